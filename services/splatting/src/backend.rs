//! One interface to both back ends: who trains and who scores do not know which one works.

use std::fmt;
use std::sync::atomic::AtomicBool;

use thiserror::Error;

use crate::camera::{Camera, RenderSettings};
use crate::engine::{Engine, EngineError, Moments, MomentsView, Rendered};
use crate::gpu::{self, GpuError};
use crate::model::Gaussians;
use crate::optimiser::Optimiser;
use crate::settings::{LossTerms, TrainingSettings};
use crate::view::TrainingView;

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
    /// The back end that is asked for: a GPU by the name of its adapter (a part of it is enough) where one is given, and
    /// `threads` threads for the CPU. With [`BackendKind::Auto`] the second value says why it is not a GPU.
    ///
    /// # Errors
    /// Where it is not there or does not work.
    pub fn new(
        kind: BackendKind,
        adapter: Option<&str>,
        threads: usize,
    ) -> Result<(Self, Option<GpuError>), BackendError> {
        let gpu = || {
            let options = gpu::Options { adapter: adapter.map(str::to_owned), ..gpu::Options::default() };
            gpu::Engine::new(&options).map(|engine| Self::Gpu(Box::new(engine)))
        };
        let cpu = || Engine::new(threads).map(Self::from);
        Ok(match kind {
            BackendKind::Cpu => (cpu()?, None),
            BackendKind::Gpu => (gpu()?, None),
            // A driver takes a while to load, even to find that there is nothing to drive.
            BackendKind::Auto if adapter.is_none() && !gpu::may_exist() => (cpu()?, Some(GpuError::NoAdapter)),
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

    /// As [`Engine::moments_batch`].
    ///
    /// # Errors
    /// [`BackendError::Cancelled`] where `cancel` became true, or where the GPU fails.
    pub fn moments_batch(
        &mut self,
        gaussians: &Gaussians,
        views: &[MomentsView],
        settings: &RenderSettings,
        cancel: &AtomicBool,
        visit: impl Fn(usize, &Moments) + Sync,
    ) -> Result<(), BackendError> {
        match self {
            Self::Cpu(engine) => engine.moments_batch(gaussians, views, settings, cancel, visit)?,
            Self::Gpu(engine) => engine.moments_batch(gaussians, views, settings, cancel, visit)?,
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

/// A model and its optimiser under training, wherever they are.
///
/// On the CPU a step is done when it returns. On a GPU it is done later: losses arrive with [`Training::finished`], and the
/// model here is that of the last [`Training::sync`].
#[derive(Debug)]
pub struct Training {
    backend: Backend,
    gaussians: Gaussians,
    optimiser: Optimiser,
    newest: Newest,
    finished: Vec<LossTerms>,
}

impl Training {
    /// An empty model.
    pub fn new(backend: impl Into<Backend>) -> Self {
        Self {
            backend: backend.into(),
            gaussians: Gaussians::new(),
            optimiser: Optimiser::new(),
            newest: Newest::Host,
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

    /// The model alone, as of the last [`Training::sync`].
    pub fn into_model(self) -> Gaussians {
        self.gaussians
    }

    /// Replaces everything.
    pub fn restore(&mut self, gaussians: Gaussians, optimiser: Optimiser) {
        (self.gaussians, self.optimiser) = (gaussians, optimiser);
        self.newest = Newest::Host;
        self.finished.clear();
    }

    /// Brings the newest state here.
    ///
    /// # Errors
    /// Where the GPU fails: then the newest state is lost, and what is here is older.
    pub fn sync(&mut self) -> Result<(), BackendError> {
        if let (Newest::Gpu, Backend::Gpu(engine)) = (self.newest, &mut self.backend) {
            engine.download(&mut self.gaussians, &mut self.optimiser)?;
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
        self.sync()?;
        self.newest = Newest::Host;
        Ok((&mut self.gaussians, &mut self.optimiser))
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
            }
            Backend::Gpu(engine) => {
                if self.newest == Newest::Host {
                    engine.upload(&self.gaussians, &mut self.optimiser)?;
                }
                self.newest = Newest::Gpu;
                engine.step(view, settings)?;
            }
        }
        Ok(())
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
