//! Section `[clock]`: which clock the mission runs on.

use serde::{Deserialize, Serialize};

use super::{Problem, Section};

/// Which clock decides behaviour.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ClockMode {
    /// Simulated time in lockstep with the members: as fast as the slowest part, the same each time.
    #[default]
    Lockstep,
    /// The machine's monotonic clock: vehicles, a real PX4, tests of latency and load.
    Wall,
}

/// Section `[clock]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClockConfig {
    /// `lockstep` (simulation: as fast as the slowest part, the same each time) or `wall` (vehicles, real PX4).
    pub mode: ClockMode,
    /// Simulated seconds per wall second at most; 0: no limit. Wall mode runs at 1.
    pub speed: f64,
}

impl Default for ClockConfig {
    fn default() -> Self {
        Self { mode: ClockMode::Lockstep, speed: 0.0 }
    }
}

impl Section for ClockConfig {
    fn problems(&self) -> Vec<Problem> {
        Problem::unless_within("speed", self.speed, 0.0, 1000.0).into_iter().collect()
    }
}
