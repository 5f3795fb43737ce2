//! Kills each service once in flight with SIGKILL: the mission completes with every keyframe exactly once.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::path::Path;

use common::{Flight, keyframes, kill, metrics};

/// Flies `tiny`, kills `service` once `after` keyframes are on disk, and expects the mission to complete.
fn survives(service: &str, after: usize) {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight = Flight::start(&folder, &["--preset", "tiny", "--seed", "21"]);
    flight.wait_until("the keyframes", |flight| keyframes(&flight.folder).len() >= after);
    let killed = *flight.services().get(service).unwrap_or_else(|| panic!("{service} runs: {:?}", flight.services()));
    kill(killed, "KILL");
    flight.finish_well();
    assert_complete(&folder, service, 1);
}

fn assert_complete(folder: &Path, service: &str, restarts: u64) {
    assert_eq!(keyframes(folder), (0..6).collect::<Vec<u64>>());
    let metrics = metrics(folder);
    assert_eq!(metrics["mission"]["end_reason"], "complete", "{metrics:#}");
    assert_eq!(metrics["mission"]["collisions"], 0, "{metrics:#}");
    assert_eq!(metrics["mission"]["restarts"][service].as_u64(), Some(restarts), "{metrics:#}");
}

#[test]
fn a_mission_survives_px4_link() {
    survives("px4-link", 1);
}

#[test]
fn a_mission_survives_the_camera() {
    survives("camera", 2);
}

#[test]
fn a_mission_survives_the_trainer() {
    survives("trainer", 4);
}

#[test]
fn a_mission_survives_the_scorer() {
    survives("scorer", 3);
}

#[test]
fn a_mission_survives_the_planner() {
    survives("planner", 2);
}

#[test]
fn a_mission_survives_the_world() {
    survives("world", 3);
}

#[test]
fn a_mission_survives_the_keeper() {
    survives("keeper", 1);
}
