//! Real spherical harmonics of degree 0 to 3: how a Gaussian's colour depends on the direction it is seen from.
//!
//! Order and signs are the field's (3DGS, gsplat, and every file format): bands in order, within band l the orders m
//! from -l to l, with the Condon-Shortley phase, so degree 1 is -C1 y, C1 z, -C1 x. The direction is that from the eye
//! to the mean, normalised, in the world. colour = 0.5 + Σ coefficient * basis function, not clamped at 0.

use glam::{DVec3, Vec3};

use crate::model::{
    Block, Gaussians, LANES, Lanes, ROW_MEAN, SH_C0, SH_DEGREE_MAX, SH_REST_MAX, sh_rest_coefficients, sh_rest_rows,
};
use crate::projection::{Projected, VALUE_MAX, View};
use crate::simd::{Simd, build};

/// sqrt(3 / 4π)
const C1: f64 = 0.488_602_511_902_919_9;
/// sqrt(15 / 4π), sqrt(5 / 16π), sqrt(15 / 16π)
const C2: [f64; 3] = [1.092_548_430_592_079_2, 0.315_391_565_252_520_05, 0.546_274_215_296_039_6];
/// sqrt(35 / 32π), sqrt(105 / 4π), sqrt(21 / 32π), sqrt(7 / 16π), sqrt(105 / 16π)
const C3: [f64; 5] = [
    0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    0.457_045_799_464_465_8,
    0.373_176_332_590_115_4,
    1.445_305_721_320_277,
];

/// Values of the sixteen basis functions for a direction of length 1.
pub(crate) fn basis(direction: DVec3) -> [f64; SH_REST_MAX + 1] {
    let DVec3 { x, y, z } = direction;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        f64::from(SH_C0),
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2[0] * x * y,
        -C2[0] * y * z,
        C2[1] * (2.0 * zz - xx - yy),
        -C2[0] * x * z,
        C2[2] * (xx - yy),
        -C3[0] * y * (3.0 * xx - yy),
        C3[1] * x * y * z,
        -C3[2] * y * (4.0 * zz - xx - yy),
        C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -C3[2] * x * (4.0 * zz - xx - yy),
        C3[4] * z * (xx - yy),
        -C3[0] * x * (xx - 3.0 * yy),
    ]
}

impl Gaussians {
    /// Colour of the Gaussian at `index` seen from `eye` (world, metres), with all bands of the model. Not clamped, as
    /// rendered; where the eye lies on the mean, the colour of degree 0.
    ///
    /// # Panics
    /// Where `index >= len()`, as a slice does.
    pub fn color_from(&self, index: usize, eye: Vec3) -> [f32; 3] {
        let gaussian = self.get(index);
        let Some(direction) = (gaussian.mean - eye).as_dvec3().try_normalize() else { return gaussian.color() };
        let (basis, rest) = (basis(direction), self.sh_rest(index));
        std::array::from_fn(|channel| {
            let bands: f64 = basis[1..].iter().zip(&rest).map(|(b, c)| b * f64::from(c[channel])).sum();
            (0.5 + basis[0] * f64::from(gaussian.sh[channel]) + bands) as f32
        })
    }

    /// Rows of a block's higher bands that an image of this highest degree needs.
    pub(crate) fn active_sh_rows(&self, highest_degree: u8) -> usize {
        sh_rest_rows(self.sh_degree().min(highest_degree))
    }
}

/// Directions from the eye to sixteen means.
pub(crate) struct Directions<S: Simd> {
    unit: [S::F; 3],
    /// One over the distance, 1/m.
    inverse_length: S::F,
}

impl<S: Simd> Directions<S> {
    #[inline(always)]
    fn new(s: S, view: &View, block: &Block) -> Self {
        let eye = view.eye.to_array();
        let offset = build!(s.splat(0.0); 3; |k| s.sub(s.load(&block.0[ROW_MEAN + k].0), s.splat(eye[k])));
        let length2 = s.fma(offset[0], offset[0], s.fma(offset[1], offset[1], s.mul(offset[2], offset[2])));
        let inverse_length = s.div(s.splat(1.0), s.sqrt(length2));
        Self { unit: build!(inverse_length; 3; |k| s.mul(offset[k], inverse_length)), inverse_length }
    }

