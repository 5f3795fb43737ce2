//! A copy of the model under training that comes to the host while training goes on.

use wgpu::Buffer;

use super::context::{Mapping, copy};
use super::engine::Engine;
use super::error::GpuError;
use super::model::DeviceModel;
use crate::model::Gaussians;

/// A copy on its way.
pub(super) struct Copying {
    staging: Buffer,
    mapping: Mapping,
    /// How often iterations had been taken back when it was begun.
    taken_back: u64,
}

impl Copying {
    pub fn bytes(&self) -> u64 {
        self.staging.size()
    }
}

impl Engine {
    /// Begins to copy the model as the iterations that were asked for so far leave it; an earlier copy is forgotten. Does
    /// not wait.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn begin_copy(&mut self) -> Result<(), GpuError> {
        self.forget_copy();
        let Some(model) = &self.model else { return Ok(()) };
        if let Some(trainer) = &mut self.trainer {
            trainer.submit(&self.context, &self.kernels, model)?;
        }
        let (parameters, bands) = (model.parameters.size(), model.bands.size());
        let bytes = parameters + bands;
        let held = self.copy_staging.take().filter(|staging| staging.size() == bytes);
        let staging = held.unwrap_or_else(|| self.context.staging(bytes));
        let mut encoder = self.context.encoder();
        encoder.copy_buffer_to_buffer(&model.parameters, 0, &staging, 0, parameters);
        encoder.copy_buffer_to_buffer(&model.bands, 0, &staging, parameters, bands);
        self.context.queue.submit([encoder.finish()]);
        let mapping = Mapping::begin(&staging);
        self.copying = Some(Copying { staging, mapping, taken_back: self.taken_back });
        self.context.check()
    }

    /// Puts what was copied into `gaussians`, the model that was uploaded; `false` where it has not arrived yet, which with
    /// `wait` it has. Where iterations had to be done again meanwhile it is copied anew, and is then newer.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn take_copy(&mut self, gaussians: &mut Gaussians, wait: bool) -> Result<bool, GpuError> {
        loop {
            if wait && self.copying.is_some() {
                self.context.wait()?;
            }
            // First the iterations that were submitted before it: whether they count is known no later than the copy.
            self.collect(false)?;
            let Some(copying) = &self.copying else { return Ok(false) };
            match copying.mapping.arrived() {
                Some(result) => result?,
                None if wait => return Err(GpuError::Lost("a readback never arrived".to_owned())),
                None => return Ok(false),
            }
            let (Some(Copying { staging, taken_back, .. }), Some(model)) = (self.copying.take(), &self.model) else {
                return Ok(false);
            };
            let bytes = copy(&staging, staging.size())?;
            self.copy_staging = Some(staging);
            if taken_back == self.taken_back {
                fill(gaussians, model, &bytes);
                return Ok(true);
            }
            self.begin_copy()?;
        }
    }

    /// Gives up a copy that is on its way.
    pub fn forget_copy(&mut self) {
        if let Some(Copying { staging, .. }) = self.copying.take() {
            // One that is still to arrive is unmapped by that, and its callback told so.
            staging.unmap();
            self.copy_staging = Some(staging);
        }
    }
}

fn fill(gaussians: &mut Gaussians, model: &DeviceModel, bytes: &[u8]) {
    let (parameters, bands) = bytes.split_at(model.parameters.size() as usize);
    model.fill(gaussians, parameters, bands);
}
