//! Many views of a model at once: their moments, or what they are scored by.

use std::sync::atomic::{AtomicBool, Ordering};

use bytemuck::{Pod, Zeroable, cast_slice, pod_collect_to_vec};
use rayon::prelude::*;
use wgpu::Buffer;

use super::chain::{Size, dispatch};
use super::context::Context;
use super::drawing::{Drawing, overflow};
use super::engine::Engine;
use super::error::GpuError;
use super::job::{VIEWS_MAX, View};
use super::kernels::{Kernel, Kernels};
use super::model::DeviceModel;
use crate::camera::{Camera, RenderSettings};
use crate::engine::{Moments, MomentsView};
use crate::model::Gaussians;
use crate::uncertainty::variance::Sums;
use crate::uncertainty::{Uncertainty, UncertaintySettings, VarianceMode, footprint};

/// Most bytes of a batch of views; more views are rendered one batch after the other.
const BATCH_BYTES: u64 = 256 << 20;

/// What becomes of the moments of a batch.
trait Ending {
    /// Bytes that each view leaves.
    fn bytes_per_view(size: &Size) -> u64;
    /// What makes them.
    fn kernel(kernels: &Kernels) -> &Kernel;
    /// What the kernel reads besides the lists.
    fn inputs(&self, context: &Context, size: &Size, views: &[MomentsView]) -> Result<Vec<Buffer>, GpuError>;
    /// Takes what a batch left, from the view `first` on.
    fn take(&self, first: usize, size: &Size, views: &[MomentsView], bytes: &[u8]);
}

impl Engine {
    /// Renders the moments of many views in as few chains as their memory allows, and gives each to `visit`, as
    /// [`crate::Engine::moments_batch`]. Views of other sizes than the first make chains of their own.
    ///
    /// # Errors
    /// [`GpuError::Cancelled`] where `cancel` became true before the last chain was begun; otherwise where the GPU fails.
    pub fn moments_batch(
        &mut self,
        gaussians: &Gaussians,
        views: &[MomentsView],
        settings: &RenderSettings,
        cancel: &AtomicBool,
        visit: impl Fn(usize, &Moments) + Sync,
    ) -> Result<(), GpuError> {
        self.batches(gaussians, views, settings, cancel, &Planes(visit))
    }

    /// What many views are scored by, as [`crate::Backend::uncertainties`]. No image leaves the GPU.
    ///
    /// # Errors
    /// As [`Engine::moments_batch`].
    pub fn uncertainties(
        &mut self,
        gaussians: &Gaussians,
        cameras: &[Camera],
        (settings, render): (&UncertaintySettings, &RenderSettings),
        cancel: &AtomicBool,
        visit: impl Fn(usize, Uncertainty) + Sync,
    ) -> Result<(), GpuError> {
        let views: Vec<MomentsView> = cameras.iter().map(|camera| settings.view(camera)).collect();
        self.batches(gaussians, &views, render, cancel, &Variances { settings: *settings, visit })
    }

    fn batches<E: Ending>(
        &mut self,
        gaussians: &Gaussians,
        views: &[MomentsView],
        settings: &RenderSettings,
        cancel: &AtomicBool,
        ending: &E,
    ) -> Result<(), GpuError> {
        let model = DeviceModel::upload(&self.context, gaussians, None)?;
        let mut drawing: Option<(Drawing, Buffer)> = None;
        let mut done = 0;
        while done < views.len() {
            if cancel.load(Ordering::Relaxed) {
                return Err(GpuError::Cancelled);
            }
            let camera = views[done].camera;
            let fits = |view: &MomentsView| (view.camera.width, view.camera.height) == (camera.width, camera.height);
            let same = views[done..].iter().take_while(|view| fits(view)).count();
            let one = self.size(&model, 1, &camera);
            let room = self.views_at_once(&one, E::bytes_per_view(&one)).min(views.len());
            let size = Size { views: room as u32, ..one };
            let batch = &views[done..done + same.min(room)];
            let (drawing_ref, out) = match drawing.take().filter(|(drawing, _)| drawing.chain.size == size) {
                Some(held) => drawing.insert(held),
                None => {
                    let out = self.context.storage("moments", E::bytes_per_view(&size) * room as u64)?;
                    drawing.insert((Drawing::new(self, &model, size, 0)?, out))
                }
            };
            match self.one_batch(drawing_ref, out, batch, settings, ending)? {
                Ok(bytes) => {
                    ending.take(done, &size, batch, &bytes);
                    done += batch.len();
                }
                // The lists did not fit: once more, with more room.
                Err(pairs) => self.make_room(pairs),
            }
        }
        Ok(())
    }

    /// What the views of a batch leave; `Err` holds how many pairs must have room where lists did not fit.
    fn one_batch<E: Ending>(
        &self,
        drawing: &mut Drawing,
        out: &Buffer,
        batch: &[MomentsView],
        settings: &RenderSettings,
        ending: &E,
    ) -> Result<Result<Vec<u8>, u32>, GpuError> {
        let size = drawing.chain.size;
        let described: Vec<View> =
            batch.iter().map(|view| View::new(&view.camera, settings, view.reference_m)).collect();
        drawing.describe(&self.context, &described);
        let inputs = ending.inputs(&self.context, &size, batch)?;
        let chain = &drawing.chain;
        let mut buffers = vec![&drawing.job, &drawing.views, &chain.rows, &chain.starts, &chain.entries, out];
        buffers.extend(&inputs);
        let group = E::kernel(&self.kernels).bind(&self.context, size.views.into(), &buffers);
        let count = batch.len() as u32;
        drawing.run(self, |pass, kernels| {
            dispatch(pass, E::kernel(kernels), &group, &[0, 0], (size.tiles_x(), size.tiles_y(), count));
        })?;
        let bytes = E::bytes_per_view(&size) * u64::from(count);
        let [control, bytes] = self.context.read([(&chain.control, 16), (out, bytes)])?;
        Ok(overflow(&control).map_or(Ok(bytes), Err))
    }

