//! A model and its optimiser under training, on the CPU or on a GPU.

use super::{Backend, BackendError};
use crate::densify::Noise;
use crate::edit::{Draft, Edit, Looks};
use crate::gpu::{self, Arrival, Copied, GpuError};
use crate::model::Gaussians;
use crate::optimiser::Optimiser;
use crate::rgbd::prune::{self, DepthView, PruneRules};
use crate::settings::{LossTerms, TrainingSettings};
use crate::simd::Isa;
use crate::statistics::ScreenStatistics;
use crate::view::TrainingView;
use crate::workers::Workers;

/// Where the newest state of a model under training is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Newest {
    /// Here, and not on the GPU.
    Host,
    /// On the GPU, and not here.
    Gpu,
    Both,
}

/// A copy of the model for somebody else.
#[derive(Debug, Default)]
enum Copy {
    #[default]
    None,
    OnItsWay,
    Here(Box<Gaussians>),
}

/// A model and its optimiser under training, wherever they are.
///
/// On the CPU a step is done when it returns. On a GPU it is done later: losses arrive with [`Training::finished`], and the
/// model here is that of the last [`Training::sync`]: but how many Gaussians there are, their ids and birth rounds are always
/// known.
#[derive(Debug)]
pub struct Training {
    backend: Backend,
    gaussians: Gaussians,
    optimiser: Optimiser,
    statistics: ScreenStatistics,
    newest: Newest,
    copy: Copy,
    /// Whether a copy of model and optimiser is on its way.
    state_copied: bool,
    finished: Vec<LossTerms>,
}

impl Training {
    /// An empty model.
    pub fn new(backend: impl Into<Backend>) -> Self {
        Self {
            backend: backend.into(),
            gaussians: Gaussians::new(),
            optimiser: Optimiser::new(),
            statistics: ScreenStatistics::new(),
            newest: Newest::Host,
            copy: Copy::None,
            state_copied: false,
            finished: Vec::new(),
        }
    }

    /// The back end alone.
    pub fn into_backend(self) -> Backend {
        self.backend
    }

    /// What trains it.
    pub fn backend(&self) -> &Backend {
        &self.backend
    }

    /// The back end, for looking at the model of the last [`Training::sync`].
    pub fn backend_and_model(&mut self) -> (&mut Backend, &Gaussians) {
        (&mut self.backend, &self.gaussians)
    }

    /// The model of the last [`Training::sync`].
    pub fn model(&self) -> &Gaussians {
        &self.gaussians
    }

    /// The optimiser of the last [`Training::sync`].
    pub fn optimiser(&self) -> &Optimiser {
        &self.optimiser
    }

    /// What densification wants to know, of the last [`Training::sync`].
    pub fn statistics(&self) -> &ScreenStatistics {
        &self.statistics
    }

    /// The model alone, as of the last [`Training::sync`].
    pub fn into_model(self) -> Gaussians {
        self.gaussians
    }

    /// Model, optimiser and statistics alone, as of the last [`Training::sync`].
    pub fn into_parts(self) -> (Gaussians, Optimiser, ScreenStatistics) {
        (self.gaussians, self.optimiser, self.statistics)
    }

    /// Replaces everything; nothing was seen yet.
    pub fn restore(&mut self, gaussians: Gaussians, optimiser: Optimiser) {
        self.restore_observed(gaussians, optimiser, ScreenStatistics::new());
    }

    /// Replaces everything.
    pub fn restore_observed(&mut self, gaussians: Gaussians, optimiser: Optimiser, statistics: ScreenStatistics) {
        (self.gaussians, self.optimiser, self.statistics) = (gaussians, optimiser, statistics);
        self.newest = Newest::Host;
        self.forget_copies();
        self.finished.clear();
    }

    /// Brings the newest state here.
    ///
    /// # Errors
    /// Where the GPU fails: then the newest state is lost, and what is here is older.
    pub fn sync(&mut self) -> Result<(), BackendError> {
        if let (Newest::Gpu, Backend::Gpu(engine)) = (self.newest, &mut self.backend) {
            engine.download(&mut self.gaussians, &mut self.optimiser, &mut self.statistics)?;
            self.finished.extend(engine.finished()?);
            self.newest = Newest::Both;
        }
        Ok(())
    }

