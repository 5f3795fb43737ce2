//! An iteration that was asked for, and what the kernels are told of it.

use super::chain::Size;
use super::job::{Job, View};
use super::keyframe::Seen;
use super::model::DeviceModel;
use crate::densify::Noise;
use crate::settings::TrainingSettings;
use crate::view::TrainingView;

/// What of a keyframe turns sums into means.
#[derive(Clone, Copy)]
pub(super) struct Counts {
    pub samples: f64,
    pub foreground: usize,
    pub free: usize,
    pub with_depth: usize,
}

impl Counts {
    fn new(view: &TrainingView) -> Self {
        let samples = 3.0 * view.camera().pixels() as f64;
        Self { samples, foreground: view.foreground, free: view.free, with_depth: view.with_depth }
    }
}

/// An iteration that was asked for.
#[derive(Clone)]
pub(super) struct Iteration {
    pub keyframe: Seen,
    pub counts: Counts,
    pub view: View,
    pub settings: TrainingSettings,
    /// Whether statistics for densification are taken.
    pub observed: bool,
    /// Noise on the means after the step.
    pub noise: Option<Noise>,
}

impl Iteration {
    pub fn new(view: &TrainingView, keyframe: Seen, settings: &TrainingSettings, observed: bool) -> Self {
        Self {
            keyframe,
            counts: Counts::new(view),
            view: View::new(view.camera(), &settings.render, 0.0),
            settings: *settings,
            observed,
            noise: None,
        }
    }
}

/// What the kernels are told of an iteration.
pub(super) fn job(size: Size, model: &DeviceModel, slot: u32, iteration: &Iteration) -> Job {
    let settings = &iteration.settings;
    let counts = &iteration.counts;
    let per = |weight: f32, count: usize| if count == 0 { 0.0 } else { weight / count as f32 };
    let (gaussians, deviations) = (size.gaussians.max(1) as f32, 3.0 * size.gaussians.max(1) as f32);
    let degree = model.sh_degree.min(settings.render.sh_degree);
    let limit = |sigma: f32| sigma.max(1e-9).ln();
    let (low, high) = settings.sigma_limits_m.map_or((-20.0, 10.0), |(low, high)| (limit(low), limit(high)));
    let noise = iteration.noise.unwrap_or_default();
    Job {
        bands: crate::model::sh_rest_coefficients(degree) as u32,
        band_rows: crate::model::sh_rest_rows(model.sh_degree) as u32,
        slot,
        l1: settings.l1_weight / counts.samples as f32,
        ssim: settings.ssim_weight / counts.samples as f32,
        depth: per(settings.depth_weight, counts.with_depth),
        free: per(settings.free_weight, counts.free),
        isotropic: settings.isotropic_weight / deviations,
        opacity: settings.opacity_weight / gaussians,
        scale: settings.scale_weight / deviations,
        lr_bands: settings.lr_sh_rest,
        lr_means: settings.lr_means,
        lr_log_scales: settings.lr_log_scales,
        lr_rotations: settings.lr_rotations,
        lr_opacity: settings.lr_opacity,
        lr_sh: settings.lr_sh,
        beta1: settings.betas.0,
        beta2: settings.betas.1,
        epsilon: settings.epsilon,
        log_scale_min: low,
        log_scale_max: high,
        ln_beta1: f64::from(settings.betas.0).ln() as f32,
        ln_beta2: f64::from(settings.betas.1).ln() as f32,
        noise_rate: noise.rate,
        noise_opacity: noise.opacity,
        noise_sharpness: noise.sharpness,
        noise_key: noise.key,
        ..size.job()
    }
}
