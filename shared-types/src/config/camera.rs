//! Section `[camera]`: what the camera sees, where it sits, and how still it must be.

use glam::{DQuat, DVec3, EulerRot};
use serde::{Deserialize, Serialize};

use crate::frames::{Intrinsics, Pose, flu_from_optical};

/// Section `[camera]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CameraConfig {
    /// Width of a captured image, pixels.
    pub width_px: u32,
    /// Height of a captured image, pixels.
    pub height_px: u32,
    /// Horizontal field of view, radians; pixels are square and the principal point is the centre.
    pub hfov_rad: f64,
    /// Nearest depth that is measured, metres; what is nearer reads 0.
    pub depth_min_m: f64,
    /// Farthest depth that is measured, metres; what is farther reads 0.
    pub depth_max_m: f64,
    /// Pivot of the gimbal in the body (x forward, y left, z up), metres.
    pub body_from_gimbal_m: [f64; 3],
    /// The camera's optical centre in the gimbal's payload frame (x along the optical axis, y left, z up), metres.
    pub gimbal_from_camera_m: [f64; 3],
    /// How the camera is turned on the payload, roll, pitch and yaw in radians; 0 when it looks along the payload's x.
    pub gimbal_from_camera_rpy_rad: [f64; 3],
    /// Without a gimbal: the camera's pitch on the body, radians, negative looks down.
    pub fixed_pitch_rad: f64,
    /// Delay of the camera's stamps behind the moment of exposure, seconds; subtracted at sources of real cameras.
    pub camera_delay_s: f64,
    /// Exposure time, seconds: with the camera's motion it gives the blur.
    pub exposure_s: f64,
    /// Images of the stream per second at most; 0: none. Rendered only while somebody watches.
    pub stream_hz: f64,
    /// Width of the stream's images, pixels; at most the captured images'.
    pub stream_width_px: u32,
    /// Height of the stream's images, pixels; at most the captured images'.
    pub stream_height_px: u32,
    /// Small depth images per second, from which the planner learns what is in the way; 0: none.
    pub depth_hz: f64,
    /// Width of the small depth images, pixels.
    pub depth_width_px: u32,
    /// Height of the small depth images, pixels.
    pub depth_height_px: u32,
    /// Capture gate: time after arrival within which the stillest image is looked for, seconds.
    pub gate_window_s: f64,
    /// Capture gate: time after arrival at which the stillest image is taken though none met the limits, seconds.
    pub gate_give_up_s: f64,
    /// Capture gate: largest camera speed times uncertainty of the stamp, metres.
    pub gate_position_m: f64,
    /// Capture gate: largest angular rate times uncertainty of the stamp, radians (0.06 degrees).
    pub gate_angle_rad: f64,
    /// Capture gate: largest motion blur at what the camera looks at, pixels.
    pub gate_blur_px: f64,
    /// Capture gate: an image within this share of every limit is taken at once, since waiting gains nothing visible; 0:
    /// always look through the whole window.
    pub gate_at_once: f64,
    /// The stamps are never taken to be better known than this (one standard deviation), seconds.
    pub time_uncertainty_min_s: f64,
}

impl Default for CameraConfig {
    fn default() -> Self {
        Self {
            width_px: 640,
            height_px: 480,
            hfov_rad: 1.204,
            depth_min_m: 0.2,
            depth_max_m: 10.0,
            body_from_gimbal_m: [0.12, 0.0, -0.05],
            gimbal_from_camera_m: [0.02, 0.0, 0.0],
            gimbal_from_camera_rpy_rad: [0.0; 3],
            fixed_pitch_rad: -0.6,
            camera_delay_s: 0.0,
            exposure_s: 0.004,
            stream_hz: 5.0,
            stream_width_px: 320,
            stream_height_px: 240,
            depth_hz: 2.0,
            depth_width_px: 80,
            depth_height_px: 60,
            gate_window_s: 1.0,
            gate_give_up_s: 3.0,
            gate_position_m: 0.002,
            gate_angle_rad: 0.001_047,
            gate_blur_px: 0.3,
            gate_at_once: 0.25,
            time_uncertainty_min_s: 0.001,
        }
    }
}

impl CameraConfig {
    /// The camera of captured images.
    #[must_use]
    pub fn intrinsics(&self) -> Intrinsics {
        Intrinsics::from_hfov(self.width_px, self.height_px, self.hfov_rad)
    }

    /// The camera of the stream: the same field of view, other pixels.
    #[must_use]
    pub fn stream_intrinsics(&self) -> Intrinsics {
        self.resized(self.stream_width_px.min(self.width_px), self.stream_height_px.min(self.height_px))
    }

    /// The camera of the small depth images: the same field of view, other pixels.
    #[must_use]
    pub fn depth_intrinsics(&self) -> Intrinsics {
        self.resized(self.depth_width_px.min(self.width_px), self.depth_height_px.min(self.height_px))
    }

