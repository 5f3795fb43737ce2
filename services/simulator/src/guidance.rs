//! What each mode flies: Hold, takeoff, return and landing paths, and a pilot's sticks.

use glam::{DQuat, DVec3};

use crate::autopilot::{Home, Senses, Sticks};
use crate::control::{GRAVITY_MPS2, MotionSetpoint};
use crate::estimator::Estimate;
use crate::frames::{wrap_pi, yaw_of};
use crate::modes::Mode;
use crate::params::{Param, Params};
use crate::trajectory::{Limits, Trajectory};

/// Close enough to a waypoint of the return, m.
const NEAR_M: f64 = 0.5;
/// Largest tilt of the stick modes, rad (MPC_MAN_TILT_MAX 35°), and turn rate, rad/s (MPC_MAN_Y_MAX 150°/s).
const MANUAL_TILT_RAD: f64 = 0.61;
const MANUAL_YAW_RATE_RADPS: f64 = 2.6;

/// Where a return stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ReturnPhase {
    Climb,
    Home,
    Descend,
    Land,
}

/// A step of an auto mode.
#[derive(Debug, Clone, Copy)]
pub struct AutoStep {
    /// The setpoint.
    pub setpoint: MotionSetpoint,
    /// A takeoff has reached its height.
    pub takeoff_done: bool,
}

/// The paths' memory.
#[derive(Debug, Clone)]
pub struct Guidance {
    path: Trajectory,
    target_m: DVec3,
    yaw_rad: f64,
    yaw_target_rad: f64,
    phase: ReturnPhase,
    takeoff_height_m: f64,
    takeoff_yaw_rad: f64,
}

impl Default for Guidance {
    fn default() -> Self {
        Self {
            path: Trajectory::from_state(DVec3::ZERO, DVec3::ZERO),
            target_m: DVec3::ZERO,
            yaw_rad: 0.0,
            yaw_target_rad: 0.0,
            phase: ReturnPhase::Climb,
            takeoff_height_m: f64::NAN,
            takeoff_yaw_rad: f64::NAN,
        }
    }
}

impl Guidance {
    /// Begins a mode from the present state: auto modes brake and stay, then go their way.
    pub fn enter(&mut self, mode: Mode, estimate: &Estimate, home: Option<Home>, params: &Params) {
        self.path = Trajectory::from_state(estimate.position_m, estimate.velocity_mps);
        self.target_m = self.path.stopping_point(params.real(Param::MPC_ACC_HOR));
        self.yaw_rad = yaw_of(estimate.ned_from_frd);
        self.yaw_target_rad = self.yaw_rad;
        self.phase = ReturnPhase::Climb;
        if mode == Mode::AutoRtl {
            let height = home.map_or(0.0, |h| h.position_m.z) - params.real(Param::RTL_RETURN_ALT);
            self.target_m.z = self.target_m.z.min(height);
        }
    }

    /// Height (m above home) and heading of the next takeoff; NaN for the default and the present one.
    pub fn set_takeoff(&mut self, height_m: f64, yaw_rad: f64) {
        self.takeoff_height_m = height_m;
        self.takeoff_yaw_rad = yaw_rad;
    }

    /// The estimate jumped.
    pub fn shift(&mut self, jump_m: DVec3) {
        self.path.shift(jump_m);
        self.target_m += jump_m;
    }

    /// Stays under the vehicle while it stands on the ground.
    pub fn wait(&mut self, estimate: &Estimate) {
        self.path = Trajectory::from_state(estimate.position_m, DVec3::ZERO);
        self.target_m = estimate.position_m;
        self.yaw_rad = yaw_of(estimate.ned_from_frd);
        self.yaw_target_rad = self.yaw_rad;
    }

    /// A step of an auto mode; `may_move` is false until the motors may lift.
    pub fn auto(
        &mut self,
        mode: Mode,
        senses: &Senses,
        home: Option<Home>,
        may_move: bool,
        dt_s: f64,
        params: &Params,
    ) -> AutoStep {
        let mut takeoff_done = false;
        let mut down_mps = f64::NAN;
        match mode {
            Mode::AutoTakeoff => takeoff_done = self.takeoff(senses, home, may_move, dt_s, params),
            Mode::AutoRtl => down_mps = self.go_home(senses, home, dt_s, params),
            Mode::AutoLand => down_mps = self.land(senses, home, dt_s, params),
            _ => self.path.step(self.target_m, &limits(params), dt_s),
        }
        self.turn(dt_s, params);
        let (mut position, mut velocity) = (self.path.position_m, self.path.velocity_mps);
        if down_mps.is_finite() {
            position.z = f64::NAN;
            velocity.z = down_mps;
        }
        let setpoint = MotionSetpoint {
            position_m: position,
            velocity_mps: velocity,
            yaw_rad: self.yaw_rad,
            ..MotionSetpoint::NONE
        };
        AutoStep { setpoint, takeoff_done }
    }

    fn takeoff(&mut self, senses: &Senses, home: Option<Home>, may_move: bool, dt_s: f64, params: &Params) -> bool {
        if !may_move {
            self.wait(&senses.estimate);
            return false;
        }
        let height =
            if self.takeoff_height_m.is_finite() { self.takeoff_height_m } else { params.real(Param::MIS_TAKEOFF_ALT) };
        let home_z = home.map_or(0.0, |h| h.position_m.z);
        self.target_m.z = (home_z - height).min(self.target_m.z);
        if self.takeoff_yaw_rad.is_finite() {
            self.yaw_target_rad = self.takeoff_yaw_rad;
        }
        let climb = Limits { up_mps: params.real(Param::MPC_TKO_SPEED), ..limits(params) };
        // The path must not run ahead of a vehicle whose climb limit is still being ramped up.
        if self.path.position_m.z > senses.estimate.position_m.z - 0.5 {
            self.path.step(self.target_m, &climb, dt_s);
        } else {
            self.path.velocity_mps = DVec3::ZERO;
        }
        senses.estimate.position_m.z < self.target_m.z + 0.25
    }

