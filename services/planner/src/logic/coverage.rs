//! `paper_coverage` (Section V-A, A33): 5 cm voxels aligned with the prior; occupied where any depth backprojection of a
//! keyframe falls in, covered where those of at least two keyframes do.

use std::collections::BTreeMap;

use super::depth::DepthView;
use super::prior::Prior;

/// Edge of a voxel, metres.
pub const VOXEL_M: f64 = 0.05;

/// The voxels seen so far.
#[derive(Debug, Clone, Default)]
pub struct Coverage {
    views: BTreeMap<[i32; 3], u16>,
    covered: usize,
}

impl Coverage {
    /// Takes a keyframe's depth in, by about `points` evenly spread pixels (0: all).
    pub fn add(&mut self, view: &DepthView, prior: &Prior, points: u32) {
        let corner = prior.center() - prior.size_m / 2.0;
        let mut seen: Vec<[i32; 3]> = view
            .points(points as usize)
            .into_iter()
            .filter(|point| {
                // The ground inside the box is not the object.
                let inside = (*point - corner).cmpge(glam::DVec3::ZERO).all()
                    && (*point - corner).cmplt(glam::DVec3::splat(prior.size_m)).all();
                inside && point.z > prior.ground.z_at(*point) + 0.02
            })
            .map(|point| ((point - corner) / VOXEL_M).floor().as_ivec3().to_array())
            .collect();
        seen.sort_unstable();
        seen.dedup();
        for voxel in seen {
            let count = self.views.entry(voxel).or_insert(0);
            *count = count.saturating_add(1);
            if *count == 2 {
                self.covered += 1;
            }
        }
    }

    /// Covered over occupied voxels, 0..1; 0 before the first keyframe.
    #[must_use]
    pub fn fraction(&self) -> f64 {
        #[expect(clippy::cast_precision_loss, reason = "counts of voxels")]
        let fraction = self.covered as f64 / self.views.len().max(1) as f64;
        fraction
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::logic::prior::Ground;
    use glam::DVec3;
    use shared_types::frames::{Intrinsics, look_at};

    #[test]
    fn a_voxel_is_covered_by_the_second_view_and_not_by_the_same_one_twice_in_an_image() {
        let prior = Prior {
            center_m: [0.0, 0.0, 0.5],
            size_m: 2.0,
            ground: Ground::level(-0.5),
            extents_m: [1.5; 3],
            clamped: false,
        };
        let view = |x: f64| DepthView {
            stamp_ns: 0,
            world_from_camera: look_at(DVec3::new(x, 0.0, 0.5), DVec3::new(0.0, 0.0, 0.5)),
            intrinsics: Intrinsics::from_hfov(32, 24, 0.3),
            depth_m: vec![2.0; 32 * 24],
        };
        let mut coverage = Coverage::default();
        coverage.add(&view(2.5), &prior, 0);
        assert_eq!(coverage.fraction(), 0.0);
        coverage.add(&view(-2.5), &prior, 0);
        assert_eq!(coverage.fraction(), 0.0, "the other side is another set of voxels");
        coverage.add(&view(2.5), &prior, 0);
        assert!((coverage.fraction() - 0.5).abs() < 0.05, "{}", coverage.fraction());
        coverage.add(&view(8.0), &prior, 0);
        assert!((coverage.fraction() - 0.5).abs() < 0.05, "outside the box nothing counts");
    }
}
