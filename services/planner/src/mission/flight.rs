//! Choosing what to fly to next, flying there, and taking the view.

use glam::DVec3;
use shared_types::config::planner::{BatchOrder, Transit};
use shared_types::messages::{
    CaptureRequest, CaptureStatus, Commander, EndReason, FlightMode, KeyframeReason, TargetStatus, VehicleState,
    VehicleTarget, Waypoint, mission_key,
};
use shared_types::ns_from_s;
use shared_types::payload::unpack_text;

use super::{Mission, PRIOR_IDS};
use crate::io::{Effect, Inputs, Views};
use crate::journal::{Record, Shot};
use crate::logic::cost::{Speeds, best_order};
use crate::logic::path::{climb, length_m};
use crate::logic::view::{Aim, View, aim, turn_toward, wrap_angle};
use crate::state::{Flight, Goal, State};

/// A target is sent again so often until the vehicle's state names it.
const RESEND_NS: u64 = 200_000_000;
/// A target that the vehicle's state does not name within this time is given up.
const UNSEEN_NS: u64 = 5_000_000_000;
/// Paths that failed in a row after which a view is given up, or another way home taken.
const MOST_FAILURES: u32 = 8;
/// Legs along which the camera keeps looking at the object are divided to at most this, metres.
const LOOK_STEP_M: f64 = 1.0;
const LEAST_SPEED_MPS: f64 = 0.3;
/// Most waypoints of a way there; the way back has as many. Both fit the channel.
const MOST_WAYPOINTS: usize = 120;

impl Mission {
    pub(super) fn deciding(&mut self, views: &mut dyn Views) -> State {
        let Some(vehicle) = self.vehicle else { return State::Deciding };
        if vehicle.landed == 1 {
            return self.on_the_ground(&vehicle);
        }
        match Commander::from_code(vehicle.commander) {
            Some(Commander::Pilot) => return self.suspend(),
            Some(Commander::Failsafe) if self.homeward() => return State::Homing,
            _ => {}
        }
        if self.ledger.ending.is_some_and(|(_, land_here)| land_here) {
            return State::Landing;
        }
        if !self.homeward() && self.shifting(&vehicle) {
            // px4-link holds for that.
            return State::Deciding;
        }
        if !Self::under_control(&vehicle) {
            return State::Launching;
        }
        self.flown = true;
        if self.ledger.airborne.is_none() {
            self.record(Record::Airborne { home_m: vehicle.home_m });
        }
        if self.now_ns < self.retry_ns {
            return State::Deciding;
        }
        self.ensure_terrain();
        if self.homeward() {
            return self.go_home(&vehicle);
        }
        if self.ledger.prior.is_none() {
            return self.survey(&vehicle, views);
        }
        if !self.is_placed() {
            return self.find_world(&vehicle, views);
        }
        self.recover_captured(views);
        let left: Vec<Shot> = self.ledger.current().map(|(_, batch)| batch.left.clone()).unwrap_or_default();
        if left.is_empty() {
            if self.ledger.taken.len() >= self.setup.planner.keyframes_wanted() as usize {
                self.end(EndReason::Complete);
                return self.go_home(&vehicle);
            }
            return State::Deciding;
        }
        self.fly_next(&vehicle, &left)
    }

    fn on_the_ground(&mut self, vehicle: &VehicleState) -> State {
        // Touched down and not disarmed yet: after a restart on the way down nothing but the ending tells.
        if vehicle.armed == 1 && (self.flown || self.homeward()) {
            return State::Landing;
        }
        if self.homeward() {
            return State::Finishing;
        }
        if self.flown {
            // It came down without us: a pilot, or the autopilot.
            self.end(EndReason::Operator);
            return State::Finishing;
        }
        State::Preparing
    }

    /// What was taken while nobody listened is on disk all the same.
    pub(super) fn recover_captured(&mut self, views: &mut dyn Views) {
        let asked: Vec<Shot> =
            self.ledger.left().filter(|shot| self.ledger.captures.contains_key(&shot.keyframe_id)).copied().collect();
        for shot in asked {
            self.take_from_disk(&shot, views);
        }
    }

