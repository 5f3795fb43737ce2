//! One interface to both back ends: who trains and who scores do not know which one works.

use std::fmt;
use std::sync::atomic::AtomicBool;

use thiserror::Error;

use crate::camera::{Camera, RenderSettings};
use crate::densify::Noise;
use crate::engine::{Engine, EngineError, MomentsView, Rendered};
use crate::gpu::{self, GpuError};
use crate::model::Gaussians;
use crate::optimiser::Optimiser;
use crate::settings::{LossTerms, TrainingSettings};
use crate::simd::Isa;
use crate::statistics::ScreenStatistics;
use crate::uncertainty::{Uncertainty, UncertaintySettings, uncertainty};
use crate::view::TrainingView;
use crate::workers::Workers;

/// What is asked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum BackendKind {
    /// A GPU where there is a real one, else the CPU.
    #[default]
    Auto,
    /// The CPU engine.
    Cpu,
    /// A GPU, or an error.
    Gpu,
}

/// Which back end, and how it is to work.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct BackendOptions {
    /// Which.
    pub kind: BackendKind,
    /// Name of the GPU's adapter, or a part of it; `None`: the best that is not software.
    pub adapter: Option<String>,
    /// Whether sums on a GPU have an order, so that training repeats bit for bit; on the CPU it always does.
    pub deterministic: bool,
    /// Threads of the CPU engine.
    pub threads: usize,
}

/// Why a back end cannot be had, or stopped working.
#[derive(Debug, Error)]
pub enum BackendError {
    /// The CPU engine.
    #[error(transparent)]
    Cpu(EngineError),
    /// The GPU. What was on it is gone.
    #[error(transparent)]
    Gpu(GpuError),
    /// The caller's flag was set before all views were done.
    #[error("cancelled before all views were rendered")]
    Cancelled,
}

impl From<EngineError> for BackendError {
    fn from(error: EngineError) -> Self {
        match error {
            EngineError::Cancelled => Self::Cancelled,
            error @ EngineError::Threads(_) => Self::Cpu(error),
        }
    }
}

impl From<GpuError> for BackendError {
    fn from(error: GpuError) -> Self {
        match error {
            GpuError::Cancelled => Self::Cancelled,
            error => Self::Gpu(error),
        }
    }
}

/// Which back end works.
pub enum Backend {
    /// The CPU engine.
    Cpu(Box<Engine>),
    /// A GPU.
    Gpu(Box<gpu::Engine>),
}

impl fmt::Display for Backend {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cpu(engine) => write!(f, "cpu-{}", format!("{:?}", engine.isa()).to_lowercase()),
            Self::Gpu(engine) => write!(f, "gpu {}", engine.name()),
        }
    }
}

impl fmt::Debug for Backend {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Backend({self})")
    }
}

impl From<Engine> for Backend {
    fn from(engine: Engine) -> Self {
        Self::Cpu(Box::new(engine))
    }
}

impl Backend {
    /// The back end that is asked for. With [`BackendKind::Auto`] the second value says why it is not a GPU.
    ///
    /// # Errors
    /// Where it is not there or does not work.
    pub fn new(wanted: &BackendOptions) -> Result<(Self, Option<GpuError>), BackendError> {
        let gpu = || {
            let (adapter, deterministic) = (wanted.adapter.clone(), wanted.deterministic);
            let options = gpu::Options { adapter, deterministic, ..gpu::Options::default() };
            gpu::Engine::new(&options).map(|engine| Self::Gpu(Box::new(engine)))
        };
        let cpu = || Engine::new(wanted.threads).map(Self::from);
        Ok(match wanted.kind {
            BackendKind::Cpu => (cpu()?, None),
            BackendKind::Gpu => (gpu()?, None),
            // A driver takes a while to load, even to find that there is nothing to drive.
            BackendKind::Auto if wanted.adapter.is_none() && !gpu::may_exist() => (cpu()?, Some(GpuError::NoAdapter)),
            BackendKind::Auto => match gpu() {
                Ok(gpu) => (gpu, None),
                // Who names an adapter wants that one.
                Err(error @ GpuError::NoSuchAdapter { .. }) => return Err(error.into()),
                Err(error) => (cpu()?, Some(error)),
            },
        })
    }

