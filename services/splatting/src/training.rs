//! One training step: render, loss, backward pass, Adam.

#![expect(unsafe_code, reason = "tasks write disjoint parts of shared buffers")]

use std::time::Instant;

use crate::backward::{BackwardTile, MOMENTS, TOUCHED};
use crate::engine::Engine;
use crate::frame::{Frame, TILE, block_lanes};
use crate::gradient::{BlockGradient, Partials, UNTOUCHED, block_gradient};
use crate::loss;
use crate::model::{
    Block, Gaussians, LANES, Lanes, ROW_LOG_SCALE, ROW_OPACITY, ROW_SH, ROWS, SH_C0, SH_REST_MAX, sh_rest_rows,
};
use crate::optimiser::{AdamStep, Optimiser};
use crate::projection::{VALUE_MAX, View};
use crate::settings::{LossTerms, TrainingSettings};
use crate::simd::{Kernel, Simd, build, dispatch};
use crate::statistics::{self, ScreenStatistics, observe};
use crate::view::TrainingView;
use crate::workers::Shared;

/// Blocks of 16 Gaussians that one task takes a step for.
const CHUNK_BLOCKS: usize = 32;

/// Gradients of the fourteen parameters of a Gaussian, in the order mean x y z, log scales, rotation x y z w, opacity
/// logit, SH of red, green, blue.
pub type ParameterGradient = [f32; ROWS];

/// Gradient of a view's loss, Gaussian by Gaussian in the order of the model.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gradient {
    /// Of the fourteen parameters that every Gaussian has.
    pub parameters: Vec<ParameterGradient>,
    /// Of the spherical harmonics above degree 0, in the order of [`Gaussians::sh_rest`]; 0 for bands that are not
    /// evaluated.
    pub sh_rest: Vec<[[f32; 3]; SH_REST_MAX]>,
}

impl Engine {
    /// One step of Adam on one view. Only Gaussians that changed a pixel of the view move, each with its own step count;
    /// with a weight of the mean opacity or scale, all of them do.
    ///
    /// Gaussians that the optimiser does not know yet get zero state. Broken Gaussians (not finite) and broken
    /// gradients are left alone, so nothing that is finite before the step is not finite after it.
    pub fn train_step(
        &mut self,
        gaussians: &mut Gaussians,
        optimiser: &mut Optimiser,
        view: &TrainingView,
        settings: &TrainingSettings,
    ) -> LossTerms {
        self.on_workers(|engine| {
            engine.step::<false>(gaussians, optimiser, view, settings, &mut ScreenStatistics::new())
        })
    }

    /// The same step, bit for bit, which also adds what it saw of each Gaussian to `statistics`, for densification.
    pub fn train_step_observed(
        &mut self,
        gaussians: &mut Gaussians,
        optimiser: &mut Optimiser,
        view: &TrainingView,
        settings: &TrainingSettings,
        statistics: &mut ScreenStatistics,
    ) -> LossTerms {
        statistics.fit(gaussians);
        self.on_workers(|engine| engine.step::<true>(gaussians, optimiser, view, settings, statistics))
    }

    /// Runs `f` on a worker, so that its dozen stages need no thread outside to be woken.
    fn on_workers<R: Send>(&mut self, f: impl FnOnce(&mut Self) -> R + Send) -> R {
        match self.workers.pool() {
            Some(pool) => pool.install(|| f(self)),
            None => f(self),
        }
    }

