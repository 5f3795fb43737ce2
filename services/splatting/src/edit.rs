//! Changes of a list of Gaussians, written down as where each new one comes from.
//!
//! What is decided is the same for both back ends, and is decided by the same code: densification draws random numbers one
//! after the other, insertion claims voxels in an order, and pruning on a GPU asks this code where rounding matters. The
//! decision is four bytes a Gaussian. The rows themselves, of which moments and higher bands are the most, are moved by it
//! wherever they are: here, or by kernels on a GPU.

use crate::model::{Gaussian, Gaussians};
use crate::statistics::ScreenStatistics;

/// Bit of a source: no moments, no steps, and nothing seen yet. The rest is the index of the old Gaussian that parameters
/// and higher bands come from.
pub(crate) const FRESH: u32 = 1 << 31;
/// Source of a Gaussian that comes from none: its higher bands are zero.
pub(crate) const BORN: u32 = u32::MAX;

/// What of a model a decision is made of, and so what must be here before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Looks {
    /// Nothing: ids and birth rounds are always here.
    Nothing,
    /// Parameters without higher bands: 56 bytes a Gaussian.
    Parameters,
    /// These and statistics: 68 bytes a Gaussian.
    Seen,
}

/// Whether state and statistics of a source begin at zero.
pub(crate) fn is_fresh(source: u32) -> bool {
    source & FRESH != 0
}

/// What became of a list of Gaussians. The parameters and ids of fresh ones are not copies: they are in the new model.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Edit {
    /// Source of each new Gaussian; `None`: the list is as it was.
    pub sources: Option<Vec<u32>>,
    /// Whether everything that was seen is forgotten.
    pub forgets_statistics: bool,
    /// Opacity logit to which higher ones were lowered; then all moments of opacities are forgotten.
    pub logit_ceiling: Option<f32>,
}

/// A list of Gaussians while it is changed. Parameters, ids and birth rounds of the model change at once; what lies beside
/// them follows when the draft is over. Higher bands of the model may be older than its parameters, and go along.
#[derive(Debug)]
pub struct Draft<'a> {
    model: &'a mut Gaussians,
    statistics: &'a ScreenStatistics,
    sources: Vec<u32>,
    changes_list: bool,
    edit: Edit,
}

impl<'a> Draft<'a> {
    pub(crate) fn new(model: &'a mut Gaussians, statistics: &'a ScreenStatistics) -> Self {
        let sources = (0..model.len() as u32).collect();
        Self { model, statistics, sources, changes_list: false, edit: Edit::default() }
    }

    /// The Gaussians as they are by now: not their higher bands.
    pub fn model(&self) -> &Gaussians {
        self.model
    }

    /// Statistics of the list as it was; see [`Draft::radius_px`] for that as it is.
    pub(crate) fn statistics(&self) -> &ScreenStatistics {
        self.statistics
    }

    /// Largest radius on the screen of the Gaussian that is at `index` by now; 0 where it was not seen yet.
    pub(crate) fn radius_px(&self, index: usize) -> f32 {
        match self.sources[index] {
            source if is_fresh(source) => 0.0,
            source => self.statistics.radius_px(source as usize),
        }
    }

    /// Keeps the Gaussians for which `keep` says so, in order.
    pub fn retain(&mut self, mut keep: impl FnMut(usize) -> bool) {
        let kept: Vec<bool> = (0..self.sources.len()).map(&mut keep).collect();
        if kept.contains(&false) {
            self.changes_list = true;
            self.model.retain(|index| kept[index]);
            let mut index = 0..;
            self.sources.retain(|_| index.next().is_some_and(|index: usize| kept[index]));
        }
    }

    /// Appends a Gaussian that is not made of another: without higher bands.
    pub fn push(&mut self, gaussian: &Gaussian) {
        self.changes_list = true;
        self.model.push(gaussian);
        self.sources.push(BORN);
    }

    /// Appends a Gaussian with the higher bands of the one that is at `origin` by now.
    pub(crate) fn push_beside(&mut self, gaussian: &Gaussian, origin: usize) {
        self.changes_list = true;
        let rest = self.model.sh_rest(origin);
        self.model.push(gaussian);
        self.model.set_sh_rest(self.model.len() - 1, &rest);
        self.sources.push(self.sources[origin] | FRESH);
    }

    /// Replaces the Gaussian at `index` by one with the higher bands of that at `origin`, which may be itself.
    pub(crate) fn replace(&mut self, index: usize, gaussian: &Gaussian, origin: usize) {
        self.changes_list = true;
        let rest = self.model.sh_rest(origin);
        self.model.set(index, gaussian);
        self.model.set_sh_rest(index, &rest);
        self.sources[index] = self.sources[origin] | FRESH;
    }

    /// Sorts along a Morton curve, so that neighbours in space are neighbours in memory.
    pub fn sort_along_curve(&mut self) {
        self.changes_list = true;
        let order = self.model.morton_order();
        self.model.permute(&order);
        self.sources = order.iter().map(|&index| self.sources[index as usize]).collect();
    }

    /// Forgets everything that was seen.
    pub(crate) fn forget_statistics(&mut self) {
        self.edit.forgets_statistics = true;
    }

    /// Lowers opacity logits to `ceiling` and forgets the moments of all opacities, as 3DGS does when it resets them.
    pub(crate) fn lower_opacities(&mut self, ceiling: f32) {
        self.edit.logit_ceiling = Some(ceiling);
        self.model.lower_opacities(ceiling);
    }

    pub(crate) fn finish(self) -> Edit {
        let sources = self.changes_list.then_some(self.sources);
        Edit { sources, ..self.edit }
    }
}
