//! Pruning on the GPU: kernels decide, and leave to the host what rounding could decide otherwise.

use std::collections::BTreeMap;

use bytemuck::{Pod, Zeroable, bytes_of, cast_slice, pod_collect_to_vec};
use glam::Vec3;
use wgpu::{Buffer, ComputePassDescriptor};

use super::chain::dispatch;
use super::context::Context;
use super::engine::Engine;
use super::error::GpuError;
use super::job::fold;
use crate::model::LANES;
use crate::rgbd::prune::{self, DepthView, PruneRules};

/// Most bytes of depth images that stay on the GPU between prunings; others go up each time.
const DEPTHS_MAX: u64 = 64 << 20;
/// Verdicts, as in `prune.wgsl`.
const KEEP: u32 = 0;
pub(super) const ASK: u32 = 2;

/// What `prune_view.wgsl` is told.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
struct Look {
    rotation: [[f32; 4]; 3],
    intrinsics: [f32; 4],
    gaussians: u32,
    width: u32,
    height: u32,
    front_m: f32,
}

impl Look {
    fn new(view: &DepthView<'_>, gaussians: u32, front_m: f32) -> Self {
        let camera = view.camera;
        let eye = camera.world_from_camera.translation.to_array();
        // By what the host does to the axes: a rotation that is not quite of unit length scales a little.
        let inverse = camera.world_from_camera.inverse().rotation;
        let columns = [Vec3::X, Vec3::Y, Vec3::Z].map(|axis| (inverse * axis).to_array());
        let row = |i: usize| [columns[0][i], columns[1][i], columns[2][i], eye[i]];
        Self {
            rotation: [row(0), row(1), row(2)],
            intrinsics: [camera.fx, camera.fy, camera.cx, camera.cy],
            gaussians,
            width: camera.width,
            height: camera.height,
            front_m,
        }
    }
}

/// What `prune.wgsl` is told.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
struct Rules {
    low: [f32; 3],
    opacity: f32,
    high: [f32; 3],
    sigma_m: f32,
    gaussians: u32,
    front_views: u32,
    padding: [u32; 2],
}

/// Depth images by [`DepthView::id`].
#[derive(Default)]
pub(super) struct Depths(BTreeMap<u64, Buffer>);

impl Depths {
    pub fn bytes(&self) -> u64 {
        self.0.values().map(Buffer::size).sum()
    }

    /// Forgets all but those of these views.
    fn keep_only(&mut self, views: &[DepthView<'_>]) {
        self.0.retain(|id, _| views.iter().any(|view| view.id == *id));
    }

    /// The depth image of a view, and whether it stays.
    fn get(&mut self, context: &Context, view: &DepthView<'_>) -> Result<(Buffer, bool), GpuError> {
        if let Some(held) = self.0.get(&view.id) {
            return Ok((held.clone(), true));
        }
        // Pixels that are missing were not measured.
        let mut depths = view.depth_m.to_vec();
        depths.resize(view.camera.pixels(), 0.0);
        let buffer = context.filled("depth images", cast_slice(&depths))?;
        let stays = self.bytes() + buffer.size() <= DEPTHS_MAX;
        if stays {
            self.0.insert(view.id, buffer.clone());
        }
        Ok((buffer, stays))
    }
}

impl Engine {
    /// Which Gaussians of the model under training to keep, as [`prune::keep`], after all iterations that were asked for.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub(crate) fn keep(&mut self, views: &[DepthView<'_>], rules: &PruneRules) -> Result<Vec<bool>, GpuError> {
        let verdicts = self.verdicts(views, rules)?;
        let asked: Vec<u32> = (0..).zip(&verdicts).filter(|(_, v)| **v == ASK).map(|(index, _)| index).collect();
        let mut kept: Vec<bool> = verdicts.iter().map(|&verdict| verdict == KEEP).collect();
        if let (false, Some(model)) = (asked.is_empty(), &self.model) {
            let model = model.some(&self.context, &self.kernels, &asked)?;
            for (&index, keep) in asked.iter().zip(prune::keep(&model, views, rules)) {
                kept[index as usize] = keep;
            }
        }
        Ok(kept)
    }

    /// What the kernels say of each Gaussian.
    pub(super) fn verdicts(&mut self, views: &[DepthView<'_>], rules: &PruneRules) -> Result<Vec<u32>, GpuError> {
        self.finish()?;
        let Some(model) = &self.model else { return Ok(Vec::new()) };
        let (context, kernels, count) = (&self.context, &self.kernels, model.gaussians);
        let (x, y) = fold(count.div_ceil(256));
        let looked_through = context.storage("pruning", 4 * u64::from(count))?;
        let words = u64::from(count).div_ceil(LANES as u64);
        let verdicts = context.storage("pruning", 4 * words)?;
        self.depths.keep_only(views);
        for view in views.iter().filter(|_| rules.front_views > 0) {
            let (depths, stays) = self.depths.get(context, view)?;
            let constant = context.constant(bytes_of(&Look::new(view, count, rules.front_m)));
            let buffers = [&constant, &model.parameters, &depths, &looked_through];
            let group = kernels.prune_view.bind(context, 0, &buffers);
            let mut encoder = context.encoder();
            let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor::default());
            dispatch(&mut pass, &kernels.prune_view, &group, &[0, 0], (x, y, 1));
            drop(pass);
            context.queue.submit([encoder.finish()]);
            if !stays {
                // So that no more than one of them is there at a time.
                drop(depths);
                context.wait()?;
            }
        }
        let told = Rules {
            low: rules.clip.min.to_array(),
            opacity: rules.min_opacity,
            high: rules.clip.max.to_array(),
            sigma_m: rules.max_sigma_m,
            gaussians: count,
            front_views: rules.front_views,
            ..Rules::default()
        };
        let constant = context.constant(bytes_of(&told));
        let buffers = [&constant, &model.parameters, &looked_through, &verdicts];
        let group = kernels.prune.bind(context, 0, &buffers);
        let mut encoder = context.encoder();
        let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor::default());
        dispatch(&mut pass, &kernels.prune, &group, &[0, 0], (x, y, 1));
        drop(pass);
        context.queue.submit([encoder.finish()]);
        let [bytes] = context.read([(&verdicts, 4 * words)])?;
        let words: Vec<u32> = pod_collect_to_vec(&bytes);
        Ok((0..count as usize).map(|index| words[index / LANES] >> (2 * (index % LANES)) & 3).collect())
    }
}
