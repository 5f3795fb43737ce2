//! `report/flight.json`: what the supervisor saw of a mission's runs, kept so that `vantage evaluate` can measure later.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use shared_types::folder::{MissionFolder, write_atomic};

use crate::exit::Refusal;
use crate::supervise::Flight;
use crate::supervise::run::end_reason;

/// What the supervisor saw, over all runs of the mission (the first and those of `resume`).
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct FlightRecord {
    /// How the mission ended.
    pub end_reason: Option<String>,
    /// Whether every run repeats bit for bit.
    pub deterministic: Option<bool>,
    /// Mission time, seconds.
    pub mission_s: Option<f64>,
    /// Wall time of all runs, seconds.
    pub wall_s: Option<f64>,
    /// Keyframes taken.
    pub keyframes: Option<u32>,
    /// Length flown, metres.
    pub path_m: Option<f64>,
    /// Training iterations run.
    pub iterations: Option<u32>,
    /// PSNR of the training views at the end, dB.
    pub psnr_train_db: Option<f64>,
    /// The paper's literal coverage at the end.
    pub paper_coverage: Option<f64>,
    /// Restarts of services, over all runs.
    pub restarts: BTreeMap<String, u32>,
    /// Highest memory over all runs, megabytes.
    pub memory: BTreeMap<String, f64>,
    /// Processor time of each scoring for a candidate, milliseconds, over all runs.
    pub score_ms: Vec<f64>,
    /// Runs: 1 for a mission that was not cut off.
    pub runs: u32,
}

impl FlightRecord {
    /// Adds a run to what was seen before.
    #[must_use]
    pub fn with(mut self, flight: &Flight) -> Self {
        let first = self.runs == 0;
        self.runs += 1;
        if let Some(state) = &flight.last {
            self.end_reason = end_reason(state).map(|reason| reason.name().to_owned());
            self.keyframes = Some(state.keyframes);
            self.path_m = Some(state.path_m);
            self.iterations = Some(state.iterations);
            self.psnr_train_db = Some(state.psnr_train_db);
            self.paper_coverage = Some(state.paper_coverage);
            self.mission_s = flight.mission_s;
        }
        self.deterministic = match (first, self.deterministic, flight.deterministic) {
            (true, _, now) => now,
            // A mission that was cut off by the wall's clock does not repeat.
            _ => Some(false),
        };
        self.wall_s = Some(self.wall_s.unwrap_or(0.0) + flight.wall_s);
        for (service, count) in &flight.restarts {
            *self.restarts.entry(service.to_string()).or_default() += count;
        }
        self.score_ms.extend(&flight.score_ms);
        for (key, megabytes) in flight.memory.megabytes() {
            let peak = self.memory.entry(key).or_default();
            *peak = peak.max(megabytes);
        }
        self
    }
}

fn path(folder: &MissionFolder) -> PathBuf {
    folder.report_path().join("flight.json")
}

/// Reads the record; empty when the mission was never supervised.
///
/// # Errors
/// When the file is there and cannot be read.
pub fn read(folder: &MissionFolder) -> anyhow::Result<FlightRecord> {
    let path = path(folder);
    match std::fs::read_to_string(&path) {
        Ok(text) => serde_json::from_str(&text).map_err(|error| {
            Refusal::failed(format!("{}: {error}; expected what `vantage fly` wrote: remove the file", path.display()))
        }),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(FlightRecord::default()),
        Err(error) => Err(Refusal::failed(format!("{}: {error}", path.display()))),
    }
}

/// Adds a run to the folder's record.
///
/// # Errors
/// When the record cannot be read or written.
pub fn write(folder: &MissionFolder, flight: &Flight) -> anyhow::Result<()> {
    let record = read(folder)?.with(flight);
    write_atomic(&path(folder), serde_json::to_string_pretty(&record)?.as_bytes())?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use shared_types::ServiceName;
    use shared_types::messages::{EndReason, MissionState};

    use super::*;
    use crate::supervise::Outcome;
    use crate::supervise::memory::Memory;

    fn run_of(keyframes: u32, trainer_mb: u64) -> Flight {
        let mut memory = Memory::default();
        memory.sample(&[(ServiceName::Trainer, trainer_mb * 1_000_000)]);
        let state = MissionState { keyframes, end_reason: EndReason::Complete.code(), ..MissionState::default() };
        Flight {
            outcome: Outcome::Done,
            last: Some(state),
            mission_s: Some(10.0),
            wall_s: 2.0,
            restarts: BTreeMap::from([(ServiceName::Scorer, 1)]),
            deterministic: Some(true),
            memory,
            score_ms: vec![2.5],
            last_words: None,
        }
    }

    #[test]
    fn runs_of_one_mission_add_up() {
        let dir = tempfile::tempdir().expect("folder");
        let folder = MissionFolder::create(dir.path().join("m")).expect("made");
        write(&folder, &run_of(3, 90)).expect("written");
        assert_eq!(read(&folder).expect("read").deterministic, Some(true));
        write(&folder, &run_of(6, 70)).expect("written");
        let record = read(&folder).expect("read");
        assert_eq!((record.runs, record.keyframes, record.wall_s), (2, Some(6), Some(4.0)));
        assert_eq!((record.restarts["scorer"], record.memory["trainer_pss_mb"]), (2, 90.0));
        assert_eq!(record.score_ms, [2.5, 2.5]);
        assert_eq!(record.deterministic, Some(false), "a resumed mission does not repeat");
        assert_eq!(record.end_reason.as_deref(), Some("complete"));
    }

    #[test]
    fn a_damaged_record_is_named() {
        let dir = tempfile::tempdir().expect("folder");
        let folder = MissionFolder::create(dir.path().join("m")).expect("made");
        assert_eq!(read(&folder).expect("none yet"), FlightRecord::default());
        std::fs::write(folder.report_path().join("flight.json"), "{\"runs\": 1").expect("written");
        assert!(read(&folder).expect_err("cut").to_string().contains("flight.json"));
    }
}
