//! The Gaussian model, its renderers, its optimiser and its file formats.
//!
//! No process of its own and no IPC: the trainer and the scorer are built on this crate. [`Gaussians`] is the model,
//! [`Engine`] renders it (colour, expected depth and alpha, or moments of depth) and trains it against
//! [`TrainingView`]s, with the state of Adam in [`Optimiser`]. Everything is deterministic: the same bits for any
//! number of threads.

#![expect(clippy::needless_range_loop, reason = "kernels index several vectors by one counter; see simd::build")]

mod backend;
mod backward;
mod blend;
pub mod bytes;
mod camera;
pub mod checkpoint;
mod densify;
mod edit;
mod engine;
pub mod formats;
mod frame;
pub mod gpu;
mod gradient;
mod initial;
mod loss;
pub mod metrics;
mod model;
mod neighbours;
mod optimiser;
pub mod order;
mod projection;
mod random;
pub mod reference;
pub mod rgbd;
mod schedule;
mod settings;
mod sh;
mod simd;
mod sort;
mod ssim;
mod statistics;
#[cfg(test)]
mod tests;
mod training;
pub mod uncertainty;
mod view;
mod workers;

pub use backend::{Arrival, Backend, BackendError, BackendKind, BackendOptions, Training};
pub use camera::{Camera, Pose, RenderSettings};
pub use densify::{
    DefaultSettings, Densifier, DensifierState, DensifyError, DensifyReport, McmcSettings, Relocation, Strategy,
};
pub use edit::Draft;
pub use engine::{DEPTH_ALPHA_TINY, Engine, EngineError, Moments, MomentsView, Rendered, Work};
pub use formats::ply;
pub use initial::{ColoredPoint, InitialError, InitialGaussians, random_points};
pub use model::{Gaussian, Gaussians, SH_C0, SH_DEGREE_MAX, SH_REST_MAX, sh_rest_coefficients};
pub use optimiser::Optimiser;
pub use schedule::{Schedule, scene_extent};
pub use settings::{LossTerms, TrainingSettings};
pub use simd::Isa;
pub use statistics::{ScreenStatistics, StatisticsError};
pub use training::{Gradient, ParameterGradient};
pub use view::{PixelClass, TrainingView, ViewError};
