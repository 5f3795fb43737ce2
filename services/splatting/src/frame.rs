//! One view on its way from Gaussians to pixels: projected rows, depth order, lists of splats per tile.
//!
//! Stages: project in chunks, exact radix sort by depth, then an append to the lists of 16x16 tiles in depth order.
//! A global sort beats sorting per tile, and a bounding box per tile beats an exact ellipse test, because the blend
//! tests 4x4 blocks with SIMD anyway.

#![expect(unsafe_code, reason = "tasks write disjoint parts of shared buffers")]

use crate::camera::{Camera, RenderSettings};
use crate::model::{Block, Gaussians, LANES, Lanes};
use crate::projection::{Shape, ShapeBlock, View, project};
use crate::sh;
use crate::simd::{Isa, Kernel, Simd, build, dispatch};
use crate::sort::{Item, sort_by_key};
use crate::workers::{Shared, Workers};

/// Edge of a tile, pixels.
pub(crate) const TILE: usize = 16;
/// Pixels of a tile.
pub(crate) const TILE_PIXELS: usize = TILE * TILE;
/// Blocks of 16 Gaussians that one task projects.
const CHUNK_BLOCKS: usize = 64;
const CHUNK: usize = CHUNK_BLOCKS * LANES;

/// One projected splat, 64 bytes. Positions in pixels; the conic is scaled by log2(e)/2, so that
/// alpha = exp2(LOG2_ALPHA - (A dx² + B2 dx dy + C dy²)).
pub(crate) type Row = Lanes;
pub(crate) const X: usize = 0;
pub(crate) const Y: usize = 1;
pub(crate) const A: usize = 2;
pub(crate) const B2: usize = 3;
pub(crate) const C: usize = 4;
pub(crate) const LOG2_ALPHA: usize = 5;
/// Red, green, blue, depth, or what else is blended.
pub(crate) const CHANNELS: usize = 6;
/// Largest exponent that still counts.
pub(crate) const THRESHOLD: usize = 10;
/// B/A and B/C, for the nearest point of a block.
pub(crate) const B_BY_A: usize = 11;
pub(crate) const B_BY_C: usize = 12;
/// Bits of u32: first gradient slot, counted from its chunk's; tile corner x | y << 16; tile extent w | h << 16.
const SLOT: usize = 13;
const CORNER: usize = 14;
const EXTENT: usize = 15;

/// Pixels of one tile, row by row.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(crate) struct Plane(pub [f32; TILE_PIXELS]);

impl Plane {
    pub(crate) const ZERO: Self = Self([0.0; TILE_PIXELS]);

    /// Row `y` of the tile.
    #[inline(always)]
    pub(crate) fn row(&self, y: usize) -> &[f32; TILE] {
        // In range for y < 16; the array reference keeps later accesses free of checks.
        self.0[TILE * y..].first_chunk().unwrap_or(&[0.0; TILE])
    }
}

/// What a tile accumulates: up to four channels, then transmittance. As gradients: of the channels, then of alpha.
pub(crate) type TilePixels = [Plane; 5];
/// Index of the transmittance (of the gradient of alpha) in [`TilePixels`].
pub(crate) const LAST: usize = 4;

/// Tiles that a splat may touch and the slots where their gradient partials go.
#[derive(Clone, Copy)]
pub(crate) struct Footprint {
    pub slot: usize,
    pub tile_x: usize,
    pub tile_y: usize,
    pub width: usize,
}

impl Footprint {
    /// Slot of this splat's partial in a tile.
    pub(crate) fn slot_in(&self, tile_x: usize, tile_y: usize) -> usize {
        self.slot + (tile_y - self.tile_y) * self.width + tile_x - self.tile_x
    }
}

/// What is drawn.
#[derive(Clone, Copy)]
pub(crate) struct Model<'a> {
    pub gaussians: &'a Gaussians,
    /// What does not depend on the view, where many views are drawn without colours.
    pub shapes: Option<&'a [ShapeBlock]>,
}

