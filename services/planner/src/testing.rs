//! A world for tests: boxes on level ground, seen by an ideal depth camera.

use glam::{DVec2, DVec3};
use shared_types::frames::{Intrinsics, Pose};

use crate::logic::depth::DepthView;

/// Boxes (lowest and highest corner) on the ground z = 0.
#[derive(Debug, Clone, Default)]
pub struct Scene {
    pub boxes: Vec<(DVec3, DVec3)>,
}

impl Scene {
    /// One box of these edges on the ground.
    pub fn single(x: f64, y: f64, edges: DVec3) -> Self {
        let low = DVec3::new(x, y, 0.0) - edges.with_z(0.0) / 2.0;
        Self { boxes: vec![(low, low + edges)] }
    }

    fn hit(&self, from: DVec3, direction: DVec3) -> f64 {
        let mut nearest = if direction.z < -1e-9 { -from.z / direction.z } else { f64::INFINITY };
        for (low, high) in &self.boxes {
            let a = (*low - from) / direction;
            let b = (*high - from) / direction;
            let (enter, leave) = (a.min(b).max_element(), a.max(b).min_element());
            if enter > 0.0 && enter < leave {
                nearest = nearest.min(enter);
            }
        }
        nearest
    }

    /// The depth image of a camera; depths beyond 10 m are no measurement.
    pub fn render(&self, stamp_ns: u64, world_from_camera: Pose, intrinsics: Intrinsics) -> DepthView {
        let mut depth_m = Vec::new();
        for row in 0..intrinsics.height {
            for column in 0..intrinsics.width {
                let pixel = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5);
                // Of depth 1: the ray's parameter is the depth.
                let ray = world_from_camera.rotation * intrinsics.backproject(pixel, 1.0);
                let depth = self.hit(world_from_camera.position_m, ray);
                depth_m.push(if depth < 10.0 { depth as f32 } else { 0.0 });
            }
        }
        DepthView { stamp_ns, world_from_camera, intrinsics, depth_m }
    }
}
