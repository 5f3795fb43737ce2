//! The check that `vantage doctor` makes, and the list it makes it from.

use super::super::{adapters, check};
use super::{options, skipped};

#[test]
fn the_adapter_passes_its_own_check() {
    let test = "the_adapter_passes_its_own_check";
    let Some(name) = options().and_then(|options| options.adapter) else { return skipped(test) };
    let listed = adapters().into_iter().find(|adapter| adapter.name == name).unwrap();
    assert!(listed.storage_buffers >= 8 && listed.max_binding_bytes >= 128 << 20 && !listed.driver.is_empty());
    let report = check(&name).unwrap();
    assert!(report.is_correct() && report.iterations_per_s > 0.0, "{report:?}");
}
