//! The loss of a training view and its gradient by what the renderer accumulated (paper Eq. 7 with A30 and A31).
//!
//! Colour: 0.8 L1 + 0.2 (1 - SSIM), means over all pixels and channels, of both images composited over grey 0.5
//! outside the foreground. Alpha: mean over free pixels. Depth: mean over pixels with a measured depth of
//! |expected depth - depth|, where alpha exceeds 0.5, with the gradient through the alpha in the denominator.

#![expect(unsafe_code, reason = "tasks write disjoint parts of shared buffers")]

use crate::frame::{LAST, Plane, TILE, TilePixels};
use crate::model::Lanes;
use crate::settings::{LossTerms, TrainingSettings};
use crate::simd::{Isa, Kernel, Simd, dispatch};
use crate::ssim::{self, Maps, Needed, Strip};
use crate::view::{TargetTile, TrainingView};
use crate::workers::{PerWorker, Shared, Workers};

/// Depth counts where alpha exceeds this: below, the expected depth says little.
pub(crate) const DEPTH_ALPHA_MIN: f32 = 0.5;

/// Images of the loss, reused from step to step.
#[derive(Default)]
pub(crate) struct LossImages {
    composited: Vec<[Plane; 3]>,
    maps: Vec<[Maps; 3]>,
    needed: Vec<Needed>,
    /// By tile: gradients of the four channels before the background, and of alpha.
    pub gradients: Vec<TilePixels>,
    sums: Vec<TileSums>,
    rows: Vec<f64>,
}

#[derive(Clone, Copy, Default)]
struct TileSums {
    l1: f64,
    squared: f64,
    depth: f64,
    free_alpha: f64,
}

impl LossImages {
    /// Fills `gradients` and returns the terms without the regulariser, which needs the model.
    pub(crate) fn evaluate(
        &mut self,
        isa: Isa,
        workers: &Workers,
        scratch: &PerWorker<ssim::Scratch>,
        pixels: &[TilePixels],
        view: &TrainingView,
        settings: &TrainingSettings,
    ) -> LossTerms {
        let (width, height) = (view.camera().width as usize, view.camera().height as usize);
        let tiles = (width.div_ceil(TILE), height.div_ceil(TILE));
        let count = tiles.0 * tiles.1;
        self.composited.resize(count, [Plane::ZERO; 3]);
        self.gradients.resize(count, [Plane::ZERO; 5]);
        self.sums.resize(count, TileSums::default());
        let window = ssim::window();
        let background = settings.render.background.to_array();

        let composited = Shared::new(&mut self.composited);
        workers.run(tiles.1, |_, ty| {
            for tile in ty * tiles.0..(ty + 1) * tiles.0 {
                // SAFETY: one task per row of tiles.
                let out = unsafe { &mut composited.slice_mut(tile..tile + 1)[0] };
                dispatch(isa, Composite { pixels: &pixels[tile], target: &view.tiles[tile], background, out });
            }
        });
        self.rows.clear();
        if settings.ssim_weight != 0.0 {
            self.similarity(isa, workers, scratch, view, tiles, &window);
        }
        let samples = (3 * width * height) as f32;
        let per = |weight: f32, count: usize| if count == 0 { 0.0 } else { weight / count as f32 };
        let weights = Weights {
            l1: settings.l1_weight / samples,
            ssim: settings.ssim_weight / samples,
            depth: per(settings.depth_weight, view.with_depth),
            free: per(settings.free_weight, view.free),
        };
        let gradients = Shared::new(&mut self.gradients);
        let sums = Shared::new(&mut self.sums);
        let (composited, maps, needed) = (&self.composited, &self.maps, &self.needed);
        workers.run(tiles.1, |_, ty| {
            for tile in ty * tiles.0..(ty + 1) * tiles.0 {
                // SAFETY: one task per row of tiles.
                let out = unsafe { &mut gradients.slice_mut(tile..tile + 1)[0] };
                let similarity = (settings.ssim_weight != 0.0 && needed[tile].gradient).then(|| SimilarityMaps {
                    window: &window,
                    above: tile.checked_sub(tiles.0).map(|tile| &maps[tile]),
                    here: &maps[tile],
                    below: maps.get(tile + tiles.0),
                });
                let kernel = GradientTile {
                    pixels: &pixels[tile],
                    target: &view.tiles[tile],
                    composited: &composited[tile],
                    similarity,
                    weights: &weights,
                    background,
                    out,
                };
                // SAFETY: as above.
                unsafe { sums.write(tile, dispatch(isa, kernel)) };
            }
        });
        self.terms(view, f64::from(samples))
    }

