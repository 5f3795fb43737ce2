//! `report/track.csv`: where the simulated vehicle truly flew, for judging its clearance. Written after the flight, over
//! all runs of a mission; no service reads it.

use std::fmt::Write as _;
use std::fs::OpenOptions;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use glam::DVec3;
use shared_types::messages::Truth;

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
        std::fs::create_dir_all(report)?;
        let path = path(report);
        let fresh = !path.exists();
        let mut file = OpenOptions::new().create(true).append(true).open(path)?;
        if fresh {
            file.write_all(HEADING.as_bytes())?;
        }
        file.write_all(self.lines.as_bytes())
    }
}

fn path(report: &Path) -> PathBuf {
    report.join("track.csv")
}

/// The points of a mission; none when it was not simulated. A line cut by a full disk is left out.
#[must_use]
pub fn read(report: &Path) -> Vec<DVec3> {
    let text = std::fs::read_to_string(path(report)).unwrap_or_default();
    text.lines()
        .skip(1)
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