    fn take_from_disk(&mut self, shot: &Shot, views: &mut dyn Views) -> bool {
        let Some((view, gate_missed)) = views.read(shot.reason, shot.keyframe_id) else { return false };
        self.record(Record::Captured {
            keyframe_id: shot.keyframe_id,
            stamp_ns: view.stamp_ns,
            gate_missed,
            position_m: view.world_from_camera.position_m.to_array(),
        });
        true
    }

    pub(super) fn route(&self, from_m: DVec3, to_m: DVec3) -> Option<Vec<DVec3>> {
        let terrain = self.terrain.as_ref()?;
        if !terrain.space.volume.contains(to_m) {
            return None;
        }
        let config = &self.setup.planner;
        let climbed = match config.transit {
            Transit::Climb => climb(&terrain.space, from_m, to_m, config.climb_margin_m),
            Transit::Shortest => None,
        };
        climbed.or_else(|| terrain.roadmap.shortest(&terrain.space, from_m, to_m))
    }

    pub(super) fn return_point(&self) -> Option<DVec3> {
        let terrain = self.terrain.as_ref()?;
        Some(terrain.space.pushed_out(terrain.home_m + DVec3::Z * self.setup.planner.takeoff_height_m))
    }

    /// Flies to the next of the views left: the first of the quickest order of all of them (Section IV-E and A23).
    pub(super) fn fly_next(&mut self, vehicle: &VehicleState, left: &[Shot]) -> State {
        let from_m = DVec3::from_array(vehicle.setpoint_position_m);
        let yaw_rad = vehicle.setpoint_yaw_rad;
        let view = |shot: &Shot| View {
            position_m: DVec3::from_array(shot.position_m),
            look_at_m: DVec3::from_array(shot.look_at_m),
        };
        let aims: Vec<Aim> = left.iter().map(|shot| aim(&view(shot), &self.mount, yaw_rad)).collect();
        let usable = |at: &Aim| self.terrain.as_ref().is_some_and(|terrain| terrain.space.is_place(at.body_m));
        let paths: Vec<Option<Vec<DVec3>>> =
            aims.iter().map(|to| if usable(to) { self.route(from_m, to.body_m) } else { None }).collect();
        if let Some((shot, _)) = left.iter().zip(&paths).find(|(_, path)| path.is_none()) {
            let (shot, why) = (*shot, "no safe path".to_owned());
            self.give_up(&shot, why);
            return State::Deciding;
        }
        let paths: Vec<Vec<DVec3>> = paths.into_iter().flatten().collect();
        let next = match self.setup.planner.order {
            BatchOrder::Pick => 0,
            BatchOrder::Time => self.first_of_best(vehicle, &aims, &paths),
        };
        let (Some(shot), Some(to), Some(path)) = (left.get(next), aims.get(next), paths.get(next)) else {
            return State::Deciding;
        };
        let look_at = DVec3::from_array(shot.look_at_m);
        self.fly(vehicle, Goal::View(*shot), path, *to, Some(look_at))
    }

    fn first_of_best(&self, vehicle: &VehicleState, aims: &[Aim], paths: &[Vec<DVec3>]) -> usize {
        if aims.len() < 2 {
            return 0;
        }
        let speeds = Speeds::of(&self.setup.planner);
        let cost = |path: Option<Vec<DVec3>>, yaw: f64, pitch: f64| {
            path.map_or(f64::INFINITY, |path| speeds.leg_s(length_m(&path), yaw, pitch))
        };
        let start: Vec<f64> = aims
            .iter()
            .zip(paths)
            .map(|(to, path)| {
                let yaw = to.yaw_rad - vehicle.setpoint_yaw_rad;
                speeds.leg_s(length_m(path), yaw, to.pitch_rad - self.pitch_rad)
            })
            .collect();
        let between: Vec<Vec<f64>> = aims
            .iter()
            .map(|from| {
                let leg = |to: &Aim| {
                    let path = self.route(from.body_m, to.body_m);
                    cost(path, to.yaw_rad - from.yaw_rad, to.pitch_rad - from.pitch_rad)
                };
                aims.iter().map(|to| if to == from { 0.0 } else { leg(to) }).collect()
            })
            .collect();
        // The way back counts where it follows: after the last batch. Before, it would draw every batch's end homeward.
        let planned = self.ledger.taken.len() + self.ledger.left().count();
        let last =
            planned >= self.setup.planner.keyframes_wanted() as usize && self.ledger.left().count() == aims.len();
        let home: Vec<f64> = match self.return_point().filter(|_| last) {
            Some(point) => aims.iter().map(|from| cost(self.route(from.body_m, point), 0.0, 0.0)).collect(),
            None => vec![0.0; aims.len()],
        };
        best_order(&start, &between, &home).0.first().copied().unwrap_or(0)
    }

