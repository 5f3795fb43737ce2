//! Section `[trainer]`: insertion, losses, learning rates, pruning, and what training costs.
//!
//! The defaults are the better values (`default` preset). [`TrainerConfig::paper`] gives the paper's literal ones; each
//! difference is a field, so that either can be tried alone.

use serde::{Deserialize, Serialize};

/// A declared cost on the simulated clock: a number, or `"auto"` for what this machine measures.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum DeclaredCost {
    /// The number; figures compare between machines.
    Fixed(f64),
    /// `"auto"`.
    Word(AutoWord),
}

/// The word `auto`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AutoWord {
    /// Measured at the start.
    Auto,
}

/// What renders and trains.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BackendWord {
    /// A GPU where there is a real one, else the CPU.
    #[default]
    Auto,
    /// The CPU.
    Cpu,
    /// A GPU, or an error.
    Gpu,
}

/// Which pixels the losses see (A31).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LossMask {
    /// Foreground, free and ignored pixels told apart by the depth image.
    Foreground,
    /// Every pixel of the image counts, as printed in the paper.
    FullImage,
}

/// Shape of a Gaussian at birth (A29).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BirthShape {
    /// A disc across the normal that the depth image shows.
    Disc,
    /// A sphere, as in the paper.
    Isotropic,
}

/// Section `[trainer]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainerConfig {
    /// Declared speed on the simulated clock, iterations a second; `"auto"` measures this machine.
    pub iterations_per_s: DeclaredCost,
    /// Worker threads; 0: one per core.
    pub threads: u32,
    /// Megabytes that the trainer may take for itself (shared memory does not count); 0: what there is. One that was killed
    /// for its memory begins again with a smaller model.
    pub memory_mb: u32,
    /// What trains: `"auto"` (a GPU where there is a real one, else the CPU), `"cpu"` or `"gpu"`.
    pub backend: BackendWord,
    /// Whether sums on a GPU have an order, so that training on the same adapter and driver repeats bit for bit; costs
    /// memory and time. On the CPU it always does.
    pub deterministic: bool,
    /// Name of the GPU, or a part of it (`vantage doctor` lists them); empty: the best that is not software.
    pub adapter: String,
    /// Iterations between two looks at stop, flattening and what is due.
    pub slice_iterations: u32,
    /// Mission time between two checkpoints, seconds (at most 10 s of training may be lost).
    pub checkpoint_period_s: f64,
    /// Mission time between two live snapshots, seconds.
    pub snapshot_period_s: f64,

    /// Window of the flattening rule, iterations: the mean loss of the last window against that of the one before.
    pub flat_window: u32,
    /// A round is flat when its loss fell by less than this share. On ideal images of apollo_sample4 the loss keeps falling
    /// by over-fitting: at 0.01 rounds ran to Eq. 6's cap without gain; 0.2 gave 3,120 iterations and 35.4 dB on views
    /// that were not trained on, 0.1 3,960 iterations and 35.4 dB, a tenth of Eq. 6 1,665 iterations and 35.8 dB.
    pub flat_gain: f64,

    /// Edge of an insertion voxel over the footprint of a training pixel at the object's near side (A29).
    pub voxel_factor: f64,
    /// Edge of an insertion voxel, metres; 0: by `voxel_factor`.
    pub voxel_m: f64,
    /// Shape at birth.
    pub birth_shape: BirthShape,
    /// Standard deviation at birth across the surface, voxel edges (also the sphere's).
    pub birth_sigma_voxels: f64,
    /// Standard deviation at birth along the normal, voxel edges (disc only).
    pub birth_thickness_voxels: f64,
    /// Opacity at birth.
    pub birth_opacity: f64,
    /// Points seen at a greater angle to their normal are not inserted, degrees.
    pub max_incidence_deg: f64,
    /// Points next to a depth jump greater than this share of their depth are not inserted.
    pub max_depth_jump: f64,
    /// A voxel seeded from more than this many times the present footprint is seeded again.
    pub reseed_ratio: f64,
    /// The clip box ends this far below the fitted ground, metres.
    pub ground_margin_m: f64,

    /// Weight of the L1 colour loss (Eq. 7).
    pub weight_l1: f64,
    /// Weight of 1 - SSIM (Eq. 7).
    pub weight_ssim: f64,
    /// Weight of the depth loss (Eq. 7: 0.5).
    pub weight_depth: f64,
    /// Weight of the isotropic regulariser (Eq. 7: 0.1); the default clamps scales instead (A30).
    pub weight_isotropic: f64,
    /// Weight of the mean alpha of free pixels (A31).
    pub weight_free_space: f64,
    /// Which pixels the losses see.
    pub loss_mask: LossMask,
    /// Least and greatest standard deviation, voxel edges (A30).
    pub sigma_min_voxels: f64,
    /// See `sigma_min_voxels`.
    pub sigma_max_voxels: f64,

    /// Learning rate of means at first, metres an iteration at R = 2.5 m; scales with R.
    pub lr_means_start_m: f64,
    /// Learning rate of means in the end.
    pub lr_means_end_m: f64,
    /// Iterations of the mission over which the rate of means decays (exponentially), then stays.
    pub lr_means_decay_iterations: u32,
    /// Learning rate of log scales.
    pub lr_log_scales: f64,
    /// Learning rate of quaternions.
    pub lr_rotations: f64,
    /// Learning rate of opacity logits.
    pub lr_opacities: f64,
    /// Learning rate of degree-0 spherical-harmonics coefficients.
    pub lr_sh0: f64,

    /// Gaussians below this opacity are pruned each round.
    pub prune_opacity: f64,
    /// Gaussians are pruned whose centre lies more than this many voxel edges (and three deviations of the depth) before
    /// the measured depth of at least `prune_front_views` views.
    pub prune_front_voxels: f64,
    /// See `prune_front_voxels`; 0 turns that rule off.
    pub prune_front_views: u32,
    /// Standard deviation of measured depth, metres.
    pub depth_sigma_m: f64,
}

