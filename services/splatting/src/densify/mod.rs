//! Densification and pruning for offline training: where Gaussians are added, moved and removed.
//!
//! Two published strategies, run after each step: adaptive density control of 3DGS ([`DefaultSettings`]) and 3DGS-MCMC
//! ([`McmcSettings`]). Everything random comes from a seed and from the Gaussians' ids, so that a run gives the same bits
//! for any number of threads, and goes on with the same bits from a saved [`DensifierState`].

mod adaptive;
mod mcmc;
mod noise;

use thiserror::Error;

use crate::backend::{BackendError, Training};
use crate::edit::{Draft, Looks};
use crate::model::{Gaussian, Gaussians};
use crate::random::Random;
use crate::settings::TrainingSettings;

pub use adaptive::DefaultSettings;
pub use mcmc::{McmcSettings, Relocation};
pub(crate) use noise::Noise;

/// How the number of Gaussians changes in training.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Strategy {
    /// It does not.
    #[default]
    None,
    /// Adaptive density control: clone, split and prune by gradients on the screen, reset opacities (Kerbl et al. 2023).
    Default(DefaultSettings),
    /// Relocation and growth up to a cap, with noise (Kheradmand et al. 2024).
    Mcmc(McmcSettings),
}

impl Strategy {
    /// The strategy with all its iterations multiplied by `factor`, as gsplat's `steps_scaler` does: 7 / 30 for a run of
    /// 7,000 iterations that is to be complete in itself. The published results after 7,000 iterations are not that:
    /// they are the schedule of 30,000 stopped at 7,000, so use no factor to compare with them.
    #[must_use]
    pub fn scaled(self, factor: f64) -> Self {
        match self {
            Self::None => Self::None,
            Self::Default(settings) => Self::Default(settings.scaled(factor)),
            Self::Mcmc(settings) => Self::Mcmc(settings.scaled(factor)),
        }
    }

    /// Sets the weights of the loss that belong to the strategy: the regularisers of 3DGS-MCMC, none otherwise.
    pub fn apply(&self, settings: &mut TrainingSettings) {
        (settings.opacity_weight, settings.scale_weight) = match self {
            Self::None | Self::Default(_) => (0.0, 0.0),
            Self::Mcmc(mcmc) => (mcmc.opacity_weight, mcmc.scale_weight),
        };
    }

    /// Whether the list of Gaussians or their opacities change after the step of this iteration.
    fn acts(&self, iteration: u32) -> bool {
        match self {
            Self::None => false,
            Self::Default(settings) => settings.refines(iteration) || settings.resets(iteration),
            Self::Mcmc(settings) => settings.refines(iteration),
        }
    }

    /// What a decision after the step of this iteration is made of.
    fn looks_at(&self, iteration: u32) -> Looks {
        match self {
            Self::Default(settings) if settings.refines(iteration) => Looks::Seen,
            Self::Mcmc(_) => Looks::Parameters,
            // Bringing opacities down asks nothing.
            Self::None | Self::Default(_) => Looks::Nothing,
        }
    }

    /// Whether the strategy reads the statistics of the step of this iteration: where not, [`Training::step`] does.
    pub fn observes(&self, iteration: u32) -> bool {
        matches!(self, Self::Default(settings) if iteration < settings.refine_stop)
    }

    fn check(&self) -> Result<(), DensifyError> {
        match self {
            Self::None => Ok(()),
            Self::Default(settings) => settings.check(),
            Self::Mcmc(settings) => settings.check(),
        }
    }
}

/// Multiplies an iteration count; one that was positive stays so.
fn scale_iterations(iterations: u32, factor: f64) -> u32 {
    ((f64::from(iterations) * factor) as u32).max(iterations.min(1))
}

/// Why a densifier was refused.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum DensifyError {
    /// A setting is out of range.
    #[error("densification setting `{name}` is {value}: give {expected}")]
    Setting {
        /// Name of the field.
        name: &'static str,
        /// Its value.
        value: String,
        /// What is accepted.
        expected: &'static str,
    },
}

/// Fails where a number is not finite and above 0.
fn positive(name: &'static str, value: f32) -> Result<(), DensifyError> {
    if value > 0.0 && value.is_finite() {
        return Ok(());
    }
    Err(DensifyError::Setting { name, value: value.to_string(), expected: "a finite number above 0" })
}

/// Fails where a number is not in (0, 1).
fn fraction(name: &'static str, value: f32) -> Result<(), DensifyError> {
    if value > 0.0 && value < 1.0 {
        return Ok(());
    }
    Err(DensifyError::Setting { name, value: value.to_string(), expected: "a number above 0 and below 1" })
}

/// Fails where a count of iterations is 0.
fn interval(name: &'static str, value: u32) -> Result<(), DensifyError> {
    if value > 0 {
        return Ok(());
    }
    Err(DensifyError::Setting { name, value: value.to_string(), expected: "at least 1 iteration" })
}

/// What a densifier did after one step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DensifyReport {
    /// Gaussians that got a copy.
    pub cloned: usize,
    /// Gaussians that were replaced by two smaller ones.
    pub split: usize,
    /// Gaussians that were removed.
    pub pruned: usize,
    /// Dead Gaussians that were moved to living ones.
    pub relocated: usize,
    /// Gaussians that were added beside living ones.
    pub added: usize,
    /// Whether opacities were reset.
    pub reset: bool,
}

impl DensifyReport {
    /// Whether the list of Gaussians changed, so that indices into it are no longer the same.
    pub fn changed_list(&self) -> bool {
        self.cloned + self.split + self.pruned + self.relocated + self.added > 0
    }
}

