//! From posed RGB-D images to Gaussians: images at training size, pixel classes, insertion, pruning. Pure: no files, no clock.
//!
//! Live and offline training share it, so that a mission folder is trained on with the rules that flew it.

pub mod clip_box;
pub mod downsample;
pub mod insertion;
pub mod masks;
pub mod prune;
pub mod voxels;
