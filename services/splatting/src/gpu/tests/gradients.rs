//! Gradients of the GPU against the reference's, class by class, and its loss against the CPU engine's.

use super::super::{Engine, Options};
use super::{options, skipped, with_engine};
use crate::tests::gradients::{classes, compare, flat};
use crate::tests::harmonics::scene_of_degree;
use crate::tests::{camera, random_view, scene};
use crate::{Gaussians, RenderSettings, TrainingSettings, TrainingView, reference};

/// The bar of a class: cosine to the reference.
const COSINE: f64 = 0.9999;

fn weighted(degree: u8) -> TrainingSettings {
    TrainingSettings {
        isotropic_weight: 0.1,
        render: RenderSettings { sh_degree: degree, ..RenderSettings::default() },
        ..TrainingSettings::default()
    }
}

fn check(engine: &mut Engine, model: &Gaussians, view: &TrainingView, settings: &TrainingSettings, degree: u8) {
    let (terms, gradient) = engine.gradient(model, view, settings).unwrap();
    let parameters = reference::parameters(model);
    let expected = reference::gradient(&parameters, view, settings);
    let found = flat(&gradient);
    for class in classes(degree) {
        let (cosine, ratio) = compare(&found, &expected, &class);
        println!("degree {degree}, {}: 1 - cosine {:.1e}, ratio {ratio:.6}", class.0, 1.0 - cosine);
        assert!(cosine > COSINE && (ratio - 1.0).abs() < 1e-3, "{}: cosine {cosine}, ratio {ratio}", class.0);
    }
    let loss = reference::loss(&parameters, view, settings);
    assert!((terms.total - loss).abs() < 1e-4 * loss, "{} against {loss}", terms.total);
}

#[test]
fn every_class_points_where_the_reference_points() {
    with_engine("every_class_points_where_the_reference_points", |engine| {
        for (degree, count, (width, height)) in [(0, 400, (61, 47)), (1, 200, (32, 40)), (3, 150, (50, 37))] {
            let model = scene_of_degree(count, 21 + u64::from(degree), degree);
            let view = random_view(camera(width, height), 6);
            check(engine, &model, &view, &weighted(degree), degree);
            let uncompensated = RenderSettings { opacity_compensation: false, ..weighted(degree).render };
            let settings = TrainingSettings {
                opacity_weight: 0.01,
                scale_weight: 0.01,
                render: uncompensated,
                ..weighted(degree)
            };
            check(engine, &model, &view, &settings, degree);
        }
    });
}

#[test]
fn adding_by_comparing_gives_the_same_gradients() {
    let test = "adding_by_comparing_gives_the_same_gradients";
    let Some(options) = options() else { return skipped(test) };
    let options = Options { without_subgroups: true, without_float_atomics: true, ..options };
    let view = random_view(camera(48, 33), 3);
    check(&mut Engine::new(&options).unwrap(), &scene(300, 9), &view, &weighted(0), 0);
}

#[test]
fn terms_are_those_of_the_cpu() {
    with_engine("terms_are_those_of_the_cpu", |engine| {
        let (model, settings) = (scene(300, 2), weighted(0));
        let view = random_view(camera(47, 35), 6);
        let (found, _) = engine.gradient(&model, &view, &settings).unwrap();
        let (expected, _) = crate::Engine::new(1).unwrap().gradient(&model, &view, &settings);
        let pairs = [
            (found.l1, expected.l1),
            (found.ssim, expected.ssim),
            (found.depth_m, expected.depth_m),
            (found.free_alpha, expected.free_alpha),
            (found.isotropic_m, expected.isotropic_m),
            (found.foreground_mse, expected.foreground_mse),
            (found.total, expected.total),
        ];
        for (found, expected) in pairs {
            assert!((found - expected).abs() < 2e-4 * expected.abs().max(0.01), "{found} against {expected}");
        }
    });
}