    /// Basis functions of the bands above 0, as far as `rows` rows of coefficients need them.
    #[inline(always)]
    fn basis(&self, s: S, rows: usize) -> [S::F; SH_REST_MAX] {
        let [x, y, z] = self.unit;
        let mut out = [s.splat(0.0); SH_REST_MAX];
        let c = s.splat(C1 as f32);
        let negative = s.splat(-C1 as f32);
        (out[0], out[1], out[2]) = (s.mul(negative, y), s.mul(c, z), s.mul(negative, x));
        if rows < sh_rest_rows(2) {
            return out;
        }
        let (xx, yy, zz) = (s.mul(x, x), s.mul(y, y), s.mul(z, z));
        let (xy, yz, xz) = (s.mul(x, y), s.mul(y, z), s.mul(x, z));
        let [c0, c1, c2] = build!(c; 3; |i| s.splat(C2[i] as f32));
        let negative = s.splat(-C2[0] as f32);
        let (sum, difference) = (s.add(xx, yy), s.sub(xx, yy));
        out[3] = s.mul(c0, xy);
        out[4] = s.mul(negative, yz);
        out[5] = s.mul(c1, s.sub(s.add(zz, zz), sum));
        out[6] = s.mul(negative, xz);
        out[7] = s.mul(c2, difference);
        if rows < sh_rest_rows(SH_DEGREE_MAX) {
            return out;
        }
        let [_, c1, _, c3, c4] = build!(c; 5; |i| s.splat(C3[i] as f32));
        let (negative0, negative2) = (s.splat(-C3[0] as f32), s.splat(-C3[2] as f32));
        let three = s.splat(3.0);
        let slope = s.fma(s.splat(4.0), zz, s.sub(s.splat(0.0), sum));
        out[8] = s.mul(s.mul(negative0, y), s.fma(three, xx, s.sub(s.splat(0.0), yy)));
        out[9] = s.mul(s.mul(c1, xy), z);
        out[10] = s.mul(s.mul(negative2, y), slope);
        out[11] = s.mul(s.mul(c3, z), s.fnma(three, sum, s.add(zz, zz)));
        out[12] = s.mul(s.mul(negative2, x), slope);
        out[13] = s.mul(s.mul(c4, z), difference);
        out[14] = s.mul(s.mul(negative0, x), s.fnma(three, yy, xx));
        out
    }

