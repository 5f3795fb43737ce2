//! The survey of the object: prior views, yaw scan, prior (Section IV-B, A19).

use core::f64::consts::{FRAC_PI_2, TAU};

use glam::DVec3;
use shared_types::config::planner::Strategy;
use shared_types::messages::{EndReason, KeyframeReason, VehicleState};
use shared_types::{NS_PER_S, ns_from_s};

use super::{Mission, PRIOR_IDS};
use crate::io::{Inputs, Views};
use crate::journal::{Record, Shot};
use crate::logic::candidates::{PitchLimits, generate};
use crate::logic::depth::DepthView;
use crate::logic::prior::{estimate, find_object};
use crate::logic::space::FreeSpace;
use crate::logic::view::Aim;
use crate::state::{Goal, State};

/// Stops of the yaw scan.
const SCAN_STOPS: u32 = 8;

impl Mission {
    /// The prior: overhead view, side view, box; a yaw scan where nothing stands there (Section IV-B, A19).
    pub(super) fn survey(&mut self, vehicle: &VehicleState, views: &mut dyn Views) -> State {
        if self.ledger.scanning {
            return self.scan(vehicle);
        }
        for reason in [KeyframeReason::PriorOverhead, KeyframeReason::PriorSide] {
            if self.survey_view(reason).is_none() {
                let shot = self.prior_shot(vehicle, reason);
                return self.fly_next(vehicle, &[shot]);
            }
        }
        let config = &self.setup.planner;
        let survey_m = self.survey_m();
        let [overhead, side] =
            [KeyframeReason::PriorOverhead, KeyframeReason::PriorSide].map(|reason| self.read_survey(reason, views));
        let (Some(overhead), Some(side)) = (overhead, side) else {
            tracing::warn!("the views of the prior cannot be read from the mission folder");
            self.end(EndReason::ServiceFailed);
            return State::Deciding;
        };
        let Some(prior) = estimate(&overhead, &side, survey_m, survey_m.z, config) else {
            if self.ledger.scans == 0 {
                self.scan_step = 0;
                self.record(Record::Scan);
            } else {
                self.end(EndReason::NoObject);
            }
            return State::Deciding;
        };
        if prior.clamped {
            tracing::warn!(
                extents_m = ?prior.extents_m,
                largest_box_m = config.box_max_m,
                "the object is larger than the largest box and is cut: raise planner.box_max_m"
            );
        }
        let limits = self.pitch_limits(vehicle);
        let candidates = self.terrain.as_ref().map(|terrain| {
            let space = FreeSpace::around_prior(&prior, terrain.space.volume, self.mount.least_drop_m(), config);
            generate(&prior, &space, &self.mount, limits, config)
        });
        let candidates = candidates.unwrap_or_default();
        let dropped = candidates.dropped;
        self.record(Record::Prior {
            prior,
            pitch_limits_rad: [limits.min_rad, limits.max_rad],
            candidates: u32::try_from(candidates.list.len()).unwrap_or(u32::MAX),
            left_out: [dropped.low, dropped.unsafe_place, dropped.gimbal],
        });
        self.renew_terrain();
        if candidates.list.is_empty() && self.setup.planner.strategy == Strategy::Nbv {
            self.end(EndReason::NoCandidates);
        }
        // The first batch is chosen before the next look.
        State::Deciding
    }

    fn pitch_limits(&self, vehicle: &VehicleState) -> PitchLimits {
        if vehicle.gimbal_present == 0 {
            // A fixed camera: what it looks at need only be well inside the image.
            let fixed = self.setup.camera.fixed_pitch_rad;
            return PitchLimits { min_rad: fixed - 0.25, max_rad: fixed + 0.25 };
        }
        let (min_rad, max_rad) = (vehicle.gimbal_pitch_min_rad, vehicle.gimbal_pitch_max_rad);
        if min_rad < max_rad {
            PitchLimits { min_rad, max_rad }
        } else {
            PitchLimits { min_rad: -FRAC_PI_2, max_rad: 0.35 }
        }
    }

    /// Id of the view taken for a reason, where that was in this flight: an earlier one's world lies elsewhere.
    pub(super) fn survey_view(&self, reason: KeyframeReason) -> Option<u64> {
        let (id, at_ns) = self.ledger.prior_views.get(&reason.code())?;
        (*at_ns >= self.setup.epoch_ns).then_some(*id)
    }

