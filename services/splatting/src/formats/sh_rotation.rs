//! Rotation of spherical harmonics up to degree 3.
//!
//! The colour of a Gaussian is a function f of the direction in which it is seen. Turning the world by R must give f'
//! with f'(R d) = f(d). A rotation mixes the coefficients within a band only, and as the basis functions Y are
//! orthonormal, the matrix of a band is M[m][n] = ∫ Y_m(R d) Y_n(d) dd over the sphere. The integrand is a polynomial of
//! degree 6 at most, for which four Gauss-Legendre nodes in z by eight equal steps of azimuth are exact, so that this
//! holds for every rotation and needs none of the recurrences in the literature with their errata.

use std::f64::consts::PI;

use glam::{DMat3, DVec3};

use crate::model::SH_REST_MAX;
use crate::sh::basis;

/// Nodes and weights of the four-point Gauss-Legendre rule on [-1, 1].
const LEGENDRE: [(f64, f64); 4] = [
    (-0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
    (-0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
    (0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
    (0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
];
const AZIMUTHS: usize = 8;
/// Entries below this are rounding: the matrices of axis permutations have exact zeros.
const ROUNDING: f64 = 1e-14;

/// Turns the coefficients of the bands 1 to 3.
#[derive(Clone, Debug)]
pub struct ShRotation {
    /// Row m, column n of the bands' matrices on the diagonal; zero elsewhere.
    matrix: [[f64; SH_REST_MAX]; SH_REST_MAX],
}

impl ShRotation {
    /// Of a proper rotation matrix.
    pub fn new(rotation: DMat3) -> Self {
        let mut matrix = [[0.0; SH_REST_MAX]; SH_REST_MAX];
        for (z, weight) in LEGENDRE {
            for step in 0..AZIMUTHS {
                // Half a step off the axes: any start is exact.
                let azimuth = 2.0 * PI * (step as f64 + 0.5) / AZIMUTHS as f64;
                let radius = (1.0 - z * z).sqrt();
                let direction = DVec3::new(radius * azimuth.cos(), radius * azimuth.sin(), z);
                let (turned, before) = (basis(rotation * direction), basis(direction));
                let weight = weight * 2.0 * PI / AZIMUTHS as f64;
                for (m, row) in matrix.iter_mut().enumerate() {
                    let band = band(m);
                    for n in band {
                        row[n] += weight * turned[m + 1] * before[n + 1];
                    }
                }
            }
        }
        for entry in matrix.iter_mut().flatten() {
            if entry.abs() < ROUNDING {
                *entry = 0.0;
            }
        }
        Self { matrix }
    }

    /// Coefficient `k` (as in [`Gaussians::sh_rest`](crate::Gaussians::sh_rest)) after the rotation, of red, green, blue.
    ///
    /// # Panics
    /// Where `k` is not below [`SH_REST_MAX`].
    pub fn coefficient(&self, k: usize, before: &[[f32; 3]; SH_REST_MAX]) -> [f32; 3] {
        std::array::from_fn(|channel| {
            let turned: f64 = band(k).map(|n| self.matrix[k][n] * f64::from(before[n][channel])).sum();
            // A sum of the largest finite numbers stays finite.
            turned.clamp(f64::from(f32::MIN), f64::from(f32::MAX)) as f32
        })
    }

    /// All coefficients above degree 0 after the rotation.
    pub fn apply(&self, before: &[[f32; 3]; SH_REST_MAX]) -> [[f32; 3]; SH_REST_MAX] {
        std::array::from_fn(|k| self.coefficient(k, before))
    }
}

/// Coefficients of the band that coefficient `k` belongs to.
fn band(k: usize) -> std::ops::Range<usize> {
    match k {
        0..3 => 0..3,
        3..8 => 3..8,
        _ => 8..SH_REST_MAX,
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, EulerRot};

    use super::*;
    use crate::tests::Random;

    /// Coefficients of all bands.
    fn coefficients(seed: u64) -> [[f32; 3]; SH_REST_MAX] {
        let mut random = Random(seed);
        std::array::from_fn(|_| std::array::from_fn(|_| random.uniform(-1.0, 1.0)))
    }

    fn value(coefficients: &[[f32; 3]; SH_REST_MAX], channel: usize, direction: DVec3) -> f64 {
        let basis = basis(direction);
        coefficients.iter().zip(&basis[1..]).map(|(c, b)| f64::from(c[channel]) * b).sum()
    }

    #[test]
    fn a_turned_colour_is_the_colour_from_the_turned_direction() {
        let mut random = Random(3);
        for seed in 0..50 {
            let mut angle = || f64::from(random.uniform(-3.2, 3.2));
            let turn = DQuat::from_euler(EulerRot::XYZ, angle(), angle(), angle());
            let direction = DQuat::from_euler(EulerRot::ZYX, angle(), angle(), angle()) * DVec3::X;
            let before = coefficients(seed);
            let after = ShRotation::new(DMat3::from_quat(turn)).apply(&before);
            for channel in 0..3 {
                let (old, new) = (value(&before, channel, direction), value(&after, channel, turn * direction));
                assert!((old - new).abs() < 1e-5, "{turn} {direction}: {old}, {new}");
            }
        }
    }

    #[test]
    fn half_turns_about_the_axes_change_signs_as_the_spz_library_does() {
        // Its table for axes that keep (1) or change (-1) their sign.
        let published = |[x, y, z]: [f32; 3]| [y, z, x, x * y, y * z, 1.0, x * z, 1.0, y, x * y * z, y, z, x, z, x];
        for signs in [[1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]] {
            let turn = DMat3::from_diagonal(DVec3::from_array(signs.map(f64::from)));
            let before = coefficients(7);
            let after = ShRotation::new(turn).apply(&before);
            for (k, sign) in published(signs).into_iter().enumerate() {
                for channel in 0..3 {
                    assert!((after[k][channel] - sign * before[k][channel]).abs() < 1e-6, "{signs:?}, {k}");
                }
            }
        }
    }

    #[test]
    fn no_turn_changes_nothing_and_the_way_back_leads_back() {
        let before = coefficients(1);
        assert_eq!(ShRotation::new(DMat3::IDENTITY).apply(&before), before);
        let quarter = DMat3::from_rotation_x(-std::f64::consts::FRAC_PI_2);
        let there = ShRotation::new(quarter).apply(&before);
        let back = ShRotation::new(quarter.transpose()).apply(&there);
        assert!(back.iter().flatten().zip(before.iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-6));
    }
}
