//! Going home: asked to end, a silent planner, a way back that cannot be flown, and the mode after a landing.

use shared_types::messages::{Commander, FlightMode, VehicleCommand};

use super::requests::Details;
use super::{Core, Running, WAY_TOLERANCE_M};
use crate::commands::{Procedure, Stage};
use crate::path::rest_from;
use crate::state::Phase;
use crate::store::WayBack;
use crate::stream::Order;

impl Core {
    /// Asked to end. True when that must wait until the vehicle has landed.
    pub fn stop(&mut self, now_ns: u64) -> bool {
        if !self.telemetry.armed || self.commander != Commander::Vantage {
            return false;
        }
        self.leaving = true;
        if self.first_sight {
            // Away until just now: what is seen of the vehicle is old. Whatever is found goes on home.
            self.landing = true;
        } else if !self.landing && self.telemetry.in_air() {
            self.go_home(now_ns, None);
        } else if !self.landing {
            self.drop_running("px4-link was told to end");
            let disarm = Procedure::new(VehicleCommand::Land, &[Stage::Disarm]);
            self.running = Some(Running { procedure: disarm, address: None });
        }
        true
    }

    /// Whether a stop that had to wait can end now.
    #[must_use]
    pub fn may_leave(&self) -> bool {
        self.leaving && !self.flies_for_us() && !self.telemetry.armed
            || self.leaving && matches!(self.commander, Commander::Pilot | Commander::Failsafe)
    }

    /// The way home: by the stored path where it begins near, else the autopilot's own return.
    pub(super) fn stages_home(&mut self, in_control: bool) -> Vec<Stage> {
        let near = rest_from(&self.way_back.waypoints(), self.telemetry.position_m)
            .is_some_and(|(_, distance_m)| distance_m <= WAY_TOLERANCE_M);
        if !near {
            return vec![Stage::Mode { mode: FlightMode::Return, always: false }, Stage::UntilDisarmed];
        }
        let mut stages = Vec::new();
        if in_control {
            self.out.orders.push(Order::Brake);
        } else {
            stages.extend([
                Stage::UntilSlow,
                Stage::StreamPose,
                Stage::Mode { mode: FlightMode::Offboard, always: false },
            ]);
        }
        stages.extend([Stage::FlyBack, Stage::Mode { mode: FlightMode::Land, always: false }, Stage::UntilDisarmed]);
        stages
    }

    /// Returns, lands and disarms on px4-link's own account.
    pub(super) fn go_home(&mut self, now_ns: u64, after_failure: Option<VehicleCommand>) {
        match after_failure {
            None => self.begin(now_ns, VehicleCommand::Return, Details::default(), None),
            // The way back could not be flown: the autopilot's own return, and when that fails too, down.
            Some(VehicleCommand::Return) if !self.way_back.points.is_empty() => {
                self.way_back = WayBack::default();
                self.begin(now_ns, VehicleCommand::Return, Details::default(), None);
            }
            Some(_) => self.begin(now_ns, VehicleCommand::Land, Details::default(), None),
        }
    }

    /// A planner that is silent for too long ends the flight.
    pub(super) fn mind_the_planner(&mut self, now_ns: u64) {
        // After an absence nothing is decided before the vehicle was looked at.
        if self.first_sight {
            return;
        }
        let lifted = self.running.as_ref().is_some_and(|running| running.procedure.stage() == Some(Stage::Disarm));
        if lifted && self.flies_for_us() {
            tracing::warn!("off the ground before it could be disarmed: returning and landing");
            self.go_home(now_ns, None);
        }
        let since_ns = self.alive_ns.max(self.started_ns.unwrap_or(now_ns));
        let silent_s = shared_types::s_from_ns(now_ns.saturating_sub(since_ns));
        if silent_s > self.config.planner_return_s && self.flies_for_us() && !self.landing {
            tracing::warn!(silent_s, "the planner is silent: returning and landing");
            self.go_home(now_ns, None);
        }
        // On its way down without anything at work (a restart): keep at it.
        if self.landing && self.running.is_none() && self.flies_for_us() {
            self.go_home(now_ns, Some(VehicleCommand::Return));
        }
        self.landing &= self.telemetry.armed;
    }

    /// After a landing the autopilot goes back to the mode flown before, often OFFBOARD, in which it is never ready to arm.
    pub(super) fn hold_on_ground(&mut self, now_ns: u64) {
        // Only after a flight of ours: a pilot who chooses a mode on the ground is left alone.
        let stuck =
            self.flown && matches!(self.telemetry.mode, FlightMode::Offboard | FlightMode::Takeoff | FlightMode::Land);
        let idle = self.running.is_none() && self.report.is_none_or(|report| !report.streaming);
        if self.phase == Phase::Ground && stuck && idle && now_ns >= self.ground_hold_due_ns {
            self.ground_hold_due_ns = now_ns + 2 * shared_types::NS_PER_S;
            let hold = [Stage::Mode { mode: FlightMode::Hold, always: false }];
            self.running = Some(Running { procedure: Procedure::new(VehicleCommand::Hold, &hold), address: None });
        }
    }
}
