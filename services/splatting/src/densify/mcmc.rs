//! 3DGS-MCMC (Kheradmand et al. 2024): Gaussians as samples of a distribution, moved and added so that the image stays.

use super::{DensifyError, DensifyReport, Lists, fraction, interval, positive, scale_iterations};
use crate::model::{Gaussian, Gaussians};
use crate::random::Random;

/// Settings of 3DGS-MCMC. The defaults are those of its code and of gsplat's `MCMCStrategy`, which agree; iterations are
/// of a run of 30,000. Both begin with opacity 0.5 and a tenth of the usual scales: [`InitialGaussians::MCMC`].
///
/// [`InitialGaussians::MCMC`]: crate::InitialGaussians::MCMC
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct McmcSettings {
    /// Most Gaussians (1,000,000).
    pub max_gaussians: usize,
    /// Number of Gaussians after a refinement relative to that before, until there are the most (1.05).
    pub growth: f32,
    /// Opacity up to which a Gaussian is dead and is moved (0.005).
    pub dead_opacity: f32,
    /// Iterations between two refinements (100).
    pub refine_every: u32,
    /// Refinements begin after this iteration (500).
    pub refine_start: u32,
    /// Refinements end before this iteration (25,000).
    pub refine_stop: u32,
    /// Noise on the means, times their learning rate (5e5).
    pub noise_rate: f32,
    /// Opacity at which noise is half of its most (0.005).
    pub noise_opacity: f32,
    /// How sharply noise falls with opacity (100).
    pub noise_sharpness: f32,
    /// Noise ends before this iteration. Published: never.
    pub noise_stop: u32,
    /// Weight of the mean opacity in the loss (0.01); see [`TrainingSettings`](crate::TrainingSettings).
    pub opacity_weight: f32,
    /// Weight of the mean standard deviation in the loss, per metre (0.01).
    pub scale_weight: f32,
}

impl Default for McmcSettings {
    fn default() -> Self {
        Self {
            max_gaussians: 1_000_000,
            growth: 1.05,
            dead_opacity: 0.005,
            refine_every: 100,
            refine_start: 500,
            refine_stop: 25_000,
            noise_rate: 5e5,
            noise_opacity: 0.005,
            noise_sharpness: 100.0,
            noise_stop: u32::MAX,
            opacity_weight: 0.01,
            scale_weight: 0.01,
        }
    }
}

impl McmcSettings {
    /// All iterations multiplied by `factor`; see [`Strategy::scaled`](super::Strategy::scaled).
    #[must_use]
    pub fn scaled(self, factor: f64) -> Self {
        Self {
            refine_every: scale_iterations(self.refine_every, factor),
            refine_start: scale_iterations(self.refine_start, factor),
            refine_stop: scale_iterations(self.refine_stop, factor),
            noise_stop: if self.noise_stop == u32::MAX { u32::MAX } else { scale_iterations(self.noise_stop, factor) },
            ..self
        }
    }

    pub(super) fn check(&self) -> Result<(), DensifyError> {
        let at_least = |name, value: f32, least: f32, expected| match value >= least && value.is_finite() {
            true => Ok(()),
            false => Err(DensifyError::Setting { name, value: value.to_string(), expected }),
        };
        at_least("growth", self.growth, 1.0, "a finite number of at least 1")?;
        fraction("dead_opacity", self.dead_opacity)?;
        interval("refine_every", self.refine_every)?;
        at_least("noise_rate", self.noise_rate, 0.0, "a finite number of at least 0")?;
        fraction("noise_opacity", self.noise_opacity)?;
        positive("noise_sharpness", self.noise_sharpness)?;
        at_least("opacity_weight", self.opacity_weight, 0.0, "a finite number of at least 0")?;
        at_least("scale_weight", self.scale_weight, 0.0, "a finite number of at least 0")
    }

    pub(super) fn refines(&self, iteration: u32) -> bool {
        (self.refine_start + 1..self.refine_stop).contains(&iteration) && iteration.is_multiple_of(self.refine_every)
    }