    /// A step; with `OBSERVED` the statistics have the length of the model, else they are not touched.
    fn step<const OBSERVED: bool>(
        &mut self,
        gaussians: &mut Gaussians,
        optimiser: &mut Optimiser,
        view: &TrainingView,
        settings: &TrainingSettings,
        statistics: &mut ScreenStatistics,
    ) -> LossTerms {
        optimiser.fit(gaussians);
        self.corrections.update(settings.betas);
        let terms = self.accumulate(gaussians, view, settings);
        let accumulated = Instant::now();
        let pass = ParameterPass::new(self, gaussians, view, settings);
        let adam = AdamStep::new(settings, &self.corrections);
        let chunks = gaussians.blocks().len().div_ceil(CHUNK_BLOCKS);
        let mut sums = vec![Sums::default(); chunks];
        let results = Shared::new(&mut sums);
        let count = gaussians.blocks().len();
        let total = gaussians.len();
        let rows = sh_rest_rows(gaussians.sh_degree());
        let (blocks, rest) = gaussians.parts_mut();
        let (blocks, rest) = (Shared::new(blocks), Shared::new(rest));
        let first = Shared::new(&mut optimiser.first);
        let second = Shared::new(&mut optimiser.second);
        let first_rest = Shared::new(&mut optimiser.first_rest);
        let second_rest = Shared::new(&mut optimiser.second_rest);
        let steps = Shared::new(&mut optimiser.steps);
        let observed = Shared::new(statistics.rows_mut());
        let observed_rows = if OBSERVED { statistics::ROWS } else { 0 };
        self.workers.run(chunks, |_, chunk| {
            let range = chunk * CHUNK_BLOCKS..count.min((chunk + 1) * CHUNK_BLOCKS);
            let lanes = range.start * LANES..total.min(range.end * LANES);
            let bands = range.start * rows..range.end * rows;
            let seen = range.start * observed_rows..range.end * observed_rows;
            // SAFETY: the ranges of different chunks do not overlap.
            let kernel = unsafe {
                AdamChunk::<OBSERVED> {
                    pass: &pass,
                    adam: &adam,
                    start: range.start,
                    blocks: blocks.slice_mut(range.clone()),
                    first: first.slice_mut(range.clone()),
                    second: second.slice_mut(range),
                    steps: steps.slice_mut(lanes),
                    observed: observed.slice_mut(seen),
                    rest_rows: rows,
                    rest: rest.slice_mut(bands.clone()),
                    first_rest: first_rest.slice_mut(bands.clone()),
                    second_rest: second_rest.slice_mut(bands),
                }
            };
            // SAFETY: one task per chunk.
            unsafe {
                results.write(
                    chunk,
                    match pass.sh_rows {
                        0 => dispatch(self.isa, WithBands::<false, _>(kernel)),
                        _ => dispatch(self.isa, WithBands::<true, _>(kernel)),
                    },
                );
            };
        });
        self.stage_times[6] = accumulated.elapsed();
        finish(terms, &sums, gaussians.len(), settings)
    }

    /// The loss of a view and its gradient by every parameter; nothing moves. Zero for Gaussians that change no pixel.
    pub fn gradient(
        &mut self,
        gaussians: &Gaussians,
        view: &TrainingView,
        settings: &TrainingSettings,
    ) -> (LossTerms, Gradient) {
        let terms = self.accumulate(gaussians, view, settings);
        let pass = ParameterPass::new(self, gaussians, view, settings);
        let mut sums = Vec::new();
        let mut out = Gradient {
            parameters: vec![[0.0; ROWS]; gaussians.len()],
            sh_rest: vec![[[0.0; 3]; SH_REST_MAX]; gaussians.len()],
        };
        for (index, block) in gaussians.blocks().iter().enumerate() {
            let rest = &gaussians.rest_rows(index)[..pass.sh_rows];
            let (gradient, bands, sum) = dispatch(self.isa, GradientBlock { pass: &pass, index, block, rest });
            sums.push(sum);
            let first = index * LANES;
            for (lane, to) in out.parameters[first..].iter_mut().take(LANES).enumerate() {
                *to = std::array::from_fn(|row| gradient.0[row].0[lane]);
            }
            for (row, lanes) in bands.iter().enumerate().take(pass.sh_rows) {
                for (to, value) in out.sh_rest[first..].iter_mut().zip(lanes.0) {
                    to[row / 3][row % 3] = value;
                }
            }
        }
        (finish(terms, &sums, gaussians.len(), settings), out)
    }