/// What a densifier must keep to go on with the same bits, for a checkpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DensifierState {
    /// Seed of the run.
    pub seed: u64,
    /// State of the random generator.
    pub random: u64,
    /// The next id that no Gaussian has had.
    pub next_id: u64,
}

impl DensifierState {
    /// The three numbers in turn, little-endian.
    pub fn to_bytes(&self) -> [u8; 24] {
        let mut bytes = [0; 24];
        for (to, value) in bytes.as_chunks_mut::<8>().0.iter_mut().zip([self.seed, self.random, self.next_id]) {
            *to = value.to_le_bytes();
        }
        bytes
    }

    /// What [`DensifierState::to_bytes`] gave.
    pub fn from_bytes(bytes: &[u8; 24]) -> Self {
        let value = |i: usize| u64::from_le_bytes(bytes.as_chunks::<8>().0[i]);
        Self { seed: value(0), random: value(1), next_id: value(2) }
    }
}

/// Adds, moves and removes Gaussians in the course of an offline run.
#[derive(Clone, Debug)]
pub struct Densifier {
    strategy: Strategy,
    extent_m: f32,
    seed: u64,
    random: Random,
    next_id: u64,
}

impl Densifier {
    /// A densifier for a run that begins with `model`. `extent_m` is the size of the scene that thresholds are relative
    /// to, metres: see [`scene_extent`](crate::scene_extent). Equal seeds give equal runs.
    ///
    /// # Errors
    /// Where a setting or the extent is out of range.
    pub fn new(strategy: Strategy, extent_m: f32, seed: u64, model: &Gaussians) -> Result<Self, DensifyError> {
        let next_id = model.iter().map(|g| g.id.saturating_add(1)).max().unwrap_or(0);
        Self::resume(strategy, extent_m, DensifierState { seed, random: seed, next_id })
    }

    /// The densifier that had this state.
    ///
    /// # Errors
    /// Where a setting or the extent is out of range.
    pub fn resume(strategy: Strategy, extent_m: f32, state: DensifierState) -> Result<Self, DensifyError> {
        strategy.check()?;
        positive("extent_m", extent_m)?;
        let DensifierState { seed, random, next_id } = state;
        Ok(Self { strategy, extent_m, seed, random: Random(random), next_id })
    }

    /// What must be kept to go on with the same bits.
    pub fn state(&self) -> DensifierState {
        DensifierState { seed: self.seed, random: self.random.0, next_id: self.next_id }
    }

    /// The strategy.
    pub fn strategy(&self) -> &Strategy {
        &self.strategy
    }

    /// Whether the step of this iteration must be an observed one; see [`Strategy::observes`].
    pub fn observes(&self, iteration: u32) -> bool {
        self.strategy.observes(iteration)
    }

    /// Does what the strategy does after the step of `iteration`, which counts from 0 (from 1, as 3DGS does, is as
    /// good). `settings` are those of the step: noise is proportional to the means' learning rate.
    ///
    /// Where the list of Gaussians changes it is sorted along a Morton curve, optimiser and statistics with it. New
    /// Gaussians have new ids, the higher bands and the birth round of the one they come from, and no moments.
    ///
    /// # Errors
    /// Where the GPU fails that trains.
    pub fn after_step(
        &mut self,
        iteration: u32,
        settings: &TrainingSettings,
        training: &mut Training,
    ) -> Result<DensifyReport, BackendError> {
        let mut report = DensifyReport::default();
        if self.strategy.acts(iteration) {
            let looks = self.strategy.looks_at(iteration);
            report = training.edit_looking(looks, |draft| self.act(iteration, draft))?;
        }
        if let Strategy::Mcmc(strategy) = &self.strategy
            && iteration < strategy.noise_stop
        {
            training.add_noise(&Noise::new(strategy, settings.lr_means, self.seed, iteration))?;
        }
        Ok(report)
    }

    /// Changes the list of Gaussians, or their opacities.
    fn act(&mut self, iteration: u32, draft: &mut Draft<'_>) -> DensifyReport {
        let mut lists = Lists { draft, next_id: &mut self.next_id };
        let mut report = DensifyReport::default();
        match &self.strategy {
            Strategy::None => {}
            Strategy::Default(strategy) => {
                if strategy.refines(iteration) {
                    strategy.refine(iteration, self.extent_m, &mut self.random, &mut lists, &mut report);
                    lists.draft.forget_statistics();
                }
                if strategy.resets(iteration) {
                    lists.draft.lower_opacities(strategy.reset_logit());
                    report.reset = true;
                }
            }
            Strategy::Mcmc(strategy) => {
                if strategy.refines(iteration) {
                    strategy.refine(&mut self.random, &mut lists, &mut report);
                }
            }
        }
        if report.changed_list() {
            draft.sort_along_curve();
        }
        report
    }
}

/// The list of Gaussians, and ids for those that are added.
struct Lists<'a, 'b> {
    draft: &'a mut Draft<'b>,
    next_id: &'a mut u64,
}

impl Lists<'_, '_> {
    /// An id that no Gaussian has had.
    fn fresh_id(&mut self) -> u64 {
        let id = *self.next_id;
        *self.next_id = id.saturating_add(1);
        id
    }

    /// Appends a Gaussian with a new id and with the higher bands of the Gaussian at `origin`.
    fn push(&mut self, gaussian: Gaussian, origin: usize) {
        let id = self.fresh_id();
        self.draft.push_beside(&Gaussian { id, ..gaussian }, origin);
    }

    fn model(&self) -> &Gaussians {
        self.draft.model()
    }
}