    /// Model, optimiser and statistics, to change all alike.
    ///
    /// # Errors
    /// As [`Training::sync`].
    pub fn lists_mut(&mut self) -> Result<(&mut Gaussians, &mut Optimiser, &mut ScreenStatistics), BackendError> {
        self.sync()?;
        self.newest = Newest::Host;
        self.forget_copies();
        self.optimiser.fit(&self.gaussians);
        self.statistics.fit(&self.gaussians);
        Ok((&mut self.gaussians, &mut self.optimiser, &mut self.statistics))
    }

    /// Changes the list of Gaussians: `change` sees and alters their parameters, and what lies beside them follows. A
    /// model on a GPU stays there: 56 bytes a Gaussian come down to be decided about, 4 go back, and the parameters of
    /// those that are new.
    ///
    /// # Errors
    /// Where the GPU fails: then the newest state is lost, and what is here is older.
    pub fn edit<R>(&mut self, change: impl FnOnce(&mut Draft<'_>) -> R) -> Result<R, BackendError> {
        self.edit_looking(Looks::Parameters, change)
    }

    /// The same, where `change` looks at no more than it says.
    pub(crate) fn edit_looking<R>(
        &mut self,
        looks: Looks,
        change: impl FnOnce(&mut Draft<'_>) -> R,
    ) -> Result<R, BackendError> {
        if let (Newest::Gpu, Backend::Gpu(engine)) = (self.newest, &mut self.backend) {
            engine.look(looks, &mut self.gaussians, &mut self.statistics)?;
        } else {
            self.optimiser.fit(&self.gaussians);
            self.statistics.fit(&self.gaussians);
        }
        let mut draft = Draft::new(&mut self.gaussians, &self.statistics);
        let result = change(&mut draft);
        let edit = draft.finish();
        self.follow(&edit)?;
        Ok(result)
    }

    /// Removes what is wrong by these rules. Where the model is on a GPU its kernels decide, and ask this code about what
    /// rounding could decide otherwise: the result is the same as here.
    ///
    /// # Errors
    /// As [`Training::edit`].
    pub fn prune(&mut self, views: &[DepthView<'_>], rules: &PruneRules) -> Result<(), BackendError> {
        let kept = match (self.newest, &mut self.backend) {
            (Newest::Gpu | Newest::Both, Backend::Gpu(engine)) => engine.keep(views, rules)?,
            _ => prune::keep(&self.gaussians, views, rules),
        };
        self.edit_looking(Looks::Nothing, |draft| draft.retain(|index| kept.get(index).copied().unwrap_or(false)))
    }

    /// Does to everything beside the parameters what was done to them: where it is, or, where it is in two places, in both.
    fn follow(&mut self, edit: &Edit) -> Result<(), BackendError> {
        if *edit == Edit::default() {
            return Ok(());
        }
        if edit.sources.is_some() {
            self.forget_copies();
        }
        if self.newest != Newest::Gpu {
            if let Some(sources) = &edit.sources {
                self.optimiser.follow(sources);
                self.statistics.follow(sources);
            }
            if edit.forgets_statistics {
                self.statistics.reset();
            }
            if edit.logit_ceiling.is_some() {
                self.optimiser.reset_opacities();
            }
        }
        match (self.newest, &mut self.backend) {
            (Newest::Gpu, Backend::Gpu(engine)) => engine.edit(edit, &self.gaussians)?,
            (Newest::Both, Backend::Gpu(engine)) => {
                engine.edit(edit, &self.gaussians).inspect_err(|_| self.newest = Newest::Host)?;
            }
            _ => {}
        }
        Ok(())
    }

    /// Begins to copy the model as the steps asked for so far leave it, while training goes on. What changes the list of
    /// Gaussians forgets the copy.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn begin_copy(&mut self) -> Result<(), BackendError> {
        self.copy = match (&mut self.backend, self.newest) {
            (Backend::Gpu(engine), Newest::Gpu) => {
                engine.begin_copy(Copied::Model)?;
                Copy::OnItsWay
            }
            _ => Copy::Here(Box::new(self.gaussians.clone())),
        };
        Ok(())
    }

    /// The copy that was begun, once it is here; with `wait` it is waited for. `None` also where there is none.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn take_copy(&mut self, wait: bool) -> Result<Option<Gaussians>, BackendError> {
        match (std::mem::take(&mut self.copy), &mut self.backend) {
            (Copy::Here(gaussians), _) => Ok(Some(*gaussians)),
            (Copy::OnItsWay, Backend::Gpu(engine)) => {
                let copy = engine.take_copy(&self.gaussians, wait)?;
                if copy.is_none() {
                    self.copy = Copy::OnItsWay;
                }
                Ok(copy)
            }
            _ => Ok(None),
        }
    }

    /// Begins to copy model and optimiser as the steps asked for so far leave them, while training goes on; `false` where
    /// there is nothing to copy, as their newest state is here. What changes the list of Gaussians forgets the copy.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn begin_state_copy(&mut self) -> Result<bool, BackendError> {
        if let (Backend::Gpu(engine), Newest::Gpu) = (&mut self.backend, self.newest) {
            engine.begin_copy(Copied::State)?;
            self.state_copied = true;
        } else {
            self.state_copied = false;
        }
        Ok(self.state_copied)
    }