impl<'a> From<&'a Gaussians> for Model<'a> {
    fn from(gaussians: &'a Gaussians) -> Self {
        Self { gaussians, shapes: None }
    }
}

/// The part of a projection that all views share, for [`Model::shapes`].
pub(crate) fn keep_shapes(isa: Isa, workers: &Workers, gaussians: &Gaussians, out: &mut Vec<ShapeBlock>) {
    let blocks = gaussians.blocks();
    out.resize(blocks.len(), [Lanes([0.0; LANES]); 13]);
    let shapes = Shared::new(out);
    workers.run(blocks.len().div_ceil(CHUNK_BLOCKS), |_, chunk| {
        let range = chunk * CHUNK_BLOCKS..blocks.len().min((chunk + 1) * CHUNK_BLOCKS);
        // SAFETY: the ranges of different chunks do not overlap.
        let shapes = unsafe { shapes.slice_mut(range.clone()) };
        dispatch(isa, KeepShapes { blocks: &blocks[range], shapes });
    });
}

struct KeepShapes<'a> {
    blocks: &'a [Block],
    shapes: &'a mut [ShapeBlock],
}

impl Kernel for KeepShapes<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        for (block, kept) in self.blocks.iter().zip(self.shapes) {
            Shape::new(s, block).keep(s, kept);
        }
    }
}

#[derive(Clone, Copy, Default)]
struct Chunk {
    items: usize,
    slots: usize,
    key_min: u32,
    key_max: u32,
}

/// Buffers of one view, reused from view to view.
#[derive(Default)]
pub(crate) struct Frame {
    pub tiles_x: usize,
    pub tiles_y: usize,
    pub rows: Vec<Row>,
    /// Visible lanes of each block of 16 Gaussians.
    pub visible: Vec<u16>,
    /// Gaussian indices of all tiles, tile after tile, nearest first.
    pub entries: Vec<u32>,
    /// Where each tile's entries begin; one more than tiles.
    pub starts: Vec<u32>,
    /// Tiles, longest list first: what is handed out last is short.
    pub schedule: Vec<u32>,
    pub pixels: Vec<TilePixels>,
    /// Gradient slots of this view.
    pub slots: usize,
    slot_bases: Vec<usize>,
    /// For each chunk, the first slot of each of its Gaussians and behind it all, counted from the chunk's first.
    first_slots: Vec<u32>,
    chunks: Vec<Chunk>,
    items: Vec<Item>,
    sorted: Vec<Item>,
    counts: Vec<i32>,
    next: Vec<u32>,
}

impl Frame {
    pub(crate) fn tiles(&self) -> usize {
        self.tiles_x * self.tiles_y
    }

    /// Projects, sorts and bins.
    pub(crate) fn prepare(
        &mut self,
        isa: Isa,
        workers: &Workers,
        model: Model<'_>,
        camera: &Camera,
        settings: &RenderSettings,
    ) {
        self.project(isa, workers, model, camera, settings);
        self.sort(workers);
        self.bin(workers);
    }

