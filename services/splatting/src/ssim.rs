//! Structural similarity with an 11x11 Gaussian window (sigma 1.5), forward and backward, on tiled images.
//!
//! The window is separable and symmetric: a pass adds the pairs of taps first, and keeps fourteen rows in registers for
//! four of the result. It goes along columns of vectors; a transpose of 16x16 pixels makes rows of them, which is
//! cheaper than loads that cross cache lines. A strip (a row of tiles) takes the forward pass along y and x and the
//! backward pass along x; what remains, along y, needs the strips beside it and is done per tile, by
//! [`similarity_gradient`].
//!
//! Outside of the image everything is 0, as the reference implementations pad. Tiles without foreground around them
//! show the same grey in both images: their similarity is 1 and its gradient 0, without computing either.

use crate::frame::{Plane, TILE};
use crate::model::Lanes;
use crate::simd::{Kernel, Simd, build};
use crate::view::TargetTile;

/// Half width of the window.
pub(crate) const RADIUS: usize = 5;
const TAPS: usize = 2 * RADIUS + 1;
/// Rows that a tile's result needs.
pub(crate) const SPAN: usize = TILE + 2 * RADIUS;
/// Rows of a result that share what is loaded.
const TOGETHER: usize = 4;
pub(crate) const C1: f32 = 0.01 * 0.01;
pub(crate) const C2: f32 = 0.03 * 0.03;

/// A tile of 16x16 numbers as vectors.
type Square = [Lanes; TILE];
const EMPTY: Lanes = Lanes([0.0; TILE]);

/// Derivatives of the summed SSIM of one channel by E[x], E[x²] and E[xy] around the pixels, smoothed along x.
pub(crate) type Maps = [Plane; 3];

/// Weights of the one-dimensional window; they sum to 1.
pub(crate) fn window() -> [f32; TAPS] {
    let weight = |i: usize| (-((i as f64 - RADIUS as f64).powi(2)) / (2.0 * 1.5 * 1.5)).exp();
    let sum: f64 = (0..TAPS).map(weight).sum();
    std::array::from_fn(|i| (weight(i) / sum) as f32)
}

/// What has to be computed for a tile.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Needed {
    /// The tile has foreground: its gradient is wanted.
    pub gradient: bool,
    /// A tile above, below or the tile itself does: the maps are wanted.
    pub maps: bool,
    /// It or a tile around it does: the similarity is not 1 everywhere.
    pub similarity: bool,
}

/// What has to be computed for each tile.
pub(crate) fn needed(target: &[TargetTile], (tiles_x, tiles_y): (usize, usize), out: &mut Vec<Needed>) {
    out.clear();
    out.extend(
        target.iter().map(|tile| Needed { gradient: tile.foreground.iter().any(|&row| row != 0), ..Needed::default() }),
    );
    for ty in 0..tiles_y {
        for tx in 0..tiles_x {
            let any = |columns: std::ops::RangeInclusive<usize>| {
                let rows = ty.saturating_sub(1)..=(ty + 1).min(tiles_y - 1);
                rows.flat_map(|y| columns.clone().map(move |x| y * tiles_x + x)).any(|tile| out[tile].gradient)
            };
            let (maps, similarity) = (any(tx..=tx), any(tx.saturating_sub(1)..=(tx + 1).min(tiles_x - 1)));
            let tile = &mut out[ty * tiles_x + tx];
            (tile.maps, tile.similarity) = (maps, similarity);
        }
    }
}

/// The six weights of the symmetric window, in all lanes.
#[inline(always)]
fn half_window<S: Simd>(s: S, window: &[f32; TAPS]) -> [S::F; RADIUS + 1] {
    build!(s.splat(0.0); RADIUS + 1; |k| s.splat(window[RADIUS + k]))
}

