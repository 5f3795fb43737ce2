//! Forward blending of one 16x16 tile.
//!
//! Batches of splats are tested against the tile's sixteen 4x4 blocks at once (a lane is a block), which gives each
//! block a short list; then each block blends its list front to back with its 16 pixels in one vector and its
//! transmittance and channels in registers. Several splats are evaluated together, because only the transmittance is a
//! chain. A block stops when every transmittance is below the limit.

use crate::frame::{
    A, B_BY_A, B_BY_C, B2, C, CHANNELS, LAST, LOG2_ALPHA, Plane, Row, THRESHOLD, TILE, TilePixels, X, Y,
};
use crate::model::Lanes;
use crate::simd::{Kernel, Simd, build};

/// Splats tested against the blocks at a time.
const BATCH: usize = 256;
/// Room of a block's list: a batch, and what an append may write beyond its end.
const LIST: usize = BATCH + 16;
/// Splats evaluated together.
const TOGETHER: usize = 4;
/// Blocks of a tile.
pub(crate) const BLOCKS: usize = 16;
/// How many rows ahead memory is asked for.
const PREFETCH: usize = 24;

/// For each 4x4 block the splats that changed one of its pixels, as positions in the tile's list, nearest first.
#[derive(Default, Clone)]
pub(crate) struct Contributors {
    pub lists: [Vec<u32>; BLOCKS],
    /// Length of the tile's list that was read before all blocks had stopped.
    pub used: usize,
}

/// Memory of a worker.
pub(crate) struct Scratch {
    rows: Vec<Row>,
    lists: Box<[[u16; LIST]; BLOCKS]>,
}

impl Default for Scratch {
    fn default() -> Self {
        Self { rows: vec![Lanes([0.0; 16]); BATCH + 16], lists: Box::new([[0; LIST]; BLOCKS]) }
    }
}

/// What is blended.
#[derive(Clone, Copy)]
pub(crate) enum Channels {
    /// Red, green, blue, depth.
    Color,
    /// Depth minus a reference depth, and its square.
    Moments { reference_m: f32 },
}

pub(crate) struct BlendTile<'a> {
    /// Pixel of the tile's corner.
    pub origin: [usize; 2],
    /// Image size, pixels.
    pub size: [usize; 2],
    pub entries: &'a [u32],
    pub rows: &'a [Row],
    pub channels: Channels,
    pub alpha_min: f32,
    pub transmittance_min: f32,
    pub scratch: &'a mut Scratch,
    pub out: &'a mut TilePixels,
    pub contributors: Option<&'a mut Contributors>,
}

