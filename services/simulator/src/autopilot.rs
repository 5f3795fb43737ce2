//! The autopilot: arming, modes, takeoff, landing, failsafes; which setpoint the cascade gets at each moment.
//!
//! Time is the simulated time since boot, in seconds; everything else comes in as arguments.

use glam::DVec3;

use crate::battery::Charge;
use crate::control::MotionSetpoint;
use crate::estimator::Estimate;
use crate::failsafe::{Action, Cause, Conditions, Decision, Failsafe};
use crate::flight::rotated;
pub use crate::flight::{CommandResult, Flight, Home, Notice, Order, Senses, Sticks};
use crate::frames::yaw_of;
use crate::guidance::Guidance;
use crate::modes::{Intention, Mode};
use crate::params::{Param, Params};

/// Sensors and the estimator are ready this long after boot, s.
const READY_AFTER_S: f64 = 1.0;
/// Contact with the intent to go down for this long is a landing, s.
const LANDED_AFTER_S: f64 = 1.0;

/// The autopilot's state.
#[derive(Debug, Clone)]
pub struct Autopilot {
    intention: Intention,
    mode: Mode,
    armed: bool,
    armed_at_s: f64,
    flight: Flight,
    landed: bool,
    has_flown: bool,
    contact_since_s: Option<f64>,
    landed_at_s: f64,
    terminated: bool,
    failsafe: Failsafe,
    decision: Decision,
    guidance: Guidance,
    order: Order,
    offboard: Option<(f64, MotionSetpoint, bool)>,
    sticks: Option<(f64, Sticks)>,
    gcs_at_s: Option<f64>,
    home: Option<Home>,
    notices: Vec<Notice>,
    now_s: f64,
    estimate: Estimate,
    charge: Charge,
}

impl Default for Autopilot {
    fn default() -> Self {
        Self {
            intention: Intention::default(),
            mode: Mode::AutoLoiter,
            armed: false,
            armed_at_s: 0.0,
            flight: Flight::Disarmed,
            landed: true,
            has_flown: false,
            contact_since_s: None,
            landed_at_s: 0.0,
            terminated: false,
            failsafe: Failsafe::default(),
            decision: Decision { action: Action::None, cause: None, announce: None },
            guidance: Guidance::default(),
            order: Order { setpoint: MotionSetpoint::NONE, up_limit_mps: 0.0, lift: false },
            offboard: None,
            sticks: None,
            gcs_at_s: None,
            home: None,
            notices: Vec::new(),
            now_s: 0.0,
            estimate: Estimate::default(),
            charge: Charge::Ok,
        }
    }
}

impl Autopilot {
    /// The mode that flies.
    #[must_use]
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// The mode that was chosen; differs from [`Self::mode`] while a failsafe acts.
    #[must_use]
    pub fn intended_mode(&self) -> Mode {
        self.intention.mode()
    }

    /// Motors armed.
    #[must_use]
    pub fn armed(&self) -> bool {
        self.armed
    }

    /// On the ground.
    #[must_use]
    pub fn landed(&self) -> bool {
        self.landed
    }

    /// Where arming and flying stand.
    #[must_use]
    pub fn flight(&self) -> Flight {
        self.flight
    }

    /// Motors off for good.
    #[must_use]
    pub fn terminated(&self) -> bool {
        self.terminated
    }

    /// Home, once the estimator is ready.
    #[must_use]
    pub fn home(&self) -> Option<Home> {
        self.home
    }

    /// The failsafes' present decision.
    #[must_use]
    pub fn decision(&self) -> Decision {
        self.decision
    }

    /// What the cascade got last.
    #[must_use]
    pub fn order(&self) -> Order {
        self.order
    }

    /// Messages for the pilot since the last call.
    pub fn take_notices(&mut self) -> Vec<Notice> {
        core::mem::take(&mut self.notices)
    }

    /// A failsafe acts.
    #[must_use]
    pub fn in_failsafe(&self) -> bool {
        self.armed && self.decision.action >= Action::Hold
    }

    /// MAV_LANDED_STATE.
    #[must_use]
    pub fn landed_state(&self) -> u8 {
        match (self.landed, self.mode) {
            (true, _) => 1,
            (false, Mode::AutoTakeoff) => 3,
            (false, Mode::AutoLand) => 4,
            (false, _) => 2,
        }
    }