    /// Renders the view, evaluates the loss, and leaves the moments of every (tile, Gaussian) in the sums.
    fn accumulate(&mut self, gaussians: &Gaussians, view: &TrainingView, settings: &TrainingSettings) -> LossTerms {
        let camera = view.camera();
        let start = Instant::now();
        self.frame.project(self.isa, &self.workers, gaussians.into(), camera, &settings.render);
        let projected = Instant::now();
        self.frame.sort(&self.workers);
        let sorted = Instant::now();
        self.frame.bin(&self.workers);
        let binned = Instant::now();
        self.blend(camera, &settings.render, true);
        let blended = Instant::now();
        let terms = self.loss.evaluate(self.isa, &self.workers, &self.ssim_scratch, &self.frame.pixels, view, settings);
        let evaluated = Instant::now();
        self.backward(settings);
        let ends = [start, projected, sorted, binned, blended, evaluated, Instant::now()];
        for (time, pair) in self.stage_times.iter_mut().zip(ends.windows(2)) {
            *time = pair[1] - pair[0];
        }
        terms
    }

    pub(crate) fn backward(&mut self, settings: &TrainingSettings) {
        let frame = &self.frame;
        // The first place is that of no splat and stays zero; behind the last there is room for a vector.
        let length = (frame.entries.len() + 1) * MOMENTS + LANES;
        if self.sums.len() < length {
            // A quarter more than needed: the number changes from view to view.
            self.sums.resize(length + length / 4, 0.0);
        }
        self.places.clear();
        self.places.resize(frame.slots + 1, UNTOUCHED);
        let sums = Shared::new(&mut self.sums);
        let places = Shared::new(&mut self.places);
        self.workers.run(frame.tiles(), |worker, task| {
            let tile = frame.schedule[task] as usize;
            let (tile_x, tile_y) = (tile % frame.tiles_x, tile / frame.tiles_x);
            let entries = frame.tile_entries(tile);
            let first = frame.starts[tile] as usize + 1;
            // SAFETY: the ranges of different tiles do not overlap, and each tile is given to one task.
            let sums = unsafe { sums.slice_mut(first * MOMENTS..(first + entries.len()) * MOMENTS) };
            self.backward_scratch.with(worker, |scratch| {
                let contributors = &self.contributors[tile];
                let kernel = BackwardTile {
                    origin: [tile_x * TILE, tile_y * TILE],
                    entries,
                    rows: &frame.rows,
                    contributors,
                    pixels: &frame.pixels[tile],
                    gradients: &self.loss.gradients[tile],
                    alpha_min: settings.render.alpha_min,
                    scratch: &mut *scratch,
                };
                dispatch(self.isa, kernel);
                let used = entries.iter().take(contributors.used).zip(&scratch.sums).zip(&scratch.rows);
                let mut kept = 0;
                for ((&gaussian, sum), row) in used {
                    if sum.0[TOUCHED] > 0.0 {
                        sums[kept * MOMENTS..][..MOMENTS].copy_from_slice(&sum.0[..MOMENTS]);
                        let slot = frame.footprint_of(gaussian as usize, row).slot_in(tile_x, tile_y);
                        // SAFETY: every (tile, Gaussian) has a slot of its own, and each tile is given to one task.
                        unsafe { places.write(slot, (first + kept) as u32) };
                        kept += 1;
                    }
                }
            });
        });
    }
}

/// Sums of the regularisers over some of the model.
#[derive(Clone, Copy, Default)]
struct Sums {
    isotropic: f64,
    opacity: f64,
    scale: f64,
}

impl std::ops::AddAssign for Sums {
    fn add_assign(&mut self, other: Self) {
        self.isotropic += other.isotropic;
        self.opacity += other.opacity;
        self.scale += other.scale;
    }
}

/// Adds up the regularisers in the order of the model, and weighs the terms.
fn finish(terms: LossTerms, parts: &[Sums], count: usize, settings: &TrainingSettings) -> LossTerms {
    let mut sums = Sums::default();
    parts.iter().for_each(|&part| sums += part);
    let count = count.max(1) as f64;
    LossTerms {
        isotropic_m: sums.isotropic / (3.0 * count),
        opacity: sums.opacity / count,
        scale_m: sums.scale / (3.0 * count),
        ..terms
    }
    .weighted(settings)
}

