//! The configuration: one TOML file, one section a service, presets, and errors that name file, line and key.
//!
//! `Default` of every section is the preset `default`; the doc comments of the fields are the comments of the file that
//! `vantage config` prints ([`document`]). [`load`] lays presets, files and `--set` over the defaults.

use serde::{Deserialize, Serialize};

pub mod camera;
pub mod clock;
pub mod document;
pub mod faults;
pub mod launch;
pub mod link;
pub mod load;
pub mod mission;
pub mod model;
pub mod planner;
pub mod recorder;
pub mod scorer;
pub mod simulator;
pub mod trainer;
pub mod world;

pub use camera::CameraConfig;
pub use clock::{ClockConfig, ClockMode};
pub use document::commented;
pub use faults::{Fault, FaultKind};
pub use launch::LaunchConfig;
pub use link::LinkConfig;
pub use load::{ConfigError, Layer, PRESETS, load, load_mission, preset};
pub use mission::MissionConfig;
pub use model::ModelConfig;
pub use planner::PlannerConfig;
pub use recorder::RecorderConfig;
pub use scorer::ScorerConfig;
pub use simulator::SimulatorConfig;
pub use trainer::TrainerConfig;
pub use world::WorldConfig;

/// Everything that can be configured.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Section `[mission]`.
    pub mission: MissionConfig,
    /// Section `[clock]`.
    pub clock: ClockConfig,
    /// Section `[world]`.
    pub world: WorldConfig,
    /// Section `[camera]`.
    pub camera: CameraConfig,
    /// Section `[model]`.
    pub model: ModelConfig,
    /// Section `[trainer]`.
    pub trainer: TrainerConfig,
    /// Section `[scorer]`.
    pub scorer: ScorerConfig,
    /// Section `[planner]`.
    pub planner: PlannerConfig,
    /// Section `[link]`.
    pub link: LinkConfig,
    /// Section `[simulator]`.
    pub simulator: SimulatorConfig,
    /// Section `[recorder]`.
    pub recorder: RecorderConfig,
    /// Section `[launch]`.
    pub launch: LaunchConfig,
}

/// A value that cannot be: which key, what it is, what it should be.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Key below the section (`width`, `gate.speed_mps`); of [`Config::problems`], with the section in front.
    pub key: String,
    /// The value found, as text.
    pub value: String,
    /// What was expected, as a phrase: "at least 16".
    pub expected: String,
}

impl Problem {
    /// A problem of one key.
    pub fn new(key: impl Into<String>, value: impl core::fmt::Display, expected: impl Into<String>) -> Self {
        Self { key: key.into(), value: value.to_string(), expected: expected.into() }
    }

    /// `Some` problem unless `value` is finite and within `low..=high`.
    #[must_use]
    pub fn unless_within(key: &str, value: f64, low: f64, high: f64) -> Option<Self> {
        let fits = value.is_finite() && (low..=high).contains(&value);
        (!fits).then(|| Self::new(key, value, format!("a number from {low} to {high}")))
    }
}

/// A section of the configuration that can tell what is impossible about its values.
pub trait Section {
    /// Values that cannot be, with keys relative to the section. Empty: the section can be used.
    fn problems(&self) -> Vec<Problem>;
}

/// Reads a problem from a section's sentence, "section.key is VALUE; expected WHAT".
fn from_sentence(section: &str, sentence: &str) -> Problem {
    let (head, expected) = sentence.split_once("; expected ").unwrap_or((sentence, "another value"));
    let (key, value) = head.split_once(" is ").unwrap_or((section, head));
    let full = if key.starts_with(section) { key.to_owned() } else { format!("{section}.{key}") };
    Problem::new(full, value, expected)
}

impl Config {
    /// Values that cannot be, over all sections, with full keys (`camera.width`).
    #[must_use]
    pub fn problems(&self) -> Vec<Problem> {
        let mut all = Vec::new();
        let sections: [(&str, &dyn Section); 5] = [
            ("mission", &self.mission),
            ("clock", &self.clock),
            ("planner", &self.planner),
            ("recorder", &self.recorder),
            ("launch", &self.launch),
        ];
        for (section, values) in sections {
            let full = |problem: Problem| Problem { key: format!("{section}.{}", problem.key), ..problem };
            all.extend(values.problems().into_iter().map(full));
        }
        let sections: [(&str, Vec<String>); 7] = [
            ("world", self.world.validate()),
            ("camera", self.camera.validate()),
            ("model", self.model.validate()),
            ("trainer", self.trainer.validate()),
            ("scorer", self.scorer.validate()),
            ("link", self.link.validate()),
            ("simulator", self.simulator.validate()),
        ];
        for (section, sentences) in sections {
            all.extend(sentences.iter().map(|sentence| from_sentence(section, sentence)));
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sections_sentence_becomes_key_value_and_expectation() {
        let problem = from_sentence("model", "model.width is 0 pixels; expected 16 to 4096");
        assert_eq!(problem, Problem::new("model.width", "0 pixels", "16 to 4096"));
        assert_eq!(from_sentence("model", "width is 0; expected 1").key, "model.width");
    }

    #[test]
    fn problems_of_every_kind_of_section_carry_their_section() {
        let mut config = Config::default();
        config.clock.speed = f64::NAN;
        config.model.width = 0;
        let keys: Vec<String> = config.problems().into_iter().map(|problem| problem.key).collect();
        assert_eq!(keys, ["clock.speed", "model.width"]);
        assert_eq!(Config::default().problems(), []);
    }
}
