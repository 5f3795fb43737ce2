//! Statistics of the screen against what their definitions say.

use glam::{Mat2, Vec2, Vec3};

use super::{camera, isas, random_view, scene};
use crate::reference;
use crate::{
    Camera, Engine, Gaussian, Gaussians, Optimiser, RenderSettings, ScreenStatistics, StatisticsError, TrainingSettings,
};

/// Learning rates of 0: the model stays, so that all views see the same.
fn still() -> TrainingSettings {
    let render = RenderSettings { alpha_min: 1e-6, transmittance_min: 1e-9, ..RenderSettings::default() };
    let rates =
        TrainingSettings { lr_means: 0.0, lr_log_scales: 0.0, lr_rotations: 0.0, ..TrainingSettings::default() };
    // Without depth, which counts a pixel or not by its alpha: differences across that cut say nothing.
    TrainingSettings { render, lr_opacity: 0.0, lr_sh: 0.0, depth_weight: 0.0, ..rates }
}

fn cameras() -> Vec<Camera> {
    let eyes = [Vec3::new(1.2, -1.5, 0.7), Vec3::new(-2.0, 0.3, 0.4), Vec3::new(0.2, 2.2, -0.5)];
    eyes.iter().map(|&eye| camera(44, 30).look_at(eye, Vec3::ZERO, Vec3::Z)).collect()
}

/// Where a model is one Gaussian, moving the principal point moves it over the screen and changes nothing else.
#[test]
fn the_gradient_is_that_of_moving_a_gaussian_over_the_screen() {
    let settings = still();
    let step = 1.0 / 64.0;
    for isa in isas() {
        let mut engine = Engine::with_isa(1, isa).unwrap();
        for gaussian in scene(12, 41).iter() {
            // Near the middle: outside of the image the projection is linearised at its edge, which moves too.
            let mut model: Gaussians = [Gaussian { mean: 0.3 * gaussian.mean, ..gaussian }].into_iter().collect();
            let parameters = reference::parameters(&model);
            let (mut statistics, mut optimiser, mut expected) = (ScreenStatistics::new(), Optimiser::new(), 0.0);
            for (i, camera) in cameras().into_iter().enumerate() {
                let view = |camera| random_view(camera, 90 + i as u64);
                let loss = |x: f32, y: f32| {
                    let moved = Camera { cx: camera.cx + x, cy: camera.cy + y, ..camera };
                    reference::loss(&parameters, &view(moved), &settings)
                };
                let slope = |a: f64, b: f64| (a - b) / f64::from(2.0 * step);
                let ndc_x = slope(loss(step, 0.0), loss(-step, 0.0)) * 22.0;
                let ndc_y = slope(loss(0.0, step), loss(0.0, -step)) * 15.0;
                expected += ndc_x.hypot(ndc_y);
                engine.train_step_observed(&mut model, &mut optimiser, &view(camera), &settings, &mut statistics);
            }
            assert_eq!(statistics.views(0), 3);
            let got = f64::from(statistics.gradient_sum(0));
            assert!((got / expected - 1.0).abs() < 0.02, "{isa:?}: {got} instead of {expected}");
            assert_eq!(statistics.mean_gradient(0), statistics.gradient_sum(0) / 3.0);
        }
    }
}

/// Three standard deviations along the long axis of the projected ellipsoid, by differences of the projection.
fn radius_px(gaussian: &Gaussian, camera: &Camera) -> f32 {
    let project = |offset: Vec3| camera.project(gaussian.mean + offset).unwrap().0;
    let mut covariance = Mat2::from_diagonal(Vec2::splat(RenderSettings::default().low_pass_px2));
    for axis in [Vec3::X, Vec3::Y, Vec3::Z] {
        let column = gaussian.rotation.normalize() * axis * 0.002;
        let slope = (project(column) - project(-column)) / 0.004 * (gaussian.log_scales.dot(axis)).exp();
        covariance += Mat2::from_cols(slope * slope.x, slope * slope.y);
    }
    let middle = 0.5 * (covariance.x_axis.x + covariance.y_axis.y);
    3.0 * (middle + (middle * middle - covariance.determinant()).max(0.0).sqrt()).sqrt()
}

#[test]
fn views_and_radii_are_those_of_the_projection() {
    let mut gaussians: Vec<Gaussian> = scene(30, 8)
        .iter()
        .map(|g| Gaussian { mean: 0.3 * g.mean, log_scales: g.log_scales - 1.0, opacity_logit: 0.5, ..g })
        .collect();
    // One that no camera sees, and one that two of them see.
    gaussians[7].mean = Vec3::new(0.0, 0.0, 40.0);
    gaussians[8].mean = Vec3::new(0.0, 1.8, -0.4);
    gaussians[8].log_scales = Vec3::splat(-4.0);
    let mut model: Gaussians = gaussians.iter().copied().collect();
    let (mut statistics, mut optimiser) = (ScreenStatistics::new(), Optimiser::new());
    let mut engine = Engine::new(1).unwrap();
    for (i, camera) in cameras().into_iter().enumerate() {
        let view = random_view(camera, i as u64);
        engine.train_step_observed(&mut model, &mut optimiser, &view, &still(), &mut statistics);
    }
    for (i, gaussian) in gaussians.iter().enumerate() {
        let seen = |c: &&Camera| {
            let at = c.project(gaussian.mean).map(|(uv, _)| uv);
            at.is_some_and(|uv| uv.cmpge(Vec2::ZERO).all() && uv.x < 44.0 && uv.y < 30.0)
        };
        let cameras = cameras();
        let seeing: Vec<&Camera> = cameras.iter().filter(seen).collect();
        let radius = seeing.iter().map(|c| radius_px(gaussian, c)).fold(0.0, f32::max);
        assert_eq!(statistics.views(i), seeing.len() as u32, "{i}");
        let got = statistics.radius_px(i);
        assert!((got - radius).abs() <= 0.01 * radius, "{i}: {got} px instead of {radius}");
    }
    assert_eq!(statistics.views(7), 0);
    assert_eq!((statistics.gradient_sum(7), statistics.mean_gradient(7)), (0.0, 0.0));
    statistics.reset();
    assert!((0..30).all(|i| statistics.views(i) == 0 && statistics.radius_px(i) == 0.0) && statistics.len() == 30);
}