/// Asks for the cache line of a value before it is needed.
#[inline(always)]
pub(crate) fn prefetch<T>(value: Option<&T>) {
    #[cfg(target_arch = "x86_64")]
    if let Some(value) = value {
        #[expect(unsafe_code, reason = "a prefetch has no other form")]
        // SAFETY: a hint for an address inside a live reference; SSE is part of every x86-64.
        unsafe {
            use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
            _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(value).cast());
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _no_prefetch = value;
}

/// Pixel-centre coordinates of a 4x4 block, and where it begins in a plane.
#[inline(always)]
pub(crate) fn block_pixels<S: Simd>(s: S, origin: [usize; 2], block: usize) -> (S::F, S::F, usize) {
    let (bx, by) = (block % 4 * 4, block / 4 * 4);
    let x = (origin[0] + bx) as f32 + 0.5;
    let y = (origin[1] + by) as f32 + 0.5;
    let columns = build!(0.0; 16; |i| x + (i % 4) as f32);
    let lines = build!(0.0; 16; |i| y + (i / 4) as f32);
    (s.load(&columns), s.load(&lines), by * TILE + bx)
}

/// Alpha of one splat at 16 pixels, and where it counts; it is 0 where it does not.
#[inline(always)]
pub(crate) fn alpha_at<S: Simd>(s: S, row: &[f32; 16], px: S::F, py: S::F, alpha_min: S::F) -> (S::F, S::M) {
    let dx = s.sub(px, s.splat(row[X]));
    let dy = s.sub(py, s.splat(row[Y]));
    let along_x = s.fma(dy, s.splat(row[B2]), s.mul(dx, s.splat(row[A])));
    let along_y = s.mul(dy, s.splat(row[C]));
    let exponent = s.fnma(dx, along_x, s.splat(row[LOG2_ALPHA]));
    let exponent = s.fnma(dy, along_y, exponent);
    let alpha = s.exp2_fast(exponent);
    let counts = s.ge(alpha, alpha_min);
    (s.keep(counts, alpha), counts)
}

/// The nearest pixel centre of the four from `low` on.
#[inline(always)]
fn clamp<S: Simd>(s: S, x: S::F, low: f32) -> S::F {
    s.min(s.max(x, s.splat(low)), s.splat(low + 3.0))
}

impl Kernel for BlendTile<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(mut self, s: S) {
        for plane in self.out[..LAST].iter_mut() {
            *plane = Plane::ZERO;
        }
        self.out[LAST] = Plane([1.0; 256]);
        let mut contributors = self.contributors.take();
        if let Some(c) = contributors.as_deref_mut() {
            c.lists.iter_mut().for_each(Vec::clear);
            c.used = 0;
        }
        // Blocks that begin outside of the image have nothing to do.
        let mut alive = 0_u16;
        for block in 0..BLOCKS {
            let inside = self.origin[0] + block % 4 * 4 < self.size[0] && self.origin[1] + block / 4 * 4 < self.size[1];
            alive |= u16::from(inside) << block;
        }
        let mut done = 0;
        while done < self.entries.len() && alive != 0 {
            let batch = &self.entries[done..self.entries.len().min(done + BATCH)];
            let counts = self.gather(s, batch, alive);
            for (block, &count) in counts.iter().enumerate() {
                if alive >> block & 1 == 0 || count == 0 {
                    continue;
                }
                let saved = contributors.as_deref_mut().map(|c| &mut c.lists[block]);
                let stopped = match self.channels {
                    Channels::Color => self.blend::<S, 4>(s, block, count, saved, done),
                    Channels::Moments { .. } => self.blend::<S, 2>(s, block, count, saved, done),
                };
                alive &= !(u16::from(stopped) << block);
            }
            done += batch.len();
        }
        if let Some(c) = contributors {
            c.used = done;
        }
    }
}

