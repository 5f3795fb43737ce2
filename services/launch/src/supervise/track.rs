//! `report/track.csv`: where the simulated vehicle truly flew, for judging its clearance. Written after the flight, over
//! all runs of a mission; no service reads it.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use glam::DVec3;
use shared_types::folder::create_dir_durable;
use shared_types::messages::Truth;
use shared_types::storage;

/// Mission time between points.
const PERIOD_NS: u64 = 50_000_000;
/// No vehicle of ours flies so far in that time.
const LARGEST_STEP_M: f64 = 1.0;
const HEADING: &str = "mission_s,x_m,y_m,z_m\n";

/// Points of a run.
#[derive(Debug, Default)]
pub struct Track {
    lines: String,
    last_ns: Option<u64>,
}

impl Track {
    /// Takes a truth message, and keeps a point every 50 ms of mission time.
    pub fn note(&mut self, truth: &Truth) {
        if self.last_ns.is_some_and(|last| truth.now_ns < last + PERIOD_NS) {
            return;
        }
        self.last_ns = Some(truth.now_ns);
        let [x, y, z] = truth.position_m;
        // Writing to text in memory cannot fail.
        writeln!(self.lines, "{:.2},{x:.4},{y:.4},{z:.4}", shared_types::s_from_ns(truth.now_ns)).ok();
    }

    /// Appends the points of this run to the mission's.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn append(&self, report: &Path) -> std::io::Result<()> {
        if self.lines.is_empty() {
            return Ok(());
        }
        create_dir_durable(report).map_err(std::io::Error::other)?;
        let path = path(report);
        let before = std::fs::read(&path).unwrap_or_default();
        let whole = before.iter().rposition(|byte| *byte == b'\n').map_or(0, |end| end + 1);
        let disk = storage::of(&path);
        let mut file = disk.append(&path)?;
        if whole < before.len() {
            // A run was cut off in the middle of a line.
            file.cut(whole as u64)?;
        }
        let heading = if whole == 0 { HEADING } else { "" };
        file.write(format!("{heading}{}", self.lines).as_bytes())?;
        file.sync()?;
        disk.sync_dir(report)
    }
}

fn path(report: &Path) -> PathBuf {
    report.join("track.csv")
}

/// The points of a mission; none when it was not simulated. A line that was cut is left out: its last number may lack digits.
#[must_use]
pub fn read(report: &Path) -> Vec<DVec3> {
    let bytes = std::fs::read(path(report)).unwrap_or_default();
    // Blocks that never reached the disk are zeros, and no text: the lines around them stand.
    let text = String::from_utf8_lossy(&bytes);
    text.split_inclusive('\n')
        .skip(1)
        .filter_map(|line| line.strip_suffix('\n'))
        .filter_map(|line| {
            let numbers: Vec<f64> = line.split(',').map(str::parse).collect::<Result<_, _>>().ok()?;
            match numbers[..] {
                [_, x, y, z] if numbers.iter().all(|number| number.is_finite()) => Some(DVec3::new(x, y, z)),
                _ => None,
            }
        })
        .collect()
}

/// Length of a track, metres. A jump to where the next run of a mission began is no part of it.
#[must_use]
pub fn length_m(points: &[DVec3]) -> f64 {
    points.windows(2).map(|pair| (pair[1] - pair[0]).length()).filter(|step| *step < LARGEST_STEP_M).sum()
}

#[cfg(test)]
mod tests {
    use std::fs::OpenOptions;
    use std::io::Write as _;

    use super::*;

    #[test]
    fn points_of_several_runs_are_read_back_and_torn_lines_are_not() {
        let report = tempfile::tempdir().expect("folder");
        for run in 0..2_u64 {
            let mut track = Track::default();
            for tick in 0..20_u64 {
                let now_ns = (run * 20 + tick) * 10_000_000;
                track.note(&Truth { now_ns, position_m: [tick as f64, run as f64, 2.5], ..Truth::default() });
            }
            track.append(report.path()).expect("written");
        }
        let mut file = OpenOptions::new().append(true).open(path(report.path())).expect("there");
        file.write_all(b"9.9,1.0,2.").expect("torn");
        let points = read(report.path());
        assert_eq!(points.len(), 8, "every fifth tick of two runs");
        assert_eq!(points[5], DVec3::new(5.0, 1.0, 2.5));
        assert!(read(Path::new("/nonexistent")).is_empty());
        assert_eq!(length_m(&[DVec3::ZERO, DVec3::X * 0.1, DVec3::new(0.1, 0.1, 0.0), DVec3::splat(5.0)]), 0.2);
    }
}