    /// Bytes allocated on the GPU, by what for; nothing on the CPU.
    pub fn gpu_bytes(&self) -> Vec<(&'static str, u64)> {
        match self {
            Self::Cpu(_) => Vec::new(),
            Self::Gpu(engine) => engine.bytes(),
        }
    }

    /// As [`Engine::render`].
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn render(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        settings: &RenderSettings,
        out: &mut Rendered,
    ) -> Result<(), BackendError> {
        match self {
            Self::Cpu(engine) => engine.render(gaussians, camera, settings, out),
            Self::Gpu(engine) => engine.render(gaussians, camera, settings, out)?,
        }
        Ok(())
    }

    /// How uncertain the model is about each of many views (Eq. 1-3): given to `visit` with the view's index, in no order
    /// and from many threads. On the CPU one view is rendered and summed by one thread, so that the bits do not depend on
    /// their number.
    ///
    /// # Errors
    /// [`BackendError::Cancelled`] where `cancel` became true, or where the GPU fails.
    pub fn uncertainties(
        &mut self,
        gaussians: &Gaussians,
        cameras: &[Camera],
        (settings, render): (&UncertaintySettings, &RenderSettings),
        cancel: &AtomicBool,
        visit: impl Fn(usize, Uncertainty) + Sync,
    ) -> Result<(), BackendError> {
        match self {
            Self::Cpu(engine) => {
                let views: Vec<MomentsView> = cameras.iter().map(|camera| settings.view(camera)).collect();
                engine.moments_batch(gaussians, &views, render, cancel, |index, moments| {
                    visit(index, uncertainty(settings, &cameras[index], moments));
                })?;
            }
            Self::Gpu(engine) => engine.uncertainties(gaussians, cameras, (settings, render), cancel, visit)?,
        }
        Ok(())
    }
}

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
/// model here is that of the last [`Training::sync`].
#[derive(Debug)]
pub struct Training {
    backend: Backend,
    gaussians: Gaussians,
    optimiser: Optimiser,
    statistics: ScreenStatistics,
    newest: Newest,
    copy: Copy,
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
        self.forget_copy();
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

    /// Model and optimiser, to change both alike.
    ///
    /// # Errors
    /// As [`Training::sync`].
    pub fn parts_mut(&mut self) -> Result<(&mut Gaussians, &mut Optimiser), BackendError> {
        let (model, optimiser, _) = self.lists_mut()?;
        Ok((model, optimiser))
    }

    /// Model, optimiser and statistics, to change all alike.
    ///
    /// # Errors
    /// As [`Training::sync`].
    pub fn lists_mut(&mut self) -> Result<(&mut Gaussians, &mut Optimiser, &mut ScreenStatistics), BackendError> {
        self.sync()?;
        self.newest = Newest::Host;
        self.forget_copy();
        self.optimiser.fit(&self.gaussians);
        self.statistics.fit(&self.gaussians);
        Ok((&mut self.gaussians, &mut self.optimiser, &mut self.statistics))
    }

    /// Begins to copy the model as the steps asked for so far leave it, while training goes on. What changes the list of
    /// Gaussians forgets the copy.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn begin_copy(&mut self) -> Result<(), BackendError> {
        self.copy = match (&mut self.backend, self.newest) {
            (Backend::Gpu(engine), Newest::Gpu) => {
                engine.begin_copy()?;
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
                let mut gaussians = self.gaussians.clone();
                if engine.take_copy(&mut gaussians, wait)? {
                    return Ok(Some(gaussians));
                }
                self.copy = Copy::OnItsWay;
                Ok(None)
            }
            _ => Ok(None),
        }
    }

    fn forget_copy(&mut self) {
        self.copy = Copy::None;
        if let Backend::Gpu(engine) = &mut self.backend {
            engine.forget_copy();
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
            Backend::Gpu(engine) => {
                if !(self.newest == Newest::Gpu && engine.add_noise(noise)) {
                    self.sync()?;
                    noise.add_to(&mut self.gaussians, Isa::detect(), &Workers::sequential());
                    self.newest = Newest::Host;
                }
            }
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
