//! The model that an offline run begins with: from the sparse points of structure from motion, or at random.

use glam::{Quat, Vec3};
use thiserror::Error;

use crate::model::{Gaussian, Gaussians};
use crate::neighbours::neighbour_distances;
use crate::random::Random;

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaussians_are_as_large_as_the_distance_to_their_neighbours() {
        // A line with a spacing of 0.1 m: two neighbours at 0.1 m and one at 0.2 m, at its ends 0.1, 0.2 and 0.3 m.
        let points: Vec<ColoredPoint> = (0..30)
            .map(|i| ColoredPoint { position: Vec3::X * (0.1 * i as f32), color: [0.01 * i as f32, 0.5, 1.0] })
            .collect();
        let model = InitialGaussians::PUBLISHED.from_points(&points).unwrap();
        for (i, (gaussian, point)) in model.iter().zip(&points).enumerate() {
            assert_eq!((gaussian.mean, gaussian.id), (point.position, i as u64));
            let sigma = if i == 0 || i == 29 { (0.14_f32 / 3.0).sqrt() } else { (0.06_f32 / 3.0).sqrt() };
            assert!((gaussian.log_scales.exp() - sigma).abs().max_element() < 1e-4, "{i}: {}", gaussian.log_scales);
            assert!((gaussian.opacity() - 0.1).abs() < 1e-6);
            assert!(gaussian.color().iter().zip(point.color).all(|(got, want)| (got - want).abs() < 1e-6));
        }
        let small = InitialGaussians::MCMC.from_points(&points).unwrap().get(3);
        assert!(
            (small.log_scales.exp().x - 0.1 * 0.02_f32.sqrt()).abs() < 1e-5 && (small.opacity() - 0.5).abs() < 1e-6
        );
        // Points that coincide, and points that are absurdly far apart, still make a model.
        let mut points = vec![points[0]; 6];
        points[5].position = Vec3::splat(1e30);
        assert!(InitialGaussians::PUBLISHED.from_points(&points).unwrap().is_finite());
    }

    #[test]
    fn random_points_fill_their_box_and_are_the_same_again() {
        let (low, high) = (Vec3::new(-1.0, 2.0, 0.0), Vec3::new(1.0, 2.5, 4.0));
        let points = random_points(2000, low, high, 9).unwrap();
        assert!(points.iter().all(|p| p.position.cmpge(low).all() && p.position.cmple(high).all()));
        let mean = points.iter().map(|p| p.position).sum::<Vec3>() / 2000.0;
        assert!(((mean - 0.5 * (low + high)) / (high - low)).abs().max_element() < 0.03, "{mean}");
        assert_eq!(points, random_points(2000, low, high, 9).unwrap());
        assert_ne!(points, random_points(2000, low, high, 10).unwrap());
    }

    #[test]
    fn what_cannot_be_begun_with_is_named() {
        let point = ColoredPoint { position: Vec3::ONE, color: [0.5; 3] };
        let error = |points: &[ColoredPoint]| InitialGaussians::PUBLISHED.from_points(points).unwrap_err();
        assert_eq!(error(&[point; 3]), InitialError::TooFew { found: 3 });
        let mut points = [point; 9];
        points[7].color[2] = f32::NAN;
        assert!(error(&points).to_string().starts_with("point 7 is not finite"));
        let opaque = InitialGaussians { opacity: 1.0, ..InitialGaussians::PUBLISHED }.from_points(&[point; 4]);
        assert!(opaque.unwrap_err().to_string().contains("initial `opacity` is 1"));
        let flat = InitialGaussians { scale_factor: 0.0, ..InitialGaussians::PUBLISHED }.from_points(&[point; 4]);
        assert!(flat.unwrap_err().to_string().contains("`scale_factor` is 0"));
        for (low, high) in [(Vec3::ONE, Vec3::ONE), (Vec3::NAN, Vec3::ONE), (Vec3::ZERO, Vec3::INFINITY)] {
            assert!(random_points(5, low, high, 1).unwrap_err().to_string().contains("random points in a box"));
        }
    }
}
