//! Changes of the list of Gaussians on the GPU: every array of the model is gathered anew, and what is no copy is put in.

use bytemuck::{Pod, Zeroable, bytes_of, cast_slice};
use wgpu::{Buffer, ComputePassDescriptor};

use super::chain::{Size, dispatch};
use super::context::Context;
use super::engine::Engine;
use super::error::GpuError;
use super::job::{Job, fold};
use super::kernels::Kernels;
use super::model::{BLOCK_BYTES, DeviceModel, DeviceOptimiser, STATISTICS_BYTES};
use super::training::Trainer;
use crate::densify::Noise;
use crate::edit::{Edit, Looks, is_fresh};
use crate::model::{Gaussians, LANES, ROWS, sh_rest_rows};
use crate::statistics::{self, ScreenStatistics};

/// What `select.wgsl` is told.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Rows {
    pub count: u32,
    pub rows: u32,
    pub lanes: u32,
    pub copies_fresh: u32,
    pub old_begin: u32,
    pub new_begin: u32,
    /// The uniform's size is a multiple of 16 bytes.
    pub padding: [u32; 2],
}

/// What `lower_opacities.wgsl` is told.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
struct Ceiling {
    gaussians: u32,
    second: u32,
    logit: f32,
    padding: u32,
}

/// A Gaussian that is no copy, as in `insert.wgsl`.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
struct Inserted {
    index: u32,
    id: [u32; 2],
    parameters: [f32; ROWS],
}

/// An array of a model: words of a Gaussian, how many Gaussians lie side by side, whether fresh ones have a copy, and how
/// often it is there, one behind the other.
#[derive(Clone, Copy)]
struct Array {
    rows: usize,
    lanes: usize,
    copies_fresh: bool,
    times: u64,
}

impl Array {
    fn blocks(rows: usize, copies_fresh: bool) -> Self {
        Self { rows, lanes: LANES, copies_fresh, times: 1 }
    }

    fn words(&self, gaussians: u64) -> u64 {
        gaussians.div_ceil(self.lanes as u64) * (self.rows * self.lanes) as u64
    }
}

/// Gathers arrays of a model by sources that are on the GPU.
struct Gather<'a> {
    context: &'a Context,
    kernels: &'a Kernels,
    sources: Buffer,
    old: u64,
    new: u64,
}

impl Gather<'_> {
    /// Replaces an array by the new one. Waits until the old one is gone, so that no more than one is there twice.
    fn replace(&self, buffer: &mut Buffer, what: &'static str, array: Array) -> Result<(), GpuError> {
        let words = array.words(self.new);
        let after = self.context.storage(what, 4 * words * array.times)?;
        let mut encoder = self.context.encoder();
        let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor::default());
        for time in 0..array.times {
            let rows = Rows {
                count: self.new as u32,
                rows: array.rows as u32,
                lanes: array.lanes as u32,
                copies_fresh: array.copies_fresh.into(),
                old_begin: (time * array.words(self.old)) as u32,
                new_begin: (time * words) as u32,
                ..Rows::default()
            };
            let constant = self.context.constant(bytes_of(&rows));
            let kernel = &self.kernels.select;
            let group = kernel.bind(self.context, 0, &[&constant, &self.sources, buffer, &after]);
            let (x, y) = fold((self.new as u32).div_ceil(256));
            dispatch(&mut pass, kernel, &group, &[0, 0], (x, y, 1));
        }
        drop(pass);
        self.context.queue.submit([encoder.finish()]);
        *buffer = after;
        self.context.wait()
    }
}

impl DeviceModel {
    fn follow(&mut self, context: &Context, kernels: &Kernels, edit: &Edit, sources: &[u32]) -> Result<(), GpuError> {
        let sources_buffer = context.filled("sources", cast_slice(sources))?;
        let (old, new) = (self.gaussians.into(), sources.len() as u64);
        let gather = Gather { context, kernels, sources: sources_buffer, old, new };
        let bands = sh_rest_rows(self.sh_degree);
        gather.replace(&mut self.parameters, "parameters", Array::blocks(ROWS, true))?;
        if bands > 0 {
            gather.replace(&mut self.bands, "parameters", Array::blocks(bands, true))?;
        }
        if let Some(DeviceOptimiser { state, band_state, steps, statistics, ids }) = &mut self.optimiser {
            gather.replace(state, "optimiser", Array { times: 2, ..Array::blocks(ROWS, false) })?;
            if bands > 0 {
                gather.replace(band_state, "optimiser", Array { times: 2, ..Array::blocks(bands, false) })?;
            }
            let words = |rows, copies_fresh| Array { rows, lanes: 1, copies_fresh, times: 1 };
            gather.replace(steps, "optimiser", words(1, false))?;
            if edit.forgets_statistics {
                *statistics = context.storage("densification", STATISTICS_BYTES * new.div_ceil(LANES as u64))?;
            } else {
                gather.replace(statistics, "densification", Array::blocks(statistics::ROWS, false))?;
            }
            gather.replace(ids, "densification", words(2, true))?;
        }
        self.gaussians = sources.len() as u32;
        Ok(())
    }

