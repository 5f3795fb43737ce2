//! What is kept of every fault and mission, a line of JSON each.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::load::Loads;

/// No setpoint is farther from the one before.
const LARGEST_STEP_M: f64 = 0.3;
/// Radius of the vehicle and the error of an exact estimator: what the path planner's clearance is made of, without its
/// margin, which may be eaten up by braking.
const LEAST_CLEARANCE_M: f64 = 0.47;

/// One fault.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Fault {
    /// Index of the mission.
    pub mission: u64,
    /// What was hit.
    pub service: String,
    /// What was done to it.
    #[serde(default = "kill")]
    pub blow: String,
    /// Where the mission was.
    pub phase: String,
    /// Wall time from the fault until the service's new process did useful work, milliseconds; absent where none came: the
    /// mission was at its end, launch itself was hit, or the process was only stopped.
    pub work_ms: Option<f64>,
    /// The same until px4-link flew the vehicle by setpoints again; absent where it did not, or was not hit.
    #[serde(default)]
    pub offboard_ms: Option<f64>,
}

fn kill() -> String {
    "kill".to_owned()
}

/// One mission.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Mission {
    /// Its index.
    pub mission: u64,
    /// Its seed.
    #[serde(default)]
    pub seed: u64,
    /// How it ended, by its journal.
    pub end_reason: String,
    /// Keyframes that are missing, and that the journal has more than once.
    pub lost: usize,
    /// See `lost`.
    pub doubled: usize,
    /// PSNR of the object, dB.
    pub psnr_db: Option<f64>,
    /// Least distance to anything, metres.
    pub clearance_m: Option<f64>,
    /// Longest way between two setpoints of a stream, metres.
    #[serde(default)]
    pub largest_step_m: f64,
    /// Collisions.
    pub collisions: u64,
    /// Files and folders left in shared memory.
    pub leftovers: usize,
    /// Wall time.
    pub wall_s: f64,
    /// The most that each process held, by name.
    #[serde(default)]
    pub loads: Loads,
    /// Bytes in use in `/dev/shm` after it.
    #[serde(default)]
    pub shared_memory_bytes: u64,
    /// What went wrong otherwise; empty where nothing did.
    pub error: String,
}

impl Mission {
    /// Whether it completed with every keyframe once, without touching anything or leaving anything behind.
    pub fn is_well(&self) -> bool {
        self.end_reason == "complete"
            && self.lost + self.doubled + self.leftovers == 0
            && self.collisions == 0
            && self.largest_step_m <= LARGEST_STEP_M
            && self.clearance_m.is_none_or(|metres| metres >= LEAST_CLEARANCE_M)
            && self.error.is_empty()
    }

    /// In words.
    pub fn verdict(&self) -> String {
        if self.is_well() {
            return "well".to_owned();
        }
        format!(
            "NOT WELL: ended \"{}\", {} keyframes lost, {} doubled, {} left over, {} collisions, step {:.2} m, clearance {:?} m {}",
            self.end_reason,
            self.lost,
            self.doubled,
            self.leftovers,
            self.collisions,
            self.largest_step_m,
            self.clearance_m,
            self.error
        )
    }
}

/// A mission and its faults.
#[derive(Debug)]
pub struct Flown {
    /// The mission.
    pub mission: Mission,
    /// Its faults.
    pub faults: Vec<Fault>,
}

/// All that was flown, in a file.
#[derive(Debug)]
pub struct Results {
    path: PathBuf,
    /// Missions in their order.
    pub missions: Vec<Mission>,
    /// Faults in their order.
    pub faults: Vec<Fault>,
}

#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum Line {
    Fault(Fault),
    Mission(Mission),
}

impl Results {
    /// What a folder holds; lines that were cut off are passed over, and so are the faults of a mission without its own.
    pub fn open(folder: &Path) -> Self {
        fs::create_dir_all(folder).expect("the folder of results");
        let path = folder.join("results.jsonl");
        let (mut missions, mut faults) = (Vec::new(), Vec::new());
        for line in fs::read_to_string(&path).unwrap_or_default().lines() {
            match serde_json::from_str(line) {
                Ok(Line::Mission(mission)) => missions.push(mission),
                Ok(Line::Fault(fault)) => faults.push(fault),
                Err(_) => {}
            }
        }
        faults.retain(|fault| missions.iter().any(|mission| mission.mission == fault.mission));
        Self { path, missions, faults }
    }

    /// Adds a mission, on disk too.
    pub fn add(&mut self, flown: Flown) {
        let mut file = fs::File::options().create(true).append(true).open(&self.path).expect("results.jsonl");
        for fault in &flown.faults {
            writeln!(file, "{}", serde_json::to_string(fault).expect("JSON")).expect("written");
        }
        writeln!(file, "{}", serde_json::to_string(&flown.mission).expect("JSON")).expect("written");
        self.faults.extend(flown.faults);
        self.missions.push(flown.mission);
    }
}
