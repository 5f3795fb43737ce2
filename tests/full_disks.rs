//! Missions on a disk that fills up in flight, and on a machine with too little shared memory: the real binary in a mount
//! namespace with small file systems of its own. Where the machine permits no namespaces, the tests say so and pass.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use common::namespace::Namespace;
use common::{Flight, journal, keyframes, metrics};

const BINARY: &str = env!("CARGO_BIN_EXE_vantage");
const ROOM_BYTES: u64 = 64 << 20;

/// A mission of `tiny` on a small disk of its own.
struct OnSmallDisk {
    /// Before the namespace: its processes end first.
    flight: Flight,
    namespace: Namespace,
    disk: PathBuf,
    folder: PathBuf,
    base: tempfile::TempDir,
}

impl OnSmallDisk {
    fn start(arguments: &[&str]) -> Option<Self> {
        let base = tempfile::tempdir().expect("folder");
        let disk = base.path().join("disk");
        std::fs::create_dir(&disk).expect("made");
        let namespace = Namespace::with(&[(&disk, ROOM_BYTES)])?;
        let folder = disk.join("mission");
        let mut command = namespace.command(BINARY);
        command.args(["fly", "--preset", "tiny", "--seed", "21", "--output"]).arg(&folder).args(arguments);
        let seen = namespace.seen(&folder);
        let mut flight = Flight::spawn(&base.path().join("mission"), command);
        flight.folder = seen.clone();
        Some(Self { flight, namespace, disk, folder: seen, base })
    }

    fn wait_for_keyframes(&mut self, count: usize) {
        self.flight.wait_until("the keyframes", |flight| keyframes(&flight.folder).len() >= count);
    }

    /// Health of a service, as `vantage status` shows it: state and last error.
    fn health(&self, service: &str) -> (String, String) {
        let name = common::system_of(self.flight.pid()).name;
        let output = common::vantage().args(["status", "--json", "--system", &name]).output().expect("vantage runs");
        let reports: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
        let services = reports[0]["services"].as_array().cloned().unwrap_or_default();
        let row = services.iter().find(|row| row["service"] == service).cloned().unwrap_or_default();
        let text = |key: &str| row[key].as_str().unwrap_or_default().to_owned();
        (text("state"), text("last_error"))
    }

    /// Waits until a service says that there is no room; what it says.
    fn wait_for_complaint(&mut self, service: &str) -> String {
        let began = Instant::now();
        loop {
            let (state, said) = self.health(service);
            if state == "degraded" && said.contains("no room for") {
                return said;
            }
            let goes_on = common::runs(self.flight.pid()) && began.elapsed() < common::LONGEST;
            assert!(goes_on, "{service}: {state}: {said}\n{}", self.flight.terminal());
        }
    }
}

fn events(folder: &Path, event: &str) -> Vec<serde_json::Value> {
    journal(folder).into_iter().filter(|entry| entry["event"] == event).collect()
}

/// The journal finds no room: nothing new is done, the vehicle waits; with room again, the mission completes.
#[test]
fn a_mission_waits_for_a_full_disk_and_completes_once_there_is_room() {
    let Some(mut mission) = OnSmallDisk::start(&["--set", "planner.capture_attempts=10"]) else { return };
    mission.wait_for_keyframes(2);
    mission.namespace.fill(&mission.disk, 0);
    let said = mission.wait_for_complaint("planner");
    assert!(said.contains("bytes more of the journal") && said.contains("mission"), "{said}");
    let lines = journal(&mission.folder).len();
    std::thread::sleep(Duration::from_secs(3));
    assert_eq!(journal(&mission.folder).len(), lines, "nothing was decided meanwhile");
    mission.namespace.free(&mission.disk);
    println!("the planner said: {said}");
    wait_for_end(&mut mission);
    let folder = mission.folder.clone();
    assert_eq!(keyframes(&folder), (0..6).collect::<Vec<u64>>());
    let metrics = metrics(&folder);
    assert_eq!(metrics["mission"]["end_reason"], "complete", "{metrics:#}");
    assert_eq!(metrics["mission"]["collisions"], 0, "{metrics:#}");
    assert_eq!(metrics["mission"]["restarts"].as_object().map_or(0, |all| all.len()), 0, "nobody died: {metrics:#}");
}

