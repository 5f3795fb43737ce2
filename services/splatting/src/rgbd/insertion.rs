//! Backprojection and insertion (A29): what a new RGB-D image adds to the model.
//!
//! A depth point becomes a Gaussian if and only if its voxel is empty, it is seen at less than 75° from its normal, and
//! no depth jump lies next to it. A rule by rendered opacity ("insert where alpha < 0.5") would never refine what was
//! first seen at a grazing angle; here such a voxel is seeded again once a pixel sees it twice as finely.

use glam::{Quat, Vec3};

use super::clip_box::ClipBox;
use super::downsample::SmallImage;
use super::voxels::VoxelGrid;
use crate::{Camera, Gaussian};

/// Shape of a Gaussian at birth (A29).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BirthShape {
    /// A disc across the normal that the depth image shows.
    Disc,
    /// A sphere, as in the paper.
    Isotropic,
}

/// Which points are inserted, and as what (A29).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InsertionRules {
    /// Shape at birth.
    pub shape: BirthShape,
    /// Standard deviation across the surface, voxel edges (also the sphere's).
    pub sigma_voxels: f32,
    /// Standard deviation along the normal, voxel edges (disc only).
    pub thickness_voxels: f32,
    /// Opacity at birth.
    pub opacity: f32,
    /// Points seen at a greater angle to their normal are not inserted, radians.
    pub max_incidence_rad: f32,
    /// Points next to a depth jump greater than this share of their depth are not inserted.
    pub max_depth_jump: f32,
    /// A voxel seeded from more than this many times the present footprint is seeded again.
    pub reseed_ratio: f32,
}

impl Default for InsertionRules {
    /// The values of live flight.
    fn default() -> Self {
        Self {
            shape: BirthShape::Disc,
            sigma_voxels: 0.6,
            thickness_voxels: 0.15,
            opacity: 0.8,
            max_incidence_rad: 75f32.to_radians(),
            max_depth_jump: 0.05,
            reseed_ratio: 2.0,
        }
    }
}

/// A depth point that may be inserted: position and normal in the world (towards the camera), and the size of its pixel
/// on the surface, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfacePoint {
    /// Index of the pixel, row by row.
    pub pixel: usize,
    /// Position in the world, metres.
    pub position: Vec3,
    /// Unit normal in the world, towards the camera.
    pub normal: Vec3,
    /// Size of the pixel on the surface along its steepest direction, metres.
    pub footprint_m: f32,
}

/// The points of a depth image (metres, 0 = none) inside the clip box that lie on a surface: all of the 3x3 pixels
/// around have depth and differ by at most `max_jump` of the depth, and the surface is seen at less than
/// `max_incidence_rad` from its normal.
#[must_use]
pub fn surface_points(
    camera: &Camera,
    depth_m: &[f32],
    clip: &ClipBox,
    max_jump: f32,
    max_incidence_rad: f32,
) -> Vec<SurfacePoint> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let eye = camera.world_from_camera.translation;
    let focal = (camera.fx * camera.fy).sqrt();
    let min_cosine = max_incidence_rad.cos();
    let mut points = Vec::new();
    if depth_m.len() != width * height {
        return points;
    }
    let backproject = |x: usize, y: usize| camera.backproject(x as f32 + 0.5, y as f32 + 0.5, depth_m[y * width + x]);
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let depth = depth_m[y * width + x];
            let near = |d: f32| d > 0.0 && (d - depth).abs() <= max_jump * depth;
            let smooth =
                (y - 1..=y + 1).all(|row| depth_m[row * width + x - 1..=row * width + x + 1].iter().all(|&d| near(d)));
            if !(depth > 0.0 && depth.is_finite() && smooth) {
                continue;
            }
            let position = backproject(x, y);
            if !clip.contains(position) {
                continue;
            }
            let right = backproject(x + 1, y) - backproject(x - 1, y);
            let down = backproject(x, y + 1) - backproject(x, y - 1);
            // x right, y down, z forward: down x right points back to the camera.
            let Some(normal) = down.cross(right).try_normalize() else { continue };
            let cosine = normal.dot((eye - position).normalize_or_zero());
            if cosine <= min_cosine {
                continue;
            }
            points.push(SurfacePoint { pixel: y * width + x, position, normal, footprint_m: depth / focal / cosine });
        }
    }
    points
}

