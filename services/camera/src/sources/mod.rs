//! The sources of RGB-D images.

pub mod simulator;
