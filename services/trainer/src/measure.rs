//! What training costs on this machine, for `trainer.iterations_per_s = "auto"`.

use std::time::Instant;

use glam::{Quat, Vec3};
use splatting::{
    BackendError, Camera, Gaussian, Gaussians, Optimiser, Pose, Rendered, Training, TrainingSettings, TrainingView,
};

/// Gaussians of the scene that is measured on: what a model of an object has.
const GAUSSIANS: usize = 100_000;
const WARM_UP: u32 = 5;
const MEASURED: u32 = 30;

/// Training iterations a second of this machine, on a sphere of 100,000 Gaussians in images of this size. Leaves the
/// training empty.
///
/// # Errors
/// When the back end fails.
pub fn iterations_per_s(training: &mut Training, width: u32, height: u32) -> Result<f64, BackendError> {
    let model: Gaussians = (0..GAUSSIANS).map(sphere_gaussian).collect();
    let camera =
        Camera::from_hfov(Pose::IDENTITY, 1.204, width, height).look_at(Vec3::new(0.0, -2.0, 0.3), Vec3::ZERO, Vec3::Z);
    let settings = TrainingSettings::default();
    let mut image = Rendered::default();
    training.restore(model, Optimiser::new());
    let (backend, model) = training.backend_and_model();
    backend.render(model, &camera, &settings.render, &mut image)?;
    let darker: Vec<[f32; 3]> = image.color.iter().map(|color| color.map(|c| 0.9 * c.clamp(0.0, 1.0))).collect();
    let Ok(view) = TrainingView::full_image(camera, &darker, &image.depth) else { return Ok(f64::NAN) };
    let mut steps = |count: u32| -> Result<(), BackendError> {
        for _ in 0..count {
            training.step(&view, &settings)?;
        }
        training.sync()
    };
    steps(WARM_UP)?;
    let started = Instant::now();
    steps(MEASURED)?;
    let rate = f64::from(MEASURED) / started.elapsed().as_secs_f64().max(1e-9);
    training.restore(Gaussians::new(), Optimiser::new());
    Ok(rate)
}

/// Point k of a Fibonacci sphere of radius 0.75 m.
fn sphere_gaussian(k: usize) -> Gaussian {
    let z = 1.0 - (2.0 * k as f32 + 1.0) / GAUSSIANS as f32;
    let (sin, cos) = ((k % 10_000) as f32 * 2.399_963).sin_cos();
    let r = (1.0 - z * z).sqrt();
    Gaussian {
        mean: Vec3::new(r * cos, r * sin, z) * 0.75,
        log_scales: Vec3::splat(0.006f32.ln()),
        rotation: Quat::IDENTITY,
        opacity_logit: 1.4,
        sh: Gaussian::sh_from_color([0.5 + 0.3 * sin, 0.5, 0.5 + 0.3 * cos]),
        id: k as u64,
        birth_round: 0,
    }
}
