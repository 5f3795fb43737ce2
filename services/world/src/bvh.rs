//! The mesh in a bounding volume hierarchy: beams through image tiles, occlusion of segments, nearest points.

use std::time::Duration;

use glam::{Vec3, Vec3A};
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::builder::build_bvh2;
use obvhs::ray::{Ray, RayHit};
use obvhs::triangle::Triangle;
use obvhs::{Boundable, BvhBuildParams};

use crate::mesh::Mesh;

/// Hits closer to a segment's end than this share of its length do not occlude it: the end lies on the surface.
const END_MARGIN: f32 = 1e-4;

/// A pyramid from a point through a tile of an image. Normals point inwards; they need not be unit length.
pub(crate) struct Beam {
    planes: [Plane; 5],
}

struct Plane {
    normal: Vec3A,
    absolute: Vec3A,
    offset: f32,
}

impl Beam {
    /// Four sides and the front, all through `eye`.
    pub(crate) fn new(eye: Vec3, normals: [Vec3; 5]) -> Self {
        Self {
            planes: normals.map(|normal| {
                let normal = Vec3A::from(normal);
                Plane { normal, absolute: normal.abs(), offset: normal.dot(Vec3A::from(eye)) }
            }),
        }
    }

    /// Whether a box may reach into the beam (never false for one that does).
    fn meets(&self, bounds: &Aabb) -> bool {
        let (center, half) = ((bounds.max + bounds.min) * 0.5, (bounds.max - bounds.min) * 0.5);
        // A little slack covers the rounding of the products.
        self.planes.iter().all(|p| p.normal.dot(center) + p.absolute.dot(half) * 1.0001 + 1e-6 >= p.offset)
    }
}

/// The triangles of a mesh in a hierarchy.
pub struct MeshIndex {
    tree: Bvh2,
    triangles: Vec<Triangle>,
}

impl MeshIndex {
    /// Builds the hierarchy. Triangles keep their numbers.
    #[must_use]
    pub fn new(mesh: &Mesh) -> Self {
        let triangles: Vec<Triangle> = (0..mesh.triangles.len())
            .map(|t| {
                let [v0, v1, v2] = mesh.corners(t).map(Vec3A::from);
                Triangle { v0, v1, v2 }
            })
            .collect();
        let tree = build_bvh2(&triangles, BvhBuildParams::medium_build(), &mut Duration::default());
        Self { tree, triangles }
    }

    /// The first hit of the ray from `origin` along `direction` (any length): triangle, and distance in units of
    /// `direction`'s length.
    #[must_use]
    pub fn first_hit(&self, origin: Vec3, direction: Vec3) -> Option<(usize, f32)> {
        let ray = Ray::new(origin.into(), direction.into(), 0.0, f32::INFINITY);
        let mut hit = RayHit::none();
        let found = self.tree.ray_traverse(ray, &mut hit, |ray, id| {
            self.triangles[self.tree.primitive_indices[id] as usize].intersect(ray)
        });
        found.then(|| (self.tree.primitive_indices[hit.primitive_id as usize] as usize, hit.t))
    }

    /// Whether something lies between `eye` and `point` (a point on the surface does not occlude itself).
    #[must_use]
    pub fn occluded(&self, eye: Vec3, point: Vec3) -> bool {
        let ray = Ray::new(eye.into(), (point - eye).into(), 0.0, 1.0 - END_MARGIN);
        !self
            .tree
            .ray_traverse_miss(ray, |ray, id| self.triangles[self.tree.primitive_indices[id] as usize].intersect(ray))
    }

    /// Appends every triangle whose leaf the beam meets to `found`, in the order of the tree.
    pub(crate) fn collect(&self, beam: &Beam, stack: &mut Vec<u32>, found: &mut Vec<u32>) {
        stack.clear();
        if !self.tree.nodes.is_empty() {
            stack.push(0);
        }
        while let Some(index) = stack.pop() {
            let node = &self.tree.nodes[index as usize];
            if !beam.meets(node.aabb()) {
                continue;
            }
            let first = node.first_index;
            if node.is_leaf() {
                found.extend_from_slice(
                    &self.tree.primitive_indices[first as usize..(first + node.prim_count) as usize],
                );
            } else {
                stack.extend([first, first + 1]);
            }
        }
    }

    /// Distance from a point to the surface, metres.
    #[must_use]
    pub fn distance_m(&self, point: Vec3) -> f32 {
        nearest_distance(&self.tree, point, |id| {
            let Triangle { v0, v1, v2 } = self.triangles[id];
            closest_on_triangle(point, [v0.into(), v1.into(), v2.into()]).distance_squared(point)
        })
    }
}

