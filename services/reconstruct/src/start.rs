//! The model that training begins with: from depth as in live flight, else from sparse points, else at random.

use glam::{DMat3, DVec3, Vec2, Vec3};
use shared_types::config::trainer::BirthShape;
use splatting::rgbd::clip_box::ClipBox;
use splatting::rgbd::insertion::{self, InsertionRules};
use splatting::rgbd::prune;
use splatting::rgbd::voxels::{VoxelGrid, voxel_edge_m};
use splatting::{Camera, ColoredPoint, Gaussians, InitialGaussians, random_points};

use crate::dataset::{Dataset, Image, Stage};

/// Random points where nothing better is known, as many as 3DGS takes.
const RANDOM_POINTS: usize = 100_000;
/// Sparse points below which a model begins with random ones: distances between neighbours need as many.
const LEAST_POINTS: usize = 4;
/// Most Gaussians that depth images give where no mission says how finely: densification adds where more are needed.
const DEPTH_POINTS: usize = 200_000;
/// Edge of an insertion voxel over the footprint of a pixel, where no mission says otherwise.
const VOXEL_FACTOR: f64 = 1.2;

/// Where a model comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// Depth images.
    Depth,
    /// Sparse points.
    Points,
    /// Nothing.
    Random,
}

impl Origin {
    /// Its name in messages.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Depth => "depth images",
            Self::Points => "sparse points",
            Self::Random => "random points",
        }
    }
}

/// A model to begin with.
#[derive(Debug)]
pub struct Start {
    /// The Gaussians.
    pub model: Gaussians,
    /// Where they come from.
    pub origin: Origin,
}

/// Edge of the voxels that Gaussians are inserted by; `None` without depth.
#[must_use]
pub fn voxel_m(dataset: &Dataset, training: &[usize]) -> Option<f32> {
    let with_depth = || training.iter().filter_map(|&index| dataset.images.get(index)).filter(|i| i.depth_m.is_some());
    let focal = f64::from(with_depth().next()?.camera.fx);
    let edge = match &dataset.stage {
        Some(stage) if stage.trainer.voxel_m > 0.0 => stage.trainer.voxel_m,
        Some(stage) => voxel_edge_m(stage.trainer.voxel_factor, stage.radius_m, stage.box_size_m, focal),
        None => {
            let mut depths: Vec<f32> = with_depth()
                .flat_map(|image| image.depth_m.iter().flatten().step_by(97).copied().filter(|d| *d > 0.0))
                .collect();
            depths.sort_unstable_by(f32::total_cmp);
            VOXEL_FACTOR * f64::from(*depths.get(depths.len() / 2)?) / focal
        }
    };
    Some(edge as f32)
}

/// Where the model that training on these images begins with comes from: what [`start`] says, without making it.
#[must_use]
pub fn origin(dataset: &Dataset, training: &[usize]) -> Origin {
    if voxel_m(dataset, training).is_some() {
        Origin::Depth
    } else if places(&dataset.points, LEAST_POINTS) {
        Origin::Points
    } else {
        Origin::Random
    }
}

/// The model that training on these images begins with, of degree `sh_degree`.
#[must_use]
pub fn start(
    dataset: &Dataset,
    training: &[usize],
    how: InitialGaussians,
    (max_gaussians, sh_degree, seed): (usize, u8, u64),
) -> Start {
    let images: Vec<&Image> = training.iter().filter_map(|&index| dataset.images.get(index)).collect();
    let most = max_gaussians.min(DEPTH_POINTS);
    let inserted = voxel_m(dataset, training).map(|edge| match &dataset.stage {
        Some(stage) => from_depth(&images, Some(stage), edge),
        None => from_depth_at_most(&images, edge, most),
    });
    let (mut model, origin) = match inserted {
        Some(model) if !model.is_empty() => (model, Origin::Depth),
        _ => from_points(dataset, &images, how, max_gaussians, seed),
    };
    let kept = prune::keep_most_contributing(&model, max_gaussians);
    model.retain(|index| kept[index]);
    model.set_sh_degree(sh_degree);
    let order = model.morton_order();
    model.permute(&order);
    Start { model, origin }
}

/// Standard deviations within which a Gaussian is seen.
const SEEN_SIGMAS: f32 = 3.0;

