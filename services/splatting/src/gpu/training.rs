//! Training on the GPU: iterations are queued, recorded several at a time, and tell their losses when they have them.

use std::collections::VecDeque;

use bytemuck::{bytes_of, pod_collect_to_vec};
use wgpu::{BindGroup, Buffer, BufferUsages, ComputePass, ComputePassDescriptor};

use super::buffers::Bytes;
use super::chain::{Chain, Listing, Size, dispatch};
use super::context::{Context, Mapping, copy};
use super::error::GpuError;
use super::iteration::{Counts, Iteration, job};
use super::job::{STRIDE, fold};
use super::kernels::Kernels;
use super::keyframe::{Keyframes, Seen};
use super::model::DeviceModel;
use crate::densify::Noise;
use crate::settings::{LossTerms, TrainingSettings};
use crate::view::TrainingView;

/// Iterations of a submission.
const ITERATIONS: usize = 16;
/// Submissions that may be under way; then the host waits for the oldest.
const AHEAD: usize = 3;
/// Words of an iteration in the ring of terms.
pub(super) const RING_WORDS: usize = 12;

/// A stage of an iteration, as the CPU engine names them.
#[derive(Clone, Copy)]
pub(super) enum Stage {
    Listing(Listing),
    Blend,
    Loss,
    Backward,
    /// With the sum of the terms.
    Adam,
}