    /// The captured image's camera with another number of pixels, which need not be square then.
    fn resized(&self, width: u32, height: u32) -> Intrinsics {
        let full = self.intrinsics();
        let (x, y) = (f64::from(width) / f64::from(full.width), f64::from(height) / f64::from(full.height));
        Intrinsics { fx: full.fx * x, fy: full.fy * y, cx: full.cx * x, cy: full.cy * y, width, height }
    }

    /// The one way from the vehicle to the camera, used for the measured pose and, by the simulator, for the true one.
    ///
    /// `world_from_body` is the body (FLU) in the world; `world_from_gimbal` the payload's attitude in the world (x along
    /// the optical axis when the camera is not turned on it). The result is `world_from_camera`, optical frame. Both lever
    /// arms count: the pivot turns with the body, the optical centre with the payload.
    #[must_use]
    pub fn world_from_camera(&self, world_from_body: Pose, world_from_gimbal: DQuat) -> Pose {
        let pivot_m = world_from_body.transform_point(DVec3::from_array(self.body_from_gimbal_m));
        let position_m = pivot_m + world_from_gimbal * DVec3::from_array(self.gimbal_from_camera_m);
        let [roll, pitch, yaw] = self.gimbal_from_camera_rpy_rad;
        let mount = DQuat::from_euler(EulerRot::ZYX, yaw, pitch, roll);
        Pose { position_m, rotation: (world_from_gimbal * mount * flu_from_optical()).normalize() }
    }

    /// Attitude that stands for the gimbal's on a vehicle without one: the body's, pitched by `fixed_pitch_rad`.
    #[must_use]
    pub fn world_from_fixed_mount(&self, world_from_body: DQuat) -> DQuat {
        (world_from_body * DQuat::from_rotation_y(-self.fixed_pitch_rad)).normalize()
    }

    /// Attitude of the payload of a levelled gimbal, for planning: yaw from east counter-clockwise, pitch negative down.
    #[must_use]
    pub fn world_from_level_gimbal(yaw_rad: f64, pitch_rad: f64) -> DQuat {
        DQuat::from_rotation_z(yaw_rad) * DQuat::from_rotation_y(-pitch_rad)
    }

    /// Where the body's origin must be, in level flight with a yaw, for the camera to be at `camera_m` while the gimbal is
    /// at a pitch. Metres in the world.
    #[must_use]
    pub fn body_position_for(&self, camera_m: DVec3, yaw_rad: f64, gimbal_pitch_rad: f64) -> DVec3 {
        let level = Pose { position_m: DVec3::ZERO, rotation: DQuat::from_rotation_z(yaw_rad) };
        camera_m - self.world_from_camera(level, Self::world_from_level_gimbal(yaw_rad, gimbal_pitch_rad)).position_m
    }

    /// Lists what is wrong, one sentence a problem: key, value found, what was expected.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = Vec::new();
        for (key, value) in [
            ("width_px", self.width_px),
            ("height_px", self.height_px),
            ("stream_width_px", self.stream_width_px),
            ("stream_height_px", self.stream_height_px),
            ("depth_width_px", self.depth_width_px),
            ("depth_height_px", self.depth_height_px),
        ] {
            if !(16..=4096).contains(&value) {
                problems.push(format!("camera.{key} is {value}; expected 16 to 4096 pixels"));
            }
        }
        for (key, value, low, high, unit) in [
            ("hfov_rad", self.hfov_rad, 0.1, 2.8, "radians"),
            ("depth_min_m", self.depth_min_m, 0.01, 10.0, "metres"),
            ("depth_max_m", self.depth_max_m, 0.1, 100.0, "metres"),
            ("fixed_pitch_rad", self.fixed_pitch_rad, -1.6, 1.6, "radians"),
            ("camera_delay_s", self.camera_delay_s, -0.5, 0.5, "seconds"),
            ("exposure_s", self.exposure_s, 0.0, 0.1, "seconds"),
            ("stream_hz", self.stream_hz, 0.0, 30.0, "per second"),
            ("depth_hz", self.depth_hz, 0.0, 30.0, "per second"),
            ("gate_window_s", self.gate_window_s, 0.0, 10.0, "seconds"),
            ("gate_give_up_s", self.gate_give_up_s, 0.0, 4.0, "seconds"),
            ("gate_position_m", self.gate_position_m, 0.0, 1.0, "metres"),
            ("gate_angle_rad", self.gate_angle_rad, 0.0, 0.1, "radians"),
            ("gate_blur_px", self.gate_blur_px, 0.0, 100.0, "pixels"),
            ("gate_at_once", self.gate_at_once, 0.0, 1.0, "of every limit"),
            ("time_uncertainty_min_s", self.time_uncertainty_min_s, 0.0, 0.1, "seconds"),
        ] {
            if !(low..=high).contains(&value) {
                problems.push(format!("camera.{key} is {value}; expected {low} to {high} {unit}"));
            }
        }
        for (key, values, high) in [
            ("body_from_gimbal_m", self.body_from_gimbal_m, 2.0),
            ("gimbal_from_camera_m", self.gimbal_from_camera_m, 1.0),
            ("gimbal_from_camera_rpy_rad", self.gimbal_from_camera_rpy_rad, 3.2),
        ] {
            if !values.iter().all(|value| (-high..=high).contains(value)) {
                problems.push(format!("camera.{key} is {values:?}; expected three numbers from -{high} to {high}"));
            }
        }
        if self.depth_min_m >= self.depth_max_m {
            problems.push(format!(
                "camera.depth_min_m is {}; expected less than camera.depth_max_m, {}",
                self.depth_min_m, self.depth_max_m
            ));
        }
        if self.gate_window_s > self.gate_give_up_s {
            problems.push(format!(
                "camera.gate_window_s is {}; expected at most camera.gate_give_up_s, {}",
                self.gate_window_s, self.gate_give_up_s
            ));
        }
        problems
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_is_valid_and_problems_name_key_value_and_expectation() {
        assert_eq!(CameraConfig::default().validate(), Vec::<String>::new());
        let bad =
            CameraConfig { width_px: 0, hfov_rad: f64::NAN, depth_min_m: 9.0, depth_max_m: 2.0, ..Default::default() };
        let problems = bad.validate().join("\n");
        for part in ["camera.width_px is 0", "camera.hfov_rad is NaN", "camera.depth_min_m is 9; expected less than"] {
            assert!(problems.contains(part), "{part} in {problems}");
        }
    }

