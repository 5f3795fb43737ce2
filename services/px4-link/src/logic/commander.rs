//! Who commands the vehicle: what its modes say of pilots and failsafes, and what is done with a vehicle found in the air.

use shared_types::messages::{ChargeState, Commander, FailsafeReason, FlightMode, VehicleCommand};

use super::requests::Details;
use super::{Core, INTENT_PATIENCE_NS, MODE_GRACE_NS, QUIET_NS, Running};
use crate::commands::{Procedure, Stage};
use crate::state::{Found, found_in_air};
use crate::store::{Kept, WayBack};
use crate::stream::{Order, Report};

impl Core {
    /// Decides who commands, from what the autopilot does and what was asked of it.
    pub(super) fn see_commander(&mut self, now_ns: u64) {
        let before = self.commander;
        let (mode, intended) = (self.telemetry.mode, self.telemetry.intended);
        if self.deaf(now_ns) || (self.first_sight && mode == FlightMode::Unknown) {
            return;
        }
        if !self.telemetry.armed {
            self.commander = Commander::Nobody;
            self.failsafe = FailsafeReason::None;
            self.first_sight &= self.telemetry.heartbeats == 0;
            if before != Commander::Nobody {
                self.out.orders.push(Order::Off);
            }
        } else if self.first_sight {
            if !self.asks.done() || !self.telemetry.ready(now_ns) {
                return;
            }
            // What was intended tells a failsafe's Hold from an operator's; some autopilots never say.
            let since_ns = *self.sight_since_ns.get_or_insert(now_ns);
            if intended == FlightMode::Unknown && now_ns.saturating_sub(since_ns) < INTENT_PATIENCE_NS {
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
                    self.settle(mode);
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
        let flown = match self.commander {
            Commander::Vantage => self.flown || self.telemetry.in_air(),
            Commander::Pilot => false,
            Commander::Nobody => self.flown && self.telemetry.mode != FlightMode::Hold,
            Commander::Failsafe => self.flown,
        };
        if flown != self.flown {
            self.flown = flown;
            self.remember();
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

    /// In the air, what is known of the vehicle is too old to decide or to command by.
    pub(super) fn deaf(&self, now_ns: u64) -> bool {
        let silent = now_ns.saturating_sub(self.telemetry.heard_ns) > QUIET_NS;
        self.telemetry.armed && (silent || self.telemetry.mode == FlightMode::Unknown)
    }

    pub(super) fn see_first(&mut self, now_ns: u64, mode: FlightMode, intended: FlightMode) {
        let found = if self.world.moved_unexplained() {
            // Where the object is now nobody knows: no setpoint in this frame until the operator's word.
            tracing::error!(
                "the estimator was reset while px4-link was away, and its origin does not tell by how much"
            );
            Found::LeaveTo(Commander::Failsafe)
        } else {
            let armed_by_us = self.kept.arming && self.telemetry.landed == Some(true) && mode != FlightMode::Pilot;
            let ours = armed_by_us || self.kept.commanded(mode);
            found_in_air(mode, intended, self.telemetry.charge, self.outside_fence(), ours)
        };
        self.world.accept();
        tracing::info!(?found, %mode, %intended, "found the vehicle armed");
        match found {
            Found::Recover => {
                self.commander = Commander::Vantage;
                self.recover(now_ns);
            }
            Found::Ours => {
                self.commander = Commander::Vantage;
                self.settle(mode);
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
        self.expect_from(now_ns, FlightMode::Hold, self.telemetry.mode);
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
            self.begin(now_ns, VehicleCommand::Return, Details::default(), None);
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
        let changing = now_ns.saturating_sub(self.expected_since_ns) < MODE_GRACE_NS;
        // Somebody flies it by hand, whatever was asked for; until our own word to go on is obeyed, it still may.
        let leaving_the_pilot = changing && self.before_expected == FlightMode::Pilot;
        if mode == FlightMode::Pilot && self.telemetry.landed != Some(true) && !leaving_the_pilot {
            self.commander = Commander::Pilot;
            return;
        }
        // A takeoff ends in Hold, and so does one that a failsafe stopped.
        let chosen = matches!(intended, FlightMode::Hold | FlightMode::Unknown) && !self.telemetry.critical;
        if self.expected == FlightMode::Takeoff && mode == FlightMode::Hold && chosen && !self.takeoff_unseen() {
            self.settle(FlightMode::Hold);
            self.remember();
        }
        // Down by our command: what mode the autopilot goes back to before it disarms is nobody's choice.
        if self.telemetry.landed == Some(true) && matches!(self.expected, FlightMode::Land | FlightMode::Return) {
            return;
        }
        // Our own Hold and a failsafe's look the same but for this.
        let forced = mode == FlightMode::Hold && self.telemetry.critical && !changing;
        let as_told =
            mode == self.expected || (changing && mode == self.before_expected) || self.expected == FlightMode::Unknown;
        if as_told && !forced {
            if mode == self.expected {
                self.failsafe = FailsafeReason::None;
                // The grace is for the change that is not yet seen: from now on the mode before is somebody's choice.
                if self.before_expected != mode {
                    self.settle(mode);
                    self.remember();
                }
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

    /// A mode is about to be commanded. On disk before it is sent: a px4-link that dies now must know it for its own.
    pub(super) fn expect(&mut self, now_ns: u64, mode: FlightMode) {
        let before = if self.expected == mode { self.before_expected } else { self.expected };
        self.expect_from(now_ns, mode, before);
    }

    /// As [`Self::expect`], where the mode before was not one of ours.
    pub(super) fn expect_from(&mut self, now_ns: u64, mode: FlightMode, before: FlightMode) {
        let changed = (self.expected, self.before_expected) != (mode, before);
        self.before_expected = before;
        self.expected = mode;
        self.expected_since_ns = now_ns;
        if changed {
            self.remember();
        }
    }

    /// The vehicle is in a mode, and no change of ours is under way.
    fn settle(&mut self, mode: FlightMode) {
        self.expected = mode;
        self.before_expected = mode;
    }

    /// Whether the takeoff was commanded out of Hold and not yet seen.
    fn takeoff_unseen(&self) -> bool {
        self.before_expected == FlightMode::Hold && self.telemetry.landed == Some(true)
    }

    pub(super) fn outside_fence(&self) -> bool {
        let number = |name: &str| self.params.get(name).map_or(0.0, |value| value.number());
        let (far_m, high_m) = (number("GF_MAX_HOR_DIST"), number("GF_MAX_VER_DIST"));
        let Some((home_local_m, _)) = self.telemetry.home else { return false };
        let from_home_m = self.telemetry.position_m - (home_local_m + self.world.offset_m());
        (far_m > 0.0 && from_home_m.truncate().length() > far_m - 0.2) || (high_m > 0.0 && from_home_m.z > high_m - 0.2)
    }

    fn is_arming(&self) -> bool {
        self.running.as_ref().is_some_and(|running| running.procedure.command == VehicleCommand::Arm)
    }

    /// An arming of ours that is over, done or not, explains no armed vehicle any more.
    pub(super) fn forget_arming(&mut self) {
        if self.kept.arming && !self.first_sight && !self.is_arming() {
            self.remember();
        }
    }

    pub(super) fn remember(&mut self) {
        let mut kept = Kept { transform: self.world.kept(), ..self.kept.clone() };
        // Before the vehicle was looked at, what an earlier life knew of the flight still counts.
        if !self.first_sight {
            kept.ours = self.commander == Commander::Vantage;
            kept.expected = self.expected;
            kept.before_expected = self.before_expected;
            kept.flown = self.flown;
            kept.arming = self.is_arming();
        }
        self.store.keep(&kept);
        self.kept = kept;
    }
}
