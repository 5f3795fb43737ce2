//! What can go wrong with a GPU.

use thiserror::Error;

/// Why the GPU back end could not do something. After [`GpuError::Lost`] and [`GpuError::OutOfMemory`] what was on the GPU
/// is gone: go on from a checkpoint, with a new engine.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum GpuError {
    /// No adapter at all.
    #[error("no GPU adapter was found: install a Vulkan driver, or set the back end to \"cpu\"")]
    NoAdapter,
    /// No device node of a GPU: no driver was loaded to look further.
    #[error(
        "this machine has no GPU (no device node of one under /dev); drivers in software are a hundred times slower and were not \
         looked for: one that is named with its adapter is taken"
    )]
    NoHardware,
    /// None of that name.
    #[error("no GPU adapter is named \"{wanted}\"; there are: {}", list(found))]
    NoSuchAdapter {
        /// What was asked for.
        wanted: String,
        /// Names of those that exist.
        found: Vec<String>,
    },
    /// Only adapters that render on the CPU.
    #[error(
        "only software adapters were found ({}), a hundred times slower than the CPU engine: set the back end to \"cpu\", \
         or name one as the adapter to take it anyway",
        list(found)
    )]
    OnlySoftware {
        /// Names of those that exist.
        found: Vec<String>,
    },
    /// The adapter cannot run the kernels.
    #[error(
        "adapter \"{adapter}\" has {what} of {found}, and the kernels need {needed}: choose another adapter, or \"cpu\""
    )]
    Limit {
        /// Its name.
        adapter: String,
        /// Name of the limit.
        what: &'static str,
        /// What it has.
        found: u64,
        /// What is needed.
        needed: u64,
    },
    /// The adapter refused.
    #[error("adapter \"{adapter}\" gave no device: {reason}")]
    NoDevice {
        /// Its name.
        adapter: String,
        /// What it said.
        reason: String,
    },
    /// A buffer larger than the adapter can bind.
    #[error(
        "{what} needs {needed} bytes in one buffer, and the adapter binds {limit} at most: use fewer Gaussians, smaller \
         images or the CPU"
    )]
    TooLarge {
        /// What for.
        what: &'static str,
        /// Bytes that are needed.
        needed: u64,
        /// Bytes that can be bound.
        limit: u64,
    },
    /// Images with more tiles along a side than a box of tiles can name.
    #[error("an image of {width}x{height} pixels; the GPU back end draws at most 4096 along a side")]
    TooManyPixels {
        /// Width, pixels.
        width: u32,
        /// Height, pixels.
        height: u32,
    },
    /// The GPU's memory is full.
    #[error("the GPU is out of memory: {0}")]
    OutOfMemory(String),
    /// The device was lost: a reset, a driver that crashed, a GPU that was unplugged.
    #[error("the GPU was lost: {0}")]
    Lost(String),
    /// The driver or the validation refused a command.
    #[error("the GPU refused a command: {0}")]
    Refused(String),
    /// Nothing came back in time.
    #[error("the GPU did not answer for {0} s")]
    Silent(u64),
    /// The caller's flag was set before all views were done.
    #[error("cancelled before all views were rendered")]
    Cancelled,
}

fn list(names: &[String]) -> String {
    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
}
