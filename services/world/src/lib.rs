//! The rendered world of the simulator: an object on the lunar ground under the sun, seen by an RGB-D camera, and the ground
//! truth about it.
//!
//! [`Scene`] is built once from a [`SceneConfig`] (a procedural rock, or an OBJ, PLY, STL or glTF mesh at a chosen size and
//! yaw); [`render::render`] makes an image of it. The service answers requests for images at the camera's true pose of a
//! stamp, and renders nothing that nobody asked for. [`truth`] is for evaluation only: no service reads it.
#![forbid(unsafe_code)]

pub mod albedo;
pub mod bvh;
pub mod color;
pub mod ground;
mod history;
pub mod mesh;
mod ports;
pub mod random;
pub mod render;
pub mod rock;
pub mod scene;
mod service;
pub mod shadow;
mod state;
pub mod texture;
pub mod truth;

pub use scene::{Scene, SceneConfig, SceneError};
pub use service::run;
