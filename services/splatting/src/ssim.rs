//! Structural similarity with an 11x11 Gaussian window (sigma 1.5), forward and backward, on tiled images.
//!
//! The window is separable: columns first, on rows of 16 pixels as tiles hold them, then along the row. Outside of the
//! image everything is 0, as the reference implementations pad. A task is a row of tiles.

use crate::frame::{Plane, TILE};
use crate::simd::{Kernel, Simd, build};
use crate::view::TargetTile;

/// Half width of the window.
const RADIUS: usize = 5;
const TAPS: usize = 2 * RADIUS + 1;
/// Rows that a row of tiles needs.
const SPAN: usize = TILE + 2 * RADIUS;
/// Floats on either side of a temporary row.
const PAD: usize = TILE;
pub(crate) const C1: f32 = 0.01 * 0.01;
pub(crate) const C2: f32 = 0.03 * 0.03;

/// Derivatives of the SSIM of one channel's pixels by E[x], E[x²] and E[xy] around them.
pub(crate) type Maps = [Plane; 3];

/// Weights of the one-dimensional window; they sum to 1.
pub(crate) fn window() -> [f32; TAPS] {
    let weight = |i: usize| (-((i as f64 - RADIUS as f64).powi(2)) / (2.0 * 1.5 * 1.5)).exp();
    let sum: f64 = (0..TAPS).map(weight).sum();
    std::array::from_fn(|i| (weight(i) / sum) as f32)
}

/// Memory of a worker: rows after the column pass, padded on both sides.
#[derive(Default)]
pub(crate) struct Scratch {
    rows: Vec<f32>,
}

impl Scratch {
    fn prepare(&mut self, quantities: usize, tiles_x: usize) -> usize {
        let stride = tiles_x * TILE + 2 * PAD;
        // Only the pads must be 0, and nothing else ever writes them; a new stride moves them.
        self.rows.clear();
        self.rows.resize(quantities * TILE * stride, 0.0);
        stride
    }
}

/// Column pass of one group of 16 columns: `Q` quantities of `SPAN` rows to `TILE` rows, into temporary rows at `at`.
#[inline(always)]
fn column_pass<S: Simd, const Q: usize>(
    s: S,
    window: &[f32; TAPS],
    column: &[[S::F; Q]; SPAN],
    rows: &mut [f32],
    stride: usize,
    at: usize,
) {
    for y in 0..TILE {
        let mut sums = [s.splat(0.0); Q];
        for (tap, weight) in window.iter().enumerate() {
            let weight = s.splat(*weight);
            for q in 0..Q {
                sums[q] = s.fma(weight, column[y + tap][q], sums[q]);
            }
        }
        for q in 0..Q {
            let from = (q * TILE + y) * stride + at;
            if let Some(to) = rows[from..].first_chunk_mut() {
                s.store(sums[q], to);
            }
        }
    }
}

/// Row pass at 16 pixels of one temporary row.
#[inline(always)]
fn row_pass<S: Simd>(s: S, window: &[f32; TAPS], rows: &[f32], at: usize) -> S::F {
    let near = &rows[at - RADIUS..at + RADIUS + TILE];
    let mut sum = s.splat(0.0);
    for (tap, weight) in window.iter().enumerate() {
        if let Some(x) = near[tap..].first_chunk() {
            sum = s.fma(s.splat(*weight), s.load(x), sum);
        }
    }
    sum
}

/// Tile and row inside it of row `i` of the span around the row of tiles `ty`; `None` outside of the image.
#[inline(always)]
fn span_row((tiles_x, tiles_y): (usize, usize), (tx, ty): (usize, usize), i: usize) -> Option<(usize, usize)> {
    let y = (ty * TILE + i).checked_sub(RADIUS).filter(|&y| y < tiles_y * TILE)?;
    Some((y / TILE * tiles_x + tx, y % TILE))
}

/// Forward: similarity of one row of tiles, its sum per channel, and the maps that the backward pass smooths.
pub(crate) struct SsimForward<'a> {
    pub window: &'a [f32; TAPS],
    pub tiles: (usize, usize),
    pub ty: usize,
    /// Composited rendered image, all tiles.
    pub rendered: &'a [[Plane; 3]],
    pub target: &'a [TargetTile],
    pub scratch: &'a mut Scratch,
    /// Maps of this row of tiles, by tile and channel.
    pub maps: &'a mut [[Maps; 3]],
}