    #[test]
    fn a_level_vehicle_facing_north_sees_north_from_in_front_of_itself() {
        let config = CameraConfig {
            body_from_gimbal_m: [0.12, 0.03, -0.05],
            gimbal_from_camera_m: [0.02, 0.01, 0.005],
            ..Default::default()
        };
        let yaw = core::f64::consts::FRAC_PI_2;
        let body = Pose { position_m: DVec3::new(1.0, 2.0, 3.0), rotation: DQuat::from_rotation_z(yaw) };
        let level = config.world_from_camera(body, CameraConfig::world_from_level_gimbal(yaw, 0.0));
        // Body x is north, body y (left) is west.
        assert!(
            (level.position_m - DVec3::new(1.0 - 0.03 - 0.01, 2.0 + 0.12 + 0.02, 3.0 - 0.05 + 0.005)).length() < 1e-12
        );
        assert!((level.rotation * DVec3::Z - DVec3::Y).length() < 1e-12, "optical axis north");
        assert!((level.rotation * DVec3::X - DVec3::X).length() < 1e-12, "image right is east");
        let down = config.world_from_camera(body, CameraConfig::world_from_level_gimbal(yaw, -yaw));
        assert!((down.rotation * DVec3::Z + DVec3::Z).length() < 1e-12, "optical axis down");
        // The payload's x points down, its z north.
        assert!(
            (down.position_m - DVec3::new(1.0 - 0.03 - 0.01, 2.0 + 0.12 + 0.005, 3.0 - 0.05 - 0.02)).length() < 1e-12
        );
    }

    #[test]
    fn a_fixed_camera_looks_down_by_its_pitch() {
        let config = CameraConfig { fixed_pitch_rad: -0.5, ..Default::default() };
        let axis = config.world_from_fixed_mount(DQuat::IDENTITY) * DVec3::X;
        assert!((axis - DVec3::new(0.5_f64.cos(), 0.0, -(0.5_f64.sin()))).length() < 1e-12);
    }

    #[test]
    fn streams_see_the_captures_field_of_view() {
        let config = CameraConfig::default();
        let point = DVec3::new(0.3, -0.2, 1.5);
        let full = config.intrinsics().project(point).expect("in front");
        for (small, factor) in [(config.stream_intrinsics(), 2.0), (config.depth_intrinsics(), 8.0)] {
            assert!((small.project(point).expect("in front") * factor - full).length() < 1e-9);
        }
    }

    proptest::proptest! {
        #[test]
        fn the_body_is_placed_so_that_the_camera_is_where_it_should_be(yaw in -4.0..4.0f64, pitch in -1.5..0.5f64, x in -5.0..5.0f64) {
            let config = CameraConfig { gimbal_from_camera_rpy_rad: [0.01, -0.02, 0.03], ..Default::default() };
            let wanted = DVec3::new(x, -x, 2.0);
            let body = Pose { position_m: config.body_position_for(wanted, yaw, pitch), rotation: DQuat::from_rotation_z(yaw) };
            let camera = config.world_from_camera(body, CameraConfig::world_from_level_gimbal(yaw, pitch));
            proptest::prop_assert!((camera.position_m - wanted).length() < 1e-12);
        }
    }
}
