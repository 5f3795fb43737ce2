//! The GPU engine: what the CPU engine does, on an adapter.

use bytemuck::pod_collect_to_vec;
use wgpu::Features;

use super::adapter;
use super::buffers::Bytes;
use super::chain::{Size, dispatch};
use super::context::Context;
use super::copying::Copies;
use super::drawing::{Drawing, overflow};
use super::error::GpuError;
use super::job::View;
use super::kernels::Kernels;
use super::keyframe::Keyframes;
use super::model::DeviceModel;
use super::peak;
use super::probing::Gradients;
use super::pruning::Depths;
use super::training::{STAGES, Trainer};
use crate::camera::{Camera, RenderSettings};
use crate::engine::{DEPTH_ALPHA_TINY, Rendered};
use crate::model::{Block, Gaussians, LANES, Lanes, ROWS, SH_REST_MAX, sh_rest_coefficients, sh_rest_rows};
use crate::optimiser::Optimiser;
use crate::settings::{LossTerms, TrainingSettings};
use crate::statistics::ScreenStatistics;
use crate::training::Gradient;
use crate::view::TrainingView;

/// Which adapter, and what of it to use.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Options {
    /// Name of the adapter or a part of it; `None`: the best that is not software.
    pub adapter: Option<String>,
    /// Do without subgroup operations.
    pub without_subgroups: bool,
    /// Do without atomic addition of floats.
    pub without_float_atomics: bool,
    /// Do without dispatches whose size the GPU decides.
    pub without_indirect: bool,
    /// Give sums of gradients an order, so that runs on the same adapter and driver repeat bit for bit, for 192 bytes
    /// per (tile, splat) pair.
    pub deterministic: bool,
    /// Room for (tile, splat) pairs at first, for tests of what happens when it is not enough; 0: a good guess.
    pub pairs: u32,
    /// Most bytes that keyframes take, of which the one not used for longest goes first; 0: 512 MB.
    pub keyframe_bytes: u64,
}

/// The renderer and trainer on a GPU.
pub struct Engine {
    pub(super) context: Context,
    pub(super) kernels: Kernels,
    pub(super) model: Option<DeviceModel>,
    pub(super) trainer: Option<Trainer>,
    pub(super) keyframes: Keyframes,
    /// Depth images that pruning looks at.
    pub(super) depths: Depths,
    /// Terms of iterations whose trainer is gone.
    pub(super) told: Vec<LossTerms>,
    pub(super) copies: Copies,
    /// How often iterations were taken back because lists did not fit.
    pub(super) taken_back: u64,
    /// Pairs per view that were needed so far, with something to spare.
    pairs: u32,
}

impl Engine {
    /// An engine on the adapter that the options ask for.
    ///
    /// # Errors
    /// Where there is none, or it cannot run the kernels.
    pub fn new(options: &Options) -> Result<Self, GpuError> {
        let adapter = adapter::choose(options.adapter.as_deref())?;
        let mut excluded = Features::empty();
        excluded.set(Features::SUBGROUP, options.without_subgroups);
        excluded.set(Features::SHADER_FLOAT32_ATOMIC, options.without_float_atomics);
        let mut context = Context::new(&adapter, excluded)?;
        context.indirect &= !options.without_indirect;
        let kernels = Kernels::new(&context, options.deterministic)?;
        Ok(Self {
            context,
            kernels,
            model: None,
            trainer: None,
            keyframes: Keyframes::new(options.keyframe_bytes),
            depths: Depths::default(),
            told: Vec::new(),
            copies: Copies::default(),
            taken_back: 0,
            pairs: options.pairs,
        })
    }

    /// Name of the adapter.
    pub fn name(&self) -> &str {
        &self.context.name
    }

    /// Largest part of a buffer that a kernel can see, bytes.
    pub fn max_binding(&self) -> u64 {
        self.context.max_binding
    }

