//! MAVLink 2: frames in and out, what clients say, what the vehicle tells.

pub mod codec;
pub mod forwarding;
pub mod gimbal;
pub mod inbound;
mod motion;
pub mod ping;
pub mod status;
pub mod telemetry;