/// A set of points in a hierarchy, for nearest-neighbour distances.
pub struct PointIndex {
    tree: Bvh2,
    points: Vec<Vec3>,
}

struct PointBox(Vec3);

impl Boundable for PointBox {
    fn aabb(&self) -> Aabb {
        Aabb::from_point(self.0.into())
    }
}

impl PointIndex {
    /// Builds the hierarchy; points that are not finite are left out.
    #[must_use]
    pub fn new(points: &[Vec3]) -> Self {
        let points: Vec<Vec3> = points.iter().copied().filter(|p| p.is_finite()).collect();
        let boxes: Vec<PointBox> = points.iter().copied().map(PointBox).collect();
        let tree = if boxes.is_empty() {
            Bvh2::default()
        } else {
            build_bvh2(&boxes, BvhBuildParams::fast_build(), &mut Duration::default())
        };
        Self { tree, points }
    }

    /// Distance from a point to its nearest neighbour, metres; infinite if there are none.
    #[must_use]
    pub fn distance_m(&self, point: Vec3) -> f32 {
        nearest_distance(&self.tree, point, |id| self.points[id].distance_squared(point))
    }
}

fn box_distance_squared(bounds: &Aabb, point: Vec3A) -> f32 {
    (bounds.min - point).max(point - bounds.max).max(Vec3A::ZERO).length_squared()
}

/// Depth first, the nearer child first, pruned by the best found so far.
fn nearest_distance(tree: &Bvh2, point: Vec3, distance_squared: impl Fn(usize) -> f32) -> f32 {
    let at = Vec3A::from(point);
    let mut best = f32::INFINITY;
    let mut stack = Vec::with_capacity(64);
    if let Some(root) = tree.nodes.first() {
        stack.push((box_distance_squared(root.aabb(), at), 0_u32));
    }
    while let Some((bound, index)) = stack.pop() {
        if bound >= best {
            continue;
        }
        let node = &tree.nodes[index as usize];
        let first = node.first_index;
        if node.is_leaf() {
            for id in &tree.primitive_indices[first as usize..(first + node.prim_count) as usize] {
                best = best.min(distance_squared(*id as usize));
            }
        } else {
            let mut children =
                [first, first + 1].map(|child| (box_distance_squared(tree.nodes[child as usize].aabb(), at), child));
            if children[0].0 < children[1].0 {
                children.swap(0, 1);
            }
            stack.extend(children);
        }
    }
    best.sqrt()
}

/// The nearest point of a triangle, by the regions of its corners, edges and face (Ericson, Real-Time Collision Detection).
fn closest_on_triangle(p: Vec3, [a, b, c]: [Vec3; 3]) -> Vec3 {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return a;
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(bp), ac.dot(bp));
    if d3 >= 0.0 && d4 <= d3 {
        return b;
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return a + ab * (d1 / (d1 - d3));
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(cp), ac.dot(cp));
    if d6 >= 0.0 && d5 <= d6 {
        return c;
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return a + ac * (d2 / (d2 - d6));
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)));
    }
    let sum = va + vb + vc;
    a + ab * (vb / sum) + ac * (vc / sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    proptest::proptest! {
        #[test]
        fn the_closest_point_of_a_triangle_beats_every_other(seed in 0_u64..500) {
            let mut random = crate::random::Stream::new(seed);
            let mut point = || Vec3::new(random.next_unit() as f32, random.next_unit() as f32, random.next_unit() as f32) * 2.0 - 1.0;
            let (p, triangle) = (point(), [point(), point(), point()]);
            let best = closest_on_triangle(p, triangle).distance(p);
            for i in 0..=20 {
                for j in 0..=(20 - i) {
                    let (u, v) = (i as f32 / 20.0, j as f32 / 20.0);
                    let other = triangle[0] * (1.0 - u - v) + triangle[1] * u + triangle[2] * v;
                    proptest::prop_assert!(best <= other.distance(p) + 1e-5);
                }
            }
        }

        #[test]
        fn the_nearest_neighbour_is_that_of_a_plain_search(seed in 0_u64..200) {
            let mut random = crate::random::Stream::new(seed);
            let points: Vec<Vec3> = (0..200).map(|_| Vec3::new(random.next_unit() as f32, random.next_unit() as f32, random.next_unit() as f32)).collect();
            let index = PointIndex::new(&points);
            let query = Vec3::new(random.next_unit() as f32, 0.5, -0.3);
            let plain = points.iter().map(|p| p.distance(query)).fold(f32::INFINITY, f32::min);
            proptest::prop_assert!((index.distance_m(query) - plain).abs() < 1e-6);
        }
    }
}
