//! The model that an offline run begins with: from the sparse points of structure from motion, or at random.

use glam::{Quat, Vec3};
use thiserror::Error;

use crate::densify::random::Random;
use crate::model::{Gaussian, Gaussians};
use crate::neighbours::neighbour_distances;

/// Smallest standard deviation that a Gaussian begins with: where points coincide, as 3DGS bounds their squared distance
/// by 1e-7.
const SIGMA_MIN_M: f32 = 3.162_277_7e-4;

/// A point with a colour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ColoredPoint {
    /// Place in the world, metres.
    pub position: Vec3,
    /// Red, green, blue, 0 to 1.
    pub color: [f32; 3],
}

/// Why no model could be made.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum InitialError {
    /// Too few points to know distances between neighbours.
    #[error("{found} points are too few to begin with: give at least 4, or begin with random points in a box")]
    TooFew {
        /// Points given.
        found: usize,
    },
    /// A point is not a number.
    #[error("point {index} is not finite: position {position}, colour {color:?}; leave it out")]
    NotFinite {
        /// Index of the point.
        index: usize,
        /// Its position.
        position: Vec3,
        /// Its colour.
        color: [f32; 3],
    },
    /// A box without an inside.
    #[error(
        "random points in a box from {low} to {high}: give finite corners, the first below the second on every axis"
    )]
    Box {
        /// First corner.
        low: Vec3,
        /// Second corner.
        high: Vec3,
    },
    /// A setting is out of range.
    #[error("initial `{name}` is {value}: give {expected}")]
    Setting {
        /// Name of the field.
        name: &'static str,
        /// Its value.
        value: f32,
        /// What is accepted.
        expected: &'static str,
    },
}

/// How Gaussians begin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InitialGaussians {
    /// Opacity of each.
    pub opacity: f32,
    /// Standard deviation relative to the root mean square distance to the three nearest points.
    pub scale_factor: f32,
}

impl InitialGaussians {
    /// As 3DGS begins: opacity 0.1, standard deviations as large as the distance between neighbours.
    pub const PUBLISHED: Self = Self { opacity: 0.1, scale_factor: 1.0 };
    /// As 3DGS-MCMC begins: opacity 0.5, a tenth of these standard deviations.
    pub const MCMC: Self = Self { opacity: 0.5, scale_factor: 0.1 };

    /// One Gaussian of equal axes per point; ids count from 0 in the order of the points.
    ///
    /// # Errors
    /// Where there are fewer than 4 points, one is not finite, or a setting is out of range.
    pub fn from_points(&self, points: &[ColoredPoint]) -> Result<Gaussians, InitialError> {
        self.check()?;
        if points.len() < 4 {
            return Err(InitialError::TooFew { found: points.len() });
        }
        let finite = |p: &ColoredPoint| p.position.is_finite() && p.color.iter().all(|c| c.is_finite());
        if let Some((index, p)) = points.iter().enumerate().find(|(_, p)| !finite(p)) {
            return Err(InitialError::NotFinite { index, position: p.position, color: p.color });
        }
        let positions: Vec<Vec3> = points.iter().map(|p| p.position).collect();
        let opacity_logit = (self.opacity / (1.0 - self.opacity)).ln();
        let gaussians = points.iter().zip(neighbour_distances(&positions)).enumerate().map(|(i, (point, distance))| {
            // Points 1e20 m apart have a distance that overflows.
            let sigma = self.scale_factor * distance.clamp(SIGMA_MIN_M, 1e9);
            Gaussian {
                mean: point.position,
                log_scales: Vec3::splat(sigma.ln()),
                rotation: Quat::IDENTITY,
                opacity_logit,
                sh: Gaussian::sh_from_color(point.color),
                id: i as u64,
                birth_round: 0,
            }
        });
        Ok(gaussians.collect())
    }

    fn check(&self) -> Result<(), InitialError> {
        if !(self.opacity > 0.0 && self.opacity < 1.0) {
            let (name, value) = ("opacity", self.opacity);
            return Err(InitialError::Setting { name, value, expected: "a number above 0 and below 1" });
        }
        if !(self.scale_factor > 0.0 && self.scale_factor.is_finite()) {
            let (name, value) = ("scale_factor", self.scale_factor);
            return Err(InitialError::Setting { name, value, expected: "a finite number above 0" });
        }
        Ok(())
    }
}

/// Points of random places and colours in a box, where no sparse points are known; equal seeds give equal points. 3DGS
/// takes 100,000 in such a case.
///
/// # Errors
/// Where the box has no inside.
pub fn random_points(count: usize, low: Vec3, high: Vec3, seed: u64) -> Result<Vec<ColoredPoint>, InitialError> {
    if !((high - low).is_finite() && low.cmplt(high).all()) {
        return Err(InitialError::Box { low, high });
    }
    let mut random = Random(seed);
    let mut three = || [0; 3].map(|_| random.uniform() as f32);
    Ok((0..count)
        .map(|_| ColoredPoint { position: low + (high - low) * Vec3::from_array(three()), color: three() })
        .collect())
}
