//! Services that stand still, are asked to end, or keep dying: the watchdog, stops of a while, a debugger's hold.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use common::watch::Watch;
use common::{Flight, journal, keyframes, kill, metrics, system_of, vantage};

fn start(folder: &Path, sets: &[&str]) -> Flight {
    let mut arguments = vec!["--preset", "tiny", "--seed", "21"];
    arguments.extend(sets.iter().flat_map(|set| ["--set", set]));
    Flight::start(folder, &arguments)
}

fn assert_complete(folder: &Path) {
    assert_eq!(keyframes(folder), (0..6).collect::<Vec<u64>>());
    let metrics = metrics(folder);
    assert_eq!(metrics["mission"]["end_reason"], "complete", "{metrics:#}");
    assert_eq!(metrics["mission"]["collisions"], 0, "{metrics:#}");
}

/// Each is stopped for good; the watchdog finds, reports and kills it.
#[test]
fn a_service_that_hangs_is_named_reported_killed_and_started_again() {
    const STOPS: [(usize, &str); 4] = [(1, "scorer"), (2, "world"), (3, "planner"), (4, "trainer")];
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight = start(&folder, &["launch.watchdog_s=3"]);
    for (after, service) in STOPS {
        flight.wait_until(service, |flight| {
            keyframes(&flight.folder).len() >= after && flight.services().contains_key(service)
        });
        let stopped = flight.services()[service];
        kill(stopped, "STOP");
        flight
            .wait_until("another process", |flight| flight.services().get(service).is_some_and(|pid| *pid != stopped));
    }
    let told = flight.terminal();
    flight.finish_well();
    assert_complete(&folder);
    for (_, service) in STOPS {
        assert!(
            told.contains(&format!("{service} has said nothing for 3 s: it is killed and started again")),
            "{told}"
        );
        assert_eq!(metrics(&folder)["mission"]["restarts"][service], 1);
        let reports: Vec<_> = std::fs::read_dir(folder.join("logs"))
            .expect("logs")
            .flatten()
            .filter(|entry| entry.file_name().to_string_lossy().starts_with(&format!("{service}-hung-")))
            .collect();
        let [report] = &reports[..] else { panic!("{service}: {} reports", reports.len()) };
        let report = std::fs::read_to_string(report.path()).expect("report");
        assert!(report.starts_with(&format!("{service}, pid ")) && report.contains("T (stopped)"), "{report}");
    }
}

/// As on a vehicle: short stops are ridden out, and the longest is ended by the watchdog.
#[test]
fn on_the_walls_clock_stops_of_a_while_are_ridden_out() {
    const STOPS: [(usize, &str, f64); 7] = [
        (0, "px4-link", 0.2),
        (1, "camera", 2.0),
        (2, "px4-link", 2.0),
        (3, "planner", 2.0),
        (3, "keeper", 0.2),
        (4, "launch", 2.0),
        (4, "trainer", 20.0),
    ];
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight = start(&folder, &["clock.mode=wall"]);
    let watch = Watch::begin(flight.pid());
    for (after, service, seconds) in STOPS {
        flight.wait_until(service, |flight| {
            let airborne = journal(&flight.folder).iter().any(|entry| entry["event"] == "airborne");
            airborne && keyframes(&flight.folder).len() >= after
        });
        let pid = if service == "launch" { flight.pid() } else { flight.services()[service] };
        kill(pid, "STOP");
        std::thread::sleep(Duration::from_secs_f64(seconds));
        kill(pid, "CONT");
    }
    let told = flight.terminal();
    flight.finish_well();
    assert_complete(&folder);
    let restarts = &metrics(&folder)["mission"]["restarts"];
    assert_eq!(restarts["trainer"], 1, "{told}");
    assert_eq!(
        restarts.as_object().map(|services| services.len()),
        Some(1),
        "nobody else was killed: {restarts}\n{told}"
    );
    let step_m = watch.look(|heard| heard.largest_step_m);
    assert!(step_m <= 0.3, "a setpoint jumped by {step_m} m");
}

/// SIGTERM to a service alone is no order to end the mission, but for those that fly.
#[test]
fn a_service_that_is_asked_to_end_is_started_again() {
    const ASKED: [(usize, &str); 5] = [(0, "keeper"), (1, "camera"), (2, "scorer"), (3, "world"), (4, "trainer")];
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight = start(&folder, &[]);
    for (after, service) in ASKED {
        flight.wait_until(service, |flight| {
            keyframes(&flight.folder).len() >= after && flight.services().contains_key(service)
        });
        if let Some(pid) = flight.services().get(service) {
            kill(*pid, "TERM");
        }
    }
    flight.finish_well();
    assert_complete(&folder);
}

/// Those that fly: the vehicle is brought home first, and then the mission goes on.
#[test]
fn who_flies_and_is_asked_to_end_lands_first_and_the_mission_goes_on() {
    for service in ["px4-link", "planner"] {
        let base = tempfile::tempdir().expect("folder");
        let folder = base.path().join("mission");
        let mut flight = start(&folder, &[]);
        flight.wait_until("the keyframes", |flight| keyframes(&flight.folder).len() >= 2);
        kill(flight.services()[service], "TERM");
        flight.finish_well();
        assert_complete(&folder);
        assert_eq!(metrics(&folder)["mission"]["restarts"][service], 1, "{service}");
    }
}

#[test]
fn a_crash_loop_ends_with_the_vehicle_on_the_ground_and_an_open_mission() {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight = start(&folder, &["launch.crash_limit=2", "launch.restart_delay_s=0.02"]);
    flight.wait_until("the keyframes", |flight| keyframes(&flight.folder).len() >= 2);
    for _ in 0..3 {
        flight.wait_until("the scorer", |flight| flight.services().contains_key("scorer"));
        let pid = flight.services()["scorer"];
        kill(pid, "KILL");
        flight.wait_until("its end", |flight| flight.services().get("scorer") != Some(&pid));
    }
    flight.wait_until("the word", |flight| {
        flight.terminal().contains("scorer died 3 times in a row: returning and landing")
    });
    let status = flight.finish();
    assert_eq!(status.code(), Some(1));
    assert!(journal(&folder).iter().all(|entry| entry["event"] != "over"), "the mission is open");
    let mut resume = vantage();
    resume.arg("resume").arg(&folder);
    Flight::spawn(&folder, resume).finish_well();
    assert_complete(&folder);
}

#[test]
fn a_dead_service_is_left_for_a_debugger_where_that_was_asked_for() {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight = start(&folder, &["launch.hold_on_fault=true"]);
    flight.wait_until("the keyframes", |flight| keyframes(&flight.folder).len() >= 2);
    let pid = flight.services()["trainer"];
    kill(pid, "KILL");
    flight.wait_until("the word", |flight| flight.terminal().contains("trainer died and is left as it is"));
    std::thread::sleep(Duration::from_secs(1));
    assert!(!flight.services().contains_key("trainer"), "it was not started again");
    // By hand, as the message says.
    let system = system_of(flight.pid());
    let mut by_hand = vantage()
        .args(["trainer", "--system", &system.name])
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("vantage starts");
    flight.wait_until("the end", |flight| journal(&flight.folder).iter().any(|entry| entry["event"] == "over"));
    kill(by_hand.id(), "TERM");
    by_hand.wait().expect("ended");
    flight.finish_well();
    assert_complete(&folder);
}
