//! One iteration alone: its gradient, or how long each of its stages takes.

use bytemuck::{bytes_of, pod_collect_to_vec};
use wgpu::{BufferUsages, ComputePassDescriptor};

use super::context::Context;
use super::error::GpuError;
use super::iteration::{Iteration, job};
use super::kernels::Kernels;
use super::keyframe::Keyframes;
use super::model::DeviceModel;
use super::training::{Last, RING_WORDS, STAGES, Stage, Trainer};
use crate::settings::{LossTerms, TrainingSettings};
use crate::view::TrainingView;

/// A loss and its gradient, as bytes in the layout of the model.
pub(super) struct Gradients {
    pub terms: LossTerms,
    pub parameters: Vec<u8>,
    pub bands: Vec<u8>,
}

impl Trainer {
    /// Runs one iteration with every stage in a pass of its own, and tells how long each took on the GPU, seconds. Nothing
    /// may be under way, and room for the pairs must be known. Needs timestamps.
    pub fn profile(
        &mut self,
        context: &Context,
        kernels: &Kernels,
        (model, keyframes): (&DeviceModel, &mut Keyframes),
        view: &TrainingView,
        settings: &TrainingSettings,
    ) -> Result<[f64; STAGES], GpuError> {
        const STAMPS: u32 = 2 * STAGES as u32;
        let keyframe = keyframes.hold(context, kernels, view)?;
        let iteration = Iteration::new(view, keyframe, settings, false);
        context.queue.write_buffer(&self.jobs, 0, bytes_of(&job(self.chain.size, model, 0, &iteration)));
        context.queue.write_buffer(&self.views, 0, bytes_of(&iteration.view));
        let stamps = context.device.create_query_set(&wgpu::QuerySetDescriptor {
            label: None,
            ty: wgpu::QueryType::Timestamp,
            count: STAMPS,
        });
        let bytes = 8 * u64::from(STAMPS);
        let resolved = context.buffer("timestamps", bytes, BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC);
        let mut encoder = context.encoder();
        for (at, stage) in (0..).zip(Stage::ALL) {
            let timestamp_writes = Some(wgpu::ComputePassTimestampWrites {
                query_set: &stamps,
                beginning_of_pass_write_index: Some(2 * at),
                end_of_pass_write_index: Some(2 * at + 1),
            });
            let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor { label: None, timestamp_writes });
            self.record_stage(stage, &mut pass, kernels, &iteration.keyframe, &[0, 0], Last::Step(&iteration));
        }
        encoder.resolve_query_set(&stamps, 0..STAMPS, &resolved, 0);
        context.queue.submit([encoder.finish()]);
        let [ticks] = context.read([(&resolved, bytes)])?;
        let ticks: Vec<u64> = pod_collect_to_vec(&ticks);
        let period_s = 1e-9 * f64::from(context.queue.get_timestamp_period());
        Ok(std::array::from_fn(|at| ticks[2 * at + 1].saturating_sub(ticks[2 * at]) as f64 * period_s))
    }

    /// The loss of a keyframe and its gradient by every parameter, without a step: parameters and bands as the model has
    /// them. `Err` holds how many pairs must have room where lists did not fit.
    pub fn gradient(
        &mut self,
        context: &Context,
        kernels: &Kernels,
        (model, keyframes): (&DeviceModel, &mut Keyframes),
        view: &TrainingView,
        settings: &TrainingSettings,
    ) -> Result<Result<Gradients, u32>, GpuError> {
        let keyframe = keyframes.hold(context, kernels, view)?;
        let iteration = Iteration::new(view, keyframe, settings, false);
        let out = context.storage("gradients", model.parameters.size())?;
        let bands_out = context.storage("gradients", model.bands.size())?;
        let group = kernels.gradient.bind(
            context,
            1,
            &[
                &self.jobs,
                &self.views,
                &model.parameters,
                &model.bands,
                &self.gradients,
                &out,
                &bands_out,
                &self.chain.control,
            ],
        );
        context.queue.write_buffer(&self.jobs, 0, bytes_of(&job(self.chain.size, model, 0, &iteration)));
        context.queue.write_buffer(&self.views, 0, bytes_of(&iteration.view));
        let mut encoder = context.encoder();
        let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor::default());
        self.record(&mut pass, kernels, &iteration.keyframe, &[0, 0], Last::Gradient(&group));
        drop(pass);
        context.queue.submit([encoder.finish()]);
        let [words, parameters, bands] =
            context.read([(&self.ring, 4 * RING_WORDS as u64), (&out, out.size()), (&bands_out, bands_out.size())])?;
        let words: Vec<u32> = pod_collect_to_vec(&words);
        Ok(match words[8] {
            0 => Err(words[9]),
            _ => Ok(Gradients { terms: self.terms(&words, &iteration), parameters, bands }),
        })
    }
}
