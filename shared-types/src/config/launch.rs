//! Section `[launch]`: how the services are watched, restarted and stopped.

use serde::{Deserialize, Serialize};

use super::{Problem, Section};

/// Section `[launch]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LaunchConfig {
    /// Wait before the first restart of a service that died, seconds; doubles with each further death.
    pub restart_delay_s: f64,
    /// Longest wait before a restart, seconds.
    pub restart_delay_max_s: f64,
    /// A service that dies more often than this within `crash_window_s` ends the mission.
    pub crash_limit: u32,
    /// Window of `crash_limit`, seconds.
    pub crash_window_s: f64,
    /// Time that each service gets to stop in order before it is killed, seconds; the trainer takes up to 8 for a checkpoint.
    pub stop_timeout_s: f64,
    /// Time that a mission gets to return, land and save after the first Ctrl-C, seconds.
    pub landing_timeout_s: f64,
    /// A service that says nothing for so long is hung: it is killed and started again, seconds.
    pub watchdog_s: f64,
    /// The same for its first word after its start, seconds: large scenes and checkpoints take their time.
    pub watchdog_start_s: f64,
    /// A service whose worker has a job and makes no progress for so long is hung, seconds.
    pub watchdog_work_s: f64,
    /// A service that died or hangs is left as it is for a debugger, instead of being started again.
    pub hold_on_fault: bool,
    /// A service that panics dumps its core, where the system allows it (`ulimit -Hc`, /proc/sys/kernel/core_pattern).
    pub core_dumps: bool,
    /// Every process writes how long its stages take (trace/), and launch puts them on one time axis (report/trace.json).
    pub trace: bool,
    /// Time between two measurements of memory (PSS), seconds; 0: none.
    pub memory_period_s: f64,
    /// Log level of the services' log files: error, warn, info, debug or trace.
    pub log_level: String,
    /// Held-out views that a model is measured against, half of them at R and half at 0.8 R.
    pub evaluate_views: u32,
}

impl Default for LaunchConfig {
    fn default() -> Self {
        Self {
            restart_delay_s: 0.1,
            restart_delay_max_s: 5.0,
            crash_limit: 5,
            crash_window_s: 30.0,
            stop_timeout_s: 10.0,
            landing_timeout_s: 180.0,
            watchdog_s: 10.0,
            watchdog_start_s: 60.0,
            watchdog_work_s: 120.0,
            hold_on_fault: false,
            core_dumps: false,
            trace: false,
            memory_period_s: 2.0,
            log_level: "info".to_owned(),
            evaluate_views: 100,
        }
    }
}

impl Section for LaunchConfig {
    fn problems(&self) -> Vec<Problem> {
        let mut problems: Vec<Problem> = [
            Problem::unless_within("restart_delay_s", self.restart_delay_s, 0.0, 60.0),
            Problem::unless_within(
                "restart_delay_max_s",
                self.restart_delay_max_s,
                self.restart_delay_s.max(0.0),
                600.0,
            ),
            Problem::unless_within("crash_limit", f64::from(self.crash_limit), 1.0, 1000.0),
            Problem::unless_within("crash_window_s", self.crash_window_s, 1.0, 3600.0),
            Problem::unless_within("stop_timeout_s", self.stop_timeout_s, 0.1, 600.0),
            Problem::unless_within("landing_timeout_s", self.landing_timeout_s, 1.0, 3600.0),
            Problem::unless_within("watchdog_s", self.watchdog_s, 3.0, 3600.0),
            Problem::unless_within("watchdog_start_s", self.watchdog_start_s, self.watchdog_s.max(0.0), 3600.0),
            Problem::unless_within("watchdog_work_s", self.watchdog_work_s, self.watchdog_s.max(0.0), 3600.0),
            Problem::unless_within("memory_period_s", self.memory_period_s, 0.0, 3600.0),
            Problem::unless_within("evaluate_views", f64::from(self.evaluate_views), 2.0, 1000.0),
        ]
        .into_iter()
        .flatten()
        .collect();
        if !["error", "warn", "info", "debug", "trace"].contains(&self.log_level.as_str()) {
            problems.push(Problem::new("log_level", &self.log_level, "error, warn, info, debug or trace"));
        }
        problems
    }
}
