//! Mission folders as a loss of power leaves them, at moments of a mission from its first line to its last, each with what
//! was being written then torn in a way of its own: `vantage evaluate` measures them or says what is missing, and
//! `vantage resume` completes the mission.
//!
//! Where a write may be cut, and what is found then, is tried exhaustively by the tests of the crates that write; here are
//! the real binary and whole folders.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::collections::BTreeSet;
use std::fs;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::path::{Path, PathBuf};

use common::{Flight, copy_folder, frozen, journal, keyframes, metrics, vantage};

/// What was being written when the power went.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Torn {
    /// Nothing.
    Nothing,
    /// The next line of the journal, to its half.
    Line,
    /// The next line of the journal: its length is there, its bytes are not.
    Zeros,
    /// The next keyframe, in its folder aside.
    Keyframe,
    /// A checkpoint, aside.
    Checkpoint,
    /// The newest checkpoint within a round is damaged.
    RottenCheckpoint,
    /// A round's model: its checkpoint is there.
    Model,
    /// `mission.toml` aside, and the report.
    Report,
}

const ALL: [Torn; 8] = [
    Torn::Nothing,
    Torn::Line,
    Torn::Zeros,
    Torn::Keyframe,
    Torn::Checkpoint,
    Torn::RottenCheckpoint,
    Torn::Model,
    Torn::Report,
];

/// A name aside of a writer that lives no more: no process has so high a number.
fn aside(name: &str) -> String {
    format!(".tmp-4194305-7-0-{name}")
}

/// Tears a folder; `whole` is the mission as it went on. False where there is nothing of that kind to be torn.
fn tear(folder: &Path, torn: Torn, whole: &Path) -> bool {
    match torn {
        Torn::Nothing => true,
        Torn::Line | Torn::Zeros => {
            let path = folder.join("journal.jsonl");
            let mut bytes = fs::read(&path).unwrap_or_default();
            let all = fs::read(whole.join("journal.jsonl")).expect("the journal");
            let Some(next) = all.get(bytes.len()..).filter(|rest| !rest.is_empty()) else { return false };
            let line = &next[..next.iter().position(|byte| *byte == b'\n').map_or(next.len(), |end| end + 1)];
            match torn {
                Torn::Line => bytes.extend_from_slice(&line[..line.len() / 2]),
                _ => bytes.resize(bytes.len() + line.len(), 0),
            }
            fs::write(path, bytes).is_ok()
        }
        Torn::Keyframe => {
            let next = keyframes(folder).len();
            let from = whole.join(format!("keyframes/{next:06}"));
            let to = folder.join("keyframes").join(aside(&format!("{next:06}")));
            let Ok(rgb) = fs::read(from.join("rgb.png")) else { return false };
            fs::create_dir(&to).expect("aside");
            fs::write(to.join("rgb.png"), rgb).expect("whole");
            fs::write(to.join("depth.png"), b"").expect("empty");
            true
        }
        Torn::Checkpoint => {
            let Some(newest) = newest_checkpoint(whole, "") else { return false };
            let bytes = fs::read(&newest).expect("read");
            let name = newest.file_name().expect("name").to_string_lossy().into_owned();
            fs::write(folder.join("model").join(aside(&name)), &bytes[..bytes.len() / 3]).is_ok()
        }
        Torn::RottenCheckpoint => {
            let Some(newest) = newest_checkpoint(folder, "-live") else { return false };
            let mut bytes = fs::read(&newest).expect("read");
            let middle = bytes.len() / 2;
            bytes.truncate(middle);
            fs::write(newest, bytes).is_ok()
        }
        Torn::Model => fs::remove_file(folder.join("model/model.ply")).is_ok(),
        Torn::Report => {
            let config = fs::read(folder.join("mission.toml")).expect("mission.toml");
            fs::write(folder.join(aside("mission.toml")), &config[..config.len() / 2]).expect("written");
            fs::remove_file(folder.join("report/metrics.json")).ok();
            let track = fs::read(whole.join("report/track.csv")).expect("the track");
            fs::write(folder.join("report/track.csv"), &track[..track.len() / 2 + 3]).is_ok()
        }
    }
}

fn newest_checkpoint(mission: &Path, kind: &str) -> Option<PathBuf> {
    let entries = fs::read_dir(mission.join("model")).ok()?;
    let name = |path: &PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| name(path).starts_with("checkpoint-") && name(path).ends_with(&format!("{kind}.ckpt")))
        .max()
}

fn sum_of(folder: &Path) -> u64 {
    let mut files: Vec<PathBuf> = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).expect("read").flatten() {
            if entry.path().is_dir() { folders.push(entry.path()) } else { files.push(entry.path()) }
        }
    }
    files.sort();
    let mut hasher = DefaultHasher::new();
    for file in files.iter().filter(|file| !file.components().any(|part| part.as_os_str() == "logs")) {
        (file.strip_prefix(folder).expect("inside"), fs::read(file).expect("read")).hash(&mut hasher);
    }
    hasher.finish()
}

