//! Training steps: they converge, they are deterministic, their state follows the model.

use glam::Vec3;

use super::{Random, camera, isas, random_view, scene};
use crate::{
    Camera, Engine, Gaussian, Gaussians, Isa, Optimiser, PixelClass, RenderSettings, Rendered, TrainingSettings,
    TrainingView, ViewError, metrics,
};

/// Views of a model from around it, as a trainer would have them.
fn views(model: &Gaussians, count: usize) -> Vec<TrainingView> {
    let mut engine = Engine::new(1).unwrap();
    (0..count)
        .map(|i| {
            let angle = i as f32 * std::f32::consts::TAU / count as f32;
            let eye = Vec3::new(2.0 * angle.cos(), 2.0 * angle.sin(), 0.8);
            let camera = camera(80, 60).look_at(eye, Vec3::ZERO, Vec3::Z);
            let mut image = Rendered::default();
            engine.render(model, &camera, &RenderSettings::default(), &mut image);
            let class: Vec<PixelClass> =
                image.alpha.iter().map(|&a| if a > 0.5 { PixelClass::Foreground } else { PixelClass::Free }).collect();
            TrainingView::new(camera, &image.color, &image.depth, &class).unwrap()
        })
        .collect()
}

fn disturbed(model: &Gaussians) -> Gaussians {
    let mut random = Random(77);
    let mut moved = |by: f32| random.vector(-by, by);
    model
        .iter()
        .map(|g| Gaussian {
            mean: g.mean + moved(0.02),
            log_scales: g.log_scales + moved(0.2),
            sh: (Vec3::from_array(g.sh) + moved(0.8)).to_array(),
            ..g
        })
        .collect()
}

#[test]
fn training_finds_back_to_a_disturbed_model() {
    let truth = scene(300, 12);
    let views = views(&truth, 6);
    let settings = TrainingSettings { lr_means: 5e-4, lr_sh: 2e-2, ..TrainingSettings::default() };
    for isa in isas().into_iter().filter(|&isa| isa != Isa::Portable) {
        let mut engine = Engine::with_isa(2, isa).unwrap();
        let mut model = disturbed(&truth);
        let mut optimiser = Optimiser::new();
        let first: f64 = views.iter().map(|v| engine.gradient(&model, v, &settings).0.foreground_mse).sum();
        for i in 0..300 {
            engine.train_step(&mut model, &mut optimiser, &views[i % views.len()], &settings);
        }
        let last: f64 = views.iter().map(|v| engine.gradient(&model, v, &settings).0.foreground_mse).sum();
        let gain_db = metrics::psnr_db(last) - metrics::psnr_db(first);
        assert!(gain_db > 8.0, "{isa:?}: gained only {gain_db} dB");
        assert!(model.is_finite());
    }
}

#[test]
fn training_gives_the_same_bits_for_any_number_of_threads() {
    let truth = scene(12_000, 12);
    let views = views(&truth, 3);
    let settings =
        TrainingSettings { isotropic_weight: 0.1, sigma_limits_m: Some((0.01, 0.4)), ..TrainingSettings::default() };
    let train = |threads: usize| {
        let mut engine = Engine::new(threads).unwrap();
        let mut model = disturbed(&truth);
        let mut optimiser = Optimiser::new();
        let terms: Vec<_> =
            (0..12).map(|i| engine.train_step(&mut model, &mut optimiser, &views[i % 3], &settings)).collect();
        (model, optimiser, terms)
    };
    let one = train(1);
    assert!(one == train(2));
    assert!(one == train(3));
}

#[test]
fn only_drawn_gaussians_move_and_sigmas_stay_inside_their_limits() {
    let mut model = scene(100, 3);
    let hidden = Gaussian { mean: Vec3::new(30.0, 0.0, 0.0), ..model.get(0) };
    model.push(&hidden);
    let mut optimiser = Optimiser::new();
    let mut engine = Engine::new(1).unwrap();
    let view = random_view(camera(50, 40), 4);
    let settings = TrainingSettings { sigma_limits_m: Some((0.05, 0.1)), ..TrainingSettings::default() };
    let before = model.clone();
    for _ in 0..4 {
        engine.train_step(&mut model, &mut optimiser, &view, &settings);
    }
    assert_eq!((model.get(100), optimiser.steps(100)), (hidden, 0));
    let drawn: Vec<usize> = (0..100).filter(|&i| optimiser.steps(i) == 4).collect();
    assert!(drawn.len() > 50);
    for i in drawn {
        let sigmas = model.get(i).log_scales.exp();
        assert!(sigmas.min_element() >= 0.0499 && sigmas.max_element() <= 0.1001, "{sigmas}");
        assert_ne!(model.get(i).mean, before.get(i).mean);
    }
}

