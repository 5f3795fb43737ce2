//! Section `[mission]`: what is flown, and where the result goes.

use serde::{Deserialize, Serialize};

use super::{Problem, Section};

/// Section `[mission]`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MissionConfig {
    /// Name of the mission; empty: made from the date and the seed.
    pub id: String,
    /// The mission folder, absolute; empty: `missions/<id>` under the present folder. `vantage fly` fills it in.
    pub folder: String,
    /// Seed of everything random.
    pub seed: u64,
    /// Preset that this configuration started from; filled in by `vantage fly`.
    pub preset: String,
    /// Version of Vantage that wrote this file; filled in by `vantage fly`.
    pub version: String,
    /// Mission time of the first tick, nanoseconds; a resumed mission goes on after its journal's last stamp.
    pub epoch_ns: u64,
}

impl Section for MissionConfig {
    fn problems(&self) -> Vec<Problem> {
        let mut problems = Vec::new();
        let simple = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
        if !self.id.chars().all(simple) || self.id.starts_with('.') || self.id.len() > 63 {
            problems.push(Problem::new(
                "id",
                &self.id,
                "at most 63 letters, digits, '-', '_' or '.', not starting with '.'",
            ));
        }
        if self.folder.len() > 255 || !(self.folder.is_empty() || self.folder.starts_with('/')) {
            problems.push(Problem::new("folder", &self.folder, "an absolute path of at most 255 bytes"));
        }
        // TOML's integers are signed: a larger number could not be written to mission.toml and read back.
        for (key, value) in [("seed", self.seed), ("epoch_ns", self.epoch_ns)] {
            if i64::try_from(value).is_err() {
                problems.push(Problem::new(key, value, format!("at most {}", i64::MAX)));
            }
        }
        problems
    }
}
