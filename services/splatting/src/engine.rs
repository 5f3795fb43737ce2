//! The CPU engine: renders images and moments, one view with all threads or many views with one thread each.

#![expect(unsafe_code, reason = "tasks write disjoint parts of shared buffers")]

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use thiserror::Error;

use crate::backward;
use crate::blend::{self, BlendTile, Channels, Contributors};
use crate::camera::{Camera, RenderSettings};
use crate::frame::{self, Frame, LAST, TILE};
use crate::loss::LossImages;
use crate::model::Gaussians;
use crate::optimiser::Corrections;
use crate::projection::ShapeBlock;
use crate::simd::{Isa, dispatch};
use crate::ssim;
use crate::workers::{PerWorker, Shared, Workers};

/// Below this alpha an expected depth is given as 0.
pub const DEPTH_ALPHA_TINY: f32 = 1e-3;

/// A rendered image, row by row.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rendered {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Colour over the background; not clamped to [0, 1].
    pub color: Vec<[f32; 3]>,
    /// Accumulated alpha, 0 to 1.
    pub alpha: Vec<f32>,
    /// Expected depth (centre z, metres) normalised by alpha; 0 where alpha is below [`DEPTH_ALPHA_TINY`].
    pub depth: Vec<f32>,
}

/// Moments of depth along each pixel's ray (A1, A7), row by row: sums over splats of weight w times powers of depth d.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Moments {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// The depth d0 that the moments are relative to, metres.
    pub reference_m: f32,
    /// Σ w = accumulated alpha.
    pub alpha: Vec<f32>,
    /// Σ w (d - d0), metres.
    pub first: Vec<f32>,
    /// Σ w (d - d0)², metres².
    pub second: Vec<f32>,
}

/// One view of a batch: its camera and the depth its moments are relative to (the box centre's, say).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MomentsView {
    /// The camera.
    pub camera: Camera,
    /// Reference depth d0, metres.
    pub reference_m: f32,
}

/// How much the last training step had to do, for benchmarks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Work {
    /// Gaussians of the model.
    pub gaussians: usize,
    /// Gaussians that may touch the image.
    pub visible: usize,
    /// Pairs of a tile and a splat that may touch it.
    pub entries: usize,
    /// Pairs of a 4x4 block and a splat that changed one of its pixels.
    pub contributions: usize,
    /// Pixels of the view.
    pub pixels: usize,
}

/// Why an engine could not be made or did not finish.
#[derive(Debug, Error)]
pub enum EngineError {
    /// The threads could not be started.
    #[error("cannot start the renderer's threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
    /// The caller's flag was set before all views were done.
    #[error("cancelled before all views were rendered")]
    Cancelled,
}

/// State of one view under work on one thread.
struct Single {
    frame: Frame,
    scratch: PerWorker<blend::Scratch>,
    moments: Moments,
}

impl Default for Single {
    fn default() -> Self {
        let scratch = PerWorker::new(&Workers::sequential());
        Self { frame: Frame::default(), scratch, moments: Moments::default() }
    }
}

/// The renderer and trainer on the CPU. Results are the same bits for any number of threads.
pub struct Engine {
    pub(crate) isa: Isa,
    pub(crate) workers: Workers,
    pub(crate) frame: Frame,
    pub(crate) blend_scratch: PerWorker<blend::Scratch>,
    pub(crate) backward_scratch: PerWorker<backward::Scratch>,
    pub(crate) ssim_scratch: PerWorker<ssim::Scratch>,
    pub(crate) contributors: Vec<Contributors>,
    pub(crate) loss: LossImages,
    /// Gradient moments of every (tile, splat), tile after tile, [`backward::MOMENTS`] each.
    pub(crate) sums: Vec<f32>,
    /// Where in `sums` each slot's moments are.
    pub(crate) places: Vec<u32>,
    pub(crate) corrections: Corrections,
    singles: PerWorker<Single>,
    shapes: Vec<ShapeBlock>,
    pub(crate) stage_times: [Duration; 7],
}

impl Engine {
    /// An engine of `threads` worker threads (0 and 1: the caller's own) and the widest instruction set there is.
    ///
    /// # Errors
    /// Where the system refuses the threads.
    pub fn new(threads: usize) -> Result<Self, EngineError> {
        Self::with_isa(threads, Isa::detect())
    }