    /// A ground station's heartbeat (MAV_TYPE_GCS) was heard.
    pub fn on_gcs_heartbeat(&mut self, now_s: f64) {
        self.gcs_at_s = Some(now_s);
    }

    /// A setpoint of a client. `in_body` says that velocity and acceleration are forward and right.
    pub fn on_setpoint(&mut self, now_s: f64, setpoint: MotionSetpoint, in_body: bool) {
        self.offboard = Some((now_s, setpoint, in_body));
    }

    /// A pilot's sticks.
    pub fn on_sticks(&mut self, now_s: f64, sticks: Sticks) {
        self.sticks = Some((now_s, sticks));
    }

    /// The estimate jumped: paths of the autopilot's own go along, setpoints of clients do not.
    pub fn on_reset(&mut self, jump_m: DVec3) {
        self.guidance.shift(jump_m);
    }

    fn offboard_fresh(&self, now_s: f64, params: &Params) -> bool {
        self.offboard.is_some_and(|(at, _, _)| now_s - at < params.real(Param::COM_OF_LOSS_T))
    }

    fn sticks_fresh(&self, now_s: f64, params: &Params) -> bool {
        self.sticks.is_some_and(|(at, _)| now_s - at < params.real(Param::COM_RC_LOSS_T))
    }

    fn gcs_fresh(&self, now_s: f64, params: &Params) -> bool {
        self.gcs_at_s.is_some_and(|at| now_s - at < params.real(Param::COM_DL_LOSS_T))
    }

    /// Whether a mode can run now.
    fn can_run(&self, mode: Mode, params: &Params) -> bool {
        match mode {
            Mode::Offboard => self.offboard_fresh(self.now_s, params),
            Mode::Termination => true,
            m if m.needs_sticks() => self.sticks_fresh(self.now_s, params),
            _ => self.home.is_some(),
        }
    }

    /// SYS_STATUS' PREARM_CHECK: it could be armed in the mode that is chosen.
    #[must_use]
    pub fn can_arm(&self, params: &Params) -> bool {
        let gcs = params.int(Param::NAV_DLL_ACT) == 0 || self.gcs_fresh(self.now_s, params);
        let mode = self.intention.mode();
        self.home.is_some()
            && !self.terminated
            && gcs
            && self.charge < Charge::Critical
            && !self.fence_breached(params)
            && !mode.prevents_arming()
            && self.can_run(mode, params)
    }

    fn fence_breached(&self, params: &Params) -> bool {
        let Some(home) = self.home else { return false };
        let away = self.estimate.position_m - home.position_m;
        let (horizontal, vertical) = (params.real(Param::GF_MAX_HOR_DIST), params.real(Param::GF_MAX_VER_DIST));
        (horizontal > 0.0 && away.truncate().length() > horizontal) || (vertical > 0.0 && -away.z > vertical)
    }

    /// Leaves a message for the pilot.
    pub fn notify(&mut self, severity: u8, text: &str) {
        self.notices.push(Notice { severity, text: text.to_owned() });
    }

    /// Arms. `force` skips the checks.
    pub fn arm(&mut self, force: bool, params: &Params) -> CommandResult {
        if self.armed {
            return CommandResult::Accepted;
        }
        if self.terminated || (!force && !self.can_arm(params)) {
            self.notify(2, "Arming denied: Resolve system health failures first");
            return CommandResult::TemporarilyRejected;
        }
        self.armed = true;
        self.armed_at_s = self.now_s;
        self.has_flown = false;
        self.flight = Flight::Spoolup { until_s: self.now_s + params.real(Param::COM_SPOOLUP_TIME) };
        self.set_home();
        self.guidance.enter(self.mode, &self.estimate, self.home, params);
        self.notify(6, "Armed by external command");
        CommandResult::Accepted
    }

    /// Disarms. In the air only by force.
    pub fn disarm(&mut self, force: bool) -> CommandResult {
        if !self.armed {
            return CommandResult::Accepted;
        }
        if !self.landed && !force {
            self.notify(2, "Disarming denied: not landed");
            return CommandResult::TemporarilyRejected;
        }
        self.stop_motors("Disarmed by external command");
        CommandResult::Accepted
    }