    /// The newest view taken for a reason, of whichever flight.
    pub(super) fn read_survey(&self, reason: KeyframeReason, views: &mut dyn Views) -> Option<DepthView> {
        let (id, _) = self.ledger.prior_views.get(&reason.code())?;
        views.read(reason, *id).map(|(view, _)| view)
    }

    pub(super) fn prior_shot(&self, vehicle: &VehicleState, reason: KeyframeReason) -> Shot {
        let config = &self.setup.planner;
        let survey_m = self.survey_m();
        let limits = self.pitch_limits(vehicle);
        let home = DVec3::from_array(self.ledger.airborne.map_or(vehicle.home_m, |(_, home_m)| home_m));
        let toward_home = (home - survey_m).with_z(0.0).normalize_or(DVec3::NEG_X);
        let from_above = matches!(reason, KeyframeReason::PriorOverhead | KeyframeReason::CheckOverhead);
        let (position_m, look_at_m) = if from_above {
            // Where the gimbal cannot look straight down, as steeply as it can from the same distance.
            let pitch = (-FRAC_PI_2).max(limits.min_rad);
            let away = toward_home * pitch.cos() - DVec3::Z * pitch.sin();
            (survey_m + away * config.overhead_height_m, survey_m)
        } else {
            let across = (config.side_distance_m.powi(2) - config.side_height_m.powi(2)).max(1.0).sqrt();
            let side = survey_m + toward_home * across + DVec3::Z * config.side_height_m;
            (side, survey_m + DVec3::Z * config.side_height_m / 2.0)
        };
        Shot {
            keyframe_id: self.survey_id(reason, from_above),
            reason,
            candidate: u32::MAX,
            position_m: position_m.to_array(),
            look_at_m: look_at_m.to_array(),
            score: 0.0,
        }
    }

    /// Another number in every flight, for every survey, and whenever the world has moved: the camera takes no image twice.
    fn survey_id(&self, reason: KeyframeReason, from_above: bool) -> u64 {
        let checks = matches!(reason, KeyframeReason::CheckOverhead | KeyframeReason::CheckSide);
        let place = if checks { 500 + self.shifts() as u64 * 2 } else { u64::from(self.ledger.scans) * 2 };
        PRIOR_IDS + self.setup.epoch_ns / NS_PER_S * 1000 + place + u64::from(!from_above)
    }

    fn scan(&mut self, vehicle: &VehicleState) -> State {
        if self.scan_step >= SCAN_STOPS {
            self.end(EndReason::NoObject);
            return State::Deciding;
        }
        let Some(terrain) = &self.terrain else { return State::Deciding };
        let limits = self.pitch_limits(vehicle);
        let yaw_rad = TAU * f64::from(self.scan_step) / f64::from(SCAN_STOPS);
        let pitch_rad = (-35.0_f64).to_radians().clamp(limits.min_rad, limits.max_rad);
        // Slowly down and up while turning: a path needs a length.
        let height = self.setup.planner.overhead_height_m - 0.1 * f64::from(self.scan_step % 2);
        let body_m = terrain.space.pushed_out(terrain.survey_m + DVec3::Z * height);
        let step = self.scan_step;
        self.scan_step += 1;
        match self.route(DVec3::from_array(vehicle.setpoint_position_m), body_m) {
            Some(path) => self.fly(vehicle, Goal::Scan(step), &path, Aim { body_m, yaw_rad, pitch_rad }, None),
            None => State::Deciding,
        }
    }

    pub(super) fn looking(&mut self, step: u32, since_ns: u64, inputs: &Inputs) -> State {
        let config = &self.setup.planner;
        if self.homeward() || self.vehicle.is_none_or(|vehicle| !Self::under_control(&vehicle)) {
            return State::Deciding;
        }
        if let Some(view) = inputs.depths.iter().find(|view| view.stamp_ns >= since_ns) {
            let reach = config.volume_half_width_m * 0.8;
            if let Some(point) = find_object(view, self.survey_m(), reach, self.survey_m().z) {
                self.record(Record::Survey { point_m: point.to_array() });
                self.renew_terrain();
            }
            return State::Deciding;
        }
        if self.now_ns > since_ns + ns_from_s(config.capture_deadline_s) {
            return State::Deciding;
        }
        State::Looking(step, since_ns)
    }
}
