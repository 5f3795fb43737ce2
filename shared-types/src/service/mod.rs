//! The loop that every service runs in.
//!
//! A service is a state machine that takes one turn at a time: it receives what was sent before, decides, publishes. In
//! lockstep a turn is a tick of the simulated mission clock, and the loop grants the tick when the turn is over; in wall
//! mode a turn comes with every period of the service, or when one of its descriptors is readable. The loop also publishes
//! health, obeys `control`, serves late joiners, and ends in order on SIGTERM or when the supervisor is gone.

mod control;
mod health;
mod lockstep;
mod notify;
mod signals;
mod wall;

use std::os::fd::BorrowedFd;
use std::time::Duration;

pub use health::HealthReport;

use crate::bus::{Bus, BusError, Limits, Listener};
use crate::codes;
use crate::config::{ClockMode, Config};
use crate::messages::ClockTick;
use crate::system::{Hold, System};
use control::Control;
use health::HealthSender;
use signals::StopSignals;

codes! {
    /// The services, and what else speaks on the bus.
    pub enum ServiceName {
        /// A command such as `vantage status`, or a test.
        Command = 0, "command",
        /// Holds the channels open.
        Keeper = 1, "keeper",
        /// Vehicle and clock.
        Simulator = 2, "simulator",
        /// The rendered world.
        World = 3, "world",
        /// MAVLink.
        Px4Link = 4, "px4-link",
        /// RGB-D images.
        Camera = 5, "camera",
        /// The model.
        Trainer = 6, "trainer",
        /// Scores of candidates.
        Scorer = 7, "scorer",
        /// The mission.
        Planner = 8, "planner",
        /// The supervisor.
        Launch = 9, "launch",
        /// Recordings.
        Recorder = 10, "recorder",
    }
}

impl ServiceName {
    /// The services that always grant ticks of the mission clock.
    pub const MEMBERS: [Self; 5] = [Self::Px4Link, Self::Camera, Self::Trainer, Self::Scorer, Self::Planner];

    /// Those that grant ticks in a mission: with a recorder that is to lose nothing, it too.
    #[must_use]
    pub fn members(config: &Config) -> Vec<Self> {
        let recorder = (config.recorder.enabled && config.recorder.complete).then_some(Self::Recorder);
        Self::MEMBERS.into_iter().chain(recorder).collect()
    }

    /// Whether this service grants ticks in a mission.
    #[must_use]
    pub fn is_member(self, config: &Config) -> bool {
        Self::members(config).contains(&self)
    }
}

/// Name of the variable by which a supervisor tells the next process of a service how the last one ended.
pub const LAST_EXIT: &str = "VANTAGE_LAST_EXIT";

/// How the last process of this service ended, in the supervisor's words (`exit code 70`, `signal 9`); `None` where there was
/// none.
#[must_use]
pub fn last_exit() -> Option<String> {
    std::env::var(LAST_EXIT).ok()
}

/// Why a service cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    /// The bus failed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// What the service was given cannot be used (a mesh, a setting): the same start would fail the same way.
    #[error("{0}")]
    Unusable(String),
    /// Something that it needs is missing, such as room on the disk.
    #[error("{0}")]
    Missing(String),
    /// Something else; the text names it, what was expected, and the way out.
    #[error("{0}")]
    Other(String),
}

/// What a turn came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// The turn is over.
    Done,
    /// Something that is due now is still being computed, or answered within the tick: call again soon, at the same time.
    Waiting,
    /// The service has nothing more to do and leaves.
    Leave,
}

/// Answer to being asked to stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StopAnswer {
    /// Ready to leave.
    Now,
    /// Something must be finished first; the loop goes on until a turn comes to [`Step::Leave`].
    Later,
}

/// A service, as its loop sees it.
pub trait Service {
    /// One turn at mission time `now_ns`.
    ///
    /// # Errors
    /// When the service cannot go on; it ends and is restarted.
    fn step(&mut self, now_ns: u64) -> Result<Step, ServiceError>;

    /// Before the first call of `step` of a tick, in lockstep: the tick itself (px4-link drains its socket up to its count).
    fn begin_tick(&mut self, _tick: &ClockTick) {}

    /// Datagrams sent to the simulator so far, for the grant; px4-link only.
    fn datagrams_sent(&self) -> u64 {
        0
    }

    /// Counts real progress of workers, so that a long computation is told from a hang.
    fn work(&self) -> u64 {
        0
    }

    /// Whether a worker has a job, so that [`Service::work`] must grow. One that does not for long is taken for hung.
    fn busy(&self) -> bool {
        false
    }

    /// Wall mode: time between turns.
    fn period(&self) -> Duration {
        Duration::from_millis(20)
    }

    /// Wall mode: descriptors that cause a turn when readable.
    fn fds(&self) -> Vec<BorrowedFd<'_>> {
        Vec::new()
    }

    /// Wall mode: listeners that cause a turn when woken.
    fn listeners(&self) -> Vec<&Listener> {
        Vec::new()
    }

    /// Lockstep: this member had been found out (stopped, stalled) and is in again. What was sent before now is void: look
    /// at the state as after a restart.
    fn rejoin(&mut self, _now_ns: u64) {}

    /// State for `health`.
    fn health(&self) -> HealthReport;

    /// Asked to stop, by SIGTERM or `control`.
    fn stop(&mut self, _now_ns: u64) -> StopAnswer {
        StopAnswer::Now
    }

    /// The supervisor is gone. Most services end as when asked to; those that a vehicle in the air needs end after it.
    fn orphaned(&mut self, now_ns: u64) -> StopAnswer {
        self.stop(now_ns)
    }
}

