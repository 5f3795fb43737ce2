//! Gradients of every parameter class against central differences of the reference.

use glam::Vec3;

use super::{camera, isas, random_view, scene};
use crate::reference::{self, Parameters};
use crate::{Engine, Gaussian, Optimiser, RenderSettings, TrainingSettings};

const CLASSES: [(&str, std::ops::Range<usize>); 5] =
    [("means", 0..3), ("log scales", 3..6), ("rotations", 6..10), ("opacity", 10..11), ("SH", 11..14)];

/// No cuts, so that the loss is smooth where the engine claims that it is.
fn smooth() -> TrainingSettings {
    TrainingSettings {
        render: RenderSettings { alpha_min: 1e-6, transmittance_min: 1e-9, ..RenderSettings::default() },
        ..TrainingSettings::default()
    }
}

fn differences(parameters: &[Parameters], f: impl Fn(&[Parameters]) -> f64) -> Vec<Parameters> {
    let mut moved = parameters.to_vec();
    let step = 1e-6;
    let mut at = |i: usize, k: usize, offset: f64| {
        moved[i][k] = parameters[i][k] + offset;
        let value = f(&moved);
        moved[i][k] = parameters[i][k];
        value
    };
    (0..parameters.len()).map(|i| std::array::from_fn(|k| (at(i, k, step) - at(i, k, -step)) / (2.0 * step))).collect()
}

fn check(settings: &TrainingSettings, count: usize, seed: u64) {
    let model = scene(count, seed);
    let view = random_view(camera(35, 27), seed + 1);
    let expected = differences(&reference::parameters(&model), |p| reference::loss(p, &view, settings));
    for isa in isas() {
        let (terms, gradient) = Engine::with_isa(1, isa).unwrap().gradient(&model, &view, settings);
        let gradient = gradient.parameters;
        let reference = reference::loss(&reference::parameters(&model), &view, settings);
        assert!((terms.total - reference).abs() < 1e-4 * reference, "{isa:?}: loss {} for {reference}", terms.total);
        for (name, range) in CLASSES {
            let (mut dot, mut got2, mut want2) = (0.0, 0.0, 0.0);
            for (got, want) in gradient.iter().zip(&expected) {
                for k in range.clone() {
                    let (got, want) = (f64::from(got[k]), want[k]);
                    (dot, got2, want2) = (dot + got * want, got2 + got * got, want2 + want * want);
                }
            }
            let cosine = dot / (got2 * want2).sqrt();
            let ratio = (got2 / want2).sqrt();
            assert!(want2 > 0.0, "the scene has no gradient of {name}");
            assert!(cosine > 0.9999 && (ratio - 1.0).abs() < 2e-3, "{isa:?} {name}: cosine {cosine}, length {ratio}");
        }
    }
}

/// A loss of one term only.
fn only(term: usize) -> TrainingSettings {
    let weight = |i: usize| if i == term { 1.0 } else { 0.0 };
    TrainingSettings {
        l1_weight: weight(0),
        ssim_weight: weight(1),
        depth_weight: weight(2),
        free_weight: weight(3),
        ..smooth()
    }
}

#[test]
fn of_the_l1_loss() {
    check(&only(0), 24, 21);
}

#[test]
fn of_the_ssim_loss() {
    check(&only(1), 24, 22);
}

#[test]
fn of_the_whole_default_loss() {
    check(&smooth(), 30, 24);
}

#[test]
fn of_the_papers_loss_with_its_regulariser() {
    check(&TrainingSettings { isotropic_weight: 5.0, free_weight: 0.0, ..smooth() }, 24, 25);
}

#[test]
fn of_the_whole_loss_with_the_regularisers_of_mcmc() {
    check(&TrainingSettings { opacity_weight: 2.0, scale_weight: 3.0, ..smooth() }, 24, 27);
}

/// The regularisers reach every Gaussian, also one that the view does not show, and no broken one.
#[test]
fn of_the_regularisers_of_mcmc_alone() {
    let settings = TrainingSettings { opacity_weight: 2.0, scale_weight: 3.0, ..only(9) };
    let mut model = scene(37, 23);
    model.set(20, &Gaussian { mean: Vec3::splat(50.0), ..model.get(20) });
    let expected =
        differences(&reference::parameters(&model), |p| reference::loss(p, &random_view(camera(35, 27), 5), &settings));
    model.push(&Gaussian { opacity_logit: f32::NAN, ..model.get(0) });
    model.push(&Gaussian { log_scales: Vec3::splat(500.0), ..model.get(0) });
    let view = random_view(camera(35, 27), 5);
    for isa in isas() {
        let mut engine = Engine::with_isa(1, isa).unwrap();
        let (terms, gradient) = engine.gradient(&model, &view, &settings);
        let gradient = gradient.parameters;
        for (i, (got, want)) in gradient.iter().zip(&expected).enumerate() {
            for k in 0..14 {
                // Two Gaussians more in the mean.
                let want = want[k] * 37.0 / 39.0;
                assert!(
                    (f64::from(got[k]) - want).abs() <= 1e-5 * want.abs() + 1e-9,
                    "{isa:?} {i} {k}: {got:?} {want}"
                );
            }
        }
        assert!(gradient[20][10] > 0.0 && gradient[20][3] > 0.0);
        assert!(gradient[37..].iter().all(|g| *g == [0.0; 14]));
        let opacity: f64 = model.iter().take(37).map(|g| f64::from(g.opacity())).sum();
        assert!((terms.opacity - opacity / 39.0).abs() < 1e-6 && terms.scale_m > 0.0);
        let (mut optimiser, mut moved) = (Optimiser::new(), model.clone());
        engine.train_step(&mut moved, &mut optimiser, &view, &settings);
        assert!((0..39).all(|i| optimiser.steps(i) == u32::from(i < 37)));
        assert!(moved.get(20).opacity_logit < model.get(20).opacity_logit && moved.get(20).mean == model.get(20).mean);
    }
}

#[test]
fn without_opacity_compensation() {
    let render = RenderSettings { opacity_compensation: false, low_pass_px2: 0.3, ..smooth().render };
    check(&TrainingSettings { render, ..smooth() }, 24, 26);
}

/// Depth and free space do not depend on colour, so only the other classes are compared.
#[test]
fn of_the_depth_and_the_free_space_loss() {
    for term in [2, 3] {
        let settings = only(term);
        let model = scene(30, 23);
        let view = random_view(camera(35, 27), 5);
        let expected = differences(&reference::parameters(&model), |p| reference::loss(p, &view, &settings));
        for isa in isas() {
            let gradient = Engine::with_isa(1, isa).unwrap().gradient(&model, &view, &settings).1.parameters;
            for (name, range) in &CLASSES[..4] {
                let (mut dot, mut got2, mut want2) = (0.0, 0.0, 0.0);
                for (got, want) in gradient.iter().zip(&expected) {
                    for k in range.clone() {
                        let (got, want) = (f64::from(got[k]), want[k]);
                        (dot, got2, want2) = (dot + got * want, got2 + got * got, want2 + want * want);
                    }
                }
                let cosine = dot / (got2 * want2).sqrt();
                assert!(want2 > 0.0 && cosine > 0.9999, "{isa:?} {name}, term {term}: cosine {cosine}");
            }
            assert!(gradient.iter().all(|g| g[11..] == [0.0; 3]));
        }
    }
}
