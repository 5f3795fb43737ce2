//! Offline training (`vantage reconstruct`): a Gaussian model from a mission folder, a COLMAP or a nerfstudio dataset.
#![forbid(unsafe_code)]

pub mod dataset;
pub mod error;
