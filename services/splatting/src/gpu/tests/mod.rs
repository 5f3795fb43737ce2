//! Tests of the GPU back end, on whatever adapter there is; software will do. One device for all of them.
//!
//! Without an adapter each says that it was skipped; with `VANTAGE_EXPECT_GPU=1` it fails instead.
//! `VANTAGE_TEST_ADAPTER` names another adapter than the first.

mod check;
mod densify;
mod dispatches;
mod edges;
mod editing;
mod forward;
mod gradients;
mod memory;
mod scoring;
mod training;

use std::sync::{Mutex, OnceLock, PoisonError};

use super::{Engine, Options, adapters};

/// Options for the adapter that tests run on; `None` without one.
pub(super) fn options() -> Option<Options> {
    let named = std::env::var("VANTAGE_TEST_ADAPTER").ok();
    let adapter = named.or_else(|| adapters().into_iter().next().map(|adapter| adapter.name));
    adapter.map(|name| Options { adapter: Some(name), ..Options::default() })
}

/// Runs a test on the shared engine, or says that it is skipped.
pub(super) fn with_engine(test: &str, run: impl FnOnce(&mut Engine)) {
    static ENGINE: OnceLock<Option<Mutex<Engine>>> = OnceLock::new();
    let engine = ENGINE.get_or_init(|| options().map(|options| Mutex::new(Engine::new(&options).unwrap())));
    match engine {
        Some(engine) => run(&mut engine.lock().unwrap_or_else(PoisonError::into_inner)),
        None => skipped(test),
    }
}

/// Says that a test is skipped, or fails where an adapter was promised.
pub(super) fn skipped(test: &str) {
    assert!(std::env::var_os("VANTAGE_EXPECT_GPU").is_none(), "{test}: no GPU adapter, but one was expected");
    println!("{test}: skipped, no GPU adapter");
}