/// Inserts what an image shows and the grid lacks. Ids count up from `first_id`; `round` is the round of birth.
#[must_use]
pub fn insert(
    rules: &InsertionRules,
    camera: &Camera,
    image: &SmallImage,
    clip: &ClipBox,
    grid: &mut VoxelGrid,
    first_id: u64,
    round: u32,
) -> Vec<Gaussian> {
    let edge = grid.edge_m();
    let across = (rules.sigma_voxels * edge).ln();
    let log_scales = match rules.shape {
        BirthShape::Disc => Vec3::new(across, across, (rules.thickness_voxels * edge).ln()),
        BirthShape::Isotropic => Vec3::splat(across),
    };
    let opacity = rules.opacity;
    let opacity_logit = (opacity / (1.0 - opacity)).ln();
    let points = surface_points(camera, &image.depth_m, clip, rules.max_depth_jump, rules.max_incidence_rad);
    points
        .iter()
        .filter(|point| grid.claim(point.position, point.footprint_m, rules.reseed_ratio))
        .zip(first_id..)
        .map(|(point, id)| Gaussian {
            mean: point.position,
            log_scales,
            rotation: match rules.shape {
                BirthShape::Disc => Quat::from_rotation_arc(Vec3::Z, point.normal),
                BirthShape::Isotropic => Quat::IDENTITY,
            },
            opacity_logit,
            sh: Gaussian::sh_from_color(image.rgb.get(point.pixel).copied().unwrap_or([0.5; 3])),
            id,
            birth_round: round,
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use crate::Pose;

    use super::*;

    /// Looks from `eye` at a plane through the origin with this normal; depth by intersection.
    fn plane_image(eye: Vec3, normal: Vec3) -> (Camera, SmallImage) {
        let camera = Camera::from_hfov(Pose::IDENTITY, 1.204, 64, 48).look_at(eye, Vec3::ZERO, Vec3::Z);
        let depth_m = (0..64 * 48)
            .map(|i| {
                let at_one = camera.backproject((i % 64) as f32 + 0.5, (i / 64) as f32 + 0.5, 1.0);
                let t = -eye.dot(normal) / (at_one - eye).dot(normal);
                if t > 0.0 && t < 20.0 { t } else { 0.0 }
            })
            .collect();
        let rgb = (0..64 * 48).map(|i| [(i % 64) as f32 / 64.0, 0.5, 0.25]).collect();
        (camera, SmallImage { width: 64, height: 48, rgb, depth_m })
    }

    fn everything() -> ClipBox {
        ClipBox { min: Vec3::splat(-50.0), max: Vec3::splat(50.0) }
    }

    #[test]
    fn discs_lie_in_the_plane_that_was_seen_with_the_colour_of_their_pixel() {
        let normal = Vec3::new(0.3, -1.0, 0.2).normalize();
        let (camera, image) = plane_image(Vec3::new(0.4, -2.0, 0.3), normal);
        let rules = InsertionRules::default();
        let mut grid = VoxelGrid::new(0.05);
        let born = insert(&rules, &camera, &image, &everything(), &mut grid, 100, 3);
        assert!(born.len() > 300, "{}", born.len());
        assert_eq!(born.len(), grid.len());
        for (k, gaussian) in born.iter().enumerate() {
            assert!(gaussian.mean.dot(normal).abs() < 1e-4, "on the plane");
            assert!((gaussian.rotation * Vec3::Z).dot(normal) > 0.9999, "thin along the normal");
            let sigma = gaussian.log_scales.exp();
            assert!((sigma - Vec3::new(0.03, 0.03, 0.0075)).length() < 1e-6);
            assert!((gaussian.opacity() - 0.8).abs() < 1e-6);
            assert_eq!((gaussian.id, gaussian.birth_round), (100 + k as u64, 3));
            let (uv, _) = camera.project(gaussian.mean).unwrap();
            assert!((gaussian.color()[0] - uv.x.floor() / 64.0).abs() < 1e-4, "the pixel's own colour");
        }
    }

    #[test]
    fn the_same_view_again_adds_nothing_and_a_late_fine_view_finds_room() {
        let normal = Vec3::NEG_Y;
        let rules = InsertionRules::default();
        let mut grid = VoxelGrid::new(0.05);
        let (far, far_image) = plane_image(Vec3::new(0.0, -4.0, 0.0), normal);
        assert!(!insert(&rules, &far, &far_image, &everything(), &mut grid, 0, 0).is_empty());
        assert!(insert(&rules, &far, &far_image, &everything(), &mut grid, 0, 1).is_empty());
        let (near, near_image) = plane_image(Vec3::new(0.0, -1.5, 0.0), normal);
        let again = insert(&rules, &near, &near_image, &everything(), &mut grid, 0, 2);
        assert!(again.len() > 100, "seeded from 2.7 times the footprint: {}", again.len());
    }

    #[test]
    fn grazing_points_points_at_edges_and_points_outside_are_left_out() {
        let rules = InsertionRules::default();
        // 80 degrees off the normal at the centre.
        let angle = 80f32.to_radians();
        let (camera, image) = plane_image(Vec3::new(0.0, -angle.cos(), angle.sin()) * 2.0, Vec3::NEG_Y);
        let points = surface_points(&camera, &image.depth_m, &everything(), 1.0, 75f32.to_radians());
        assert!(
            points
                .iter()
                .all(|p| p.normal.dot((camera.world_from_camera.translation - p.position).normalize()) > 0.258)
        );
        assert!(points.len() < 64 * 48 / 2);

        let (camera, mut image) = plane_image(Vec3::new(0.0, -2.0, 0.0), Vec3::NEG_Y);
        let all = surface_points(&camera, &image.depth_m, &everything(), 0.05, 1.3).len();
        assert_eq!(all, 62 * 46);
        image.depth_m[20 * 64 + 30] = 2.2;
        assert_eq!(surface_points(&camera, &image.depth_m, &everything(), 0.05, 1.3).len(), all - 9);
        image.depth_m[20 * 64 + 30] = 0.0;
        assert_eq!(surface_points(&camera, &image.depth_m, &everything(), 0.05, 1.3).len(), all - 9);
        let small = ClipBox { min: Vec3::splat(-0.2), max: Vec3::splat(0.2) };
        let mut grid = VoxelGrid::new(0.05);
        let born = insert(&rules, &camera, &image, &small, &mut grid, 0, 0);
        assert!(!born.is_empty() && born.iter().all(|g| small.contains(g.mean)));
    }

    #[test]
    fn paper_spheres_are_spheres() {
        let (camera, image) = plane_image(Vec3::new(0.0, -2.0, 0.0), Vec3::NEG_Y);
        let mut grid = VoxelGrid::new(0.05);
        for gaussian in insert(
            &InsertionRules { shape: BirthShape::Isotropic, ..InsertionRules::default() },
            &camera,
            &image,
            &everything(),
            &mut grid,
            0,
            0,
        ) {
            assert_eq!((gaussian.log_scales.x, gaussian.log_scales.y), (gaussian.log_scales.z, gaussian.log_scales.z));
            assert_eq!(gaussian.rotation, Quat::IDENTITY);
        }
    }
}