    fn stop_motors(&mut self, why: &str) {
        self.armed = false;
        self.flight = Flight::Disarmed;
        self.decision = Decision { action: Action::None, cause: None, announce: None };
        self.intention.on_disarm();
        self.mode = self.intention.mode();
        self.notify(6, why);
    }

    /// Motors off, for good.
    pub fn terminate(&mut self) {
        self.terminated = true;
        self.intention.choose(Mode::Termination);
        self.mode = Mode::Termination;
        self.notify(1, "Flight termination active");
    }

    /// Chooses a mode, as DO_SET_MODE: any while disarmed, only one that can run while armed.
    pub fn choose(&mut self, mode: Mode, params: &Params) -> CommandResult {
        if self.terminated || (self.armed && !self.can_run(mode, params)) {
            self.notify(2, "Mode change rejected: mode cannot run");
            return CommandResult::TemporarilyRejected;
        }
        self.intention.choose(mode);
        if self.armed {
            self.failsafe.take_over();
        }
        CommandResult::Accepted
    }

    /// Takes off to a height above home (NaN: MIS_TAKEOFF_ALT), with a heading (NaN: the present one).
    pub fn takeoff(&mut self, height_m: f64, yaw_rad: f64, params: &Params) -> CommandResult {
        if self.armed && !self.landed && self.mode != Mode::AutoTakeoff {
            self.notify(2, "Takeoff denied! Please disarm and retry");
            return CommandResult::TemporarilyRejected;
        }
        let result = self.choose(Mode::AutoTakeoff, params);
        if result == CommandResult::Accepted {
            self.guidance.set_takeoff(height_m, yaw_rad);
        }
        result
    }

    fn set_home(&mut self) {
        self.home = Some(Home { position_m: self.estimate.position_m, yaw_rad: yaw_of(self.estimate.ned_from_frd) });
    }

    /// One tick: conditions, failsafes, mode, takeoff and landing, setpoint.
    pub fn update(&mut self, senses: &Senses, dt_s: f64, params: &Params) -> Order {
        self.now_s = senses.now_s;
        self.estimate = senses.estimate;
        self.charge = senses.charge;
        if self.home.is_none() && senses.now_s >= READY_AFTER_S {
            self.set_home();
            self.notify(6, "Ready for takeoff!");
        }
        self.update_failsafe(params);
        self.update_mode(params);
        let setpoint = self.setpoint(senses, dt_s, params);
        let lift = self.update_flight(senses, &setpoint, params);
        self.update_landed(senses, &setpoint, params);
        self.order = Order { setpoint, up_limit_mps: self.up_limit(params), lift: lift && self.armed };
        self.order
    }

    fn update_failsafe(&mut self, params: &Params) {
        let chosen = self.intention.mode();
        let sticks = self.sticks_fresh(self.now_s, params);
        let conditions = Conditions {
            armed: self.armed,
            offboard_lost: chosen == Mode::Offboard && !self.offboard_fresh(self.now_s, params),
            sticks,
            sticks_lost: chosen.needs_sticks() && !sticks,
            gcs_lost: !self.gcs_fresh(self.now_s, params),
            charge: self.charge,
            fence_breached: self.fence_breached(params),
        };
        self.decision = self.failsafe.update(self.now_s, &conditions, params);
        if let Some(cause) = self.decision.announce {
            let severity = if cause == Cause::BatteryLow { 4 } else { 2 };
            self.notify(severity, cause.text());
        }
    }

    fn update_mode(&mut self, params: &Params) {
        let chosen = self.intention.mode();
        let mode = if self.armed {
            match self.decision.action {
                Action::Hold => Mode::AutoLoiter,
                Action::Return => Mode::AutoRtl,
                Action::Land => Mode::AutoLand,
                Action::Disarm => {
                    self.stop_motors("Disarmed by failsafe");
                    return;
                }
                Action::Terminate => {
                    self.terminate();
                    return;
                }
                Action::None | Action::Warn => chosen,
            }
        } else {
            chosen
        };
        if mode != self.mode {
            self.mode = mode;
            self.guidance.enter(mode, &self.estimate, self.home, params);
        }
    }

