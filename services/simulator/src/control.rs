//! PX4's multicopter cascade: position to velocity to acceleration to thrust, and heading to yaw rate.
//!
//! Gains, limits and their defaults are PX4's parameters. A setpoint's fields may be NaN, which means "not controlled",
//! as in PX4's trajectory setpoint.

use glam::{DVec2, DVec3};

use crate::estimator::Estimate;
use crate::frames::{wrap_pi, yaw_of};
use crate::params::{Param, Params};

/// Gravity, m/s².
pub const GRAVITY_MPS2: f64 = 9.806_65;
/// Largest thrust over weight: four rotors of 8.55 N on 2.06 kg.
pub const THRUST_TO_WEIGHT: f64 = 1.69;
/// Smallest thrust over weight that keeps the attitude controllable (MPC_THR_MIN 0.12 against hover 0.6).
const MIN_THRUST_TO_WEIGHT: f64 = 0.2;
/// Largest horizontal acceleration that the cascade asks for, m/s².
const MAX_HORIZONTAL_MPS2: f64 = 8.0;
/// Largest part of the horizontal acceleration that the integrator may hold, m/s² (wind of 8.5 m/s at the body's drag).
const MAX_INTEGRAL_MPS2: f64 = 6.0;

/// What the vehicle should do; NaN fields are not controlled. NED, metres, radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionSetpoint {
    /// Position.
    pub position_m: DVec3,
    /// Velocity, or feed-forward where the position is given too.
    pub velocity_mps: DVec3,
    /// Acceleration, feed-forward.
    pub acceleration_mps2: DVec3,
    /// Heading.
    pub yaw_rad: f64,
    /// Turn rate, or feed-forward where the heading is given too.
    pub yaw_rate_radps: f64,
}

impl MotionSetpoint {
    /// Nothing controlled.
    pub const NONE: Self = Self {
        position_m: DVec3::NAN,
        velocity_mps: DVec3::NAN,
        acceleration_mps2: DVec3::NAN,
        yaw_rad: f64::NAN,
        yaw_rate_radps: f64::NAN,
    };

    /// Whether anything is controlled.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        let any = |v: DVec3| v.to_array().iter().any(|x| x.is_finite());
        !any(self.position_m) && !any(self.velocity_mps) && !any(self.acceleration_mps2)
    }

    /// Whether it asks to go up from where the vehicle stands (NED: down is positive).
    #[must_use]
    pub fn wants_up(&self, z_m: f64) -> bool {
        (self.position_m.z.is_finite() && self.position_m.z < z_m - 0.1)
            || (self.velocity_mps.z.is_finite() && self.velocity_mps.z < -0.1)
            || (self.acceleration_mps2.z.is_finite() && self.acceleration_mps2.z < -0.5)
    }

    /// Whether it asks to go down from where the vehicle is.
    #[must_use]
    pub fn wants_down(&self, z_m: f64) -> bool {
        (self.position_m.z.is_finite() && self.position_m.z > z_m + 0.1)
            || (self.velocity_mps.z.is_finite() && self.velocity_mps.z > 0.1)
    }
}

/// What the cascade asks of the body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ControlOutput {
    /// Thrust per mass in the estimator's NED, m/s²; hover is (0, 0, -g).
    pub specific_force_mps2: DVec3,
    /// Turn rate about down, rad/s.
    pub yaw_rate_radps: f64,
    /// Velocity setpoint after its limits, m/s.
    pub velocity_setpoint_mps: DVec3,
}

impl ControlOutput {
    /// Motors idle: no thrust, no turn.
    pub const IDLE: Self =
        Self { specific_force_mps2: DVec3::ZERO, yaw_rate_radps: 0.0, velocity_setpoint_mps: DVec3::ZERO };
}

/// The cascade's memory: the velocity loop's integrator and the heading it keeps when none is given.
#[derive(Debug, Clone)]
pub struct PositionControl {
    integral_mps2: DVec3,
    held_yaw_rad: f64,
}

impl PositionControl {
    /// A cascade that keeps a heading.
    #[must_use]
    pub fn new(yaw_rad: f64) -> Self {
        Self { integral_mps2: DVec3::ZERO, held_yaw_rad: yaw_rad }
    }

