//! Hostile bytes for everything that reads files and datagrams: no input may panic, hang, overflow, or take memory out of
//! proportion. A target gets bytes, brings them to a reader of the product, and uses what it accepted as the product does.
//!
//! Two ways in: `fuzz/run` mutates under the guidance of coverage for as long as it is told; the test `replay` runs the
//! seeds, what was found before (`regressions/`), and a fixed number of mutations from a fixed seed, on every change.
//!
//! Seeds are made by the product's own writers, so that they follow its formats. Where a format has checksums, the target
//! makes them right again after the mutation: else nothing behind them would ever be reached.

#![allow(clippy::panic, reason = "a panic is how a target tells of a finding")]

pub mod memory;
pub mod mutate;
pub mod seal;
mod targets;

use std::path::{Path, PathBuf};

pub use targets::TARGETS;

/// Something that reads bytes of others.
#[derive(Debug, Clone, Copy)]
pub struct Target {
    /// Name on the command line, and of its folder of regressions.
    pub name: &'static str,
    /// Brings the bytes to the reader. Panics are findings.
    pub run: fn(&[u8]),
    /// Inputs to begin with.
    pub seeds: fn() -> Vec<Vec<u8>>,
    /// Mutations that the test `replay` tries.
    pub mutations: u32,
}

/// The target of a name.
#[must_use]
pub fn target(name: &str) -> Option<&'static Target> {
    TARGETS.iter().find(|target| target.name == name)
}

/// Runs a target and looks at the memory it took.
///
/// # Panics
/// When the target does, or when it held more than [`memory::MOST_BYTES`] at once.
pub fn check(target: &Target, data: &[u8]) {
    memory::begin();
    (target.run)(data);
    let peak = memory::peak();
    assert!(
        peak <= memory::MOST_BYTES,
        "target {}: {peak} bytes of memory for an input of {} bytes, expected at most {}",
        target.name,
        data.len(),
        memory::MOST_BYTES
    );
}

/// The folder of inputs that once were findings.
#[must_use]
pub fn regressions(target: &Target) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("regressions").join(target.name)
}

/// Writes a target's seeds into a folder, for the fuzzer to begin with.
///
/// # Errors
/// When the folder or a file cannot be written.
pub fn write_seeds(target: &Target, folder: &Path) -> std::io::Result<()> {
    std::fs::create_dir_all(folder)?;
    for (index, seed) in (target.seeds)().into_iter().enumerate() {
        std::fs::write(folder.join(format!("seed-{index:02}")), seed)?;
    }
    Ok(())
}
