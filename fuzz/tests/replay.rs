//! The short run of every change: seeds, what was found before, and mutations from a fixed seed.

#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use fuzz::mutate::{Random, mutated};
use fuzz::{TARGETS, Target, check, regressions};

fn inputs(target: &Target) -> Vec<Vec<u8>> {
    let mut inputs = (target.seeds)();
    let folder = regressions(target);
    let mut files: Vec<_> = match std::fs::read_dir(&folder) {
        Ok(entries) => entries.map(|entry| entry.expect("an entry").path()).collect(),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Vec::new(),
        Err(error) => panic!("{}: {error}", folder.display()),
    };
    files.sort();
    inputs.extend(files.iter().map(|path| std::fs::read(path).expect("a regression")));
    inputs
}

/// Runs an input; what it was is written beside the test's output before it runs, so that it is there after a panic.
fn run(target: &Target, what: &str, input: &[u8]) {
    let result = std::panic::catch_unwind(|| check(target, input));
    if result.is_err() {
        let path = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{}-{what}", target.name));
        std::fs::write(&path, input).expect("written");
        panic!(
            "target {}: {what} fails; the input is {}: mend the reader, then keep it in {}",
            target.name,
            path.display(),
            regressions(target).display()
        );
    }
}

#[test]
fn no_seed_no_earlier_finding_and_no_mutation_of_them_panics() {
    for target in TARGETS {
        let began = std::time::Instant::now();
        let inputs = inputs(target);
        assert!(!inputs.is_empty(), "target {} has no seed", target.name);
        for (index, input) in inputs.iter().enumerate() {
            run(target, &format!("input-{index}"), input);
        }
        let mut random = Random::new(0x5eed);
        for index in 0..target.mutations {
            run(target, &format!("mutation-{index}"), &mutated(&inputs, &mut random));
        }
        println!("{}: {} inputs, {} mutations, {:.1?}", target.name, inputs.len(), target.mutations, began.elapsed());
    }
}

#[test]
fn every_folder_of_regressions_belongs_to_a_target() {
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("regressions");
    for entry in std::fs::read_dir(&root).expect("the folder of regressions") {
        let name = entry.expect("an entry").file_name().into_string().expect("a name");
        assert!(name == "README.md" || fuzz::target(&name).is_some(), "regressions/{name}: no target has this name");
    }
}

#[test]
fn memory_out_of_proportion_is_a_finding() {
    let greedy = Target {
        name: "greedy",
        run: |data| drop(std::hint::black_box(vec![1u8; data.len() * (300 << 20)])),
        seeds: Vec::new,
        mutations: 0,
    };
    check(&greedy, &[0]);
    assert!(std::panic::catch_unwind(|| check(&greedy, &[0, 0])).is_err(), "600 MB for two bytes");
}
