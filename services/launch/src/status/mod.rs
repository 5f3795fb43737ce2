//! `vantage status`: what runs, since when, memory, and what goes on on the channels. It looks at shared memory and `/proc`
//! only, and asks nobody.

mod channels;
mod words;

use std::time::{Duration, Instant};

use serde::Serialize;
use shared_types::ServiceName;
use shared_types::bus::{Bus, Limits};
use shared_types::channel::{HealthChannel, HealthLastChannel, MissionStateChannel};
use shared_types::config::{Layer, load};
use shared_types::messages::{Health, MissionState, ServiceState};
use shared_types::payload::unpack_text;
use shared_types::system::System;

use crate::cli::Status;
use crate::clock::monotonic_ns;
use crate::exit::Exit;
use crate::progress::Report;
use crate::reach::in_time;
use crate::{print, print_on, proc};
use channels::{ChannelRow, Channels};

/// Services send health once a second; a little more than that is listened for.
const LISTEN: Duration = Duration::from_millis(1_300);
/// Time to join a system's bus.
const PATIENCE: Duration = Duration::from_secs(5);

/// What is known of a service.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ServiceRow {
    /// Name.
    pub service: String,
    /// Process id.
    pub pid: u32,
    /// Whether the process runs.
    pub alive: bool,
    /// What it says it is doing.
    pub state: String,
    /// Seconds since its start.
    pub age_s: Option<f64>,
    /// Wall time since health was heard from it, seconds; absent when nothing came while listening.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub heard_s: Option<f64>,
    /// nice value.
    pub nice: Option<i32>,
    /// Proportional memory, megabytes.
    pub pss_mb: Option<f64>,
    /// The same by kind.
    pub memory_mb: Option<MemoryRow>,
    /// How often it was started again.
    pub restarts: u32,
    /// Median time of a turn of its loop, milliseconds.
    pub turn_p50_ms: f64,
    /// 99th percentile of that.
    pub turn_p99_ms: f64,
    /// Messages received, sent and lost.
    pub messages: [u64; 3],
    /// What went wrong last.
    pub last_error: String,
}

/// Proportional memory by kind, megabytes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MemoryRow {
    /// Heap and stacks.
    pub anonymous: f64,
    /// The program and mapped files.
    pub file: f64,
    /// Channels.
    pub shared: f64,
}

/// What is known of a system.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SystemReport {
    /// Name.
    pub system: String,
    /// Folder.
    pub folder: String,
    /// `runs`, `dead`, or `does not answer`.
    pub condition: &'static str,
    /// Supervisor's process id; 0: none.
    pub supervisor_pid: u32,
    /// Whether the supervisor runs.
    pub supervised: bool,
    /// What the mission says.
    pub mission: Option<String>,
    /// Services.
    pub services: Vec<ServiceRow>,
    /// Channels.
    pub channels: Vec<ChannelRow>,
}

/// `vantage status`.
///
/// # Errors
/// When there is no such system, or its bus cannot be joined.
pub fn run(arguments: &Status) -> anyhow::Result<Exit> {
    if !arguments.watch {
        return print(&text(arguments, &reports(arguments)?)?);
    }
    // Until Ctrl-C. A system that ends meanwhile is listed no more.
    loop {
        let text = text(arguments, &reports(arguments)?)?;
        let clear = if arguments.json { "" } else { CLEAR };
        if !print_on(&format!("{clear}{text}"))? {
            return Ok(Exit::Ok);
        }
    }
}

/// The terminal's cursor to its first line, and everything away.
const CLEAR: &str = "\u{1b}[H\u{1b}[2J\u{1b}[3J";

fn reports(arguments: &Status) -> anyhow::Result<Vec<SystemReport>> {
    let base = System::base_dir();
    let systems = match arguments.system.as_deref() {
        Some(name) => vec![System::find(&base, Some(name))?],
        None => System::list(&base),
    };
    if systems.is_empty() && arguments.watch {
        std::thread::sleep(LISTEN);
    }
    // Nothing runs in a dead system: joining it would only wait for what its dead left half-made.
    let look = |system: System| if system.is_alive() { look_at_in_time(system) } else { Ok(blank(&system, "dead")) };
    systems.into_iter().map(look).collect()
}

fn text(arguments: &Status, reports: &[SystemReport]) -> anyhow::Result<String> {
    Ok(if arguments.json {
        let json =
            if arguments.watch { serde_json::to_string(reports)? } else { serde_json::to_string_pretty(reports)? };
        json + "\n"
    } else if reports.is_empty() {
        format!("nothing runs: no system in {}\n", System::base_dir().display())
    } else {
        reports.iter().map(|report| words::describe(report, arguments.channels)).collect()
    })
}

fn look_at_in_time(system: System) -> anyhow::Result<SystemReport> {
    let unreachable = blank(&system, "does not answer");
    Ok(in_time("status", LISTEN + PATIENCE, move || look_at(&system))?.unwrap_or(unreachable))
}

/// What is known of a system without joining it.
/// Names and process ids of the services of a system that run.
///
/// # Errors
/// When its bus cannot be joined.
pub fn pids(system: System) -> anyhow::Result<Vec<(String, u32)>> {
    let report = look_at_in_time(system)?;
    Ok(report.services.into_iter().filter(|row| row.alive).map(|row| (row.service, row.pid)).collect())
}

fn blank(system: &System, condition: &'static str) -> SystemReport {
    SystemReport {
        system: system.name.clone(),
        folder: system.runtime_dir.display().to_string(),
        condition,
        supervisor_pid: system.supervisor_pid,
        supervised: system.supervisor_pid != 0 && proc::is_alive(system.supervisor_pid),
        mission: None,
        services: Vec::new(),
        channels: Vec::new(),
    }
}

