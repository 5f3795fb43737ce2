//! The journal: every decision of the mission, one line of JSON each, on disk before it is acted on.
//!
//! Stamps are mission time; nothing of the wall's clock, of processes or of absolute paths is in it, so that the same
//! mission writes the same journal. The number of a line is the id of the request or target that it announces.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shared_types::fault_point;
use shared_types::messages::{EndReason, KeyframeReason, VehicleCommand};
use shared_types::storage::{self, WriteFile};

use crate::logic::prior::Prior;

/// What cannot be done with a journal. Every variant names the file.
#[derive(Debug, thiserror::Error)]
pub enum JournalError {
    /// The system refused.
    #[error("cannot {action} the journal {path}: {source}; check the disk, then go on with `vantage resume`")]
    Io {
        /// What was tried.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// No room for more lines.
    #[error("no room for {bytes} bytes more of the journal {path}: free disk space ({source})")]
    Full {
        /// The file.
        path: PathBuf,
        /// What was to be appended.
        bytes: usize,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A line before the last cannot be understood.
    #[error(
        "{path}, line {line}: {found}; expected entry {line} of a mission's journal: restore the file, or fly anew"
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Number of the line, from 1.
        line: u64,
        /// What is wrong.
        found: String,
    },
}

/// A view that is to be taken.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Shot {
    /// Id of the keyframe; of prior views, a number that no keyframe has.
    pub keyframe_id: u64,
    /// Why.
    pub reason: KeyframeReason,
    /// Index on the Fibonacci sphere, or `u32::MAX`.
    pub candidate: u32,
    /// Position of the camera, metres.
    pub position_m: [f64; 3],
    /// What it looks at, metres.
    pub look_at_m: [f64; 3],
    /// Score at its choice.
    pub score: f64,
}

/// Score of a candidate, as far as it is worth keeping.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Index on the Fibonacci sphere.
    pub index: u32,
    /// u_c (Eq. 3).
    pub uncertainty: f64,
    /// The angular term (Eq. 4).
    pub angle: f64,
    /// s_c (Eq. 4).
    pub score: f64,
    /// Mean alpha in the projected box.
    pub alpha: f64,
}

/// A decision, or what became of one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "kebab-case")]
pub enum Record {
    /// The mission begins.
    Started {
        /// Its id.
        mission_id: String,
        /// Seed of everything random.
        seed: u64,
    },
    /// A command to the vehicle.
    Command {
        /// Which.
        command: VehicleCommand,
        /// Height above home for a takeoff, metres.
        altitude_m: f64,
    },
    /// The vehicle is in the air and under control.
    Airborne {
        /// Home, metres.
        home_m: [f64; 3],
    },
    /// A path to fly, `[x, y, z, yaw, gimbal pitch, speed]` each; then the way back.
    Target {
        /// What for.
        purpose: String,
        /// Keyframe to be taken at its end, where there is one.
        keyframe_id: Option<u64>,
        /// The path.
        path: Vec<[f64; 6]>,
        /// The checked way back from its end.
        back: Vec<[f64; 6]>,
    },
    /// A capture is asked for.
    Capture {
        /// The view.
        shot: Shot,
        /// The target at whose end it is.
        target: u64,
        /// When to give up.
        deadline_ns: u64,
    },
    /// A view is on disk.
    Captured {
        /// Which.
        keyframe_id: u64,
        /// Mission time of the image.
        stamp_ns: u64,
        /// The stillest image was taken though it met no limit.
        gate_missed: bool,
        /// Measured position of the camera, metres.
        position_m: [f64; 3],
    },
    /// A view was not taken.
    CaptureFailed {
        /// Which.
        keyframe_id: u64,
        /// Why not.
        why: String,
    },
    /// A view is given up.
    Dropped {
        /// Which.
        keyframe_id: u64,
        /// Its candidate, or `u32::MAX`.
        candidate: u32,
        /// Why.
        why: String,
    },
    /// Nothing stood at the survey point: looking around from above.
    Scan,
    /// The scan found something: the survey point is moved there.
    Survey {
        /// The new point, metres.
        point_m: [f64; 3],
    },
    /// The prior.
    Prior {
        /// Box and ground.
        prior: Prior,
        /// The gimbal's limits that the candidates were made with, radians.
        pitch_limits_rad: [f64; 2],
        /// Candidates (N).
        candidates: u32,
        /// Points left out: too low, unsafe, beyond the gimbal.
        left_out: [u32; 3],
    },
    /// The world is to be moved: where the estimator has put its origin, the object is not.
    Shift {
        /// What positions in the world change by, metres.
        shift_m: [f64; 3],
        /// The vehicle's reset counter when that was measured.
        reset_count: u32,
    },
    /// The object is where, and as, the prior's views show it, within a residual: views may be taken.
    Aligned {
        /// What was left to move and was not, metres.
        shift_m: [f64; 3],
        /// Root mean square between the object's surfaces then and now, metres.
        residual_m: f64,
    },
    /// It is not; the vehicle comes home and the mission stays open.
    Misaligned {
        /// Root mean square between the object's surfaces then and now, metres; absent where it was not found at all.
        residual_m: Option<f64>,
        /// In words.
        why: String,
    },
    /// A training round is asked for.
    Round {
        /// Number, from 0.
        round: u32,
        /// How many keyframes, in the order of capture.
        views: u32,
        /// Most iterations.
        max_iterations: u32,
    },
    /// A training round is over.
    RoundDone {
        /// Number.
        round: u32,
        /// Generation of its final snapshot.
        generation: u64,
        /// Iterations in it.
        iterations: u32,
        /// Iterations of the mission.
        total_iterations: u32,
        /// PSNR of training views, dB.
        psnr_train_db: f64,
    },
    /// Scores are asked for.
    Score {
        /// The batch they are for.
        batch: u32,
        /// Snapshot to score on.
        generation: u64,
        /// Candidates to score.
        free: Vec<u32>,
        /// Positions of the views taken and planned, metres.
        visited_m: Vec<[f64; 3]>,
    },
    /// A batch is chosen. Batch 0 are the seed views.
    Selected {
        /// Number of the batch.
        batch: u32,
        /// Snapshot that it was chosen on; 0: none.
        generation: u64,
        /// 95th percentile of the uncertainty.
        uncertainty_p95: f64,
        /// The views, in the order of the choice.
        shots: Vec<Shot>,
        /// Every candidate's score.
        scores: Vec<Score>,
    },
    /// Somebody else flies, or the operator said hold.
    Suspended,
    /// The operator said go on.
    GoOn,
    /// The vehicle stands on the ground, disarmed, and flies no more.
    Landed,
    /// No more views: going home.
    Ending {
        /// Why.
        reason: EndReason,
        /// Land where the vehicle is.
        land_here: bool,
    },
    /// The mission is over.
    Over {
        /// How it ended.
        reason: EndReason,
        /// Whether there is a model.
        usable: bool,
    },
}