    /// An engine with a chosen instruction set; one that the machine lacks is replaced by plain Rust.
    ///
    /// # Errors
    /// Where the system refuses the threads.
    pub fn with_isa(threads: usize, isa: Isa) -> Result<Self, EngineError> {
        let workers = Workers::new(threads)?;
        Ok(Self {
            isa: if isa.is_available() { isa } else { Isa::Portable },
            frame: Frame::default(),
            blend_scratch: PerWorker::new(&workers),
            backward_scratch: PerWorker::new(&workers),
            ssim_scratch: PerWorker::new(&workers),
            contributors: Vec::new(),
            loss: LossImages::default(),
            sums: Vec::new(),
            places: Vec::new(),
            corrections: Corrections::default(),
            singles: PerWorker::new(&workers),
            shapes: Vec::new(),
            stage_times: [Duration::ZERO; 7],
            workers,
        })
    }

    /// The instruction set in use.
    pub fn isa(&self) -> Isa {
        self.isa
    }

    /// Number of threads.
    pub fn threads(&self) -> usize {
        self.workers.count()
    }

    /// Wall time of the stages of the last training step: project, sort, bin, blend, loss, backward blend, backward
    /// projection with Adam. For benchmarks and health figures; nothing depends on it.
    pub fn stage_times(&self) -> [Duration; 7] {
        self.stage_times
    }

    /// What the last training step had to do.
    pub fn work(&self) -> Work {
        let tiles = self.frame.tiles();
        let contributors = self.contributors.iter().take(tiles);
        Work {
            gaussians: self.frame.rows.len(),
            visible: self.frame.visible.iter().map(|lanes| lanes.count_ones() as usize).sum(),
            entries: self.frame.entries.len(),
            contributions: contributors.flat_map(|c| &c.lists).map(Vec::len).sum(),
            pixels: tiles * TILE * TILE,
        }
    }

    /// Renders colour, alpha and expected depth. Broken Gaussians (not finite, absurdly large) are left out; a camera
    /// that cannot project sees nothing.
    pub fn render(&mut self, gaussians: &Gaussians, camera: &Camera, settings: &RenderSettings, out: &mut Rendered) {
        self.frame.prepare(self.isa, &self.workers, gaussians.into(), camera, settings);
        self.blend(camera, settings, false);
        let pixels = camera.pixels();
        (out.width, out.height) = (camera.width, camera.height);
        out.color.clear();
        out.alpha.clear();
        out.depth.clear();
        out.color.reserve(pixels);
        out.alpha.reserve(pixels);
        out.depth.reserve(pixels);
        let background = settings.background.to_array();
        for_each_pixel(&self.frame, camera, |tile, at| {
            let transmittance = tile[LAST].0[at];
            let alpha = 1.0 - transmittance;
            out.color.push(std::array::from_fn(|k| tile[k].0[at] + transmittance * background[k]));
            out.alpha.push(alpha);
            out.depth.push(if alpha < DEPTH_ALPHA_TINY { 0.0 } else { tile[3].0[at] / alpha });
        });
    }

    /// Renders the moments of depth relative to `reference_m`.
    pub fn moments(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        settings: &RenderSettings,
        reference_m: f32,
        out: &mut Moments,
    ) {
        self.frame.prepare(self.isa, &self.workers, gaussians.into(), camera, settings);
        let target = Target { camera, settings, channels: Channels::Moments { reference_m } };
        blend_frame(self.isa, &self.workers, &self.blend_scratch, &mut self.frame, &target, None);
        copy_moments(&self.frame, camera, reference_m, out);
    }

    /// Renders the moments of many views, one view per thread, and gives each to `visit(index, moments)` on the thread
    /// that rendered it, in no order. Each view's result does not depend on the others.
    ///
    /// # Errors
    /// [`EngineError::Cancelled`] where `cancel` became true before the last view was begun; views visited until then
    /// are complete.
    pub fn moments_batch(
        &mut self,
        gaussians: &Gaussians,
        views: &[MomentsView],
        settings: &RenderSettings,
        cancel: &AtomicBool,
        visit: impl Fn(usize, &Moments) + Sync,
    ) -> Result<(), EngineError> {
        let cancelled = AtomicBool::new(false);
        let alone = Workers::sequential();
        let isa = self.isa;
        frame::keep_shapes(isa, &self.workers, gaussians, &mut self.shapes);
        let model = frame::Model { gaussians, shapes: Some(&self.shapes) };
        self.workers.run(views.len(), |worker, index| {
            if cancel.load(Ordering::Relaxed) {
                cancelled.store(true, Ordering::Relaxed);
                return;
            }
            let MomentsView { camera, reference_m } = views[index];
            self.singles.with(worker, |single| {
                single.frame.prepare(isa, &alone, model, &camera, settings);
                let target = Target { camera: &camera, settings, channels: Channels::Moments { reference_m } };
                blend_frame(isa, &alone, &single.scratch, &mut single.frame, &target, None);
                copy_moments(&single.frame, &camera, reference_m, &mut single.moments);
                visit(index, &single.moments);
            });
        });
        if cancelled.into_inner() { Err(EngineError::Cancelled) } else { Ok(()) }
    }

