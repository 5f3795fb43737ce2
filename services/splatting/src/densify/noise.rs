//! Noise of 3DGS-MCMC on the means: what turns gradient descent into sampling (Kheradmand et al. 2024, equations 8, 9).
//!
//! mean += Σ η, with Σ the Gaussian's covariance and η normal numbers times the learning rate, the noise rate and a gate
//! that lets noise through where opacity is near 0. The numbers are a hash of seed, iteration and id, so that they depend
//! neither on threads nor on the order of the model.

#![expect(unsafe_code, reason = "tasks write disjoint parts of shared buffers")]

use super::mcmc::McmcSettings;
use crate::model::{Block, Gaussians, LANES, ROW_LOG_SCALE, ROW_MEAN, ROW_OPACITY, ROW_ROTATION};
use crate::projection::{VALUE_MAX, rotation_matrix};
use crate::random::Random;
use crate::simd::{Isa, Kernel, Simd, build, dispatch};
use crate::workers::{Shared, Workers};

/// Blocks of 16 Gaussians that one task moves.
const CHUNK_BLOCKS: usize = 64;
/// Noise that moves a Gaussian by less than this part of its largest standard deviation is left out: even all of a run's
/// 30,000 moves together stay below 0.2 % of it. Most Gaussians of a trained model are so opaque.
const NEGLIGIBLE: f32 = 1e-5;
/// Largest argument of an exponential, far from where it overflows.
const EXPONENT_MAX: f32 = 80.0;

/// Noise of one iteration.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Noise {
    /// Learning rate times noise rate.
    pub rate: f32,
    pub opacity: f32,
    pub sharpness: f32,
    pub key: [u32; 2],
}

impl Noise {
    pub(crate) fn new(settings: &McmcSettings, lr_means: f32, seed: u64, iteration: u32) -> Self {
        // Two rounds, so that neighbouring seeds and iterations have nothing in common.
        let key = Random(Random(seed).bits() ^ u64::from(iteration)).bits();
        Self {
            rate: settings.noise_rate * lr_means,
            opacity: settings.noise_opacity,
            sharpness: settings.noise_sharpness,
            key: [key as u32, (key >> 32) as u32],
        }
    }
}

impl Noise {
    /// Moves the means.
    pub(crate) fn add_to(&self, model: &mut Gaussians, isa: Isa, workers: &Workers) {
        let (blocks, ids) = model.blocks_mut_and_ids();
        let (count, total) = (blocks.len(), ids.len());
        let blocks = Shared::new(blocks);
        workers.run(count.div_ceil(CHUNK_BLOCKS), |_, chunk| {
            let range = chunk * CHUNK_BLOCKS..count.min((chunk + 1) * CHUNK_BLOCKS);
            let ids = &ids[range.start * LANES..total.min(range.end * LANES)];
            // SAFETY: the ranges of different chunks do not overlap.
            let blocks = unsafe { blocks.slice_mut(range) };
            dispatch(isa, NoiseChunk { noise: self, blocks, ids });
        });
    }
}

struct NoiseChunk<'a> {
    noise: &'a Noise,
    blocks: &'a mut [Block],
    /// As many as there are Gaussians, which may end inside of the last block.
    ids: &'a [u64],
}

impl Kernel for NoiseChunk<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        for (block, ids) in self.blocks.iter_mut().zip(self.ids.chunks(LANES)) {
            move_block(s, self.noise, block, ids);
        }
    }
}

