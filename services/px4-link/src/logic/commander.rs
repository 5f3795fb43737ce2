//! Who commands the vehicle: what its modes say of pilots and failsafes, and what is done with a vehicle found in the air.

use shared_types::messages::{ChargeState, Commander, FailsafeReason, FlightMode, VehicleCommand};

use super::{Core, MODE_GRACE_NS, Running};
use crate::commands::{Procedure, Stage};
use crate::state::{Found, found_in_air};
use crate::store::{Kept, WayBack};
use crate::stream::{Order, Report};

impl Core {
    /// Decides who commands, from what the autopilot does and what was asked of it.
    pub(super) fn see_commander(&mut self, now_ns: u64) {
        let before = self.commander;
        let (mode, intended) = (self.telemetry.mode, self.telemetry.intended);
        if !self.telemetry.armed {
            self.commander = Commander::Nobody;
            self.failsafe = FailsafeReason::None;
            self.first_sight &= self.telemetry.heartbeats == 0;
            if before != Commander::Nobody {
                self.out.orders.push(Order::Off);
            }
        } else if self.first_sight {
            if mode == FlightMode::Unknown || !self.asks.done() || !self.telemetry.ready(now_ns) {
                return;
            }
            self.first_sight = false;
            self.see_first(now_ns, mode, intended);
        } else {
            match before {
                Commander::Nobody => {
                    let arming =
                        self.running.as_ref().is_some_and(|running| running.procedure.command == VehicleCommand::Arm);
                    self.commander = if arming { Commander::Vantage } else { Commander::Pilot };
                    self.expected = mode;
                }
                Commander::Vantage => self.see_modes(now_ns, mode, intended),
                Commander::Failsafe if mode == FlightMode::Pilot => self.commander = Commander::Pilot,
                // The reason may be told after the mode; that setpoints have stopped since is our own doing.
                Commander::Failsafe if self.failsafe == FailsafeReason::Other => {
                    let reason = self.failsafe_reason();
                    if matches!(reason, FailsafeReason::Battery | FailsafeReason::Geofence) {
                        self.failsafe = reason;
                    }
                }
                Commander::Failsafe | Commander::Pilot => {}
            }
        }
        if self.commander != before {
            tracing::info!(commander = %self.commander, %mode, failsafe = %self.failsafe, "who commands changed");
            if matches!(self.commander, Commander::Pilot | Commander::Failsafe) {
                let who = if self.commander == Commander::Pilot { "a pilot took over" } else { "a failsafe acts" };
                self.drop_running(who);
                self.running = None;
                self.landing = false;
                self.out.orders.push(Order::Off);
            }
            self.remember();
        }
    }

    pub(super) fn see_first(&mut self, now_ns: u64, mode: FlightMode, intended: FlightMode) {
        let found = found_in_air(mode, intended, self.telemetry.charge, self.outside_fence(), self.kept.ours);
        tracing::info!(?found, %mode, %intended, "found the vehicle armed");
        match found {
            Found::Recover => {
                self.commander = Commander::Vantage;
                self.recover(now_ns);
            }
            Found::Ours => {
                self.commander = Commander::Vantage;
                self.expected = mode;
            }
            Found::LeaveTo(commander) => {
                self.commander = commander;
                self.failsafe =
                    if commander == Commander::Failsafe { self.failsafe_reason() } else { FailsafeReason::None };
            }
        }
    }

    /// Hold, the present pose, OFFBOARD: as after a restart.
    pub(super) fn recover(&mut self, now_ns: u64) {
        self.drop_running("setpoints were interrupted");
        self.out.orders.push(Order::Off);
        self.expect(now_ns, FlightMode::Hold);
        self.before_expected = self.telemetry.mode;
        let stages = [
            Stage::Mode { mode: FlightMode::Hold, always: true },
            Stage::UntilSlow,
            Stage::StreamPose,
            Stage::Mode { mode: FlightMode::Offboard, always: false },
        ];
        self.running = Some(Running { procedure: Procedure::new(VehicleCommand::TakeControl, &stages), address: None });
        if self.landing {
            // On its way home when it was interrupted: by the autopilot's own return, which needs no setpoints.
            self.way_back = WayBack::default();
            self.begin(now_ns, VehicleCommand::Return, 0.0, None);
        }
    }

    pub(super) fn failsafe_reason(&self) -> FailsafeReason {
        if matches!(self.telemetry.charge, ChargeState::Critical | ChargeState::Emergency) {
            FailsafeReason::Battery
        } else if self.outside_fence() {
            FailsafeReason::Geofence
        } else if self.telemetry.intended == FlightMode::Offboard && self.report.is_none_or(|report| !report.streaming)
        {
            FailsafeReason::OffboardLost
        } else {
            FailsafeReason::Other
        }
    }

    pub(super) fn see_modes(&mut self, now_ns: u64, mode: FlightMode, intended: FlightMode) {
        if self.expected == FlightMode::Takeoff && mode == FlightMode::Hold {
            self.expect(now_ns, FlightMode::Hold);
        }
        // Down by our command: what mode the autopilot goes back to before it disarms is nobody's choice.
        if self.telemetry.landed == Some(true) && matches!(self.expected, FlightMode::Land | FlightMode::Return) {
            return;
        }
        let changing = now_ns.saturating_sub(self.expected_since_ns) < MODE_GRACE_NS;
        if mode == self.expected || (changing && mode == self.before_expected) || self.expected == FlightMode::Unknown {
            if mode == self.expected {
                self.failsafe = FailsafeReason::None;
            }
            if self.report.is_some_and(|report| report.stalled) && mode == FlightMode::Offboard {
                tracing::warn!("no setpoint for more than 0.5 s: taking control anew");
                self.recover(now_ns);
                self.report = self.report.map(|report| Report { stalled: false, ..report });
            }
            return;
        }
        let failsafe = self.telemetry.critical || (intended != FlightMode::Unknown && intended != mode);
        if !failsafe {
            self.commander = Commander::Pilot;
            return;
        }
        let reason = self.failsafe_reason();
        let stream_stopped = self.report.is_some_and(|report| report.stalled);
        if stream_stopped
            && mode == FlightMode::Hold
            && !matches!(reason, FailsafeReason::Battery | FailsafeReason::Geofence)
        {
            tracing::warn!("the autopilot holds because setpoints stopped: taking control anew");
            self.recover(now_ns);
            self.report = self.report.map(|report| Report { stalled: false, ..report });
            return;
        }
        self.failsafe = reason;
        self.commander = Commander::Failsafe;
    }

    pub(super) fn expect(&mut self, now_ns: u64, mode: FlightMode) {
        if self.expected != mode {
            self.before_expected = self.expected;
        }
        self.expected = mode;
        self.expected_since_ns = now_ns;
    }

    pub(super) fn outside_fence(&self) -> bool {
        let number = |name: &str| self.params.get(name).map_or(0.0, |value| value.number());
        let (far_m, high_m) = (number("GF_MAX_HOR_DIST"), number("GF_MAX_VER_DIST"));
        let Some((home_local_m, _)) = self.telemetry.home else { return false };
        let from_home_m = self.telemetry.position_m - (home_local_m + self.world.offset_m());
        (far_m > 0.0 && from_home_m.truncate().length() > far_m - 0.2) || (high_m > 0.0 && from_home_m.z > high_m - 0.2)
    }

    pub(super) fn remember(&mut self) {
        let kept = Kept {
            transform: self.world.kept(),
            ours: self.commander == Commander::Vantage,
            last_target_id: self.kept.last_target_id,
        };
        self.store.keep(&kept);
        self.kept = kept;
    }
}
