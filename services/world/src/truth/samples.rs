//! Points spread over the true surface.

use glam::Vec3;

use crate::mesh::{Mesh, area};
use crate::random::Stream;

/// Points on the surface in proportion to area, with the outward normals of their triangles.
#[derive(Debug, Clone, PartialEq)]
pub struct SurfaceSamples {
    /// World coordinates, metres.
    pub points: Vec<Vec3>,
    /// Unit length.
    pub normals: Vec<Vec3>,
}

impl SurfaceSamples {
    /// `count` samples (20,000 in the evaluation protocol). The surface is cut into `count` shares of equal area, one
    /// sample at random in each: less clumping than independent draws.
    #[must_use]
    pub fn new(mesh: &Mesh, count: usize, seed: u64) -> Self {
        let mut random = Stream::new(seed ^ 0x5341_4D50_4C45);
        let total = mesh.area_m2();
        let mut samples = Self { points: Vec::with_capacity(count), normals: Vec::with_capacity(count) };
        let (mut triangle, mut passed) = (0, 0.0);
        let area_of = |t: usize| f64::from(area(mesh.corners(t)));
        for i in 0..count {
            let target = total * (i as f64 + random.next_unit()) / count as f64;
            while triangle + 1 < mesh.triangles.len() && passed + area_of(triangle) < target {
                passed += area_of(triangle);
                triangle += 1;
            }
            let [a, b, c] = mesh.corners(triangle);
            // Uniform on the triangle: fold the far half of the parallelogram back.
            let (mut u, mut v) = (random.next_unit() as f32, random.next_unit() as f32);
            if u + v > 1.0 {
                (u, v) = (1.0 - u, 1.0 - v);
            }
            samples.points.push(a + (b - a) * u + (c - a) * v);
            samples.normals.push((b - a).cross(c - a).normalize_or(Vec3::Z));
        }
        samples
    }

    /// Those for which `wanted` is true.
    #[must_use]
    pub fn only(&self, wanted: &[bool]) -> Self {
        fn chosen(all: &[Vec3], wanted: &[bool]) -> Vec<Vec3> {
            all.iter().zip(wanted).filter(|(_, wanted)| **wanted).map(|(sample, _)| *sample).collect()
        }
        Self { points: chosen(&self.points, wanted), normals: chosen(&self.normals, wanted) }
    }

    /// Number of samples.
    #[must_use]
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }
}
