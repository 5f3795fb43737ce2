//! Backward blending of one 16x16 tile.
//!
//! Front to back over the contributors that the forward pass saved, recomputing alphas (saving them measured slower).
//! For a splat with alpha a, transmittance T before it and c = Σ_k g_k f_k (upstream gradients times its channels):
//! dL/da = T c - R / (1 - a), where R is the sum of weight times c over everything behind it, less g_A times the
//! final transmittance. R starts as the sum over all, known from the forward pass, and shrinks; nothing is divided by T.
//!
//! With h = a dL/da, a splat's gradient is determined by ten moments over pixels: h, h dx, h dy, h dx², h dx dy, h dy²,
//! and weight times upstream gradient of each channel. They are summed per (tile, splat).
//!
//! The sums over a block's pixels are taken for four splats at once: a transpose inside the rows of the block puts the
//! splats side by side in the lanes, so that sums along rows are plain additions, powers of dx and dy come in last, and
//! only the sum over the four rows needs shuffles.

use crate::blend::{BLOCKS, Contributors, alpha_at, block_pixels, prefetch};
use crate::frame::{CHANNELS, LAST, LOG2_ALPHA, Row, TILE, TilePixels, X, Y};
use crate::model::Lanes;
use crate::simd::{Kernel, Simd, build};

/// Number of moments; the other lanes of a row are 0, but for [`TOUCHED`].
pub(crate) const MOMENTS: usize = 10;
/// Lane of a sum that is positive where the splat changed a pixel.
pub(crate) const TOUCHED: usize = 10;
const PREFETCH: usize = 24;
/// Splats evaluated and reduced together.
const TOGETHER: usize = 4;
/// How many contributors ahead rows and sums are asked for: a tile's do not fit the first-level cache.
const AHEAD: usize = 8;

/// Memory of a worker.
#[derive(Default)]
pub(crate) struct Scratch {
    /// Rows of the tile's list, and one that changes nothing.
    pub rows: Vec<Row>,
    /// Result: moments by position in the tile's list as far as it was used, and of the row that changes nothing.
    pub sums: Vec<Row>,
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

/// What a block's pixels need.
struct BlockState<S: Simd> {
    px: S::F,
    py: S::F,
    upstream: [S::F; 4],
    /// Upstream gradient of channel k in column i, in all lanes of its row.
    columns: [[S::F; 4]; 4],
    /// y of each row of pixels, in all lanes of the row.
    rows_y: S::F,
    /// x of the block's centre.
    centre_x: f32,
    alpha_min: S::F,
    transmittance: S::F,
    behind: S::F,
}

impl Kernel for BackwardTile<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let used = self.contributors.used;
        let scratch = self.scratch;
        let nothing = s.splat(0.0);
        let length = (used + 1).max(scratch.rows.len());
        scratch.rows.resize(length, Lanes([0.0; 16]));
        scratch.sums.resize(length, Lanes([0.0; 16]));
        let rows = &mut scratch.rows[..=used];
        let sums = &mut scratch.sums[..=used];
        for (i, (&gaussian, (row, sum))) in self.entries.iter().zip(rows.iter_mut().zip(sums.iter_mut())).enumerate() {
            prefetch(self.entries.get(i + PREFETCH).map(|&g| &self.rows[g as usize]));
            s.store(s.load(&self.rows[gaussian as usize].0), &mut row.0);
            s.store(nothing, &mut sum.0);
        }
        rows[used] = Lanes([0.0; 16]);
        rows[used].0[LOG2_ALPHA] = -200.0;
        sums[used] = Lanes([0.0; 16]);
        let rows = &*rows;
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
            let top = (self.origin[1] + block / 4 * 4) as f32 + 0.5;
            let mut state = BlockState::<S> {
                px,
                py,
                upstream,
                columns: build!([one; 4]; 4; |k| build!(one; 4; |i| s.spread(upstream[k], i))),
                rows_y: s.splat_groups([top, top + 1.0, top + 2.0, top + 3.0]),
                centre_x: (self.origin[0] + block % 4 * 4) as f32 + 2.0,
                alpha_min: s.splat(self.alpha_min),
                transmittance: one,
                behind,
            };
            for (step, four) in list.chunks(TOGETHER).enumerate() {
                for ahead in 0..TOGETHER {
                    if let Some(&next) = list.get(step * TOGETHER + AHEAD + ahead) {
                        prefetch(rows.get(next as usize));
                        prefetch(sums.get(next as usize));
                    }
                }
                // An odd end is filled up with the row that changes nothing.
                let at = build!(used; TOGETHER; |j| if j < four.len() { four[j] as usize } else { used });
                let rows = build!(&rows[0].0; TOGETHER; |j| &rows[at[j]].0);
                let moments = four_splats(s, &mut state, rows);
                for j in 0..TOGETHER {
                    let sum = &mut sums[at[j]].0;
                    s.store(s.add(s.load(sum), moments[j]), sum);
                }
            }
        }
    }
}

