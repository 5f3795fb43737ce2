//! Frames and the pinhole camera.
//!
//! World: right-handed, metres, x east, y north, z up. Body and gimbal payload: x forward, y left, z up (FLU). Camera:
//! x right, y down, z forward (optical). A pose is named by both ends: `world_from_camera` maps camera points to the world.
//! Pixel (0, 0) covers [0, 1) x [0, 1); its centre is (0.5, 0.5).

use glam::{DMat3, DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// A rigid transform `a_from_b`: rotates, then translates.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Origin of b in a, metres.
    pub position_m: DVec3,
    /// Rotation from b to a, unit length.
    pub rotation: DQuat,
}

impl Pose {
    /// No translation, no rotation.
    pub const IDENTITY: Self = Self { position_m: DVec3::ZERO, rotation: DQuat::IDENTITY };

    /// Maps a point of b into a.
    #[must_use]
    pub fn transform_point(&self, point_b: DVec3) -> DVec3 {
        self.rotation * point_b + self.position_m
    }

    /// `b_from_a`.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.conjugate();
        Self { position_m: -(rotation * self.position_m), rotation }
    }

    /// Whether every number is finite and the rotation has unit length within 1e-3.
    #[must_use]
    pub fn is_sane(&self) -> bool {
        self.position_m.is_finite() && self.rotation.is_finite() && (self.rotation.length() - 1.0).abs() < 1e-3
    }

    /// The pose a share `t` (0..1) of the way to another: linear in position, shortest arc in rotation.
    #[must_use]
    pub fn interpolate(&self, other: &Self, t: f64) -> Self {
        Self { position_m: self.position_m.lerp(other.position_m, t), rotation: self.rotation.slerp(other.rotation, t) }
    }
}

impl core::ops::Mul for Pose {
    type Output = Self;

    /// `a_from_b * b_from_c = a_from_c`.
    fn mul(self, b_from_c: Self) -> Self {
        Self {
            position_m: self.transform_point(b_from_c.position_m),
            rotation: (self.rotation * b_from_c.rotation).normalize(),
        }
    }
}

/// Rotation `flu_from_optical`: the optical axis is FLU's x, right is -y, down is -z.
#[must_use]
pub fn flu_from_optical() -> DQuat {
    DQuat::from_mat3(&DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X))
}

/// `world_from_camera` of a camera at `eye_m` that looks at `target_m` with the world's up as the image's up. Straight
/// down or up, where no such image exists, the image's up is north.
#[must_use]
pub fn look_at(eye_m: DVec3, target_m: DVec3) -> Pose {
    let forward = (target_m - eye_m).try_normalize().unwrap_or(DVec3::X);
    let right = forward.cross(DVec3::Z).try_normalize().filter(|_| forward.z.abs() < 1.0 - 1e-9).unwrap_or(DVec3::X);
    let down = forward.cross(right);
    Pose { position_m: eye_m, rotation: DQuat::from_mat3(&DMat3::from_cols(right, down, forward)).normalize() }
}

/// A pinhole camera without distortion. Lengths in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point, x.
    pub cx: f64,
    /// Principal point, y.
    pub cy: f64,
    /// Width of the image.
    pub width: u32,
    /// Height of the image.
    pub height: u32,
}

impl Intrinsics {
    /// Square pixels, principal point at the centre, horizontal field of view in radians.
    #[must_use]
    pub fn from_hfov(width: u32, height: u32, hfov_rad: f64) -> Self {
        let f = f64::from(width) / 2.0 / (hfov_rad / 2.0).tan();
        Self { fx: f, fy: f, cx: f64::from(width) / 2.0, cy: f64::from(height) / 2.0, width, height }
    }

    /// Pixel of a point in the camera frame; `None` behind the camera.
    #[must_use]
    pub fn project(&self, point_camera_m: DVec3) -> Option<DVec2> {
        (point_camera_m.z > 1e-9).then(|| {
            DVec2::new(
                self.fx * point_camera_m.x / point_camera_m.z + self.cx,
                self.fy * point_camera_m.y / point_camera_m.z + self.cy,
            )
        })
    }

    /// Point in the camera frame at a pixel and a depth (centre z), metres.
    #[must_use]
    pub fn backproject(&self, pixel: DVec2, depth_m: f64) -> DVec3 {
        DVec3::new((pixel.x - self.cx) / self.fx * depth_m, (pixel.y - self.cy) / self.fy * depth_m, depth_m)
    }

    /// The camera of the image downsampled by an integer factor (box mean): everything is divided by it, since pixel
    /// (0, 0) begins at 0.
    #[must_use]
    pub fn downsampled(&self, factor: u32) -> Self {
        let k = f64::from(factor.max(1));
        Self {
            fx: self.fx / k,
            fy: self.fy / k,
            cx: self.cx / k,
            cy: self.cy / k,
            width: self.width / factor.max(1),
            height: self.height / factor.max(1),
        }
    }

    /// Centre of pixel (column, row).
    #[must_use]
    pub fn pixel_center(column: u32, row: u32) -> DVec2 {
        DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn looking_north_from_the_south_the_image_is_upright() {
        let world_from_camera = look_at(DVec3::new(0.0, -5.0, 1.0), DVec3::new(0.0, 0.0, 1.0));
        assert!((world_from_camera.rotation * DVec3::Z - DVec3::Y).length() < 1e-12, "optical axis is north");
        assert!((world_from_camera.rotation * DVec3::X - DVec3::X).length() < 1e-12, "image right is east");
        assert!((world_from_camera.rotation * DVec3::Y + DVec3::Z).length() < 1e-12, "image down is down");
    }

    #[test]
    fn straight_down_the_image_has_north_up() {
        let world_from_camera = look_at(DVec3::new(1.0, 2.0, 5.0), DVec3::new(1.0, 2.0, 0.0));
        assert!((world_from_camera.rotation * DVec3::X - DVec3::X).length() < 1e-9);
        assert!((world_from_camera.rotation * DVec3::Y + DVec3::Y).length() < 1e-9);
    }

    #[test]
    fn the_optical_frame_of_a_level_payload_points_forward() {
        assert!((flu_from_optical() * DVec3::Z - DVec3::X).length() < 1e-12);
        assert!((flu_from_optical() * DVec3::X + DVec3::Y).length() < 1e-12);
        assert!((flu_from_optical() * DVec3::Y + DVec3::Z).length() < 1e-12);
    }

    proptest::proptest! {
        #[test]
        fn backprojection_inverts_projection(x in -2.0..2.0f64, y in -2.0..2.0f64, z in 0.3..9.0f64) {
            let camera = Intrinsics::from_hfov(640, 480, 1.204);
            let point = DVec3::new(x, y, z);
            let pixel = camera.project(point).expect("in front");
            proptest::prop_assert!((camera.backproject(pixel, z) - point).length() < 1e-9);
            let half = camera.downsampled(2);
            proptest::prop_assert!((half.project(point).expect("in front") * 2.0 - pixel).length() < 1e-9);
        }

        #[test]
        fn a_pose_times_its_inverse_is_the_identity(x in -9.0..9.0f64, yaw in -4.0..4.0f64, pitch in -1.5..1.5f64) {
            let pose = Pose { position_m: DVec3::new(x, 2.0 * x, -x), rotation: DQuat::from_rotation_z(yaw) * DQuat::from_rotation_y(pitch) };
            let unit = pose * pose.inverse();
            proptest::prop_assert!(unit.position_m.length() < 1e-9 && unit.rotation.angle_between(DQuat::IDENTITY) < 1e-6);
        }
    }
}