    fn similarity(
        &mut self,
        isa: Isa,
        workers: &Workers,
        scratch: &PerWorker<ssim::Scratch>,
        view: &TrainingView,
        tiles: (usize, usize),
        window: &[f32; 11],
    ) {
        self.maps.resize(tiles.0 * tiles.1, [[Plane::ZERO; 3]; 3]);
        self.rows.resize(tiles.1, 0.0);
        let target = &view.tiles[..];
        ssim::needed(target, tiles, &mut self.needed);
        let (rendered, needed) = (&self.composited[..], &self.needed[..]);
        let size = (view.camera().width as usize, view.camera().height as usize);
        let maps = Shared::new(&mut self.maps);
        let rows = Shared::new(&mut self.rows);
        workers.run(tiles.1, |worker, ty| {
            // SAFETY: one task per row of tiles.
            let maps = unsafe { maps.slice_mut(ty * tiles.0..(ty + 1) * tiles.0) };
            scratch.with(worker, |scratch| {
                let sum = dispatch(isa, Strip { window, tiles, ty, size, rendered, target, needed, scratch, maps });
                // SAFETY: as above.
                unsafe { rows.write(ty, sum) };
            });
        });
    }

    /// Sums the tiles' terms in the order of the tiles.
    fn terms(&self, view: &TrainingView, samples: f64) -> LossTerms {
        let mut sum = TileSums::default();
        for tile in &self.sums {
            sum.l1 += tile.l1;
            sum.squared += tile.squared;
            sum.depth += tile.depth;
            sum.free_alpha += tile.free_alpha;
        }
        let per = |value: f64, count: usize| if count == 0 { 0.0 } else { value / count as f64 };
        LossTerms {
            l1: sum.l1 / samples,
            ssim: if self.rows.is_empty() { 1.0 } else { self.rows.iter().sum::<f64>() / samples },
            depth_m: per(sum.depth, view.with_depth),
            free_alpha: per(sum.free_alpha, view.free),
            isotropic_m: 0.0,
            opacity: 0.0,
            scale_m: 0.0,
            foreground_mse: per(sum.squared, 3 * view.foreground),
            total: 0.0,
        }
    }
}

/// Rendered colour over the background, then over grey outside of the foreground, then 0 outside of the image.
struct Composite<'a> {
    pixels: &'a TilePixels,
    target: &'a TargetTile,
    background: [f32; 3],
    out: &'a mut [Plane; 3],
}

impl Kernel for Composite<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        for y in 0..TILE {
            let transmittance = s.load(self.pixels[LAST].row(y));
            let foreground = s.mask(self.target.foreground[y]);
            let inside = s.mask(self.target.inside[y]);
            for k in 0..3 {
                let color = s.fma(transmittance, s.splat(self.background[k]), s.load(self.pixels[k].row(y)));
                let color = s.keep(inside, s.select(foreground, color, s.splat(0.5)));
                if let Some(to) = self.out[k].0[TILE * y..].first_chunk_mut() {
                    s.store(color, to);
                }
            }
        }
    }
}

/// Weights divided by the number of what they are means over.
struct Weights {
    l1: f32,
    ssim: f32,
    depth: f32,
    free: f32,
}

/// Where the gradient of the similarity comes from: the maps of a tile and of those above and below it.
struct SimilarityMaps<'a> {
    window: &'a [f32; 11],
    above: Option<&'a [Maps; 3]>,
    here: &'a [Maps; 3],
    below: Option<&'a [Maps; 3]>,
}

