//! The bounding box as a camera sees it: the convex hull of its projection, clipped to the image (I5), and the stretch of
//! each ray inside the box.
//!
//! Unclipped, the hull can exceed the image, and the area fraction of Eq. 3 would exceed 1.

use glam::{DVec2, DVec3};

use crate::camera::Camera;

/// Nearest depth at which a corner is projected, metres: nearer parts of the box are cut off.
const NEAR_M: f64 = 0.05;

/// The bounding box: centre and edge, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoundingBox {
    /// Centre in the world.
    pub center_m: DVec3,
    /// Edge (B in the paper).
    pub size_m: f64,
}

impl BoundingBox {
    /// Depths (centre z of the camera) at which the ray of a pixel enters and leaves the box; `None` where it misses.
    #[must_use]
    pub fn depth_interval(&self, camera: &Camera, pixel: DVec2) -> Option<(f64, f64)> {
        // The point of the ray at depth 1 lies `direction` from the eye, so the ray's parameter is the depth.
        let eye = camera.world_from_camera.translation.as_dvec3();
        let direction = camera.world_from_camera.rotation.as_dquat()
            * DVec3::new(
                (pixel.x - f64::from(camera.cx)) / f64::from(camera.fx),
                (pixel.y - f64::from(camera.cy)) / f64::from(camera.fy),
                1.0,
            );
        let (mut enter, mut leave) = (0.0f64, f64::INFINITY);
        for axis in 0..3 {
            let low = self.center_m[axis] - self.size_m / 2.0 - eye[axis];
            let high = self.center_m[axis] + self.size_m / 2.0 - eye[axis];
            if direction[axis].abs() < 1e-12 {
                if low > 0.0 || high < 0.0 {
                    return None;
                }
            } else {
                let (a, b) = (low / direction[axis], high / direction[axis]);
                enter = enter.max(a.min(b));
                leave = leave.min(a.max(b));
            }
        }
        (enter < leave && leave.is_finite()).then_some((enter, leave))
    }

    /// Depth of the box's centre, metres.
    #[must_use]
    pub fn center_depth(&self, camera: &Camera) -> f64 {
        self.in_camera(camera, self.center_m).z
    }

    /// The box's outline in the image: a convex polygon in pixels, clipped to the image; empty where nothing is seen.
    #[must_use]
    pub fn outline(&self, camera: &Camera) -> Vec<DVec2> {
        let half = self.size_m / 2.0;
        let corners: Vec<DVec3> = (0..8)
            .map(|k| {
                let sign = |bit: usize| if k >> bit & 1 == 0 { -half } else { half };
                self.in_camera(camera, self.center_m + DVec3::new(sign(0), sign(1), sign(2)))
            })
            .collect();
        // The part before the camera is the hull of its corners and of where edges cross the near plane.
        let mut points: Vec<DVec3> = corners.iter().copied().filter(|c| c.z >= NEAR_M).collect();
        for (i, &a) in corners.iter().enumerate() {
            for bit in 0..3 {
                let b = corners[i ^ (1 << bit)];
                if a.z < NEAR_M && b.z > NEAR_M {
                    points.push(a + (b - a) * ((NEAR_M - a.z) / (b.z - a.z)));
                }
            }
        }
        let projected: Vec<DVec2> = points
            .iter()
            .map(|p| {
                DVec2::new(
                    f64::from(camera.fx) * p.x / p.z + f64::from(camera.cx),
                    f64::from(camera.fy) * p.y / p.z + f64::from(camera.cy),
                )
            })
            .collect();
        clip_to_image(&convex_hull(projected), f64::from(camera.width), f64::from(camera.height))
    }

    fn in_camera(&self, camera: &Camera, point: DVec3) -> DVec3 {
        let pose = &camera.world_from_camera;
        pose.rotation.as_dquat().conjugate() * (point - pose.translation.as_dvec3())
    }
}

/// Area of a polygon, px^2.
#[must_use]
pub fn area(polygon: &[DVec2]) -> f64 {
    let twice: f64 = polygon.iter().zip(polygon.iter().cycle().skip(1)).map(|(a, b)| a.perp_dot(*b)).sum();
    (twice / 2.0).abs()
}

/// The columns, by row, whose pixel centres lie inside a convex polygon: `(row, first column, end column)`.
#[must_use]
pub fn covered_pixels(polygon: &[DVec2], width: u32, height: u32) -> Vec<(u32, u32, u32)> {
    let mut rows = Vec::new();
    for row in 0..height {
        let y = f64::from(row) + 0.5;
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for (a, b) in polygon.iter().zip(polygon.iter().cycle().skip(1)) {
            if (a.y <= y) != (b.y <= y) {
                let x = a.x + (b.x - a.x) * (y - a.y) / (b.y - a.y);
                low = low.min(x);
                high = high.max(x);
            }
        }
        if low < high {
            // Centres x + 0.5 in [low, high].
            let first = (low - 0.5).ceil().clamp(0.0, f64::from(width)) as u32;
            let end = ((high - 0.5).floor() + 1.0).clamp(0.0, f64::from(width)) as u32;
            if first < end {
                rows.push((row, first, end));
            }
        }
    }
    rows
}

