//! What the planner wrote down, as far as figures need it: times of mission, training, scoring and capture.
//!
//! The journal is read leniently, line by line: a torn last line is dropped, and entries of other versions that carry a
//! number, a stamp and an event still count.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::Value;

use crate::exit::Refusal;

/// What a journal tells. Times in seconds of mission time; absent where the journal does not tell. Flight, capture, training
/// and scoring do not overlap: together they are the time from the first takeoff to the mission's end.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Journal {
    /// From the mission's begin to its last line.
    pub mission_s: Option<f64>,
    /// In the air: under way, or waiting for nothing that is known.
    pub flight_s: Option<f64>,
    /// From asking for a view to its being on disk, after arrival.
    pub capture_s: Option<f64>,
    /// Waiting for training: in the air with nowhere to fly, or on the ground.
    pub training_s: Option<f64>,
    /// Waiting for scores, in the air with nowhere to fly.
    pub scoring_s: Option<f64>,
    /// Length of all training rounds, whatever the vehicle did meanwhile.
    pub rounds_s: Option<f64>,
    /// Iterations of the mission.
    pub iterations: Option<u32>,
    /// PSNR of training views at the last round's end, dB.
    pub psnr_train_db: Option<f64>,
    /// How it ended.
    pub end_reason: Option<String>,
    /// Whether it is over, and if so, whether with a usable model.
    pub over: Option<bool>,
    /// Why the last flight did not go on with the mission: its object was not found as it was.
    pub misaligned: Option<String>,
    /// Stamp of the last whole line.
    pub last_ns: Option<u64>,
}

/// Reads the journal of a mission; an empty one when there is none yet.
///
/// # Errors
/// When the file is there and cannot be read.
pub fn read(path: &Path) -> anyhow::Result<Journal> {
    match std::fs::read(path) {
        Ok(bytes) => Ok(summarise(&bytes)),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(Journal::default()),
        Err(error) => Err(Refusal::missing(format!("{}: {error}; expected the mission's journal", path.display()))),
    }
}

/// Seconds between two stamps.
fn seconds(from_ns: u64, to_ns: u64) -> f64 {
    shared_types::s_from_ns(to_ns.saturating_sub(from_ns))
}

/// Adds an interval to a sum that is absent until there is one.
fn add(sum: &mut Option<f64>, interval_s: f64) {
    *sum = Some(sum.unwrap_or(0.0) + interval_s);
}

/// What is under way at a moment of a journal.
#[derive(Debug, Default)]
struct Activity {
    airborne: bool,
    /// A path is flown.
    flying: bool,
    capturing: bool,
    scoring: bool,
    /// When each open round was first asked for: one that is asked for again began then.
    rounds: BTreeMap<u64, u64>,
}

impl Activity {
    /// Adds an interval to what it was spent on.
    fn spend(&self, journal: &mut Journal, interval_s: f64) {
        if self.capturing {
            add(&mut journal.capture_s, interval_s);
        } else if self.airborne && (self.flying || (!self.scoring && self.rounds.is_empty())) {
            add(&mut journal.flight_s, interval_s);
        } else if self.airborne && self.scoring {
            add(&mut journal.scoring_s, interval_s);
        } else if !self.rounds.is_empty() {
            add(&mut journal.training_s, interval_s);
        }
    }

    fn take(&mut self, event: &str, entry: &Value, now_ns: u64, journal: &mut Journal) {
        match event {
            "airborne" => self.airborne = true,
            "landed" => *self = Self { rounds: core::mem::take(&mut self.rounds), ..Self::default() },
            // Also the way down: nothing is waited for on it.
            "target" | "command" => (self.flying, self.capturing) = (true, false),
            "capture" => (self.flying, self.capturing) = (false, true),
            "captured" | "capture-failed" | "dropped" => (self.flying, self.capturing) = (false, false),
            "score" => self.scoring = true,
            "selected" => self.scoring = false,
            "round" => {
                if let Some(round) = entry["round"].as_u64() {
                    self.rounds.entry(round).or_insert(now_ns);
                }
            }
            "round-done" => {
                if let Some(asked) = entry["round"].as_u64().and_then(|round| self.rounds.remove(&round)) {
                    add(&mut journal.rounds_s, seconds(asked, now_ns));
                }
            }
            _ => {}
        }
    }
}

