//! The coverage-guided fuzzer: libFuzzer's program for the target that `VANTAGE_FUZZ_TARGET` names. Started by `fuzz/run`.
#![no_main]

use std::path::Path;
use std::sync::OnceLock;

use fuzz::Target;
use libfuzzer_sys::fuzz_target;

static TARGET: OnceLock<&'static Target> = OnceLock::new();

/// The target; writes its seeds into the folder that `VANTAGE_FUZZ_SEEDS` names.
fn target() -> &'static Target {
    TARGET.get_or_init(|| {
        let name = std::env::var("VANTAGE_FUZZ_TARGET").unwrap_or_default();
        let Some(target) = fuzz::target(&name) else {
            let names: Vec<&str> = fuzz::TARGETS.iter().map(|target| target.name).collect();
            eprintln!("VANTAGE_FUZZ_TARGET is {name:?}; expected one of {}; start this by fuzz/run", names.join(", "));
            std::process::exit(64);
        };
        if let Ok(folder) = std::env::var("VANTAGE_FUZZ_SEEDS")
            && let Err(error) = fuzz::write_seeds(target, Path::new(&folder))
        {
            eprintln!("cannot write seeds to {folder}: {error}; name another folder");
            std::process::exit(64);
        }
        target
    })
}

fuzz_target!(
    init: { target(); },
    |data: &[u8]| { fuzz::check(target(), data); }
);
