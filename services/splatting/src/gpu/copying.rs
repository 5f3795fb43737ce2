//! Copies of what is under training that come to the host while training goes on: of the model for a snapshot, of all of it
//! for a checkpoint.

use wgpu::Buffer;

use super::context::{Mapping, copy};
use super::engine::Engine;
use super::error::GpuError;
use crate::model::Gaussians;
use crate::optimiser::Optimiser;

/// What a copy is of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Copied {
    /// The parameters.
    Model,
    /// The parameters, then the optimiser.
    State,
}

/// Whether a copy has arrived.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrival<T> {
    /// It has.
    Here(T),
    /// Not yet, or none was begun.
    NotYet,
    /// Steps before it had to be done again, so that it is copied anew: as the steps that were asked for until now leave it.
    Anew,
}

/// A copy on its way.
struct Copying {
    staging: Buffer,
    mapping: Mapping,
    /// How often iterations had been taken back when it was begun.
    taken_back: u64,
}

/// A copy on its way, or where the last one came through.
#[derive(Default)]
pub(super) struct Slot {
    copying: Option<Copying>,
    staging: Option<Buffer>,
}

impl Slot {
    /// Bytes that the host can map.
    pub fn bytes(&self) -> u64 {
        let copying = self.copying.as_ref().map(|copying| &copying.staging);
        copying.into_iter().chain(&self.staging).map(Buffer::size).sum()
    }

    /// Gives up a copy that is on its way.
    fn forget(&mut self) {
        if let Some(Copying { staging, .. }) = self.copying.take() {
            // One that is still to arrive is unmapped by that, and its callback told so.
            staging.unmap();
            self.staging = Some(staging);
        }
    }
}

/// Copies of both kinds.
#[derive(Default)]
pub(super) struct Copies {
    pub model: Slot,
    pub state: Slot,
}

impl Copies {
    fn of(&mut self, of: Copied) -> &mut Slot {
        match of {
            Copied::Model => &mut self.model,
            Copied::State => &mut self.state,
        }
    }
}

impl Engine {
    /// Begins to copy what is under training as the iterations that were asked for so far leave it; an earlier copy of this
    /// kind is forgotten. Does not wait.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn begin_copy(&mut self, of: Copied) -> Result<(), GpuError> {
        self.copies.of(of).forget();
        let Some(model) = &self.model else { return Ok(()) };
        if let Some(trainer) = &mut self.trainer {
            trainer.submit(&self.context, &self.kernels, model)?;
        }
        let mut sources = vec![&model.parameters, &model.bands];
        if let (Copied::State, Some(optimiser)) = (of, &model.optimiser) {
            sources.extend([&optimiser.state, &optimiser.band_state, &optimiser.steps]);
            // The larger of the two is seldom on its way: its room is not kept beside that of the other.
            self.copies.model.staging = None;
        }
        let bytes = sources.iter().map(|buffer| buffer.size()).sum();
        let slot = self.copies.of(of);
        let held = slot.staging.take().filter(|staging| staging.size() == bytes);
        let staging = held.unwrap_or_else(|| self.context.staging(bytes));
        let mut encoder = self.context.encoder();
        let mut offset = 0;
        for source in sources {
            encoder.copy_buffer_to_buffer(source, 0, &staging, offset, source.size());
            offset += source.size();
        }
        self.context.queue.submit([encoder.finish()]);
        let mapping = Mapping::begin(&staging);
        slot.copying = Some(Copying { staging, mapping, taken_back: self.taken_back });
        self.context.check()
    }

    /// The copy of the model, whose shape is that of `uploaded`; `None` where it has not arrived yet, which with `wait` it
    /// has. Where iterations had to be done again meanwhile it is copied anew, and is then newer.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn take_copy(&mut self, uploaded: &Gaussians, wait: bool) -> Result<Option<Gaussians>, GpuError> {
        loop {
            match (self.arrived(Copied::Model, wait)?, &self.model) {
                (Arrival::Here(bytes), Some(model)) => {
                    let mut gaussians = uploaded.clone();
                    let (parameters, bands) = bytes.split_at(model.parameters.size() as usize);
                    model.fill(&mut gaussians, parameters, bands);
                    return Ok(Some(gaussians));
                }
                (Arrival::Anew, _) => {}
                (Arrival::NotYet | Arrival::Here(_), _) => return Ok(None),
            }
        }
    }

    /// The copy of everything, with the shape of `uploaded`. Every loss of an iteration that it holds is then told by
    /// [`Engine::finished`]. Does not wait.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn take_state(&mut self, uploaded: &Gaussians) -> Result<Arrival<(Gaussians, Optimiser)>, GpuError> {
        let bytes = match self.arrived(Copied::State, false)? {
            Arrival::Here(bytes) => bytes,
            Arrival::NotYet => return Ok(Arrival::NotYet),
            Arrival::Anew => return Ok(Arrival::Anew),
        };
        self.copies.state.staging = None;
        let Some((model, device)) = self.model.as_ref().and_then(|model| Some((model, model.optimiser.as_ref()?)))
        else {
            return Ok(Arrival::NotYet);
        };
        let mut rest = bytes.as_slice();
        let mut next = |buffer: &Buffer| {
            let (part, after) = rest.split_at(buffer.size() as usize);
            rest = after;
            part
        };
        let (mut gaussians, mut optimiser) = (uploaded.clone(), Optimiser::new());
        model.fill(&mut gaussians, next(&model.parameters), next(&model.bands));
        model.fill_optimiser(&mut optimiser, next(&device.state), next(&device.band_state), next(&device.steps));
        Ok(Arrival::Here((gaussians, optimiser)))
    }

    /// The bytes of a copy, once it has arrived.
    fn arrived(&mut self, of: Copied, wait: bool) -> Result<Arrival<Vec<u8>>, GpuError> {
        if wait && self.copies.of(of).copying.is_some() {
            self.context.wait()?;
        }
        // First the iterations that were submitted before it: whether they count is known no later than the copy.
        self.collect(false)?;
        let slot = self.copies.of(of);
        match slot.copying.as_ref().map(|copying| copying.mapping.arrived()) {
            Some(Some(result)) => result?,
            Some(None) if wait => return Err(GpuError::Lost("a readback never arrived".to_owned())),
            Some(None) | None => return Ok(Arrival::NotYet),
        }
        let Some(Copying { staging, taken_back, .. }) = slot.copying.take() else { return Ok(Arrival::NotYet) };
        let bytes = copy(&staging, staging.size())?;
        slot.staging = Some(staging);
        if taken_back == self.taken_back {
            return Ok(Arrival::Here(bytes));
        }
        self.begin_copy(of)?;
        Ok(Arrival::Anew)
    }

    /// Gives up copies that are on their way.
    pub fn forget_copies(&mut self) {
        self.copies.model.forget();
        self.copies.state.forget();
        self.copies.state.staging = None;
    }
}