    /// Bytes allocated on the GPU, by what for.
    pub fn bytes(&self) -> Vec<(&'static str, u64)> {
        let mut all: Vec<(&'static str, u64)> = Vec::new();
        let model = self.model.iter().map(DeviceModel::bytes);
        let trainer = self.trainer.iter().flat_map(Trainer::all_bytes);
        for (what, bytes) in model.chain(trainer).flat_map(Bytes::into_list) {
            match all.iter_mut().find(|(name, _)| *name == what) {
                Some((_, sum)) => *sum += bytes,
                None => all.push((what, bytes)),
            }
        }
        all.push(("keyframes", self.keyframes.bytes()));
        all.push(("depth images", self.depths.bytes()));
        all.push(("snapshots", self.copies.model.bytes()));
        all.push(("checkpoints", self.copies.state.bytes()));
        all
    }

    /// Bytes of models, lists and images that went up to the GPU so far, and that came down. Not the jobs and the losses of
    /// iterations, and not snapshots.
    pub fn traffic(&self) -> (u64, u64) {
        self.context.traffic()
    }

    fn likely_pairs(&self, gaussians: u32) -> u32 {
        if self.pairs > 0 { self.pairs } else { Size::likely_pairs(gaussians) }
    }

    /// A quarter more than was needed: the number changes from view to view.
    pub(super) fn make_room(&mut self, pairs: u32) {
        self.pairs = pairs.saturating_add(pairs / 4).max(1024);
    }

    /// Renders colour, alpha and expected depth, as [`crate::Engine::render`].
    ///
    /// # Errors
    /// Where the GPU fails or the image is too large.
    pub fn render(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        settings: &RenderSettings,
        out: &mut Rendered,
    ) -> Result<(), GpuError> {
        let pixels = camera.pixels();
        *out = Rendered { width: camera.width, height: camera.height, ..Rendered::default() };
        if pixels == 0 {
            return Ok(());
        }
        let model = DeviceModel::upload(&self.context, gaussians, None)?;
        let image = self.context.storage("images", 20 * pixels as u64)?;
        let bytes = loop {
            let size = self.size(&model, 1, camera);
            let reached = self.context.storage("tile lists", 4 * u64::from(size.tiles() + size.capacity))?;
            let mut drawing = Drawing::new(self, &model, size, settings.sh_degree)?;
            drawing.describe(&self.context, &[View::new(camera, settings, 0.0)]);
            let chain = &drawing.chain;
            let blend = self.kernels.blend.bind(
                &self.context,
                1,
                &[&drawing.job, &drawing.views, &chain.rows, &chain.starts, &chain.entries, &reached, &image],
            );
            drawing.run(self, |pass, kernels| {
                dispatch(pass, &kernels.blend, &blend, &[0, 0], (size.tiles_x(), size.tiles_y(), 1));
            })?;
            let [control, bytes] = self.context.read([(&drawing.chain.control, 16), (&image, 20 * pixels as u64)])?;
            match overflow(&control) {
                Some(pairs) => self.make_room(pairs),
                None => break bytes,
            }
        };
        let planes: Vec<f32> = pod_collect_to_vec(&bytes);
        let plane = |k: usize| &planes[k * pixels..(k + 1) * pixels];
        let background = settings.background.to_array();
        for i in 0..pixels {
            let transmittance = plane(4)[i];
            let alpha = 1.0 - transmittance;
            out.color.push(std::array::from_fn(|k| plane(k)[i] + transmittance * background[k]));
            out.alpha.push(alpha);
            out.depth.push(if alpha < DEPTH_ALPHA_TINY { 0.0 } else { plane(3)[i] / alpha });
        }
        Ok(())
    }

    pub(super) fn size(&self, model: &DeviceModel, views: u32, camera: &Camera) -> Size {
        let gaussians = model.gaussians;
        let (width, height) = (camera.width, camera.height);
        Size { gaussians, views, width, height, capacity: self.likely_pairs(gaussians) }
    }

    /// Puts a model under training on the GPU. From now on [`Engine::step`] changes it there.
    ///
    /// # Errors
    /// Where it does not fit, or the GPU fails.
    pub fn upload(
        &mut self,
        gaussians: &Gaussians,
        optimiser: &mut Optimiser,
        statistics: &mut ScreenStatistics,
    ) -> Result<(), GpuError> {
        optimiser.fit(gaussians);
        statistics.fit(gaussians);
        self.forget_copies();
        self.told.clear();
        self.trainer = None;
        self.model = None;
        self.model = Some(DeviceModel::upload(&self.context, gaussians, Some((optimiser, statistics)))?);
        Ok(())
    }

    /// Copies the model under training back, after all iterations that were asked for.
    ///
    /// # Errors
    /// Where the GPU fails; what is given is then as it was.
    pub fn download(
        &mut self,
        gaussians: &mut Gaussians,
        optimiser: &mut Optimiser,
        statistics: &mut ScreenStatistics,
    ) -> Result<(), GpuError> {
        self.finish()?;
        match &self.model {
            Some(model) => model.download(&self.context, gaussians, (optimiser, statistics)),
            None => Ok(()),
        }
    }

    /// Asks for one step of Adam on one view, as [`crate::Engine::train_step`]. It happens later: its loss comes with
    /// [`Engine::finished`]. Without a model, nothing is done.
    ///
    /// # Errors
    /// Where the GPU fails. Nothing is known of the model then.
    pub fn step(&mut self, view: &TrainingView, settings: &TrainingSettings) -> Result<(), GpuError> {
        self.step_of(view, settings, false)
    }

    /// The same step, which also adds what it saw of each Gaussian to the statistics, as
    /// [`crate::Engine::train_step_observed`].
    ///
    /// # Errors
    /// As [`Engine::step`].
    pub fn step_observed(&mut self, view: &TrainingView, settings: &TrainingSettings) -> Result<(), GpuError> {
        self.step_of(view, settings, true)
    }

    fn step_of(&mut self, view: &TrainingView, settings: &TrainingSettings, observed: bool) -> Result<(), GpuError> {
        self.ready(view)?;
        if let (Some(trainer), Some(model)) = (&mut self.trainer, &self.model) {
            let keyframes = (model, &mut self.keyframes);
            trainer.push(&self.context, &self.kernels, keyframes, (view, observed), settings)?;
        }
        self.collect(false)
    }

    /// Losses that have arrived since the last call, in the order of the steps.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn finished(&mut self) -> Result<Vec<LossTerms>, GpuError> {
        self.collect(false)?;
        let mut finished = std::mem::take(&mut self.told);
        finished.extend(self.trainer.iter_mut().flat_map(Trainer::take_finished));
        Ok(finished)
    }

