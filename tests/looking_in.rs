//! Looking into a mission that flies: status, tap and log levels, with no effect on it.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::path::Path;
use std::process::{Output, Stdio};

use common::{Flight, keyframes, kill, metrics, runs, system_of, vantage};
use serde_json::Value;

fn run(arguments: &[&str]) -> Output {
    vantage().args(arguments).stdin(Stdio::null()).output().expect("vantage runs")
}

fn said(output: &Output) -> (String, String) {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (text(&output.stdout), text(&output.stderr))
}

fn start(folder: &Path, sets: &[&str]) -> Flight {
    // Slow enough to be looked at.
    let mut arguments = vec!["--preset", "tiny", "--seed", "21", "--speed", "4"];
    arguments.extend(sets.iter().flat_map(|set| ["--set", set]));
    Flight::start(folder, &arguments)
}

#[test]
fn a_mission_is_looked_into_and_does_not_notice() {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight = start(&folder, &[]);
    flight.wait_until("the first keyframe", |flight| !keyframes(&flight.folder).is_empty());
    let name = system_of(flight.pid()).name;

    let (text, errors) = said(&run(&["status", "--system", &name, "--json"]));
    let reports: Value = serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}\n{errors}"));
    let report = &reports[0];
    let services = report["services"].as_array().expect("services");
    assert_eq!(services.len(), 8, "{text}");
    for service in services {
        assert_eq!(service["alive"], true, "{service}");
        let memory = &service["memory_mb"];
        assert!(memory["anonymous"].as_f64().is_some_and(|mb| mb > 0.1) && memory["shared"].is_f64(), "{service}");
        assert!(service["turn_p50_ms"].as_f64() <= service["turn_p99_ms"].as_f64(), "{service}");
    }
    let channels = report["channels"].as_array().expect("channels");
    let channel = |name: &str| channels.iter().find(|row| row["channel"] == name).expect("the channel").clone();
    let state = channel("vehicle/state");
    // 50 a second of mission time, four of which pass in one of the wall's.
    assert!(state["rate_hz"].as_f64().is_some_and(|rate| rate > 50.0 && rate < 400.0), "{state}");
    assert!(state["publishers"] == 1 && state["subscribers"].as_u64().is_some_and(|count| count >= 3), "{state}");
    assert!(state["segment_bytes"].as_u64().is_some_and(|bytes| bytes > 10_000), "{state}");
    let (people, _) = said(&run(&["status", "--system", &name, "--channels"]));
    assert!(people.contains("vehicle/state") && people.contains("px4-link"), "{people}");

    let (text, errors) = said(&run(&["tap", "vehicle/state", "--system", &name, "--json", "--count", "3"]));
    let stamps: Vec<u64> = text
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).expect("JSON")["stamp_ns"].as_u64().expect("a stamp"))
        .collect();
    assert!(stamps.len() == 3 && stamps.is_sorted(), "{text}{errors}");
    let (text, _) = said(&run(&["tap", "planner/alive", "--system", &name, "--count", "1"]));
    assert!(text.contains("planner/alive planner"), "{text}");

    let (text, errors) = said(&run(&["log", "planner", "debug", "--system", &name]));
    assert!(text.contains("planner at debug"), "{text}{errors}");
    let (text, _) = said(&run(&["log", "all", "info", "--system", &name]));
    assert!(text.contains("px4-link") && text.contains("world"), "{text}");

    let pictures = base.path().join("pictures");
    let to = pictures.to_str().expect("UTF-8");
    let tapped = run(&["tap", "camera/keyframe", "--system", &name, "--png", to, "--count", "1"]);
    assert!(tapped.status.success(), "{}", said(&tapped).1);
    let names: Vec<String> = std::fs::read_dir(&pictures)
        .expect("pictures")
        .flatten()
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .collect();
    assert!(names.len() == 2 && names.iter().any(|name| name.ends_with("-rgb.png")), "{names:?}");

    flight.finish_well();
    let metrics = metrics(&folder);
    assert_eq!(metrics["mission"]["deterministic"], true, "nobody noticed");
    assert_eq!(metrics["mission"]["end_reason"], "complete");
}

/// What the dead said last is kept, by the keeper while it lives.
#[test]
fn status_works_when_half_of_the_services_are_dead() {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight = start(&folder, &["launch.hold_on_fault=true"]);
    flight.wait_until("the first keyframe", |flight| !keyframes(&flight.folder).is_empty());
    let name = system_of(flight.pid()).name;
    let services = flight.services();
    let dead = ["scorer", "trainer", "world", "camera"];
    for service in dead {
        kill(services[service], "KILL");
    }
    flight.wait_until("their end", |_| dead.iter().all(|service| !runs(services[*service])));
    let (text, errors) = said(&run(&["status", "--system", &name, "--json"]));
    let reports: Value = serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}\n{errors}"));
    let rows = reports[0]["services"].as_array().expect("services");
    assert_eq!(rows.len(), 8, "{text}");
    for row in rows {
        let gone = dead.iter().any(|service| row["service"] == *service);
        assert_eq!(row["alive"], !gone, "{row}");
    }

    // Nor is anybody drawn who does not run, or without what draws.
    let refused = run(&["profile", "scorer", "--system", &name]);
    assert!(refused.status.code() == Some(69) && said(&refused).1.contains("expected one of: keeper"), "{refused:?}");
    let without = vantage().args(["profile", "planner", "--system", &name]).env("PATH", "").output().expect("runs");
    assert!(without.status.code() == Some(69) && said(&without).1.contains("linux-perf"), "{without:?}");
}

#[test]
fn what_is_not_there_is_named() {
    for (arguments, words, code) in [
        (vec!["log", "autopilot", "debug"], "expected all, or one of: keeper", 64),
        (vec!["log", "trainer", "loud"], "invalid value 'loud'", 64),
        (vec!["tap", "vehicle/thoughts"], "expected one of: vehicle/state", 64),
        (vec!["tap", "health", "--system", "nowhere"], "nowhere", 69),
    ] {
        let output = run(&arguments);
        let (_, errors) = said(&output);
        assert!(output.status.code() == Some(code) && errors.contains(words), "{arguments:?}: {errors}");
    }
}