    /// Projects all Gaussians into rows and sort items.
    pub(crate) fn project(
        &mut self,
        isa: Isa,
        workers: &Workers,
        model: Model<'_>,
        camera: &Camera,
        settings: &RenderSettings,
    ) {
        let gaussians = model.gaussians;
        self.tiles_x = (camera.width as usize).div_ceil(TILE);
        self.tiles_y = (camera.height as usize).div_ceil(TILE);
        self.pixels.resize(self.tiles(), [Plane::ZERO; 5]);
        let blocks = gaussians.blocks().len();
        let chunks = blocks.div_ceil(CHUNK_BLOCKS);
        self.rows.resize(blocks * LANES, Lanes([0.0; LANES]));
        self.visible.resize(blocks, 0);
        self.items.resize(blocks * LANES, Item::default());
        self.chunks.clear();
        self.chunks.resize(chunks, Chunk::default());

        self.first_slots.resize(chunks * (CHUNK + 1), 0);
        let view = View::new(camera, settings);
        let sh_rows = if model.shapes.is_some() { 0 } else { gaussians.active_sh_rows(settings.sh_degree) };
        let valid = camera.is_valid();
        let rows = Shared::new(&mut self.rows);
        let visible = Shared::new(&mut self.visible);
        let items = Shared::new(&mut self.items);
        let results = Shared::new(&mut self.chunks);
        let first_slots = Shared::new(&mut self.first_slots);
        workers.run(chunks, |_, chunk| {
            let first = chunk * CHUNK_BLOCKS;
            let last = blocks.min(first + CHUNK_BLOCKS);
            // SAFETY: the ranges of different chunks do not overlap.
            let (rows, visible, items, first_slots) = unsafe {
                (
                    rows.slice_mut(first * LANES..last * LANES),
                    visible.slice_mut(first..last),
                    items.slice_mut(first * LANES..last * LANES),
                    first_slots.slice_mut(chunk * (CHUNK + 1)..(chunk + 1) * (CHUNK + 1)),
                )
            };
            let count = if valid { gaussians.len() } else { 0 };
            let kernel = ProjectChunk { view: &view, model, sh_rows, first, count, rows, visible, items, first_slots };
            let result = dispatch(isa, kernel);
            // SAFETY: one task per chunk.
            unsafe { results.write(chunk, result) };
        });

        self.slot_bases.clear();
        self.slots = 0;
        for chunk in &self.chunks {
            self.slot_bases.push(self.slots);
            self.slots += chunk.slots;
        }
    }

    /// Orders the visible splats by depth; equal depths keep the order of the model.
    pub(crate) fn sort(&mut self, workers: &Workers) {
        let filled = || self.chunks.iter().filter(|chunk| chunk.items > 0);
        let low = filled().map(|chunk| chunk.key_min).min().unwrap_or(0);
        let high = filled().map(|chunk| chunk.key_max).max().unwrap_or(0);
        let total: usize = self.chunks.iter().map(|chunk| chunk.items).sum();
        let mut packed = 0;
        for (index, chunk) in self.chunks.iter().enumerate() {
            if packed != index * CHUNK {
                self.items.copy_within(index * CHUNK..index * CHUNK + chunk.items, packed);
            }
            packed += chunk.items;
        }
        self.sorted.resize(self.items.len(), Item::default());
        sort_by_key(workers, &mut self.items[..total], &mut self.sorted[..total], low, high);
        self.items.truncate(total);
    }