    /// Moves the dead to the living, then adds some more beside the living, each time with a chance in proportion to
    /// opacity.
    pub(super) fn refine(&self, random: &mut Random, lists: &mut Lists<'_, '_>, report: &mut DensifyReport) {
        let model = lists.model();
        let dead: Vec<usize> = (0..model.len()).filter(|&i| self.is_dead(&model.get(i))).collect();
        let origins = self.draw(dead.len(), random, model);
        self.share(&origins, lists);
        for (&index, &origin) in dead.iter().zip(&origins) {
            let id = lists.fresh_id();
            let gaussian = Gaussian { id, ..lists.model().get(origin) };
            lists.draft.replace(index, &gaussian, origin);
        }
        report.relocated += origins.len();

        let count = lists.model().len();
        let target = ((count as f64 * f64::from(self.growth)) as usize).min(self.max_gaussians);
        let origins = self.draw(target.saturating_sub(count), random, lists.model());
        self.share(&origins, lists);
        for &origin in &origins {
            lists.push(lists.model().get(origin), origin);
        }
        report.added += origins.len();
    }

    fn is_dead(&self, gaussian: &Gaussian) -> bool {
        gaussian.opacity() <= self.dead_opacity || !gaussian.is_finite()
    }

    /// `count` living Gaussians, drawn independently in proportion to opacity; none where none lives.
    fn draw(&self, count: usize, random: &mut Random, model: &Gaussians) -> Vec<usize> {
        let mut total = 0.0;
        let cumulative: Vec<f64> = model
            .iter()
            .map(|g| {
                total += if self.is_dead(&g) { 0.0 } else { f64::from(g.opacity()) };
                total
            })
            .collect();
        if total <= 0.0 {
            return Vec::new();
        }
        // The first whose sum exceeds the draw has a chance above 0; rounding may lead behind the last of these.
        let last = cumulative.partition_point(|&sum| sum < total);
        (0..count)
            .map(|_| random.uniform() * total)
            .map(|at| cumulative.partition_point(|&sum| sum <= at).min(last))
            .collect()
    }

    /// Gives each of the drawn Gaussians the opacity and the scales that it will share with its copies.
    fn share(&self, origins: &[usize], lists: &mut Lists<'_, '_>) {
        let mut copies = vec![0_u32; lists.model().len()];
        for &origin in origins {
            copies[origin] += 1;
        }
        for (index, &copies) in copies.iter().enumerate().filter(|(_, copies)| **copies > 0) {
            let old = lists.model().get(index);
            let new = Relocation::new(f64::from(old.opacity()), copies + 1, self.dead_opacity);
            let opacity_logit = (new.opacity / (1.0 - new.opacity)).ln() as f32;
            let log_scales = old.log_scales + new.scale_ratio.ln() as f32;
            lists.draft.replace(index, &Gaussian { opacity_logit, log_scales, ..old }, index);
        }
    }
}

/// What `n` Gaussians at one place must be to look like the one that was there (Kheradmand et al. 2024, equation 9).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Relocation {
    /// Opacity of each.
    pub opacity: f64,
    /// Standard deviations of each, relative to those of the one.
    pub scale_ratio: f64,
}

impl Relocation {
    /// More Gaussians than this at one place are treated as this many, as published.
    pub const MOST: u32 = 51;

    /// For `count` Gaussians in place of one of `opacity` in (0, 1): together they let through in their centre what the
    /// one did, 1 - o = (1 - o')ⁿ, and along a line through it they absorb as much. Opacity is not let below
    /// `opacity_min`, which gives up on that for the sake of Gaussians that would die at once.
    ///
    /// The published double sum over i ≤ n and k < i of C(i - 1, k) (-1)ᵏ o'ᵏ⁺¹ / √(k + 1) is summed over i by
    /// Σ C(i - 1, k) = C(n, k + 1).
    pub fn new(opacity: f64, count: u32, opacity_min: f32) -> Self {
        let n = f64::from(count.clamp(1, Self::MOST));
        let new = -((-opacity).ln_1p() / n).exp_m1();
        let new = new.clamp(f64::from(opacity_min), 1.0 - f64::from(f32::EPSILON));
        let (mut term, mut sum) = (-1.0, 0.0);
        for k in 1..=count.clamp(1, Self::MOST) {
            let k = f64::from(k);
            // term = -C(n, k) (-o')ᵏ
            term *= -new * (n - k + 1.0) / k;
            sum += term / k.sqrt();
        }
        Self { opacity: new, scale_ratio: opacity / sum }
    }
}
