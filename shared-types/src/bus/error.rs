//! What can go wrong on the bus.

use std::path::PathBuf;

/// An error of the bus. None is a panic: another process's death may cause any of them.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// The domain cannot be joined.
    #[error("{}: cannot join the system's bus: {cause}; expected this user's own system folder and a usable /dev/shm (see `vantage doctor`)", path.display())]
    Domain {
        /// iceoryx2's configuration of the domain.
        path: PathBuf,
        /// iceoryx2's word.
        cause: String,
    },
    /// Another version of Vantage has the channel open.
    #[error(
        "channel {channel}: its payload is not ours (schema {ours}): a process of another version runs in this system; stop it, or restart all services with one version"
    )]
    Schema {
        /// The channel.
        channel: &'static str,
        /// Hash of our declaration.
        ours: String,
    },
    /// A channel cannot be opened.
    #[error("channel {channel}: cannot be opened: {cause}; is the keeper running?")]
    Channel {
        /// The channel.
        channel: &'static str,
        /// iceoryx2's word.
        cause: String,
    },
    /// A sending or receiving end cannot be made.
    #[error(
        "channel {channel}: no port to be had: {cause}; too many processes use it, or dead ones have not been cleaned up"
    )]
    Port {
        /// The channel.
        channel: &'static str,
        /// iceoryx2's word.
        cause: String,
    },
    /// Shared memory is full.
    #[error(
        "channel {channel}: cannot reserve {bytes} bytes in /dev/shm: {source}; enlarge it (`mount -o remount,size=1G /dev/shm`, docker `--shm-size`) or lower model.max_gaussians"
    )]
    Reserve {
        /// The channel.
        channel: &'static str,
        /// Bytes wanted.
        bytes: u64,
        /// The operating system's word.
        source: std::io::Error,
    },
    /// Every chunk is held by readers.
    #[error("channel {channel}: every chunk is still held by readers; the message is dropped")]
    NoChunk {
        /// The channel.
        channel: &'static str,
    },
    /// More items than the channel admits.
    #[error("channel {channel}: {items} items, expected at most {limit}")]
    TooManyItems {
        /// The channel.
        channel: &'static str,
        /// Items of the message.
        items: usize,
        /// The channel's limit.
        limit: usize,
    },
    /// Sending failed.
    #[error("channel {channel}: cannot send: {cause}")]
    Send {
        /// The channel.
        channel: &'static str,
        /// iceoryx2's word.
        cause: String,
    },
    /// Receiving failed.
    #[error("channel {channel}: cannot receive: {cause}")]
    Receive {
        /// The channel.
        channel: &'static str,
        /// iceoryx2's word.
        cause: String,
    },
    /// Waiting failed.
    #[error("cannot wait for messages: {cause}")]
    Wait {
        /// The operating system's word.
        cause: String,
    },
}
