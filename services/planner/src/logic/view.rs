//! Views, and where the vehicle must be for its camera to have them.

use core::f64::consts::{FRAC_PI_2, PI, TAU};

use glam::{DQuat, DVec3};
use shared_types::frames::{Pose, look_at};

/// Above this elevation of the camera over what it looks at, yaw means little and is kept.
pub const KEEP_YAW_ABOVE_RAD: f64 = 80.0 * PI / 180.0;

/// A place for the camera and a point to look at, metres in the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// Position of the camera.
    pub position_m: DVec3,
    /// What it looks at.
    pub look_at_m: DVec3,
}

impl View {
    /// `world_from_camera` of the view.
    #[must_use]
    pub fn pose(&self) -> Pose {
        look_at(self.position_m, self.look_at_m)
    }

    /// Pitch of the optical axis, radians, negative down.
    #[must_use]
    pub fn pitch_rad(&self) -> f64 {
        let forward = (self.look_at_m - self.position_m).normalize_or(DVec3::X);
        forward.z.clamp(-1.0, 1.0).asin()
    }
}

/// How the camera hangs: from the body's origin to the gimbal's pivot (body frame, FLU), from there to the camera (payload
/// frame, x along the optical axis), metres.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Mount {
    /// The pivot in the body frame.
    pub pivot_in_body_m: DVec3,
    /// The camera in the payload frame.
    pub camera_in_payload_m: DVec3,
}

impl Mount {
    /// From the body's origin to the camera in the world, for a level body of this yaw and a payload of this pitch.
    #[must_use]
    pub fn camera_offset_m(&self, yaw_rad: f64, pitch_rad: f64) -> DVec3 {
        DQuat::from_rotation_z(yaw_rad)
            * (self.pivot_in_body_m + DQuat::from_rotation_y(-pitch_rad) * self.camera_in_payload_m)
    }

    /// How far the camera is below the body's origin at least, whatever the payload's pitch, metres; negative above it.
    #[must_use]
    pub fn least_drop_m(&self) -> f64 {
        let payload = self.camera_in_payload_m;
        -self.pivot_in_body_m.z - payload.x.hypot(payload.z)
    }
}

/// Where the vehicle must be and how it must be turned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Aim {
    /// Position of the body's origin in the world, metres.
    pub body_m: DVec3,
    /// Yaw (ENU, from east, counter-clockwise), radians.
    pub yaw_rad: f64,
    /// Pitch of the gimbal, radians, negative down.
    pub pitch_rad: f64,
}

/// Yaw and pitch that turn a camera from one point toward another. Above 80 degrees the yaw is kept, and the pitch is the
/// one that comes closest with it.
#[must_use]
pub fn turn_toward(from_m: DVec3, to_m: DVec3, kept_yaw_rad: f64) -> (f64, f64) {
    let forward = (to_m - from_m).normalize_or(DVec3::X);
    let pitch = forward.z.clamp(-1.0, 1.0).asin();
    let yaw = forward.y.atan2(forward.x);
    if pitch > -KEEP_YAW_ABOVE_RAD {
        return (yaw, pitch);
    }
    let tilt = FRAC_PI_2 + pitch;
    (kept_yaw_rad, (tilt * (yaw - kept_yaw_rad).cos() - FRAC_PI_2).max(-FRAC_PI_2))
}

/// The vehicle's place for a view. `kept_yaw_rad` is the yaw that is kept above 80 degrees.
#[must_use]
pub fn aim(view: &View, mount: &Mount, kept_yaw_rad: f64) -> Aim {
    let (yaw_rad, pitch_rad) = turn_toward(view.position_m, view.look_at_m, kept_yaw_rad);
    Aim { body_m: view.position_m - mount.camera_offset_m(yaw_rad, pitch_rad), yaw_rad, pitch_rad }
}

/// The angle in (-pi, pi] that differs from this one by whole turns.
#[must_use]
pub fn wrap_angle(angle_rad: f64) -> f64 {
    let wrapped = (angle_rad + PI).rem_euclid(TAU) - PI;
    if wrapped <= -PI { PI } else { wrapped }
}

#[cfg(test)]
mod tests {
    use super::*;

    proptest::proptest! {
        #[test]
        fn an_aimed_vehicle_has_its_camera_at_the_view(
            x in -5.0..5.0f64, y in -5.0..5.0f64, z in 0.3..6.0f64, kept in -3.0..3.0f64,
        ) {
            let mount = Mount { pivot_in_body_m: DVec3::new(0.1, 0.0, -0.05), camera_in_payload_m: DVec3::new(0.03, 0.01, 0.02) };
            let view = View { position_m: DVec3::new(x, y, z), look_at_m: DVec3::new(0.0, 0.0, 0.5) };
            let aimed = aim(&view, &mount, kept);
            let camera = aimed.body_m + mount.camera_offset_m(aimed.yaw_rad, aimed.pitch_rad);
            proptest::prop_assert!((camera - view.position_m).length() < 1e-9);
            let axis = DQuat::from_rotation_z(aimed.yaw_rad) * DQuat::from_rotation_y(-aimed.pitch_rad) * DVec3::X;
            let wanted = view.pose().rotation * DVec3::Z;
            // With a kept yaw the axis may be off by twice what is left to straight down.
            let allowed = if view.pitch_rad() > -KEEP_YAW_ABOVE_RAD { 1e-6 } else { 0.36 };
            proptest::prop_assert!(axis.angle_between(wanted) < allowed, "{axis} {wanted}");
        }

        #[test]
        fn wrapped_angles_are_the_same_angle(angle in -50.0..50.0f64) {
            let wrapped = wrap_angle(angle);
            proptest::prop_assert!(wrapped > -PI - 1e-12 && wrapped <= PI);
            proptest::prop_assert!(((wrapped - angle) / TAU - ((wrapped - angle) / TAU).round()).abs() < 1e-9);
        }
    }
}