impl Default for TrainerConfig {
    fn default() -> Self {
        Self {
            iterations_per_s: DeclaredCost::Fixed(80.0),
            threads: 0,
            memory_mb: 0,
            backend: BackendWord::Auto,
            deterministic: false,
            adapter: String::new(),
            slice_iterations: 20,
            checkpoint_period_s: 10.0,
            snapshot_period_s: 1.0,
            flat_window: 100,
            flat_gain: 0.2,
            voxel_factor: 1.2,
            voxel_m: 0.0,
            birth_shape: BirthShape::Disc,
            birth_sigma_voxels: 0.6,
            birth_thickness_voxels: 0.15,
            birth_opacity: 0.8,
            max_incidence_deg: 75.0,
            max_depth_jump: 0.05,
            reseed_ratio: 2.0,
            ground_margin_m: 0.03,
            weight_l1: 0.8,
            weight_ssim: 0.2,
            weight_depth: 0.1,
            weight_isotropic: 0.0,
            weight_free_space: 0.5,
            loss_mask: LossMask::Foreground,
            sigma_min_voxels: 0.1,
            sigma_max_voxels: 4.0,
            lr_means_start_m: 1e-4,
            lr_means_end_m: 1e-5,
            lr_means_decay_iterations: 2500,
            lr_log_scales: 5e-3,
            lr_rotations: 1e-3,
            lr_opacities: 0.05,
            lr_sh0: 3e-3,
            prune_opacity: 0.02,
            prune_front_voxels: 2.0,
            prune_front_views: 2,
            depth_sigma_m: 0.003,
        }
    }
}

impl TrainerConfig {
    /// The paper's literal values: spheres of 1 cm spacing, losses over the full image with the weights of Eq. 7.
    #[must_use]
    pub fn paper() -> Self {
        Self {
            voxel_m: 0.01,
            sigma_min_voxels: 0.0,
            sigma_max_voxels: 1000.0,
            birth_shape: BirthShape::Isotropic,
            weight_depth: 0.5,
            weight_isotropic: 0.1,
            weight_free_space: 0.0,
            loss_mask: LossMask::FullImage,
            prune_front_views: 0,
            ..Self::default()
        }
    }

