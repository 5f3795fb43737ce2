//! Keyframes on the GPU, with what the loss needs of them and no iteration changes.

use std::collections::BTreeMap;

use bytemuck::cast_slice;
use wgpu::{BindGroup, Buffer};

use super::buffers::Bytes;
use super::context::Context;
use super::error::GpuError;
use super::kernels::Kernels;
use crate::frame::TILE;
use crate::metrics;
use crate::ssim;
use crate::view::TrainingView;

/// What `keyframe.wgsl` has instead of a depth.
const IGNORED: f32 = -1.0;
const FREE: f32 = -2.0;
const HAS_FOREGROUND: u32 = 1;
const NEAR_FOREGROUND: u32 = 2;
/// Most bytes that keyframes take, unless the options say otherwise.
const KEYFRAMES_MAX: u64 = 512 << 20;

/// Bindings of the kernels of the loss, which see the same of a keyframe. They keep its buffers alive.
#[derive(Clone)]
pub(super) struct Seen {
    pub ssim: BindGroup,
    pub loss: BindGroup,
}

pub(super) struct DeviceKeyframe {
    pub seen: Seen,
    pub bytes: u64,
    /// When it was last used, to let go of the oldest.
    pub used: u64,
}

impl DeviceKeyframe {
    pub fn upload(context: &Context, kernels: &Kernels, view: &TrainingView) -> Result<Self, GpuError> {
        let (width, height) = (view.camera().width as usize, view.camera().height as usize);
        let (tiles_x, tiles_y) = (width.div_ceil(TILE), height.div_ceil(TILE));
        let mut pixels = vec![[0.0_f32; 4]; width * height];
        let mut planes = [const { Vec::<f64>::new() }; 3];
        for y in 0..height {
            for x in 0..width {
                let tile = &view.tiles[y / TILE * tiles_x + x / TILE];
                let (row, at) = (y % TILE, y % TILE * TILE + x % TILE);
                let is = |mask: &[u16; TILE]| mask[row] >> (x % TILE) & 1 == 1;
                let depth = match (is(&tile.foreground), is(&tile.has_depth), is(&tile.free)) {
                    (true, true, _) => tile.depth.0[at],
                    (true, false, _) => 0.0,
                    (false, _, true) => FREE,
                    (false, _, false) => IGNORED,
                };
                let color: [f32; 3] = std::array::from_fn(|k| tile.color[k].0[at]);
                pixels[y * width + x] = [color[0], color[1], color[2], depth];
                for (plane, value) in planes.iter_mut().zip(color) {
                    plane.push(f64::from(value));
                }
            }
        }
        let squares = planes.each_ref().map(|plane| plane.iter().map(|v| v * v).collect::<Vec<f64>>());
        let means: Vec<f32> = planes
            .iter()
            .chain(&squares)
            .flat_map(|plane| metrics::blur(plane, width, height))
            .map(|mean| mean as f32)
            .collect();
        let mut needed = Vec::new();
        ssim::needed(&view.tiles, (tiles_x, tiles_y), &mut needed);
        let flags: Vec<u32> = needed
            .iter()
            .map(|tile| u32::from(tile.gradient) * HAS_FOREGROUND + u32::from(tile.similarity) * NEAR_FOREGROUND)
            .collect();

        let mut bytes = Bytes::default();
        let mut put = |what: &'static str, contents: &[u8]| -> Result<Buffer, GpuError> {
            let buffer = context.filled(what, contents)?;
            bytes.add(what, &buffer);
            Ok(buffer)
        };
        let buffers = [
            put("keyframes", cast_slice(&pixels))?,
            put("keyframes", cast_slice(&means))?,
            put("keyframes", cast_slice(&flags))?,
        ];
        context.check()?;
        let seen = [&buffers[0], &buffers[1], &buffers[2]];
        Ok(Self {
            seen: Seen {
                ssim: kernels.ssim.bind_second(context, &seen),
                loss: kernels.loss.bind_second(context, &seen),
            },
            bytes: bytes.into_list().iter().map(|(_, bytes)| bytes).sum(),
            used: 0,
        })
    }
}

/// Keyframes by [`TrainingView::id`].
pub(super) struct Keyframes {
    held: BTreeMap<u64, DeviceKeyframe>,
    /// How often one was asked for, to know which was used last.
    clock: u64,
    /// Most bytes that they take.
    most: u64,
}

impl Keyframes {
    /// None yet, of at most so many bytes; 0: the default.
    pub fn new(most: u64) -> Self {
        Self { held: BTreeMap::new(), clock: 0, most: if most == 0 { KEYFRAMES_MAX } else { most } }
    }

    pub fn bytes(&self) -> u64 {
        self.held.values().map(|keyframe| keyframe.bytes).sum()
    }

    /// What the loss needs of a keyframe; brings it to the GPU where it is not there, and makes room for it. Who was given one
    /// that has to go may still use it.
    pub fn hold(&mut self, context: &Context, kernels: &Kernels, view: &TrainingView) -> Result<Seen, GpuError> {
        self.clock += 1;
        if let Some(keyframe) = self.held.get_mut(&view.id()) {
            keyframe.used = self.clock;
            return Ok(keyframe.seen.clone());
        }
        let keyframe = DeviceKeyframe { used: self.clock, ..DeviceKeyframe::upload(context, kernels, view)? };
        while self.bytes() + keyframe.bytes > self.most {
            let oldest = self.held.iter().min_by_key(|(_, keyframe)| keyframe.used).map(|(&id, _)| id);
            match oldest {
                Some(id) => self.held.remove(&id),
                None => break,
            };
        }
        let seen = keyframe.seen.clone();
        self.held.insert(view.id(), keyframe);
        Ok(seen)
    }
}
