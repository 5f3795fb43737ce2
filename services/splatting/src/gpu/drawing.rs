//! A chain that draws and does not train: one image, or one batch of views after the other.

use bytemuck::{bytes_of, cast_slice, pod_collect_to_vec};
use wgpu::{Buffer, BufferUsages, ComputePassDescriptor};

use super::chain::{Chain, Size, views_buffer};
use super::context::Context;
use super::engine::Engine;
use super::error::GpuError;
use super::job::{CONTROL_HALT, CONTROL_PAIRS, JOB_BYTES, Job, View};
use super::kernels::Kernels;
use super::model::DeviceModel;
use crate::model::{sh_rest_coefficients, sh_rest_rows};

/// Buffers of a chain with a job of its own.
pub(super) struct Drawing {
    pub job: Buffer,
    pub views: Buffer,
    pub chain: Chain,
}

impl Drawing {
    /// Room for as many views as `size` says.
    pub fn new(engine: &Engine, model: &DeviceModel, size: Size, sh_degree: u8) -> Result<Self, GpuError> {
        let context = &engine.context;
        let job = context.buffer("jobs", JOB_BYTES, BufferUsages::UNIFORM | BufferUsages::COPY_DST);
        let degree = model.sh_degree.min(sh_degree);
        let described = Job {
            bands: sh_rest_coefficients(degree) as u32,
            band_rows: sh_rest_rows(model.sh_degree) as u32,
            ..size.job()
        };
        context.queue.write_buffer(&job, 0, bytes_of(&described));
        let views = views_buffer(context, size.views)?;
        let chain = Chain::new(context, &engine.kernels, model, size, (&job, &views))?;
        Ok(Self { job, views, chain })
    }

    /// The views that are drawn next: at most as many as there is room for.
    pub fn describe(&mut self, context: &Context, views: &[View]) {
        context.queue.write_buffer(&self.views, 0, cast_slice(views));
        self.chain.views = views.len() as u32;
    }

    /// Runs the chain and what `last` records after it.
    pub fn run(
        &self,
        engine: &Engine,
        last: impl FnOnce(&mut wgpu::ComputePass<'_>, &Kernels),
    ) -> Result<(), GpuError> {
        let mut encoder = engine.context.encoder();
        let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor::default());
        self.chain.record_all(&mut pass, &engine.kernels, &[0, 0]);
        last(&mut pass, &engine.kernels);
        drop(pass);
        engine.context.queue.submit([encoder.finish()]);
        engine.context.check()
    }
}

/// How many pairs a view had, where there was no room for them.
pub(super) fn overflow(control: &[u8]) -> Option<u32> {
    let words: Vec<u32> = pod_collect_to_vec(control);
    (words[CONTROL_HALT] != 0).then(|| words[CONTROL_PAIRS])
}