fn look_at(system: &System) -> anyhow::Result<SystemReport> {
    let mut report = blank(system, "runs");
    let Ok(layer) = Layer::of_file(&system.config_path()) else { return Ok(report) };
    let config = load(&[layer])?;
    let bus = Bus::open(system, Limits::of(&config), ServiceName::Command, monotonic_ns(), false)?;
    let mut last = bus.subscriber::<HealthLastChannel>()?;
    let mut fresh = bus.subscriber::<HealthChannel>()?;
    let mut missions = bus.subscriber::<MissionStateChannel>()?;
    let mut channels = Channels::open(&bus)?;
    let mut known: Vec<(Health, Option<Instant>)> = Vec::new();
    let mut mission: Option<(u64, MissionState)> = None;
    let began = Instant::now();
    while began.elapsed() < LISTEN {
        if let Some(message) = last.latest(0)? {
            for health in message.items() {
                note(&mut known, health, None);
            }
        }
        while let Some(message) = fresh.receive(0)? {
            note(&mut known, message.header(), Some(Instant::now()));
        }
        if let Some(message) = missions.latest(0)? {
            mission = Some((message.stamp_ns(), *message.header()));
        }
        channels.listen()?;
        std::thread::sleep(Duration::from_millis(20));
    }
    known.sort_by_key(|(health, _)| health.service);
    report.services = known.iter().filter_map(|(health, heard)| row(health, *heard)).collect();
    report.channels = channels.rows(&bus)?;
    report.mission = mission.and_then(|(stamp_ns, state)| {
        let line = Report::of(&state, stamp_ns)?.line();
        Some(format!("{} {} in {}", unpack_text(&state.mission_id), line.trim_start(), unpack_text(&state.folder)))
    });
    Ok(report)
}

/// Keeps the newest life of each service.
fn note(known: &mut Vec<(Health, Option<Instant>)>, health: &Health, heard: Option<Instant>) {
    match known.iter_mut().find(|(other, _)| other.service == health.service) {
        Some((other, when)) if health.incarnation >= other.incarnation => {
            // Only the keeper counts restarts.
            let restarts = other.restarts.max(health.restarts);
            *other = Health { restarts, ..*health };
            *when = heard.or(*when);
        }
        Some(_) => {}
        None => known.push((*health, heard)),
    }
}

fn row(health: &Health, heard: Option<Instant>) -> Option<ServiceRow> {
    let service = ServiceName::from_code(health.service)?;
    if health.pid == 0 {
        return None;
    }
    #[expect(clippy::cast_precision_loss, reason = "figures for people")]
    let (megabytes, milliseconds) = (|bytes: u64| bytes as f64 / 1e6, |ns: u64| ns as f64 / 1e6);
    Some(ServiceRow {
        service: service.to_string(),
        pid: health.pid,
        alive: proc::is_alive(health.pid),
        state: ServiceState::from_code(health.state).map_or_else(|| "unknown".to_owned(), |state| state.to_string()),
        age_s: proc::age_s(health.pid),
        heard_s: heard.map(|when| when.elapsed().as_secs_f64()),
        nice: proc::nice(health.pid),
        pss_mb: proc::pss_bytes(health.pid).map(megabytes),
        memory_mb: proc::memory(health.pid).map(|memory| MemoryRow {
            anonymous: megabytes(memory.anonymous),
            file: megabytes(memory.file),
            shared: megabytes(memory.shared),
        }),
        restarts: health.restarts,
        turn_p50_ms: milliseconds(health.turn_p50_ns),
        turn_p99_ms: milliseconds(health.turn_p99_ns),
        messages: [health.received, health.sent, health.dropped],
        last_error: unpack_text(&health.last_error),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn health(service: ServiceName, incarnation: u64) -> Health {
        Health {
            service: service.code(),
            incarnation,
            pid: std::process::id(),
            state: ServiceState::Running.code(),
            ..Health::default()
        }
    }

    #[test]
    fn the_newest_life_of_each_service_counts() {
        let mut known = Vec::new();
        note(&mut known, &health(ServiceName::Camera, 5), None);
        note(&mut known, &health(ServiceName::Camera, 9), Some(Instant::now()));
        note(&mut known, &health(ServiceName::Camera, 7), None);
        note(&mut known, &health(ServiceName::World, 1), None);
        assert_eq!(known.len(), 2);
        assert_eq!(known[0].0.incarnation, 9);
        assert!(known[0].1.is_some());
    }

    #[test]
    fn a_row_tells_of_the_living_process_and_of_the_dead() {
        let row_here = row(&health(ServiceName::Camera, 1), Some(Instant::now())).expect("row");
        assert!(row_here.alive && row_here.pss_mb.is_some_and(|mb| mb > 0.1));
        let dead = Health { pid: u32::MAX, ..health(ServiceName::World, 1) };
        let row_dead = row(&dead, None).expect("row");
        assert!(!row_dead.alive && row_dead.pss_mb.is_none());
        let report = SystemReport {
            system: "s".into(),
            folder: "/f".into(),
            condition: "runs",
            supervisor_pid: 7,
            supervised: false,
            mission: None,
            services: vec![row_here, row_dead],
            channels: Vec::new(),
        };
        let system = System::create(tempfile::tempdir_in("/dev/shm").expect("tmpfs").path(), "d", 0).expect("made");
        assert!(words::describe(&blank(&system, "dead"), false).contains("doctor --clean"));
        let text = words::describe(&report, true);
        assert!(text.contains("world") && text.contains("gone") && text.contains("--clean"), "{text}");
    }
}
