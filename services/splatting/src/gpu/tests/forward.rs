//! Images and moments of the GPU against the reference and against the CPU engine.

use std::sync::Mutex;
use std::sync::atomic::AtomicBool;

use glam::Vec3;

use super::super::{Engine, GpuError, Options};
use super::{options, skipped, with_engine};
use crate::tests::forward::{assert_within, errors};
use crate::tests::harmonics::scene_of_degree;
use crate::tests::{camera, scene};
use crate::{Gaussians, Moments, MomentsView, RenderSettings, Rendered, reference};

/// Bar of an image where no pixel is at a cut.
const TOLERANCE: f64 = 1e-3;

fn settings() -> RenderSettings {
    RenderSettings { background: Vec3::new(0.1, 0.5, 0.9), ..RenderSettings::default() }
}

#[test]
fn images_are_those_of_the_reference() {
    with_engine("images_are_those_of_the_reference", |engine| {
        for (degree, count, (width, height)) in [(0, 300, (61, 47)), (1, 2000, (64, 64)), (3, 700, (35, 59))] {
            let (model, camera) = (scene_of_degree(count, 3 + u64::from(degree), degree), camera(width, height));
            let uncompensated = RenderSettings { opacity_compensation: false, low_pass_px2: 0.3, ..settings() };
            for settings in [settings(), uncompensated] {
                let mut rendered = Rendered::default();
                engine.render(&model, &camera, &settings, &mut rendered).unwrap();
                let expected = reference::render(&reference::parameters(&model), &camera, &settings, 0.0);
                let errors = errors(&rendered, &expected, settings.background);
                assert_within(&errors, &expected, TOLERANCE, &format!("degree {degree}, {count} Gaussians"));
            }
        }
    });
}

fn moments(engine: &mut Engine, model: &Gaussians, views: &[MomentsView]) -> Vec<Moments> {
    let found = Mutex::new(vec![Moments::default(); views.len()]);
    let visit = |index: usize, moments: &Moments| found.lock().unwrap()[index] = moments.clone();
    engine.moments_batch(model, views, &settings(), &AtomicBool::new(false), visit).unwrap();
    found.into_inner().unwrap()
}

fn views(count: usize, width: u32, height: u32) -> Vec<MomentsView> {
    (0..count)
        .map(|i| {
            let angle = i as f32 * 0.61;
            let eye = Vec3::new(1.9 * angle.cos(), 1.9 * angle.sin(), 0.4 + 0.05 * i as f32);
            MomentsView { camera: camera(width, height).look_at(eye, Vec3::ZERO, Vec3::Z), reference_m: 1.9 }
        })
        .collect()
}

#[test]
fn a_batch_of_moments_is_what_the_reference_has_of_each_view() {
    with_engine("a_batch_of_moments_is_what_the_reference_has_of_each_view", |engine| {
        let model = scene(900, 5);
        // Two sizes of images in one request.
        let mut all = views(5, 37, 29);
        all.extend(views(2, 16, 16));
        let found = moments(engine, &model, &all);
        for (view, found) in all.iter().zip(&found) {
            let expected =
                reference::render(&reference::parameters(&model), &view.camera, &settings(), view.reference_m.into());
            let error = |i: usize| {
                let (pixel, alpha) = (&expected[i], f64::from(found.alpha[i]));
                let (first, second) = (f64::from(found.first[i]), f64::from(found.second[i]));
                let differences = [pixel.alpha - alpha, pixel.first - first, pixel.second - second];
                differences.map(f64::abs).into_iter().fold(0.0, f64::max)
            };
            let errors: Vec<f64> = (0..expected.len()).map(error).collect();
            assert_within(&errors, &expected, TOLERANCE, "moments");
            assert_eq!((found.width, found.height), (view.camera.width, view.camera.height));
        }
    });
}

#[test]
fn a_view_of_a_batch_does_not_depend_on_the_others() {
    with_engine("a_view_of_a_batch_does_not_depend_on_the_others", |engine| {
        let (model, all) = (scene(500, 8), views(4, 33, 20));
        let together = moments(engine, &model, &all);
        for (view, together) in all.iter().zip(&together) {
            assert_eq!(&moments(engine, &model, std::slice::from_ref(view))[0], together);
        }
    });
}

#[test]
fn a_cancelled_batch_says_so() {
    with_engine("a_cancelled_batch_says_so", |engine| {
        let result =
            engine.moments_batch(&scene(10, 1), &views(2, 16, 16), &settings(), &AtomicBool::new(true), |_, _| {});
        assert_eq!(result, Err(GpuError::Cancelled));
    });
}

#[test]
fn portable_paths_draw_the_same_image_bit_for_bit() {
    let test = "portable_paths_draw_the_same_image_bit_for_bit";
    let Some(options) = options() else { return skipped(test) };
    let (model, camera) = (scene(1500, 4), camera(64, 48));
    let images = [false, true].map(|portable| {
        let (without_subgroups, without_float_atomics, without_indirect) = (portable, portable, portable);
        let options = Options { without_subgroups, without_float_atomics, without_indirect, ..options.clone() };
        let mut rendered = Rendered::default();
        Engine::new(&options).unwrap().render(&model, &camera, &settings(), &mut rendered).unwrap();
        rendered
    });
    assert!(images[0] == images[1], "the order of splats is exact in both");
}
