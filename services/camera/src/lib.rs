//! RGB-D sources to frames and keyframes.
//!
//! The camera turns the images of a source into `camera/frame`, `camera/depth` and, when asked, into keyframes: it waits
//! until the vehicle has arrived at the view, chooses the stillest instant, takes that image with the pose measured at
//! that very instant, brings it to the mission folder, and only then says so. A keyframe exists once, whatever dies.
//!
//! - [`source`] and [`conformance`]: what a source of images is, and how that is checked; [`sources`]: the sources;
//! - [`logic`]: pose at an instant, the capture gate, headers, without channels or clocks;
//! - [`state`]: the state machine of a capture;
//! - [`writer`]: keyframes to the disk; [`ports`]: the channels; [`service`]: one turn of the loop.

#![forbid(unsafe_code)]

pub mod conformance;
pub mod logic;
pub mod ports;
pub mod service;
pub mod source;
pub mod sources;
pub mod state;
pub mod writer;

use anyhow::Context as _;

/// Runs the camera until it is told to stop.
///
/// # Errors
/// When the channels cannot be opened or the service cannot go on.
pub fn run(mut context: shared_types::service::Context) -> anyhow::Result<()> {
    let (ports, render) = ports::Ports::open(&context.bus)?;
    let source = sources::simulator::SimulatorSource::new(render);
    let mut service =
        service::CameraService::new(ports, Box::new(source), &context).context("the camera cannot start")?;
    context.run(&mut service)?;
    Ok(())
}