/// A line of the journal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Entry {
    /// Number of the line, from 1.
    pub id: u64,
    /// Mission time.
    pub now_ns: u64,
    /// What was decided.
    #[serde(flatten)]
    pub record: Record,
}

/// The file.
#[derive(Debug)]
pub struct Journal {
    file: Box<dyn WriteFile>,
    path: PathBuf,
    /// Length of what was appended for certain.
    good: u64,
    /// An append failed, and what it left was not cut off yet.
    torn: bool,
}

impl Journal {
    /// Opens or makes a journal, and reads what is in it. A torn last line is cut off.
    ///
    /// # Errors
    /// [`JournalError`] where the file cannot be had, or a line before the last is damaged.
    pub fn open(path: &Path) -> Result<(Self, Vec<Entry>), JournalError> {
        let io = |action| move |source| JournalError::Io { action, path: path.to_owned(), source };
        let disk = storage::of(path);
        let file = disk.append(path).map_err(io("open"))?;
        let bytes = std::fs::read(path).map_err(io("read"))?;
        let (entries, good) = parse(&bytes, path)?;
        let mut journal = Self { file, path: path.to_owned(), good: good as u64, torn: good < bytes.len() };
        if journal.torn {
            tracing::warn!(bytes = bytes.len() - good, "the torn end of the journal is dropped");
            journal.mend().and_then(|()| journal.file.sync()).map_err(io("repair"))?;
        }
        if let Some(folder) = path.parent() {
            // The file's name in the folder is to last as long as its lines.
            disk.sync_dir(folder).map_err(io("sync the folder of"))?;
        }
        Ok((journal, entries))
    }

    /// Appends entries and brings them to the disk.
    ///
    /// # Errors
    /// [`JournalError::Full`] and [`JournalError::Io`]; nothing that the entries announce may be done then. The same may be
    /// tried again: what a failed try left is cut off first.
    pub fn append(&mut self, entries: &[Entry]) -> Result<(), JournalError> {
        if entries.is_empty() {
            return Ok(());
        }
        let path = self.path.clone();
        let io = |action, source| JournalError::Io { action, path: path.clone(), source };
        let mut text = String::new();
        for entry in entries {
            let line = serde_json::to_string(entry).map_err(|error| io("write", std::io::Error::other(error)))?;
            text.push_str(&line);
            text.push('\n');
        }
        if self.torn {
            self.mend().map_err(|source| io("repair", source))?;
        }
        fault_point::reach("journal", "unwritten");
        match self.file.write(text.as_bytes()).and_then(|()| self.file.sync()) {
            Ok(()) => {
                fault_point::reach("journal", "appended");
                self.good += text.len() as u64;
                Ok(())
            }
            Err(source) => {
                self.torn = true;
                // Another process may read the journal meanwhile; where this fails, the next try does it.
                self.mend().ok();
                Err(if storage::is_full(&source) {
                    JournalError::Full { path, bytes: text.len(), source }
                } else {
                    io("append to", source)
                })
            }
        }
    }