/// A mission that was frozen at moments of its flight: a folder for each, and the whole.
struct Mission {
    _base: tempfile::TempDir,
    moments: Vec<PathBuf>,
    whole: PathBuf,
}

fn flown() -> Mission {
    let base = tempfile::tempdir().expect("folder");
    let whole = base.path().join("mission");
    let mut flight = Flight::start(&whole, &["--preset", "tiny", "--seed", "21"]);
    let mut moments = Vec::new();
    // By lines of the journal, which tell where a mission is.
    for lines in [2, 5, 9, 13, 17, 21, 25, 29, 33, 38] {
        flight.wait_until("the lines", |flight| journal_lines(&flight.folder) >= lines);
        let moment = base.path().join(format!("moment-{lines}"));
        frozen(&flight, || copy_folder(&whole, &moment));
        moments.push(moment);
    }
    flight.finish_well();
    moments.push(whole.clone());
    Mission { _base: base, moments, whole }
}

fn journal_lines(folder: &Path) -> usize {
    fs::read(folder.join("journal.jsonl")).map_or(0, |bytes| bytes.iter().filter(|byte| **byte == b'\n').count())
}

/// Cuts a mission in all ways, and goes on with every `every`-th of the folders that are not over.
fn go_on_after_cuts(every: usize) {
    let mission = flown();
    let place = tempfile::tempdir().expect("folder");
    let (mut seen, mut measured, mut refused, mut resumed, mut number) = (BTreeSet::new(), 0, 0, 0, 0);
    for moment in &mission.moments {
        for torn in ALL {
            let folder = place.path().join("m");
            copy_folder(moment, &folder);
            let what = format!("{torn:?} at {}", moment.file_name().expect("name").to_string_lossy());
            if tear(&folder, torn, &mission.whole) && seen.insert(sum_of(&folder)) {
                number += 1;
                if evaluates(&folder, &what) {
                    measured += 1
                } else {
                    refused += 1
                }
                let over = journal(&mission.whole).len() == journal_lines(&folder);
                if number % every == 0 && !over {
                    completes(&folder, &what);
                    resumed += 1;
                }
            }
            fs::remove_dir_all(&folder).expect("removed");
        }
    }
    println!(
        "{} distinct outcomes at {} moments: {measured} measured, {refused} refused with the way out, {resumed} resumed, all \
         complete",
        seen.len(),
        mission.moments.len()
    );
    assert!(seen.len() >= 50, "{}", seen.len());
}

/// `vantage evaluate`: true where it measured; else it must say that there is no model yet, and what to do.
fn evaluates(folder: &Path, what: &str) -> bool {
    let has_model = folder.join("model/model.ply").exists();
    let output = vantage().arg("evaluate").arg(folder).arg("--json").output().expect("vantage runs");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.success(), has_model, "{what}: {errors}");
    if has_model {
        let figures: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
        assert!(figures["live"]["psnr_object_db"].as_f64().is_some_and(|db| db > 15.0), "{what}: {figures:#}");
    } else {
        assert_eq!(output.status.code(), Some(1), "{what}: {errors}");
        assert!(errors.contains("model.ply") && errors.contains("vantage resume"), "{what}: {errors}");
    }
    has_model
}

/// `vantage resume`: the mission completes, with each keyframe once.
fn completes(folder: &Path, what: &str) {
    println!("resuming: {what}");
    let mut resume = vantage();
    resume.arg("resume").arg(folder);
    Flight::spawn(folder, resume).finish_well();
    assert_eq!(keyframes(folder), (0..6).collect::<Vec<u64>>(), "{what}");
    let metrics = metrics(folder);
    assert_eq!(metrics["mission"]["end_reason"], "complete", "{what}: {metrics:#}");
    assert_eq!(metrics["mission"]["collisions"], 0, "{what}: {metrics:#}");
    let events = journal(folder);
    assert_eq!(events.iter().filter(|entry| entry["event"] == "over").count(), 1, "{what}");
    let captured: Vec<u64> = events
        .iter()
        .filter(|entry| entry["event"] == "captured")
        .filter_map(|entry| entry["keyframe_id"].as_u64())
        .filter(|id| *id < 6)
        .collect();
    assert_eq!(captured.iter().collect::<BTreeSet<_>>().len(), captured.len(), "{what}: {captured:?}");
    for place in ["", "keyframes", "model", "report", "prior"] {
        let left = fs::read_dir(folder.join(place)).expect("read").flatten();
        let left: Vec<_> = left.filter(|entry| entry.file_name().to_string_lossy().starts_with(".tmp-")).collect();
        assert!(left.is_empty(), "{what}: {left:?}");
    }
}

#[test]
fn folders_that_a_cut_left_are_measured_and_resumed() {
    go_on_after_cuts(14);
}

/// cargo test --release --test power_cuts -- --ignored --nocapture
#[test]
#[ignore = "takes minutes: goes on with every outcome"]
fn every_folder_that_a_cut_left_is_resumed() {
    go_on_after_cuts(1);
}
