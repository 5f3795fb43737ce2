//! Getting into the air, out of it, and what ends a mission.

use glam::DVec3;
use shared_types::messages::{
    ChargeState, Commander, EndReason, FailsafeReason, FlightMode, VehicleCommand, VehicleState,
};
use shared_types::ns_from_s;

use super::Mission;
use crate::io::Views;
use crate::journal::Record;
use crate::logic::depth::DepthView;
use crate::state::State;

/// Link age at which the mission ends, seconds.
const LINK_LOST_S: f64 = 10.0;
/// Link age from which nothing is asked of a vehicle in the air: px4-link decides nothing in such a silence either.
const LINK_QUIET_NS: u64 = 500_000_000;
/// How long a failsafe may stay without a reason, nanoseconds.
const UNEXPLAINED_NS: u64 = 3_000_000_000;
/// Refusals after which a command is not tried again.
pub(super) const MOST_REFUSALS: u32 = 3;

impl Mission {
    pub(super) fn heard(&mut self, vehicle: VehicleState) {
        if let Some(before) = &self.vehicle
            && vehicle.landed == 0
            && vehicle.position_stamp_ns > 0
        {
            let step = (DVec3::from_array(vehicle.position_m) - DVec3::from_array(before.position_m)).length();
            if step.is_finite() && step < 5.0 {
                self.path_m += step;
            }
        }
        let blank = vehicle.mode == FlightMode::Unknown.code() || vehicle.position_stamp_ns == 0;
        match &mut self.vehicle {
            // px4-link was started anew and has not heard the autopilot yet: what was known of the vehicle stands, but for
            // how long nothing has been heard of it.
            Some(known) if blank => known.link_age_ns = vehicle.link_age_ns,
            known => *known = Some(vehicle),
        }
    }

    /// Takes a small depth image into the occupied voxels. The object in its box and the ground are known, and no obstacle.
    pub(super) fn saw(&mut self, view: &DepthView) {
        let radius = self.setup.planner.survey_radius_m;
        let prior = self.ledger.prior.filter(|_| self.is_placed());
        let Some(terrain) = &mut self.terrain else { return };
        let (survey, obstacle) = (terrain.survey_m, terrain.space.obstacle);
        terrain.space.occupancy.add(view, |point| match &prior {
            Some((prior, _)) => obstacle.distance(point) > 0.15 && point.z > prior.ground.z_at(point) + 0.3,
            None => (point - survey).truncate().length() > radius + 0.5 && point.z > survey.z + 0.3,
        });
    }

    pub(super) fn commanded_by_us(&self) -> bool {
        self.vehicle.is_some_and(|vehicle| vehicle.commander == Commander::Vantage.code())
    }

    fn commander(&self) -> Option<Commander> {
        self.vehicle.and_then(|vehicle| Commander::from_code(vehicle.commander))
    }

    /// Whether paths are being flown for us.
    pub(super) fn under_control(vehicle: &VehicleState) -> bool {
        vehicle.mode == FlightMode::Offboard.code() && vehicle.streaming == 1 && vehicle.landed == 0
    }

