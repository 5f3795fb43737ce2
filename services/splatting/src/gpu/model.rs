//! A model and its optimiser on the GPU: the same blocks of 16 Gaussians, byte for byte.

use bytemuck::{cast_slice, cast_slice_mut, pod_collect_to_vec};
use wgpu::Buffer;

use super::buffers::Bytes;
use super::context::Context;
use super::error::GpuError;
use crate::edit::Looks;
use crate::model::{Block, Gaussians, LANES, Lanes, sh_rest_rows};
use crate::optimiser::Optimiser;
use crate::statistics::{self, ScreenStatistics};

const LANES_BYTES: u64 = size_of::<Lanes>() as u64;
pub(super) const BLOCK_BYTES: u64 = size_of::<Block>() as u64;
pub(super) const STATISTICS_BYTES: u64 = statistics::ROWS as u64 * LANES_BYTES;

/// Buffers of a model.
pub(super) struct DeviceModel {
    pub parameters: Buffer,
    pub bands: Buffer,
    pub gaussians: u32,
    pub sh_degree: u8,
    /// What only training needs.
    pub optimiser: Option<DeviceOptimiser>,
}

/// Adam's state: first moments of all blocks, then second moments. With what densification needs.
pub(super) struct DeviceOptimiser {
    pub state: Buffer,
    pub band_state: Buffer,
    pub steps: Buffer,
    /// As [`ScreenStatistics`] has them.
    pub statistics: Buffer,
    pub ids: Buffer,
}

impl DeviceModel {
    /// Copies a model to the GPU; for training with an optimiser and statistics, which must have the model's shape.
    pub fn upload(
        context: &Context,
        model: &Gaussians,
        training: Option<(&Optimiser, &ScreenStatistics)>,
    ) -> Result<Self, GpuError> {
        let blocks = model.blocks().len() as u64;
        let rows = blocks * sh_rest_rows(model.sh_degree()) as u64;
        let storage = |what: &'static str, length: u64| context.storage(what, length);
        let parameters = storage("parameters", BLOCK_BYTES * blocks)?;
        let bands = storage("parameters", LANES_BYTES * rows)?;
        let state = match training {
            Some(_) => Some(DeviceOptimiser {
                state: storage("optimiser", 2 * BLOCK_BYTES * blocks)?,
                band_state: storage("optimiser", 2 * LANES_BYTES * rows)?,
                steps: storage("optimiser", 4 * model.len() as u64)?,
                statistics: storage("densification", STATISTICS_BYTES * blocks)?,
                ids: storage("densification", 8 * model.len() as u64)?,
            }),
            None => None,
        };
        context.check()?;
        let write = |buffer: &Buffer, offset: u64, bytes: &[u8]| context.write(buffer, offset, bytes);
        write(&parameters, 0, cast_slice(model.blocks()));
        write(&bands, 0, cast_slice(model.rest()));
        if let (Some(device), Some((host, statistics))) = (&state, training) {
            write(&device.state, 0, cast_slice(&host.first));
            write(&device.state, BLOCK_BYTES * blocks, cast_slice(&host.second));
            write(&device.band_state, 0, cast_slice(&host.first_rest));
            write(&device.band_state, LANES_BYTES * rows, cast_slice(&host.second_rest));
            write(&device.steps, 0, cast_slice(&host.steps));
            write(&device.statistics, 0, cast_slice(statistics.rows()));
            write(&device.ids, 0, cast_slice(model.ids()));
        }
        // So that the copies do not wait in memory for the first iteration.
        context.queue.submit([]);
        context.check()?;
        let (gaussians, sh_degree) = (model.len() as u32, model.sh_degree());
        Ok(Self { parameters, bands, gaussians, sh_degree, optimiser: state })
    }

    /// Blocks of 16 Gaussians, of which the last may not be full.
    pub fn blocks(&self) -> u64 {
        u64::from(self.gaussians).div_ceil(LANES as u64)
    }