    /// Σ weight * gradient of its basis function by the direction's coordinates.
    #[inline(always)]
    fn weighted_slope(&self, s: S, rows: usize, w: &[S::F; SH_REST_MAX]) -> [S::F; 3] {
        let [x, y, z] = self.unit;
        let c = s.splat(C1 as f32);
        let negative = s.splat(-C1 as f32);
        let (mut dx, mut dy, mut dz) = (s.mul(negative, w[2]), s.mul(negative, w[0]), s.mul(c, w[1]));
        if rows < sh_rest_rows(2) {
            return [dx, dy, dz];
        }
        let c0 = s.splat(C2[0] as f32);
        // Weights times the constants of their functions.
        let (w3, w4, w6) = (s.mul(c0, w[3]), s.mul(c0, w[4]), s.mul(c0, w[6]));
        let (w5, w7) = (s.mul(s.splat(2.0 * C2[1] as f32), w[5]), s.mul(s.splat(2.0 * C2[2] as f32), w[7]));
        dx = s.fma(y, w3, s.fnma(x, w5, s.fnma(z, w6, s.fma(x, w7, dx))));
        dy = s.fma(x, w3, s.fnma(z, w4, s.fnma(y, w5, s.fnma(y, w7, dy))));
        dz = s.fnma(y, w4, s.fma(s.add(z, z), w5, s.fnma(x, w6, dz)));
        if rows < sh_rest_rows(SH_DEGREE_MAX) {
            return [dx, dy, dz];
        }
        let (xx, yy, zz) = (s.mul(x, x), s.mul(y, y), s.mul(z, z));
        let (xy, yz, xz) = (s.mul(x, y), s.mul(y, z), s.mul(x, z));
        let three = s.splat(3.0);
        let (c0, c1, c2) = (s.splat(3.0 * C3[0] as f32), s.splat(C3[1] as f32), s.splat(C3[2] as f32));
        let (c3, c4) = (s.splat(3.0 * C3[3] as f32), s.splat(C3[4] as f32));
        let (w8, w9, w10) = (s.mul(c0, w[8]), s.mul(c1, w[9]), s.mul(c2, w[10]));
        let (w11, w12) = (s.mul(c3, w[11]), s.mul(c2, w[12]));
        let (w13, w14) = (s.mul(c4, w[13]), s.mul(c0, w[14]));
        let (sum, difference) = (s.add(xx, yy), s.sub(xx, yy));
        let (xy2, xz2, yz2) = (s.add(xy, xy), s.add(xz, xz), s.add(yz, yz));
        let eight_z = s.mul(s.splat(8.0), z);
        let four_zz = s.mul(s.splat(4.0), zz);
        let steep_x = s.sub(four_zz, s.fma(three, xx, yy));
        let steep_y = s.sub(four_zz, s.fma(three, yy, xx));
        dx = s.fnma(xy2, w8, s.fma(yz, w9, s.fma(xy2, w10, s.fnma(xz2, w11, dx))));
        dx = s.fnma(steep_x, w12, s.fma(xz2, w13, s.fnma(difference, w14, dx)));
        dy = s.fnma(difference, w8, s.fma(xz, w9, s.fnma(steep_y, w10, s.fnma(yz2, w11, dy))));
        dy = s.fma(xy2, w12, s.fnma(yz2, w13, s.fma(xy2, w14, dy)));
        dz = s.fma(xy, w9, s.fnma(s.mul(eight_z, y), w10, s.fma(s.sub(s.add(zz, zz), sum), w11, dz)));
        dz = s.fnma(s.mul(eight_z, x), w12, s.fma(difference, w13, dz));
        [dx, dy, dz]
    }
}

/// Adds the higher bands, whose coefficients are `rest`, to the colours of a projected block; what becomes absurdly
/// large or is not a number is not visible.
#[inline(always)]
pub(crate) fn add_bands<S: Simd>(s: S, view: &View, block: &Block, rest: &[Lanes], p: &mut Projected<S>) {
    let basis = Directions::new(s, view, block).basis(s, rest.len());
    for (k, coefficients) in rest.chunks_exact(3).enumerate() {
        for channel in 0..3 {
            p.color[channel] = s.fma(basis[k], s.load(&coefficients[channel].0), p.color[channel]);
        }
    }
    for channel in 0..3 {
        p.visible = s.and(p.visible, s.gt(s.splat(VALUE_MAX), s.abs(p.color[channel])));
    }
}

/// The basis functions, which times the gradient of the colour are the gradient of `rest`; and adds to the gradient of
/// the mean what passes through the direction.
#[inline(always)]
pub(crate) fn bands_gradient<S: Simd>(
    s: S,
    view: &View,
    block: &Block,
    rest: &[Lanes],
    d_color: &[S::F; 3],
    d_mean: &mut [S::F],
) -> [S::F; SH_REST_MAX] {
    let directions = Directions::new(s, view, block);
    let mut weights = [s.splat(0.0); SH_REST_MAX];
    for (k, coefficients) in rest.chunks_exact(3).enumerate() {
        for channel in 0..3 {
            weights[k] = s.fma(d_color[channel], s.load(&coefficients[channel].0), weights[k]);
        }
    }
    let slope = directions.weighted_slope(s, rest.len(), &weights);
    // Moving along the ray changes nothing.
    let unit = &directions.unit;
    let along = s.fma(unit[0], slope[0], s.fma(unit[1], slope[1], s.mul(unit[2], slope[2])));
    for k in 0..3 {
        let across = s.fnma(unit[k], along, slope[k]);
        d_mean[k] = s.fma(directions.inverse_length, across, d_mean[k]);
    }
    directions.basis(s, rest.len())
}

