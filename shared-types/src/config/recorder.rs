//! Section `[recorder]`: what is recorded of a mission, and how much room it may take.

use serde::{Deserialize, Serialize};

use super::{Problem, Section};

/// How chunks of a recording are compressed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Compression {
    /// Not at all: least processor time.
    None,
    /// Zstandard, its fastest level.
    #[default]
    Zstd,
}

/// Section `[recorder]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RecorderConfig {
    /// Record the mission into `recording.mcap` of its folder.
    pub enabled: bool,
    /// The mission's clock waits for the recorder, so that no message is ever lost; in lockstep only.
    pub complete: bool,
    /// Record the stream of images too, which the camera makes only for those who read it. Keyframes are recorded anyway.
    pub frames: bool,
    /// Images of the stream that viewers can show, a second; keyframes all are.
    pub preview_hz: f64,
    /// Compression of chunks: none or zstd.
    pub compression: Compression,
    /// Size of a chunk before compression, megabytes; what was not written whole is lost with the process.
    pub chunk_mb: f64,
    /// Memory that may wait for a slow disk, megabytes. Where it is used up, images of the stream are dropped first.
    pub memory_mb: f64,
    /// Room on the disk for all recordings of a mission, megabytes. The last tenth is kept from the stream of images.
    pub max_mb: f64,
    /// Time between two syncs to the disk, seconds: what a power cut may take.
    pub sync_s: f64,
}

impl Default for RecorderConfig {
    fn default() -> Self {
        Self {
            enabled: false,
            complete: false,
            frames: true,
            preview_hz: 1.0,
            compression: Compression::Zstd,
            chunk_mb: 2.0,
            memory_mb: 64.0,
            max_mb: 20_000.0,
            sync_s: 5.0,
        }
    }
}

impl Section for RecorderConfig {
    fn problems(&self) -> Vec<Problem> {
        [
            Problem::unless_within("preview_hz", self.preview_hz, 0.0, 30.0),
            Problem::unless_within("chunk_mb", self.chunk_mb, 0.1, 64.0),
            Problem::unless_within("memory_mb", self.memory_mb, 8.0, 4096.0),
            Problem::unless_within("max_mb", self.max_mb, 1.0, 10_000_000.0),
            Problem::unless_within("sync_s", self.sync_s, 0.1, 600.0),
        ]
        .into_iter()
        .flatten()
        .collect()
    }
}