    /// Battery, time, wind, link and failsafes end a mission early.
    pub(super) fn check_ends(&mut self) {
        let Some(vehicle) = self.vehicle else { return };
        let Some((airborne_ns, _)) = self.ledger.airborne else { return };
        if self.homeward() || self.ledger.over.is_some() || self.commander() == Some(Commander::Pilot) {
            return;
        }
        let config = &self.setup.planner;
        let charge = ChargeState::from_code(vehicle.charge_state).unwrap_or(ChargeState::Unknown);
        let heard = charge != ChargeState::Unknown;
        let low = matches!(charge, ChargeState::Low | ChargeState::Critical | ChargeState::Emergency);
        let failsafe = match FailsafeReason::from_code(vehicle.failsafe) {
            Some(FailsafeReason::Battery) => Some(EndReason::Battery),
            Some(FailsafeReason::Geofence) => Some(EndReason::Geofence),
            Some(FailsafeReason::LinkLost) => Some(EndReason::Link),
            // The battery's own words come every two seconds, and may explain it yet.
            Some(FailsafeReason::Other) => {
                let since_ns = *self.unexplained_ns.get_or_insert(self.now_ns);
                (self.now_ns - since_ns > UNEXPLAINED_NS).then_some(EndReason::Link)
            }
            // px4-link takes control again by itself.
            Some(FailsafeReason::OffboardLost | FailsafeReason::None) | None => None,
        };
        let wind = DVec3::from_array(vehicle.wind_mps).length();
        let reason = if low || (heard && vehicle.battery_fraction <= config.return_battery) {
            Some(EndReason::Battery)
        } else if failsafe.is_some() {
            failsafe
        } else if vehicle.link_age_ns > ns_from_s(LINK_LOST_S) {
            Some(EndReason::Link)
        } else if wind > config.max_wind_mps {
            Some(EndReason::Wind)
        } else if self.now_ns.saturating_sub(airborne_ns) > ns_from_s(config.max_mission_s) {
            Some(EndReason::Time)
        } else {
            None
        };
        if let Some(reason) = reason {
            self.end(reason);
            // A failsafe flies the vehicle home by itself; what the operator had held goes home too.
            if matches!(self.state, State::Suspended(_)) {
                self.state = State::Deciding;
            }
        }
    }

    /// Whether the way straight down keeps its distance from the object, or, before that is known, from where it may be.
    pub(super) fn may_land_here(&self) -> bool {
        let (Some(vehicle), Some(terrain)) = (&self.vehicle, &self.terrain) else { return true };
        let free = terrain.space.may_sink(DVec3::from_array(vehicle.position_m));
        if !free {
            tracing::warn!("the object is below or too near to land here: returning, to land at home");
        }
        free
    }

    pub(super) fn preparing(&mut self) -> State {
        if self.homeward() && self.on_ground() {
            return State::Finishing;
        }
        let Some(vehicle) = self.vehicle else { return State::Preparing };
        if vehicle.ready == 0 {
            return State::Preparing;
        }
        if vehicle.landed == 1 && vehicle.armed == 0 {
            let charge = ChargeState::from_code(vehicle.charge_state).unwrap_or(ChargeState::Unknown);
            if charge != ChargeState::Unknown && vehicle.battery_fraction <= self.setup.planner.return_battery {
                self.end(EndReason::Battery);
                return State::Finishing;
            }
            if vehicle.armable == 0 || !self.level_home(&vehicle) {
                return State::Preparing;
            }
        }
        State::Launching
    }

    pub(super) fn launching(&mut self) -> State {
        let Some(vehicle) = self.vehicle else { return State::Launching };
        let grounded = vehicle.landed == 1;
        if !grounded && vehicle.link_age_ns > LINK_QUIET_NS {
            // Whoever cannot hear refuses nothing: it is waited for, until the link counts as lost.
            self.refusals = 0;
            return State::Launching;
        }
        let comes_home = [FlightMode::Return.code(), FlightMode::Land.code()].contains(&vehicle.mode);
        if comes_home && vehicle.armed == 1 && self.commanded_by_us() && self.pending.is_none() && !self.homeward() {
            // px4-link brings it home by itself: it was told to end, or the planner had been away. Then it takes off again.
            return State::Launching;
        }
        if self.homeward() && grounded {
            return if vehicle.armed == 1 { State::Landing } else { State::Finishing };
        }
        if !grounded && self.commander() == Some(Commander::Pilot) {
            return self.suspend();
        }
        if !grounded && self.ledger.ending.is_some_and(|(_, land_here)| land_here) {
            return State::Landing;
        }
        let taking_off = self.pending.as_ref().is_some_and(|pending| pending.command == VehicleCommand::Takeoff);
        let command = if grounded && vehicle.armed == 0 && !taking_off {
            VehicleCommand::Arm
        } else if grounded || taking_off {
            VehicleCommand::Takeoff
        } else if vehicle.mode == FlightMode::Takeoff.code() {
            // Our takeoff before a restart: let it come to its end.
            return State::Launching;
        } else if Self::under_control(&vehicle) {
            self.flown = true;
            // What was refused before counts no more: each px4-link that was started anew refuses once.
            self.refusals = 0;
            // Seen before its answer came: nobody need ask again.
            if let Some(pending) = self.pending.take() {
                self.out.effects.push(crate::io::Effect::CommandOver(pending.id));
            }
            if self.ledger.airborne.is_none() {
                self.record(Record::Airborne { home_m: vehicle.home_m });
            }
            return State::Deciding;
        } else {
            VehicleCommand::TakeControl
        };
        let altitude_m = if command == VehicleCommand::Takeoff { self.setup.planner.takeoff_height_m } else { 0.0 };
        let answer = self.ensure(command, altitude_m);
        if answer.is_some_and(|answer| answer.is_err()) && self.refusals >= MOST_REFUSALS {
            self.refusals = 0;
            self.end(EndReason::VehicleRefused);
            return if grounded && vehicle.armed == 0 { State::Finishing } else { State::Homing };
        }
        State::Launching
    }

