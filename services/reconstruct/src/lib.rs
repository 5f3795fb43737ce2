//! Offline training (`vantage reconstruct`): a Gaussian model from a mission folder, a COLMAP or a nerfstudio dataset.
//!
//! - [`dataset`]: posed images, whatever format they come in; [`split`](mod@split): which are trained on;
//! - [`start`], [`recipe`]: what the model begins with, and what is minimised how fast;
//! - [`run`](mod@run): the loop; [`views`], [`evaluate`](mod@evaluate), [`progress`]: what it looks at and tells;
//! - [`checkpoint`], [`output`], [`report`], [`picture`]: what it leaves; [`finished`](mod@finished): what was left.
//!
//! A library without a process of its own. On the CPU the same seed gives the same bits for any number of threads, and a
//! run that was killed goes on with the bits of one that never was; so it does on a GPU where `deterministic` is set. A run
//! may change its back end. Figures are measured by the CPU engine, whatever trained.
#![forbid(unsafe_code)]

pub mod checkpoint;
mod clocks;
pub mod dataset;
pub mod error;
pub mod evaluate;
pub mod finished;
pub mod options;
pub mod output;
pub mod picture;
pub mod progress;
pub mod recipe;
pub mod report;
pub mod run;
pub mod split;
pub mod start;
pub mod views;

pub use dataset::MaskUse;
pub use error::{ErrorKind, ReconstructError};
pub use finished::finished;
pub use options::{Background, Options, StrategyName};
pub use progress::{Event, Observer, Progress};
pub use run::{Outcome, run};