/// Whether any Gaussian of a model reaches into any image, before the camera and not nearer than `near_m`.
#[must_use]
pub fn is_seen(model: &Gaussians, images: &[&Image], near_m: f32) -> bool {
    let within = |camera: &Camera, gaussian: &splatting::Gaussian| {
        let Some((pixel, depth_m)) = camera.project(gaussian.mean).filter(|(_, depth_m)| *depth_m >= near_m) else {
            return false;
        };
        let reach = SEEN_SIGMAS * gaussian.log_scales.max_element().exp() * camera.fx.max(camera.fy) / depth_m;
        let nearest = pixel.clamp(Vec2::ZERO, Vec2::new(camera.width as f32, camera.height as f32));
        pixel.distance(nearest) <= reach
    };
    images.iter().any(|image| model.iter().any(|gaussian| within(&image.camera, &gaussian)))
}

/// As [`from_depth`] without a stage, with voxels so large that at most `most` Gaussians come of it: leaving some of them out
/// would leave holes.
fn from_depth_at_most(images: &[&Image], edge_m: f32, most: usize) -> Gaussians {
    let mut edge_m = edge_m;
    loop {
        let model = from_depth(images, None, edge_m);
        if model.len() <= most {
            return model;
        }
        // Surfaces: the number falls with the square of the edge. At least a tenth more, so that this ends.
        edge_m *= ((model.len() as f32 / most as f32).sqrt()).max(1.1);
    }
}

fn from_depth(images: &[&Image], stage: Option<&Stage>, edge_m: f32) -> Gaussians {
    let everywhere = ClipBox { min: Vec3::splat(f32::MIN), max: Vec3::splat(f32::MAX) };
    let clip = stage.map_or(everywhere, |stage| stage.clip);
    let rules = stage.map_or_else(InsertionRules::default, insertion_rules);
    let mut grid = VoxelGrid::new(edge_m);
    let mut model = Gaussians::new();
    for image in images {
        if let Some(small) = image.with_depth() {
            let first_id = model.len() as u64;
            model.extend(insertion::insert(&rules, &image.camera, &small, &clip, &mut grid, first_id, 0));
        }
    }
    model
}

fn insertion_rules(stage: &Stage) -> InsertionRules {
    let trainer = &stage.trainer;
    InsertionRules {
        shape: match trainer.birth_shape {
            BirthShape::Disc => insertion::BirthShape::Disc,
            BirthShape::Isotropic => insertion::BirthShape::Isotropic,
        },
        sigma_voxels: trainer.birth_sigma_voxels as f32,
        thickness_voxels: trainer.birth_thickness_voxels as f32,
        opacity: trainer.birth_opacity as f32,
        max_incidence_rad: (trainer.max_incidence_deg as f32).to_radians(),
        max_depth_jump: trainer.max_depth_jump as f32,
        reseed_ratio: trainer.reseed_ratio as f32,
    }
}

/// Whether points lie at so many different places.
fn places(points: &[crate::dataset::Point], count: usize) -> bool {
    let mut found: Vec<DVec3> = Vec::with_capacity(count);
    for point in points {
        if !found.contains(&point.position) {
            found.push(point.position);
        }
        if found.len() >= count {
            return true;
        }
    }
    false
}

fn from_points(
    dataset: &Dataset,
    images: &[&Image],
    how: InitialGaussians,
    max_gaussians: usize,
    seed: u64,
) -> (Gaussians, Origin) {
    let colored = |point: &crate::dataset::Point| ColoredPoint {
        position: point.position.as_vec3(),
        color: point.rgb.map(|value| f32::from(value) / 255.0),
    };
    // A share of them where they are too many, evenly over their list.
    let stride = dataset.points.len().div_ceil(max_gaussians).max(1);
    let points: Vec<ColoredPoint> =
        dataset.points.iter().step_by(stride).map(colored).filter(|point| point.position.is_finite()).collect();
    if places(&dataset.points, LEAST_POINTS)
        && points.len() >= LEAST_POINTS
        && let Ok(model) = how.from_points(&points)
    {
        return (model, Origin::Points);
    }
    let cameras: Vec<&Camera> = images.iter().map(|image| &image.camera).collect();
    let (center, half) = focus(&cameras);
    let count = RANDOM_POINTS.min(max_gaussians);
    let model = random_points(count, center - half, center + half, seed)
        .and_then(|points| how.from_points(&points))
        .unwrap_or_default();
    (model, Origin::Random)
}