/// Goes past four splats and gives the sums over the block's pixels of their ten moments, and of 1.
#[inline(always)]
fn four_splats<S: Simd>(s: S, state: &mut BlockState<S>, rows: [&[f32; 16]; TOGETHER]) -> [S::F; TOGETHER] {
    let one = s.splat(1.0);
    // The alphas do not depend on each other.
    let alphas = build!(one; TOGETHER; |j| alpha_at(s, rows[j], state.px, state.py, state.alpha_min).0);
    let mut h = [one; TOGETHER];
    let mut weights = [one; TOGETHER];
    for j in 0..TOGETHER {
        let (row, alpha) = (rows[j], alphas[j]);
        let weight = s.mul(state.transmittance, alpha);
        let mut value = s.mul(state.upstream[0], s.splat(row[CHANNELS]));
        for k in 1..4 {
            value = s.fma(state.upstream[k], s.splat(row[CHANNELS + k]), value);
        }
        state.behind = s.fnma(weight, value, state.behind);
        let shown = s.mul(state.transmittance, value);
        h[j] = s.mul(alpha, s.fnma(state.behind, s.reciprocal_14(s.sub(one, alpha)), shown));
        weights[j] = weight;
        state.transmittance = s.sub(state.transmittance, weight);
    }

    // Lanes are now (row of pixels, splat), vectors are columns of pixels.
    let h = s.transpose_groups(h);
    let (outer, inner) = (s.add(h[0], h[3]), s.add(h[1], h[2]));
    let sum = s.add(outer, inner);
    // First and second moment about the block's centre: columns lie 1.5 and 0.5 pixels from it.
    let first = s.fma(s.sub(h[3], h[0]), s.splat(1.5), s.mul(s.sub(h[2], h[1]), s.splat(0.5)));
    let second = s.fma(outer, s.splat(2.25), s.mul(inner, s.splat(0.25)));
    let dx = s.splat_four(build!(0.0; 4; |j| state.centre_x - rows[j][X]));
    let dy = s.sub(state.rows_y, s.splat_four(build!(0.0; 4; |j| rows[j][Y])));
    // About the splat's mean: sum of h (dx + c)^2 = second + dx (2 first + dx sum).
    let along = s.fma(dx, sum, first);
    let square = s.fma(dx, s.add(first, along), second);
    let across = s.mul(dy, sum);
    let turned = s.transpose_groups(weights);
    let channels = build!(one; 4; |k| {
        let columns = &state.columns[k];
        let low = s.fma(turned[1], columns[1], s.mul(turned[0], columns[0]));
        let high = s.fma(turned[3], columns[3], s.mul(turned[2], columns[2]));
        s.add(low, high)
    });
    s.rows_of_groups([
        s.sum_groups([sum, along, across, square]),
        s.sum_groups([s.mul(dy, along), s.mul(dy, across), channels[0], channels[1]]),
        s.sum_groups([channels[2], channels[3], one, s.splat(0.0)]),
    ])
}