    /// Appends every splat to the lists of the tiles its bounding box touches.
    pub(crate) fn bin(&mut self, workers: &Workers) {
        let tiles = self.tiles();
        let tiles_x = self.tiles_x;
        let parts = workers.count();
        let part_length = self.items.len().div_ceil(parts).max(1);
        let items = &self.items;
        let part = |p: usize| &items[(p * part_length).min(items.len())..((p + 1) * part_length).min(items.len())];
        // Boxes are counted by their corners: sums along both axes make of these the boxes over each tile.
        let stride = tiles_x + 1;
        let corners = stride * (self.tiles_y + 1);
        self.counts.clear();
        self.counts.resize(parts * corners, 0);
        let counts = Shared::new(&mut self.counts);
        workers.run(parts, |_, p| {
            // SAFETY: one range of counters per part.
            let counts = unsafe { counts.slice_mut(p * corners..(p + 1) * corners) };
            for item in part(p) {
                let [x0, y0, x1, y1] = item.tiles();
                let (top, bottom) = (y0 * stride, (y1 + 1) * stride);
                for (at, change) in [(top + x0, 1), (top + x1 + 1, -1), (bottom + x0, -1), (bottom + x1 + 1, 1)] {
                    counts[at] += change;
                }
            }
            for row in counts.chunks_exact_mut(stride) {
                let mut sum = 0;
                for count in row {
                    sum += *count;
                    *count = sum;
                }
            }
            for at in stride..corners {
                counts[at] += counts[at - stride];
            }
        });

        self.starts.clear();
        self.next.clear();
        self.next.resize(parts * tiles, 0);
        let mut total = 0;
        for tile in 0..tiles {
            self.starts.push(total);
            let corner = tile / tiles_x * stride + tile % tiles_x;
            for p in 0..parts {
                self.next[p * tiles + tile] = total;
                total += self.counts[p * corners + corner].cast_unsigned();
            }
        }
        self.starts.push(total);
        // Behind the entries is one place for each part's writes that count for nothing.
        self.entries.resize(total as usize + parts, 0);

        let next = Shared::new(&mut self.next);
        let entries = Shared::new(&mut self.entries);
        workers.run(parts, |_, p| {
            // SAFETY: one range of counters per part.
            let next = unsafe { next.slice_mut(p * tiles..(p + 1) * tiles) };
            let nowhere = total + p as u32;
            let mut append = |tile: usize, gaussian: u32, really: bool| {
                let place = next[tile];
                let place_or_nowhere = if really { place } else { nowhere };
                // SAFETY: the prefix sums give every (tile, part) a range of its own, and every part a place behind all.
                unsafe { entries.write(place_or_nowhere as usize, gaussian) };
                next[tile] = place + u32::from(really);
            };
            for item in part(p) {
                let [x0, y0, x1, y1] = item.tiles();
                if x1 - x0 > 1 || y1 - y0 > 1 {
                    for y in y0..=y1 {
                        for x in x0..=x1 {
                            append(y * tiles_x + x, item.gaussian, true);
                        }
                    }
                } else {
                    // Most splats touch one, two or four tiles: without a branch, which would be mispredicted.
                    let (right, below) = (x1 > x0, y1 > y0);
                    let (top, bottom) = (y0 * tiles_x, y1 * tiles_x);
                    append(top + x0, item.gaussian, true);
                    append(top + x1, item.gaussian, right);
                    append(bottom + x0, item.gaussian, below);
                    append(bottom + x1, item.gaussian, right && below);
                }
            }
        });
        self.entries.truncate(total as usize);
        self.schedule.clear();
        self.schedule.extend(0..tiles as u32);
        let length = |t: u32| self.starts[t as usize + 1] - self.starts[t as usize];
        self.schedule.sort_by_key(|&t| std::cmp::Reverse(length(t)));
    }

    /// Entries of a tile, nearest first.
    pub(crate) fn tile_entries(&self, tile: usize) -> &[u32] {
        &self.entries[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }

    /// First slots of the 16 Gaussians of a block and behind them, and what to add to them.
    #[inline(always)]
    pub(crate) fn block_slots(&self, block: usize) -> (&[u32; LANES + 1], usize) {
        let chunk = block / CHUNK_BLOCKS;
        let at = chunk * (CHUNK + 1) + block % CHUNK_BLOCKS * LANES;
        // In range, as every chunk has CHUNK + 1 of them.
        (self.first_slots[at..].first_chunk().unwrap_or(&[0; LANES + 1]), self.slot_bases[chunk])
    }

    /// Footprint of a visible Gaussian, from its row.
    #[inline(always)]
    pub(crate) fn footprint_of(&self, gaussian: usize, row: &Row) -> Footprint {
        let row = &row.0;
        let (corner, extent) = (row[CORNER].to_bits(), row[EXTENT].to_bits());
        Footprint {
            slot: self.slot_bases[gaussian / CHUNK] + row[SLOT].to_bits() as usize,
            tile_x: (corner & 0xffff) as usize,
            tile_y: (corner >> 16) as usize,
            width: (extent & 0xffff) as usize,
        }
    }
}

struct ProjectChunk<'a> {
    view: &'a View,
    model: Model<'a>,
    /// Rows of the higher bands that are evaluated.
    sh_rows: usize,
    /// First block.
    first: usize,
    /// Gaussians of the model.
    count: usize,
    rows: &'a mut [Row],
    visible: &'a mut [u16],
    items: &'a mut [Item],
    first_slots: &'a mut [u32],
}

