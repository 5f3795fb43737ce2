//! What the autopilot takes and gives: senses, orders, answers, messages for the pilot.

use glam::{DQuat, DVec3};

use crate::battery::Charge;
use crate::control::MotionSetpoint;
use crate::estimator::Estimate;
use crate::frames::wrap_pi;

/// Outcome of a command, MAV_RESULT.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum CommandResult {
    /// Done or begun.
    Accepted = 0,
    /// Not now.
    TemporarilyRejected = 1,
    /// Not this way.
    Denied = 2,
    /// Not known.
    Unsupported = 3,
}

/// A message for the pilot; severity as MAV_SEVERITY.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Notice {
    /// 0 worst, 6 information.
    pub severity: u8,
    /// The text.
    pub text: String,
}

/// Where arming and flying stand (PX4's takeoff states).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Flight {
    /// Motors off.
    Disarmed,
    /// Motors spin up until a time.
    Spoolup {
        /// End, seconds since boot.
        until_s: f64,
    },
    /// Armed on the ground.
    Ready,
    /// The climb limit grows since a time.
    Ramp {
        /// Beginning, seconds since boot.
        since_s: f64,
    },
    /// In the air.
    Flying,
}

/// What the autopilot sees of a moment.
#[derive(Debug, Clone, Copy)]
pub struct Senses {
    /// Time since boot, s.
    pub now_s: f64,
    /// The estimate.
    pub estimate: Estimate,
    /// The feet touch the ground.
    pub contact: bool,
    /// Height above the ground by the rangefinder, m.
    pub height_m: f64,
    /// Charge of the battery.
    pub charge: Charge,
}

/// What the cascade gets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Order {
    /// The setpoint.
    pub setpoint: MotionSetpoint,
    /// The climb limit of the moment, m/s.
    pub up_limit_mps: f64,
    /// Thrust at all: false idles the motors.
    pub lift: bool,
}

/// Where it took off, in the local frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Home {
    /// NED, m.
    pub position_m: DVec3,
    /// Heading, rad.
    pub yaw_rad: f64,
}

/// Sticks of MANUAL_CONTROL, each -1 to 1: forward, right, up, turn right.
pub type Sticks = [f64; 4];

/// Forward and right become north and east.
#[must_use]
pub fn rotated(setpoint: MotionSetpoint, yaw_rad: f64) -> MotionSetpoint {
    let turn = DQuat::from_rotation_z(wrap_pi(yaw_rad));
    // A NaN in one horizontal axis leaves both free: they cannot be told apart after the turn.
    let turned = |v: DVec3| {
        let flat = turn * v.truncate().extend(0.0);
        DVec3::new(flat.x, flat.y, v.z)
    };
    MotionSetpoint {
        velocity_mps: turned(setpoint.velocity_mps),
        acceleration_mps2: turned(setpoint.acceleration_mps2),
        ..setpoint
    }
}