    /// Puts the fresh ones of `after` in.
    fn insert(&self, context: &Context, kernels: &Kernels, sources: &[u32], after: &Gaussians) -> Result<(), GpuError> {
        let Some(optimiser) = &self.optimiser else { return Ok(()) };
        let fresh = sources.iter().enumerate().filter(|(_, source)| is_fresh(**source));
        let rows: Vec<Inserted> = fresh
            .map(|(index, _)| {
                let gaussian = after.get(index);
                let id = [gaussian.id as u32, (gaussian.id >> 32) as u32];
                Inserted { index: index as u32, id, parameters: gaussian.row() }
            })
            .collect();
        if rows.is_empty() {
            return Ok(());
        }
        let constant = context.constant(bytes_of(&[rows.len() as u32, 0, 0, 0]));
        let rows_buffer = context.filled("inserted Gaussians", cast_slice(&rows))?;
        let kernel = &kernels.insert;
        let group = kernel.bind(context, 0, &[&constant, &rows_buffer, &self.parameters, &optimiser.ids]);
        let mut encoder = context.encoder();
        let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor::default());
        let (x, y) = fold((rows.len() as u32).div_ceil(256));
        dispatch(&mut pass, kernel, &group, &[0, 0], (x, y, 1));
        drop(pass);
        context.queue.submit([encoder.finish()]);
        context.check()
    }

    fn lower_opacities(&self, context: &Context, kernels: &Kernels, logit: f32) -> Result<(), GpuError> {
        let Some(optimiser) = &self.optimiser else { return Ok(()) };
        let second = (BLOCK_BYTES * self.blocks() / 4) as u32;
        let constant = context.constant(bytes_of(&Ceiling { gaussians: self.gaussians, second, logit, padding: 0 }));
        let kernel = &kernels.lower_opacities;
        let group = kernel.bind(context, 0, &[&constant, &self.parameters, &optimiser.state]);
        let mut encoder = context.encoder();
        let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor::default());
        let (x, y) = fold(self.gaussians.div_ceil(256));
        dispatch(&mut pass, kernel, &group, &[0, 0], (x, y, 1));
        drop(pass);
        context.queue.submit([encoder.finish()]);
        context.check()
    }

    /// Parameters of some Gaussians alone, as a model whose ids are their indices.
    pub fn some(&self, context: &Context, kernels: &Kernels, indices: &[u32]) -> Result<Gaussians, GpuError> {
        let sources = context.filled("sources", cast_slice(indices))?;
        let (old, new) = (self.gaussians.into(), indices.len() as u64);
        let gather = Gather { context, kernels, sources, old, new };
        let mut parameters = self.parameters.clone();
        gather.replace(&mut parameters, "parameters", Array::blocks(ROWS, true))?;
        let blocks = new.div_ceil(LANES as u64);
        let [bytes] = context.read([(&parameters, BLOCK_BYTES * blocks)])?;
        let ids = indices.iter().copied().map(u64::from).collect();
        Ok(Gaussians::from_parts(bytemuck::pod_collect_to_vec(&bytes), (0, Vec::new()), ids, vec![0; indices.len()]))
    }
}

impl Engine {
    /// Brings here what decisions about the list are made of, after all iterations that were asked for.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub(crate) fn look(
        &mut self,
        looks: Looks,
        gaussians: &mut Gaussians,
        statistics: &mut ScreenStatistics,
    ) -> Result<(), GpuError> {
        self.finish()?;
        match &self.model {
            Some(model) => model.look(&self.context, looks, gaussians, statistics),
            None => Ok(()),
        }
    }

    /// Does to the model under training what was done to the list; `after` has the parameters and ids of what is new.
    ///
    /// # Errors
    /// Where the GPU fails. Nothing is known of the model then.
    pub(crate) fn edit(&mut self, edit: &Edit, after: &Gaussians) -> Result<(), GpuError> {
        self.finish()?;
        let Some(model) = &mut self.model else { return Ok(()) };
        if let Some(sources) = &edit.sources {
            self.told.extend(self.trainer.take().iter_mut().flat_map(Trainer::take_finished));
            model.follow(&self.context, &self.kernels, edit, sources)?;
            model.insert(&self.context, &self.kernels, sources, after)?;
        } else if let (true, Some(optimiser)) = (edit.forgets_statistics, &model.optimiser) {
            let mut encoder = self.context.encoder();
            encoder.clear_buffer(&optimiser.statistics, 0, None);
            self.context.queue.submit([encoder.finish()]);
        }
        match edit.logit_ceiling {
            Some(ceiling) => model.lower_opacities(&self.context, &self.kernels, ceiling),
            None => self.context.check(),
        }
    }

    /// Moves the means by noise after the step that was asked for last.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub(crate) fn add_noise(&mut self, noise: &Noise) -> Result<(), GpuError> {
        if self.trainer.as_mut().is_some_and(|trainer| trainer.add_noise(noise)) {
            return Ok(());
        }
        // No step is waiting, as after a change of the list: at once.
        self.finish()?;
        let Some(model) = &self.model else { return Ok(()) };
        let Some(optimiser) = &model.optimiser else { return Ok(()) };
        let size = Size { gaussians: model.gaussians, views: 1, width: 0, height: 0, capacity: 0 };
        let job = Job {
            noise_rate: noise.rate,
            noise_opacity: noise.opacity,
            noise_sharpness: noise.sharpness,
            noise_key: noise.key,
            ..size.job()
        };
        let job = self.context.constant(bytes_of(&job));
        // It says that no list was too long.
        let control = self.context.storage("control", 16)?;
        let kernel = &self.kernels.noise;
        let group = kernel.bind(&self.context, 0, &[&job, &model.parameters, &optimiser.ids, &control]);
        let mut encoder = self.context.encoder();
        let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor::default());
        let (x, y) = fold(size.parameter_groups());
        dispatch(&mut pass, kernel, &group, &[0, 0], (x, y, 1));
        drop(pass);
        self.context.queue.submit([encoder.finish()]);
        self.context.check()
    }
}
