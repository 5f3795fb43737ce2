//! Depth images as the planner reads them.

use glam::{DVec2, DVec3};
use shared_types::frames::{Intrinsics, Pose};

/// A depth image with its camera.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthView {
    /// Mission time of the image.
    pub stamp_ns: u64,
    /// Pose of the camera at that time.
    pub world_from_camera: Pose,
    /// The pinhole camera; its size is the image's.
    pub intrinsics: Intrinsics,
    /// Centre z in metres, row by row; 0 = no measurement.
    pub depth_m: Vec<f32>,
}

impl DepthView {
    /// Depth at a pixel's index; `None` without a measurement.
    #[must_use]
    pub fn depth_at(&self, index: usize) -> Option<f64> {
        self.depth_m.get(index).map(|&depth| f64::from(depth)).filter(|depth| depth.is_finite() && *depth > 0.0)
    }

    /// Point in the world at the centre of a pixel, at a depth.
    #[must_use]
    pub fn point_at(&self, index: usize, depth_m: f64) -> DVec3 {
        let width = (self.intrinsics.width as usize).max(1);
        #[expect(clippy::cast_precision_loss, reason = "pixels of an image")]
        let pixel = DVec2::new((index % width) as f64 + 0.5, (index / width) as f64 + 0.5);
        self.world_from_camera.transform_point(self.intrinsics.backproject(pixel, depth_m))
    }

    /// Points in the world of about `wanted` evenly spread pixels (0: all), in the order of the pixels.
    #[must_use]
    pub fn points(&self, wanted: usize) -> Vec<DVec3> {
        spread(self.depth_m.len(), wanted)
            .filter_map(|index| self.depth_at(index).map(|depth| self.point_at(index, depth)))
            .collect()
    }
}

/// About `wanted` indices below `count`, evenly spread over an image's rows and columns: multiples of a stride that has
/// no common measure with usual widths.
pub fn spread(count: usize, wanted: usize) -> impl Iterator<Item = usize> {
    let mut stride = count.checked_div(wanted).unwrap_or(1).max(1);
    if stride > 1 {
        while [2, 3, 5].into_iter().any(|prime| stride.is_multiple_of(prime)) {
            stride += 1;
        }
    }
    (0..count).step_by(stride)
}

#[cfg(test)]
mod tests {
    use super::*;
    use shared_types::frames::look_at;

    #[test]
    fn a_pixel_comes_back_to_where_it_was_seen() {
        let intrinsics = Intrinsics::from_hfov(64, 48, 1.2);
        let view = DepthView {
            stamp_ns: 0,
            world_from_camera: look_at(DVec3::new(3.0, -2.0, 2.5), DVec3::ZERO),
            intrinsics,
            depth_m: vec![2.0; 64 * 48],
        };
        let index = 20 * 64 + 33;
        let seen = view.world_from_camera.inverse().transform_point(view.point_at(index, 2.0));
        let pixel = intrinsics.project(seen).unwrap();
        assert!((pixel - DVec2::new(33.5, 20.5)).length() < 1e-9 && (seen.z - 2.0).abs() < 1e-12);
        assert_eq!(view.points(0).len(), 64 * 48);
        let few = view.points(300).len();
        assert!((200..=320).contains(&few), "{few}");
    }
}