    /// Cuts off what is not whole.
    fn mend(&mut self) -> std::io::Result<()> {
        self.file.cut(self.good)?;
        self.torn = false;
        Ok(())
    }
}

/// Reads the entries of a journal, and how many bytes of it are whole lines.
///
/// What one turn appends is synced at once. A loss of power within that may leave blocks of it on the disk and others not,
/// which then read as zeros: such a hole is the journal's end where all that follows is of one turn.
///
/// # Errors
/// [`JournalError::Damaged`] for a line before the last that is no entry or has the wrong number.
pub fn parse(bytes: &[u8], path: &Path) -> Result<(Vec<Entry>, usize), JournalError> {
    let mut entries: Vec<Entry> = Vec::new();
    let mut good = 0;
    let mut lines = bytes.split_inclusive(|&byte| byte == b'\n').peekable();
    while let Some(line) = lines.next() {
        let last = lines.peek().is_none();
        if last && line.last() != Some(&b'\n') {
            break;
        }
        let number = entries.len() as u64 + 1;
        let problem = match serde_json::from_slice::<Entry>(line) {
            Ok(entry) if entry.id == number => {
                good += line.len();
                entries.push(entry);
                continue;
            }
            Ok(entry) => format!("has number {}", entry.id),
            Err(error) => format!("{error}"),
        };
        if last || (line.contains(&0) && is_one_turn(lines.clone())) {
            break;
        }
        return Err(JournalError::Damaged { path: path.to_owned(), line: number, found: problem });
    }
    Ok((entries, good))
}

/// Whether all lines that can be read are of the same turn.
fn is_one_turn<'a>(lines: impl Iterator<Item = &'a [u8]>) -> bool {
    let mut stamps = lines.filter_map(|line| serde_json::from_slice::<Entry>(line).ok()).map(|entry| entry.now_ns);
    let first = stamps.next();
    stamps.all(|stamp| Some(stamp) == first)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(id: u64) -> Entry {
        Entry {
            id,
            now_ns: 10 * id,
            record: Record::Command { command: VehicleCommand::Takeoff, altitude_m: 0.1 + 0.2 },
        }
    }

    #[test]
    fn what_is_appended_is_read_again_and_a_torn_line_is_cut() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("journal.jsonl");
        let (mut journal, none) = Journal::open(&path).unwrap();
        assert!(none.is_empty());
        journal.append(&[entry(1), entry(2)]).unwrap();
        let whole = std::fs::read(&path).unwrap();
        for torn in [&b"{\"id\":3,\"now"[..], b"{\"id\":3,\"now\n", b"\0\0\0"] {
            std::fs::write(&path, [&whole[..], torn].concat()).unwrap();
            let (mut journal, entries) = Journal::open(&path).unwrap();
            assert_eq!(entries, [entry(1), entry(2)]);
            journal.append(&[entry(3)]).unwrap();
            assert_eq!(Journal::open(&path).unwrap().1.len(), 3);
        }
    }

    #[test]
    fn a_damaged_line_in_the_middle_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("journal.jsonl");
        let (mut journal, _) = Journal::open(&path).unwrap();
        journal.append(&[entry(1), entry(2), entry(3)]).unwrap();
        let text = std::fs::read_to_string(&path).unwrap().replace("\"id\":2", "\"id\":7");
        std::fs::write(&path, text).unwrap();
        let message = Journal::open(&path).unwrap_err().to_string();
        assert!(message.contains("line 2") && message.contains("number 7"), "{message}");
    }

    #[test]
    fn every_number_comes_back_bit_for_bit() {
        let shot = Shot {
            keyframe_id: 3,
            reason: KeyframeReason::Selected,
            candidate: 5,
            position_m: [1.0 / 3.0, 0.1 + 0.2, -1e-17],
            look_at_m: [f64::MIN_POSITIVE, 2.0_f64.sqrt(), 1e300],
            score: 0.7,
        };
        let written = Entry {
            id: 1,
            now_ns: u64::MAX,
            record: Record::Selected {
                batch: 1,
                generation: 9,
                uncertainty_p95: 0.1,
                shots: vec![shot],
                scores: Vec::new(),
            },
        };
        let text = serde_json::to_string(&written).unwrap();
        assert_eq!(serde_json::from_str::<Entry>(&text).unwrap(), written);
    }
}