struct GradientTile<'a> {
    pixels: &'a TilePixels,
    target: &'a TargetTile,
    composited: &'a [Plane; 3],
    /// `None` where the similarity has no gradient.
    similarity: Option<SimilarityMaps<'a>>,
    weights: &'a Weights,
    background: [f32; 3],
    out: &'a mut TilePixels,
}

impl Kernel for GradientTile<'_> {
    type Output = TileSums;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> TileSums {
        let zero = s.splat(0.0);
        let one = s.splat(1.0);
        let (mut l1, mut squared, mut depth_sum, mut free_sum) = (zero, zero, zero, zero);
        let mut similarity = [[Lanes([0.0; TILE]); TILE]; 3];
        if let Some(from) = &self.similarity {
            for k in 0..3 {
                let maps = [from.above.map(|maps| &maps[k]), Some(&from.here[k]), from.below.map(|maps| &maps[k])];
                let (rendered, target) = (&self.composited[k], &self.target.color[k]);
                ssim::similarity_gradient(s, from.window, maps, rendered, target, &mut similarity[k]);
            }
        }
        for y in 0..TILE {
            let foreground = s.mask(self.target.foreground[y]);
            let alpha = s.sub(one, s.load(self.pixels[LAST].row(y)));
            let mut d_alpha = zero;
            for k in 0..3 {
                let difference = s.sub(s.load(self.composited[k].row(y)), s.load(self.target.color[k].row(y)));
                l1 = s.add(l1, s.abs(difference));
                squared = s.fma(difference, difference, squared);
                let d = s.mul(sign(s, difference), s.splat(self.weights.l1));
                let d = s.fnma(s.load(&similarity[k][y].0), s.splat(self.weights.ssim), d);
                let d = s.keep(foreground, d);
                d_alpha = s.fnma(d, s.splat(self.background[k]), d_alpha);
                store(s, d, &mut self.out[k], y);
            }
            let counts = s.and(s.mask(self.target.has_depth[y]), s.gt(alpha, s.splat(DEPTH_ALPHA_MIN)));
            let inv_alpha = s.div(one, s.select(counts, alpha, one));
            let expected = s.mul(s.load(self.pixels[3].row(y)), inv_alpha);
            let difference = s.keep(counts, s.sub(expected, s.load(self.target.depth.row(y))));
            depth_sum = s.add(depth_sum, s.abs(difference));
            let d_depth = s.mul(s.mul(sign(s, difference), s.splat(self.weights.depth)), inv_alpha);
            d_alpha = s.fnma(d_depth, expected, d_alpha);
            store(s, d_depth, &mut self.out[3], y);
            let free = s.mask(self.target.free[y]);
            free_sum = s.add(free_sum, s.keep(free, alpha));
            d_alpha = s.add(d_alpha, s.keep(free, s.splat(self.weights.free)));
            store(s, d_alpha, &mut self.out[LAST], y);
        }
        TileSums { l1: sum(s, l1), squared: sum(s, squared), depth: sum(s, depth_sum), free_alpha: sum(s, free_sum) }
    }
}

#[inline(always)]
fn store<S: Simd>(s: S, value: S::F, plane: &mut Plane, y: usize) {
    if let Some(to) = plane.0[TILE * y..].first_chunk_mut() {
        s.store(value, to);
    }
}

/// 1, -1 or 0.
#[inline(always)]
pub(crate) fn sign<S: Simd>(s: S, x: S::F) -> S::F {
    let zero = s.splat(0.0);
    s.select(s.gt(x, zero), s.splat(1.0), s.keep(s.gt(zero, x), s.splat(-1.0)))
}

/// Sum over lanes, in their order.
#[inline(always)]
pub(crate) fn sum<S: Simd>(s: S, value: S::F) -> f64 {
    let mut lanes = [0.0; 16];
    s.store(value, &mut lanes);
    lanes.iter().map(|&v| f64::from(v)).sum()
}
