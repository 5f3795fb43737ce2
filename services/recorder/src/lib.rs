//! Records every channel of a system to MCAP, and reads recordings.
//!
//! The loop copies messages out of shared memory into a queue of bounded size; a thread writes them, in chunks that are
//! flushed each second. A slow disk fills the queue, and then images of the stream are dropped first; nobody else ever waits.
//! A recorder that is killed loses the chunk it was filling. Without room on the disk nothing is recorded until there is some
//! again, in another file.
//!
//! - [`recording`]: what a file holds, and reading it;
//! - [`service`]: the state machine, with [`queue`] and [`writer`] behind it.

#![forbid(unsafe_code)]

mod file;
mod pictures;
mod ports;
pub mod queue;
pub mod recording;
pub mod service;
mod topics;
pub mod writer;

use shared_types::service::Context;

/// Records until it is asked to stop.
///
/// # Errors
/// When the bus or the recording cannot be opened.
pub fn run(mut context: Context) -> anyhow::Result<()> {
    let mut recorder = service::Recorder::open(&context)?;
    context.run(&mut recorder)?;
    recorder.finish();
    Ok(())
}
