//! Others take the processor: every service but the vehicle itself at nice 19 on one core, which a program of nice 0 wants
//! for itself.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::process::{Child, Command, Stdio};
use std::time::Duration;

use common::watch::Watch;
use common::{Flight, journal, keyframes, metrics};
use rustix::process::{Pid, setpriority_process};
use rustix::thread::{CpuSet, sched_setaffinity};

/// How long the processor is taken: longer than the watchdog's patience.
const STOLEN: Duration = Duration::from_secs(14);

/// Every thread of a process, and what they will start, gets `nice` and `cpus`.
fn demote(pid: u32, nice: i32, cpus: &CpuSet) {
    let threads = std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    for thread in threads.filter_map(|entry| Pid::from_raw(entry.file_name().to_str()?.parse().ok()?)) {
        // A thread may have ended meanwhile; giving a better nice value back is not permitted to everybody.
        setpriority_process(Some(thread), nice).ok();
        sched_setaffinity(Some(thread), cpus).ok();
    }
}

/// A program that computes on one core until it is dropped.
struct Thief(Child);

impl Thief {
    fn on(cpus: &CpuSet) -> Self {
        let child =
            Command::new("sh").args(["-c", "while :; do :; done"]).stdin(Stdio::null()).spawn().expect("sh runs");
        let pid = Pid::from_child(&child);
        sched_setaffinity(Some(pid), cpus).expect("its own processor");
        Self(child)
    }
}

impl Drop for Thief {
    fn drop(&mut self) {
        drop(self.0.kill());
        drop(self.0.wait());
    }
}

/// On the wall's clock, as on a vehicle: setpoints come late or not at all, PX4 holds, who is silent for too long is killed
/// and started again; the mission goes on when the processor is back.
#[test]
fn a_mission_survives_the_loss_of_its_processor() {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight = Flight::start(&folder, &["--preset", "tiny", "--seed", "21", "--set", "clock.mode=wall"]);
    let watch = Watch::begin(flight.pid());
    flight.wait_until("the first keyframes", |flight| keyframes(&flight.folder).len() >= 2);
    let all = rustix::thread::sched_getaffinity(None).expect("processors");
    let mut one = CpuSet::new();
    one.set((0..CpuSet::MAX_CPU).find(|cpu| all.is_set(*cpu)).expect("a processor"));
    let victims = |flight: &Flight| {
        let services = flight.services().into_iter().filter(|(name, _)| name != "simulator");
        services.map(|(_, pid)| pid).chain([flight.pid()]).collect::<Vec<u32>>()
    };
    let thief = Thief::on(&one);
    victims(&flight).into_iter().for_each(|pid| demote(pid, 19, &one));
    std::thread::sleep(STOLEN);
    drop(thief);
    victims(&flight).into_iter().for_each(|pid| demote(pid, 0, &all));
    let told = flight.terminal();
    flight.finish_well();
    assert_eq!(keyframes(&folder), (0..6).collect::<Vec<u64>>(), "{told}");
    let metrics = metrics(&folder);
    assert_eq!(metrics["mission"]["end_reason"], "complete", "{told}\n{metrics:#}");
    assert_eq!(metrics["mission"]["collisions"], 0, "{metrics:#}");
    let mut captured: Vec<u64> = journal(&folder)
        .iter()
        .filter(|entry| entry["event"] == "captured")
        .filter_map(|entry| entry["keyframe_id"].as_u64())
        .filter(|id| *id < 6)
        .collect();
    captured.sort_unstable();
    assert_eq!(captured, (0..6).collect::<Vec<u64>>(), "each once");
    let step_m = watch.look(|heard| heard.largest_step_m);
    assert!(step_m <= 0.3, "a setpoint jumped by {step_m} m");
}
