//! Kills each service once in flight with SIGKILL: the mission completes with every keyframe exactly once. Kills launch:
//! the vehicle comes home without it, and `vantage resume` completes the mission.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use common::{Flight, journal, keyframes, kill, metrics, runs, system_of, vantage};

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

/// One after the other, in the phases that a mission goes through.
#[test]
fn a_mission_survives_all_of_them() {
    const KILLS: [(usize, &str); 7] =
        [(0, "keeper"), (1, "camera"), (2, "px4-link"), (3, "world"), (4, "scorer"), (4, "trainer"), (5, "planner")];
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight = Flight::start(&folder, &["--preset", "tiny", "--seed", "21"]);
    for (after, service) in KILLS {
        flight.wait_until(service, |flight| {
            keyframes(&flight.folder).len() >= after && flight.services().contains_key(service)
        });
        if let Some(pid) = flight.services().get(service) {
            kill(*pid, "KILL");
        }
    }
    flight.finish_well();
    for (_, service) in KILLS {
        assert_complete(&folder, service, 1);
    }
}

#[test]
fn a_mission_survives_launch() {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight = Flight::start(&folder, &["--preset", "tiny", "--seed", "21"]);
    flight.wait_until("the keyframes", |flight| keyframes(&flight.folder).len() >= 2);
    let system = system_of(flight.pid());
    flight.lose_launch();
    let log = std::fs::read_to_string(folder.join("logs/px4-link.log")).expect("log");
    assert!(log.contains("in the air: returning and landing before leaving"), "{log}");
    assert!(!log.contains("the mission clock is gone"), "px4-link left before the vehicle had landed: {log}");
    let ended = journal(&folder).iter().any(|entry| entry["event"] == "ending" || entry["event"] == "over");
    assert!(!ended, "nothing ends the mission but its user");
    // The last service to end has removed it.
    assert!(!system.runtime_dir.exists() && system.shared_memory_files().is_empty());

    let mut resume = vantage();
    resume.arg("resume").arg(&folder);
    Flight::spawn(&folder, resume).finish_well();
    assert_eq!(keyframes(&folder), (0..6).collect::<Vec<u64>>());
    let metrics = metrics(&folder);
    assert_eq!(metrics["mission"]["end_reason"], "complete", "{metrics:#}");
    assert_eq!(metrics["mission"]["collisions"], 0, "{metrics:#}");
}

/// SIGABRT is how a process ends that is refused memory.
#[test]
fn a_trainer_that_died_of_its_memory_holds_the_model_smaller_and_says_so() {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight = Flight::start(&folder, &["--preset", "tiny", "--seed", "21"]);
    let done = |folder: &Path| journal(folder).iter().any(|entry| entry["event"] == "round-done");
    flight.wait_until("a round", |flight| done(&flight.folder));
    kill(flight.services()["trainer"], "ABRT");
    flight.finish_well();
    assert_complete(&folder, "trainer", 1);
    let text = std::fs::read(folder.join("model/memory.json")).expect("memory.json");
    let record: serde_json::Value = serde_json::from_slice(&text).expect("JSON");
    let most = record["most"].as_u64().expect("the new limit");
    assert_eq!(record["deaths"], 1);
    let log = std::fs::read_to_string(folder.join("logs/trainer.log")).expect("log");
    assert!(log.contains("the last trainer was killed for its memory"), "{log}");
    let count = metrics(&folder)["live"]["gaussians"].as_u64().expect("Gaussians");
    assert!(count <= most, "{count} of at most {most}");
}

#[test]
fn a_terminal_that_hangs_up_does_not_end_the_flight() {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut child = vantage()
        .args(["fly", "--preset", "tiny", "--seed", "21", "--output"])
        .arg(&folder)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .expect("vantage starts");
    // From now on every line of progress fails.
    drop(child.stderr.take());
    let began = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().expect("waited") {
            break status;
        }
        if began.elapsed() > common::LONGEST {
            child.kill().expect("killed");
        }
        std::thread::sleep(Duration::from_millis(50));
    };
    assert!(status.success(), "{status}");
    assert_eq!(keyframes(&folder), (0..6).collect::<Vec<u64>>());
}

#[test]
fn an_interrupt_before_the_takeoff_is_not_forgotten() {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight = Flight::start(&folder, &["--preset", "tiny", "--seed", "21"]);
    flight.wait_until("the planner", |flight| flight.services().contains_key("planner"));
    let (services, began) = (flight.services(), Instant::now());
    kill(flight.pid(), "INT");
    let status = flight.finish();
    assert_eq!(status.code(), Some(1), "{status}");
    assert!(began.elapsed() < Duration::from_secs(30), "{:?}", began.elapsed());
    assert!(services.values().all(|pid| !runs(*pid)));
    assert!(!journal(&folder).iter().any(|entry| entry["event"] == "airborne"), "it did not fly");
}
