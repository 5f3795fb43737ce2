//! Coverage of the true surface by a sequence of views.
//!
//! A sample is covered once (Cov@1) when a view sees it, and twice (Cov@2) when two views see it from directions at least
//! 10 degrees apart, which is what triangulation needs. What no view of a dense shell can see (the contact with the ground,
//! deep concavities) is not feasible; coverage is reported over the feasible and over the total surface.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::SurfaceSamples;
use super::visibility::{ViewLimits, shell_poses};
use crate::bvh::MeshIndex;
use crate::render::Threads;
use shared_types::frames::Pose;

/// Views of one sample closer together than this do not triangulate it.
const BASELINE_DEG: f32 = 10.0;
/// Poses of the shell that decides what is feasible.
const SHELL_POSES: usize = 700;

/// Shares of the surface after some views, 0 to 1.
#[derive(Debug, Clone, PartialEq)]
pub struct Coverage {
    /// Seen by at least one view, of what one pose of the shell can see.
    pub cov1_feasible: f64,
    /// Seen by two views, of what two poses of the shell can see.
    pub cov2_feasible: f64,
    /// Seen by at least one view, of everything.
    pub cov1_total: f64,
    /// Seen by two views, of everything.
    pub cov2_total: f64,
    /// `cov2_feasible` after each view.
    pub curve: Vec<f64>,
    /// Mean of the curve: the area under it over the number of views.
    pub auc: f64,
}

/// Measures coverage of one object; what is feasible is found once.
pub struct CoverageMeter<'a> {
    index: &'a MeshIndex,
    samples: &'a SurfaceSamples,
    limits: ViewLimits,
    feasible_once: Vec<bool>,
    feasible_twice: Vec<bool>,
}

/// After which views (counted from 1) a sample is covered once and twice.
#[derive(Debug, Clone, Copy, Default)]
struct Covered {
    once: Option<usize>,
    twice: Option<usize>,
}

impl<'a> CoverageMeter<'a> {
    /// Finds what is feasible from the shell of `radius_m` around `center_m`, not below `lowest_altitude_m`.
    #[must_use]
    pub fn new(
        index: &'a MeshIndex,
        samples: &'a SurfaceSamples,
        limits: ViewLimits,
        (center_m, radius_m, lowest_altitude_m): (DVec3, f64, f64),
        threads: &Threads,
    ) -> Self {
        let mut meter = Self { index, samples, limits, feasible_once: Vec::new(), feasible_twice: Vec::new() };
        // In golden-angle order, neighbours in the list are far apart on the shell: most samples are done after a few.
        let poses = shell_poses(center_m, radius_m, lowest_altitude_m, SHELL_POSES);
        let stride = 271; // coprime to 700: the order visits top and bottom alike
        let shuffled: Vec<Pose> = (0..poses.len()).map(|i| poses[i * stride % poses.len()]).collect();
        let covered = meter.cover(&shuffled, threads);
        meter.feasible_once = covered.iter().map(|c| c.once.is_some()).collect();
        meter.feasible_twice = covered.iter().map(|c| c.twice.is_some()).collect();
        meter
    }

    /// For each sample, whether one pose of the shell sees it.
    #[must_use]
    pub fn feasible_once(&self) -> &[bool] {
        &self.feasible_once
    }

    /// For each sample, whether two poses of the shell, far enough apart, see it.
    #[must_use]
    pub fn feasible_twice(&self) -> &[bool] {
        &self.feasible_twice
    }

    /// Coverage by views in their order.
    #[must_use]
    pub fn measure(&self, views: &[Pose], threads: &Threads) -> Coverage {
        let covered = self.cover(views, threads);
        let share = |count: usize, of: usize| if of == 0 { 0.0 } else { count as f64 / of as f64 };
        let count = |flags: &[bool]| flags.iter().filter(|f| **f).count();
        let (once, twice) = (|c: &Covered| c.once.is_some(), |c: &Covered| c.twice.is_some());
        let both = |feasible: &[bool], done: fn(&Covered) -> bool| {
            covered.iter().zip(feasible).filter(|(c, f)| **f && done(c)).count()
        };
        let all = |done: fn(&Covered) -> bool| covered.iter().filter(|c| done(c)).count();

        let feasible_twice = count(&self.feasible_twice);
        let mut added = vec![0_usize; views.len() + 1];
        for (covered, feasible) in covered.iter().zip(&self.feasible_twice) {
            if let Some(view) = covered.twice.filter(|_| *feasible) {
                added[view] += 1;
            }
        }
        let curve: Vec<f64> = added
            .iter()
            .skip(1)
            .scan(0, |sum, new| {
                *sum += new;
                Some(share(*sum, feasible_twice))
            })
            .collect();
        Coverage {
            cov1_feasible: share(both(&self.feasible_once, once), count(&self.feasible_once)),
            cov2_feasible: share(both(&self.feasible_twice, twice), feasible_twice),
            cov1_total: share(all(once), covered.len()),
            cov2_total: share(all(twice), covered.len()),
            auc: if curve.is_empty() { 0.0 } else { curve.iter().sum::<f64>() / curve.len() as f64 },
            curve,
        }
    }

    /// For each sample, the views that cover it; stops looking once it is covered twice.
    fn cover(&self, views: &[Pose], threads: &Threads) -> Vec<Covered> {
        let limit = BASELINE_DEG.to_radians().cos();
        threads.install(|| {
            self.samples
                .points
                .par_iter()
                .zip(&self.samples.normals)
                .map(|(point, normal)| {
                    let mut covered = Covered::default();
                    let mut directions: Vec<Vec3> = Vec::new();
                    for (i, view) in views.iter().enumerate() {
                        if !self.limits.sees(self.index, view, *point, *normal) {
                            continue;
                        }
                        let direction = (view.position_m.as_vec3() - *point).normalize_or_zero();
                        covered.once.get_or_insert(i + 1);
                        if directions.iter().any(|other| other.dot(direction) <= limit) {
                            covered.twice = Some(i + 1);
                            break;
                        }
                        directions.push(direction);
                    }
                    covered
                })
                .collect()
        })
    }
}