/// The first step of Adam moves each parameter by its learning rate, whatever the size of its gradient.
#[test]
fn the_first_step_has_the_length_of_the_learning_rate() {
    let mut model = scene(80, 3);
    let before = model.clone();
    let view = random_view(camera(50, 40), 4);
    let settings = TrainingSettings::default();
    let mut engine = Engine::new(1).unwrap();
    let gradient = engine.gradient(&model, &view, &settings).1.parameters;
    engine.train_step(&mut model, &mut Optimiser::new(), &view, &settings);
    let mut checked = 0;
    for (i, gradient) in gradient.iter().enumerate().filter(|(_, g)| g[0].abs() > 1e-7 && g[10].abs() > 1e-7) {
        let (old, new) = (before.get(i), model.get(i));
        assert!((new.mean.x - old.mean.x + 1e-4 * gradient[0].signum()).abs() < 2e-6);
        assert!((new.opacity_logit - old.opacity_logit + 0.05 * gradient[10].signum()).abs() < 1e-4);
        checked += 1;
    }
    assert!(checked > 30);
}

#[test]
fn state_follows_retain_and_permute() {
    let view = random_view(camera(50, 40), 4);
    let settings = TrainingSettings::default();
    let mut engine = Engine::new(1).unwrap();
    // Every fifth Gaussian is out of sight and takes no steps.
    let away = |i: u64| Vec3::X * if i.is_multiple_of(5) { 30.0 } else { 0.0 };
    let mut model: Gaussians = scene(90, 3).iter().map(|g| Gaussian { mean: g.mean + away(g.id), ..g }).collect();
    let mut optimiser = Optimiser::new();
    for _ in 0..3 {
        engine.train_step(&mut model, &mut optimiser, &view, &settings);
    }
    // Reversed and back is as if nothing had happened, and so is a removal of what another copy removes too.
    let (mut model2, mut optimiser2) = (model.clone(), optimiser.clone());
    let reversed: Vec<u32> = (0..90).rev().collect();
    for _ in 0..2 {
        model2.permute(&reversed);
        optimiser2.permute(&reversed);
    }
    assert_eq!((&model, &optimiser), (&model2, &optimiser2));
    model2.permute(&reversed);
    optimiser2.permute(&reversed);
    assert!((0..90).all(|i| optimiser2.steps(i) == optimiser.steps(89 - i)));
    assert!((0..90).any(|i| optimiser2.steps(i) != optimiser2.steps(0)), "some were never drawn");
    model.retain(|i| i >= 40);
    optimiser.retain(|i| i >= 40);
    model2.retain(|i| i < 50);
    optimiser2.retain(|i| i < 50);
    let back: Vec<u32> = (0..50).rev().collect();
    model2.permute(&back);
    optimiser2.permute(&back);
    assert_eq!((&model, &optimiser), (&model2, &optimiser2));
    // A new Gaussian begins at 0.
    model.push(&scene(1, 5).get(0));
    optimiser.fit(&model);
    assert_eq!((optimiser.len(), optimiser.steps(50)), (51, 0));
}

#[test]
fn views_that_do_not_fit_are_refused() {
    let camera = camera(10, 8);
    let (color, depth, class) = (vec![[0.5; 3]; 80], vec![1.0; 80], vec![PixelClass::Free; 80]);
    assert!(TrainingView::new(camera, &color, &depth, &class).is_ok());
    let error = TrainingView::new(camera, &color, &depth[1..], &class).err().unwrap();
    assert!(error.to_string().contains("depth has 79 pixels") && error.to_string().contains("10x8"), "{error}");
    let mut broken = color.clone();
    broken[23] = [0.0, f32::NAN, 0.0];
    assert_eq!(TrainingView::new(camera, &broken, &depth, &class).err(), Some(ViewError::Color { x: 3, y: 2 }));
    let blind = Camera { fy: 0.0, ..camera };
    assert!(matches!(TrainingView::new(blind, &color, &depth, &class), Err(ViewError::Camera(_))));
}