    /// Climb, fly home, descend, land; gives the landing's speed once it lands.
    fn go_home(&mut self, senses: &Senses, home: Option<Home>, dt_s: f64, params: &Params) -> f64 {
        let Some(home) = home else { return self.land(senses, home, dt_s, params) };
        let away = home.position_m - self.path.position_m;
        match self.phase {
            ReturnPhase::Climb if (self.path.position_m.z - self.target_m.z).abs() < NEAR_M => {
                self.phase = ReturnPhase::Home;
                self.target_m = home.position_m.truncate().extend(self.target_m.z);
                if away.truncate().length() > 2.0 {
                    self.yaw_target_rad = away.y.atan2(away.x);
                }
            }
            ReturnPhase::Home if away.truncate().length() < NEAR_M => {
                self.phase = ReturnPhase::Descend;
                let descend_z = home.position_m.z - params.real(Param::RTL_DESCEND_ALT);
                self.target_m.z = self.target_m.z.max(descend_z);
                self.yaw_target_rad = home.yaw_rad;
            }
            ReturnPhase::Descend if (self.path.position_m.z - self.target_m.z).abs() < NEAR_M => {
                self.phase = ReturnPhase::Land;
            }
            ReturnPhase::Land => return self.land(senses, Some(home), dt_s, params),
            _ => {}
        }
        self.path.step(self.target_m, &limits(params), dt_s);
        f64::NAN
    }

    /// Descends where it is; the speed falls with the height.
    fn land(&mut self, senses: &Senses, home: Option<Home>, dt_s: f64, params: &Params) -> f64 {
        self.target_m.z = senses.estimate.position_m.z;
        self.path.step(self.target_m, &limits(params), dt_s);
        self.path.position_m.z = senses.estimate.position_m.z;
        let home_z = home.map_or(0.0, |h| h.position_m.z);
        land_speed(home_z - senses.estimate.position_m.z, senses.height_m, params)
    }

    fn turn(&mut self, dt_s: f64, params: &Params) {
        let most = params.radians(Param::MPC_YAWRAUTO_MAX).max(0.0) * dt_s;
        let error = wrap_pi(self.yaw_target_rad - self.yaw_rad);
        self.yaw_rad = wrap_pi(self.yaw_rad + error.clamp(-most, most));
    }

    /// The sticks' setpoint: velocity in POSCTL, tilt and climb otherwise.
    pub fn manual(&mut self, mode: Mode, sticks: Sticks, estimate: &Estimate, params: &Params) -> MotionSetpoint {
        let dead = |s: f64| if s.abs() < 0.05 { 0.0 } else { s };
        let [forward, right, up, turn] = sticks.map(dead);
        let heading = DQuat::from_rotation_z(yaw_of(estimate.ned_from_frd));
        let climb = if up > 0.0 { params.real(Param::MPC_Z_VEL_MAX_UP) } else { params.real(Param::MPC_Z_VEL_MAX_DN) };
        let push = heading * DVec3::new(forward, right, 0.0);
        let mut setpoint = MotionSetpoint { yaw_rate_radps: turn * MANUAL_YAW_RATE_RADPS, ..MotionSetpoint::NONE };
        if mode == Mode::Posctl {
            setpoint.velocity_mps = push * params.real(Param::MPC_VEL_MANUAL);
            if forward == 0.0 && right == 0.0 && up == 0.0 {
                // Sticks at rest: brake along the path, then hold the point.
                self.path.step(self.target_m, &limits(params), 0.01);
                setpoint.position_m = self.path.position_m;
                setpoint.velocity_mps = self.path.velocity_mps;
                return setpoint;
            }
        } else {
            setpoint.acceleration_mps2 = push * (GRAVITY_MPS2 * MANUAL_TILT_RAD.tan());
        }
        setpoint.velocity_mps.z = -up * climb;
        self.path = Trajectory::from_state(estimate.position_m, estimate.velocity_mps);
        self.target_m = self.path.stopping_point(params.real(Param::MPC_ACC_HOR));
        setpoint
    }
}

fn limits(params: &Params) -> Limits {
    Limits {
        horizontal_mps: params.real(Param::MPC_XY_CRUISE),
        up_mps: params.real(Param::MPC_Z_V_AUTO_UP),
        down_mps: params.real(Param::MPC_Z_V_AUTO_DN),
        acceleration_mps2: params.real(Param::MPC_ACC_HOR),
    }
}

/// MPC_Z_V_AUTO_DN above MPC_LAND_ALT1, MPC_LAND_SPEED below MPC_LAND_ALT2, straight between; MPC_LAND_CRWL below
/// MPC_LAND_ALT3 over the ground.
fn land_speed(above_home_m: f64, over_ground_m: f64, params: &Params) -> f64 {
    let (fast, slow) = (params.real(Param::MPC_Z_V_AUTO_DN), params.real(Param::MPC_LAND_SPEED));
    if over_ground_m < params.real(Param::MPC_LAND_ALT3) {
        return params.real(Param::MPC_LAND_CRWL);
    }
    let (high, low) = (params.real(Param::MPC_LAND_ALT1), params.real(Param::MPC_LAND_ALT2));
    let share = if high > low { ((above_home_m - low) / (high - low)).clamp(0.0, 1.0) } else { 0.0 };
    slow + (fast - slow) * share
}
