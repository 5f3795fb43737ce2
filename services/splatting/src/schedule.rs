//! Learning rates of an offline run over its iterations, and the size of a scene that they are relative to.

use glam::DVec3;

use crate::camera::Camera;
use crate::model::SH_DEGREE_MAX;
use crate::settings::TrainingSettings;

/// Iterations of a published run.
const PUBLISHED_ITERATIONS: u32 = 30_000;

/// Learning rates by iteration. The defaults are those of 3DGS (Kerbl et al. 2023, and `OptimizationParams` of its code)
/// and of gsplat's `simple_trainer.py`, for 30,000 iterations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// Size of the scene, metres, by which the rate of the means is multiplied: see [`scene_extent`].
    pub extent_m: f32,
    /// Rate of the means at the beginning, relative to the extent (1.6e-4).
    pub means_first: f32,
    /// Rate of the means at [`Schedule::means_iterations`] and after, relative to the extent (1.6e-6).
    pub means_last: f32,
    /// Iterations over which the logarithm of the rate of the means falls linearly (30,000).
    pub means_iterations: u32,
    /// Rate of the log scales (5e-3).
    pub log_scales: f32,
    /// Rate of the quaternions (1e-3).
    pub rotations: f32,
    /// Rate of the opacity logits: 0.05, as in the paper and in gsplat. The code of 3DGS has 0.025 since October 2024.
    pub opacity: f32,
    /// Rate of the spherical harmonics of degree 0 (2.5e-3).
    pub sh: f32,
    /// Rate of the higher degrees relative to that of degree 0 (1/20).
    pub sh_rest_fraction: f32,
    /// Iterations after which another degree of spherical harmonics is used (1,000).
    pub sh_degree_every: u32,
    /// The highest degree that is used (3).
    pub sh_degree: u8,
}

impl Schedule {
    /// The published schedule for a scene of this extent. A published run of 7,000 iterations is this one, stopped.
    pub fn published(extent_m: f32) -> Self {
        Self {
            extent_m,
            means_first: 1.6e-4,
            means_last: 1.6e-6,
            means_iterations: PUBLISHED_ITERATIONS,
            log_scales: 5e-3,
            rotations: 1e-3,
            opacity: 0.05,
            sh: 2.5e-3,
            sh_rest_fraction: 1.0 / 20.0,
            sh_degree_every: 1000,
            sh_degree: SH_DEGREE_MAX,
        }
    }

    /// The schedule with all its iterations multiplied by `factor`, as gsplat's `steps_scaler` does, for a shorter run
    /// that is to be complete in itself: goes with [`Strategy::scaled`](crate::Strategy::scaled).
    #[must_use]
    pub fn scaled(self, factor: f64) -> Self {
        let scaled = |iterations: u32| ((f64::from(iterations) * factor) as u32).max(1);
        Self { means_iterations: scaled(self.means_iterations), sh_degree_every: scaled(self.sh_degree_every), ..self }
    }

    /// Learning rate of the means in an iteration, metres.
    pub fn means(&self, iteration: u32) -> f32 {
        let part = (f64::from(iteration) / f64::from(self.means_iterations.max(1))).min(1.0);
        let [first, last] = [self.means_first, self.means_last].map(|rate| f64::from(rate).ln());
        (f64::from(self.extent_m) * (first + part * (last - first)).exp()) as f32
    }

    /// Degree of spherical harmonics that is used in an iteration.
    pub fn sh_degree(&self, iteration: u32) -> u8 {
        (iteration / self.sh_degree_every.max(1)).min(u32::from(self.sh_degree.min(SH_DEGREE_MAX))) as u8
    }

    /// Sets the learning rates of an iteration, and the degree of spherical harmonics that is rendered: the model itself
    /// has all its bands from the beginning.
    pub fn apply(&self, iteration: u32, settings: &mut TrainingSettings) {
        settings.lr_means = self.means(iteration);
        settings.lr_log_scales = self.log_scales;
        settings.lr_rotations = self.rotations;
        settings.lr_opacity = self.opacity;
        settings.lr_sh = self.sh;
        settings.lr_sh_rest = self.sh * self.sh_rest_fraction;
        settings.render.sh_degree = self.sh_degree(iteration);
    }
}

/// Size of a scene from the places of its cameras, metres: 1.1 times the distance of the farthest from their mean, as
/// 3DGS has it. `None` where there are not two cameras at different places.
pub fn scene_extent<'a>(cameras: impl IntoIterator<Item = &'a Camera>) -> Option<f32> {
    let centres: Vec<DVec3> = cameras.into_iter().map(|c| c.world_from_camera.translation.as_dvec3()).collect();
    let mean = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
    let radius = centres.iter().map(|c| c.distance(mean)).fold(0.0, f64::max);
    let extent = (1.1 * radius) as f32;
    (extent > 0.0 && extent.is_finite()).then_some(extent)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Pose;
    use glam::{Quat, Vec3};

    #[test]
    fn the_rate_of_the_means_falls_a_hundredfold_in_equal_ratios() {
        let schedule = Schedule::published(2.0);
        let close = |iteration: u32, rate: f32| (schedule.means(iteration) / rate - 1.0).abs() < 1e-5;
        assert!(close(0, 3.2e-4) && close(15_000, 3.2e-5) && close(30_000, 3.2e-6) && close(50_000, 3.2e-6));
        let mut settings = TrainingSettings::default();
        schedule.apply(15_000, &mut settings);
        assert_eq!(settings.lr_means, schedule.means(15_000));
        assert_eq!((settings.lr_opacity, settings.lr_sh, settings.lr_sh_rest), (0.05, 2.5e-3, 1.25e-4));
        assert_eq!(settings.render.sh_degree, 3);
        let short = schedule.scaled(7.0 / 30.0);
        assert!((short.means(3500) / 3.2e-5 - 1.0).abs() < 1e-3 && (short.means(7000) / 3.2e-6 - 1.0).abs() < 1e-3);
    }

    #[test]
    fn a_degree_is_added_every_thousand_iterations() {
        let schedule = Schedule::published(1.0);
        assert_eq!([0, 999, 1000, 2999, 3000, 29_999].map(|i| schedule.sh_degree(i)), [0, 0, 1, 2, 3, 3]);
        assert_eq!(Schedule { sh_degree: 1, ..schedule }.sh_degree(9000), 1);
        assert_eq!(Schedule { sh_degree_every: 0, sh_degree: 9, ..schedule }.sh_degree(9000), 3);
    }

    #[test]
    fn the_extent_is_that_of_the_cameras() {
        let at = |x: f32, y: f32| {
            let pose = Pose { rotation: Quat::IDENTITY, translation: Vec3::new(x, y, 5.0) };
            Camera::from_hfov(pose, 1.0, 40, 30)
        };
        let cameras = [at(-1.0, 0.0), at(1.0, 0.0), at(0.0, -3.0), at(0.0, 3.0)];
        assert!((scene_extent(&cameras).unwrap() - 3.3).abs() < 1e-5);
        assert_eq!(scene_extent(&[at(2.0, 1.0), at(2.0, 1.0)]), None);
        assert_eq!(scene_extent(&[]), None);
        assert_eq!(scene_extent(&[at(f32::NAN, 1.0), at(2.0, 1.0)]), None);
    }
}
