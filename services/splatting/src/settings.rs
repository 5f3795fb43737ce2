//! What a training step minimises and how far it moves: learning rates, loss weights, limits.

use crate::camera::RenderSettings;

/// Settings of a training step. The defaults are the starting points of the live trainer for R = 2.5 m; the
/// trainer scales and decays `lr_means` itself.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrainingSettings {
    /// How images are rendered.
    pub render: RenderSettings,
    /// Adam learning rate of means, metres.
    pub lr_means: f32,
    /// Adam learning rate of log scales.
    pub lr_log_scales: f32,
    /// Adam learning rate of quaternions.
    pub lr_rotations: f32,
    /// Adam learning rate of opacity logits.
    pub lr_opacity: f32,
    /// Adam learning rate of SH coefficients of degree 0.
    pub lr_sh: f32,
    /// Adam learning rate of SH coefficients above degree 0: a twentieth of that of degree 0, as in 3DGS.
    pub lr_sh_rest: f32,
    /// Adam decay of the first and the second moment.
    pub betas: (f32, f32),
    /// Adam's guard against division by zero.
    pub epsilon: f32,
    /// Weight of the mean absolute colour difference (paper Eq. 7).
    pub l1_weight: f32,
    /// Weight of 1 - SSIM (paper Eq. 7).
    pub ssim_weight: f32,
    /// Weight of the mean absolute depth difference, per metre (paper Eq. 7, A30).
    pub depth_weight: f32,
    /// Weight of the mean alpha over free pixels (A31).
    pub free_weight: f32,
    /// Weight of mean |s - mean(s)| over standard deviations, per metre (paper Eq. 7); 0 but in the paper's preset.
    pub isotropic_weight: f32,
    /// Weight of the mean opacity of all Gaussians: 0.01 in 3DGS-MCMC (Kheradmand et al. 2024, section 4.4). With this
    /// weight or the next every Gaussian has a gradient, so that all of them take a step, also those out of sight: what no
    /// view holds on to fades.
    pub opacity_weight: f32,
    /// Weight of the mean standard deviation of all Gaussians, per metre: 0.01 in 3DGS-MCMC.
    pub scale_weight: f32,
    /// Smallest and largest standard deviation, metres, enforced after each step (A30); `None`: only against overflow.
    pub sigma_limits_m: Option<(f32, f32)>,
}

impl Default for TrainingSettings {
    fn default() -> Self {
        Self {
            render: RenderSettings::default(),
            lr_means: 1e-4,
            lr_log_scales: 5e-3,
            lr_rotations: 1e-3,
            lr_opacity: 0.05,
            lr_sh: 3e-3,
            lr_sh_rest: 3e-3 / 20.0,
            betas: (0.9, 0.999),
            epsilon: 1e-15,
            l1_weight: 0.8,
            ssim_weight: 0.2,
            depth_weight: 0.1,
            free_weight: 0.5,
            isotropic_weight: 0.0,
            opacity_weight: 0.0,
            scale_weight: 0.0,
            sigma_limits_m: None,
        }
    }
}

/// Terms of the loss of one step, before their weights.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LossTerms {
    /// Mean absolute colour difference over the image, after compositing.
    pub l1: f64,
    /// Mean structural similarity over the image, after compositing; 1 is equal.
    pub ssim: f64,
    /// Mean absolute depth difference over pixels with a measured depth, metres.
    pub depth_m: f64,
    /// Mean alpha over free pixels.
    pub free_alpha: f64,
    /// Mean |s - mean(s)| over the drawn Gaussians' standard deviations, per Gaussian of the model, metres.
    pub isotropic_m: f64,
    /// Mean opacity of the model; 0 where neither it nor the scale has a weight.
    pub opacity: f64,
    /// Mean standard deviation of the model, metres; 0 where neither it nor the opacity has a weight.
    pub scale_m: f64,
    /// Mean squared colour error over the foreground.
    pub foreground_mse: f64,
    /// Weighted sum: what is minimised.
    pub total: f64,
}

impl LossTerms {
    /// Peak signal-to-noise ratio over the foreground of the training view, dB.
    pub fn foreground_psnr_db(&self) -> f64 {
        crate::metrics::psnr_db(self.foreground_mse)
    }

    pub(crate) fn weighted(self, settings: &TrainingSettings) -> Self {
        let weight = f64::from;
        let total = weight(settings.l1_weight) * self.l1
            + weight(settings.ssim_weight) * (1.0 - self.ssim)
            + weight(settings.depth_weight) * self.depth_m
            + weight(settings.free_weight) * self.free_alpha
            + weight(settings.isotropic_weight) * self.isotropic_m
            + weight(settings.opacity_weight) * self.opacity
            + weight(settings.scale_weight) * self.scale_m;
        Self { total, ..self }
    }
}
