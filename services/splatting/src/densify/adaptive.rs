//! Adaptive density control of 3DGS (Kerbl et al. 2023, section 5.2), with the constants of its code.
//!
//! A Gaussian that the loss pulls hard on the screen, in the mean over the views since the last time, is where the model
//! is too coarse: a small one is cloned, a large one is split. Transparent and oversized ones are removed, and opacities
//! are brought down now and then so that what no view needs does not come back.

use super::{DensifyError, DensifyReport, Lists, fraction, interval, positive, scale_iterations};
use crate::model::Gaussian;
use crate::random::Random;

/// Settings of adaptive density control. The defaults are those of 3DGS (`OptimizationParams` of its code) and of
/// gsplat's `DefaultStrategy`, which agree; iterations are of a run of 30,000.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DefaultSettings {
    /// Mean gradient on the screen, in normalised device coordinates, from which a Gaussian is cloned or split (2e-4).
    pub grow_gradient: f32,
    /// Largest standard deviation, relative to the scene's extent, up to which it is cloned; above, it is split (0.01).
    pub clone_scale: f32,
    /// Standard deviations of a Gaussian divided by those of the two it is split into (1.6).
    pub split_shrink: f32,
    /// Opacity below which a Gaussian is removed (0.005).
    pub prune_opacity: f32,
    /// Largest standard deviation, relative to the scene's extent, above which it is removed after the first reset (0.1).
    pub prune_scale: f32,
    /// Radius on the screen above which it is removed after the first reset, pixels. 3DGS names 20, but its code forgets
    /// the radii just before it compares them, and gsplat leaves the comparison out: the published results, and this
    /// default, are without it.
    pub prune_radius_px: Option<f32>,
    /// Iterations between two refinements (100).
    pub refine_every: u32,
    /// Refinements begin after this iteration (500).
    pub refine_start: u32,
    /// Refinements and resets end before this iteration (15,000).
    pub refine_stop: u32,
    /// Iterations between two resets of opacities (3,000).
    pub reset_every: u32,
    /// Opacity to which higher ones are reset (0.01).
    pub reset_opacity: f32,
    /// Most Gaussians that growth leads to: where there is room for some only, those with the largest gradients grow.
    /// Published: no limit.
    pub max_gaussians: usize,
}

impl Default for DefaultSettings {
    fn default() -> Self {
        Self {
            grow_gradient: 2e-4,
            clone_scale: 0.01,
            split_shrink: 1.6,
            prune_opacity: 0.005,
            prune_scale: 0.1,
            prune_radius_px: None,
            refine_every: 100,
            refine_start: 500,
            refine_stop: 15_000,
            reset_every: 3000,
            reset_opacity: 0.01,
            max_gaussians: usize::MAX,
        }
    }
}

impl DefaultSettings {
    /// All iterations multiplied by `factor`; see [`Strategy::scaled`](super::Strategy::scaled).
    #[must_use]
    pub fn scaled(self, factor: f64) -> Self {
        Self {
            refine_every: scale_iterations(self.refine_every, factor),
            refine_start: scale_iterations(self.refine_start, factor),
            refine_stop: scale_iterations(self.refine_stop, factor),
            reset_every: scale_iterations(self.reset_every, factor),
            ..self
        }
    }

    pub(super) fn check(&self) -> Result<(), DensifyError> {
        positive("grow_gradient", self.grow_gradient)?;
        positive("clone_scale", self.clone_scale)?;
        positive("split_shrink", self.split_shrink)?;
        fraction("prune_opacity", self.prune_opacity)?;
        positive("prune_scale", self.prune_scale)?;
        self.prune_radius_px.map_or(Ok(()), |radius| positive("prune_radius_px", radius))?;
        interval("refine_every", self.refine_every)?;
        interval("reset_every", self.reset_every)?;
        fraction("reset_opacity", self.reset_opacity)
    }

    pub(super) fn refines(&self, iteration: u32) -> bool {
        (self.refine_start + 1..self.refine_stop).contains(&iteration) && iteration.is_multiple_of(self.refine_every)
    }

    pub(super) fn resets(&self, iteration: u32) -> bool {
        (1..self.refine_stop).contains(&iteration) && iteration.is_multiple_of(self.reset_every)
    }

    /// Clones, splits and prunes.
    pub(super) fn refine(
        &self,
        iteration: u32,
        extent_m: f32,
        random: &mut Random,
        lists: &mut Lists<'_, '_>,
        report: &mut DensifyReport,
    ) {
        let before = lists.model().len();
        let mut keep = vec![true; before];
        for index in self.growing(lists) {
            let parent = lists.model().get(index);
            if largest_scale(&parent) <= self.clone_scale * extent_m {
                lists.push(parent, index);
                report.cloned += 1;
            } else {
                for _ in 0..2 {
                    lists.push(self.child(&parent, random), index);
                }
                keep[index] = false;
                report.split += 1;
            }
        }
        keep.resize(lists.model().len(), true);
        let sizes_count = iteration > self.reset_every;
        for (index, keep) in keep.iter_mut().enumerate().filter(|(_, keep)| **keep) {
            let gaussian = lists.model().get(index);
            let too_big = largest_scale(&gaussian) > self.prune_scale * extent_m
                || self.prune_radius_px.is_some_and(|limit| lists.draft.radius_px(index) > limit);
            if gaussian.opacity() < self.prune_opacity || sizes_count && too_big || !gaussian.is_finite() {
                *keep = false;
                report.pruned += 1;
            }
        }
        lists.draft.retain(|index| keep[index]);
    }

    /// Indices of the Gaussians to clone or split, in order.
    fn growing(&self, lists: &Lists<'_, '_>) -> Vec<usize> {
        let gradient = |&i: &usize| lists.draft.statistics().mean_gradient(i);
        let mut growing: Vec<usize> = (0..lists.model().len())
            .filter(|i| gradient(i) >= self.grow_gradient && lists.model().get(*i).is_finite())
            .collect();
        // Each adds one, whether it is cloned or split.
        let room = self.max_gaussians.saturating_sub(lists.model().len());
        if growing.len() > room {
            growing.sort_by(|a, b| gradient(b).total_cmp(&gradient(a)).then(a.cmp(b)));
            growing.truncate(room);
            growing.sort_unstable();
        }
        growing
    }

    /// One of the two that replace `parent`: smaller, at a place drawn from the parent itself.
    fn child(&self, parent: &Gaussian, random: &mut Random) -> Gaussian {
        let offset = parent.rotation.normalize() * (parent.log_scales.exp() * random.normal3());
        Gaussian { mean: parent.mean + offset, log_scales: parent.log_scales - self.split_shrink.ln(), ..*parent }
    }

    /// Logit of [`DefaultSettings::reset_opacity`].
    pub(super) fn reset_logit(&self) -> f32 {
        (self.reset_opacity / (1.0 - self.reset_opacity)).ln()
    }
}

fn largest_scale(gaussian: &Gaussian) -> f32 {
    gaussian.log_scales.max_element().exp()
}
