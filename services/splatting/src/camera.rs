//! Pinhole camera: pose, intrinsics, projection and its inverse.
//!
//! Frames: the camera frame is optical (x right, y down, z forward), the world frame is ENU in metres. Pixel (0, 0)
//! covers `[0, 1) x [0, 1)` and its centre is (0.5, 0.5); every coordinate here follows that rule. Half a pixel of
//! error costs about 6 dB, so the rule is stated once and tested.

use glam::{Mat3, Quat, Vec2, Vec3};

use crate::model::SH_DEGREE_MAX;

/// Rigid transform between two frames, named by both ends at the place of use (`world_from_camera`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Rotation, unit quaternion (x, y, z, w).
    pub rotation: Quat,
    /// Translation in metres.
    pub translation: Vec3,
}

impl Pose {
    /// The transform that changes nothing.
    pub const IDENTITY: Self = Self { rotation: Quat::IDENTITY, translation: Vec3::ZERO };

    /// Maps a point from the right frame of the name to the left one.
    pub fn transform_point(&self, point: Vec3) -> Vec3 {
        self.rotation * point + self.translation
    }

    /// The transform the other way.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.conjugate();
        Self { rotation, translation: -(rotation * self.translation) }
    }
}

/// Pinhole camera with its pose. Focal lengths and principal point in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Pose of the optical frame (x right, y down, z forward) in the world.
    pub world_from_camera: Pose,
    /// Focal length along x, pixels.
    pub fx: f32,
    /// Focal length along y, pixels.
    pub fy: f32,
    /// Principal point x, pixels, where the first pixel's centre is 0.5.
    pub cx: f32,
    /// Principal point y, pixels, where the first pixel's centre is 0.5.
    pub cy: f32,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
}

impl Camera {
    /// Camera with square pixels and a centred principal point from its horizontal field of view in radians.
    pub fn from_hfov(world_from_camera: Pose, hfov_rad: f32, width: u32, height: u32) -> Self {
        let focal_px = 0.5 * width as f32 / (0.5 * hfov_rad).tan();
        Self {
            world_from_camera,
            fx: focal_px,
            fy: focal_px,
            cx: 0.5 * width as f32,
            cy: 0.5 * height as f32,
            width,
            height,
        }
    }

    /// The same camera moved to `eye`, looking at `target`, with image "up" toward `up` (need not be perpendicular).
    ///
    /// Looking straight along `up` leaves the roll open; it is then chosen so that the image's right is as near to
    /// world x as possible.
    #[must_use]
    pub fn look_at(self, eye: Vec3, target: Vec3, up: Vec3) -> Self {
        let forward = (target - eye).try_normalize().unwrap_or(Vec3::X);
        let right = forward.cross(up).try_normalize().filter(|r| r.is_finite()).unwrap_or_else(|| {
            let flat = Vec3::X - forward * forward.x;
            flat.try_normalize().unwrap_or(Vec3::Y)
        });
        let down = forward.cross(right);
        let rotation = Quat::from_mat3(&Mat3::from_cols(right, down, forward)).normalize();
        Self { world_from_camera: Pose { rotation, translation: eye }, ..self }
    }

    /// Pixel coordinates and depth (centre z, metres) of a world point; `None` at or behind the camera plane.
    pub fn project(&self, point_world: Vec3) -> Option<(Vec2, f32)> {
        let p = self.world_from_camera.inverse().transform_point(point_world);
        (p.z > 0.0).then(|| (Vec2::new(self.fx * p.x / p.z + self.cx, self.fy * p.y / p.z + self.cy), p.z))
    }

    /// World point seen at pixel coordinates (u, v) (a pixel's centre is `index + 0.5`) at centre-z depth `depth_m`.
    pub fn backproject(&self, u: f32, v: f32, depth_m: f32) -> Vec3 {
        let p = Vec3::new((u - self.cx) / self.fx * depth_m, (v - self.cy) / self.fy * depth_m, depth_m);
        self.world_from_camera.transform_point(p)
    }

    /// The camera of an image box-averaged by `factor`: with centres at 0.5 every intrinsic just divides.
    ///
    /// Rows and columns that do not fill a whole box are dropped. A factor of 0 is taken as 1.
    #[must_use]
    pub fn downsampled(self, factor: u32) -> Self {
        let factor = factor.max(1);
        let s = 1.0 / factor as f32;
        Self {
            fx: self.fx * s,
            fy: self.fy * s,
            cx: self.cx * s,
            cy: self.cy * s,
            width: self.width / factor,
            height: self.height / factor,
            ..self
        }
    }