fn wait_for_end(mission: &mut OnSmallDisk) {
    let launch = mission.flight.pid();
    let began = Instant::now();
    while common::runs(launch) {
        assert!(began.elapsed() < common::LONGEST, "{}", mission.flight.terminal());
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// No room comes: after its patience the vehicle comes home, and everything so far can be used and gone on with.
#[test]
fn a_mission_on_a_disk_that_stays_full_lands_and_is_resumed() {
    let Some(mut mission) =
        OnSmallDisk::start(&["--set", "planner.disk_patience_s=3", "--set", "planner.capture_attempts=10"])
    else {
        return;
    };
    mission.wait_for_keyframes(2);
    mission.namespace.fill(&mission.disk, 0);
    let said = mission.wait_for_complaint("planner");
    println!("the planner said: {said}");
    let began = Instant::now();
    wait_for_end(&mut mission);
    println!("on the ground and ended {:.0} s after the disk was full", began.elapsed().as_secs_f64());
    let told = mission.flight.terminal();
    assert!(
        told.contains("no room for") && told.contains("journal.jsonl") && told.contains("vantage resume"),
        "{told}"
    );
    let restarts = told.matches("planner ended").count();
    assert!(restarts <= 1, "it does not crash again and again: {told}");
    mission.namespace.free(&mission.disk);
    let taken = keyframes(&mission.folder);
    assert!(taken.len() >= 2, "{taken:?}");
    let inside = mission.disk.join("mission");
    let mut resume = mission.namespace.command(BINARY);
    resume.arg("resume").arg(&inside);
    let mut again = Flight::spawn(&mission.base.path().join("resumed"), resume);
    again.folder.clone_from(&mission.folder);
    again.finish_well();
    assert_eq!(keyframes(&mission.folder), (0..6).collect::<Vec<u64>>());
    let metrics = metrics(&mission.folder);
    assert_eq!(metrics["mission"]["end_reason"], "complete", "{metrics:#}");
    assert_eq!(metrics["mission"]["collisions"], 0, "{metrics:#}");
}

/// Room for lines of the journal, not for a keyframe: the camera says so, the planner tries again and goes on.
#[test]
fn a_keyframe_that_finds_no_room_is_tried_again() {
    let Some(mut mission) = OnSmallDisk::start(&["--set", "planner.capture_attempts=10"]) else { return };
    mission.wait_for_keyframes(2);
    mission.namespace.fill(&mission.disk, 24 << 10);
    let folder = mission.folder.clone();
    mission.flight.wait_until("a failed capture", |_| !events(&folder, "capture-failed").is_empty());
    let failed = events(&folder, "capture-failed");
    let why = failed[0]["why"].as_str().unwrap_or_default();
    println!("the journal says: {why}");
    assert!(why.contains("not stored: no room for") && why.contains("bytes of"), "{why}");
    mission.namespace.free(&mission.disk);
    wait_for_end(&mut mission);
    assert_eq!(keyframes(&folder), (0..6).collect::<Vec<u64>>(), "{}", mission.flight.terminal());
    assert_eq!(metrics(&folder)["mission"]["end_reason"], "complete");
}

/// Room for keyframes, not for a checkpoint: the round's end waits, and the mission completes once there is room.
#[test]
fn a_round_waits_for_room_for_its_checkpoint() {
    let Some(mut mission) = OnSmallDisk::start(&["--set", "planner.capture_attempts=10"]) else { return };
    mission.wait_for_keyframes(1);
    mission.namespace.fill(&mission.disk, 400 << 10);
    let said = mission.wait_for_complaint("trainer");
    println!("the trainer said: {said}");
    assert!(said.contains(".ckpt") && said.contains("bytes of"), "{said}");
    let folder = mission.folder.clone();
    mission.namespace.free(&mission.disk);
    wait_for_end(&mut mission);
    let metrics = metrics(&folder);
    assert_eq!(metrics["mission"]["end_reason"], "complete", "{metrics:#}\n{}", mission.flight.terminal());
    assert_eq!(metrics["mission"]["restarts"].as_object().map_or(0, |all| all.len()), 0, "nobody died: {metrics:#}");
}

#[test]
fn a_disk_that_is_too_small_is_refused_with_both_numbers() {
    let base = tempfile::tempdir().expect("folder");
    let disk = base.path().join("disk");
    std::fs::create_dir(&disk).expect("made");
    let Some(namespace) = Namespace::with(&[(&disk, 1 << 20)]) else { return };
    let mut command = namespace.command(BINARY);
    let output = command.args(["fly", "--preset", "tiny", "--output"]).arg(disk.join("m")).output().expect("runs");
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(69), "{told}");
    assert!(told.contains("1 MiB free, expected at least ") && told.contains("--output"), "{told}");
    assert_eq!(std::fs::read_dir(namespace.seen(&disk)).expect("read").count(), 0, "nothing was made");
}

/// Too small, and large enough but full: both are refused before anything is made, with what is there and what is needed.
#[test]
fn shared_memory_that_is_too_small_or_full_is_refused_with_both_numbers() {
    let shm = Path::new("/dev/shm");
    for (size, fill) in [(4 << 20, false), (512 << 20, true)] {
        let base = tempfile::tempdir().expect("folder");
        let Some(namespace) = Namespace::with(&[(shm, size)]) else { return };
        if fill {
            namespace.fill(shm, 3 << 20);
        }
        let mut command = namespace.command(BINARY);
        let folder = base.path().join("m");
        let output = command.args(["fly", "--preset", "tiny", "--output"]).arg(&folder).output().expect("runs");
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(69), "{told}");
        let free = if fill { "/dev/shm: 3 MiB free" } else { "/dev/shm: 4 MiB free" };
        assert!(told.contains(free) && told.contains("expected at least ") && told.contains("--shm-size"), "{told}");
        assert!(!folder.exists(), "nothing was made");
        println!("{}", told.trim());
    }
}
