//! The trainer as others see it: training end to end without IPC, and the service over a real bus.
#![expect(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod common;
mod disks;
mod service;
mod training;
