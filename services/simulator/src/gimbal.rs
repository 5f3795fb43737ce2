//! A two-axis stabilised gimbal (pitch and yaw; roll is kept level) behind PX4's gimbal protocol v2.
//!
//! Pitch is held against the earth, yaw against the vehicle (follow) or the earth (lock). Nothing moves it but the
//! client in primary control.

use glam::DQuat;

use crate::frames::{euler_of, from_euler, wrap_pi};
use crate::params::{Param, Params};

/// GIMBAL_DEVICE_FLAGS, as the protocol numbers them.
pub mod flags {
    /// Roll is held against the horizon.
    pub const ROLL_LOCK: u16 = 4;
    /// Pitch is held against the horizon.
    pub const PITCH_LOCK: u16 = 8;
    /// Yaw is held against north.
    pub const YAW_LOCK: u16 = 16;
    /// The reported yaw is against the vehicle's heading.
    pub const YAW_IN_VEHICLE_FRAME: u16 = 32;
    /// The reported yaw is against north.
    pub const YAW_IN_EARTH_FRAME: u16 = 64;
}

/// Fastest turn of an axis, rad/s, and how fast it closes in on its target, 1/s.
const RATE_MAX_RADPS: f64 = 1.6;
const CLOSING_PER_S: f64 = 8.0;
/// Largest acceleration of an axis, rad/s².
const ACCELERATION_MAX_RADPS2: f64 = 20.0;

/// Who may command the gimbal (system, component); (0, 0) is nobody.
pub type Controller = (u8, u8);

/// One axis: closes in on a target with limited rate and acceleration.
#[derive(Debug, Clone, Copy, Default)]
struct Axis {
    angle_rad: f64,
    rate_radps: f64,
}

impl Axis {
    fn step(&mut self, error_rad: f64, dt_s: f64) {
        // The rate from which the axis can still stop in time.
        let stopping = (2.0 * 0.5 * ACCELERATION_MAX_RADPS2 * error_rad.abs()).sqrt();
        let limit = RATE_MAX_RADPS.min(stopping);
        let wanted = (CLOSING_PER_S * error_rad).clamp(-limit, limit);
        let change = (wanted - self.rate_radps).clamp(-ACCELERATION_MAX_RADPS2 * dt_s, ACCELERATION_MAX_RADPS2 * dt_s);
        self.rate_radps += change;
        self.angle_rad += self.rate_radps * dt_s;
    }
}

/// The gimbal's state.
#[derive(Debug, Clone)]
pub struct Gimbal {
    primary: Controller,
    secondary: Controller,
    target_pitch_rad: f64,
    target_yaw_rad: f64,
    target_pitch_rate_radps: f64,
    target_yaw_rate_radps: f64,
    yaw_lock: bool,
    pitch: Axis,
    /// Yaw against the vehicle.
    yaw: Axis,
}

impl Default for Gimbal {
    fn default() -> Self {
        Self {
            primary: (0, 0),
            secondary: (0, 0),
            target_pitch_rad: 0.0,
            target_yaw_rad: 0.0,
            target_pitch_rate_radps: 0.0,
            target_yaw_rate_radps: 0.0,
            yaw_lock: false,
            pitch: Axis::default(),
            yaw: Axis::default(),
        }
    }
}

impl Gimbal {
    /// Who is in primary control.
    #[must_use]
    pub fn primary(&self) -> Controller {
        self.primary
    }

    /// Who is in secondary control.
    #[must_use]
    pub fn secondary(&self) -> Controller {
        self.secondary
    }

    /// Takes or gives up control as command 1001 says: -1 leaves as it is, -2 is the sender, -3 removes the sender, 0
    /// nobody.
    pub fn configure(&mut self, sender: Controller, primary: (f32, f32), secondary: (f32, f32)) {
        self.primary = configured(self.primary, sender, primary);
        self.secondary = configured(self.secondary, sender, secondary);
    }