    /// Waits until all iterations that were asked for are done.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn finish(&mut self) -> Result<(), GpuError> {
        while self.trainer.as_ref().is_some_and(|trainer| !trainer.is_idle()) {
            if let (Some(trainer), Some(model)) = (&mut self.trainer, &self.model) {
                trainer.submit(&self.context, &self.kernels, model)?;
            }
            self.collect(true)?;
        }
        Ok(())
    }

    /// The loss of a view and its gradient by every parameter; nothing moves. As [`crate::Engine::gradient`], for tests
    /// and tools. A model under training is put away: upload it again.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn gradient(
        &mut self,
        gaussians: &Gaussians,
        view: &TrainingView,
        settings: &TrainingSettings,
    ) -> Result<(LossTerms, Gradient), GpuError> {
        self.upload(gaussians, &mut Optimiser::new(), &mut ScreenStatistics::new())?;
        let Gradients { terms, parameters, bands } = loop {
            self.ready(view)?;
            let (Some(trainer), Some(model)) = (&mut self.trainer, &self.model) else { continue };
            let keyframes = (model, &mut self.keyframes);
            match trainer.gradient(&self.context, &self.kernels, keyframes, view, settings)? {
                Ok(found) => break found,
                Err(pairs) => {
                    self.make_room(pairs);
                    self.trainer = None;
                }
            }
        };
        self.trainer = None;
        self.model = None;
        let blocks: Vec<Block> = pod_collect_to_vec(&parameters);
        let bands: Vec<Lanes> = pod_collect_to_vec(&bands);
        let rows = sh_rest_rows(gaussians.sh_degree());
        let evaluated = sh_rest_coefficients(gaussians.sh_degree().min(settings.render.sh_degree));
        let mut out = Gradient::default();
        for i in 0..gaussians.len() {
            let (block, lane) = (i / LANES, i % LANES);
            out.parameters.push(std::array::from_fn::<f32, ROWS, _>(|row| blocks[block].0[row].0[lane]));
            let mut rest = [[0.0; 3]; SH_REST_MAX];
            for (k, to) in rest.iter_mut().enumerate().take(evaluated) {
                *to = std::array::from_fn(|channel| bands[block * rows + 3 * k + channel].0[lane]);
            }
            out.sh_rest.push(rest);
        }
        Ok((terms, out))
    }

    /// What the adapter can do at best: multiply-adds, GFLOP/s, and memory, GB/s read and written. Takes seconds.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn measure_peaks(&self) -> Result<(f64, f64), GpuError> {
        peak::measure(&self.context)
    }

    /// Runs one step and tells how long each of its stages took on the GPU, seconds: project, sort, bin, blend, loss,
    /// backward, Adam. `None` where the adapter has no timestamps. The model must be uploaded, and its lists fit.
    ///
    /// # Errors
    /// Where the GPU fails.
    pub fn profile(
        &mut self,
        view: &TrainingView,
        settings: &TrainingSettings,
    ) -> Result<Option<[f64; STAGES]>, GpuError> {
        if !self.context.features.contains(Features::TIMESTAMP_QUERY) {
            return Ok(None);
        }
        self.ready(view)?;
        self.finish()?;
        match (&mut self.trainer, &self.model) {
            (Some(trainer), Some(model)) => {
                let keyframes = (model, &mut self.keyframes);
                trainer.profile(&self.context, &self.kernels, keyframes, view, settings).map(Some)
            }
            _ => Ok(None),
        }
    }

    /// Loses the device, as a reset does.
    #[cfg(test)]
    pub(super) fn lose_device(&self) {
        self.context.device.destroy();
    }

    /// Makes sure that there is a trainer for views of this size.
    fn ready(&mut self, view: &TrainingView) -> Result<(), GpuError> {
        let Some(model) = &self.model else { return Ok(()) };
        let size = self.size(model, 1, view.camera());
        let shape = |size: Size| (size.width, size.height);
        if self.trainer.as_ref().is_none_or(|trainer| shape(trainer.size()) != shape(size)) {
            self.finish()?;
            self.replace_trainer(size)?;
        }
        Ok(())
    }

    fn replace_trainer(&mut self, size: Size) -> Result<(), GpuError> {
        let Some(model) = &self.model else { return Ok(()) };
        let mut old = self.trainer.take();
        let mut new = Trainer::new(&self.context, &self.kernels, model, size)?;
        if let Some(old) = &mut old {
            new.inherit(old);
        }
        self.trainer = Some(new);
        Ok(())
    }

    pub(super) fn collect(&mut self, all: bool) -> Result<(), GpuError> {
        let Some(trainer) = &mut self.trainer else { return Ok(()) };
        let Some(pairs) = trainer.collect(&self.context, all)? else { return Ok(()) };
        let size = trainer.size();
        self.taken_back += 1;
        self.make_room(pairs);
        self.replace_trainer(Size { capacity: self.pairs, ..size })
    }
}
