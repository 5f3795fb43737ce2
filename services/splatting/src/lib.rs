//! The Gaussian model, its renderers, its optimiser and its file formats.
//!
//! No process of its own and no IPC: the trainer and the scorer are built on this crate. [`Gaussians`] is the model,
//! [`Engine`] renders it (colour, expected depth and alpha, or moments of depth) and trains it against
//! [`TrainingView`]s, with the state of Adam in [`Optimiser`]. Everything is deterministic: the same bits for any
//! number of threads.

#![expect(clippy::needless_range_loop, reason = "kernels index several vectors by one counter; see simd::build")]

mod backward;
mod blend;
pub mod bytes;
mod camera;
pub mod checkpoint;
mod engine;
mod frame;
mod gradient;
mod loss;
pub mod metrics;
mod model;
mod optimiser;
pub mod order;
pub mod ply;
mod projection;
pub mod reference;
pub mod rgbd;
mod settings;
mod sh;
mod simd;
mod sort;
mod ssim;
#[cfg(test)]
mod tests;
mod training;
mod view;
mod workers;

pub use camera::{Camera, Pose, RenderSettings};
pub use engine::{DEPTH_ALPHA_TINY, Engine, EngineError, Moments, MomentsView, Rendered};
pub use model::{Gaussian, Gaussians, SH_C0, SH_DEGREE_MAX, SH_REST_MAX, sh_rest_coefficients};
pub use optimiser::Optimiser;
pub use settings::{LossTerms, TrainingSettings};
pub use simd::Isa;
pub use training::{Gradient, ParameterGradient};
pub use view::{PixelClass, TrainingView, ViewError};
