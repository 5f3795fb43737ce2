//! The keeper holds every channel open, deletes files that killed processes left half-made, and reaps the dead.
//!
//! iceoryx2's data path survives any kill; its control path has instants in which a kill leaves a file half-made, and every
//! later start then waits for it for ever. A living keeper closes those holes: channels exist before anybody opens them,
//! and what is half-made for longer than any living process needs is removed. The keeper itself may die like the others:
//! nothing stops, and its successor opens everything anew.
//!
//! Two threads besides the loop, never one: reaping can hang on a half-made file until the janitor has deleted it.

#![forbid(unsafe_code)]

pub mod janitor;
mod ports;
mod roster;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use shared_types::bus::{Bus, Limits};
use shared_types::service::{Context, HealthReport, Service, ServiceError, Step, StopAnswer};
use shared_types::system::System;

use janitor::Janitor;
use ports::Ports;
use roster::Roster;

const JANITOR_PERIOD: Duration = Duration::from_millis(200);
/// How long the ports of a dead process may stay taken. Whoever opens a port cleans up as well, so a restart does not wait
/// for it; each look costs about a millisecond.
const REAPER_PERIOD: Duration = Duration::from_millis(200);

/// Begins to remove what was left half-made. Before anything else: joining the bus itself waits for ever on such a file,
/// and there is nobody but the keeper to remove it.
///
/// # Errors
/// When there is no thread to be had.
pub fn sweep(system: &System) -> anyhow::Result<Sweeping> {
    Sweeping::start(system)
}

/// Runs the keeper until it is asked to stop.
///
/// # Errors
/// When the bus cannot be joined, or a channel belongs to another version.
pub fn run(mut context: Context, janitor: Sweeping) -> anyhow::Result<()> {
    let reaper = Reaping::start(&context)?;
    let mut keeper =
        Keeper { ports: Ports::open(&context.bus)?, roster: Roster::default(), janitor, reaper, orphaned: false };
    context.run(&mut keeper)?;
    Ok(())
}

struct Keeper {
    ports: Ports,
    roster: Roster,
    janitor: Sweeping,
    reaper: Reaping,
    /// The supervisor is gone: leave after the last of the vehicle's processes.
    orphaned: bool,
}

impl Service for Keeper {
    fn step(&mut self, now_ns: u64) -> Result<Step, ServiceError> {
        let mut changed = false;
        while let Some(health) = self.ports.receive_health(now_ns)? {
            changed |= self.roster.note(health);
        }
        if changed {
            self.ports.publish_last(now_ns, self.roster.last())?;
        }
        if self.orphaned && !self.roster.vehicle_is_served() {
            return Ok(Step::Leave);
        }
        Ok(Step::Done)
    }

    fn orphaned(&mut self, _now_ns: u64) -> StopAnswer {
        self.orphaned = true;
        if self.roster.vehicle_is_served() { StopAnswer::Later } else { StopAnswer::Now }
    }

    fn period(&self) -> Duration {
        Duration::from_millis(200)
    }

    fn health(&self) -> HealthReport {
        HealthReport {
            received: self.janitor.removed.load(Ordering::Relaxed),
            sent: self.reaper.reaped.load(Ordering::Relaxed),
            ..HealthReport::running()
        }
    }
}

/// The janitor's thread; ends when dropped.
#[derive(Debug)]
pub struct Sweeping {
    removed: Arc<AtomicU64>,
    stop: Arc<AtomicBool>,
}

impl Sweeping {
    fn start(system: &System) -> anyhow::Result<Self> {
        let (removed, stop) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
        let (count, end) = (Arc::clone(&removed), Arc::clone(&stop));
        let mut janitor = Janitor::new(system);
        std::thread::Builder::new().name("janitor".to_owned()).spawn(move || {
            while !end.load(Ordering::Relaxed) {
                count.fetch_add(janitor.sweep(Instant::now()), Ordering::Relaxed);
                std::thread::sleep(JANITOR_PERIOD);
            }
        })?;
        Ok(Self { removed, stop })
    }
}

impl Drop for Sweeping {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

/// The reaper's thread, with a bus of its own; ends when dropped.
struct Reaping {
    reaped: Arc<AtomicU64>,
    stop: Arc<AtomicBool>,
}

impl Reaping {
    fn start(context: &Context) -> anyhow::Result<Self> {
        let (reaped, stop) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
        let (count, end) = (Arc::clone(&reaped), Arc::clone(&stop));
        let (system, limits) = (context.system.clone(), Limits::of(&context.config));
        let (name, incarnation) = (context.name, context.incarnation);
        // What a dead service left in shared memory is looked at with a debugger.
        let hold = context.config.launch.hold_on_fault;
        std::thread::Builder::new().name("reaper".to_owned()).spawn(move || {
            let bus = match Bus::open(&system, limits, name, incarnation, false) {
                Ok(bus) => bus,
                Err(error) => {
                    tracing::error!(%error, "nobody reaps the dead: the reaper cannot join the bus");
                    return;
                }
            };
            while !end.load(Ordering::Relaxed) {
                if !hold {
                    count.fetch_add(bus.reap_the_dead(), Ordering::Relaxed);
                }
                std::thread::sleep(REAPER_PERIOD);
            }
        })?;
        Ok(Self { reaped, stop })
    }
}

impl Drop for Reaping {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::OpenOptionsExt as _;

    #[test]
    fn sweeping_needs_no_bus() {
        let base = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
        let system = System::create(base.path(), "k", 0).expect("system");
        // What a process leaves that was killed between making and sizing its shared memory.
        let file = std::path::Path::new("/dev/shm").join(format!("{}x.dynamic", system.prefix));
        std::fs::OpenOptions::new().create_new(true).write(true).mode(0o200).open(&file).expect("made");
        let sweeping = sweep(&system).expect("a thread");
        let began = Instant::now();
        while file.exists() {
            assert!(began.elapsed() < Duration::from_secs(20), "never removed");
            std::thread::sleep(Duration::from_millis(20));
        }
        drop(sweeping);
        system.remove().expect("removed");
    }
}
