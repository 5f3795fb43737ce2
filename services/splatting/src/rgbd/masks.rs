//! Which pixels say what (A31): told from the depth image alone.
//!
//! The prior's box projects to nearly the whole image, so it is no mask; the measured depth is. Without the classes,
//! ground and sky behind the object would be painted onto floaters inside the box. *Foreground*: the measured point lies in
//! the clip box, colour and depth count. *Free*: the measurement lies beyond the box's exit, or the ray misses the box; the
//! model must be empty there. *Ignored*: no depth, or something before the box.

use super::clip_box::ClipBox;
use crate::{Camera, PixelClass};

/// The class of every pixel of a depth image (metres, 0 = no measurement) taken by `camera`.
#[must_use]
pub fn classify(camera: &Camera, depth_m: &[f32], clip: &ClipBox) -> Vec<PixelClass> {
    let eye = camera.world_from_camera.translation;
    let width = camera.width as usize;
    depth_m
        .iter()
        .enumerate()
        .map(|(index, &depth)| {
            if !(depth.is_finite() && depth > 0.0) {
                return PixelClass::Ignored;
            }
            let (u, v) = ((index % width) as f32 + 0.5, (index / width) as f32 + 0.5);
            let point = camera.backproject(u, v, depth);
            if clip.contains(point) {
                return PixelClass::Foreground;
            }
            // The measured point is at t = 1.
            match clip.ray_interval(eye, point - eye) {
                Some((_, leave)) if leave > 1.0 => PixelClass::Ignored,
                _ => PixelClass::Free,
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use crate::Pose;
    use glam::Vec3;

    use super::*;

    fn camera() -> Camera {
        // At (0, -3, 0), looking north at a cube of edge 2 about the origin.
        Camera::from_hfov(Pose::IDENTITY, 1.204, 32, 24).look_at(Vec3::new(0.0, -3.0, 0.0), Vec3::ZERO, Vec3::Z)
    }

    #[test]
    fn each_depth_on_the_optical_axis_gets_its_class() {
        let clip = ClipBox { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
        let camera = camera();
        let center = 12 * 32 + 16;
        let class = |depth: f32| classify(&camera, &vec![depth; 32 * 24], &clip)[center];
        assert_eq!(class(0.0), PixelClass::Ignored, "no measurement");
        assert_eq!(class(f32::NAN), PixelClass::Ignored);
        assert_eq!(class(1.5), PixelClass::Ignored, "something before the box");
        assert_eq!(class(2.1), PixelClass::Foreground);
        assert_eq!(class(3.9), PixelClass::Foreground);
        assert_eq!(class(4.2), PixelClass::Free, "the box is empty along this ray");
    }

    #[test]
    fn rays_that_miss_the_box_are_free_where_something_was_measured() {
        let clip = ClipBox { min: Vec3::splat(-0.5), max: Vec3::splat(0.5) };
        let classes = classify(&camera(), &vec![3.0; 32 * 24], &clip);
        assert_eq!(classes[0], PixelClass::Free, "the corner's ray passes beside the box");
        assert_eq!(classes[12 * 32 + 16], PixelClass::Foreground);
        assert_eq!(classify(&camera(), &vec![0.0; 32 * 24], &clip)[0], PixelClass::Ignored, "sky without depth");
    }
}