    fn setpoint(&mut self, senses: &Senses, dt_s: f64, params: &Params) -> MotionSetpoint {
        match self.mode {
            Mode::Offboard => self.offboard.map_or(MotionSetpoint::NONE, |(_, setpoint, in_body)| {
                if in_body { rotated(setpoint, yaw_of(senses.estimate.ned_from_frd)) } else { setpoint }
            }),
            Mode::Termination => MotionSetpoint::NONE,
            mode if mode.needs_sticks() => {
                let sticks = self.sticks.map_or([0.0; 4], |(_, sticks)| sticks);
                self.guidance.manual(mode, sticks, &senses.estimate, params)
            }
            mode => {
                // On the ground the path waits under the vehicle until the climb begins.
                if matches!(self.flight, Flight::Disarmed | Flight::Spoolup { .. } | Flight::Ready)
                    && mode != Mode::AutoTakeoff
                {
                    self.guidance.wait(&senses.estimate);
                }
                let may_move = matches!(self.flight, Flight::Ramp { .. } | Flight::Flying);
                let step = self.guidance.auto(mode, senses, self.home, may_move, dt_s, params);
                if step.takeoff_done {
                    self.intention.choose(Mode::AutoLoiter);
                    self.mode = Mode::AutoLoiter;
                }
                step.setpoint
            }
        }
    }

    /// PX4's takeoff states; returns whether the motors may lift.
    fn update_flight(&mut self, senses: &Senses, setpoint: &MotionSetpoint, params: &Params) -> bool {
        let takes_off = matches!(self.mode, Mode::AutoTakeoff | Mode::Offboard) || self.mode.needs_sticks();
        let wants = takes_off && (self.mode == Mode::AutoTakeoff || setpoint.wants_up(senses.estimate.position_m.z));
        self.flight = match self.flight {
            Flight::Spoolup { until_s } if senses.now_s >= until_s => Flight::Ready,
            Flight::Ready if wants => Flight::Ramp { since_s: senses.now_s },
            // A takeoff that is called off before the feet leave the ground.
            Flight::Ramp { .. } if !wants && senses.contact => Flight::Ready,
            Flight::Ramp { since_s } if senses.now_s - since_s >= params.real(Param::MPC_TKO_RAMP_T) => Flight::Flying,
            Flight::Flying if self.landed => Flight::Ready,
            same => same,
        };
        matches!(self.flight, Flight::Ramp { .. } | Flight::Flying)
    }

    fn up_limit(&self, params: &Params) -> f64 {
        let takeoff = params.real(Param::MPC_TKO_SPEED);
        match self.flight {
            Flight::Ramp { since_s } => {
                let ramp_s = params.real(Param::MPC_TKO_RAMP_T).max(0.01);
                takeoff * ((self.now_s - since_s) / ramp_s).clamp(0.0, 1.0)
            }
            Flight::Flying if self.mode == Mode::AutoTakeoff => takeoff,
            _ => params.real(Param::MPC_Z_VEL_MAX_UP),
        }
    }

    fn update_landed(&mut self, senses: &Senses, setpoint: &MotionSetpoint, params: &Params) {
        if !senses.contact {
            self.contact_since_s = None;
            if self.armed || senses.height_m > 0.3 {
                self.has_flown |= self.armed;
                self.landed = false;
            }
            return;
        }
        let idle = matches!(self.flight, Flight::Disarmed | Flight::Spoolup { .. } | Flight::Ready);
        if idle || setpoint.wants_down(senses.estimate.position_m.z) || self.terminated {
            let since = *self.contact_since_s.get_or_insert(senses.now_s);
            if !self.landed && senses.now_s - since >= LANDED_AFTER_S {
                self.landed = true;
                self.landed_at_s = senses.now_s;
                self.notify(6, "Landing detected");
            }
        } else {
            self.contact_since_s = None;
        }
        self.auto_disarm(params);
    }

    fn auto_disarm(&mut self, params: &Params) {
        if !self.armed || !self.landed {
            return;
        }
        let (since_s, after_s, why) = if self.has_flown {
            (self.landed_at_s, params.real(Param::COM_DISARM_LAND), "Disarmed by landing")
        } else {
            (self.armed_at_s, params.real(Param::COM_DISARM_PRFLT), "Disarmed by auto preflight disarming")
        };
        if after_s > 0.0 && self.now_s - since_s >= after_s && !matches!(self.flight, Flight::Ramp { .. }) {
            self.stop_motors(why);
        }
    }
}
