//! North-east-down and forward-right-down to the world's east-north-up and the body's forward-left-up.
//!
//! The vehicle inside this crate lives in NED and FRD, as PX4 does; only the truth leaves it in the world's frames.

use glam::{DQuat, DVec3};

/// A vector of NED in ENU (and back: the map is its own inverse).
#[must_use]
pub fn enu_from_ned(v: DVec3) -> DVec3 {
    DVec3::new(v.y, v.x, -v.z)
}

/// The rotation that takes NED axes to ENU: half a turn about the axis between north and east.
#[must_use]
pub fn enu_from_ned_rotation() -> DQuat {
    DQuat::from_xyzw(core::f64::consts::FRAC_1_SQRT_2, core::f64::consts::FRAC_1_SQRT_2, 0.0, 0.0)
}

/// The rotation that takes FRD axes to FLU: half a turn about the forward axis.
#[must_use]
pub fn frd_from_flu_rotation() -> DQuat {
    DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0)
}

/// Attitude of a FLU body in ENU from the attitude of the same body as FRD in NED.
#[must_use]
pub fn enu_from_flu(ned_from_frd: DQuat) -> DQuat {
    (enu_from_ned_rotation() * ned_from_frd * frd_from_flu_rotation()).normalize()
}

/// Heading of an attitude: rotation about down, radians.
#[must_use]
pub fn yaw_of(q: DQuat) -> f64 {
    let x = q * DVec3::X;
    x.y.atan2(x.x)
}

/// Roll, pitch and yaw (about forward, right and down in the order yaw, pitch, roll) of an attitude, radians.
#[must_use]
pub fn euler_of(q: DQuat) -> (f64, f64, f64) {
    let (x, y, z, w) = (q.x, q.y, q.z, q.w);
    let roll = (2.0 * (w * x + y * z)).atan2(1.0 - 2.0 * (x * x + y * y));
    let pitch = (2.0 * (w * y - z * x)).clamp(-1.0, 1.0).asin();
    let yaw = (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z));
    (roll, pitch, yaw)
}

/// Attitude of roll, pitch and yaw, radians.
#[must_use]
pub fn from_euler(roll: f64, pitch: f64, yaw: f64) -> DQuat {
    DQuat::from_rotation_z(yaw) * DQuat::from_rotation_y(pitch) * DQuat::from_rotation_x(roll)
}

/// An angle in (-π, π].
#[must_use]
pub fn wrap_pi(angle_rad: f64) -> f64 {
    let wrapped = (angle_rad + core::f64::consts::PI).rem_euclid(core::f64::consts::TAU) - core::f64::consts::PI;
    if wrapped == -core::f64::consts::PI { core::f64::consts::PI } else { wrapped }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::f64::consts::FRAC_PI_2;

    #[test]
    fn a_vehicle_heading_north_looks_along_the_worlds_y() {
        let q = enu_from_flu(DQuat::IDENTITY);
        assert!((q * DVec3::X).abs_diff_eq(DVec3::Y, 1e-12));
        assert!((q * DVec3::Z).abs_diff_eq(DVec3::Z, 1e-12));
        let east = enu_from_flu(from_euler(0.0, 0.0, FRAC_PI_2));
        assert!((east * DVec3::X).abs_diff_eq(DVec3::X, 1e-12));
    }

    #[test]
    fn a_payload_pitched_down_looks_at_the_ground_with_its_top_to_the_front() {
        let down = enu_from_flu(from_euler(0.0, -FRAC_PI_2, 0.0));
        assert!((down * DVec3::X).abs_diff_eq(-DVec3::Z, 1e-12));
        assert!((down * DVec3::Z).abs_diff_eq(DVec3::Y, 1e-12), "its top points north");
    }

    proptest::proptest! {
        #[test]
        fn euler_angles_come_back(roll in -3.0..3.0f64, pitch in -1.5..1.5f64, yaw in -3.1..3.1f64) {
            let (r, p, y) = euler_of(from_euler(roll, pitch, yaw));
            proptest::prop_assert!((r - roll).abs() < 1e-9 && (p - pitch).abs() < 1e-9 && (y - yaw).abs() < 1e-9);
        }

        #[test]
        fn wrapped_angles_lie_within_half_a_turn(angle in -100.0..100.0f64) {
            let w = wrap_pi(angle);
            proptest::prop_assert!(w > -core::f64::consts::PI - 1e-12 && w <= core::f64::consts::PI);
            proptest::prop_assert!(((w - angle).sin()).abs() < 1e-9);
        }
    }
}
