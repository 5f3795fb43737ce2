//! Recordings of real missions: complete, the same for the same seed, replayed to the same result, readable after a kill and
//! by other people's tools.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use common::{Flight, keyframes, kill, metrics, runs, vantage};
use recorder::recording::Recording;
use serde_json::Value;
use shared_types::messages::{MissionPhase, RoundStatus};

/// What a recording holds of a channel: header fields, and a checksum of the items.
type Told = BTreeMap<&'static str, Vec<(Value, u64)>>;

/// Fields that tell of processes and of the machine, and not of the mission.
const OF_THE_MACHINE: [&str; 9] =
    ["pid", "incarnation", "cpu_ns", "folder", "mission", "work", "clock_incarnation", "header_sequence", "rss_bytes"];
/// Channels whose messages are sent by the wall's clock, or are of processes.
const BY_THE_WALL: [&str; 6] = ["clock", "clock/grant", "health", "health/last", "control/request", "control/reply"];

fn fly(folder: &Path, sets: &[&str]) -> Flight {
    let mut arguments = vec!["--preset", "tiny", "--seed", "21", "--set", "recorder.enabled=true"];
    arguments.extend(["--set", "recorder.frames=false"]);
    arguments.extend(sets.iter().flat_map(|set| ["--set", set]));
    Flight::start(folder, &arguments)
}

/// Everything that the channels of the mission said until it was over: how soon after that everybody is told to leave, the
/// wall's clock decides.
fn told(path: &Path, wanted: impl Fn(&str) -> bool) -> Told {
    let mut recording = Recording::open(path).expect("a recording");
    let (mut told, mut asked, mut end_ns) = (Told::new(), BTreeSet::new(), u64::MAX);
    while let Some(message) = recording.next_message().expect("read") {
        if message.channel == "mission/state" && message.json().expect("whole")["phase"] == MissionPhase::Done.code() {
            end_ns = end_ns.min(message.sent_ns);
        }
        if message.sent_ns > end_ns {
            continue;
        }
        if BY_THE_WALL.contains(&message.channel) || !wanted(message.channel) {
            continue;
        }
        let mut json = message.json().expect("whole");
        let fields = json.as_object_mut().expect("an object");
        OF_THE_MACHINE.iter().for_each(|field| drop(fields.remove(*field)));
        let is_reply = message.channel.ends_with("/reply");
        if is_reply || message.channel.ends_with("/request") {
            // What is not answered is asked again after a while of the wall's clock, and then answered twice: who gets it
            // knows its id. How far a round is, is told as often as it is asked.
            fields.remove("sequence");
            let number = |field: &str| fields.get(field).and_then(Value::as_u64).unwrap_or_default();
            let (id, status) = (number("request_id"), if is_reply { number("status") } else { 0 });
            let progress =
                message.channel == "trainer/round/reply" && status == u64::from(RoundStatus::Progress.code());
            if progress || !asked.insert((message.channel, id, status)) {
                continue;
            }
        }
        if message.channel.starts_with("simulator/render/") {
            // Answered inside a tick and kept by nobody: the camera counts from its own birth.
            fields.remove("request_id");
        }
        let sum = message.items().iter().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
            (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3)
        });
        told.entry(message.channel).or_default().push((json, sum));
    }
    assert_eq!(recording.is_cut(), None, "{}", path.display());
    told
}

fn assert_equal(one: &Told, other: &Told) {
    assert_eq!(one.keys().collect::<Vec<_>>(), other.keys().collect::<Vec<_>>());
    for (channel, messages) in one {
        let others = &other[channel];
        for (at, (a, b)) in messages.iter().zip(others).enumerate() {
            let fields = |told: &(Value, u64)| told.0.as_object().cloned().unwrap_or_default();
            let other = fields(b);
            let differ: Vec<_> = fields(a).into_iter().filter(|(name, value)| other.get(name) != Some(value)).collect();
            assert!(differ.is_empty() && a.1 == b.1, "{channel}, message {at}: {differ:?} in {:?}", b.0["sent_ns"]);
        }
        assert_eq!(messages.len(), others.len(), "{channel}");
    }
}

fn run(arguments: &[&str]) -> Output {
    vantage().args(arguments).stdin(Stdio::null()).output().expect("vantage runs")
}