const _: () = assert!(sh_rest_coefficients(SH_DEGREE_MAX) == SH_REST_MAX && LANES == 16);

#[cfg(test)]
mod tests {
    use super::*;

    /// Associated Legendre polynomial with the Condon-Shortley phase, by its recurrences.
    fn legendre(l: i32, m: i32, x: f64) -> f64 {
        let mut diagonal = 1.0;
        for i in 1..=m {
            diagonal *= -f64::from(2 * i - 1) * (1.0 - x * x).sqrt();
        }
        let (mut before, mut value) = (0.0, diagonal);
        for i in m + 1..=l {
            let next = (f64::from(2 * i - 1) * x * value - f64::from(i + m - 1) * before) / f64::from(i - m);
            (before, value) = (value, next);
        }
        value
    }

    /// A real spherical harmonic from its definition in angles.
    fn harmonic(l: i32, m: i32, direction: DVec3) -> f64 {
        let azimuth = direction.y.atan2(direction.x);
        let factorial = |n: i32| (1..=n).map(f64::from).product::<f64>();
        let order = m.abs();
        let norm = f64::from(2 * l + 1) / (4.0 * std::f64::consts::PI) * factorial(l - order) / factorial(l + order);
        let turn = match m {
            0 => 1.0,
            _ if m > 0 => 2.0_f64.sqrt() * (f64::from(order) * azimuth).cos(),
            _ => 2.0_f64.sqrt() * (f64::from(order) * azimuth).sin(),
        };
        norm.sqrt() * turn * legendre(l, order, direction.z)
    }

    #[test]
    fn the_basis_is_that_of_the_definition() {
        for i in 0..50 {
            let angle = f64::from(i) * 2.399_963;
            let z: f64 = 0.97 - 0.039 * f64::from(i);
            let direction = DVec3::new((1.0 - z * z).sqrt() * angle.cos(), (1.0 - z * z).sqrt() * angle.sin(), z);
            let basis = basis(direction);
            for (k, value) in basis.iter().enumerate() {
                let l = (k as f64).sqrt() as i32;
                let expected = harmonic(l, k as i32 - l * l - l, direction);
                assert!((value - expected).abs() < 1e-7, "function {k} at {direction}: {value}, expected {expected}");
            }
        }
    }

    #[test]
    fn a_colour_depends_on_the_side_it_is_seen_from() {
        let mut model = Gaussians::with_sh_degree(1);
        let gaussian = crate::Gaussian {
            mean: Vec3::new(1.0, 0.0, 0.0),
            log_scales: Vec3::splat(-3.0),
            rotation: glam::Quat::IDENTITY,
            opacity_logit: 0.0,
            sh: [0.0; 3],
            id: 0,
            birth_round: 0,
        };
        model.push(&gaussian);
        let mut rest = [[0.0; 3]; SH_REST_MAX];
        rest[2] = [-1.0, 0.0, 1.0];
        model.set_sh_rest(0, &rest);
        // Seen along +x, the third function of degree 1 is -C1.
        let c1 = C1 as f32;
        let near = |a: [f32; 3], b: [f32; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
        assert!(near(model.color_from(0, Vec3::ZERO), [0.5 + c1, 0.5, 0.5 - c1]));
        assert!(near(model.color_from(0, Vec3::X * 2.0), [0.5 - c1, 0.5, 0.5 + c1]));
        assert!(near(model.color_from(0, Vec3::X), [0.5; 3]), "no direction");
    }
}
