//! Backward blending of one 16x16 tile.
//!
//! Front to back over the contributors that the forward pass saved, recomputing alphas (saving them measured slower).
//! For a splat with alpha a, transmittance T before it and c = Σ_k g_k f_k (upstream gradients times its channels):
//! dL/da = T c - R / (1 - a), where R is the sum of weight times c over everything behind it, less g_A times the
//! final transmittance. R starts as the sum over all, known from the forward pass, and shrinks; nothing is divided by T.
//!
//! With h = a dL/da, a splat's gradient is determined by ten moments over pixels: h, h dx, h dy, h dx², h dx dy, h dy²,
//! and weight times upstream gradient of each channel. They are summed per (tile, splat).

use crate::blend::{BLOCKS, Contributors, alpha_at, block_pixels, prefetch};
use crate::frame::{CHANNELS, LAST, Row, TILE, TilePixels};
use crate::model::Lanes;
use crate::simd::{Kernel, Simd, build};

/// Number of moments; the other lanes of a row stay 0.
pub(crate) const MOMENTS: usize = 10;
const PREFETCH: usize = 16;
/// Splats whose alphas are evaluated together.
const TOGETHER: usize = 2;
/// How many contributors ahead rows and sums are asked for: a tile's do not fit the first-level cache.
const AHEAD: usize = 4;

/// Memory of a worker, and after a run the tile's result.
#[derive(Default)]
pub(crate) struct Scratch {
    rows: Vec<Row>,
    /// Moments by position in the tile's list.
    pub sums: Vec<Row>,
    /// Whether a position has any.
    pub touched: Vec<bool>,
}

pub(crate) struct BackwardTile<'a> {
    pub origin: [usize; 2],
    pub entries: &'a [u32],
    pub rows: &'a [Row],
    pub contributors: &'a Contributors,
    /// What the forward pass gave.
    pub pixels: &'a TilePixels,
    /// Gradients of the four channels (before the background) and of alpha.
    pub gradients: &'a TilePixels,
    pub alpha_min: f32,
    pub scratch: &'a mut Scratch,
}

impl Kernel for BackwardTile<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let used = self.contributors.used;
        let scratch = self.scratch;
        scratch.rows.clear();
        scratch.rows.extend(self.entries[..used].iter().enumerate().map(|(i, &g)| {
            prefetch(self.entries.get(i + PREFETCH).map(|&g| &self.rows[g as usize]));
            self.rows[g as usize]
        }));
        scratch.sums.clear();
        scratch.sums.resize(used, Lanes([0.0; 16]));
        scratch.touched.clear();
        scratch.touched.resize(used, false);
        let rows = &scratch.rows[..];
        let sums = &mut scratch.sums[..used];
        let touched = &mut scratch.touched[..used];
        let alpha_min = s.splat(self.alpha_min);
        let one = s.splat(1.0);

        for block in 0..BLOCKS {
            let list = &self.contributors.lists[block];
            if list.is_empty() {
                continue;
            }
            let (px, py, at) = block_pixels(s, self.origin, block);
            let upstream = build!(one; 4; |k| s.load_4x4(&self.gradients[k].0, at, TILE));
            let upstream_alpha = s.load_4x4(&self.gradients[LAST].0, at, TILE);
            let last = s.load_4x4(&self.pixels[LAST].0, at, TILE);
            let mut behind = s.mul(s.sub(s.splat(0.0), upstream_alpha), last);
            for k in 0..4 {
                behind = s.fma(upstream[k], s.load_4x4(&self.pixels[k].0, at, TILE), behind);
            }
            let mut transmittance = one;
            for (i, pair) in list.chunks(TOGETHER).enumerate() {
                for ahead in 0..TOGETHER {
                    if let Some(&next) = list.get(i * TOGETHER + AHEAD + ahead) {
                        prefetch(rows.get(next as usize));
                        prefetch(sums.get(next as usize));
                    }
                }
                // The alphas do not depend on each other; an odd end evaluates its last splat twice and uses it once.
                let at = build!(pair[0] as usize; TOGETHER; |j| pair[j.min(pair.len() - 1)] as usize);
                let alphas = build!((one, one, one); TOGETHER; |j| {
                    let (dx, dy, alpha, _) = alpha_at(s, &rows[at[j]].0, px, py, alpha_min);
                    (dx, dy, alpha)
                });
                for j in 0..pair.len().min(TOGETHER) {
                    let (position, (dx, dy, alpha)) = (at[j], alphas[j]);
                    let row = &rows[position].0;
                    let weight = s.mul(transmittance, alpha);
                    let mut value = s.mul(upstream[0], s.splat(row[CHANNELS]));
                    for k in 1..4 {
                        value = s.fma(upstream[k], s.splat(row[CHANNELS + k]), value);
                    }
                    behind = s.fnma(weight, value, behind);
                    let hidden = s.mul(behind, s.reciprocal_14(s.sub(one, alpha)));
                    let h = s.mul(alpha, s.sub(s.mul(transmittance, value), hidden));
                    transmittance = s.sub(transmittance, weight);
                    let (hx, hy) = (s.mul(h, dx), s.mul(h, dy));
                    let moments = [
                        h,
                        hx,
                        hy,
                        s.mul(hx, dx),
                        s.mul(hx, dy),
                        s.mul(hy, dy),
                        s.mul(weight, upstream[0]),
                        s.mul(weight, upstream[1]),
                        s.mul(weight, upstream[2]),
                        s.mul(weight, upstream[3]),
                    ];
                    let sum = &mut sums[position].0;
                    let total = s.add(s.load(sum), s.sum_rows_10(&moments));
                    s.store(total, sum);
                    touched[position] = true;
                }
            }
        }
    }
}
