//! What scoring costs on this machine, for `scorer.ms_per_candidate = "auto"`.

use std::sync::atomic::{AtomicBool, AtomicU64};
use std::time::Instant;

use glam::{DVec3, Quat, Vec3};
use shared_types::frames::{Intrinsics, look_at};
use shared_types::messages::{CandidateView, ScoreRequest, VarianceMode};
use splatting::{Backend, Gaussian, Gaussians};

use crate::job::Job;

const GAUSSIANS: usize = 100_000;
const CANDIDATES: u32 = 16;

/// Milliseconds a candidate on this machine: a sphere of 100,000 Gaussians in images of this size.
///
/// # Errors
/// When an image of this size cannot be scored, or the back end fails.
pub fn ms_per_candidate(backend: &mut Backend, width: u32, height: u32) -> Result<f64, String> {
    let model: Gaussians = (0..GAUSSIANS).map(sphere_gaussian).collect();
    let camera = Intrinsics::from_hfov(width, height, 1.204);
    let request = ScoreRequest {
        variance: VarianceMode::Normalised.code(),
        width,
        height,
        grid_candidates: CANDIDATES,
        focal_px: [camera.fx, camera.fy],
        principal_px: [camera.cx, camera.cy],
        box_size_m: 2.0,
        ..ScoreRequest::default()
    };
    let views: Vec<CandidateView> = (0..CANDIDATES)
        .map(|index| {
            let (sin, cos) = (f64::from(index) * std::f64::consts::TAU / f64::from(CANDIDATES)).sin_cos();
            let pose = look_at(2.5 * DVec3::new(cos, sin, 0.3), DVec3::ZERO);
            CandidateView {
                position_m: pose.position_m.to_array(),
                world_from_camera_xyzw: pose.rotation.to_array(),
                index,
                visited: 0,
            }
        })
        .collect();
    let job = Job::from_request(&request, &views, 0.1)?;
    let mut run = || {
        let result = job.run(backend, &model, &AtomicBool::new(false), &AtomicU64::new(0));
        result.map(|_| ()).map_err(|error| error.to_string())
    };
    run()?;
    let started = Instant::now();
    run()?;
    Ok(started.elapsed().as_secs_f64() * 1e3 / f64::from(CANDIDATES))
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
        sh: [0.0; 3],
        id: k as u64,
        birth_round: 0,
    }
}
