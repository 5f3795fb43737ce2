//! Whole offline runs on a small scene: what densification is worth.

use glam::{Quat, Vec3};

use super::Random;
use crate::{
    Camera, ColoredPoint, DefaultSettings, Densifier, DensifierState, Engine, Gaussian, Gaussians, InitialGaussians,
    McmcSettings, Optimiser, Pose, RenderSettings, Rendered, Schedule, ScreenStatistics, Strategy, Training,
    TrainingSettings, TrainingView, metrics, scene_extent,
};

/// A bumpy sphere of about 0.5 m with fine stripes, as Gaussians lying on its surface.
fn target(count: usize) -> Gaussians {
    let golden = std::f32::consts::PI * (3.0 - 5_f32.sqrt());
    (0..count)
        .map(|i| {
            let z = 1.0 - 2.0 * (i as f32 + 0.5) / count as f32;
            let (sin, cos) = (golden * i as f32).sin_cos();
            let normal = Vec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z);
            let bump = 0.5 + 0.06 * (7.0 * normal.x).sin() * (6.0 * normal.y).cos();
            let stripe = 0.5 + 0.4 * (23.0 * normal.z + 9.0 * normal.x).sin();
            let spacing = (4.0 * std::f32::consts::PI * 0.25 / count as f32).sqrt();
            Gaussian {
                mean: bump * normal,
                log_scales: Vec3::new(0.55 * spacing, 0.55 * spacing, 0.1 * spacing).map(f32::ln),
                rotation: Quat::from_rotation_arc(Vec3::Z, normal),
                opacity_logit: 4.0,
                sh: Gaussian::sh_from_color([stripe, 0.3 + 0.3 * normal.x, 0.8 - stripe * 0.5]),
                id: i as u64,
                birth_round: 0,
            }
        })
        .collect()
}

fn cameras(count: usize, phase: f32) -> Vec<Camera> {
    (0..count)
        .map(|i| {
            let z = 0.75 - 1.5 * (i as f32 + 0.5) / count as f32;
            let angle = 2.4 * (i as f32 + phase);
            let eye = 1.6 * Vec3::new((1.0 - z * z).sqrt() * angle.cos(), (1.0 - z * z).sqrt() * angle.sin(), z);
            Camera::from_hfov(Pose::IDENTITY, 0.8, 160, 120).look_at(eye, Vec3::ZERO, Vec3::Z)
        })
        .collect()
}

struct Scene {
    views: Vec<TrainingView>,
    held_out: Vec<(Camera, Vec<[f32; 3]>)>,
    points: Vec<ColoredPoint>,
    extent_m: f32,
}

/// Twenty views of the target, five held out, and one in twelve of its places, disturbed.
fn observed_scene() -> Scene {
    let truth = target(3000);
    let mut engine = Engine::new(1).unwrap();
    let mut images = |cameras: Vec<Camera>| -> Vec<(Camera, Vec<[f32; 3]>)> {
        let mut image = Rendered::default();
        cameras
            .into_iter()
            .map(|camera| {
                engine.render(&truth, &camera, &RenderSettings::default(), &mut image);
                (camera, image.color.clone())
            })
            .collect()
    };
    let views = images(cameras(20, 0.0))
        .into_iter()
        .map(|(camera, color)| TrainingView::full_image(camera, &color, &vec![0.0; color.len()]).unwrap())
        .collect();
    let mut random = Random(17);
    let points = truth
        .iter()
        .step_by(12)
        .map(|g| ColoredPoint { position: g.mean + random.vector(-0.02, 0.02), color: g.color() })
        .collect();
    let extent_m = scene_extent(&cameras(20, 0.0)).unwrap();
    Scene { views, held_out: images(cameras(5, 0.5)), points, extent_m }
}