/// What the pass over parameters reads.
struct ParameterPass<'a> {
    view: View,
    frame: &'a Frame,
    partials: Partials<'a>,
    /// Rows of the higher bands that are evaluated.
    sh_rows: usize,
    /// Gaussians of the model.
    count: usize,
    /// Isotropic weight divided by the number of standard deviations of the model.
    isotropic: f32,
    /// Opacity weight divided by the number of Gaussians.
    opacity: f32,
    /// Scale weight divided by the number of standard deviations of the model.
    scale: f32,
}

impl<'a> ParameterPass<'a> {
    fn new(engine: &'a Engine, model: &Gaussians, view: &TrainingView, settings: &TrainingSettings) -> Self {
        let count = model.len();
        let (gaussians, deviations) = (count.max(1) as f32, (3 * count.max(1)) as f32);
        Self {
            view: View::new(view.camera(), &settings.render),
            frame: &engine.frame,
            partials: Partials { sums: &engine.sums, places: &engine.places },
            sh_rows: model.active_sh_rows(settings.render.sh_degree),
            count,
            isotropic: settings.isotropic_weight / deviations,
            opacity: settings.opacity_weight / gaussians,
            scale: settings.scale_weight / deviations,
        }
    }

    /// Gradient of one block with the regularisers, and their sums.
    #[inline(always)]
    fn block<S: Simd, const BANDS: bool, const OBSERVED: bool>(
        &self,
        s: S,
        index: usize,
        block: (&Block, &[Lanes]),
    ) -> Option<(BlockGradient<S>, Sums)> {
        let (view, frame, partials) = (&self.view, self.frame, self.partials);
        let mut gradient = block_gradient::<S, BANDS, OBSERVED>(s, view, frame, partials, index, block);
        let mut sums = Sums::default();
        if let Some(gradient) = &mut gradient
            && self.isotropic != 0.0
        {
            let third = s.splat(1.0 / 3.0);
            let scales = gradient.scales;
            let mean = s.mul(s.add(s.add(scales[0], scales[1]), scales[2]), third);
            let difference = build!(mean; 3; |k| s.sub(scales[k], mean));
            let sign = build!(mean; 3; |k| loss::sign(s, difference[k]));
            let mean_sign = s.mul(s.add(s.add(sign[0], sign[1]), sign[2]), third);
            for k in 0..3 {
                let d = s.mul(s.mul(s.sub(sign[k], mean_sign), scales[k]), s.splat(self.isotropic));
                gradient.rows[ROW_LOG_SCALE + k] = s.add(gradient.rows[ROW_LOG_SCALE + k], d);
                sums.isotropic += loss::sum(s, s.keep(gradient.lanes, s.abs(difference[k])));
            }
        }
        if self.opacity != 0.0 || self.scale != 0.0 {
            let mut all = match gradient {
                Some(gradient) => gradient,
                None => BlockGradient::zero::<BANDS>(s),
            };
            self.regularise(s, index, block.0, &mut all, &mut sums);
            return Some((all, sums));
        }
        Some((gradient?, sums))
    }

    /// Adds the gradients of mean opacity and mean scale, which every Gaussian of the model has, drawn or not.
    #[inline(always)]
    fn regularise<S: Simd>(&self, s: S, index: usize, block: &Block, gradient: &mut BlockGradient<S>, sums: &mut Sums) {
        let one = s.splat(1.0);
        let parameter = build!(one; ROWS; |row| s.load(&block.0[row].0));
        let opacity = s.div(one, s.add(one, s.exp(s.sub(s.splat(0.0), parameter[ROW_OPACITY]))));
        let scales = build!(one; 3; |k| s.exp(parameter[ROW_LOG_SCALE + k]));
        let mut size = s.add(scales[0], s.add(scales[1], scales[2]));
        for row in parameter {
            size = s.add(size, s.abs(row));
        }
        // Broken Gaussians are left alone, as they are without regularisers.
        let whole = s.and(s.mask(block_lanes(index, self.count)), s.gt(s.splat(VALUE_MAX), size));
        for row in &mut gradient.rows {
            *row = s.keep(gradient.lanes, *row);
        }
        if let Some(bands) = &mut gradient.bands {
            for basis in bands {
                *basis = s.keep(gradient.lanes, *basis);
            }
        }
        let d = s.mul(s.mul(opacity, s.sub(one, opacity)), s.splat(self.opacity));
        gradient.rows[ROW_OPACITY] = s.add(gradient.rows[ROW_OPACITY], d);
        sums.opacity += loss::sum(s, s.keep(whole, opacity));
        for k in 0..3 {
            let d = s.mul(scales[k], s.splat(self.scale));
            gradient.rows[ROW_LOG_SCALE + k] = s.add(gradient.rows[ROW_LOG_SCALE + k], d);
            sums.scale += loss::sum(s, s.keep(whole, scales[k]));
        }
        gradient.lanes = whole;
    }
}

