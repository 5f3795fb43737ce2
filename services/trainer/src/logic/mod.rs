//! The trainer's logic: no IPC, no clock, no files; time, seeds and images come in as arguments.

pub mod clip_box;
pub mod downsample;
pub mod insertion;
pub mod masks;
pub mod order;
pub mod prune;
pub mod rounds;
pub mod voxels;