/// A Gaussian behind an opaque wall is projected, and the loss does not pull at it.
#[test]
fn a_hidden_gaussian_is_seen_without_gradient() {
    let [template] = [scene(1, 3).get(0)];
    let camera = camera(40, 30).look_at(Vec3::new(2.0, 0.0, 0.0), Vec3::ZERO, Vec3::Z);
    let wall = (0..20).map(|i| Gaussian {
        mean: Vec3::X * (1.0 - 0.001 * i as f32),
        log_scales: Vec3::new(-7.0, 0.0, 0.0),
        rotation: glam::Quat::IDENTITY,
        opacity_logit: 6.0,
        ..template
    });
    let hidden = Gaussian { mean: Vec3::X * -0.5, log_scales: Vec3::splat(-3.0), opacity_logit: 1.0, ..template };
    let mut model: Gaussians = wall.chain(std::iter::repeat_n(hidden, 30)).collect();
    let mut statistics = ScreenStatistics::new();
    let (mut engine, mut optimiser) = (Engine::new(1).unwrap(), Optimiser::new());
    let settings = TrainingSettings::default();
    engine.train_step_observed(&mut model, &mut optimiser, &random_view(camera, 1), &settings, &mut statistics);
    assert!(statistics.gradient_sum(0) > 0.0);
    for i in 20..50 {
        assert_eq!((statistics.views(i), statistics.gradient_sum(i), optimiser.steps(i)), (1, 0.0, 0));
        assert!(statistics.radius_px(i) > 0.0);
    }
}

#[test]
fn an_observed_step_is_the_plain_step_and_statistics_are_the_same_for_any_number_of_threads() {
    let views: Vec<_> = cameras().into_iter().enumerate().map(|(i, c)| random_view(c, i as u64)).collect();
    for settings in [
        TrainingSettings::default(),
        TrainingSettings { opacity_weight: 0.01, scale_weight: 0.01, ..TrainingSettings::default() },
    ] {
        let run = |threads: usize, observed: bool| {
            let mut engine = Engine::new(threads).unwrap();
            let (mut model, mut optimiser) = (scene(3000, 5), Optimiser::new());
            let mut statistics = ScreenStatistics::new();
            let mut terms = Vec::new();
            for view in views.iter().cycle().take(6) {
                terms.push(if observed {
                    engine.train_step_observed(&mut model, &mut optimiser, view, &settings, &mut statistics)
                } else {
                    engine.train_step(&mut model, &mut optimiser, view, &settings)
                });
            }
            (model, optimiser, terms, statistics)
        };
        let one = run(1, true);
        assert!(one == run(2, true) && one == run(3, true));
        let plain = run(1, false);
        assert!((&one.0, &one.1, &one.2) == (&plain.0, &plain.1, &plain.2));
        assert!(plain.3.is_empty() && one.3.len() == 3000);
    }
}

#[test]
fn statistics_follow_the_model_and_come_back_from_bytes() {
    let (mut model, mut optimiser) = (scene(50, 5), Optimiser::new());
    let (mut statistics, mut engine) = (ScreenStatistics::new(), Engine::new(1).unwrap());
    let view = random_view(cameras()[0], 3);
    engine.train_step_observed(&mut model, &mut optimiser, &view, &TrainingSettings::default(), &mut statistics);
    assert_eq!(ScreenStatistics::decode(&statistics.encode(), 50).as_ref(), Ok(&statistics));
    let before: Vec<f32> = (0..50).map(|i| statistics.gradient_sum(i)).collect();
    assert!(before[3] != before[46]);
    statistics.retain(|i| i % 2 == 0);
    statistics.permute(&(0..25).rev().collect::<Vec<u32>>());
    assert!((0..25).all(|i| statistics.gradient_sum(i) == before[48 - 2 * i]));
    statistics.fit(&model);
    assert_eq!((statistics.len(), statistics.gradient_sum(49)), (50, 0.0));

    let bytes = statistics.encode();
    let short = ScreenStatistics::decode(&bytes[1..], 50);
    assert_eq!(short, Err(StatisticsError::Length { found: 599, gaussians: 50, expected: 600 }));
    let mut broken = bytes.clone();
    broken[7 * 12 + 4..][..4].copy_from_slice(&f32::NAN.to_le_bytes());
    let error = ScreenStatistics::decode(&broken, 50).unwrap_err();
    assert!(error.to_string().contains("Gaussian 7 are NaN"), "{error}");
}