fn summarise(bytes: &[u8]) -> Journal {
    let mut journal = Journal::default();
    let mut began: Option<u64> = None;
    let mut activity = Activity::default();
    // Zeros are where a loss of power left a hole: the planner goes on from before it.
    let whole = |line: &&[u8]| line.ends_with(b"\n") && !line.contains(&0);
    for line in bytes.split_inclusive(|byte| *byte == b'\n').take_while(whole) {
        let Ok(entry) = serde_json::from_slice::<Value>(line) else { continue };
        let (Some(now_ns), Some(event)) = (entry["now_ns"].as_u64(), entry["event"].as_str()) else { continue };
        if let Some(last) = journal.last_ns {
            activity.spend(&mut journal, seconds(last, now_ns));
        }
        journal.last_ns = Some(now_ns.max(journal.last_ns.unwrap_or(0)));
        activity.take(event, &entry, now_ns, &mut journal);
        match event {
            "started" => began = began.or(Some(now_ns)),
            "round-done" => {
                journal.iterations = entry["total_iterations"].as_u64().and_then(|count| u32::try_from(count).ok());
                journal.psnr_train_db = entry["psnr_train_db"].as_f64();
            }
            "misaligned" => journal.misaligned = entry["why"].as_str().map(str::to_owned),
            "ending" | "over" => {
                journal.end_reason = entry["reason"].as_str().map(str::to_owned);
                if event == "over" {
                    journal.over = Some(entry["usable"].as_bool().unwrap_or(false));
                }
            }
            _ => {}
        }
    }
    if let (Some(began), Some(last)) = (began, journal.last_ns) {
        journal.mission_s = Some(seconds(began, last));
    }
    journal
}

#[cfg(test)]
mod tests {
    use super::*;

    const WHOLE: &str = r#"{"id":1,"now_ns":1000000000,"event":"started","mission_id":"m","seed":1}
{"id":2,"now_ns":3000000000,"event":"airborne","home_m":[0,0,0]}
{"id":3,"now_ns":3000000000,"event":"target","purpose":"seed"}
{"id":4,"now_ns":5000000000,"event":"capture","shot":{"keyframe_id":7,"reason":"seed"},"target":2}
{"id":5,"now_ns":6500000000,"event":"captured","keyframe_id":7,"stamp_ns":1,"gate_missed":false}
{"id":6,"now_ns":6500000000,"event":"round","round":0,"views":4,"max_iterations":750}
{"id":7,"now_ns":7000000000,"event":"round","round":0,"views":4,"max_iterations":750}
{"id":8,"now_ns":9000000000,"event":"round-done","round":0,"total_iterations":160,"psnr_train_db":31.5}
{"id":9,"now_ns":9000000000,"event":"score","batch":1,"generation":3}
{"id":10,"now_ns":9400000000,"event":"selected","batch":1}
{"id":11,"now_ns":9400000000,"event":"target","purpose":"selected"}
{"id":12,"now_ns":9500000000,"event":"round","round":1,"views":5,"max_iterations":750}
{"id":13,"now_ns":10400000000,"event":"command","command":"land"}
{"id":14,"now_ns":12000000000,"event":"landed"}
{"id":15,"now_ns":12500000000,"event":"round-done","round":1,"total_iterations":400,"psnr_train_db":32.5}
{"id":16,"now_ns":12500000000,"event":"over","reason":"complete","usable":true}
"#;

    #[test]
    fn times_are_split_by_what_was_waited_for_and_add_up() {
        let journal = summarise(WHOLE.as_bytes());
        let close = |found: Option<f64>, wanted: f64| found.is_some_and(|found| (found - wanted).abs() < 1e-9);
        assert_eq!(journal.mission_s, Some(11.5));
        assert!(close(journal.capture_s, 1.5), "{journal:?}");
        assert!(close(journal.flight_s, 2.0 + 1.0 + 1.6), "{journal:?}");
        assert!(close(journal.training_s, 2.5 + 0.5), "{journal:?}");
        assert!(close(journal.scoring_s, 0.4), "{journal:?}");
        assert!(close(journal.rounds_s, 2.5 + 3.0), "{journal:?}");
        assert_eq!((journal.iterations, journal.psnr_train_db), (Some(400), Some(32.5)));
        assert_eq!((journal.end_reason.as_deref(), journal.over), (Some("complete"), Some(true)));
        assert_eq!(journal.last_ns, Some(12_500_000_000));
    }

    #[test]
    fn a_torn_last_line_is_dropped_wherever_it_is_cut() {
        let text = WHOLE.as_bytes();
        let last_line = WHOLE.trim_end().rfind('\n').expect("lines") + 1;
        for cut in last_line..text.len() {
            assert_eq!(summarise(&text[..cut]).end_reason, None, "cut at {cut}");
        }
        let mut holed = WHOLE.replace("\"event\":\"landed\"", &"\0".repeat(16)).into_bytes();
        assert_eq!(summarise(&holed).end_reason, None, "what comes behind a hole is dropped by the planner too");
        holed.clear();
        assert_eq!(summarise(&holed), Journal::default());
    }

    #[test]
    fn what_never_happened_is_absent() {
        let journal = summarise(WHOLE.lines().next().expect("line").as_bytes());
        assert_eq!(journal, Journal::default(), "a line without its end is torn");
        let first = format!("{}\n", WHOLE.lines().next().expect("line"));
        let journal = summarise(first.as_bytes());
        assert_eq!((journal.mission_s, journal.flight_s, journal.training_s), (Some(0.0), None, None));
    }
}
