//! What the camera decides, without channels, clocks or files.

pub mod gate;
pub mod image;
pub mod pose_buffer;
pub mod schedule;