    /// Forgets the integrator and keeps the present heading: on the ground.
    pub fn reset(&mut self, yaw_rad: f64) {
        *self = Self::new(yaw_rad);
    }

    /// One step of the cascade. `up_limit_mps` is the climb limit of the moment (takeoff ramps it).
    pub fn update(
        &mut self,
        setpoint: &MotionSetpoint,
        estimate: &Estimate,
        params: &Params,
        up_limit_mps: f64,
        dt_s: f64,
    ) -> ControlOutput {
        let velocity_sp = velocity_setpoint(setpoint, estimate, params, up_limit_mps);
        let p = DVec3::new(
            params.real(Param::MPC_XY_VEL_P_ACC),
            params.real(Param::MPC_XY_VEL_P_ACC),
            params.real(Param::MPC_Z_VEL_P_ACC),
        );
        let d = params.real(Param::MPC_XY_VEL_D_ACC);
        let feed_forward = or_zero(setpoint.acceleration_mps2);
        let mut wanted = feed_forward;
        let mut error = DVec3::ZERO;
        for axis in 0..3 {
            if velocity_sp[axis].is_finite() {
                error[axis] = velocity_sp[axis] - estimate.velocity_mps[axis];
                wanted[axis] += p[axis] * error[axis] + self.integral_mps2[axis] - d * estimate.acceleration_mps2[axis];
            }
        }
        let limited = limit_acceleration(wanted, params);
        self.integrate(error, wanted, limited, p.x, params, dt_s);
        ControlOutput {
            specific_force_mps2: limited - DVec3::Z * GRAVITY_MPS2,
            yaw_rate_radps: self.yaw_rate(setpoint, estimate, params),
            velocity_setpoint_mps: or_zero(velocity_sp),
        }
    }

    /// PX4's tracking anti-windup horizontally, a stop at saturation vertically.
    fn integrate(&mut self, error: DVec3, wanted: DVec3, limited: DVec3, p_xy: f64, params: &Params, dt_s: f64) {
        let back = if p_xy > 0.0 { 2.0 / p_xy } else { 0.0 };
        let xy_gain = params.real(Param::MPC_XY_VEL_I_ACC);
        for axis in 0..2 {
            let unsaturated = error[axis] - back * (wanted[axis] - limited[axis]);
            self.integral_mps2[axis] += xy_gain * unsaturated * dt_s;
        }
        let horizontal = DVec2::new(self.integral_mps2.x, self.integral_mps2.y).clamp_length_max(MAX_INTEGRAL_MPS2);
        let mut z = self.integral_mps2.z;
        if wanted.z == limited.z {
            z += params.real(Param::MPC_Z_VEL_I_ACC) * error.z * dt_s;
        }
        self.integral_mps2 = horizontal.extend(z.clamp(-MAX_INTEGRAL_MPS2, MAX_INTEGRAL_MPS2));
    }

    fn yaw_rate(&mut self, setpoint: &MotionSetpoint, estimate: &Estimate, params: &Params) -> f64 {
        let limit = params.radians(Param::MC_YAWRATE_MAX).max(0.0);
        let feed_forward = if setpoint.yaw_rate_radps.is_finite() { setpoint.yaw_rate_radps } else { 0.0 };
        let yaw = yaw_of(estimate.ned_from_frd);
        if setpoint.yaw_rad.is_finite() {
            self.held_yaw_rad = setpoint.yaw_rad;
        } else if feed_forward != 0.0 {
            // A turn rate alone leaves the heading free.
            self.held_yaw_rad = yaw;
        }
        let rate = params.real(Param::MC_YAW_P) * wrap_pi(self.held_yaw_rad - yaw) + feed_forward;
        rate.clamp(-limit, limit)
    }
}

fn or_zero(v: DVec3) -> DVec3 {
    DVec3::from_array(v.to_array().map(|x| if x.is_finite() { x } else { 0.0 }))
}

