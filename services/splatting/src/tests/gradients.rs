//! Gradients of every parameter class: the reference's against central differences of its loss, and the engine's against
//! the reference's.

use glam::Vec3;

use super::harmonics::scene_of_degree;
use super::{camera, isas, random_view, scene};
use crate::model::sh_rest_rows;
use crate::reference::{self, Parameters};
use crate::{Camera, Engine, Gaussian, Gaussians, Gradient, Optimiser, RenderSettings, TrainingSettings, TrainingView};

/// Parameters of a class, as indices into [`Parameters`].
pub(crate) type Class = (&'static str, std::ops::Range<usize>);

const GEOMETRY: [Class; 4] = [("means", 0..3), ("log scales", 3..6), ("rotations", 6..10), ("opacity", 10..11)];

/// The classes that a loss of colour has a gradient of, for a degree.
pub(crate) fn classes(degree: u8) -> Vec<Class> {
    let bands = [("SH 0", 11..14), ("SH 1", 14..23), ("SH 2", 23..38), ("SH 3", 38..59)];
    GEOMETRY.into_iter().chain(bands.into_iter().take(usize::from(degree) + 1)).collect()
}

/// Cosine between two gradients of one class, and the ratio of their lengths. 0, 0 where the second is 0.
pub(crate) fn compare(got: &[Parameters], want: &[Parameters], (_, range): &Class) -> (f64, f64) {
    let (mut dot, mut got2, mut want2) = (0.0, 0.0, 0.0);
    for (got, want) in got.iter().zip(want) {
        for (got, want) in got[range.clone()].iter().zip(&want[range.clone()]) {
            (dot, got2, want2) = (dot + got * want, got2 + got * got, want2 + want * want);
        }
    }
    if want2 > 0.0 && got2 > 0.0 { (dot / (got2 * want2).sqrt(), (got2 / want2).sqrt()) } else { (0.0, 0.0) }
}

/// The engine's gradient in the order of the reference's.
fn engine_gradient(
    engine: &mut Engine,
    model: &Gaussians,
    view: &TrainingView,
    s: &TrainingSettings,
) -> Vec<Parameters> {
    flat(&engine.gradient(model, view, s).1)
}

/// A gradient in the order of the reference's.
pub(crate) fn flat(gradient: &Gradient) -> Vec<Parameters> {
    let all = gradient.parameters.iter().zip(&gradient.sh_rest);
    all.map(|(parameters, rest)| {
        let mut values = parameters.iter().chain(rest.iter().flatten());
        std::array::from_fn(|_| f64::from(*values.next().unwrap()))
    })
    .collect()
}

/// Central differences, and parameters without any effect left at 0.
fn differences(parameters: &[Parameters], degree: u8, f: impl Fn(&[Parameters]) -> f64) -> Vec<Parameters> {
    let mut moved = parameters.to_vec();
    let step = 1e-5;
    let mut at = |i: usize, k: usize, offset: f64| {
        moved[i][k] = parameters[i][k] + offset;
        let value = f(&moved);
        moved[i][k] = parameters[i][k];
        value
    };
    let used = 14 + sh_rest_rows(degree);
    let slope = |i: usize, k: usize| (at(i, k, step) - at(i, k, -step)) / (2.0 * step);
    let mut slope = slope;
    (0..parameters.len()).map(|i| std::array::from_fn(|k| if k < used { slope(i, k) } else { 0.0 })).collect()
}

/// The degree of a model, without cuts, so that the loss is smooth.
fn smooth(degree: u8) -> TrainingSettings {
    let render =
        RenderSettings { alpha_min: 0.0, transmittance_min: 0.0, sh_degree: degree, ..RenderSettings::default() };
    TrainingSettings { render, ..TrainingSettings::default() }
}

/// A loss of one term only.
fn only(term: usize, settings: TrainingSettings) -> TrainingSettings {
    let weight = |i: usize| if i == term { 1.0 } else { 0.0 };
    TrainingSettings {
        l1_weight: weight(0),
        ssim_weight: weight(1),
        depth_weight: weight(2),
        free_weight: weight(3),
        isotropic_weight: weight(4),
        opacity_weight: weight(5),
        scale_weight: weight(6),
        ..settings
    }
}

fn check_reference(settings: &TrainingSettings, degree: u8, seed: u64, classes: &[Class]) {
    let model = scene_of_degree(10, seed, degree);
    let view = random_view(camera(19, 15), seed + 1);
    let parameters = reference::parameters(&model);
    let want = differences(&parameters, degree, |p| reference::loss(p, &view, settings));
    let got = reference::gradient(&parameters, &view, settings);
    for class in classes {
        let (cosine, ratio) = compare(&got, &want, class);
        let name = class.0;
        assert!(cosine > 1.0 - 1e-7 && (ratio - 1.0).abs() < 1e-4, "degree {degree}, {name}: {cosine}, {ratio}");
    }
    let total = |gradient: &[Parameters]| gradient.iter().flatten().map(|g| g.abs()).sum::<f64>();
    let of_classes: f64 = classes
        .iter()
        .flat_map(|(_, range)| got.iter().map(|g| g[range.clone()].iter().map(|g| g.abs()).sum::<f64>()))
        .sum();
    assert!((total(&got) - of_classes).abs() < 1e-12 * of_classes, "other classes have no gradient");
}

#[test]
fn of_the_reference_are_those_of_central_differences() {
    for degree in 0..=3 {
        check_reference(&smooth(degree), degree, 40 + u64::from(degree), &classes(degree));
        let plain = RenderSettings { opacity_compensation: false, low_pass_px2: 0.3, ..smooth(degree).render };
        let settings = TrainingSettings { render: plain, isotropic_weight: 3.0, ..smooth(degree) };
        check_reference(&settings, degree, 50 + u64::from(degree), &classes(degree));
    }
}

#[test]
fn of_each_term_of_the_reference_are_those_of_central_differences() {
    for term in 0..2 {
        check_reference(&only(term, smooth(3)), 3, 60, &classes(3));
    }
    for term in 2..4 {
        check_reference(&only(term, smooth(3)), 3, 61, &GEOMETRY);
    }
    check_reference(&only(4, smooth(3)), 3, 62, &GEOMETRY[1..2]);
    check_reference(&only(5, smooth(3)), 3, 62, &GEOMETRY[3..4]);
    check_reference(&only(6, smooth(3)), 3, 62, &GEOMETRY[1..2]);
}

/// Compares the engine with the reference on every instruction set.
fn check(model: &Gaussians, camera: Camera, settings: &TrainingSettings, classes: &[Class]) {
    let view = random_view(camera, 5);
    let parameters = reference::parameters(model);
    let want = reference::gradient(&parameters, &view, settings);
    let loss = reference::loss(&parameters, &view, settings);
    for isa in isas() {
        let mut engine = Engine::with_isa(1, isa).unwrap();
        let (terms, _) = engine.gradient(model, &view, settings);
        assert!((terms.total - loss).abs() < 1e-5 * loss, "{isa:?}: loss {} instead of {loss}", terms.total);
        let got = engine_gradient(&mut engine, model, &view, settings);
        for class in classes {
            let (cosine, ratio) = compare(&got, &want, class);
            let context = format!("{isa:?}, degree {}, {}x{}", model.sh_degree(), camera.width, camera.height);
            println!("{context}, {}: 1 - {:.1e}, {ratio}", class.0, 1.0 - cosine);
            assert!(cosine > 0.99999, "{context}, {}: cosine {cosine}", class.0);
            assert!((ratio - 1.0).abs() < 1e-3, "{context}, {}: length {ratio}", class.0);
        }
    }
}

#[test]
fn of_the_engine_are_those_of_the_reference_at_every_degree() {
    for degree in 0..=3 {
        let render = RenderSettings { sh_degree: degree, ..RenderSettings::default() };
        for (compensation, (width, height)) in [(true, (35, 27)), (false, (50, 33)), (true, (17, 64))] {
            let render = RenderSettings { opacity_compensation: compensation, ..render };
            let settings = TrainingSettings { render, isotropic_weight: 1.0, ..TrainingSettings::default() };
            check(
                &scene_of_degree(60, 70 + u64::from(degree), degree),
                camera(width, height),
                &settings,
                &classes(degree),
            );
        }
    }
}

#[test]
fn of_the_engine_where_the_evaluated_degree_is_below_the_models() {
    for degree in 0..3 {
        let render = RenderSettings { sh_degree: degree, ..RenderSettings::default() };
        let settings = TrainingSettings { render, ..TrainingSettings::default() };
        check(&scene_of_degree(60, 80, 3), camera(35, 27), &settings, &classes(degree));
    }
}

#[test]
fn of_each_term_of_the_engine_are_those_of_the_reference() {
    let settings = TrainingSettings::default();
    for term in 0..2 {
        check(&scene_of_degree(60, 21, 3), camera(35, 27), &only(term, settings), &classes(3));
    }
    // Neither depends on colour.
    for term in 2..4 {
        check(&scene(60, 23), camera(35, 27), &only(term, settings), &GEOMETRY);
    }
    check(&scene(60, 23), camera(35, 27), &only(4, settings), &GEOMETRY[1..2]);
    check(&scene(60, 23), camera(35, 27), &only(5, settings), &GEOMETRY[3..4]);
    check(&scene(60, 23), camera(35, 27), &only(6, settings), &GEOMETRY[1..2]);
}

#[test]
fn of_the_whole_loss_with_the_regularisers_of_mcmc() {
    let settings = TrainingSettings { opacity_weight: 2.0, scale_weight: 3.0, ..TrainingSettings::default() };
    check(&scene_of_degree(60, 29, 2), camera(35, 27), &settings, &classes(2));
}

/// The regularisers reach every Gaussian, also one that the view does not show, and no broken one.
#[test]
fn of_the_regularisers_of_mcmc_where_a_gaussian_is_out_of_sight_or_broken() {
    let settings = TrainingSettings { scale_weight: 3.0, ..only(5, TrainingSettings::default()) };
    let mut model = scene_of_degree(37, 23, 1);
    model.set(20, &Gaussian { mean: Vec3::splat(50.0), ..model.get(20) });
    let view = random_view(camera(35, 27), 5);
    let want = reference::gradient(&reference::parameters(&model), &view, &settings);
    model.push(&Gaussian { opacity_logit: f32::NAN, ..model.get(0) });
    model.push(&Gaussian { log_scales: Vec3::splat(500.0), ..model.get(0) });
    for isa in isas() {
        let mut engine = Engine::with_isa(1, isa).unwrap();
        let got = engine_gradient(&mut engine, &model, &view, &settings);
        for (i, (got, want)) in got.iter().zip(&want).enumerate() {
            for (k, (got, want)) in got.iter().zip(want).enumerate() {
                // Two Gaussians more in the mean.
                let want = want * 37.0 / 39.0;
                assert!((got - want).abs() <= 1e-5 * want.abs() + 1e-9, "{isa:?} {i} {k}: {got} instead of {want}");
            }
        }
        assert!(got[20][10] > 0.0 && got[20][3] > 0.0);
        assert!(got[37..].iter().flatten().all(|g| *g == 0.0));
        let (mut optimiser, mut moved) = (Optimiser::new(), model.clone());
        let terms = engine.train_step(&mut moved, &mut optimiser, &view, &settings);
        let opacity: f64 = model.iter().take(37).map(|g| f64::from(g.opacity())).sum();
        assert!((terms.opacity - opacity / 39.0).abs() < 1e-6 && terms.scale_m > 0.0);
        assert!((0..39).all(|i| optimiser.steps(i) == u32::from(i < 37)));
        assert!(moved.get(20).opacity_logit < model.get(20).opacity_logit && moved.get(20).mean == model.get(20).mean);
        assert!((0..37).all(|i| moved.sh_rest(i) == model.sh_rest(i)), "the loss has nothing of colour");
    }
}

#[test]
fn with_many_gaussians_and_a_strong_low_pass() {
    let render = RenderSettings { low_pass_px2: 0.3, sh_degree: 3, ..RenderSettings::default() };
    let settings = TrainingSettings { render, ..TrainingSettings::default() };
    check(&scene_of_degree(800, 27, 3), camera(75, 53), &settings, &classes(3));
}
