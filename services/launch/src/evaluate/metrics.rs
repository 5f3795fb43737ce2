//! The keys of `report/metrics.json`. What was not measured is absent, never zero.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use shared_types::config::Config;
use world::truth::{Coverage as TrueCoverage, Geometry as Distances};

use super::flight::FlightRecord;
use super::journal::Journal;
use super::views::Quality;

/// The whole file.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Metrics {
    /// What was flown, and how it went.
    pub mission: Mission,
    /// The model as it was when the last round ended.
    pub live: Live,
    /// The model as trained offline on the same keyframes.
    #[serde(default)]
    pub offline: Offline,
    /// What was seen of the object.
    pub coverage: Coverage,
    /// How near the model is to the true surface.
    #[serde(default)]
    pub geometry: Geometry,
    /// Where the mission's time went.
    pub timing: Timing,
    /// `<service>_pss_mb`, `total_pss_mb`, `model_mb`: megabytes.
    pub memory: BTreeMap<String, f64>,
}

macro_rules! optional_figures {
    ($(#[$doc:meta])* pub struct $name:ident { $( $(#[$field_doc:meta])* pub $field:ident : $kind:ty ),* $(,)? }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
        pub struct $name {
            $( $(#[$field_doc])* #[serde(default, skip_serializing_if = "Option::is_none")] pub $field: Option<$kind> ),*
        }
    };
}

optional_figures! {
    /// `mission.*`.
    pub struct Mission {
        /// The mesh's file name, or `rock`.
        pub object: String,
        /// Largest extent, metres.
        pub size_m: f64,
        /// Turn about the vertical, degrees.
        pub yaw_deg: f64,
        /// Seed of everything random.
        pub seed: u64,
        /// Preset that the configuration started from.
        pub preset: String,
        /// What decided where to fly.
        pub strategy: String,
        /// What chose the views of a round.
        pub selector: String,
        /// The renderer.
        pub backend: String,
        /// Version of Vantage.
        pub version: String,
        /// How it ended.
        pub end_reason: String,
        /// The autopilot's estimator.
        pub estimator: String,
        /// Whether the run repeats bit for bit.
        pub deterministic: bool,
        /// Mission time, seconds.
        pub mission_s: f64,
        /// Wall time, seconds.
        pub wall_s: f64,
        /// Keyframes taken.
        pub keyframes: usize,
        /// Length flown, metres.
        pub path_m: f64,
        /// Least distance of the vehicle's centre from the object's surface in the air, metres.
        pub min_clearance_m: f64,
        /// How often the vehicle's rotors reached the object.
        pub collisions: usize,
        /// Training iterations run.
        pub iterations: u32,
        /// How often services were started again.
        pub restarts: BTreeMap<String, u32>,
    }
}

optional_figures! {
    /// `live.*`: means over the held-out views.
    pub struct Live {
        /// Object mask, radius R, dB.
        pub psnr_object_db: f64,
        /// Object mask, radius 0.8 R, dB.
        pub psnr_object_near_db: f64,
        /// Whole image, radius R, dB.
        pub psnr_frame_db: f64,
        /// Object mask, radius R.
        pub ssim_object: f64,
        /// The training views, as the trainer reported last, dB.
        pub psnr_train_db: f64,
        /// What one constant colour (the object's mean) scores, dB.
        pub psnr_null_db: f64,
        /// What the inserted, untrained Gaussians score, dB.
        pub psnr_init_db: f64,
        /// Gaussians of the model.
        pub gaussians: usize,
    }
}

optional_figures! {
    /// `offline.*`: means over the held-out views that `live.*` is measured on.
    pub struct Offline {
        /// Training iterations.
        pub iterations: u32,
        /// Object mask, radius R, dB.
        pub psnr_object_db: f64,
        /// Object mask, radius 0.8 R, dB.
        pub psnr_object_near_db: f64,
        /// Whole image, radius R, dB.
        pub psnr_frame_db: f64,
        /// Object mask, radius R.
        pub ssim_object: f64,
        /// Keyframes trained on: all, or those that were not held out.
        pub keyframes: usize,
        /// Gaussians of the model.
        pub gaussians: usize,
        /// Wall time of training, seconds.
        pub seconds: f64,
    }
}

optional_figures! {
    /// `coverage.*`, 0 to 1.
    pub struct Coverage {
        /// The paper's literal coverage.
        pub paper: f64,
        /// Seen once, of what can be seen once.
        pub cov1_feasible: f64,
        /// Seen twice, of what can be seen twice.
        pub cov2_feasible: f64,
        /// Seen once, of everything.
        pub cov1_total: f64,
        /// Seen twice, of everything.
        pub cov2_total: f64,
        /// Mean of `cov2_feasible` after each view.
        pub auc: f64,
    }
}

optional_figures! {
    /// `geometry.*`: centres of the Gaussians that are more than half opaque, beside the true surface.
    pub struct Geometry {
        /// Mean distance of the centres from the surface, metres.
        pub accuracy_m: f64,
        /// Mean distance of the feasible surface from the nearest centre, metres.
        pub completeness_m: f64,
        /// F-score at 1 % of the object's diameter, 0 to 1.
        pub f_score_1pct: f64,
        /// Mean of accuracy and completeness, metres.
        pub chamfer_m: f64,
    }
}

optional_figures! {
    /// `timing.*`, mission time. The first four do not overlap; together they are the time from takeoff to the end.
    pub struct Timing {
        /// In the air and under way, seconds.
        pub flight_s: f64,
        /// Taking views, seconds.
        pub capture_s: f64,
        /// Waiting for training, in the air or on the ground, seconds.
        pub training_s: f64,
        /// Waiting for scores, seconds.
        pub scoring_s: f64,
        /// Median over the rounds of the processor time of scoring one candidate, milliseconds.
        pub score_ms_p50: f64,
        /// 95th percentile of that, milliseconds.
        pub score_ms_p95: f64,
        /// Training iterations per second of training.
        pub iterations_per_s: f64,
    }
}

/// The name of a value that is an enum in the configuration, as in its file.
fn name_of(value: &impl Serialize) -> Option<String> {
    serde_json::to_value(value).ok()?.as_str().map(str::to_owned)
}

/// The value below which a share of the values lie (nearest rank); `None` of nothing.
fn percentile(values: &[f64], share: f64) -> Option<f64> {
    let mut sorted: Vec<f64> = values.iter().copied().filter(|value| value.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a rank within the values")]
    let rank = (share * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.saturating_sub(1)).copied()
}

/// A figure that means something: finite and above zero.
fn positive(value: f64) -> Option<f64> {
    (value.is_finite() && value > 0.0).then_some(value)
}

impl Metrics {
    /// What the configuration, the supervisor and the journal tell.
    #[must_use]
    pub fn of_folder(config: &Config, flight: &FlightRecord, journal: &Journal) -> Self {
        let simulated = config.link.is_local();
        let object = config.world.object.rsplit('/').next().unwrap_or_default().to_owned();
        let mission = Mission {
            object: simulated.then_some(object),
            size_m: simulated.then_some(config.world.size_m),
            yaw_deg: simulated.then_some(config.world.yaw_deg),
            seed: Some(config.mission.seed),
            preset: Some(config.mission.preset.clone()).filter(|preset| !preset.is_empty()),
            strategy: name_of(&config.planner.strategy),
            selector: name_of(&config.planner.selector),
            backend: None,
            version: Some(config.mission.version.clone()).filter(|version| !version.is_empty()),
            end_reason: journal.end_reason.clone().or_else(|| flight.end_reason.clone()),
            estimator: if simulated { name_of(&config.simulator.estimator) } else { None },
            deterministic: flight.deterministic,
            mission_s: journal.mission_s.or(flight.mission_s).and_then(positive),
            wall_s: flight.wall_s.and_then(positive),
            keyframes: flight.keyframes.map(|count| count as usize),
            path_m: flight.path_m.and_then(positive),
            min_clearance_m: None,
            collisions: None,
            iterations: journal.iterations.or(flight.iterations).filter(|count| *count > 0),
            restarts: Some(flight.restarts.clone()),
        };
        let live = Live {
            psnr_train_db: journal.psnr_train_db.or(flight.psnr_train_db).and_then(positive),
            ..Live::default()
        };
        let coverage =
            Coverage { paper: flight.paper_coverage.filter(|share| share.is_finite()), ..Coverage::default() };
        let rate = |iterations: u32, training_s: f64| positive(f64::from(iterations) / training_s);
        let timing = Timing {
            flight_s: journal.flight_s,
            capture_s: journal.capture_s,
            training_s: journal.training_s,
            scoring_s: journal.scoring_s,
            score_ms_p50: percentile(&flight.score_ms, 0.5),
            score_ms_p95: percentile(&flight.score_ms, 0.95),
            iterations_per_s: journal.iterations.zip(journal.rounds_s).and_then(|(count, time)| rate(count, time)),
        };
        Self {
            mission,
            live,
            offline: Offline::default(),
            coverage,
            geometry: Geometry::default(),
            timing,
            memory: flight.memory.clone(),
        }
    }
}

impl Live {
    /// Takes the figures of the held-out views.
    pub fn take(&mut self, quality: &Quality) {
        self.psnr_object_db = quality.object_db;
        self.psnr_object_near_db = quality.object_near_db;
        self.psnr_frame_db = quality.frame_db;
        self.ssim_object = quality.ssim_object;
        self.psnr_null_db = quality.null_db;
    }
}

impl Offline {
    /// Takes the figures of the held-out views.
    pub fn take(&mut self, quality: &Quality) {
        self.psnr_object_db = quality.object_db;
        self.psnr_object_near_db = quality.object_near_db;
        self.psnr_frame_db = quality.frame_db;
        self.ssim_object = quality.ssim_object;
    }
}

impl Geometry {
    /// Takes the distances, with the F-score at one threshold.
    pub fn take(&mut self, distances: &Distances) {
        self.accuracy_m = Some(distances.accuracy_m);
        self.completeness_m = Some(distances.completeness_m);
        self.f_score_1pct = distances.f_scores.first().map(|(_, score)| *score);
        self.chamfer_m = Some(distances.chamfer_m);
    }
}

impl Coverage {
    /// Takes the coverage of the true surface; nothing without views.
    pub fn take(&mut self, truth: &TrueCoverage) {
        if truth.curve.is_empty() {
            return;
        }
        self.cov1_feasible = Some(truth.cov1_feasible);
        self.cov2_feasible = Some(truth.cov2_feasible);
        self.cov1_total = Some(truth.cov1_total);
        self.cov2_total = Some(truth.cov2_total);
        self.auc = Some(truth.auc);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_not_measured_is_absent() {
        let metrics = Metrics::of_folder(&Config::default(), &FlightRecord::default(), &Journal::default());
        let json = serde_json::to_value(&metrics).expect("json");
        assert_eq!(json["mission"]["object"], "rock");
        assert_eq!(json["mission"]["strategy"], "nbv");
        assert_eq!(json["mission"]["estimator"], "exact");
        for absent in ["mission_s", "deterministic", "end_reason", "keyframes"] {
            assert!(json["mission"].get(absent).is_none(), "{absent}");
        }
        assert_eq!(json["live"], serde_json::json!({}));
        assert_eq!(json["timing"], serde_json::json!({}));
        assert_eq!(serde_json::from_value::<Metrics>(json).expect("read back"), metrics);
    }

    #[test]
    fn percentiles_are_by_nearest_rank() {
        let values: Vec<f64> = (1..=20).rev().map(f64::from).collect();
        assert_eq!((percentile(&values, 0.5), percentile(&values, 0.95)), (Some(10.0), Some(19.0)));
        assert_eq!((percentile(&[7.0], 0.95), percentile(&[], 0.5)), (Some(7.0), None));
    }

    #[test]
    fn no_views_are_no_coverage() {
        let mut coverage = Coverage::default();
        let none = TrueCoverage {
            cov1_feasible: 0.0,
            cov2_feasible: 0.0,
            cov1_total: 0.0,
            cov2_total: 0.0,
            curve: vec![],
            auc: 0.0,
        };
        coverage.take(&none);
        assert_eq!(coverage, Coverage::default());
        coverage.take(&TrueCoverage { curve: vec![0.5], auc: 0.5, ..none });
        assert_eq!(coverage.auc, Some(0.5));
    }
}
