//! A vehicle and a link that misbehave: packets lost, late, doubled, damaged and of strangers; a link that is gone; an estimator
//! that jumps and wanders; a battery, a fence and a pilot that end or interrupt a mission. All made by the simulator, in
//! mission time and by a seed.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::path::PathBuf;

use common::watch::Watch;
use common::{Flight, journal, keyframes, metrics, system_of, vantage};

/// A mission with faults, and what it left.
struct Flown {
    _base: tempfile::TempDir,
    folder: PathBuf,
    code: Option<i32>,
    told: String,
    largest_step_m: f64,
}

/// Flies `tiny` with faults of the simulator, and looks at its setpoints.
fn fly(faults: &[&str], sets: &[&str]) -> Flown {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut arguments = vec!["--preset", "tiny", "--seed", "21"];
    let list = format!("simulator.faults={faults:?}");
    for set in sets.iter().copied().chain([list.as_str()]) {
        arguments.extend(["--set", set]);
    }
    let flight = Flight::start(&folder, &arguments);
    let watch = Watch::begin(flight.pid());
    let log = folder.with_extension("terminal.log");
    let code = flight.finish().code();
    let largest_step_m = watch.look(|heard| heard.largest_step_m);
    let told = std::fs::read_to_string(log).expect("terminal");
    Flown { _base: base, folder, code, told, largest_step_m }
}

impl Flown {
    /// Complete with every keyframe, at its clearance, and no jump in the setpoints.
    fn is_complete(&self, faults: &[&str]) {
        self.is_safe(faults);
        assert_eq!(self.end(), "complete", "{faults:?}: {}", self.told);
        assert_eq!(keyframes(&self.folder), (0..6).collect::<Vec<u64>>(), "{faults:?}");
    }

    /// Ended early by a reason, with everything captured so far usable.
    fn ended_by(&self, reason: &str, faults: &[&str]) {
        self.is_safe(faults);
        assert_eq!(self.end(), reason, "{faults:?}: {}", self.told);
        let taken = keyframes(&self.folder).len();
        assert!((4..=6).contains(&taken), "{faults:?}: {taken} keyframes");
        assert!(self.folder.join("model/model.ply").exists(), "{faults:?}: no model");
    }

    fn is_safe(&self, faults: &[&str]) {
        assert_eq!(self.code, Some(0), "{faults:?}: {}", self.told);
        let metrics = metrics(&self.folder);
        assert_eq!(metrics["mission"]["collisions"], 0, "{faults:?}: {metrics:#}");
        let clearance_m = metrics["mission"]["min_clearance_m"].as_f64().expect("clearance");
        // The tips of the vehicle, and what an exact estimator is trusted with.
        assert!(clearance_m > 0.47, "{faults:?}: {clearance_m} m");
        assert!(self.largest_step_m <= 0.3, "{faults:?}: a setpoint jumped by {} m", self.largest_step_m);
    }

    fn end(&self) -> String {
        metrics(&self.folder)["mission"]["end_reason"].as_str().expect("a reason").to_owned()
    }

    fn psnr_db(&self) -> f64 {
        metrics(&self.folder)["live"]["psnr_object_db"].as_f64().expect("PSNR")
    }
}

#[test]
fn lost_packets() {
    for faults in [["loss 0.01"], ["loss 0.05"], ["loss 0.2"]] {
        fly(&faults, &[]).is_complete(&faults);
    }
}

#[test]
fn late_doubled_overtaken_and_damaged_packets() {
    for faults in [["delay 0.5", "loss 0"], ["duplicate 0.3", "reorder 0.3"], ["garbage 0.5", "duplicate 0.1"]] {
        fly(&faults, &[]).is_complete(&faults);
    }
}

#[test]
fn strangers_on_the_link() {
    let faults = ["second-autopilot at 3", "second-station at 3", "wrong-ids"];
    fly(&faults, &[]).is_complete(&faults);
}

#[test]
fn a_link_that_is_gone_for_a_while_is_waited_for() {
    for faults in [["gone at 45 for 0.5"], ["gone at 45 for 5"], ["heartbeat-loss at 40 for 8"]] {
        fly(&faults, &[]).is_complete(&faults);
    }
}

#[test]
fn a_link_that_is_gone_for_a_minute() {
    let faults = ["gone at 45 for 60"];
    fly(&faults, &[]).ended_by("link", &faults);
}

