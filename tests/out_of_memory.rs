//! The kernel itself kills the trainer for its memory: in a control group with next to none, where this user may make one.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use common::{Flight, keyframes, metrics, runs};

/// A control group whose processes may have two megabytes more than they have.
struct Group(PathBuf);

impl Group {
    /// `None` where there is no such thing, or it is not ours to make.
    fn new() -> Option<Self> {
        let name = format!("vantage-test-{}", std::process::id());
        // Version 1, then 2.
        let kinds = [("/sys/fs/cgroup/memory", "memory.limit_in_bytes"), ("/sys/fs/cgroup", "memory.max")];
        kinds.into_iter().find_map(|(root, limit)| {
            let path = Path::new(root).join(&name);
            fs::create_dir(&path).ok()?;
            let group = Self(path);
            // What a process had before it came counts where it was.
            fs::write(group.0.join(limit), "2097152").ok()?;
            group.0.join("cgroup.procs").exists().then_some(group)
        })
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        drop(fs::remove_dir(&self.0));
    }
}

#[test]
fn a_trainer_that_the_kernel_kills_for_its_memory_goes_on_with_less() {
    let Some(group) = Group::new() else {
        println!(
            "a_trainer_that_the_kernel_kills_for_its_memory_goes_on_with_less: skipped, no control group of memory can be made"
        );
        return;
    };
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight = Flight::start(&folder, &["--preset", "tiny", "--seed", "21", "--speed", "6"]);
    // The first round is over: the next one takes memory anew.
    flight.wait_until("the first model", |flight| flight.folder.join("model/rounds/00.ply").exists());
    let trainer = flight.services()["trainer"];
    fs::write(group.0.join("cgroup.procs"), trainer.to_string()).expect("moved");
    flight.wait_until("its end", |_| !runs(trainer));
    flight.finish_well();
    assert_eq!(keyframes(&folder), (0..6).collect::<Vec<u64>>());
    let metrics = metrics(&folder);
    assert_eq!(metrics["mission"]["end_reason"], "complete", "{metrics:#}");
    assert_eq!(metrics["mission"]["restarts"]["trainer"], 1, "{metrics:#}");
    let text = fs::read_to_string(folder.join("model/memory.json")).expect("remembered");
    let record: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    assert!(record["deaths"] == 1 && record["most"].is_u64(), "{text}");
    let log = fs::read_to_string(folder.join("logs/trainer.log")).expect("log");
    assert!(log.contains("the last trainer was killed for its memory"), "{log}");
}