    fn go_home(&mut self, vehicle: &VehicleState) -> State {
        let from_m = DVec3::from_array(vehicle.setpoint_position_m);
        let path = self.return_point().and_then(|point| self.route(from_m, point));
        let Some(path) = path.filter(|_| self.flight_failures < MOST_FAILURES) else { return State::Homing };
        let Some(&body_m) = path.last() else { return State::Homing };
        self.fly(vehicle, Goal::Home, &path, Aim { body_m, yaw_rad: vehicle.setpoint_yaw_rad, pitch_rad: 0.0 }, None)
    }

    pub(super) fn fly(
        &mut self,
        vehicle: &VehicleState,
        goal: Goal,
        path: &[DVec3],
        to: Aim,
        look_at_m: Option<DVec3>,
    ) -> State {
        let begin = Aim {
            body_m: DVec3::from_array(vehicle.setpoint_position_m),
            yaw_rad: vehicle.setpoint_yaw_rad,
            pitch_rad: self.pitch_rad,
        };
        let mut waypoints = self.waypoints(path, begin, to, look_at_m);
        let there = waypoints.len();
        if goal != Goal::Home
            && let Some(back) = self.return_point().and_then(|point| self.route(to.body_m, point))
        {
            let end = Aim { body_m: back.last().copied().unwrap_or(to.body_m), ..to };
            waypoints.extend(self.waypoints(&back, to, end, None));
        }
        let Some(terrain) = &self.terrain else { return State::Deciding };
        let volume = terrain.space.volume;
        let rows = |points: &[Waypoint]| -> Vec<[f64; 6]> {
            let row = |w: &Waypoint| {
                [w.position_m[0], w.position_m[1], w.position_m[2], w.yaw_rad, w.gimbal_pitch_rad, w.speed_mps]
            };
            points.iter().map(row).collect()
        };
        let (purpose, keyframe_id) = match goal {
            Goal::View(shot) => (shot.reason.name(), Some(shot.keyframe_id)),
            Goal::Scan(_) => ("scan", None),
            Goal::Home => ("home", None),
        };
        let (out, back) = waypoints.split_at(there);
        let record = Record::Target { purpose: purpose.to_owned(), keyframe_id, path: rows(out), back: rows(back) };
        let expected_s: f64 = out.windows(2).map(leg_s).sum();
        let back_len = back.len();
        let id = self.record(record);
        self.pitch_rad = to.pitch_rad;
        #[expect(clippy::cast_possible_truncation, reason = "at most a few hundred waypoints")]
        let target = VehicleTarget {
            id,
            mission: mission_key(&self.setup.mission_id, &self.setup.folder),
            volume_min_m: volume.min_m.to_array(),
            volume_max_m: volume.max_m.to_array(),
            path_len: there as u32,
            return_len: back_len as u32,
        };
        self.out.effects.push(Effect::Target(target, waypoints.clone()));
        State::Flying(Box::new(Flight {
            goal,
            target,
            waypoints,
            began_ns: self.now_ns,
            sent_ns: self.now_ns,
            overdue_ns: self.now_ns + ns_from_s(30.0 + 4.0 * expected_s),
            seen: false,
        }))
    }