#[test]
fn an_estimator_that_jumps_moves_neither_object_nor_vehicle() {
    let calm = fly(&["loss 0"], &[]);
    let faults = ["jump 3 -1 0.5 at 22", "jump -2 2 0 at 46"];
    let flown = fly(&faults, &[]);
    flown.is_complete(&faults);
    assert!(flown.psnr_db() > calm.psnr_db() - 1.0, "{} dB, without jumps {} dB", flown.psnr_db(), calm.psnr_db());
}

#[test]
fn wander_like_gps() {
    let flown = fly(&["loss 0"], &["simulator.estimator=gnss"]);
    assert_eq!(flown.code, Some(0), "{}", flown.told);
    assert_eq!(metrics(&flown.folder)["mission"]["collisions"], 0);
    assert_eq!(flown.end(), "complete");
}

#[test]
fn a_battery_that_drops() {
    // Below its own threshold the mission returns; the autopilot returns by itself at the critical one, and lands in an
    // emergency.
    for faults in [["battery 0.14 at 36"], ["battery 0.06 at 36"], ["battery 0.04 at 36"]] {
        fly(&faults, &[]).ended_by("battery", &faults);
    }
}

#[test]
fn a_fence_that_is_crossed() {
    // Between the first views and the third; PX4 returns.
    let flown = fly(&["loss 0"], &["simulator.params.GF_MAX_HOR_DIST=7.6", "simulator.params.GF_ACTION=3"]);
    flown.is_safe(&[]);
    assert_eq!(flown.end(), "geofence", "{}", flown.told);
    assert!(flown.folder.join("model/model.ply").exists());
}

#[test]
fn a_fence_that_is_drawn_around_a_vehicle_outside_of_it() {
    // PX4 holds, and px4-link commands nothing until the operator's word; the battery would bring it home in the end.
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight =
        Flight::start(&folder, &["--preset", "tiny", "--seed", "21", "--set", "simulator.faults=[\"fence 2 at 36\"]"]);
    flight.wait_until("the fence", |flight| {
        journal(&flight.folder).iter().any(|entry| entry["event"] == "ending" || entry["event"] == "suspended")
    });
    let system = system_of(flight.pid());
    flight.wait_until("the way home", |flight| {
        let order = vantage().args(["go-on", "--system", &system.name]).output().expect("vantage runs");
        std::thread::sleep(std::time::Duration::from_millis(200));
        order.status.success() || journal(&flight.folder).iter().any(|entry| entry["event"] == "landed")
    });
    flight.finish_well();
    assert!(keyframes(&folder).len() >= 4);
}

#[test]
fn a_pilot_takes_over_and_gives_back() {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    // An operator's word takes real time, and a battery lasts for mission time: not as fast as it goes.
    let faults = ["--speed", "5", "--set", "simulator.faults=[\"pilot at 36 for 4\"]"];
    let mut flight = Flight::start(&folder, &[&["--preset", "tiny", "--seed", "21"], &faults[..]].concat());
    let suspended = |folder: &PathBuf| journal(folder).iter().any(|entry| entry["event"] == "suspended");
    flight.wait_until("the pilot", |flight| suspended(&flight.folder));
    let system = system_of(flight.pid());
    // Again and again: while the pilot flies it suspends anew, as for an operator who is too quick, and else it is refused.
    flight.wait_until("the way home", |flight| {
        vantage().args(["go-on", "--system", &system.name]).output().expect("vantage runs");
        std::thread::sleep(std::time::Duration::from_millis(200));
        journal(&flight.folder).iter().any(|entry| entry["event"] == "ending")
    });
    flight.finish_well();
    assert_eq!(keyframes(&folder), (0..6).collect::<Vec<u64>>());
    assert_eq!(metrics(&folder)["mission"]["end_reason"], "complete");
}

#[test]
fn a_fault_that_is_none_is_refused_before_the_mission() {
    let base = tempfile::tempdir().expect("folder");
    let output = vantage()
        .args(["fly", "--preset", "tiny", "--set", "simulator.faults=[\"loss 5\"]", "--output"])
        .arg(base.path().join("mission"))
        .output()
        .expect("vantage runs");
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(64), "{told}");
    assert!(told.contains("the share is 5, expected a number from 0 to 1"), "{told}");
    assert!(!base.path().join("mission").exists());
}