/// Trains as an offline trainer does, with all but the model saved and restored before one iteration; returns the model
/// and the mean PSNR of the held-out views.
fn train(
    scene: &Scene,
    strategy: Strategy,
    threads: usize,
    iterations: u32,
    interruption: Option<u32>,
) -> (Gaussians, f64) {
    let factor = f64::from(iterations) / 30_000.0;
    let schedule = Schedule { sh_degree: 0, ..Schedule::published(scene.extent_m) }.scaled(factor);
    let initial =
        if matches!(strategy, Strategy::Mcmc(_)) { InitialGaussians::MCMC } else { InitialGaussians::PUBLISHED };
    let model = initial.from_points(&scene.points).unwrap();
    let mut densifier = Densifier::new(strategy, scene.extent_m, 5, &model).unwrap();
    let mut training = Training::new(Engine::new(threads).unwrap());
    training.restore(model, Optimiser::new());
    let mut settings = TrainingSettings { depth_weight: 0.0, free_weight: 0.0, ..TrainingSettings::default() };
    strategy.apply(&mut settings);
    for iteration in 0..iterations {
        if Some(iteration) == interruption {
            let state = DensifierState::from_bytes(&densifier.state().to_bytes());
            densifier = Densifier::resume(strategy, scene.extent_m, state).unwrap();
            let (_, _, statistics) = training.lists_mut().unwrap();
            *statistics = ScreenStatistics::decode(&statistics.encode(), statistics.len()).unwrap();
        }
        schedule.apply(iteration, &mut settings);
        let view = &scene.views[(iteration as usize * 7) % scene.views.len()];
        if densifier.observes(iteration) {
            training.step_observed(view, &settings).unwrap();
        } else {
            training.step(view, &settings).unwrap();
        }
        densifier.after_step(iteration, &settings, &mut training).unwrap();
    }
    let mut engine = Engine::new(threads).unwrap();
    let model = training.into_model();
    assert!(model.is_finite());
    let mut image = Rendered::default();
    let sum: f64 = scene
        .held_out
        .iter()
        .map(|(camera, color)| {
            engine.render(&model, camera, &settings.render, &mut image);
            metrics::psnr(&image.color, color, None).unwrap()
        })
        .sum();
    (model, sum / scene.held_out.len() as f64)
}

/// The strategies with their published thresholds, in a run of 1,200 iterations.
fn strategies() -> [Strategy; 3] {
    let (max_gaussians, refine_every, refine_start) = (4000, 25, 50);
    let default = DefaultSettings { max_gaussians, refine_every, refine_start, ..DefaultSettings::default() };
    let mcmc = McmcSettings { max_gaussians, refine_every, refine_start, ..McmcSettings::default() };
    [
        Strategy::None,
        Strategy::Default(DefaultSettings { refine_stop: 800, reset_every: 400, ..default }),
        Strategy::Mcmc(McmcSettings { refine_stop: 1000, growth: 1.3, max_gaussians: 2500, ..mcmc }),
    ]
}

#[test]
fn both_strategies_show_views_that_were_held_out_better_than_none() {
    let scene = observed_scene();
    let [(none, none_db), (default, default_db), (mcmc, mcmc_db)] =
        strategies().map(|s| train(&scene, s, 1, 1200, None));
    assert_eq!(none.len(), scene.points.len());
    assert!((1000..=4000).contains(&default.len()) && mcmc.len() == 2500, "{} {}", default.len(), mcmc.len());
    let margin = default_db.min(mcmc_db) - none_db;
    assert!(margin > 1.0, "{none_db:.2} dB without, {default_db:.2} dB by default, {mcmc_db:.2} dB with MCMC");
}

/// Same seed, same bits, for any number of threads and interrupted or not: statistics, growth, noise, order.
#[test]
fn a_run_gives_the_same_bits_for_any_number_of_threads_interrupted_or_not() {
    let scene = observed_scene();
    for strategy in strategies() {
        let one = train(&scene, strategy, 1, 110, None);
        assert!(strategy == Strategy::None || one.0.len() > scene.points.len());
        assert!(one == train(&scene, strategy, 2, 110, None));
        // Between two refinements, with statistics half gathered.
        assert!(one == train(&scene, strategy, 3, 110, Some(90)));
    }
}
