//! What the supervisor's state machine takes and gives.

use shared_types::ServiceName;

/// Limits of the supervisor; times in milliseconds of wall time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Policy {
    /// Wait before the first restart; doubles with each further death.
    pub restart_delay_ms: u64,
    /// Longest wait before a restart.
    pub restart_delay_max_ms: u64,
    /// Deaths within the window that are still mended.
    pub crash_limit: usize,
    /// The window.
    pub crash_window_ms: u64,
    /// Time to stop in order before SIGKILL.
    pub stop_timeout_ms: u64,
    /// Time to return, land and save.
    pub landing_timeout_ms: u64,
    /// Time that the keeper gets before the others are started without a word from it.
    pub keeper_timeout_ms: u64,
    /// A service that says nothing for so long is hung.
    pub silence_ms: u64,
    /// The same before its first word.
    pub start_ms: u64,
    /// A worker that has a job and makes no progress for so long is hung.
    pub stall_ms: u64,
    /// What died or hangs is left for a debugger.
    pub hold_on_fault: bool,
}

/// What happened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Event {
    /// Begin.
    Begin,
    /// Time passes.
    Tick,
    /// The service's health was heard.
    Heard(ServiceName),
    /// A worker of the service has had a job for so long without progress, milliseconds.
    Stalled(ServiceName, u64),
    /// A debugger has stopped the service: it may be silent.
    Debugged(ServiceName),
    /// The process ended.
    Exited {
        /// Which one.
        service: ServiceName,
        /// Exit code; `None` for a signal.
        code: Option<i32>,
    },
    /// Ctrl-C, or SIGTERM.
    Interrupt,
    /// The planner's phase is `Done` (true) or `Failed` (false).
    MissionOver {
        /// Whether there is a usable model.
        usable: bool,
    },
    /// The motors run.
    Armed,
    /// The motors are off.
    Disarmed,
}

/// What to do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Action {
    /// Start the process.
    Start(ServiceName),
    /// Ask the process to stop in order (SIGTERM).
    Ask(ServiceName),
    /// Kill the process.
    Kill(ServiceName),
    /// The process hangs: write down what its threads are doing, and kill it unless it is to be held.
    Examine {
        /// Which one.
        service: ServiceName,
        /// Whether to kill it then.
        kill: bool,
    },
    /// Tell the planner to return, land and save: the mission ends.
    CommandStop,
    /// Tell the planner to return and land, and to leave the mission open for `resume`.
    CommandRecall,
    /// Tell the vehicle to hold where it is.
    VehicleHold,
    /// Tell the user.
    Say(String),
    /// All processes are gone.
    Finish(Outcome),
}

/// How the run ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// The mission landed with a usable model.
    Done,
    /// The mission is over without one.
    Failed,
    /// The user asked twice to stop: a vehicle in the air was left holding.
    Aborted,
    /// A service could not be kept alive or never started.
    Broken {
        /// Which one.
        service: ServiceName,
        /// Its last exit code; `None` for a signal.
        code: Option<i32>,
        /// Whether it ever worked in this run.
        worked: bool,
    },
    /// The vehicle did not land in time after the user asked for it.
    NotLanded,
}
