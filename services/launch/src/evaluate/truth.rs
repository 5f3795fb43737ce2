//! The world that was flown in, rebuilt for judging: the same scene, held-out views, and coverage of the true surface.

use glam::{DVec3, Vec3};
use shared_types::config::Config;
use shared_types::config::planner::PlannerConfig;
use shared_types::frames::{Intrinsics, Pose};
use splatting::Gaussians;
use world::render::{RenderOptions, RgbdImage, Threads, render};
use world::truth::{
    Coverage, CoverageMeter, Geometry, HeldOutRules, HeldOutView, SurfaceSamples, ViewLimits, compare, held_out_views,
};
use world::{Scene, SceneConfig};

use crate::exit::Refusal;

/// Samples of the true surface (the evaluation protocol's number).
const SURFACE_SAMPLES: usize = 20_000;
/// Threshold of the F-score as a share of the object's diameter.
const F_SCORE_SHARE: f64 = 0.01;
/// Seed of the samples: the same for every mission over an object.
const SAMPLE_SEED: u64 = 1;
/// Below this the vehicle stands, starts or lands, metres.
const AIRBORNE_M: f64 = 0.3;
/// From the vehicle's centre to its rotors' tips, metres (X500).
const ROTOR_REACH_M: f64 = 0.37;

/// The ground truth of a mission.
pub struct Truth {
    scene: Scene,
    hfov_rad: f64,
    capture: Intrinsics,
    samples_per_edge: u32,
    depth_max_m: f32,
    center_m: DVec3,
    radius_m: f64,
    lowest_m: f64,
    bounds_m: (DVec3, DVec3),
}

impl core::fmt::Debug for Truth {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Truth")
            .field("center_m", &self.center_m)
            .field("radius_m", &self.radius_m)
            .finish_non_exhaustive()
    }
}

impl Truth {
    /// Builds the scene of a configuration. Box and radius are the true object's, by the rules of the default preset,
    /// whatever the mission found or was told: so they are the same for every method.
    ///
    /// # Errors
    /// When the object cannot be read.
    pub fn build(config: &Config) -> anyhow::Result<Self> {
        let scene = Scene::new(&SceneConfig::of(config), &Threads::new(cores()))
            .map_err(|error| Refusal::missing(format!("object {}: {error}", config.world.object)))?;
        let (low, high) = scene.mesh().bounds();
        let bounds_m = (low.as_dvec3(), high.as_dvec3());
        let rules = PlannerConfig::default();
        let edge_m =
            ((bounds_m.1 - bounds_m.0).max_element() + rules.box_margin_m).clamp(rules.box_min_m, rules.box_max_m);
        Ok(Self {
            hfov_rad: config.camera.hfov_rad,
            capture: config.camera.intrinsics(),
            samples_per_edge: config.world.samples_per_edge,
            #[expect(clippy::cast_possible_truncation, reason = "a range in metres")]
            depth_max_m: config.camera.depth_max_m as f32,
            center_m: (bounds_m.0 + bounds_m.1) / 2.0,
            radius_m: (edge_m + 0.5).max(0.87 * edge_m + rules.clearance_m),
            lowest_m: rules.lowest_altitude_m,
            bounds_m,
            scene,
        })
    }

    /// Centre of the true box, metres.
    #[must_use]
    pub fn center_m(&self) -> DVec3 {
        self.center_m
    }

    /// The radius R that belongs to the true box, metres.
    #[must_use]
    pub fn radius_m(&self) -> f64 {
        self.radius_m
    }

    /// A camera with the mission's field of view.
    #[must_use]
    pub fn intrinsics(&self, width: u32, height: u32) -> Intrinsics {
        Intrinsics::from_hfov(width, height, self.hfov_rad)
    }

    /// The held-out views of the object: half at R, half at 0.8 R, away from every candidate of the full sphere.
    ///
    /// # Errors
    /// When the candidates leave no room for so many.
    pub fn held_out(&self, count: usize) -> anyhow::Result<Vec<HeldOutView>> {
        let points = PlannerConfig::default().sphere_points;
        let avoid: Vec<DVec3> = (0..points).map(|index| fibonacci_direction(index, points)).collect();
        let rules = HeldOutRules { count, ..HeldOutRules::default() };
        Ok(held_out_views(self.bounds_m, self.radius_m, &avoid, &rules)?)
    }

    /// The true image at the size of a capture over a whole number, averaged as the trainer averages its images, and the
    /// object's mask at that size.
    #[must_use]
    pub fn image(&self, pose: &Pose, width: u32, height: u32) -> TrueImage {
        let threads = Threads::new(1);
        let factor = (self.capture.width / width.max(1)).max(1);
        let fine = self.intrinsics(width * factor, height * factor);
        let options = RenderOptions {
            samples_per_edge: self.samples_per_edge,
            depth_max_m: self.depth_max_m,
            ..RenderOptions::default()
        };
        let color = render(&self.scene, pose, &fine, &options, &threads);
        let depth_only = RenderOptions { color: false, ..options };
        let coarse = render(&self.scene, pose, &self.intrinsics(width, height), &depth_only, &threads);
        TrueImage {
            color: box_mean(&color, factor as usize),
            object: coarse.object.iter().map(|hit| *hit == 1).collect(),
        }
    }

