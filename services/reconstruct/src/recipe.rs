//! What is minimised and how fast: the published recipe of 3DGS for images alone, live flight's for a mission.
//!
//! A mission is trained on with the values that flew it (masks by depth, depth loss, bounds on the Gaussians' size), its rates
//! stretched over the run. Everything else follows 3DGS: 0.8 L1 + 0.2 (1 - SSIM) over the whole image, the published rates.

use splatting::order::Random;
use splatting::rgbd::prune::PruneRules;
use splatting::{DefaultSettings, McmcSettings, RenderSettings, Schedule, Strategy, TrainingSettings};

use crate::dataset::{Dataset, Stage};
use crate::options::{Background, Options, StrategyName};

/// Iterations between two prunings of a mission's model.
const PRUNE_EVERY: u32 = 500;

/// How a dataset is trained on.
#[derive(Debug, Clone)]
pub struct Recipe {
    base: TrainingSettings,
    schedule: Schedule,
    /// How the number of Gaussians changes.
    pub strategy: Strategy,
    background: Background,
    seed: u64,
    rules: Option<PruneRules>,
}

impl Recipe {
    /// The recipe for a dataset. `voxel_m` is the edge of the voxels that a mission's Gaussians were inserted by.
    #[must_use]
    pub fn new(options: &Options, dataset: &Dataset, extent_m: f32, voxel_m: Option<f32>) -> Self {
        let name = strategy_for(options, dataset);
        let strategy = match name {
            StrategyName::None => Strategy::None,
            StrategyName::Default => Strategy::Default(DefaultSettings {
                max_gaussians: options.max_gaussians,
                ..DefaultSettings::default()
            }),
            StrategyName::Mcmc => {
                Strategy::Mcmc(McmcSettings { max_gaussians: options.max_gaussians, ..McmcSettings::default() })
            }
        };
        let published = Schedule { sh_degree: options.sh_degree, ..Schedule::published(extent_m) };
        let mut base = TrainingSettings::default();
        base.render.background = options.background_for(dataset).color();
        let (mut schedule, mut rules) = (published, None);
        if let (Some(stage), Some(edge)) = (&dataset.stage, voxel_m) {
            schedule = live_schedule(stage, options);
            live_settings(stage, edge, &mut base);
            rules = Some(live_rules(stage, edge));
        }
        strategy.apply(&mut base);
        let background = options.background_for(dataset);
        Self { base, schedule, strategy, background, seed: options.seed, rules }
    }

    /// Settings of the step of an iteration, from 0.
    #[must_use]
    pub fn settings(&self, iteration: u32) -> TrainingSettings {
        let mut settings = self.base;
        self.schedule.apply(iteration, &mut settings);
        if self.background == Background::Random {
            // A generator of its own for each iteration: nothing to keep in a checkpoint.
            let mut random = Random::new(self.seed ^ (u64::from(iteration) << 32));
            settings.render.background = glam::Vec3::from_array([0; 3].map(|_| random.below(1 << 16) as f32 / 65536.0));
        }
        settings
    }

    /// How images are rendered in evaluation after so many iterations.
    #[must_use]
    pub fn render(&self, iteration: u32) -> RenderSettings {
        let mut settings = self.base;
        self.schedule.apply(iteration, &mut settings);
        settings.render
    }

    /// Whether a mission's rules prune after this many iterations.
    #[must_use]
    pub fn prunes(&self, iteration: u32, iterations: u32) -> bool {
        self.rules.is_some() && (iteration.is_multiple_of(PRUNE_EVERY) || iteration == iterations)
    }

    /// What a mission removes; `None` for other datasets.
    #[must_use]
    pub fn rules(&self) -> Option<&PruneRules> {
        self.rules.as_ref()
    }
}

/// The densification of a run: the user's choice, or what is best for the dataset.
#[must_use]
pub fn strategy_for(options: &Options, dataset: &Dataset) -> StrategyName {
    let default = if dataset.stage.is_some() { StrategyName::None } else { StrategyName::Default };
    options.strategy.unwrap_or(default)
}

fn live_schedule(stage: &Stage, options: &Options) -> Schedule {
    let trainer = &stage.trainer;
    // A rate of zero has no logarithm.
    let rate = |rate_m: f64| (rate_m * stage.radius_m / 2.5).max(1e-12) as f32;
    Schedule {
        extent_m: 1.0,
        means_first: rate(trainer.lr_means_start_m),
        means_last: rate(trainer.lr_means_end_m),
        means_iterations: options.iterations,
        log_scales: trainer.lr_log_scales as f32,
        rotations: trainer.lr_rotations as f32,
        opacity: trainer.lr_opacities as f32,
        sh: trainer.lr_sh0 as f32,
        sh_degree: options.sh_degree,
        ..Schedule::published(1.0)
    }
}

fn live_settings(stage: &Stage, edge_m: f32, settings: &mut TrainingSettings) {
    let trainer = &stage.trainer;
    settings.l1_weight = trainer.weight_l1 as f32;
    settings.ssim_weight = trainer.weight_ssim as f32;
    settings.depth_weight = trainer.weight_depth as f32;
    settings.free_weight = trainer.weight_free_space as f32;
    settings.isotropic_weight = trainer.weight_isotropic as f32;
    settings.sigma_limits_m =
        Some((trainer.sigma_min_voxels as f32 * edge_m, trainer.sigma_max_voxels as f32 * edge_m));
}

fn live_rules(stage: &Stage, edge_m: f32) -> PruneRules {
    let trainer = &stage.trainer;
    PruneRules {
        clip: stage.clip,
        min_opacity: trainer.prune_opacity as f32,
        // A hair above the clamp, which rounds.
        max_sigma_m: trainer.sigma_max_voxels as f32 * edge_m * 1.001,
        front_m: trainer.prune_front_voxels as f32 * edge_m + 3.0 * trainer.depth_sigma_m as f32,
        front_views: trainer.prune_front_views,
    }
}