struct AdamChunk<'a, const OBSERVED: bool> {
    pass: &'a ParameterPass<'a>,
    adam: &'a AdamStep<'a>,
    start: usize,
    blocks: &'a mut [Block],
    first: &'a mut [Block],
    second: &'a mut [Block],
    steps: &'a mut [u32],
    /// Rows of the statistics, none where the step is not observed.
    observed: &'a mut [Lanes],
    /// Rows of the higher bands per block, in the three that follow.
    rest_rows: usize,
    rest: &'a mut [Lanes],
    first_rest: &'a mut [Lanes],
    second_rest: &'a mut [Lanes],
}

/// A kernel compiled with and without higher bands: at degree 0 they must not cost a register.
struct WithBands<const BANDS: bool, K>(K);

impl<const BANDS: bool, const OBSERVED: bool> Kernel for WithBands<BANDS, AdamChunk<'_, OBSERVED>> {
    type Output = Sums;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> Sums {
        let chunk = self.0;
        let mut sums = Sums::default();
        let state = chunk.first.iter_mut().zip(chunk.second).zip(chunk.steps.chunks_mut(LANES));
        for (i, (block, ((first, second), steps))) in chunk.blocks.iter_mut().zip(state).enumerate() {
            let bands = match BANDS {
                true => i * chunk.rest_rows..i * chunk.rest_rows + chunk.pass.sh_rows,
                false => 0..0,
            };
            let rest = &mut chunk.rest[bands.clone()];
            let parameters = (&*block, &*rest);
            let Some((gradient, sum)) = chunk.pass.block::<S, BANDS, OBSERVED>(s, chunk.start + i, parameters) else {
                continue;
            };
            sums += sum;
            let corrections = chunk.adam.apply(s, &gradient.rows, gradient.lanes, block, (first, second, steps));
            if let Some(basis) = &gradient.bands {
                let moments = (&mut chunk.first_rest[bands.clone()], &mut chunk.second_rest[bands]);
                chunk.adam.apply_rest(s, (&gradient.rows, basis), (gradient.lanes, &corrections), rest, moments);
            }
            if OBSERVED {
                let rows = &mut chunk.observed[i * statistics::ROWS..(i + 1) * statistics::ROWS];
                observe(s, &chunk.pass.view, &gradient.screen, rows);
            }
        }
        sums
    }
}

struct GradientBlock<'a> {
    pass: &'a ParameterPass<'a>,
    index: usize,
    block: &'a Block,
    rest: &'a [Lanes],
}

impl Kernel for GradientBlock<'_> {
    type Output = (Block, [Lanes; 3 * SH_REST_MAX], Sums);

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> Self::Output {
        let (mut out, mut bands) = (Block::ZERO, [Lanes([0.0; LANES]); 3 * SH_REST_MAX]);
        let block = (self.block, self.rest);
        let Some((gradient, sums)) = self.pass.block::<S, true, false>(s, self.index, block) else {
            return (out, bands, Sums::default());
        };
        for (to, row) in out.0.iter_mut().zip(gradient.rows) {
            s.store(s.keep(gradient.lanes, row), &mut to.0);
        }
        if let Some(basis) = &gradient.bands {
            for (row, to) in bands.iter_mut().enumerate() {
                let color = s.mul(gradient.rows[ROW_SH + row % 3], s.splat(1.0 / SH_C0));
                s.store(s.keep(gradient.lanes, s.mul(basis[row / 3], color)), &mut to.0);
            }
        }
        (out, bands, sums)
    }
}