    /// Least distance of a flown track from the object's surface, metres, and how often it came closer than the rotors
    /// reach; `None` for a vehicle that never flew.
    #[must_use]
    pub fn clearance(&self, track_m: &[DVec3]) -> Option<(f64, usize)> {
        let airborne = track_m.iter().filter(|point| point.z > AIRBORNE_M);
        let distances: Vec<f64> =
            airborne.map(|point| f64::from(self.scene.index().distance_m(point.as_vec3()))).collect();
        let least = distances.iter().copied().min_by(f64::total_cmp)?;
        let touching = |distance: &f64| *distance < ROTOR_REACH_M;
        let began = distances.windows(2).filter(|pair| !touching(&pair[0]) && touching(&pair[1])).count();
        Some((least, began + usize::from(distances.first().is_some_and(touching))))
    }

    /// Coverage of the true surface by views in their order, and how near the model is to it: the centres of Gaussians that
    /// are more than half opaque, those left out that are nearer to the ground than to the object. Completeness asks for what
    /// some view could have seen.
    #[must_use]
    pub fn surface(&self, poses: &[Pose], gaussians: &Gaussians) -> (Coverage, Option<Geometry>) {
        let threads = Threads::new(cores());
        let index = self.scene.index();
        let samples = SurfaceSamples::new(self.scene.mesh(), SURFACE_SAMPLES, SAMPLE_SEED);
        let shell = (self.center_m, self.radius_m, self.lowest_m);
        let meter = CoverageMeter::new(index, &samples, ViewLimits::new(self.capture), shell, &threads);
        let solid: Vec<Vec3> = gaussians
            .iter()
            .filter(|gaussian| gaussian.opacity_logit > 0.0 && gaussian.mean.is_finite())
            .map(|gaussian| gaussian.mean)
            .filter(|mean| index.distance_m(*mean) <= mean.z.abs())
            .collect();
        let feasible = samples.only(meter.feasible_once());
        let diameter_m = (self.bounds_m.1 - self.bounds_m.0).length();
        let geometry = compare(&solid, index, &feasible, &[F_SCORE_SHARE * diameter_m], &threads);
        (meter.measure(poses, &threads), geometry)
    }
}

/// The truth of one view.
#[derive(Debug, Clone, PartialEq)]
pub struct TrueImage {
    /// sRGB as shares of full scale, row by row.
    pub color: Vec<[f32; 3]>,
    /// Whether the ray through the pixel's centre hits the object.
    pub object: Vec<bool>,
}

/// Cores of this machine.
#[must_use]
pub fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, std::num::NonZero::get)
}

/// Unit vector of point `index` of `count` on the full Fibonacci sphere, as the planner places its candidates (A16).
fn fibonacci_direction(index: u32, count: u32) -> DVec3 {
    let golden_rad = core::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
    let z = 1.0 - (2.0 * f64::from(index) + 1.0) / f64::from(count.max(1));
    let across = (1.0 - z * z).max(0.0).sqrt();
    let angle_rad = golden_rad * f64::from(index);
    DVec3::new(across * angle_rad.cos(), across * angle_rad.sin(), z)
}

/// The mean of every `factor` x `factor` pixels, of sRGB values, as shares of full scale.
fn box_mean(image: &RgbdImage, factor: usize) -> Vec<[f32; 3]> {
    let (width, height) = (image.width / factor, image.height / factor);
    #[expect(clippy::cast_precision_loss, reason = "a few pixels")]
    let scale = 1.0 / (255.0 * (factor * factor) as f32);
    let mut mean = Vec::with_capacity(width * height);
    for row in 0..height {
        for column in 0..width {
            let mut sum = [0.0_f32; 3];
            for line in 0..factor {
                let start = ((row * factor + line) * image.width + column * factor) * 3;
                for pixel in image.rgb.get(start..start + factor * 3).unwrap_or_default().chunks_exact(3) {
                    for (total, value) in sum.iter_mut().zip(pixel) {
                        *total += f32::from(*value);
                    }
                }
            }
            mean.push(sum.map(|total| total * scale));
        }
    }
    mean
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_box_mean_keeps_each_block_to_itself() {
        let rgb: Vec<u8> = [[0, 100, 200, 20], [0, 100, 200, 20], [40, 40, 0, 0], [40, 40, 255, 255]]
            .concat()
            .into_iter()
            .flat_map(|v: u8| [v, v, v])
            .collect();
        let image = RgbdImage { width: 4, height: 4, rgb, depth_m: vec![0.0; 16], object: vec![0; 16] };
        let mean: Vec<f32> = box_mean(&image, 2).iter().map(|c| c[0] * 255.0).collect();
        for (found, expected) in mean.iter().zip([50.0, 110.0, 40.0, 127.5]) {
            assert!((found - expected).abs() < 1e-3, "{mean:?}");
        }
    }
}