    /// The waypoints of a path: yaw and gimbal keep looking at the object, or turn evenly from begin to end; the speed
    /// leaves time for both.
    fn waypoints(&self, path: &[DVec3], begin: Aim, end: Aim, look_at_m: Option<DVec3>) -> Vec<Waypoint> {
        let mut points = Vec::new();
        for leg in path.windows(2) {
            let length = (leg[1] - leg[0]).length();
            let parts = if look_at_m.is_some() { (length / LOOK_STEP_M).ceil().clamp(1.0, 12.0) } else { 1.0 };
            let mut part = 0.0;
            while part < parts {
                points.push(leg[0].lerp(leg[1], part / parts));
                part += 1.0;
            }
        }
        points.push(end.body_m);
        if points.len() > MOST_WAYPOINTS {
            points = path.to_vec();
        }
        let whole = length_m(&points).max(1e-9);
        let speeds = Speeds::of(&self.setup.planner);
        let (mut yaw, mut pitch, mut along) = (begin.yaw_rad, begin.pitch_rad, 0.0);
        let mut waypoints: Vec<Waypoint> = Vec::new();
        let last = points.len() - 1;
        for (at, point) in points.iter().enumerate() {
            let length = if at == 0 { 0.0 } else { (*point - points[at - 1]).length() };
            along += length;
            let (next_yaw, next_pitch) = if at == last {
                (end.yaw_rad, end.pitch_rad)
            } else if at == 0 {
                (yaw, pitch)
            } else if let Some(look_at) = look_at_m {
                let (toward, down) = turn_toward(*point, look_at, yaw);
                (toward, down.min(0.3))
            } else {
                let share = along / whole;
                let turned = begin.yaw_rad + wrap_angle(end.yaw_rad - begin.yaw_rad) * share;
                (turned, begin.pitch_rad + (end.pitch_rad - begin.pitch_rad) * share)
            };
            let turn_s = (wrap_angle(next_yaw - yaw).abs() / speeds.yaw_rate_radps)
                .max((next_pitch - pitch).abs() / speeds.gimbal_rate_radps);
            let turning = if turn_s > 1e-6 { length / turn_s } else { f64::INFINITY };
            (yaw, pitch) = (wrap_angle(next_yaw), next_pitch);
            waypoints.push(Waypoint {
                position_m: point.to_array(),
                yaw_rad: yaw,
                gimbal_pitch_rad: pitch,
                speed_mps: turning.clamp(LEAST_SPEED_MPS.min(speeds.speed_mps), speeds.speed_mps),
            });
        }
        waypoints
    }

    pub(super) fn flying(&mut self, mut flight: Box<Flight>) -> State {
        let Some(vehicle) = self.vehicle else { return State::Flying(flight) };
        let leaves = self.homeward() && flight.goal != Goal::Home;
        if leaves || !Self::under_control(&vehicle) {
            return State::Deciding;
        }
        if vehicle.target_id != flight.target.id {
            if flight.seen || self.now_ns > flight.began_ns + UNSEEN_NS {
                return self.flight_failed(&flight.goal, "the path was not taken or is forgotten");
            }
            if self.now_ns >= flight.sent_ns + RESEND_NS {
                flight.sent_ns = self.now_ns;
                self.out.effects.push(Effect::Target(flight.target, flight.waypoints.clone()));
            }
            return State::Flying(flight);
        }
        flight.seen = true;
        match TargetStatus::from_code(vehicle.target_status) {
            Some(TargetStatus::Arrived) => self.arrived(flight),
            Some(TargetStatus::RefusedOld | TargetStatus::RefusedStart | TargetStatus::RefusedPath) => {
                self.flight_failed(&flight.goal, "the path was refused")
            }
            Some(TargetStatus::Held) => self.flight_failed(&flight.goal, "the path was held"),
            Some(TargetStatus::Flying | TargetStatus::None) | None if self.now_ns > flight.overdue_ns => {
                self.flight_failed(&flight.goal, "the end was not reached in time")
            }
            Some(TargetStatus::Flying | TargetStatus::None) | None => State::Flying(flight),
        }
    }

    fn flight_failed(&mut self, goal: &Goal, why: &str) -> State {
        tracing::debug!(why, "planning anew");
        self.flight_failures += 1;
        self.retry_ns = self.now_ns + 300_000_000;
        if self.flight_failures >= MOST_FAILURES {
            match goal {
                Goal::View(shot) => {
                    let shot = *shot;
                    self.flight_failures = 0;
                    self.give_up(&shot, why.to_owned());
                }
                Goal::Scan(_) => self.flight_failures = 0,
                Goal::Home => return State::Homing,
            }
        }
        State::Deciding
    }

