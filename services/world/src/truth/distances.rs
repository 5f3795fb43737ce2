//! How far a reconstructed point set lies from the true surface, and the other way round.

use glam::Vec3;
use rayon::prelude::*;

use super::SurfaceSamples;
use crate::bvh::{MeshIndex, PointIndex};
use crate::render::Threads;

/// Distances between points and surface.
#[derive(Debug, Clone, PartialEq)]
pub struct Geometry {
    /// Mean distance of the points from the surface, metres.
    pub accuracy_m: f64,
    /// Mean distance of the surface's samples from their nearest point, metres.
    pub completeness_m: f64,
    /// Mean of both, metres.
    pub chamfer_m: f64,
    /// For each threshold asked for (metres): harmonic mean of the share of points and the share of samples within it.
    pub f_scores: Vec<(f64, f64)>,
}

/// Compares a point set with the surface. `None` if there are no finite points or no samples. Samples that no view can see
/// may be left out by the caller, so that completeness does not ask for the impossible.
#[must_use]
pub fn compare(
    points: &[Vec3],
    index: &MeshIndex,
    samples: &SurfaceSamples,
    thresholds_m: &[f64],
    threads: &Threads,
) -> Option<Geometry> {
    let points: Vec<Vec3> = points.iter().copied().filter(|p| p.is_finite()).collect();
    if points.is_empty() || samples.is_empty() {
        return None;
    }
    let tree = PointIndex::new(&points);
    let (from_points, from_surface): (Vec<f64>, Vec<f64>) = threads.install(|| {
        (
            points.par_iter().map(|p| f64::from(index.distance_m(*p))).collect(),
            samples.points.par_iter().map(|p| f64::from(tree.distance_m(*p))).collect(),
        )
    });
    // Summed in order, after the parallel part: the same for any number of threads.
    let mean = |distances: &[f64]| distances.iter().sum::<f64>() / distances.len() as f64;
    let within = |distances: &[f64], limit: f64| {
        distances.iter().filter(|d| **d <= limit).count() as f64 / distances.len() as f64
    };
    let f_score = |limit: f64| {
        let (precision, recall) = (within(&from_points, limit), within(&from_surface, limit));
        if precision + recall > 0.0 { 2.0 * precision * recall / (precision + recall) } else { 0.0 }
    };
    let (accuracy_m, completeness_m) = (mean(&from_points), mean(&from_surface));
    Some(Geometry {
        accuracy_m,
        completeness_m,
        chamfer_m: (accuracy_m + completeness_m) / 2.0,
        f_scores: thresholds_m.iter().map(|limit| (*limit, f_score(*limit))).collect(),
    })
}