/// Convex hull, counter-clockwise (Andrew's monotone chain).
fn convex_hull(mut points: Vec<DVec2>) -> Vec<DVec2> {
    points.retain(|p| p.is_finite());
    points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    points.dedup();
    if points.len() < 3 {
        return Vec::new();
    }
    let chain = |points: &mut dyn Iterator<Item = DVec2>| {
        let mut half: Vec<DVec2> = Vec::new();
        for p in points {
            while let [.., a, b] = half[..]
                && (b - a).perp_dot(p - a) <= 0.0
            {
                half.pop();
            }
            half.push(p);
        }
        half.pop();
        half
    };
    let mut hull = chain(&mut points.iter().copied());
    hull.extend(chain(&mut points.iter().rev().copied()));
    hull
}

/// Sutherland-Hodgman against the four borders of the image.
fn clip_to_image(polygon: &[DVec2], width: f64, height: f64) -> Vec<DVec2> {
    // Inside: normal . p <= limit.
    let borders = [(DVec2::NEG_X, 0.0), (DVec2::X, width), (DVec2::NEG_Y, 0.0), (DVec2::Y, height)];
    borders.iter().fold(polygon.to_vec(), |polygon, &(normal, limit)| {
        let mut clipped = Vec::with_capacity(polygon.len() + 1);
        for (&a, &b) in polygon.iter().zip(polygon.iter().cycle().skip(1)) {
            let (da, db) = (normal.dot(a) - limit, normal.dot(b) - limit);
            if da <= 0.0 {
                clipped.push(a);
            }
            if (da < 0.0 && db > 0.0) || (da > 0.0 && db < 0.0) {
                clipped.push(a + (b - a) * (da / (da - db)));
            }
        }
        clipped
    })
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::camera::Pose;

    fn camera(eye: Vec3) -> Camera {
        Camera::from_hfov(Pose::IDENTITY, 1.204, 320, 240).look_at(eye, Vec3::ZERO, Vec3::Z)
    }

    fn cube(size_m: f64) -> BoundingBox {
        BoundingBox { center_m: DVec3::ZERO, size_m }
    }

    #[test]
    fn a_cube_seen_face_on_is_its_near_face() {
        // The face at distance 2 - 0.5; the far face projects inside it.
        let camera = camera(Vec3::new(0.0, -2.0, 0.0));
        let outline = cube(1.0).outline(&camera);
        let edge = f64::from(camera.fx) / 1.5;
        assert!((area(&outline) - edge * edge).abs() < 1e-2 * edge, "{}", area(&outline));
        let count: u32 = covered_pixels(&outline, 320, 240).iter().map(|(_, first, end)| end - first).sum();
        assert!((f64::from(count) / area(&outline) - 1.0).abs() < 0.02);
        assert!((cube(1.0).center_depth(&camera) - 2.0).abs() < 1e-6);
    }

    #[test]
    fn a_box_larger_than_the_image_fills_it_and_no_more() {
        assert!((area(&cube(2.0).outline(&camera(Vec3::new(0.0, -1.2, 0.0)))) - 320.0 * 240.0).abs() < 1e-6);
        let inside = area(&cube(2.0).outline(&camera(Vec3::new(0.0, -0.5, 0.1))));
        assert!((inside - 320.0 * 240.0).abs() < 1e-3, "from within: {inside}");
        let behind =
            camera(Vec3::new(0.0, -2.0, 0.0)).look_at(Vec3::new(0.0, -2.0, 0.0), Vec3::new(0.0, -4.0, 0.0), Vec3::Z);
        assert!(cube(1.0).outline(&behind).is_empty());
    }

    #[test]
    fn the_chord_of_the_central_ray_is_the_edge() {
        let camera = camera(Vec3::new(0.0, -2.0, 0.0));
        let (enter, leave) = cube(1.0).depth_interval(&camera, DVec2::new(160.0, 120.0)).unwrap();
        assert!((enter - 1.5).abs() < 1e-6 && (leave - 2.5).abs() < 1e-6);
        assert_eq!(cube(1.0).depth_interval(&camera, DVec2::new(0.5, 0.5)), None);
    }

    proptest::proptest! {
        #[test]
        fn pixels_in_the_outline_are_the_pixels_whose_rays_hit(
            azimuth in -3.0f32..3.0, elevation in -1.4f32..1.4, distance in 1.9f32..3.5
        ) {
            let eye = distance * Vec3::new(
                azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin());
            let camera = camera(eye);
            let cube = cube(2.0);
            let mut inside = vec![false; 320 * 240];
            for (row, first, end) in covered_pixels(&cube.outline(&camera), 320, 240) {
                for column in first..end {
                    inside[(row * 320 + column) as usize] = true;
                }
            }
            let differing = (0..320 * 240u32)
                .filter(|i| {
                    let pixel = DVec2::new(f64::from(i % 320) + 0.5, f64::from(i / 320) + 0.5);
                    cube.depth_interval(&camera, pixel).is_some() != inside[*i as usize]
                })
                .count();
            proptest::prop_assert!(differing <= 4, "{differing} pixels differ");
        }
    }
}
