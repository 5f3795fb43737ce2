//! The GPU back end: the same model, images, losses and steps as the CPU engine, on any adapter that wgpu reaches.
//!
//! Kernels are the files of `shaders/`, one each, with the source of what they compute. An iteration is 18 dispatches:
//! projection, four passes of an exact radix sort by depth (two each), three of binning, blending, similarity, loss,
//! backward blending, Adam with the projection's backward pass, and the sum of the terms. What one leaves the next one
//! reads; nothing is read back before the host asks for it, and what the host learns late (the terms of the loss, lists
//! that did not fit) is made so that lateness does no harm. Between iterations the list of Gaussians changes where it is:
//! pruning is decided by kernels, everything else by the host, from what it must see of each, and rows are moved here.

mod adapter;
mod buffers;
mod chain;
mod check;
mod context;
mod copying;
mod drawing;
mod editing;
mod engine;
mod error;
mod iteration;
mod job;
mod kernels;
mod keyframe;
mod model;
mod peak;
mod probing;
mod pruning;
mod scoring;
#[cfg(test)]
mod tests;
mod training;

pub use adapter::{AdapterReport, adapters, may_exist};
pub use check::{CheckReport, check};
pub use copying::{Arrival, Copied};
pub use engine::{Engine, Options};
pub use error::GpuError;
