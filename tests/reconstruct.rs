//! `vantage reconstruct` on a mission that was flown for it: with kills, with any number of threads.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use common::{Flight, kill, metrics, vantage};

fn reconstruct(mission: &Path, out: &Path, arguments: &[&str]) -> Command {
    let mut command = vantage();
    command.arg("reconstruct").arg(mission).arg("--out").arg(out).args(arguments);
    command
}

fn run(mut command: Command) -> (Option<i32>, String) {
    let output = command.output().expect("vantage runs");
    let text = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    (output.status.code(), text)
}

fn checkpoints(out: &Path) -> usize {
    let names = fs::read_dir(out).into_iter().flatten().flatten().map(|entry| entry.file_name());
    names.filter(|name| name.to_string_lossy().ends_with(".ckpt")).count()
}

#[test]
fn a_mission_is_reconstructed_through_kills_with_the_same_bits() {
    let base = tempfile::tempdir().expect("folder");
    let mission = base.path().join("mission");
    Flight::start(&mission, &["--preset", "tiny", "--seed", "4"]).finish_well();
    let live = metrics(&mission);
    let arguments = ["--iterations", "600", "--eval-every", "300", "--hold-out", "6", "--sh-degree", "1"];
    let (whole, broken, single) = (base.path().join("whole"), base.path().join("broken"), base.path().join("single"));

    let (status, text) = run(reconstruct(&mission, &whole, &[&arguments[..], &["--json"]].concat()));
    assert_eq!(status, Some(0), "{text}");
    let after = metrics(&mission);
    let number = |a: &str, b: &str| after[a][b].as_f64().unwrap_or_else(|| panic!("{a}.{b} in {after:#}"));
    assert_eq!(after["offline"]["iterations"], 600);
    assert_eq!(after["offline"]["keyframes"], 5);
    assert!(number("offline", "psnr_object_db") > number("live", "psnr_init_db") + 1.0, "{after:#}");
    assert_eq!(after["live"], live["live"], "nothing else changes");
    let report: serde_json::Value =
        serde_json::from_slice(&fs::read(whole.join("metrics.json")).expect("metrics.json")).expect("JSON");
    assert_eq!(report["run"]["dataset"], "mission");
    assert_eq!(report["origin"], "depth images");
    let rows = report["evaluations"].as_array().expect("rows");
    let psnr = |row: usize| rows[row]["held_out_psnr_db"].as_f64().expect("held out");
    assert!(psnr(rows.len() - 1) > psnr(0) + 1.0, "{report:#}");
    assert_eq!(checkpoints(&whole), 0);

    assert_eq!(report["offline"]["psnr_object_db"], after["offline"]["psnr_object_db"]);

    // Killed between the last of training's files and the measuring: only that is made up for.
    let trained = fs::metadata(whole.join("model.ply")).and_then(|file| file.modified()).expect("model.ply");
    for path in [whole.join("metrics.json"), mission.join("report/metrics.json")] {
        let mut json: serde_json::Value = serde_json::from_slice(&fs::read(&path).expect("read")).expect("JSON");
        json.as_object_mut().expect("an object").remove("offline");
        fs::write(&path, json.to_string()).expect("written");
    }
    let (status, text) = run(reconstruct(&mission, &whole, &arguments));
    assert_eq!(status, Some(0), "{text}");
    assert_eq!(metrics(&mission)["offline"]["psnr_object_db"], after["offline"]["psnr_object_db"]);
    assert_eq!(fs::metadata(whole.join("model.ply")).and_then(|file| file.modified()).expect("model.ply"), trained);

    // Killed with SIGKILL, twice, each time after it wrote a checkpoint (at most every 50 ms, for this test).
    for kills in 1..=2 {
        let mut command =
            reconstruct(&mission, &broken, &[&arguments[..], &["--checkpoint-ms", "50", "--quiet"]].concat());
        let mut child = command.spawn().expect("vantage starts");
        let began = Instant::now();
        let newest = || {
            let names = fs::read_dir(&broken).into_iter().flatten().flatten().map(|entry| entry.file_name());
            // A file under work ends the same and begins otherwise.
            let whole = |name: &str| name.starts_with("checkpoint-") && name.ends_with(".ckpt");
            names.filter(|name| whole(&name.to_string_lossy())).max()
        };
        let first = newest();
        while newest() == first {
            assert!(child.try_wait().expect("waited").is_none(), "it ended before kill {kills}");
            assert!(began.elapsed() < Duration::from_secs(120), "no checkpoint");
            std::thread::sleep(Duration::from_millis(2));
        }
        kill(child.id(), "KILL");
        assert!(!child.wait().expect("waited").success());
        assert!(!broken.join("model.ply").exists());
    }
    let (status, text) = run(reconstruct(&mission, &broken, &arguments));
    assert_eq!(status, Some(0), "{text}");
    assert!(text.contains("going on from the checkpoint at iteration"), "{text}");
    let model = |out: &Path| fs::read(out.join("model.ply")).expect("model.ply");
    assert!(model(&broken) == model(&whole), "killed and unbroken runs differ");

    let (status, text) = run(reconstruct(&mission, &single, &[&arguments[..], &["--threads", "1"]].concat()));
    assert_eq!(status, Some(0), "{text}");
    assert!(model(&single) == model(&whole), "one thread and all of them differ");

    let (status, text) = run(reconstruct(&mission, &whole, &arguments));
    assert_eq!(status, Some(64), "{text}");
    assert!(text.contains("--overwrite"), "{text}");
}

#[test]
fn what_is_no_dataset_and_what_makes_no_sense_is_refused_with_its_exit_code() {
    let base = tempfile::tempdir().expect("folder");
    let (status, text) = run(reconstruct(base.path(), &base.path().join("out"), &[]));
    assert_eq!(status, Some(64), "{text}");
    assert!(text.contains("transforms.json") && text.contains("sparse/0"), "{text}");
    let (status, text) = run(reconstruct(base.path(), &base.path().join("out"), &["--sh-degree", "4"]));
    assert_eq!(status, Some(64), "{text}");
    assert!(text.contains("--sh-degree is 4"), "{text}");
    fs::write(base.path().join("transforms.json"), r#"{"fl_x": 1, "frames": [{"file_path": "a.png"}]}"#)
        .expect("written");
    let (status, text) = run(reconstruct(base.path(), &base.path().join("out"), &[]));
    assert_eq!(status, Some(69), "{text}");
    assert!(text.contains("a.png does not exist"), "{text}");
    fs::write(base.path().join("transforms.json"), r#"{"frames": [7]}"#).expect("written");
    assert_eq!(run(reconstruct(base.path(), &base.path().join("out"), &[])).0, Some(1));
}
