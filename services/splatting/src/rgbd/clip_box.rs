//! The clip box: the part of the world that the model may fill.
//!
//! It is the prior's cube, raised to just below the fitted ground (A31): what lies deeper is never seen.

use glam::{DVec3, Vec3};

/// An axis-aligned box in the world, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClipBox {
    /// Least corner.
    pub min: Vec3,
    /// Greatest corner.
    pub max: Vec3,
}

impl ClipBox {
    /// The cube of edge `size_m` about `center_m`, with its floor not deeper than `ground_z_m - ground_margin_m`.
    #[must_use]
    pub fn new(center_m: DVec3, size_m: f64, ground_z_m: f64, ground_margin_m: f64) -> Self {
        let (mut min, max) = (center_m - size_m / 2.0, center_m + size_m / 2.0);
        min.z = min.z.max(ground_z_m - ground_margin_m).min(max.z);
        Self { min: min.as_vec3(), max: max.as_vec3() }
    }

    /// Whether a point lies inside or on the border.
    #[must_use]
    pub fn contains(&self, point: Vec3) -> bool {
        point.cmpge(self.min).all() && point.cmple(self.max).all()
    }

    /// Parameters t at which the ray `origin + t direction` enters and leaves the box, for t >= 0. `None` where it misses.
    #[must_use]
    pub fn ray_interval(&self, origin: Vec3, direction: Vec3) -> Option<(f32, f32)> {
        let mut enter = 0.0f32;
        let mut leave = f32::INFINITY;
        for axis in 0..3 {
            let (o, d) = (origin[axis], direction[axis]);
            if d.abs() < 1e-12 {
                if o < self.min[axis] || o > self.max[axis] {
                    return None;
                }
                continue;
            }
            let (a, b) = ((self.min[axis] - o) / d, (self.max[axis] - o) / d);
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        (enter <= leave).then_some((enter, leave))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_floor_is_raised_to_the_ground_and_never_lowered() {
        let raised = ClipBox::new(DVec3::new(1.0, 2.0, 0.5), 2.0, 0.0, 0.03);
        assert!((raised.min - Vec3::new(0.0, 1.0, -0.03)).length() < 1e-6);
        assert!((raised.max - Vec3::new(2.0, 3.0, 1.5)).length() < 1e-6);
        let floating = ClipBox::new(DVec3::new(0.0, 0.0, 5.0), 2.0, 0.0, 0.03);
        assert_eq!(floating.min.z, 4.0);
    }

    #[test]
    fn a_ray_through_the_box_enters_and_leaves_where_geometry_says() {
        let cube = ClipBox { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
        assert_eq!(cube.ray_interval(Vec3::new(-3.0, 0.0, 0.0), Vec3::X), Some((2.0, 4.0)));
        assert_eq!(cube.ray_interval(Vec3::ZERO, Vec3::Z), Some((0.0, 1.0)), "from inside");
        assert_eq!(cube.ray_interval(Vec3::new(3.0, 0.0, 0.0), Vec3::X), None, "behind");
        assert_eq!(cube.ray_interval(Vec3::new(-3.0, 1.5, 0.0), Vec3::X), None, "beside");
    }

    proptest::proptest! {
        #[test]
        fn points_between_entry_and_exit_are_inside(
            o in proptest::array::uniform3(-4.0f32..4.0), d in proptest::array::uniform3(-1.0f32..1.0), s in 0.01f32..0.99
        ) {
            let cube = ClipBox { min: Vec3::new(-1.0, -0.5, 0.0), max: Vec3::new(1.0, 0.5, 2.0) };
            let (origin, direction) = (Vec3::from(o), Vec3::from(d));
            let grown = ClipBox { min: cube.min - 1e-4, max: cube.max + 1e-4 };
            match cube.ray_interval(origin, direction) {
                Some((enter, leave)) if leave.is_finite() => {
                    proptest::prop_assert!(grown.contains(origin + direction * (enter + s * (leave - enter))));
                }
                Some(_) => {}
                None => for k in 0..64 {
                    let point = origin + direction * (k as f32 * 0.2);
                    let shrunk = ClipBox { min: cube.min + 1e-4, max: cube.max - 1e-4 };
                    proptest::prop_assert!(!shrunk.contains(point));
                },
            }
        }
    }
}