/// Centre of what the cameras look at, and half the edge of a cube about it: the point nearest to all optical axes, and half
/// the cameras' mean distance from it.
fn focus(cameras: &[&Camera]) -> (Vec3, Vec3) {
    let (mut a, mut b) = (DMat3::ZERO, DVec3::ZERO);
    for camera in cameras {
        let axis = (camera.world_from_camera.rotation * Vec3::Z).as_dvec3();
        let across = DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
        a += across;
        b += across * camera.world_from_camera.translation.as_dvec3();
    }
    let count = cameras.len().max(1) as f64;
    let eyes: Vec<DVec3> = cameras.iter().map(|camera| camera.world_from_camera.translation.as_dvec3()).collect();
    let mean_eye = eyes.iter().sum::<DVec3>() / count;
    // Nearly parallel axes meet nowhere in particular.
    let center = if a.determinant() > 1e-6 * count.powi(3) { a.inverse() * b } else { mean_eye };
    let distance = eyes.iter().map(|eye| eye.distance(center)).sum::<f64>() / count;
    let half = (0.5 * distance).clamp(1e-3, 1e6) as f32;
    (center.as_vec3(), Vec3::splat(half))
}

#[cfg(test)]
mod tests {
    use splatting::Pose;

    use super::*;

    #[test]
    fn a_gaussian_is_seen_where_it_reaches_into_an_image() {
        let image = Image {
            name: "a".to_owned(),
            camera: Camera::from_hfov(Pose::IDENTITY, 1.0, 64, 48),
            colors: crate::dataset::Colors::Bytes(vec![[9; 3]; 64 * 48]),
            depth_m: None,
            classes: None,
            held_out: None,
        };
        let seen = |mean: Vec3, sigma: f32| {
            let gaussian = splatting::Gaussian {
                mean,
                log_scales: Vec3::splat(sigma.ln()),
                rotation: glam::Quat::IDENTITY,
                opacity_logit: 0.0,
                sh: [0.0; 3],
                id: 0,
                birth_round: 0,
            };
            is_seen(&[gaussian].into_iter().collect(), &[&image], 0.05)
        };
        assert!(seen(Vec3::Z, 0.01));
        assert!(!seen(-Vec3::Z, 0.01), "behind");
        assert!(!seen(0.01 * Vec3::Z, 0.001), "too near");
        assert!(!seen(Vec3::new(3.0, 0.0, 1.0), 0.01), "beside");
        assert!(seen(Vec3::new(3.0, 0.0, 1.0), 1.0), "beside, and large enough");
        assert!(!is_seen(&Gaussians::new(), &[&image], 0.05));
    }

    #[test]
    fn points_at_one_place_are_no_shape_to_begin_with() {
        let at = |x: f64| crate::dataset::Point { position: DVec3::X * x, rgb: [1, 2, 3] };
        assert!(!places(&vec![at(1.0); 1000], LEAST_POINTS) && !places(&[at(0.0), at(1.0), at(2.0)], LEAST_POINTS));
        assert!(places(&[at(0.0), at(0.0), at(1.0), at(2.0), at(3.0)], LEAST_POINTS));
    }

    #[test]
    fn larger_voxels_and_not_holes_make_room() {
        let camera = Camera::from_hfov(Pose::IDENTITY, 1.0, 64, 48);
        let image = Image {
            name: "a".to_owned(),
            camera,
            colors: crate::dataset::Colors::Bytes(vec![[9; 3]; 64 * 48]),
            depth_m: Some(vec![2.0; 64 * 48]),
            classes: None,
            held_out: None,
        };
        let all = from_depth_at_most(&[&image], 0.01, 10_000);
        assert_eq!(all.len(), 62 * 46);
        let few = from_depth_at_most(&[&image], 0.01, 500);
        assert!((200..=500).contains(&few.len()), "{}", few.len());
        let reach = |model: &Gaussians| model.iter().map(|g| g.mean.x).fold(f32::MIN, f32::max);
        assert!(reach(&all) - reach(&few) < 0.15, "to the border of the image");
    }

    #[test]
    fn cameras_on_a_ring_look_at_its_centre() {
        let target = Vec3::new(1.0, -2.0, 0.5);
        let cameras: Vec<Camera> = (0..6)
            .map(|k| {
                let angle = k as f32;
                let eye = target + 3.0 * Vec3::new(angle.cos(), angle.sin(), 0.3);
                Camera::from_hfov(Pose::IDENTITY, 1.0, 32, 24).look_at(eye, target, Vec3::Z)
            })
            .collect();
        let (center, half) = focus(&cameras.iter().collect::<Vec<_>>());
        assert!((center - target).length() < 1e-3, "{center}");
        assert!((half.x - 1.5 * 1.044).abs() < 0.01, "{half}");
        // Parallel axes: a box about the cameras, and no panic.
        let parallel = [cameras[0], cameras[0]];
        let (center, half) = focus(&parallel.iter().collect::<Vec<_>>());
        assert!(center.is_finite() && half.is_finite() && half.x > 0.0);
    }
}