/// What takes the gradients of an iteration.
#[derive(Clone, Copy)]
pub(super) enum Last<'a> {
    /// A step, and what belongs to it.
    Step(&'a Iteration),
    /// The buffers of the caller; nothing moves.
    Gradient(&'a BindGroup),
}

/// Number of stages: those of [`crate::Engine::stage_times`].
pub(super) const STAGES: usize = 7;

impl Stage {
    pub const ALL: [Self; STAGES] = [
        Self::Listing(Listing::Project),
        Self::Listing(Listing::Sort),
        Self::Listing(Listing::Bin),
        Self::Blend,
        Self::Loss,
        Self::Backward,
        Self::Adam,
    ];
}

/// Iterations on their way.
struct Flight {
    iterations: Vec<Iteration>,
    staging: Buffer,
    mapping: Mapping,
}

/// Everything that a model under training has on the GPU, besides the model.
pub(super) struct Trainer {
    pub(super) chain: Chain,
    pub(super) jobs: Buffer,
    pub(super) views: Buffer,
    pub(super) ring: Buffer,
    /// Sums of ten moments of every Gaussian.
    pub(super) gradients: Buffer,
    blend: BindGroup,
    ssim: BindGroup,
    loss: BindGroup,
    backward: BindGroup,
    gather: Option<BindGroup>,
    observe: BindGroup,
    adam: BindGroup,
    noise: BindGroup,
    metrics: BindGroup,
    pub bytes: Bytes,
    waiting: Vec<Iteration>,
    flights: VecDeque<Flight>,
    idle: Vec<Buffer>,
    finished: VecDeque<LossTerms>,
}

impl Trainer {
    pub fn new(context: &Context, kernels: &Kernels, model: &DeviceModel, size: Size) -> Result<Self, GpuError> {
        let Some(optimiser) = &model.optimiser else {
            return Err(GpuError::Refused("a model without an optimiser cannot be trained".to_owned()));
        };
        let mut bytes = Bytes::default();
        let jobs = context.buffer("jobs", STRIDE * ITERATIONS as u64, BufferUsages::UNIFORM | BufferUsages::COPY_DST);
        let views = context.storage("views", STRIDE * ITERATIONS as u64)?;
        let chain = Chain::new(context, kernels, model, size, (&jobs, &views))?;
        let mut storage = |what: &'static str, length: u64| -> Result<Buffer, GpuError> {
            let buffer = context.storage(what, length)?;
            bytes.add(what, &buffer);
            Ok(buffer)
        };
        let tiles = u64::from(size.tiles());
        let ring = storage("terms of the loss", 4 * (RING_WORDS * ITERATIONS) as u64)?;
        let terms = storage("terms of the loss", 32 * tiles)?;
        let gradients = storage("gradients", 48 * u64::from(size.gaussians))?;
        let image = storage("images", 40 * size.pixels())?;
        let maps = storage("images", 36 * size.pixels())?;
        let reached = storage("tile lists", 4 * (tiles + u64::from(size.capacity)))?;
        context.check()?;
        // A place for each quarter of a tile and splat, where sums must have an order.
        let partials = match &kernels.gather {
            Some(_) => Some(storage("ordered sums", 192 * u64::from(size.capacity))?),
            None => None,
        };
        let (jobs_ref, views_ref) = (&jobs, &views);
        let blend = kernels.blend.bind(
            context,
            1,
            &[jobs_ref, views_ref, &chain.rows, &chain.starts, &chain.entries, &reached, &image],
        );
        let ssim = kernels.ssim.bind(context, 1, &[jobs_ref, views_ref, &image, &maps, &terms]);
        let loss = kernels.loss.bind(context, 1, &[jobs_ref, views_ref, &image, &maps, &terms]);
        let backward = kernels.backward.bind(
            context,
            1,
            &[
                jobs_ref,
                views_ref,
                &chain.rows,
                &chain.starts,
                &chain.entries,
                &reached,
                &image,
                partials.as_ref().unwrap_or(&gradients),
            ],
        );
        let gather = kernels.gather.as_ref().zip(partials.as_ref()).map(|(kernel, partials)| {
            let lists = [&chain.starts, &chain.entries, &reached];
            let [starts, entries, reached] = lists;
            let buffers = [jobs_ref, &chain.rows, &chain.boxes, starts, entries, reached, partials, &gradients];
            kernel.bind(context, 0, &buffers)
        });
        let seen = [&model.parameters, &gradients, &chain.control, &optimiser.statistics];
        let observe = kernels.observe.bind(context, 1, &[jobs_ref, views_ref, seen[0], seen[1], seen[2], seen[3]]);
        let moved = [jobs_ref, &model.parameters, &optimiser.ids, &chain.control];
        let noise = kernels.noise.bind(context, 0, &moved);
        let adam = kernels.adam.bind(
            context,
            1,
            &[
                jobs_ref,
                views_ref,
                &model.parameters,
                &model.bands,
                &optimiser.state,
                &optimiser.band_state,
                &optimiser.steps,
                &gradients,
                &chain.control,
            ],
        );
        let metrics = kernels.metrics.bind(context, 0, &[jobs_ref, &chain.control, &terms, &ring]);
        context.check()?;
        Ok(Self {
            chain,
            jobs,
            views,
            ring,
            gradients,
            blend,
            ssim,
            loss,
            backward,
            gather,
            observe,
            adam,
            noise,
            metrics,
            bytes,
            waiting: Vec::new(),
            flights: VecDeque::new(),
            idle: Vec::new(),
            finished: VecDeque::new(),
        })
    }

    pub fn size(&self) -> Size {
        self.chain.size
    }

    pub fn all_bytes(&self) -> impl Iterator<Item = Bytes> + '_ {
        [self.bytes.clone(), self.chain.bytes.clone()].into_iter()
    }

    /// Whether every iteration that was asked for has told its loss.
    pub fn is_idle(&self) -> bool {
        self.waiting.is_empty() && self.flights.is_empty()
    }

    /// Takes the place of a trainer of another size: what that one still had to do goes on here.
    pub fn inherit(&mut self, other: &mut Self) {
        self.finished = std::mem::take(&mut other.finished);
        self.waiting = std::mem::take(&mut other.waiting);
    }

    /// Asks for an iteration; submits once more than enough are waiting. The last one waits for what may follow it.
    pub fn push(
        &mut self,
        context: &Context,
        kernels: &Kernels,
        (model, keyframes): (&DeviceModel, &mut Keyframes),
        (view, observed): (&TrainingView, bool),
        settings: &TrainingSettings,
    ) -> Result<(), GpuError> {
        let keyframe = keyframes.hold(context, kernels, view)?;
        self.waiting.push(Iteration::new(view, keyframe, settings, observed));
        if self.waiting.len() > ITERATIONS {
            self.submit_batch(context, kernels, model);
        }
        context.check()
    }

    /// Asks for noise after the iteration that was asked for last; `false` where that one is over.
    pub fn add_noise(&mut self, noise: &Noise) -> bool {
        match self.waiting.last_mut() {
            Some(last) => {
                last.noise = Some(*noise);
                true
            }
            None => false,
        }
    }

    /// Submits what is waiting.
    pub fn submit(&mut self, context: &Context, kernels: &Kernels, model: &DeviceModel) -> Result<(), GpuError> {
        while !self.waiting.is_empty() {
            self.submit_batch(context, kernels, model);
        }
        context.check()
    }

    fn submit_batch(&mut self, context: &Context, kernels: &Kernels, model: &DeviceModel) {
        let rest = self.waiting.split_off(self.waiting.len().min(ITERATIONS));
        let iterations = std::mem::replace(&mut self.waiting, rest);
        for (slot, iteration) in iterations.iter().enumerate() {
            let job = job(self.chain.size, model, slot as u32, iteration);
            context.queue.write_buffer(&self.jobs, STRIDE * slot as u64, bytes_of(&job));
            context.queue.write_buffer(&self.views, STRIDE * slot as u64, bytes_of(&iteration.view));
        }
        let mut encoder = context.encoder();
        let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor::default());
        for (slot, iteration) in iterations.iter().enumerate() {
            let offset = (STRIDE * slot as u64) as u32;
            self.record(&mut pass, kernels, &iteration.keyframe, &[offset, offset], Last::Step(iteration));
        }
        drop(pass);
        let bytes = self.ring.size();
        let staging = self.idle.pop().unwrap_or_else(|| context.staging(bytes));
        encoder.copy_buffer_to_buffer(&self.ring, 0, &staging, 0, bytes);
        context.queue.submit([encoder.finish()]);
        let mapping = Mapping::begin(&staging);
        self.flights.push_back(Flight { iterations, staging, mapping });
    }

    /// Records the dispatches of one iteration, of which `last` takes the gradients.
    pub(super) fn record(
        &self,
        pass: &mut ComputePass<'_>,
        kernels: &Kernels,
        keyframe: &Seen,
        offsets: &[u32; 2],
        last: Last<'_>,
    ) {
        for stage in Stage::ALL {
            self.record_stage(stage, pass, kernels, keyframe, offsets, last);
        }
    }

    pub(super) fn record_stage(
        &self,
        stage: Stage,
        pass: &mut ComputePass<'_>,
        kernels: &Kernels,
        keyframe: &Seen,
        offsets: &[u32; 2],
        last: Last<'_>,
    ) {
        let size = self.chain.size;
        let tiles = (size.tiles_x(), size.tiles_y(), 1);
        match stage {
            Stage::Listing(listing) => self.chain.record(listing, pass, kernels, offsets),
            Stage::Blend => dispatch(pass, &kernels.blend, &self.blend, offsets, tiles),
            Stage::Loss => {
                pass.set_bind_group(1, &keyframe.ssim, &[]);
                dispatch(pass, &kernels.ssim, &self.ssim, offsets, tiles);
                pass.set_bind_group(1, &keyframe.loss, &[]);
                dispatch(pass, &kernels.loss, &self.loss, offsets, tiles);
            }
            Stage::Backward => {
                let quarters = (2 * size.tiles_x(), 2 * size.tiles_y(), 1);
                dispatch(pass, &kernels.backward, &self.backward, offsets, quarters);
                if let (Some(kernel), Some(group)) = (&kernels.gather, &self.gather) {
                    let (x, y) = fold(size.parameter_groups());
                    dispatch(pass, kernel, group, offsets, (x, y, 1));
                }
            }
            Stage::Adam => {
                let (x, y) = fold(size.parameter_groups());
                let mut each = |kernel, group| dispatch(pass, kernel, group, offsets, (x, y, 1));
                match last {
                    Last::Step(iteration) => {
                        if iteration.observed {
                            each(&kernels.observe, &self.observe);
                        }
                        each(&kernels.adam, &self.adam);
                        if iteration.noise.is_some() {
                            each(&kernels.noise, &self.noise);
                        }
                    }
                    Last::Gradient(group) => each(&kernels.gradient, group),
                }
                dispatch(pass, &kernels.metrics, &self.metrics, offsets, (1, 1, 1));
            }
        }
    }

    /// Takes in what has come back; with `all`, waits for all of it, else only for what is too far behind. Returns how
    /// many pairs must have room where lists did not fit: the iterations from that one on are waiting again.
    pub fn collect(&mut self, context: &Context, all: bool) -> Result<Option<u32>, GpuError> {
        context.poll()?;
        while let Some(flight) = self.flights.front() {
            let arrived = match flight.mapping.arrived() {
                Some(result) => {
                    result?;
                    true
                }
                None if all || self.flights.len() > AHEAD => {
                    context.wait()?;
                    match self.flights.front().and_then(|flight| flight.mapping.arrived()) {
                        Some(result) => {
                            result?;
                            true
                        }
                        None => return Err(GpuError::Lost("a readback never arrived".to_owned())),
                    }
                }
                None => false,
            };
            if !arrived {
                break;
            }
            let Some(flight) = self.flights.pop_front() else { break };
            let words: Vec<u32> = pod_collect_to_vec(&copy(&flight.staging, flight.staging.size())?);
            self.idle.push(flight.staging);
            for (at, iteration) in flight.iterations.iter().enumerate() {
                let words = &words[at * RING_WORDS..(at + 1) * RING_WORDS];
                if words[8] == 0 {
                    let pairs = words[9];
                    return self.take_back(context, &flight.iterations[at..], pairs).map(Some);
                }
                self.finished.push_back(self.terms(words, iteration));
            }
        }
        Ok(None)
    }

    /// Lists did not fit in an iteration: it and all that were recorded after it changed nothing, and wait again.
    fn take_back(&mut self, context: &Context, failed: &[Iteration], pairs: u32) -> Result<u32, GpuError> {
        context.wait()?;
        let mut again = failed.to_vec();
        let mut most = pairs;
        for flight in std::mem::take(&mut self.flights) {
            if let Some(result) = flight.mapping.arrived() {
                result?;
                let words: Vec<u32> = pod_collect_to_vec(&copy(&flight.staging, flight.staging.size())?);
                most = most.max(words.get(9).copied().unwrap_or(0));
            }
            again.extend(flight.iterations);
        }
        again.append(&mut self.waiting);
        self.waiting = again;
        Ok(most)
    }

    pub(super) fn terms(&self, words: &[u32], iteration: &Iteration) -> LossTerms {
        let sum = |k: usize| f64::from(f32::from_bits(words[k]));
        let Counts { samples, foreground, free, with_depth } = iteration.counts;
        let per = |value: f64, count: usize| if count == 0 { 0.0 } else { value / count as f64 };
        let count = f64::from(self.chain.size.gaussians.max(1));
        let settings = &iteration.settings;
        let terms = LossTerms {
            l1: sum(0) / samples,
            ssim: if settings.ssim_weight == 0.0 { 1.0 } else { sum(4) / samples },
            depth_m: per(sum(2), with_depth),
            free_alpha: per(sum(3), free),
            isotropic_m: sum(5) / (3.0 * count),
            opacity: sum(6) / count,
            scale_m: sum(7) / (3.0 * count),
            foreground_mse: per(sum(1), 3 * foreground),
            total: 0.0,
        };
        terms.weighted(settings)
    }

    /// Terms of iterations that are over, in their order.
    pub fn take_finished(&mut self) -> Vec<LossTerms> {
        self.finished.drain(..).collect()
    }
}