    pub(super) fn suspend(&mut self) -> State {
        tracing::info!("somebody else flies: the mission is suspended");
        if !self.ledger.suspended {
            self.record(Record::Suspended);
        }
        State::Suspended(false)
    }

    pub(super) fn suspended(&mut self, hold: bool) -> State {
        if self.vehicle.is_some() && self.on_ground() {
            if self.recalled {
                self.record(Record::GoOn);
            } else {
                self.end(EndReason::Operator);
            }
            return State::Finishing;
        }
        if hold {
            return State::Suspended(self.ensure(VehicleCommand::Hold, 0.0).is_none_or(|answer| answer.is_err()));
        }
        State::Suspended(false)
    }

    pub(super) fn going_on(&mut self) -> State {
        match self.ensure(VehicleCommand::GoOn, 0.0) {
            None => State::GoingOn,
            Some(Ok(())) => State::Launching,
            Some(Err(_)) => self.suspend(),
        }
    }

    pub(super) fn homing(&mut self) -> State {
        let Some(vehicle) = self.vehicle else { return State::Homing };
        if self.on_ground() {
            return State::Finishing;
        }
        if self.commander() == Some(Commander::Pilot) {
            return self.suspend();
        }
        let going = [FlightMode::Return.code(), FlightMode::Land.code()].contains(&vehicle.mode);
        if going && self.pending.is_none() {
            return State::Homing;
        }
        let answer = self.ensure(VehicleCommand::Return, 0.0);
        if answer.is_some_and(|answer| answer.is_err()) && self.refusals >= MOST_REFUSALS {
            self.refusals = 0;
            return State::Landing;
        }
        State::Homing
    }

    pub(super) fn landing(&mut self) -> State {
        let Some(vehicle) = self.vehicle else { return State::Landing };
        if self.on_ground() {
            if let Some(pending) = self.pending.take() {
                self.out.effects.push(crate::io::Effect::CommandOver(pending.id));
            }
            return State::Finishing;
        }
        // He lands it himself, or gives it back and the operator says go on.
        if self.commander() == Some(Commander::Pilot) {
            return self.suspend();
        }
        // A landing under way is waited for.
        if vehicle.mode != FlightMode::Land.code() || self.pending.is_some() {
            self.ensure(VehicleCommand::Land, 0.0);
        }
        State::Landing
    }

    pub(super) fn finishing(&mut self, views: &mut dyn Views) -> State {
        if self.recalled {
            tracing::info!("on the ground; the mission is open");
            return State::Over;
        }
        if self.ledger.airborne.is_some() && !self.ledger.landed && self.on_ground() {
            // The view that was being taken when the mission ended may have been stored since.
            self.recover_captured(views);
            self.record(Record::Landed);
        }
        let waiting = self.ledger.training().is_some() || self.round_due().is_some();
        let overdue = self.now_ns > self.progress_ns.saturating_add(ns_from_s(self.setup.planner.service_deadline_s));
        if waiting && !self.trainer_failed && !overdue {
            return State::Finishing;
        }
        let usable = self.ledger.rounds.iter().any(|round| round.generation.is_some());
        let mut reason = self.ledger.ending.map_or(EndReason::ServiceFailed, |(reason, _)| reason);
        if waiting && reason == EndReason::Complete {
            reason = EndReason::ServiceFailed;
        }
        self.record(Record::Over { reason, usable });
        tracing::info!(reason = %reason, usable, "the mission is over");
        State::Over
    }
}