/// v = P·e + feed-forward; the position's part keeps its share when both exceed the limit (PX4's constrainXY, simplified
/// to a common scale when the sum is too long).
fn velocity_setpoint(setpoint: &MotionSetpoint, estimate: &Estimate, params: &Params, up_limit_mps: f64) -> DVec3 {
    let gain = DVec3::new(params.real(Param::MPC_XY_P), params.real(Param::MPC_XY_P), params.real(Param::MPC_Z_P));
    let mut velocity = DVec3::NAN;
    for axis in 0..3 {
        let feed_forward = setpoint.velocity_mps[axis];
        let target = setpoint.position_m[axis];
        velocity[axis] = match (target.is_finite(), feed_forward.is_finite()) {
            (true, true) => gain[axis] * (target - estimate.position_m[axis]) + feed_forward,
            (true, false) => gain[axis] * (target - estimate.position_m[axis]),
            (false, _) => feed_forward,
        };
    }
    if velocity.x.is_finite() && velocity.y.is_finite() {
        let limit = params.real(Param::MPC_XY_VEL_MAX).max(0.0);
        let horizontal = DVec2::new(velocity.x, velocity.y).clamp_length_max(limit.max(1e-6));
        velocity.x = horizontal.x;
        velocity.y = horizontal.y;
    }
    if velocity.z.is_finite() {
        let up = up_limit_mps.min(params.real(Param::MPC_Z_VEL_MAX_UP)).max(0.0);
        velocity.z = velocity.z.clamp(-up, params.real(Param::MPC_Z_VEL_MAX_DN).max(0.0));
    }
    velocity
}

/// Thrust and tilt limits; the vertical comes first.
fn limit_acceleration(wanted: DVec3, params: &Params) -> DVec3 {
    let up = GRAVITY_MPS2 * (THRUST_TO_WEIGHT - 1.0);
    let down = GRAVITY_MPS2 * (1.0 - MIN_THRUST_TO_WEIGHT);
    let z = if wanted.z.is_finite() { wanted.z.clamp(-up, down) } else { 0.0 };
    let thrust_z = GRAVITY_MPS2 - z;
    let tilt = params.radians(Param::MPC_TILTMAX_AIR).clamp(0.05, 1.4);
    let by_thrust = ((GRAVITY_MPS2 * THRUST_TO_WEIGHT).powi(2) - thrust_z * thrust_z).max(0.0).sqrt();
    let limit = (thrust_z * tilt.tan()).min(by_thrust.max(1.0)).min(MAX_HORIZONTAL_MPS2);
    DVec2::new(wanted.x, wanted.y).clamp_length_max(limit).extend(z)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn still() -> Estimate {
        Estimate::default()
    }

    #[test]
    fn hover_asks_for_weight_and_nothing_else() {
        let params = Params::default();
        let mut control = PositionControl::new(0.0);
        let setpoint = MotionSetpoint { position_m: DVec3::ZERO, ..MotionSetpoint::NONE };
        let out = control.update(&setpoint, &still(), &params, 3.0, 0.0025);
        assert!(out.specific_force_mps2.abs_diff_eq(DVec3::new(0.0, 0.0, -GRAVITY_MPS2), 1e-12));
        assert!(out.yaw_rate_radps == 0.0);
    }

    proptest::proptest! {
        #[test]
        fn limits_hold_whatever_is_asked(
            target in proptest::array::uniform3(-1e4..1e4f64),
            feed_forward in proptest::array::uniform3(-1e3..1e3f64),
            velocity in proptest::array::uniform3(-30.0..30.0f64),
            yaw in -10.0..10.0f64,
        ) {
            let params = Params::default();
            let mut control = PositionControl::new(0.0);
            let estimate = Estimate { velocity_mps: DVec3::from_array(velocity), ..still() };
            let setpoint = MotionSetpoint {
                position_m: DVec3::from_array(target),
                velocity_mps: DVec3::from_array(feed_forward),
                acceleration_mps2: DVec3::from_array(feed_forward),
                yaw_rad: yaw,
                yaw_rate_radps: feed_forward[0],
            };
            let out = control.update(&setpoint, &estimate, &params, 3.0, 0.0025);
            let f = out.specific_force_mps2;
            let horizontal = f.truncate().length();
            proptest::prop_assert!(f.is_finite());
            proptest::prop_assert!(horizontal <= -f.z * 45.0f64.to_radians().tan() + 1e-9, "tilt {f}");
            proptest::prop_assert!(out.yaw_rate_radps.abs() <= 200.0f64.to_radians() + 1e-9);
            let v = out.velocity_setpoint_mps;
            proptest::prop_assert!(v.truncate().length() <= 12.0 + 1e-9 && v.z <= 1.5 && v.z >= -3.0);
        }
    }
}
