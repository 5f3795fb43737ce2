//! One mission under kills.

use std::path::Path;
use std::time::{Duration, Instant};

use splatting::order::Random;

use crate::common::{Flight, journal, keyframes, kill, runs, system_files, vantage};
use crate::record::{Fault, Flown, Mission};
use crate::{Options, phase};

/// What may be killed; the simulator is the vehicle.
const SERVICES: [&str; 8] = ["px4-link", "camera", "trainer", "scorer", "planner", "keeper", "world", "launch"];
/// Longest wait for a new process, and for the services to end after launch.
const PATIENCE: Duration = Duration::from_secs(60);
/// Longest wait for a phase.
const PHASE_PATIENCE: Duration = Duration::from_secs(5);
/// Ids from here on are views of the prior, of which only the newest counts.
const PRIOR_IDS: u64 = 1_000_000;

/// Flies mission `index`.
pub fn fly(options: &Options, index: u64) -> Flown {
    let folder = options.out.join(format!("mission-{index:05}"));
    drop(std::fs::remove_dir_all(&folder));
    let before = system_files();
    let began = Instant::now();
    let mut random = Random::new(options.seed ^ index.wrapping_mul(0x9e37_79b9));
    let crash_limit = "launch.crash_limit=1000";
    let mut flight = Some(Flight::start(&folder, &["--preset", &options.preset, "--seed", "21", "--set", crash_limit]));
    let mut faults: Vec<Fault> = Vec::new();
    let mut error = String::new();
    for _ in 0..options.kills {
        let Some(flying) = flight.as_mut() else { break };
        await_a_phase(flying, &folder, &mut random);
        std::thread::sleep(Duration::from_millis(u64::from(random.below(options.pause_ms.max(1) as u32))));
        let services = flying.services();
        let service = match &options.service {
            Some(service) => service.as_str(),
            None => SERVICES[random.below(SERVICES.len() as u32) as usize],
        };
        let pid = if service == "launch" { Some(flying.pid()) } else { services.get(service).copied() };
        let Some(pid) = pid.filter(|pid| runs(*pid)) else { continue };
        let mut fault = Fault {
            mission: index,
            service: service.to_owned(),
            phase: phase::of(&folder).to_owned(),
            restart_ms: None,
        };
        let killed = Instant::now();
        kill(pid, "KILL");
        if service == "launch" {
            if let Some(flight) = flight.take() {
                let _killed = flight.finish();
            }
            while services.values().any(|pid| runs(*pid)) && killed.elapsed() < PATIENCE {
                std::thread::sleep(Duration::from_millis(20));
            }
            if services.values().any(|pid| runs(*pid)) {
                "services outlive launch by a minute".clone_into(&mut error);
            }
            // Killed before there was a mission, or after all was said: a user would look, and fly or be done.
            if folder.join("mission.toml").exists() {
                let mut resume = vantage();
                resume.arg("resume").arg(&folder);
                flight = Some(Flight::spawn(&folder, resume));
            }
        } else {
            fault.restart_ms = new_process(flying, service, pid, killed);
        }
        faults.push(fault);
    }
    if let Some(flight) = flight {
        let terminal = folder.with_extension("terminal.log");
        let status = flight.finish();
        if !status.success() {
            let text = std::fs::read_to_string(terminal).unwrap_or_default();
            error += &format!("{status}: {}", text.lines().last().unwrap_or_default());
        }
    }
    let leftovers = system_files().into_iter().filter(|path| !before.contains(path)).count();
    let mission = judge(index, &folder, leftovers, began.elapsed().as_secs_f64(), error);
    if mission.is_well() {
        drop(std::fs::remove_dir_all(&folder));
        drop(std::fs::remove_file(folder.with_extension("terminal.log")));
    }
    Flown { mission, faults }
}

/// Waits until the mission is in a phase that is drawn, so that short ones have their share; not for long, and not for one
/// that is over.
fn await_a_phase(flight: &Flight, folder: &Path, random: &mut Random) {
    let aim = random.below(phase::PHASES.len() as u32) as usize;
    let began = Instant::now();
    while began.elapsed() < PHASE_PATIENCE && runs(flight.pid()) {
        let now = phase::of(folder);
        if now == phase::PHASES[aim] || now == "shutdown" {
            break;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Milliseconds until the service has another process.
fn new_process(flight: &Flight, service: &str, old: u32, killed: Instant) -> Option<f64> {
    while killed.elapsed() < PATIENCE && runs(flight.pid()) {
        if flight.services().get(service).is_some_and(|&pid| pid != old && runs(pid)) {
            return Some(1e3 * killed.elapsed().as_secs_f64());
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    None
}

fn judge(index: u64, folder: &Path, leftovers: usize, wall_s: f64, error: String) -> Mission {
    let mut mission = Mission {
        mission: index,
        end_reason: String::new(),
        lost: 0,
        doubled: 0,
        psnr_db: None,
        clearance_m: None,
        collisions: 0,
        leftovers,
        wall_s,
        error,
    };
    if !folder.join("mission.toml").exists() {
        // Launch died before the mission was; there is nothing to lose.
        "complete".clone_into(&mut mission.end_reason);
        return mission;
    }
    let entries = journal(folder);
    let reason = entries.iter().rev().find(|entry| entry["event"] == "over").map(|entry| entry["reason"].clone());
    mission.end_reason = reason.and_then(|reason| Some(reason.as_str()?.to_owned())).unwrap_or_default();
    let there = keyframes(folder);
    let wanted = entries.iter().filter(|entry| entry["event"] == "captured").filter_map(|e| e["keyframe_id"].as_u64());
    let mut captured: Vec<u64> = wanted.filter(|id| *id < PRIOR_IDS).collect();
    let all = captured.len();
    captured.sort_unstable();
    captured.dedup();
    mission.doubled = all - captured.len();
    let dropped = entries.iter().filter(|entry| entry["event"] == "dropped").count();
    mission.lost = captured.iter().filter(|id| !there.contains(id)).count() + dropped;
    let text = std::fs::read_to_string(folder.join("report/metrics.json")).unwrap_or_default();
    match serde_json::from_str::<serde_json::Value>(&text) {
        Ok(metrics) => {
            mission.psnr_db = metrics["live"]["psnr_object_db"].as_f64();
            mission.clearance_m = metrics["mission"]["min_clearance_m"].as_f64();
            mission.collisions = metrics["mission"]["collisions"].as_u64().unwrap_or(0);
        }
        Err(error) => mission.error += &format!(" metrics.json: {error}"),
    }
    mission
}