impl Kernel for SsimForward<'_> {
    /// Sum of the similarity over the row's pixels and channels.
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> f64 {
        let (tiles_x, _) = self.tiles;
        let mut total = 0.0;
        for channel in 0..3 {
            let stride = self.scratch.prepare(5, tiles_x);
            let rows = &mut self.scratch.rows[..];
            for tx in 0..tiles_x {
                let mut column = [[s.splat(0.0); 5]; SPAN];
                for (i, quantities) in column.iter_mut().enumerate() {
                    if let Some((tile, y)) = span_row(self.tiles, (tx, self.ty), i) {
                        let x = s.load(self.rendered[tile][channel].row(y));
                        let t = s.load(self.target[tile].color[channel].row(y));
                        *quantities = [x, s.mul(x, x), s.mul(x, t), t, s.mul(t, t)];
                    }
                }
                column_pass(s, self.window, &column, rows, stride, PAD + tx * TILE);
            }
            for tx in 0..tiles_x {
                let inside = &self.target[self.ty * tiles_x + tx].inside;
                let maps = &mut self.maps[tx][channel];
                let mut sum = s.splat(0.0);
                for y in 0..TILE {
                    let means = build!(s.splat(0.0); 5; |q| row_pass(s, self.window, rows, (q * TILE + y) * stride + PAD + tx * TILE));
                    let inside = s.mask(inside[y]);
                    let (similarity, derivatives) = similarity(s, means);
                    sum = s.add(sum, s.keep(inside, similarity));
                    for (map, d) in maps.iter_mut().zip(derivatives) {
                        if let Some(to) = map.0[TILE * y..].first_chunk_mut() {
                            s.store(s.keep(inside, d), to);
                        }
                    }
                }
                total += crate::loss::sum(s, sum);
            }
        }
        total
    }
}

/// SSIM from windowed means of x, x², xt, t, t², and its derivatives by the first three.
#[inline(always)]
fn similarity<S: Simd>(s: S, [x, xx, xt, t, tt]: [S::F; 5]) -> (S::F, [S::F; 3]) {
    let two = s.splat(2.0);
    let (c1, c2) = (s.splat(C1), s.splat(C2));
    let variance_x = s.fnma(x, x, xx);
    let variance_t = s.fnma(t, t, tt);
    let covariance = s.fnma(x, t, xt);
    let a1 = s.fma(s.mul(two, x), t, c1);
    let a2 = s.fma(two, covariance, c2);
    let b1 = s.fma(x, x, s.fma(t, t, c1));
    let b2 = s.add(s.add(variance_x, variance_t), c2);
    let inv = s.div(s.splat(1.0), s.mul(b1, b2));
    let value = s.mul(s.mul(a1, a2), inv);
    let inv_b1 = s.mul(inv, b2);
    let inv_b2 = s.mul(inv, b1);
    let d_variance = s.sub(s.splat(0.0), s.mul(value, inv_b2));
    let d_covariance = s.mul(two, s.mul(a1, inv));
    // By the mean directly, and through the variance (-2 x) and the covariance (-t).
    let direct = s.mul(two, s.sub(s.mul(s.mul(t, a2), inv), s.mul(s.mul(x, value), inv_b1)));
    let d_mean = s.fnma(s.mul(two, x), d_variance, s.fnma(t, d_covariance, direct));
    (value, [d_mean, d_variance, d_covariance])
}

/// Backward: gradient of the summed similarity by the rendered image, for one row of tiles.
pub(crate) struct SsimBackward<'a> {
    pub window: &'a [f32; TAPS],
    pub tiles: (usize, usize),
    pub ty: usize,
    pub rendered: &'a [[Plane; 3]],
    pub target: &'a [TargetTile],
    /// All maps.
    pub maps: &'a [[Maps; 3]],
    pub scratch: &'a mut Scratch,
    /// Gradients of this row of tiles.
    pub gradients: &'a mut [[Plane; 3]],
}

impl Kernel for SsimBackward<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (tiles_x, _) = self.tiles;
        for channel in 0..3 {
            let stride = self.scratch.prepare(3, tiles_x);
            let rows = &mut self.scratch.rows[..];
            for tx in 0..tiles_x {
                let mut column = [[s.splat(0.0); 3]; SPAN];
                for (i, quantities) in column.iter_mut().enumerate() {
                    if let Some((tile, y)) = span_row(self.tiles, (tx, self.ty), i) {
                        let maps = &self.maps[tile][channel];
                        *quantities = build!(s.splat(0.0); 3; |q| s.load(maps[q].row(y)));
                    }
                }
                column_pass(s, self.window, &column, rows, stride, PAD + tx * TILE);
            }
            for tx in 0..tiles_x {
                let tile = self.ty * tiles_x + tx;
                for y in 0..TILE {
                    let [mean, variance, covariance] = build!(s.splat(0.0); 3; |q| row_pass(s, self.window, rows, (q * TILE + y) * stride + PAD + tx * TILE));
                    let x = s.load(self.rendered[tile][channel].row(y));
                    let t = s.load(self.target[tile].color[channel].row(y));
                    let gradient = s.fma(s.add(x, x), variance, s.fma(t, covariance, mean));
                    if let Some(to) = self.gradients[tx][channel].0[TILE * y..].first_chunk_mut() {
                        s.store(gradient, to);
                    }
                }
            }
        }
    }
}