/// One pass: row y of the result is the window over rows y to y + 10 of `from`.
#[inline(always)]
fn smooth<S: Simd>(s: S, window: &[S::F; RADIUS + 1], from: &[Lanes; SPAN], to: &mut Square) {
    for start in (0..TILE).step_by(TOGETHER) {
        let near = build!(s.splat(0.0); TOGETHER + 2 * RADIUS; |i| s.load(&from[start + i].0));
        for i in 0..TOGETHER {
            let mut sum = s.mul(window[0], near[i + RADIUS]);
            for k in 1..=RADIUS {
                sum = s.fma(window[k], s.add(near[i + RADIUS - k], near[i + RADIUS + k]), sum);
            }
            s.store(sum, &mut to[start + i].0);
        }
    }
}

/// Turns rows into columns.
#[inline(always)]
fn transpose<S: Simd>(s: S, square: &mut Square) {
    let mut rows = build!(s.splat(0.0); TILE; |i| s.load(&square[i].0));
    s.transpose(&mut rows);
    for i in 0..TILE {
        s.store(rows[i], &mut square[i].0);
    }
}

/// Memory of a worker: columns of a strip, a vector being 16 rows of one column, with 16 columns of zeros on both sides.
#[derive(Default)]
pub(crate) struct Scratch {
    columns: [Vec<Lanes>; 5],
    maps: [Vec<Lanes>; 3],
}

impl Scratch {
    fn clear(&mut self, tiles_x: usize) {
        for column in self.columns.iter_mut().chain(&mut self.maps) {
            column.clear();
            column.resize((tiles_x + 2) * TILE, EMPTY);
        }
    }
}

/// The columns of tile `tx` and the five on each side of it.
#[inline(always)]
fn around(columns: &[Lanes], tx: usize) -> &[Lanes; SPAN] {
    // In range for every tile of the strip, because of the columns of zeros.
    columns[(tx + 1) * TILE - RADIUS..].first_chunk().unwrap_or(&[EMPTY; SPAN])
}

/// The columns of tile `tx`.
#[inline(always)]
fn tile_columns(columns: &mut [Lanes], tx: usize) -> &mut [Lanes] {
    &mut columns[(tx + 1) * TILE..][..TILE]
}

/// Row `i` of the span around the row of tiles `ty`: its tile and row inside it; `None` outside of the image.
#[inline(always)]
fn span_row((tiles_x, tiles_y): (usize, usize), (tx, ty): (usize, usize), i: usize) -> Option<(usize, usize)> {
    let y = (ty * TILE + i).checked_sub(RADIUS).filter(|&y| y < tiles_y * TILE)?;
    Some((y / TILE * tiles_x + tx, y % TILE))
}

/// Forward pass of a strip, and the half of the backward pass that stays inside of it.
pub(crate) struct Strip<'a> {
    pub window: &'a [f32; TAPS],
    pub tiles: (usize, usize),
    pub ty: usize,
    /// Image size, pixels.
    pub size: (usize, usize),
    /// Composited rendered image, all tiles.
    pub rendered: &'a [[Plane; 3]],
    pub target: &'a [TargetTile],
    pub needed: &'a [Needed],
    pub scratch: &'a mut Scratch,
    /// Maps of this strip, by tile and channel; those of tiles that do not need them keep what they had.
    pub maps: &'a mut [[Maps; 3]],
}

impl Kernel for Strip<'_> {
    /// Sum of the similarity over the strip's pixels and channels.
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(mut self, s: S) -> f64 {
        let tiles_x = self.tiles.0;
        let needed = &self.needed[self.ty * tiles_x..(self.ty + 1) * tiles_x];
        let rows = (self.size.1 - self.ty * TILE).min(TILE);
        let width = self.size.0;
        let columns = |tx: usize| (width - tx * TILE).min(TILE);
        let equal: usize = (0..tiles_x).filter(|&tx| !needed[tx].similarity).map(columns).sum();
        let mut total = (3 * rows * equal) as f64;
        if equal == width {
            return total;
        }
        let window = half_window(s, self.window);
        for channel in 0..3 {
            self.scratch.clear(tiles_x);
            for tx in 0..tiles_x {
                let beside = &needed[tx.saturating_sub(1)..(tx + 2).min(tiles_x)];
                if beside.iter().any(|n| n.similarity) {
                    self.along_y(s, &window, tx, channel);
                }
            }
            for tx in (0..tiles_x).filter(|&tx| needed[tx].similarity) {
                let sum = self.along_x(s, &window, tx, (rows, columns(tx)));
                total += crate::loss::sum(s, sum);
            }
            for tx in (0..tiles_x).filter(|&tx| needed[tx].maps) {
                for (columns, map) in self.scratch.maps.iter().zip(&mut self.maps[tx][channel]) {
                    let mut square = [EMPTY; TILE];
                    smooth(s, &window, around(columns, tx), &mut square);
                    transpose(s, &mut square);
                    for (to, row) in map.0.chunks_exact_mut(TILE).zip(&square) {
                        to.copy_from_slice(&row.0);
                    }
                }
            }
        }
        total
    }
}