    /// Blends the prepared frame's colours; with `save`, keeps what the backward pass needs.
    pub(crate) fn blend(&mut self, camera: &Camera, settings: &RenderSettings, save: bool) {
        let saved = save.then_some(&mut self.contributors);
        let target = Target { camera, settings, channels: Channels::Color };
        blend_frame(self.isa, &self.workers, &self.blend_scratch, &mut self.frame, &target, saved);
    }
}

/// What a frame is blended into.
struct Target<'a> {
    camera: &'a Camera,
    settings: &'a RenderSettings,
    channels: Channels,
}

fn blend_frame(
    isa: Isa,
    workers: &Workers,
    scratch: &PerWorker<blend::Scratch>,
    frame: &mut Frame,
    target: &Target<'_>,
    mut saved: Option<&mut Vec<Contributors>>,
) {
    let tiles = frame.tiles();
    let mut nothing = Vec::new();
    let save = saved.is_some();
    if let Some(saved) = saved.as_deref_mut() {
        saved.resize(tiles.max(saved.len()), Contributors::default());
    }
    let mut pixels = std::mem::take(&mut frame.pixels);
    let frame_ref = &*frame;
    let outputs = Shared::new(&mut pixels);
    let contributors = Shared::new(saved.unwrap_or(&mut nothing));
    workers.run(tiles, |worker, task| {
        let tile = frame_ref.schedule[task] as usize;
        // SAFETY: the schedule is a permutation of the tiles, so each is given to one task.
        let out = unsafe { &mut outputs.slice_mut(tile..tile + 1)[0] };
        // SAFETY: as above.
        let contributors = save.then(|| unsafe { &mut contributors.slice_mut(tile..tile + 1)[0] });
        scratch.with(worker, |scratch| {
            let kernel = BlendTile {
                origin: [tile % frame_ref.tiles_x * TILE, tile / frame_ref.tiles_x * TILE],
                size: [target.camera.width as usize, target.camera.height as usize],
                entries: frame_ref.tile_entries(tile),
                rows: &frame_ref.rows,
                channels: target.channels,
                alpha_min: target.settings.alpha_min,
                transmittance_min: target.settings.transmittance_min,
                scratch,
                out,
                contributors,
            };
            dispatch(isa, kernel);
        });
    });
    frame.pixels = pixels;
}

fn copy_moments(frame: &Frame, camera: &Camera, reference_m: f32, out: &mut Moments) {
    (out.width, out.height, out.reference_m) = (camera.width, camera.height, reference_m);
    let width = camera.width as usize;
    for (plane, to) in [LAST, 0, 1].into_iter().zip([&mut out.alpha, &mut out.first, &mut out.second]) {
        to.resize(camera.pixels(), 0.0);
        for (y, line) in to.chunks_exact_mut(width.max(1)).enumerate() {
            let tiles = &frame.pixels[y / TILE * frame.tiles_x..];
            for (part, tile) in line.chunks_mut(TILE).zip(tiles) {
                part.copy_from_slice(&tile[plane].row(y % TILE)[..part.len()]);
            }
        }
    }
    out.alpha.iter_mut().for_each(|transmittance| *transmittance = 1.0 - *transmittance);
}

fn for_each_pixel(frame: &Frame, camera: &Camera, mut f: impl FnMut(&crate::frame::TilePixels, usize)) {
    for y in 0..camera.height as usize {
        for x in 0..camera.width as usize {
            f(&frame.pixels[y / TILE * frame.tiles_x + x / TILE], y % TILE * TILE + x % TILE);
        }
    }
}
