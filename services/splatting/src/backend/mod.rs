//! One interface to both back ends: who trains and who scores do not know which one works.

mod training;

use std::fmt;
use std::sync::atomic::AtomicBool;

use thiserror::Error;

use crate::camera::{Camera, RenderSettings};
use crate::engine::{Engine, EngineError, MomentsView, Rendered};
use crate::gpu::{self, GpuError};
use crate::model::Gaussians;
use crate::uncertainty::{Uncertainty, UncertaintySettings, uncertainty};

pub use crate::gpu::Arrival;
pub use training::Training;

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
            BackendKind::Auto if wanted.adapter.is_none() && !gpu::may_exist() => (cpu()?, Some(GpuError::NoHardware)),
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