    /// Aims, where the sender is in primary control. Angles in radians, NaN leaves an axis to its rate (rad/s; NaN is 0).
    /// Returns whether the sender was allowed to.
    pub fn aim(
        &mut self,
        sender: Controller,
        pitch: (f64, f64),
        yaw: (f64, f64),
        yaw_lock: bool,
        params: &Params,
    ) -> bool {
        if sender != self.primary {
            return false;
        }
        let rate = |r: f64| if r.is_finite() { r } else { 0.0 };
        let (low, high) = Self::pitch_range_rad(params);
        if pitch.0.is_finite() {
            self.target_pitch_rad = pitch.0.clamp(low, high);
            self.target_pitch_rate_radps = 0.0;
        } else {
            self.target_pitch_rate_radps = rate(pitch.1);
        }
        if yaw.0.is_finite() {
            self.target_yaw_rad = wrap_pi(yaw.0);
            self.target_yaw_rate_radps = 0.0;
            self.yaw_lock = yaw_lock;
        } else {
            self.target_yaw_rate_radps = rate(yaw.1);
        }
        true
    }

    /// Aims by an attitude (message 282); a quaternion that is not one leaves the axes to their rates.
    pub fn aim_attitude(
        &mut self,
        sender: Controller,
        q: DQuat,
        rates: (f64, f64),
        yaw_lock: bool,
        params: &Params,
    ) -> bool {
        let (pitch, yaw) = if q.is_finite() && q.length_squared() > 0.5 {
            let (_, pitch, yaw) = euler_of(q.normalize());
            (pitch, yaw)
        } else {
            (f64::NAN, f64::NAN)
        };
        self.aim(sender, (pitch, rates.0), (yaw, rates.1), yaw_lock, params)
    }

    /// Lowest and highest pitch, radians.
    #[must_use]
    pub fn pitch_range_rad(params: &Params) -> (f64, f64) {
        let (low, high) = (params.radians(Param::MNT_MIN_PITCH), params.radians(Param::MNT_MAX_PITCH));
        (low.min(high), high.max(low))
    }

    /// Advances by `dt_s` under a vehicle of a true heading and turn rate.
    pub fn step(&mut self, vehicle_yaw_rad: f64, dt_s: f64, params: &Params) {
        let (low, high) = Self::pitch_range_rad(params);
        self.target_pitch_rad = (self.target_pitch_rad + self.target_pitch_rate_radps * dt_s).clamp(low, high);
        self.target_yaw_rad = wrap_pi(self.target_yaw_rad + self.target_yaw_rate_radps * dt_s);
        self.pitch.step(self.target_pitch_rad - self.pitch.angle_rad, dt_s);
        let base = if self.yaw_lock { vehicle_yaw_rad } else { 0.0 };
        self.yaw.step(wrap_pi(self.target_yaw_rad - base - self.yaw.angle_rad), dt_s);
        self.yaw.angle_rad = wrap_pi(self.yaw.angle_rad);
    }

    /// Pitch against the horizon, radians.
    #[must_use]
    pub fn pitch_rad(&self) -> f64 {
        self.pitch.angle_rad
    }

    /// Turn rates (pitch, yaw), rad/s.
    #[must_use]
    pub fn rates_radps(&self) -> (f64, f64) {
        (self.pitch.rate_radps, self.yaw.rate_radps)
    }

    /// The payload's true attitude (forward-right-down in NED) under a vehicle of a true heading.
    #[must_use]
    pub fn ned_from_payload(&self, vehicle_yaw_rad: f64) -> DQuat {
        from_euler(0.0, self.pitch.angle_rad, vehicle_yaw_rad + self.yaw.angle_rad)
    }

    /// Flags of GIMBAL_DEVICE_ATTITUDE_STATUS: what is locked and which yaw the quaternion holds.
    #[must_use]
    pub fn flags(&self) -> u16 {
        let yaw = if self.yaw_lock { flags::YAW_LOCK | flags::YAW_IN_EARTH_FRAME } else { flags::YAW_IN_VEHICLE_FRAME };
        flags::ROLL_LOCK | flags::PITCH_LOCK | yaw
    }