    /// Bytes of its buffers.
    pub fn bytes(&self) -> Bytes {
        let mut bytes = Bytes::default();
        bytes.add("parameters", &self.parameters);
        bytes.add("parameters", &self.bands);
        if let Some(optimiser) = &self.optimiser {
            let DeviceOptimiser { state, band_state, steps, statistics, ids } = optimiser;
            [state, band_state, steps].into_iter().for_each(|buffer| bytes.add("optimiser", buffer));
            [statistics, ids].into_iter().for_each(|buffer| bytes.add("densification", buffer));
        }
        bytes
    }

    /// Puts bytes of the two buffers into the model that was uploaded.
    pub fn fill(&self, model: &mut Gaussians, parameters: &[u8], bands: &[u8]) {
        let (blocks, rest) = model.parts_mut();
        // Buffers are never empty, so they may be longer than what they hold.
        let (blocks, rest) = (cast_slice_mut::<Block, u8>(blocks), cast_slice_mut::<Lanes, u8>(rest));
        blocks.copy_from_slice(&parameters[..blocks.len()]);
        rest.copy_from_slice(&bands[..rest.len()]);
    }

    /// Puts bytes of the three buffers into the optimiser.
    pub fn fill_optimiser(&self, optimiser: &mut Optimiser, state: &[u8], band_state: &[u8], steps: &[u8]) {
        let state_half = (BLOCK_BYTES * self.blocks()) as usize;
        let bands_half = (LANES_BYTES * self.blocks()) as usize * sh_rest_rows(self.sh_degree);
        // Buffers are never empty, so they may be longer than what they hold.
        let (first, second) = state[..2 * state_half].split_at(state_half);
        (optimiser.first, optimiser.second) = (pod_collect_to_vec(first), pod_collect_to_vec(second));
        let (first, second) = band_state[..2 * bands_half].split_at(bands_half);
        (optimiser.first_rest, optimiser.second_rest) = (pod_collect_to_vec(first), pod_collect_to_vec(second));
        optimiser.sh_degree = self.sh_degree;
        optimiser.steps = pod_collect_to_vec(&steps[..4 * self.gaussians as usize]);
    }

    /// Copies back what decisions about the list are made of.
    pub fn look(
        &self,
        context: &Context,
        looks: Looks,
        model: &mut Gaussians,
        statistics: &mut ScreenStatistics,
    ) -> Result<(), GpuError> {
        let parameters = (&self.parameters, BLOCK_BYTES * self.blocks());
        match (looks, &self.optimiser) {
            (Looks::Nothing, _) => {}
            (Looks::Seen, Some(device)) => {
                let seen = (&device.statistics, STATISTICS_BYTES * self.blocks());
                let [parameters, seen] = context.read([parameters, seen])?;
                cast_slice_mut::<Block, u8>(model.parts_mut().0).copy_from_slice(&parameters);
                statistics.fit(model);
                cast_slice_mut::<Lanes, u8>(statistics.rows_mut()).copy_from_slice(&seen);
            }
            (Looks::Parameters | Looks::Seen, _) => {
                let [parameters] = context.read([parameters])?;
                cast_slice_mut::<Block, u8>(model.parts_mut().0).copy_from_slice(&parameters);
            }
        }
        Ok(())
    }

    /// Copies what training changed back.
    pub fn download(
        &self,
        context: &Context,
        model: &mut Gaussians,
        (optimiser, statistics): (&mut Optimiser, &mut ScreenStatistics),
    ) -> Result<(), GpuError> {
        let Some(device) = &self.optimiser else { return Ok(()) };
        let blocks = model.blocks().len();
        let rows = blocks * sh_rest_rows(self.sh_degree);
        let (block_bytes, row_bytes) = (BLOCK_BYTES * blocks as u64, LANES_BYTES * rows as u64);
        let [parameters, bands, state, band_state, steps, seen] = context.read([
            (&self.parameters, block_bytes),
            (&self.bands, row_bytes),
            (&device.state, 2 * block_bytes),
            (&device.band_state, 2 * row_bytes),
            (&device.steps, 4 * u64::from(self.gaussians)),
            (&device.statistics, STATISTICS_BYTES * blocks as u64),
        ])?;
        self.fill(model, &parameters, &bands);
        self.fill_optimiser(optimiser, &state, &band_state, &steps);
        statistics.fit(model);
        cast_slice_mut::<Lanes, u8>(statistics.rows_mut()).copy_from_slice(&seen);
        Ok(())
    }
}
