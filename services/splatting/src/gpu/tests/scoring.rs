//! What views are scored by, against the same on the CPU.

use std::sync::Mutex;
use std::sync::atomic::AtomicBool;

use glam::{DVec3, Vec3};

use super::super::{GpuError, Options};
use super::{options, skipped, with_engine};
use crate::gpu::Engine;
use crate::tests::scene;
use crate::uncertainty::{BoundingBox, Uncertainty, UncertaintySettings, VarianceMode};
use crate::{Backend, Camera, Gaussians, Pose, RenderSettings};

/// Views around the box, from near enough to be inside to far enough to see it whole, of two sizes.
fn cameras(count: u32) -> Vec<Camera> {
    (0..count)
        .map(|k| {
            let angle = 1.1 * k as f32;
            let radius = 0.7 + 0.35 * (k % 6) as f32;
            let eye = radius * Vec3::new(angle.cos(), angle.sin(), 0.4 - 0.2 * (k % 4) as f32);
            let (width, height) = if k % 7 < 5 { (64, 48) } else { (40, 56) };
            Camera::from_hfov(Pose::IDENTITY, 1.2, width, height).look_at(eye, Vec3::new(0.1, 0.0, 0.0), Vec3::Z)
        })
        .collect()
}

fn asked(mode: VarianceMode) -> UncertaintySettings {
    let bounding_box = BoundingBox { center_m: DVec3::new(0.05, -0.1, 0.0), size_m: 1.3 };
    UncertaintySettings { mode, bounding_box, transparent_alpha: 0.1 }
}

fn of(backend: &mut Backend, model: &Gaussians, cameras: &[Camera], mode: VarianceMode) -> Vec<Uncertainty> {
    let found = Mutex::new(vec![None; cameras.len()]);
    let settings = (&asked(mode), &RenderSettings::default());
    let visit = |index: usize, seen| assert!(found.lock().unwrap()[index].replace(seen).is_none(), "{index} twice");
    backend.uncertainties(model, cameras, settings, &AtomicBool::new(false), visit).unwrap();
    found.into_inner().unwrap().into_iter().map(|seen| seen.expect("each view is visited")).collect()
}

#[test]
fn views_are_scored_as_on_the_cpu() {
    let test = "views_are_scored_as_on_the_cpu";
    let Some(options) = options() else { return skipped(test) };
    // Lists that do not fit at first, so that a batch is drawn again.
    let mut gpu = Backend::Gpu(Box::new(Engine::new(&Options { pairs: 60, ..options }).unwrap()));
    let mut cpu = Backend::from(crate::Engine::new(1).unwrap());
    // More of one size than a chain has, once: 135 of the 189.
    for (mode, count) in [(VarianceMode::Normalised, 189), (VarianceMode::Paper, 23)] {
        let cameras = cameras(count);
        for model in [scene(400, 8), scene(17, 9), Gaussians::new()] {
            let expected = of(&mut cpu, &model, &cameras, mode);
            let found = of(&mut gpu, &model, &cameras, mode);
            for (k, (a, b)) in expected.iter().zip(&found).enumerate() {
                let near = |a: f64, b: f64, margin: f64| (a - b).abs() <= margin * a.abs().max(0.01);
                // A pixel at the border of transparency may fall to either side.
                assert!(
                    near(a.mean_variance_m2, b.mean_variance_m2, 5e-3)
                        && near(a.mean_alpha, b.mean_alpha, 1e-3)
                        && (a.transparent_fraction - b.transparent_fraction).abs() < 3e-3
                        && a.area_fraction == b.area_fraction,
                    "view {k} in {mode:?}: {a:?} {b:?}"
                );
            }
        }
    }
}

#[test]
fn scoring_that_is_cancelled_says_so() {
    with_engine("scoring_that_is_cancelled_says_so", |engine| {
        let settings = (&asked(VarianceMode::Paper), &RenderSettings::default());
        let cancelled = AtomicBool::new(true);
        let result = engine.uncertainties(&scene(20, 1), &cameras(3), settings, &cancelled, |_, _| panic!("visited"));
        assert_eq!(result, Err(GpuError::Cancelled));
    });
}
