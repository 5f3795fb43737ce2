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
        Self { rows: vec![Lanes([0.0; 16]); BATCH + 1], lists: Box::new([[0; LIST]; BLOCKS]) }
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
    #[inline(always)]
    fn gather<S: Simd>(&mut self, s: S, batch: &[u32], alive: u16) -> [usize; BLOCKS] {
        let mut counts = [0; BLOCKS];
        // Lanes are blocks: low and high pixel centres of each.
        let [left, top] = [self.origin[0] as f32, self.origin[1] as f32];
        let low = [
            s.load(&build!(0.0; 16; |i| left + (i % 4 * 4) as f32 + 0.5)),
            s.load(&build!(0.0; 16; |i| top + (i / 4 * 4) as f32 + 0.5)),
        ];
        let three = s.splat(3.0);
        let high = [s.add(low[0], three), s.add(low[1], three)];
        let mut hits = [0_u32; 16];
        for (i, &gaussian) in batch.iter().enumerate() {
            prefetch(batch.get(i + PREFETCH).map(|&g| &self.rows[g as usize]));
            let mut row = self.rows[gaussian as usize].0;
            if let Channels::Moments { reference_m } = self.channels {
                let depth = row[CHANNELS + 3] - reference_m;
                row[CHANNELS] = depth;
                row[CHANNELS + 1] = depth * depth;
            }
            self.scratch.rows[i].0 = row;
            // The least exponent over a block lies at the mean, or on the nearer vertical or horizontal edge.
            let (mx, my) = (s.splat(row[X]), s.splat(row[Y]));
            let dx = s.sub(s.min(s.max(mx, low[0]), high[0]), mx);
            let dy = s.sub(s.min(s.max(my, low[1]), high[1]), my);
            let (a, b2, c) = (s.splat(row[A]), s.splat(row[B2]), s.splat(row[C]));
            let free_y = s.fnma(dx, s.splat(row[B_BY_C]), my);
            let free_x = s.fnma(dy, s.splat(row[B_BY_A]), mx);
            let vy = s.sub(s.min(s.max(free_y, low[1]), high[1]), my);
            let hx = s.sub(s.min(s.max(free_x, low[0]), high[0]), mx);
            let vertical = s.fma(dx, s.fma(vy, b2, s.mul(dx, a)), s.mul(vy, s.mul(vy, c)));
            let horizontal = s.fma(hx, s.fma(dy, b2, s.mul(hx, a)), s.mul(dy, s.mul(dy, c)));
            let least = s.min(vertical, horizontal);
            let reach = s.splat(row[THRESHOLD] * 1.0001 + 1e-3);
            hits[i % 16] = u32::from(s.bits(s.ge(reach, least)) & alive);
            if i % 16 == 15 {
                s.append_hits(&hits, i as u16 - 15, &mut self.scratch.lists, &mut counts);
                hits = [0; 16];
            }
        }
        if !batch.len().is_multiple_of(16) {
            s.append_hits(&hits, (batch.len() / 16 * 16) as u16, &mut self.scratch.lists, &mut counts);
        }
        // The row after the batch changes nothing: it fills lists up to a multiple of what is evaluated together.
        let mut nothing = [0.0; 16];
        nothing[LOG2_ALPHA] = -200.0;
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