    /// Views of this size that fit a chain and leave so many bytes each.
    fn views_at_once(&self, size: &Size, out_bytes: u64) -> usize {
        let parts = size.bytes_per_view(out_bytes);
        let by_binding = parts.iter().map(|&bytes| self.context.max_binding / bytes.max(1)).min().unwrap_or(1);
        let by_memory = BATCH_BYTES / parts.iter().sum::<u64>().max(1);
        by_binding.min(by_memory).clamp(1, VIEWS_MAX.into()) as usize
    }
}

/// Moments as they are: three planes of each view.
struct Planes<V>(V);

impl<V: Fn(usize, &Moments) + Sync> Ending for Planes<V> {
    fn bytes_per_view(size: &Size) -> u64 {
        12 * size.pixels()
    }

    fn kernel(kernels: &Kernels) -> &Kernel {
        &kernels.moments_store
    }

    fn inputs(&self, _: &Context, _: &Size, _: &[MomentsView]) -> Result<Vec<Buffer>, GpuError> {
        Ok(Vec::new())
    }

    fn take(&self, first: usize, size: &Size, views: &[MomentsView], bytes: &[u8]) {
        let (width, height, pixels) = (size.width, size.height, size.pixels() as usize);
        let planes: Vec<f32> = pod_collect_to_vec(bytes);
        planes.par_chunks(3 * pixels.max(1)).zip(views).enumerate().for_each(|(index, (planes, view))| {
            let plane = |k: usize| planes[k * pixels..(k + 1) * pixels].to_vec();
            let reference_m = view.reference_m;
            let moments = Moments { width, height, reference_m, alpha: plane(0), first: plane(1), second: plane(2) };
            (self.0)(first + index, &moments);
        });
    }
}

/// Sums over the pixels that count of each tile.
struct Variances<V> {
    settings: UncertaintySettings,
    visit: V,
}

/// The box as a view sees it, as in `moments_variance.wgsl`.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
struct Candidate {
    low: [f32; 4],
    high: [f32; 4],
    edge: [f32; 4],
}

impl Candidate {
    fn new(camera: &Camera, settings: &UncertaintySettings) -> Self {
        let cube = &settings.bounding_box;
        let center = cube.center_m - camera.world_from_camera.translation.as_dvec3();
        let [low, high] = [-0.5, 0.5].map(|half| (center + half * cube.size_m).as_vec3().to_array());
        let normalised = f32::from(u8::from(settings.mode == VarianceMode::Normalised));
        Self {
            low: [low[0], low[1], low[2], settings.transparent_alpha as f32],
            high: [high[0], high[1], high[2], normalised],
            edge: [cube.size_m as f32, 0.0, 0.0, 0.0],
        }
    }
}

impl<V: Fn(usize, Uncertainty) + Sync> Ending for Variances<V> {
    fn bytes_per_view(size: &Size) -> u64 {
        16 * u64::from(size.tiles())
    }

    fn kernel(kernels: &Kernels) -> &Kernel {
        &kernels.moments_variance
    }

    fn inputs(&self, context: &Context, size: &Size, views: &[MomentsView]) -> Result<Vec<Buffer>, GpuError> {
        let height = size.height as usize;
        let mut spans = vec![0_u32; height * views.len()];
        for (view, rows) in views.iter().zip(spans.chunks_mut(height.max(1))) {
            let outline = self.settings.bounding_box.outline(&view.camera);
            for (row, first, end) in footprint::covered_pixels(&outline, size.width, size.height) {
                rows[row as usize] = first | end << 16;
            }
        }
        let candidates: Vec<Candidate> =
            views.iter().map(|view| Candidate::new(&view.camera, &self.settings)).collect();
        let buffers = [("box", cast_slice(&spans)), ("box", cast_slice(&candidates))];
        buffers
            .into_iter()
            .map(|(what, bytes): (_, &[u8])| {
                let buffer = context.storage(what, bytes.len() as u64)?;
                context.queue.write_buffer(&buffer, 0, bytes);
                Ok(buffer)
            })
            .collect()
    }

    fn take(&self, first: usize, size: &Size, views: &[MomentsView], bytes: &[u8]) {
        let sums: Vec<[f32; 4]> = pod_collect_to_vec(bytes);
        for (index, (tiles, view)) in sums.chunks(size.tiles().max(1) as usize).zip(views).enumerate() {
            let outline = self.settings.bounding_box.outline(&view.camera);
            let rows = footprint::covered_pixels(&outline, size.width, size.height);
            let sum = |k: usize| tiles.iter().map(|tile| f64::from(tile[k])).sum();
            let sums = Sums {
                variance: sum(0),
                alpha: sum(1),
                transparent: sum(2),
                pixels: rows.iter().map(|(_, first, end)| end - first).sum(),
            };
            (self.visit)(first + index, sums.uncertainty(footprint::area(&outline) / size.pixels() as f64));
        }
    }
}