    /// Whether yaw is held against north.
    #[must_use]
    pub fn yaw_lock(&self) -> bool {
        self.yaw_lock
    }
}

fn configured(present: Controller, sender: Controller, wanted: (f32, f32)) -> Controller {
    match (wanted.0.round() as i32, wanted.1.round() as i32) {
        (-1, _) | (_, -1) => present,
        (-2, _) | (_, -2) => sender,
        (-3, _) | (_, -3) if present == sender => (0, 0),
        (-3, _) | (_, -3) => present,
        (system, component) => match (u8::try_from(system), u8::try_from(component)) {
            (Ok(system), Ok(component)) => (system, component),
            _ => present,
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ME: Controller = (245, 190);

    #[test]
    fn only_the_client_in_control_moves_it() {
        let params = Params::default();
        let mut gimbal = Gimbal::default();
        assert!(!gimbal.aim(ME, (-0.5, f64::NAN), (0.0, f64::NAN), false, &params));
        gimbal.configure(ME, (-2.0, -2.0), (-1.0, -1.0));
        assert_eq!(gimbal.primary(), ME);
        assert!(gimbal.aim(ME, (-0.5, f64::NAN), (0.0, f64::NAN), false, &params));
        assert!(!gimbal.aim((1, 191), (0.0, f64::NAN), (0.0, f64::NAN), false, &params));
        gimbal.configure((1, 191), (-3.0, -3.0), (-1.0, -1.0));
        assert_eq!(gimbal.primary(), ME, "another cannot remove it");
        gimbal.configure(ME, (-3.0, -3.0), (-1.0, -1.0));
        assert_eq!(gimbal.primary(), (0, 0));
    }

    #[test]
    fn it_moves_with_limited_rate_to_within_its_range() {
        let params = Params::default();
        let mut gimbal = Gimbal::default();
        gimbal.configure(ME, (-2.0, -2.0), (-1.0, -1.0));
        assert!(gimbal.aim(ME, (-2.0, f64::NAN), (0.0, f64::NAN), false, &params));
        let (mut fastest, mut lowest, mut last) = (0.0f64, 0.0f64, 0.0);
        for _ in 0..300 {
            gimbal.step(0.0, 0.01, &params);
            fastest = fastest.max((gimbal.pitch_rad() - last).abs() / 0.01);
            last = gimbal.pitch_rad();
            lowest = lowest.min(last);
        }
        assert!((last + core::f64::consts::FRAC_PI_2).abs() < 1e-3, "stops at -90°: {last}");
        assert!(fastest <= RATE_MAX_RADPS + 1e-6 && fastest > 1.2, "{fastest}");
        assert!(lowest > -1.60, "no more than a little overshoot: {lowest}");
    }

    #[test]
    fn yaw_lock_keeps_the_camera_pointed_while_the_vehicle_turns() {
        let params = Params::default();
        let mut gimbal = Gimbal::default();
        gimbal.configure(ME, (-2.0, -2.0), (-1.0, -1.0));
        assert!(gimbal.aim(ME, (0.0, f64::NAN), (0.7, f64::NAN), true, &params));
        let mut heading = 0.0;
        for _ in 0..600 {
            heading += 0.003;
            gimbal.step(heading, 0.01, &params);
        }
        for _ in 0..200 {
            gimbal.step(heading, 0.01, &params);
        }
        let (_, _, yaw) = euler_of(gimbal.ned_from_payload(heading));
        assert!((yaw - 0.7).abs() < 0.01, "{yaw}");
        assert_eq!(gimbal.flags(), flags::ROLL_LOCK | flags::PITCH_LOCK | flags::YAW_LOCK | flags::YAW_IN_EARTH_FRAME);
    }
}