    fn arrived(&mut self, flight: Box<Flight>) -> State {
        self.flight_failures = 0;
        match flight.goal {
            Goal::View(shot) => {
                let deadline_ns = self.now_ns + ns_from_s(self.setup.planner.capture_deadline_s);
                let id = self.record(Record::Capture { shot, target: flight.target.id, deadline_ns });
                let request = CaptureRequest {
                    keyframe_id: shot.keyframe_id,
                    target_id: flight.target.id,
                    deadline_ns,
                    look_at_m: shot.look_at_m,
                    reason: shot.reason.code(),
                    candidate: shot.candidate,
                };
                self.out.effects.push(Effect::Capture(id, request));
                State::Capturing(flight, id, deadline_ns)
            }
            Goal::Scan(step) => State::Looking(step, self.now_ns),
            Goal::Home => State::Landing,
        }
    }

    pub(super) fn capturing(
        &mut self,
        flight: Box<Flight>,
        request: u64,
        deadline_ns: u64,
        inputs: &Inputs,
        views: &mut dyn Views,
    ) -> State {
        let Goal::View(shot) = flight.goal else { return State::Deciding };
        let mut failure = None;
        for (_, reply) in inputs.capture_replies.iter().filter(|(id, _)| *id == request) {
            match CaptureStatus::from_code(reply.status) {
                Some(CaptureStatus::Stored) => {
                    if self.take_from_disk(&shot, views) {
                        self.out.effects.push(Effect::CaptureOver(request));
                        return State::Deciding;
                    }
                    failure = Some("stored, but not to be read from the mission folder".to_owned());
                }
                Some(status) => failure = Some(format!("{status}: {}", unpack_text(&reply.reason))),
                None => {}
            }
        }
        // The camera keeps its own deadline; its word is waited for a little longer.
        if failure.is_none() && self.now_ns > deadline_ns + 2_000_000_000 {
            failure = Some("no answer before the deadline".to_owned());
        }
        if let Some(why) = failure {
            tracing::warn!(keyframe = shot.keyframe_id, why, "a view was not taken");
            self.out.effects.push(Effect::CaptureOver(request));
            self.record(Record::CaptureFailed { keyframe_id: shot.keyframe_id, why: why.clone() });
            let failures = self.ledger.failures.get(&shot.keyframe_id).copied().unwrap_or(0);
            if failures >= self.setup.planner.capture_attempts {
                self.give_up(&shot, why);
            }
            return State::Deciding;
        }
        let lost = self.vehicle.is_some_and(|vehicle| {
            vehicle.target_id != flight.target.id
                || vehicle.target_status == TargetStatus::Held.code()
                || vehicle.mode != FlightMode::Offboard.code()
        });
        if self.homeward() || lost {
            self.out.effects.push(Effect::CaptureOver(request));
            return State::Deciding;
        }
        State::Capturing(flight, request, deadline_ns)
    }

    fn give_up(&mut self, shot: &Shot, why: String) {
        if matches!(shot.reason, KeyframeReason::CheckOverhead | KeyframeReason::CheckSide) {
            self.misaligned(None, &format!("the prior's views cannot be taken again: {why}"));
            return;
        }
        if shot.keyframe_id >= PRIOR_IDS {
            // Without the prior there is no mission.
            let blocked = !self.ledger.failures.contains_key(&shot.keyframe_id);
            self.end(if blocked { EndReason::NoCandidates } else { EndReason::ServiceFailed });
            return;
        }
        tracing::info!(keyframe = shot.keyframe_id, why, "a view is given up");
        self.record(Record::Dropped { keyframe_id: shot.keyframe_id, candidate: shot.candidate, why });
    }
}

fn leg_s(leg: &[Waypoint]) -> f64 {
    match leg {
        [from, to] => {
            let length = (DVec3::from_array(to.position_m) - DVec3::from_array(from.position_m)).length();
            length / to.speed_mps.max(LEAST_SPEED_MPS)
        }
        _ => 0.0,
    }
}
