//! Which samples of the surface a camera sees: inside the image, in range, not too oblique, and nothing in between.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::{SurfaceSamples, spiral_directions};
use crate::bvh::MeshIndex;
use crate::render::Threads;
use shared_types::frames::{Intrinsics, Pose, look_at};

/// When a sample counts as seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewLimits {
    /// The camera.
    pub intrinsics: Intrinsics,
    /// Nearest depth (centre z), metres.
    pub depth_min_m: f32,
    /// Farthest depth, metres.
    pub depth_max_m: f32,
    /// Largest angle between the surface normal and the direction to the camera, degrees.
    pub max_incidence_deg: f32,
}

impl ViewLimits {
    /// The limits of the evaluation protocol for a camera: 0.2 to 19.1 m, incidence below 80 degrees.
    #[must_use]
    pub fn new(intrinsics: Intrinsics) -> Self {
        Self { intrinsics, depth_min_m: 0.2, depth_max_m: 19.1, max_incidence_deg: 80.0 }
    }

    /// Whether the camera sees a point with a normal.
    pub(super) fn sees(&self, index: &MeshIndex, world_from_camera: &Pose, point: Vec3, normal: Vec3) -> bool {
        let eye = world_from_camera.position_m.as_vec3();
        let to_eye = eye - point;
        if normal.dot(to_eye) <= self.max_incidence_deg.to_radians().cos() * to_eye.length() {
            return false;
        }
        let in_camera = world_from_camera.inverse().transform_point(point.as_dvec3());
        let depths = f64::from(self.depth_min_m)..=f64::from(self.depth_max_m);
        let inside = self.intrinsics.project(in_camera).is_some_and(|pixel| {
            let (width, height) = (f64::from(self.intrinsics.width), f64::from(self.intrinsics.height));
            pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < width && pixel.y < height
        });
        inside && depths.contains(&in_camera.z) && eye.z > 0.0 && !index.occluded(eye, point)
    }
}

/// For each sample, whether the camera at `world_from_camera` sees it.
#[must_use]
pub fn visible_samples(
    index: &MeshIndex,
    samples: &SurfaceSamples,
    world_from_camera: &Pose,
    limits: &ViewLimits,
    threads: &Threads,
) -> Vec<bool> {
    threads.install(|| {
        let pairs = samples.points.par_iter().zip(&samples.normals);
        pairs.map(|(point, normal)| limits.sees(index, world_from_camera, *point, *normal)).collect()
    })
}

/// `count` poses spread evenly over the shell of `radius_m` around `center_m`, not below `lowest_altitude_m`, all looking
/// at the centre (700 of them say what is feasible). Empty if the whole shell lies below.
#[must_use]
pub fn shell_poses(center_m: DVec3, radius_m: f64, lowest_altitude_m: f64, count: usize) -> Vec<Pose> {
    let lowest = ((lowest_altitude_m - center_m.z) / radius_m).max(-1.0);
    if lowest >= 1.0 {
        return Vec::new();
    }
    spiral_directions(count, lowest)
        .into_iter()
        .map(|direction| look_at(center_m + direction * radius_m, center_m))
        .collect()
}