    /// Lists what is wrong, one sentence a problem: key, value found, what was expected.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = Vec::new();
        if let DeclaredCost::Fixed(rate) = self.iterations_per_s
            && !(0.01..=1e6).contains(&rate)
        {
            problems.push(format!("trainer.iterations_per_s is {rate}; expected 0.01 to 1000000, or \"auto\""));
        }
        let counts = [
            ("threads", self.threads, 0, 1024),
            ("memory_mb", self.memory_mb, 0, 1 << 24),
            ("slice_iterations", self.slice_iterations, 1, 1000),
            ("flat_window", self.flat_window, 10, 10_000),
            ("lr_means_decay_iterations", self.lr_means_decay_iterations, 1, 10_000_000),
            ("prune_front_views", self.prune_front_views, 0, 1000),
        ];
        for (key, value, low, high) in counts {
            if !(low..=high).contains(&value) {
                problems.push(format!("trainer.{key} is {value}; expected {low} to {high}"));
            }
        }
        let numbers = [
            ("checkpoint_period_s", self.checkpoint_period_s, 0.1, 10.0),
            ("snapshot_period_s", self.snapshot_period_s, 0.1, 60.0),
            ("flat_gain", self.flat_gain, 0.0, 0.5),
            ("voxel_factor", self.voxel_factor, 0.25, 20.0),
            ("voxel_m", self.voxel_m, 0.0, 1.0),
            ("birth_sigma_voxels", self.birth_sigma_voxels, 0.05, 10.0),
            ("birth_thickness_voxels", self.birth_thickness_voxels, 0.01, 10.0),
            ("birth_opacity", self.birth_opacity, 0.01, 0.99),
            ("max_incidence_deg", self.max_incidence_deg, 1.0, 90.0),
            ("max_depth_jump", self.max_depth_jump, 0.001, 1.0),
            ("reseed_ratio", self.reseed_ratio, 1.0, 1e6),
            ("ground_margin_m", self.ground_margin_m, 0.0, 10.0),
            ("weight_l1", self.weight_l1, 0.0, 100.0),
            ("weight_ssim", self.weight_ssim, 0.0, 100.0),
            ("weight_depth", self.weight_depth, 0.0, 100.0),
            ("weight_isotropic", self.weight_isotropic, 0.0, 100.0),
            ("weight_free_space", self.weight_free_space, 0.0, 100.0),
            ("sigma_min_voxels", self.sigma_min_voxels, 0.0, 1.0),
            ("sigma_max_voxels", self.sigma_max_voxels, 1.0, 1000.0),
            ("lr_means_start_m", self.lr_means_start_m, 0.0, 0.1),
            ("lr_means_end_m", self.lr_means_end_m, 0.0, 0.1),
            ("lr_log_scales", self.lr_log_scales, 0.0, 1.0),
            ("lr_rotations", self.lr_rotations, 0.0, 1.0),
            ("lr_opacities", self.lr_opacities, 0.0, 1.0),
            ("lr_sh0", self.lr_sh0, 0.0, 1.0),
            ("prune_opacity", self.prune_opacity, 0.0, 0.5),
            ("prune_front_voxels", self.prune_front_voxels, 0.0, 1000.0),
            ("depth_sigma_m", self.depth_sigma_m, 0.0, 1.0),
        ];
        for (key, value, low, high) in numbers {
            // A NaN lies in no range.
            if !(low..=high).contains(&value) {
                problems.push(format!("trainer.{key} is {value}; expected {low} to {high}"));
            }
        }
        problems
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_presets_are_valid_and_survive_toml() {
        for config in [TrainerConfig::default(), TrainerConfig::paper()] {
            assert_eq!(config.validate(), Vec::<String>::new());
            let text = toml::to_string(&config).unwrap();
            assert_eq!(toml::from_str::<TrainerConfig>(&text).unwrap(), config);
        }
    }

    #[test]
    fn nonsense_is_named_with_its_key_and_value() {
        let bad = TrainerConfig {
            birth_opacity: 1.5,
            weight_l1: f64::NAN,
            slice_iterations: 0,
            iterations_per_s: DeclaredCost::Fixed(0.0),
            ..TrainerConfig::default()
        };
        let text = bad.validate().join("\n");
        for key in ["birth_opacity is 1.5", "weight_l1 is NaN", "slice_iterations is 0", "iterations_per_s is 0"] {
            assert!(text.contains(key), "{key} is missing in {text}");
        }
        assert!(toml::from_str::<TrainerConfig>("loss_mask = \"all\"").is_err());
        assert!(toml::from_str::<TrainerConfig>("birth_opacitty = 0.5").is_err());
    }
}