    /// Number of pixels.
    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Whether pose and intrinsics are finite, focal lengths positive and the image not empty.
    pub fn is_valid(&self) -> bool {
        self.world_from_camera.rotation.is_finite()
            && self.world_from_camera.rotation.length_squared() > 0.5
            && self.world_from_camera.translation.is_finite()
            && [self.fx, self.fy].iter().all(|f| f.is_finite() && *f > 0.0)
            && [self.cx, self.cy].iter().all(|c| c.is_finite())
            && self.pixels() > 0
    }
}

/// How a model is turned into pixels; part of the definition of an image, so it travels with every model and metric.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderSettings {
    /// Variance added to both axes of every projected Gaussian, px² (0.1 at 320x240).
    pub low_pass_px2: f32,
    /// Scales opacity by sqrt(det before / det after) of the low-pass, so that small splats do not brighten.
    pub opacity_compensation: bool,
    /// Colour behind the model.
    pub background: Vec3,
    /// Contributions below this alpha are dropped.
    pub alpha_min: f32,
    /// A 4x4 block of pixels stops when all its transmittances are below this.
    pub transmittance_min: f32,
    /// Gaussians whose mean is nearer than this are not drawn, metres.
    pub near_m: f32,
    /// Highest degree of spherical harmonics that is evaluated, 0 to 3; a model of a lower degree bounds it. 3DGS begins
    /// with 0 and adds a degree every 1,000 iterations.
    pub sh_degree: u8,
}

impl Default for RenderSettings {
    fn default() -> Self {
        Self {
            low_pass_px2: 0.1,
            opacity_compensation: true,
            background: Vec3::splat(0.5),
            alpha_min: 1.0 / 255.0,
            transmittance_min: 1e-4,
            near_m: 0.05,
            sh_degree: SH_DEGREE_MAX,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        Camera::from_hfov(Pose::IDENTITY, 1.204, 320, 240)
    }

    #[test]
    fn look_at_puts_the_target_on_the_principal_point_with_up_up() {
        let camera = camera().look_at(Vec3::new(3.0, -2.0, 1.5), Vec3::new(0.1, 0.2, 0.3), Vec3::Z);
        let (uv, depth) = camera.project(Vec3::new(0.1, 0.2, 0.3)).unwrap();
        assert!((uv - Vec2::new(160.0, 120.0)).length() < 1e-3, "{uv}");
        assert!((depth - (Vec3::new(2.9, -2.2, 1.2)).length()).abs() < 1e-5);
        let (above, _) = camera.project(Vec3::new(0.1, 0.2, 0.5)).unwrap();
        assert!(above.y < uv.y - 5.0, "world up must be image up: {above}");
    }

    #[test]
    fn look_at_straight_down_is_a_rotation() {
        let camera = camera().look_at(Vec3::new(0.0, 0.0, 5.0), Vec3::ZERO, Vec3::Z);
        let rotation = camera.world_from_camera.rotation;
        assert!((rotation.length() - 1.0).abs() < 1e-5);
        assert!((rotation * Vec3::Z + Vec3::Z).length() < 1e-5);
        assert!((rotation * Vec3::X - Vec3::X).length() < 1e-5);
    }

    #[test]
    fn backproject_inverts_project() {
        let camera = camera().look_at(Vec3::new(1.0, 2.0, 3.0), Vec3::ZERO, Vec3::Z);
        let point = camera.backproject(17.5, 203.5, 2.25);
        let (uv, depth) = camera.project(point).unwrap();
        assert!((uv - Vec2::new(17.5, 203.5)).length() < 1e-3 && (depth - 2.25).abs() < 1e-5);
    }

    #[test]
    fn downsampling_keeps_the_ray_of_a_box_centre() {
        let full = camera();
        let half = full.downsampled(2);
        // The centre of half pixel (3, 5) is the corner shared by full pixels (6..8, 10..12).
        let a = full.backproject(7.0, 11.0, 2.0);
        let b = half.backproject(3.5, 5.5, 2.0);
        assert!((a - b).length() < 1e-5);
    }

    #[test]
    fn points_behind_do_not_project() {
        assert!(camera().project(Vec3::new(0.0, 0.0, -1.0)).is_none());
        assert!(camera().project(Vec3::ZERO).is_none());
    }
}