impl BlendTile<'_> {
    /// Copies a batch's rows next to each other and lists, for each living block, the splats that reach it.
    ///
    /// Sixteen splats are tested against one block at a time: what depends on the column or the row of blocks alone is
    /// shared by four tests, and a comparison is the list's selection.
    #[inline(always)]
    fn gather<S: Simd>(&mut self, s: S, batch: &[u32], alive: u16) -> [usize; BLOCKS] {
        let mut counts = [0; BLOCKS];
        let [left, top] = [self.origin[0] as f32 + 0.5, self.origin[1] as f32 + 0.5];
        let zero = s.splat(0.0);
        // The row after the batch changes nothing and reaches no block. It fills up the last sixteen, and lists up to a
        // multiple of what is evaluated together.
        let mut nothing = [0.0; 16];
        nothing[LOG2_ALPHA] = -200.0;
        nothing[THRESHOLD] = -1e9;
        for (group, sixteen) in batch.chunks(16).enumerate() {
            let mut columns = [zero; 16];
            for i in 0..16 {
                let position = group * 16 + i;
                prefetch(batch.get(position + PREFETCH).map(|&g| &self.rows[g as usize]));
                let row = if i < sixteen.len() { &self.rows[sixteen[i] as usize].0 } else { &nothing };
                columns[i] = s.load(row);
                let copy = &mut self.scratch.rows[position].0;
                s.store(columns[i], copy);
                if let Channels::Moments { reference_m } = self.channels {
                    let depth = row[CHANNELS + 3] - reference_m;
                    copy[CHANNELS] = depth;
                    copy[CHANNELS + 1] = depth * depth;
                }
            }
            s.transpose(&mut columns);
            let [mx, my, a, b2, c] = [columns[X], columns[Y], columns[A], columns[B2], columns[C]];
            let (b_by_a, b_by_c) = (columns[B_BY_A], columns[B_BY_C]);
            let reach = s.fma(columns[THRESHOLD], s.splat(1.0001), s.splat(1e-3));
            // From the mean to the nearest pixels of each row of blocks; where along that row the exponent is least.
            let dy = build!(zero; 4; |j| s.sub(clamp(s, my, top + (4 * j) as f32), my));
            let free_x = build!(zero; 4; |j| s.fnma(dy[j], b_by_a, mx));
            let by = build!(zero; 4; |j| s.mul(dy[j], b2));
            let cyy = build!(zero; 4; |j| s.mul(dy[j], s.mul(dy[j], c)));
            for i in 0..4 {
                let block_left = left + (4 * i) as f32;
                let dx = s.sub(clamp(s, mx, block_left), mx);
                let free_y = s.fnma(dx, b_by_c, my);
                let (bx, axx) = (s.mul(dx, b2), s.mul(dx, s.mul(dx, a)));
                for j in 0..4 {
                    let block = 4 * j + i;
                    if alive >> block & 1 == 0 {
                        continue;
                    }
                    // The least exponent over a block lies at the mean, or on the nearer vertical or horizontal edge.
                    let vy = s.sub(clamp(s, free_y, top + (4 * j) as f32), my);
                    let vertical = s.fma(vy, s.fma(vy, c, bx), axx);
                    let hx = s.sub(clamp(s, free_x[j], block_left), mx);
                    let horizontal = s.fma(hx, s.fma(hx, a, by[j]), cyy[j]);
                    let hits = s.ge(reach, s.min(vertical, horizontal));
                    let list = &mut self.scratch.lists[block];
                    counts[block] += s.append(hits, 16 * group as u16, &mut list[counts[block]..]);
                }
            }
        }
        self.scratch.rows[batch.len()].0 = nothing;
        for (list, &count) in self.scratch.lists.iter_mut().zip(&counts) {
            list[count..count + TOGETHER].fill(batch.len() as u16);
        }
        counts
    }

    /// Blends one block's list; says whether the block has stopped.
    #[inline(always)]
    fn blend<S: Simd, const N: usize>(
        &mut self,
        s: S,
        block: usize,
        count: usize,
        mut saved: Option<&mut Vec<u32>>,
        first: usize,
    ) -> bool {
        let (px, py, at) = block_pixels(s, self.origin, block);
        let mut transmittance = s.load_4x4(&self.out[LAST].0, at, TILE);
        let mut sums = build!(s.splat(0.0); N; |k| s.load_4x4(&self.out[k].0, at, TILE));
        let alpha_min = s.splat(self.alpha_min);
        let limit = s.splat(self.transmittance_min);
        let rows = &self.scratch.rows[..=BATCH];
        let list = &self.scratch.lists[block][..count.next_multiple_of(TOGETHER)];
        let mut stopped = false;
        if let Some(saved) = saved.as_deref_mut() {
            saved.reserve(list.len());
        }
        for (step, four) in list.chunks_exact(TOGETHER).enumerate() {
            let rows = build!(&rows[0].0; TOGETHER; |j| &rows[four[j] as usize].0);
            let alphas = build!((limit, s.mask(0)); TOGETHER; |j| alpha_at(s, rows[j], px, py, alpha_min));
            for j in 0..TOGETHER {
                let weight = s.mul(transmittance, alphas[j].0);
                transmittance = s.sub(transmittance, weight);
                for k in 0..N {
                    sums[k] = s.fma(weight, s.splat(rows[j][CHANNELS + k]), sums[k]);
                }
            }
            if let Some(saved) = saved.as_deref_mut() {
                for j in 0..TOGETHER {
                    if s.bits(alphas[j].1) != 0 {
                        saved.push(first as u32 + u32::from(four[j]));
                    }
                }
            }
            if step % 2 == 1 && s.bits(s.ge(transmittance, limit)) == 0 {
                stopped = true;
                break;
            }
        }
        s.store_4x4(transmittance, &mut self.out[LAST].0, at, TILE);
        for k in 0..N {
            s.store_4x4(sums[k], &mut self.out[k].0, at, TILE);
        }
        stopped
    }
}
