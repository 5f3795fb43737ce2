//! A check of an adapter that takes about a second: whether it computes what the CPU computes, and how fast.

use std::time::{Duration, Instant};

use glam::{Quat, Vec3};

use super::engine::{Engine, Options};
use super::error::GpuError;
use crate::camera::{Camera, Pose};
use crate::engine::Rendered;
use crate::model::{Gaussian, Gaussians};
use crate::optimiser::Optimiser;
use crate::settings::TrainingSettings;
use crate::statistics::ScreenStatistics;
use crate::view::TrainingView;

const GAUSSIANS: usize = 5_000;
const WIDTH: u32 = 160;
const HEIGHT: u32 = 120;
/// How long iterations are counted.
const DURATION: Duration = Duration::from_millis(500);
/// Iterations between two looks at the clock.
const SLICE: u32 = 16;

/// What a check found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CheckReport {
    /// Gaussians of the scene.
    pub gaussians: usize,
    /// Width of its image, pixels.
    pub width: u32,
    /// Height of its image, pixels.
    pub height: u32,
    /// Training iterations a second.
    pub iterations_per_s: f64,
    /// Colour difference to the CPU that all pixels but a thousandth stay below.
    pub image_error: f32,
    /// Cosine between the gradient and the CPU's.
    pub gradient_cosine: f64,
}

impl CheckReport {
    /// Whether images and gradients are those of the CPU, as far as single precision goes.
    pub fn is_correct(&self) -> bool {
        self.image_error < 1e-3 && self.gradient_cosine > 0.9999
    }
}

/// Checks the adapter of this name.
///
/// # Errors
/// Where it gives no device, or fails on the way.
pub fn check(adapter: &str) -> Result<CheckReport, GpuError> {
    let mut gpu = Engine::new(&Options { adapter: Some(adapter.to_owned()), ..Options::default() })?;
    let Ok(mut cpu) = crate::Engine::new(1) else {
        return Err(GpuError::Refused("the CPU engine did not start".to_owned()));
    };
    let model: Gaussians = (0..GAUSSIANS).map(sphere_gaussian).collect();
    let camera =
        Camera::from_hfov(Pose::IDENTITY, 1.0, WIDTH, HEIGHT).look_at(Vec3::new(0.3, -2.0, 0.4), Vec3::ZERO, Vec3::Z);
    let settings = TrainingSettings::default();
    let [mut by_cpu, mut by_gpu] = [Rendered::default(), Rendered::default()];
    cpu.render(&model, &camera, &settings.render, &mut by_cpu);
    gpu.render(&model, &camera, &settings.render, &mut by_gpu)?;
    let differs = |(a, b): (&[f32; 3], &[f32; 3])| (0..3).map(|k| (a[k] - b[k]).abs()).fold(0.0, f32::max);
    let mut errors: Vec<f32> = by_cpu.color.iter().zip(&by_gpu.color).map(differs).collect();
    errors.sort_by(f32::total_cmp);
    let image_error = errors.get(errors.len() - errors.len() / 1000 - 1).copied().unwrap_or(f32::INFINITY);

    let darker: Vec<[f32; 3]> = by_cpu.color.iter().map(|color| color.map(|c| 0.8 * c.clamp(0.0, 1.0))).collect();
    // Away from what is rendered: there the sign of a difference is that of its rounding.
    let deeper: Vec<f32> = by_cpu.depth.iter().map(|depth| 1.05 * depth).collect();
    let view =
        TrainingView::full_image(camera, &darker, &deeper).map_err(|error| GpuError::Refused(error.to_string()))?;
    let (_, expected) = cpu.gradient(&model, &view, &settings);
    let (_, found) = gpu.gradient(&model, &view, &settings)?;
    let (mut dot, mut a2, mut b2) = (0.0, 0.0, 0.0);
    for (a, b) in found.parameters.iter().flatten().zip(expected.parameters.iter().flatten()) {
        let (a, b) = (f64::from(*a), f64::from(*b));
        (dot, a2, b2) = (dot + a * b, a2 + a * a, b2 + b * b);
    }

    gpu.upload(&model, &mut Optimiser::new(), &mut ScreenStatistics::new())?;
    let mut steps = |count: u32| -> Result<(), GpuError> {
        for _ in 0..count {
            gpu.step(&view, &settings)?;
        }
        gpu.finish()
    };
    steps(1)?;
    let (started, mut done) = (Instant::now(), 0);
    while started.elapsed() < DURATION {
        // Software would take seconds for a slice.
        let count = if done == 0 { 1 } else { SLICE };
        steps(count)?;
        done += count;
        if done == 1 && started.elapsed() > DURATION / SLICE {
            break;
        }
    }
    Ok(CheckReport {
        gaussians: GAUSSIANS,
        width: WIDTH,
        height: HEIGHT,
        iterations_per_s: f64::from(done) / started.elapsed().as_secs_f64(),
        image_error,
        gradient_cosine: dot / (a2 * b2).sqrt().max(f64::MIN_POSITIVE),
    })
}

/// Point k of a Fibonacci sphere of radius 0.7 m, with a coloured pattern.
fn sphere_gaussian(k: usize) -> Gaussian {
    let z = 1.0 - (2.0 * k as f32 + 1.0) / GAUSSIANS as f32;
    let (sin, cos) = (k as f32 * 2.399_963).sin_cos();
    let r = (1.0 - z * z).sqrt();
    Gaussian {
        mean: Vec3::new(r * cos, r * sin, z) * 0.7,
        log_scales: Vec3::new(0.02_f32.ln(), 0.015_f32.ln(), 0.01_f32.ln()),
        rotation: Quat::from_xyzw(0.3 * sin, 0.2 * cos, 0.1, 1.0).normalize(),
        opacity_logit: 1.0 + cos,
        sh: Gaussian::sh_from_color([0.5 + 0.3 * sin, 0.5 + 0.4 * z, 0.5 + 0.3 * cos]),
        id: k as u64,
        birth_round: 0,
    }
}
