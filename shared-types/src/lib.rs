//! What crosses process borders in Vantage, and nothing else.
//!
//! - [`messages`]: the payload types, zero-copy, one file per subject;
//! - [`channel`]: one table of channel names and settings;
//! - [`bus`]: the one thin wrapper over iceoryx2 that every service uses: publishers, subscribers, requests with replies;
//! - [`service`]: the loop every service runs in, on the mission clock (lockstep) or the machine's (wall);
//! - [`system`]: one vehicle and its services: folders, shared-memory prefix;
//! - [`describe`]: payloads as JSON, for people and viewers;
//! - [`frames`]: poses and the pinhole camera;
//! - [`config`]: the configuration file;
//! - [`folder`]: the mission folder, and files that appear whole;
//! - [`fault_point`]: instants at which tests make processes die;
//! - [`storage`]: the disk, as far as it is written to; tests record, cut, fill and slow it;
//! - [`realtime`]: what a thread with a deadline asks of the kernel.

pub mod bus;
pub mod channel;
pub mod config;
pub mod describe;
pub mod fault_point;
pub mod folder;
pub mod frames;
pub mod logging;
pub mod memory;
pub mod messages;
pub mod payload;
pub mod post_mortem;
pub mod realtime;
pub mod service;
pub mod storage;
pub mod system;
pub mod trace;

pub use payload::Payload;
pub use service::ServiceName;

/// One tick of the simulated mission clock, nanoseconds.
pub const TICK_NS: u64 = 10_000_000;

/// Nanoseconds of a second.
pub const NS_PER_S: u64 = 1_000_000_000;

/// Seconds as nanoseconds of mission time; negative and non-finite durations are 0.
#[must_use]
pub fn ns_from_s(seconds: f64) -> u64 {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped; 584 years fit")]
    let ns = (seconds.max(0.0) * 1e9).round() as u64;
    ns
}

/// Nanoseconds of mission time as seconds.
#[must_use]
pub fn s_from_ns(ns: u64) -> f64 {
    #[expect(clippy::cast_precision_loss, reason = "53 bits hold 104 days of nanoseconds")]
    let s = ns as f64 * 1e-9;
    s
}

/// What the macros [`payload!`] and [`stage!`] need from its callers' point of view. Not for use by hand.
#[doc(hidden)]
pub mod private {
    pub use bytemuck::{Pod, Zeroable};
    pub use iceoryx2::prelude::ZeroCopySend;
    pub use serde_json::{Map, Value};
    pub use tracing;

    pub use crate::describe::{object_schema, tell, tell_schema};
    pub use crate::payload::{SCHEMA_SEED, fold, fold_text};
}
