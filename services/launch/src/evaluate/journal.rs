//! What the planner wrote down, as far as figures need it: times of mission, training, scoring and capture.
//!
//! The journal is read leniently, line by line: a torn last line is dropped, and entries of other versions that carry a
//! number, a stamp and an event still count.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::Value;

use crate::exit::Refusal;

/// What a journal tells. Times in seconds of mission time; absent where the journal does not tell.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Journal {
    /// From the mission's begin to its last line.
    pub mission_s: Option<f64>,
    /// In the air, captures left out.
    pub flight_s: Option<f64>,
    /// From asking for a view to its being on disk, after arrival.
    pub capture_s: Option<f64>,
    /// Training rounds (those that run while the vehicle flies, too).
    pub training_s: Option<f64>,
    /// From asking for scores to the choice of views.
    pub scoring_s: Option<f64>,
    /// Iterations of the mission.
    pub iterations: Option<u32>,
    /// PSNR of training views at the last round's end, dB.
    pub psnr_train_db: Option<f64>,
    /// How it ended.
    pub end_reason: Option<String>,
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

fn summarise(bytes: &[u8]) -> Journal {
    let mut journal = Journal::default();
    let (mut began, mut airborne, mut scoring): (Option<u64>, Option<u64>, Option<u64>) = (None, None, None);
    let mut captures: BTreeMap<u64, u64> = BTreeMap::new();
    let mut rounds: BTreeMap<u64, u64> = BTreeMap::new();
    for line in bytes.split_inclusive(|byte| *byte == b'\n').filter(|line| line.ends_with(b"\n")) {
        let Ok(entry) = serde_json::from_slice::<Value>(line) else { continue };
        let (Some(now_ns), Some(event)) = (entry["now_ns"].as_u64(), entry["event"].as_str()) else { continue };
        journal.last_ns = Some(now_ns.max(journal.last_ns.unwrap_or(0)));
        match event {
            "started" => began = began.or(Some(now_ns)),
            "airborne" => airborne = airborne.or(Some(now_ns)),
            "capture" => {
                captures.extend(entry["shot"]["keyframe_id"].as_u64().map(|id| (id, now_ns)));
            }
            "captured" => {
                if let Some(asked) = entry["keyframe_id"].as_u64().and_then(|id| captures.remove(&id)) {
                    add(&mut journal.capture_s, seconds(asked, now_ns));
                }
            }
            "round" => {
                // A round that is asked for again began when it was first asked for.
                if let Some(round) = entry["round"].as_u64() {
                    rounds.entry(round).or_insert(now_ns);
                }
            }
            "round-done" => {
                if let Some(asked) = entry["round"].as_u64().and_then(|round| rounds.remove(&round)) {
                    add(&mut journal.training_s, seconds(asked, now_ns));
                }
                journal.iterations = entry["total_iterations"].as_u64().and_then(|count| u32::try_from(count).ok());
                journal.psnr_train_db = entry["psnr_train_db"].as_f64();
            }
            "score" => scoring = scoring.or(Some(now_ns)),
            "selected" => {
                if let Some(asked) = scoring.take() {
                    add(&mut journal.scoring_s, seconds(asked, now_ns));
                }
            }
            "ending" | "over" => journal.end_reason = entry["reason"].as_str().map(str::to_owned),
            _ => {}
        }
    }
    if let (Some(began), Some(last)) = (began, journal.last_ns) {
        journal.mission_s = Some(seconds(began, last));
    }
    if let (Some(airborne), Some(last)) = (airborne, journal.last_ns) {
        journal.flight_s = Some((seconds(airborne, last) - journal.capture_s.unwrap_or(0.0)).max(0.0));
    }
    journal
}

#[cfg(test)]
mod tests {
    use super::*;

    const WHOLE: &str = r#"{"id":1,"now_ns":1000000000,"event":"started","mission_id":"m","seed":1}
{"id":2,"now_ns":3000000000,"event":"airborne","home_m":[0,0,0]}
{"id":3,"now_ns":5000000000,"event":"capture","shot":{"keyframe_id":7,"reason":"seed"},"target":2}
{"id":4,"now_ns":6500000000,"event":"captured","keyframe_id":7,"stamp_ns":1,"gate_missed":false}
{"id":5,"now_ns":7000000000,"event":"round","round":0,"views":4,"max_iterations":750}
{"id":6,"now_ns":8000000000,"event":"round","round":0,"views":4,"max_iterations":750}
{"id":7,"now_ns":9000000000,"event":"round-done","round":0,"total_iterations":160,"psnr_train_db":31.5}
{"id":8,"now_ns":9500000000,"event":"score","batch":1,"generation":3}
{"id":9,"now_ns":9900000000,"event":"selected","batch":1}
{"id":10,"now_ns":11000000000,"event":"over","reason":"complete","usable":true}
"#;

    #[test]
    fn times_are_summed_by_what_was_waited_for() {
        let journal = summarise(WHOLE.as_bytes());
        assert_eq!(journal.mission_s, Some(10.0));
        assert_eq!(journal.capture_s, Some(1.5));
        assert_eq!(journal.flight_s, Some(6.5));
        assert_eq!(journal.training_s, Some(2.0));
        assert!(journal.scoring_s.is_some_and(|s| (s - 0.4).abs() < 1e-9));
        assert_eq!((journal.iterations, journal.psnr_train_db), (Some(160), Some(31.5)));
        assert_eq!(journal.end_reason.as_deref(), Some("complete"));
        assert_eq!(journal.last_ns, Some(11_000_000_000));
    }

    #[test]
    fn a_torn_last_line_is_dropped_wherever_it_is_cut() {
        let text = WHOLE.as_bytes();
        let last_line = WHOLE.trim_end().rfind('\n').expect("lines") + 1;
        for cut in last_line..text.len() {
            assert_eq!(summarise(&text[..cut]).last_ns, Some(9_900_000_000), "cut at {cut}");
        }
        assert_eq!(summarise(b""), Journal::default());
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
