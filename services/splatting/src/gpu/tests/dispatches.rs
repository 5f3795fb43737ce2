//! How many dispatches an iteration has, and that the GPU says how large those of the sort and of the lists are.

use glam::Vec3;

use super::super::chain::DISPATCHES;
use super::training::{settings, task};
use super::{options, skipped, with_engine};
use crate::gpu::{Engine, Options};
use crate::tests::{camera, scene};
use crate::{Gaussians, McmcSettings, Optimiser, RenderSettings, Rendered, ScreenStatistics};

#[test]
fn an_iteration_is_eighteen_dispatches_and_never_more_than_twenty_five() {
    let test = "an_iteration_is_eighteen_dispatches_and_never_more_than_twenty_five";
    let Some(options) = options() else { return skipped(test) };
    let (start, views) = task(60, (24, 24), 0);
    let mut engine = Engine::new(&Options { deterministic: true, ..options }).unwrap();
    engine.upload(&start, &mut Optimiser::new(), &mut ScreenStatistics::new()).unwrap();
    let noise = crate::densify::Noise::new(&McmcSettings::default(), 1e-4, 1, 1);
    let mut count = |everything: bool| {
        let before = DISPATCHES.get();
        for view in &views {
            if everything {
                engine.step_observed(view, &settings()).unwrap();
                engine.add_noise(&noise).unwrap();
            } else {
                engine.step(view, &settings()).unwrap();
            }
        }
        engine.finish().unwrap();
        (DISPATCHES.get() - before) / views.len() as u32
    };
    // With ordered sums it is one more, with statistics and noise three.
    assert_eq!((count(false), count(true)), (19, 21));
}

/// Few of many Gaussians are drawn: what comes after the first pass of the sort has few workgroups, and the image is the
/// same, with the workgroups of all and on the CPU.
#[test]
fn few_drawn_gaussians_of_many_are_sorted_by_few_workgroups() {
    let test = "few_drawn_gaussians_of_many_are_sorted_by_few_workgroups";
    let Some(options) = options() else { return skipped(test) };
    let mut fixed = Engine::new(&Options { without_indirect: true, ..options }).unwrap();
    with_engine(test, |engine| {
        let camera = camera(64, 48);
        for (count, drawn) in [(9000, 1), (9000, 100), (9000, 0), (9000, 4), (3, 1)] {
            let mut model: Gaussians = scene(count, 4);
            let eye = camera.world_from_camera.translation;
            for i in (0..count).filter(|i| drawn == 0 || i % drawn != 0) {
                let gaussian = model.get(i);
                // Behind the camera.
                let mean = eye + (eye - gaussian.mean) + Vec3::splat(1e-3 * i as f32);
                model.set(i, &crate::Gaussian { mean, ..gaussian });
            }
            let [mut a, mut b, mut c] = [const { None }; 3].map(|_: Option<()>| Rendered::default());
            engine.render(&model, &camera, &RenderSettings::default(), &mut a).unwrap();
            fixed.render(&model, &camera, &RenderSettings::default(), &mut b).unwrap();
            crate::Engine::new(1).unwrap().render(&model, &camera, &RenderSettings::default(), &mut c);
            assert!(a == b, "{count} {drawn}");
            let apart =
                a.color.iter().zip(&c.color).filter(|(a, c)| (0..3).any(|k| (a[k] - c[k]).abs() > 1e-3)).count();
            assert!(apart <= 4, "{count} {drawn}: {apart} pixels");
            assert_eq!(drawn == 0, a.alpha.iter().all(|&alpha| alpha == 0.0), "{count} {drawn}");
        }
    });
}