impl Strip<'_> {
    /// Smooths the five quantities of a tile along y and leaves them as columns.
    #[inline(always)]
    fn along_y<S: Simd>(&mut self, s: S, window: &[S::F; RADIUS + 1], tx: usize, channel: usize) {
        let mut spans = [[EMPTY; SPAN]; 5];
        for i in 0..SPAN {
            if let Some((tile, y)) = span_row(self.tiles, (tx, self.ty), i) {
                let x = s.load(self.rendered[tile][channel].row(y));
                let t = s.load(self.target[tile].color[channel].row(y));
                let quantities = [x, s.mul(x, x), s.mul(x, t), t, s.mul(t, t)];
                for q in 0..5 {
                    s.store(quantities[q], &mut spans[q][i].0);
                }
            }
        }
        for (span, columns) in spans.iter().zip(&mut self.scratch.columns) {
            let mut square = [EMPTY; TILE];
            smooth(s, window, span, &mut square);
            transpose(s, &mut square);
            tile_columns(columns, tx).copy_from_slice(&square);
        }
    }

    /// Smooths along x, gives the sum of the similarity and leaves its derivatives as columns.
    #[inline(always)]
    fn along_x<S: Simd>(
        &mut self,
        s: S,
        window: &[S::F; RADIUS + 1],
        tx: usize,
        (rows, columns): (usize, usize),
    ) -> S::F {
        let mut means = [[EMPTY; TILE]; 5];
        for (columns, means) in self.scratch.columns.iter().zip(&mut means) {
            smooth(s, window, around(columns, tx), means);
        }
        let inside = s.mask(((1_u32 << rows) - 1) as u16);
        let mut sum = s.splat(0.0);
        for x in 0..columns {
            let (similarity, derivatives) = similarity(s, build!(sum; 5; |q| s.load(&means[q][x].0)));
            sum = s.add(sum, s.keep(inside, similarity));
            for (map, d) in self.scratch.maps.iter_mut().zip(derivatives) {
                s.store(s.keep(inside, d), &mut tile_columns(map, tx)[x].0);
            }
        }
        sum
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

/// Gradient of the summed similarity by one channel of a tile of the rendered image: the pass along y over the maps of
/// the tile and the tiles above and below it.
#[inline(always)]
pub(crate) fn similarity_gradient<S: Simd>(
    s: S,
    window: &[f32; TAPS],
    maps: [Option<&Maps>; 3],
    rendered: &Plane,
    target: &Plane,
    out: &mut Square,
) {
    let window = half_window(s, window);
    let mut smoothed = [[EMPTY; TILE]; 3];
    for q in 0..3 {
        let mut span = [EMPTY; SPAN];
        let rows = [TILE - RADIUS..TILE, 0..TILE, 0..RADIUS];
        let mut to = span.iter_mut();
        for (maps, rows) in maps.iter().zip(rows) {
            for (row, to) in rows.zip(&mut to) {
                if let Some(maps) = maps {
                    s.store(s.load(maps[q].row(row)), &mut to.0);
                }
            }
        }
        smooth(s, &window, &span, &mut smoothed[q]);
    }
    for y in 0..TILE {
        let [mean, variance, covariance] = build!(s.splat(0.0); 3; |q| s.load(&smoothed[q][y].0));
        let (x, t) = (s.load(rendered.row(y)), s.load(target.row(y)));
        s.store(s.fma(s.add(x, x), variance, s.fma(t, covariance, mean)), &mut out[y].0);
    }
}
