//! Whole missions of the preset `tiny`, with real processes.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::collections::BTreeSet;
use std::fs;

use common::{Flight, journal, keyframes, metrics};

#[test]
fn a_mission_lands_with_a_model_and_a_complete_folder_and_leaves_nothing_behind() {
    let folder = tempfile::tempdir().expect("folder");
    let folder = folder.path().join("mission");
    let flight = Flight::start(&folder, &["--preset", "tiny", "--seed", "3", "--system", "whole"]);
    flight.finish_well();

    let base = shared_types::system::System::base_dir();
    assert!(!base.join("whole").exists(), "the system's folder is gone");
    assert_eq!(keyframes(&folder), (0..6).collect::<Vec<u64>>());
    assert!(folder.join("mission.toml").is_file());
    let gaussians = splatting::ply::read(&fs::read(folder.join("model/model.ply")).expect("model.ply")).expect("a PLY");
    assert!(gaussians.len() > 500, "{} Gaussians", gaussians.len());

    let metrics = metrics(&folder);
    assert_eq!(metrics["mission"]["end_reason"], "complete");
    assert_eq!(metrics["mission"]["keyframes"], 6);
    assert_eq!(metrics["mission"]["deterministic"], true);
    assert_eq!(metrics["mission"]["collisions"], 0);
    let number = |a: &str, b: &str| metrics[a][b].as_f64().unwrap_or_else(|| panic!("{a}.{b} in {metrics:#}"));
    // Colours of one frame convention and none other: training gains over the points as inserted, and those over one colour.
    assert!(number("live", "psnr_init_db") > number("live", "psnr_null_db") + 3.0, "{metrics:#}");
    assert!(number("live", "psnr_object_db") > number("live", "psnr_init_db") + 2.0, "{metrics:#}");
    assert!(number("geometry", "f_score_1pct") > 0.5, "{metrics:#}");
    assert!(number("timing", "score_ms_p50") > 0.0, "{metrics:#}");
    let parts = ["flight_s", "capture_s", "training_s", "scoring_s"].map(|part| number("timing", part));
    let total: f64 = parts.iter().sum();
    assert!(total <= number("mission", "mission_s") && total > 0.8 * number("mission", "mission_s"), "{metrics:#}");
    assert!(number("mission", "min_clearance_m") > 0.3, "{metrics:#}");
    assert!(number("coverage", "cov1_feasible") > 0.5, "{metrics:#}");
    for name in ["north", "east", "south", "west"] {
        assert!(folder.join(format!("report/{name}.png")).is_file(), "report/{name}.png");
    }

    // What is over is not flown again.
    let before = fs::read(folder.join("journal.jsonl")).expect("the journal");
    let resumed = common::vantage().arg("resume").arg(&folder).arg("--json").output().expect("vantage runs");
    assert!(resumed.status.success() && String::from_utf8_lossy(&resumed.stderr).contains("is over"));
    assert_eq!(serde_json::from_slice::<serde_json::Value>(&resumed.stdout).expect("JSON"), metrics);
    assert_eq!(fs::read(folder.join("journal.jsonl")).expect("the journal"), before);
}

#[test]
fn the_same_seed_flies_the_same_mission_bit_for_bit() {
    let folder = tempfile::tempdir().expect("folder");
    // One after the other, so that the second finds another load on the machine than the first beside other tests.
    let runs: Vec<_> = ["a", "b"]
        .iter()
        .map(|name| {
            let folder = folder.path().join(name);
            Flight::start(&folder, &["--preset", "tiny", "--seed", "11"]).finish_well();
            folder
        })
        .collect();
    for file in ["journal.jsonl", "model/model.ply"] {
        let [a, b] = [0, 1].map(|run: usize| fs::read(runs[run].join(file)).expect(file));
        let differs = a.iter().zip(&b).position(|(x, y)| x != y);
        assert!(a == b, "{file} differs from byte {differs:?} on ({} and {} bytes)", a.len(), b.len());
    }
}

#[test]
fn two_missions_fly_side_by_side() {
    let folder = tempfile::tempdir().expect("folder");
    let flights: Vec<_> = ["one", "two"]
        .iter()
        .map(|name| Flight::start(&folder.path().join(name), &["--preset", "tiny", "--seed", "5"]))
        .collect();
    for flight in flights {
        let folder = flight.folder.clone();
        flight.finish_well();
        assert_eq!(keyframes(&folder).len(), 6);
    }
}

#[test]
fn every_decision_is_in_the_journal_once_and_in_order() {
    let folder = tempfile::tempdir().expect("folder");
    let folder = folder.path().join("mission");
    Flight::start(&folder, &["--preset", "tiny", "--seed", "8"]).finish_well();
    let journal = journal(&folder);
    assert!(journal.len() > 10, "{} lines", journal.len());
    let stamps: Vec<u64> = journal.iter().filter_map(|line| line["now_ns"].as_u64()).collect();
    assert_eq!(stamps.len(), journal.len(), "every line has a stamp");
    assert!(stamps.is_sorted());
    let numbers: BTreeSet<u64> = journal.iter().filter_map(|line| line["id"].as_u64()).collect();
    assert_eq!(numbers.len(), journal.len(), "every line has a number of its own");
    let text = fs::read_to_string(folder.join("journal.jsonl")).expect("journal");
    assert!(!text.contains(folder.to_str().expect("utf8")), "no absolute path in the journal");
}

/// A GPU in software is taken where it is named, and flies the mission as the CPU does, in small images.
#[test]
fn a_mission_is_trained_and_scored_on_a_gpu() {
    let Some(adapter) = splatting::gpu::adapters().into_iter().next() else {
        assert!(std::env::var_os("VANTAGE_EXPECT_GPU").is_none(), "no GPU adapter, but one was expected");
        println!("a_mission_is_trained_and_scored_on_a_gpu: skipped, no GPU adapter");
        return;
    };
    let folder = tempfile::tempdir().expect("folder");
    let folder = folder.path().join("mission");
    let named = |service: &str| {
        [format!("{service}.backend=\"gpu\""), format!("{service}.adapter=\"{}\"", adapter.name.replace('"', ""))]
    };
    let small = ["model.width=64", "model.height=48"].map(str::to_owned);
    let sets: Vec<String> = [named("trainer"), named("scorer"), small].concat();
    let mut arguments = vec!["--preset", "tiny", "--seed", "5"];
    arguments.extend(sets.iter().flat_map(|set| ["--set", set]));
    Flight::start(&folder, &arguments).finish_well();
    assert_eq!(keyframes(&folder), (0..6).collect::<Vec<u64>>());
    let metrics = metrics(&folder);
    let backend = metrics["mission"]["backend"].as_str().expect("named");
    assert!(backend.starts_with("gpu ") && backend.contains(&adapter.name), "{backend}");
    assert!(metrics["memory"]["gpu_mb"].as_f64() > Some(0.1), "{metrics:#}");
    let number = |name: &str| metrics["live"][name].as_f64().unwrap_or_else(|| panic!("live.{name} in {metrics:#}"));
    assert!(number("psnr_object_db") > number("psnr_null_db") + 4.0, "{metrics:#}");
}
