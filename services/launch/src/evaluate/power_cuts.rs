//! A loss of power while a run's figures are written: each file is the old or the new, and a track loses a run's end at most.

use std::collections::BTreeMap;
use std::sync::Arc;

use shared_types::folder::MissionFolder;
use shared_types::messages::Truth;
use shared_types::storage;
use shared_types::storage::record::Recorder;
use shared_types::storage::replay::every_outcome;

use super::{Metrics, flight, read_metrics, write_metrics};
use crate::supervise::memory::Memory;
use crate::supervise::track::{self, Track};
use crate::supervise::{Flight, Outcome};

fn flight_of(wall_s: f64) -> Flight {
    Flight {
        outcome: Outcome::Done,
        last: None,
        mission_s: None,
        wall_s,
        restarts: BTreeMap::new(),
        deterministic: Some(true),
        memory: Memory::default(),
        score_ms: vec![0.1; 30],
        last_words: None,
    }
}

fn track_of(run: u64, points: u64) -> Track {
    let mut track = Track::default();
    for point in 0..points {
        let position_m = [point as f64 / 7.0, run as f64, 2.5];
        track.note(&Truth { now_ns: (run * 1000 + point) * 50_000_000, position_m, ..Truth::default() });
    }
    track
}

fn metrics_of(runs: usize) -> Metrics {
    let mut metrics = Metrics::default();
    metrics.live.gaussians = Some(runs);
    metrics
}

#[test]
fn figures_are_the_old_or_the_new_and_a_track_loses_no_point_of_earlier_runs() {
    let dir = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
    let folder = MissionFolder::create(dir.path().join("m")).expect("made");
    let finish = |run: u64| {
        track_of(run, 300).append(&folder.report_path()).expect("track");
        flight::write(&folder, &flight_of(1.0)).expect("flight");
        write_metrics(&folder, &metrics_of(run as usize)).expect("metrics");
    };
    finish(1);
    let recorder = Recorder::new(folder.root()).expect("read");
    let mount = storage::mount(folder.root(), Arc::new(recorder.clone()));
    finish(2);
    drop(mount);
    let all = track::read(&folder.report_path());
    assert_eq!(all.len(), 600);
    let findings = every_outcome(&recorder.trace(), &dir.path().join("after"), |root| {
        let text = |error: anyhow::Error| error.to_string();
        let folder = MissionFolder::open(root).map_err(|error| error.to_string())?;
        let points = track::read(&folder.report_path());
        // Blocks may be missing: what is read are points that were flown, in their order, and all of the first run.
        let mut flown = all.iter();
        if points.get(..300) != all.get(..300) || !points.iter().all(|point| flown.any(|known| known == point)) {
            return Err(format!("{} points, and not those that were flown", points.len()));
        }
        // A third run goes on behind whatever was left of the second.
        track_of(3, 2).append(&folder.report_path()).map_err(|error| error.to_string())?;
        if track::read(&folder.report_path()).len() != points.len() + 2 {
            return Err("the next run's points are not read".to_owned());
        }
        let runs = flight::read(&folder).map_err(text)?.runs;
        let metrics = read_metrics(&folder).map_err(text)?.and_then(|metrics| metrics.live.gaussians);
        match (points.len(), runs, metrics) {
            (300.., 1, Some(1)) => Ok("old"),
            (600, 2, Some(1)) => Ok("between"),
            (600, 2, Some(2)) => Ok("new"),
            other => Err(format!("{other:?}")),
        }
    })
    .unwrap_or_else(|why| panic!("{why}"));
    println!("report/: {} cuts, {} outcomes: {:?}", findings.places, findings.distinct, findings.by_name);
    assert_eq!(findings.by_name.len(), 3, "{findings:?}");
}