#[inline(always)]
fn move_block<S: Simd>(s: S, noise: &Noise, block: &mut Block, ids: &[u64]) {
    let (zero, one) = (s.splat(0.0), s.splat(1.0));
    let opacity = s.div(one, s.add(one, s.exp(s.sub(zero, s.load(&block.0[ROW_OPACITY].0)))));
    let exponent = s.mul(s.splat(noise.sharpness), s.sub(opacity, s.splat(noise.opacity)));
    let gate = s.div(one, s.add(one, s.exp(s.min(exponent, s.splat(EXPONENT_MAX)))));
    let amplitude = s.mul(gate, s.splat(noise.rate));
    let scales = build!(zero; 3; |k| s.exp(s.load(&block.0[ROW_LOG_SCALE + k].0)));
    let largest = s.max(s.max(scales[0], scales[1]), scales[2]);
    let mut lanes = s.gt(s.mul(amplitude, largest), s.splat(NEGLIGIBLE));
    if s.bits(lanes) == 0 {
        return;
    }
    let eta = normal(s, noise, ids);
    let quat = build!(zero; 4; |i| s.load(&block.0[ROW_ROTATION + i].0));
    let mut length2 = zero;
    for c in quat {
        length2 = s.fma(c, c, length2);
    }
    let inverse = s.div(one, s.sqrt(length2));
    let quat = build!(zero; 4; |i| s.mul(quat[i], inverse));
    let rotation = rotation_matrix(s, &quat);
    // Σ η = R diag(s²) Rᵀ η
    let mut along = [zero; 3];
    for k in 0..3 {
        for i in 0..3 {
            along[k] = s.fma(rotation[i][k], eta[i], along[k]);
        }
        along[k] = s.mul(s.mul(along[k], amplitude), s.mul(scales[k], scales[k]));
    }
    let mut new = build!(zero; 3; |i| s.load(&block.0[ROW_MEAN + i].0));
    let mut size = zero;
    for i in 0..3 {
        for k in 0..3 {
            new[i] = s.fma(rotation[i][k], along[k], new[i]);
        }
        size = s.add(size, s.abs(new[i]));
    }
    // What is broken, or would be, stays.
    lanes = s.and(lanes, s.gt(s.splat(VALUE_MAX), size));
    for i in 0..3 {
        let old = s.load(&block.0[ROW_MEAN + i].0);
        s.store(s.select(lanes, new[i], old), &mut block.0[ROW_MEAN + i].0);
    }
}

/// Three normal numbers per lane (Box-Muller).
#[inline(always)]
fn normal<S: Simd>(s: S, noise: &Noise, ids: &[u64]) -> [S::F; 3] {
    let zero = s.splat(0.0);
    let mut hash = [0_u32; LANES];
    for (hash, &id) in hash.iter_mut().zip(ids) {
        *hash = mix(mix(id as u32 ^ noise.key[0]) ^ (id >> 32) as u32 ^ noise.key[1]);
    }
    let mut uniform = [zero; 4];
    for (k, uniform) in uniform.iter_mut().enumerate() {
        let mut values = [0.0; LANES];
        for (value, &hash) in values.iter_mut().zip(&hash) {
            let bits = mix(hash.wrapping_add((k as u32 + 1).wrapping_mul(0x9e37_79b9)));
            *value = (bits >> 8) as f32 * (1.0 / (1_u32 << 24) as f32);
        }
        *uniform = s.load(&values);
    }
    let (cos, sin) = cos_sin_turns(s, uniform[1]);
    let first = radius(s, uniform[0]);
    let (third, _) = cos_sin_turns(s, uniform[3]);
    [s.mul(first, cos), s.mul(first, sin), s.mul(radius(s, uniform[2]), third)]
}

/// √(-2 ln(1 - u))
#[inline(always)]
fn radius<S: Simd>(s: S, u: S::F) -> S::F {
    let log2 = s.log2(s.sub(s.splat(1.0), u));
    s.sqrt(s.max(s.mul(s.splat(-2.0 * std::f32::consts::LN_2), log2), s.splat(0.0)))
}

/// Cosine and sine of 2π (u - 1/2), which are as well distributed as those of 2π u; error below 2e-5. By series for
/// half the angle, which lies within a right angle of 0, and the formulas of the double angle.
#[inline(always)]
fn cos_sin_turns<S: Simd>(s: S, u: S::F) -> (S::F, S::F) {
    let x = s.mul(s.sub(u, s.splat(0.5)), s.splat(std::f32::consts::PI));
    let x2 = s.mul(x, x);
    let (mut sin, mut cos) = (s.splat(1.0 / 362_880.0), s.splat(-1.0 / 3_628_800.0));
    for c in [-1.0 / 5040.0, 1.0 / 120.0, -1.0 / 6.0, 1.0] {
        sin = s.fma(sin, x2, s.splat(c));
    }
    for c in [1.0 / 40_320.0, -1.0 / 720.0, 1.0 / 24.0, -0.5, 1.0] {
        cos = s.fma(cos, x2, s.splat(c));
    }
    sin = s.mul(sin, x);
    let twice = s.add(sin, sin);
    (s.fnma(twice, sin, s.splat(1.0)), s.mul(twice, cos))
}

/// A bijection of 32 bits in which every bit of the input moves half of the output's (Wellons' `lowbias32`).
#[inline(always)]
fn mix(mut x: u32) -> u32 {
    x = (x ^ x >> 16).wrapping_mul(0x7feb_352d);
    x = (x ^ x >> 15).wrapping_mul(0x846c_a68b);
    x ^ x >> 16
}