/// What a service is given by its command.
#[derive(Debug)]
pub struct Context {
    /// Which service this is.
    pub name: ServiceName,
    /// Access to the channels.
    pub bus: Bus,
    /// The resolved configuration.
    pub config: Config,
    /// The system it belongs to.
    pub system: System,
    /// Which life of the service this is: its start on the monotonic clock, nanoseconds.
    pub incarnation: u64,
    /// Whether a supervisor is to be watched: the loop stops the service when it is gone.
    pub supervised: bool,
    /// While this lives, the system is not taken for dead.
    _hold: Hold,
}

impl Context {
    /// Joins a system as a service.
    ///
    /// # Errors
    /// When the system has ended, or its bus cannot be joined.
    pub fn open(name: ServiceName, config: Config, system: System, supervised: bool) -> Result<Self, BusError> {
        let hold = system
            .hold()
            .map_err(|error| BusError::Domain { path: system.runtime_dir.clone(), cause: error.to_string() })?;
        let incarnation = wall::monotonic_ns();
        let by_tick = name.is_member(&config) && config.clock.mode == ClockMode::Lockstep;
        let bus = Bus::open(&system, Limits::of(&config), name, incarnation, by_tick)?;
        Ok(Self { name, bus, config, system, incarnation, supervised, _hold: hold })
    }

    /// Whether this service grants the ticks of a simulated clock.
    #[must_use]
    pub fn lockstep(&self) -> bool {
        self.name.is_member(&self.config) && self.config.clock.mode == ClockMode::Lockstep
    }

    /// The supervisor to be watched; `None` without one.
    fn supervisor(&self) -> Option<u32> {
        (self.supervised && self.system.supervisor_pid != 0).then_some(self.system.supervisor_pid)
    }

    /// Whether the supervisor is gone. The loop sees to it by itself; for what a service waits for before its loop.
    #[must_use]
    pub fn orphaned(&self) -> bool {
        self.supervisor().is_some_and(signals::is_gone)
    }

    /// Runs a service until it leaves: on the mission clock in lockstep, else on the machine's.
    ///
    /// # Errors
    /// When the service or the bus cannot go on.
    pub fn run(&mut self, service: &mut impl Service) -> Result<(), ServiceError> {
        if self.lockstep() { lockstep::run(self, service) } else { wall::run(self, service) }
    }

    /// Mission time in wall mode: the monotonic clock, shifted by `mission.epoch_ns` in a resumed mission.
    #[must_use]
    pub fn wall_now_ns(&self) -> u64 {
        wall::monotonic_ns().saturating_add(self.config.mission.epoch_ns)
    }
}

/// Who wants this service to stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Stopping {
    /// Nobody.
    No,
    /// The supervisor is gone.
    Orphaned,
    /// SIGTERM or `control` came.
    Asked,
}

/// What both loops do besides turns.
struct Housekeeping {
    control: Control,
    health: HealthSender,
    signals: StopSignals,
    stopping: Stopping,
    last: u64,
}

impl Housekeeping {
    const PERIOD_NS: u64 = 100_000_000;

    fn new(context: &Context) -> Result<Self, ServiceError> {
        Ok(Self {
            control: Control::open(context)?,
            health: HealthSender::open(context)?,
            signals: StopSignals::install(context.supervisor())?,
            stopping: Stopping::No,
            last: 0,
        })
    }

    /// Whether this service has been told to stop and finishes something first.
    fn stopping(&self) -> bool {
        self.stopping != Stopping::No
    }

    /// Late joiners, control, health and stop requests, at most every 100 ms of wall time. True when the service leaves now.
    fn turn(&mut self, context: &Context, service: &mut impl Service, now_ns: u64) -> Result<bool, ServiceError> {
        let wall_ns = wall::monotonic_ns();
        if !self.signals.raised() && wall_ns.saturating_sub(self.last) < Self::PERIOD_NS {
            return Ok(false);
        }
        self.last = wall_ns;
        context.bus.serve_late_joiners();
        let asked = self.control.turn(context, now_ns)? || self.signals.take();
        self.health.turn(context, service, now_ns, wall_ns, self.stopping())?;
        let wanted = match (asked, self.signals.orphaned()) {
            (true, _) => Stopping::Asked,
            (false, true) => Stopping::Orphaned,
            (false, false) => Stopping::No,
        };
        // Who was orphaned and finishes something first can still be asked to stop; the same is said once.
        if wanted <= self.stopping {
            return Ok(false);
        }
        self.stopping = wanted;
        self.health.leaving();
        Ok(if wanted == Stopping::Asked {
            tracing::info!(service = %context.name, "asked to stop");
            service.stop(now_ns) == StopAnswer::Now
        } else {
            tracing::warn!(service = %context.name, "the supervisor is gone");
            service.orphaned(now_ns) == StopAnswer::Now
        })
    }
}