/// Lanes of a block that hold Gaussians, of `count` in the model.
pub(crate) fn block_lanes(block: usize, count: usize) -> u16 {
    match count.saturating_sub(block * LANES) {
        0 => 0,
        n if n >= LANES => u16::MAX,
        n => (1 << n) - 1,
    }
}

impl Kernel for ProjectChunk<'_> {
    type Output = Chunk;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> Chunk {
        let mut chunk = Chunk { items: 0, slots: 0, key_min: u32::MAX, key_max: 0 };
        for (i, visible) in self.visible.iter_mut().enumerate() {
            let block = self.first + i;
            let parameters = &self.model.gaussians.blocks()[block];
            let shape = match self.model.shapes {
                Some(shapes) => Shape::load(s, &shapes[block]),
                None => Shape::new(s, parameters),
            };
            let mut p = project(s, self.view, &shape, block_lanes(block, self.count));
            if self.sh_rows != 0 && s.bits(p.visible) != 0 {
                let rest = &self.model.gaussians.rest_rows(block)[..self.sh_rows];
                sh::add_bands(s, self.view, parameters, rest, &mut p);
            }
            let bits = s.bits(p.visible);
            *visible = bits;
            if bits == 0 {
                self.first_slots[i * LANES..=(i + 1) * LANES].fill(chunk.slots as u32);
                continue;
            }
            let scale = s.splat(0.5 * std::f32::consts::LOG2_E);
            let [ca, cb, cc] = p.conic;
            let per_tile = s.splat(1.0 / TILE as f32);
            let tile = build!(per_tile; 4; |b| s.floor(s.mul(p.bounds[b], per_tile)));
            // A splat between two pixel centres may have its last pixel before its first.
            let (x0, y0) = (tile[0], tile[1]);
            let (x1, y1) = (s.max(tile[2], x0), s.max(tile[3], y0));
            let one = s.splat(1.0);
            let (width, height) = (s.add(s.sub(x1, x0), one), s.add(s.sub(y1, y0), one));
            let mut columns = [
                p.mean[0],
                p.mean[1],
                s.mul(ca, scale),
                s.mul(s.add(cb, cb), scale),
                s.mul(cc, scale),
                p.log2_alpha,
                p.color[0],
                p.color[1],
                p.color[2],
                p.z,
                p.threshold,
                s.div(cb, ca),
                s.div(cb, cc),
                one,
                s.pack_u16(x0, y0),
                s.pack_u16(width, height),
            ];
            s.transpose(&mut columns);
            let (mut first, mut last, mut depths, mut tiles) = ([0.0; LANES], [0.0; LANES], [0.0; LANES], [0.0; LANES]);
            s.store(s.pack_u16(x0, y0), &mut first);
            s.store(s.pack_u16(x1, y1), &mut last);
            s.store(p.z, &mut depths);
            s.store(s.keep(p.visible, s.mul(width, height)), &mut tiles);
            let slots = &mut self.first_slots[i * LANES..=(i + 1) * LANES];
            slots[0] = chunk.slots as u32;
            for lane in 0..LANES {
                slots[lane + 1] = slots[lane] + tiles[lane] as u32;
            }
            chunk.slots = slots[LANES] as usize;
            let mut bits = bits;
            while bits != 0 {
                let lane = bits.trailing_zeros() as usize;
                bits &= bits - 1;
                let row = &mut self.rows[i * LANES + lane].0;
                s.store(columns[lane], row);
                row[SLOT] = f32::from_bits(slots[lane]);
                let key = depths[lane].to_bits();
                self.items[chunk.items] = Item {
                    key,
                    gaussian: (block * LANES + lane) as u32,
                    first: first[lane].to_bits(),
                    last: last[lane].to_bits(),
                };
                chunk.items += 1;
                chunk.key_min = chunk.key_min.min(key);
                chunk.key_max = chunk.key_max.max(key);
            }
        }
        chunk
    }
}
