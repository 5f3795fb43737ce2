//! The camera over real channels.

#![expect(clippy::expect_used, clippy::panic, reason = "a failed expectation fails the test")]

mod capture;
mod common;
mod conformance;
mod disks;
