//! Everything is started anew between two flights of a mission: the estimator puts its origin elsewhere, by metres. `vantage
//! resume` takes the prior's views again, finds the world, and goes on; where the object is not as it was, it says so.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::path::Path;

use common::{Flight, copy_folder, journal, keyframes, metrics, vantage};

const ORIGIN: &str = "simulator.origin_m=[1.3, -0.9, 0.5]";

/// A mission that lost its launch after three keyframes.
fn cut_off(base: &Path) -> std::path::PathBuf {
    let folder = base.join("mission");
    let mut flight = Flight::start(&folder, &["--preset", "tiny", "--seed", "21"]);
    flight.wait_until("the keyframes", |flight| keyframes(&flight.folder).len() >= 3);
    flight.lose_launch();
    folder
}

fn resumed(folder: &Path, sets: &[&str]) -> Flight {
    let mut resume = vantage();
    resume.arg("resume").arg(folder).args(sets.iter().flat_map(|set| ["--set", set]));
    Flight::spawn(folder, resume)
}

fn aligned(folder: &Path) -> Vec<f64> {
    let of = |entry: &serde_json::Value| (entry["event"] == "aligned").then(|| entry["residual_m"].as_f64()).flatten();
    journal(folder).iter().filter_map(of).collect()
}

#[test]
fn the_world_is_found_again_and_the_mission_completes() {
    let base = tempfile::tempdir().expect("folder");
    let folder = cut_off(base.path());
    let still = base.path().join("still");
    copy_folder(&folder, &still);
    let mut psnr_db = Vec::new();
    for (folder, sets) in [(&still, &[][..]), (&folder, &[ORIGIN][..])] {
        resumed(folder, sets).finish_well();
        assert_eq!(keyframes(folder), (0..6).collect::<Vec<u64>>());
        let metrics = metrics(folder);
        assert_eq!(metrics["mission"]["end_reason"], "complete", "{metrics:#}");
        assert_eq!(metrics["mission"]["collisions"], 0, "{metrics:#}");
        let residuals = aligned(folder);
        assert!(residuals.len() == 1 && residuals[0] < 0.05, "{residuals:?}");
        psnr_db.push(metrics["live"]["psnr_object_db"].as_f64().expect("dB"));
    }
    // Views of two flights make one model only where both are in one world.
    assert!(psnr_db[1] > psnr_db[0] - 1.0, "{psnr_db:?}");
}

#[test]
fn an_object_that_was_turned_is_refused_with_the_figure_and_the_way_out() {
    let base = tempfile::tempdir().expect("folder");
    let folder = cut_off(base.path());
    let config = folder.join("mission.toml");
    let text = std::fs::read_to_string(&config).expect("mission.toml");
    let turned = text.replacen("yaw_deg = 0.0", "yaw_deg = 90.0", 1);
    assert_ne!(turned, text, "{text}");
    std::fs::write(&config, turned).expect("written");
    let before = keyframes(&folder);
    let flight = resumed(&folder, &[ORIGIN]);
    let log = folder.with_extension("terminal.log");
    assert_eq!(flight.finish().code(), Some(1));
    let told = std::fs::read_to_string(log).expect("terminal");
    assert!(
        told.contains("object") && told.contains("expected at most 0.05") && told.contains("vantage resume"),
        "{told}"
    );
    assert_eq!(keyframes(&folder), before);
    assert!(journal(&folder).iter().all(|entry| entry["event"] != "over"), "the mission is open");
    // Turned back, it goes on.
    std::fs::write(&config, text).expect("written");
    resumed(&folder, &[]).finish_well();
    assert_eq!(metrics(&folder)["mission"]["end_reason"], "complete");
}

#[test]
fn a_key_that_a_mission_keeps_is_refused() {
    let base = tempfile::tempdir().expect("folder");
    let folder = cut_off(base.path());
    let output = vantage().arg("resume").arg(&folder).args(["--set", "planner.keyframes=9"]).output().expect("runs");
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(64), "{told}");
    assert!(told.contains("--set planner.keyframes=9: expected a key of another section"), "{told}");
}
