//! How far training is: everything that decides what comes next, besides the model and its optimiser. What a checkpoint holds.

use std::collections::VecDeque;

use splatting::order::ViewOrder;
use splatting::rgbd::voxels::VoxelGrid;
use splatting::{Gaussians, LossTerms, Optimiser};

use crate::logic::rounds::LossHistory;
use crate::round::{FinishedRound, RoundSpec, generation};

/// Training images behind `psnr_train_db`.
pub(crate) const PSNR_IMAGES: usize = 100;
/// PSNR of a foreground without error, dB: what 16 bits could show.
const PSNR_MAX_DB: f64 = 100.0;

/// A round under work.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ActiveRound {
    pub(crate) spec: RoundSpec,
    pub(crate) iterations: u32,
    pub(crate) order: ViewOrder,
    pub(crate) losses: LossHistory,
    pub(crate) psnr_db: VecDeque<f64>,
}

impl ActiveRound {
    /// Takes in the loss of an iteration, whose view has foreground or none.
    pub(crate) fn take_loss(&mut self, terms: &LossTerms, has_foreground: bool) {
        self.losses.push(terms.total);
        if has_foreground {
            if self.psnr_db.len() == PSNR_IMAGES {
                self.psnr_db.pop_front();
            }
            self.psnr_db.push_back(terms.foreground_psnr_db().min(PSNR_MAX_DB));
        }
    }
}

/// What of a session goes into a checkpoint, besides the model and its optimiser.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Progression {
    pub(crate) grid: Option<VoxelGrid>,
    /// Keyframes whose points were inserted, ascending.
    pub(crate) inserted: Vec<u64>,
    pub(crate) next_gaussian_id: u64,
    pub(crate) total_iterations: u64,
    pub(crate) finished: Vec<FinishedRound>,
    pub(crate) active: Option<ActiveRound>,
}

impl Progression {
    pub(crate) fn new() -> Self {
        Self {
            grid: None,
            inserted: Vec::new(),
            next_gaussian_id: 1,
            total_iterations: 0,
            finished: Vec::new(),
            active: None,
        }
    }

    /// Generation of a snapshot or checkpoint taken now, and whether it is of a round's end; `None` before the first round.
    pub(crate) fn generation(&self) -> Option<(u64, bool)> {
        let is_final = self.active.is_none();
        Some((generation(self.total_iterations, self.last_spec()?.round, is_final), is_final))
    }

    /// What the round under work was asked, or the last one.
    pub(crate) fn last_spec(&self) -> Option<&RoundSpec> {
        let active = self.active.as_ref().map(|round| &round.spec);
        active.or(self.finished.last().map(|round| &round.spec))
    }
}

/// Everything that a checkpoint holds.
#[derive(Debug, Clone, Copy)]
pub(crate) struct State<'a> {
    pub(crate) progression: &'a Progression,
    pub(crate) model: &'a Gaussians,
    pub(crate) optimiser: &'a Optimiser,
}

/// A checkpoint that is on its way from the back end.
#[derive(Debug)]
pub(crate) struct Awaited {
    pub(crate) progression: Progression,
    /// Iterations of it whose losses are not known yet.
    pub(crate) untold: usize,
}

impl Awaited {
    /// The same for a state that is on its way, as long as the iteration is one of it.
    pub(crate) fn take_loss(&mut self, terms: &LossTerms, has_foreground: bool) {
        if self.untold > 0
            && let Some(round) = &mut self.progression.active
        {
            self.untold -= 1;
            round.take_loss(terms, has_foreground);
        }
    }
}