    /// The copy of model and optimiser that was begun, once it is here. By then [`Training::finished`] tells every loss up to
    /// it. Does not wait.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn take_state_copy(&mut self) -> Result<Arrival<(Gaussians, Optimiser)>, BackendError> {
        let Backend::Gpu(engine) = &mut self.backend else { return Ok(Arrival::NotYet) };
        if !self.state_copied {
            return Ok(Arrival::NotYet);
        }
        let arrival = engine.take_state(&self.gaussians)?;
        self.state_copied = !matches!(arrival, Arrival::Here(_));
        Ok(arrival)
    }

    /// Gives up copies that were begun, and the room that they take.
    pub fn forget_copies(&mut self) {
        self.copy = Copy::None;
        self.state_copied = false;
        if let Backend::Gpu(engine) = &mut self.backend {
            engine.forget_copies();
        }
    }

    /// Asks for one step of Adam on one view.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn step(&mut self, view: &TrainingView, settings: &TrainingSettings) -> Result<(), BackendError> {
        match &mut self.backend {
            Backend::Cpu(engine) => {
                let terms = engine.train_step(&mut self.gaussians, &mut self.optimiser, view, settings);
                self.finished.push(terms);
                Ok(())
            }
            Backend::Gpu(_) => Ok(self.on_gpu()?.step(view, settings)?),
        }
    }

    /// The same step, which also adds what it saw of each Gaussian to the statistics, for densification.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn step_observed(&mut self, view: &TrainingView, settings: &TrainingSettings) -> Result<(), BackendError> {
        match &mut self.backend {
            Backend::Cpu(engine) => {
                let (model, optimiser, seen) = (&mut self.gaussians, &mut self.optimiser, &mut self.statistics);
                self.finished.push(engine.train_step_observed(model, optimiser, view, settings, seen));
                Ok(())
            }
            Backend::Gpu(_) => Ok(self.on_gpu()?.step_observed(view, settings)?),
        }
    }

    /// Moves the means by noise, after the step that was asked for last.
    pub(crate) fn add_noise(&mut self, noise: &Noise) -> Result<(), BackendError> {
        match &mut self.backend {
            Backend::Cpu(engine) => noise.add_to(&mut self.gaussians, engine.isa, &engine.workers),
            Backend::Gpu(engine) if self.newest != Newest::Host => {
                self.newest = Newest::Gpu;
                engine.add_noise(noise)?;
            }
            Backend::Gpu(_) => noise.add_to(&mut self.gaussians, Isa::detect(), &Workers::sequential()),
        }
        Ok(())
    }

    /// The GPU's engine with the newest model on it, which will be newer there.
    fn on_gpu(&mut self) -> Result<&mut gpu::Engine, BackendError> {
        let Backend::Gpu(engine) = &mut self.backend else { return Err(GpuError::NoAdapter.into()) };
        if self.newest == Newest::Host {
            engine.upload(&self.gaussians, &mut self.optimiser, &mut self.statistics)?;
        }
        self.newest = Newest::Gpu;
        Ok(engine)
    }

    /// Losses of steps that are done and were not given before, in the order of the steps. Does not wait.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn finished(&mut self) -> Result<Vec<LossTerms>, BackendError> {
        if let Backend::Gpu(engine) = &mut self.backend {
            self.finished.extend(engine.finished()?);
        }
        Ok(std::mem::take(&mut self.finished))
    }
}