fn text(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

/// Record equals record, and record equals replay.
#[test]
fn the_same_seed_is_recorded_the_same_and_a_replay_gives_the_same_models_and_scores() {
    let base = tempfile::tempdir().expect("folder");
    let folders: Vec<PathBuf> = (0..2).map(|number| base.path().join(format!("mission-{number}"))).collect();
    for folder in &folders {
        let flight = fly(folder, &["recorder.complete=true", "mission.id=same"]);
        flight.finish_well();
        assert_eq!(metrics(folder)["mission"]["deterministic"], true, "no member was out");
    }
    let recordings: Vec<PathBuf> = folders.iter().map(|folder| folder.join("recording.mcap")).collect();
    let one = told(&recordings[0], |_| true);
    for channel in ["vehicle/state", "camera/keyframe", "model/snapshot", "scorer/score/reply", "simulator/truth"] {
        assert!(one.contains_key(channel), "{channel}: {:?}", one.keys());
    }
    assert_eq!(one["camera/keyframe"].len(), 6 + 2, "keyframes, and the views of the prior");
    assert_equal(&one, &told(&recordings[1], |_| true));

    let output = base.path().join("replayed");
    let replay =
        run(&["replay", text(&recordings[0]), "--services", "trainer,scorer", "--output", text(&output), "--record"]);
    assert!(replay.status.success(), "{}", String::from_utf8_lossy(&replay.stderr));
    let theirs = |channel: &str| ["trainer/round/reply", "model/snapshot", "scorer/score/reply"].contains(&channel);
    assert_equal(&told(&recordings[0], theirs), &told(&output.join("recording.mcap"), theirs));
    assert_eq!(keyframes(&output), keyframes(&folders[0]), "the trainer reads them from the folder");

    // From the middle: a state that was told before is known, and keyframes are there.
    let late = base.path().join("late");
    let replay = run(&["replay", text(&folders[0]), "--services", "scorer", "--from", "40", "--output", text(&late)]);
    assert!(replay.status.success(), "{}", String::from_utf8_lossy(&replay.stderr));
    assert_eq!(keyframes(&late), keyframes(&folders[0]));

    // Without the recording, a folder's keyframes and rounds are enough for a trainer.
    std::fs::remove_file(&recordings[0]).expect("removed");
    let of_folder = base.path().join("of-folder");
    let replay = run(&["replay", text(&folders[0]), "--services", "trainer", "--output", text(&of_folder)]);
    assert!(replay.status.success(), "{}", String::from_utf8_lossy(&replay.stderr));
    let models = |folder: &Path| {
        let rounds = std::fs::read_dir(folder.join("model/rounds")).into_iter().flatten().flatten();
        rounds
            .map(|entry| (entry.file_name(), std::fs::read(entry.path()).expect("a model")))
            .collect::<BTreeMap<_, _>>()
    };
    assert!(models(&folders[0]).len() >= 2 && models(&of_folder) == models(&folders[0]), "the same models");
}

#[test]
fn a_recorder_may_die_or_stand_still_and_the_mission_does_not_notice() {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    // At a speed at which there is time for a death in flight.
    let mut flight = fly(&folder, &["clock.speed=8", "recorder.chunk_mb=0.1"]);
    flight.wait_until("keyframes", |flight| keyframes(&flight.folder).len() >= 2);
    let first = flight.services()["recorder"];
    kill(first, "KILL");
    flight.wait_until("another", |flight| flight.services().get("recorder").is_some_and(|pid| *pid != first));
    let second = flight.services()["recorder"];
    flight.wait_until("its file", |flight| flight.folder.join("recording-2.mcap").exists());
    kill(second, "STOP");
    std::thread::sleep(Duration::from_secs(1));
    assert!(runs(second));
    kill(second, "CONT");
    flight.finish_well();
    let metrics = metrics(&folder);
    assert_eq!(metrics["mission"]["end_reason"], "complete", "{metrics:#}");
    assert_eq!(metrics["mission"]["restarts"]["recorder"], 1);
    // What the first wrote can be read, though it was never ended; the second's file is whole.
    let mut cut = Recording::open(&folder.join("recording.mcap")).expect("a recording");
    let mut messages = 0;
    while let Some(message) = cut.next_message().expect("read") {
        assert!(message.json().is_some());
        messages += 1;
    }
    assert!(cut.is_cut().is_some() && messages > 100, "{messages} messages");
    let second = told(&folder.join("recording-2.mcap"), |_| true);
    assert!(second["vehicle/state"].len() > 100);
}

#[test]
fn what_is_no_recording_is_refused_with_the_way_out() {
    let base = tempfile::tempdir().expect("folder");
    let file = |name: &str, bytes: &[u8]| {
        let path = base.path().join(name);
        std::fs::write(&path, bytes).expect("written");
        path
    };
    let mut foreign = Vec::new();
    mcap::Writer::new(std::io::Cursor::new(&mut foreign)).expect("an MCAP").finish().expect("whole");
    let cases = [
        (file("empty.mcap", b""), "not an MCAP file", 64),
        (file("text.mcap", b"this is no recording of anything at all"), "not an MCAP file", 64),
        (file("foreign.mcap", &foreign), "no recording of Vantage", 64),
        (base.path().join("missing.mcap"), "cannot be read", 69),
        (base.path().to_owned(), "holds no mission", 64),
    ];
    for (path, words, code) in cases {
        let output = run(&["replay", text(&path), "--services", "trainer"]);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{}: {said}", path.display());
        assert!(said.contains(words) && said.contains(text(&path)), "{said}");
    }
    let output = run(&["replay", "a.mcap", "--services", "px4-link"]);
    assert!(String::from_utf8_lossy(&output.stderr).contains("cannot be replayed; expected one of: camera"));
    assert_eq!(output.status.code(), Some(64));
}

/// The library of the format's makers opens it, and finds JSON that fits its schema and images.
#[test]
fn other_people_s_tools_read_it() {
    let Some(python) = std::env::var_os("VANTAGE_CLIENTS_PYTHON") else {
        eprintln!("skipped: other_people_s_tools_read_it (VANTAGE_CLIENTS_PYTHON is not set; see tests/clients)");
        return;
    };
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    fly(&folder, &[]).finish_well();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/clients/read_recording.py");
    let output = Command::new(python).arg(script).arg(folder.join("recording.mcap")).output().expect("python runs");
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{said}\n{}", String::from_utf8_lossy(&output.stderr));
}
