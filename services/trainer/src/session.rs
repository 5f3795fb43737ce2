//! A mission's training, from the first keyframe to the last round: pure computing, no clock, no bus.
//!
//! The session owns everything that decides what comes next (model, optimiser, voxel grid, view order, losses), so that a
//! session taken from a checkpoint goes on with the same bits as one that never stopped.

use std::collections::{BTreeMap, VecDeque};

use shared_types::config::trainer::BirthShape;
use shared_types::config::{ModelConfig, TrainerConfig};
use shared_types::messages::GaussianRow;
use splatting::{Arrival, Backend, BackendError, Gaussian, Gaussians, Optimiser, Training, TrainingSettings};

use crate::checkpoint::Checkpoint;
use crate::keyframes::{self, KeyframeError, KeyframeSource, SmallKeyframe, View};
use crate::logic::rounds::{LossHistory, means_learning_rate, window_views};
use crate::progression::{ActiveRound, Awaited, Progression, State};
use crate::round::{FinishedRound, Progress, RoundSpec, generation};
use splatting::order::ViewOrder;
use splatting::rgbd::clip_box::ClipBox;
use splatting::rgbd::insertion::{self, InsertionRules};
use splatting::rgbd::prune::{self, DepthView, PruneRules};
use splatting::rgbd::voxels::{VoxelGrid, voxel_edge_m};

/// Why a round cannot begin.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// A keyframe cannot be read; the session is as before.
    #[error(transparent)]
    Keyframe(#[from] KeyframeError),
    /// The back end failed: training since the last [`Session::sync`] is lost.
    #[error(transparent)]
    Backend(#[from] BackendError),
}

/// A snapshot of the model, as published.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// See [`generation`].
    pub generation: u64,
    /// Training iterations behind it.
    pub total_iterations: u64,
    /// What the round was asked.
    pub spec: RoundSpec,
    /// Whether it is the last of its round.
    pub is_final: bool,
    /// The Gaussians.
    pub rows: Vec<GaussianRow>,
}

/// Training of one mission.
pub struct Session {
    config: TrainerConfig,
    model_config: ModelConfig,
    pub(crate) training: Training,
    /// Whether the views of steps whose losses are not known yet have foreground.
    have_foreground: VecDeque<bool>,
    pub(crate) progression: Progression,
    /// What a snapshot that is on its way will say.
    snapshot_begun: Option<Snapshot>,
    checkpoint_begun: Option<Awaited>,
    /// Keyframes prepared for training, and the clip box that their masks are for.
    views: BTreeMap<u64, View>,
    views_clip: Option<ClipBox>,
}

impl core::fmt::Debug for Session {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Session")
            .field("gaussians", &self.model().len())
            .field("total_iterations", &self.progression.total_iterations)
            .finish_non_exhaustive()
    }
}

impl Session {
    /// A session that has seen nothing.
    #[must_use]
    pub fn new(config: TrainerConfig, model_config: ModelConfig, backend: impl Into<Backend>) -> Self {
        Self {
            config,
            model_config,
            training: Training::new(backend),
            have_foreground: VecDeque::new(),
            progression: Progression::new(),
            snapshot_begun: None,
            checkpoint_begun: None,
            views: BTreeMap::new(),
            views_clip: None,
        }
    }

    /// What it was configured with.
    #[must_use]
    pub fn config(&self) -> &TrainerConfig {
        &self.config
    }

    /// What trains.
    #[must_use]
    pub fn backend(&self) -> &Backend {
        self.training.backend()
    }

    /// The model, as of the last [`Session::sync`]; how many Gaussians it has, and their ids, are always those of now.
    #[must_use]
    pub fn model(&self) -> &Gaussians {
        self.training.model()
    }

    /// The model alone, as of the last [`Session::sync`].
    pub fn into_model(self) -> Gaussians {
        self.training.into_model()
    }

    /// The renderer, for looking at the model of the last [`Session::sync`].
    pub fn backend_and_model(&mut self) -> (&mut Backend, &Gaussians) {
        self.training.backend_and_model()
    }

    /// Brings the model here from wherever it is trained: before it is looked at, published or written. Between rounds it
    /// is here.
    ///
    /// # Errors
    /// When the back end failed; what is here is then older.
    pub fn sync(&mut self) -> Result<(), BackendError> {
        self.training.sync()?;
        self.take_losses()
    }

    /// Rounds that are over, in their order.
    #[must_use]
    pub fn finished(&self) -> &[FinishedRound] {
        &self.progression.finished
    }

    /// What the round under work was asked; `None` between rounds.
    #[must_use]
    pub fn active(&self) -> Option<&RoundSpec> {
        self.progression.active.as_ref().map(|round| &round.spec)
    }

    /// How far the round under work is (the last one, between rounds).
    #[must_use]
    pub fn progress(&self) -> Progress {
        let total_iterations = self.progression.total_iterations;
        match &self.progression.active {
            Some(round) => Progress {
                iterations: round.iterations,
                total_iterations,
                gaussians: self.model().len() as u64,
                loss: round.losses.mean_of_last(),
                psnr_train_db: round.psnr_db.iter().sum::<f64>() / round.psnr_db.len().max(1) as f64,
            },
            None => self.progression.finished.last().map_or_else(Progress::default, |round| round.progress),
        }
    }

    /// Begins a round: prunes what is wrong, makes room, and inserts the keyframes that are new.
    ///
    /// # Errors
    /// When a keyframe cannot be read, or the back end failed.
    pub fn begin(&mut self, spec: RoundSpec, source: &mut dyn KeyframeSource) -> Result<(), SessionError> {
        let clip = self.clip(&spec);
        let mut fresh = Vec::new();
        for &id in &spec.keyframes {
            if !self.progression.inserted.contains(&id) {
                fresh.push((id, keyframes::load(source, id, &self.model_config)?));
            }
        }
        self.prepare_views(&spec, &fresh, source)?;

        self.prune(&spec)?;
        if self.progression.grid.is_none() {
            let focal = fresh.first().map_or(1.0, |(_, keyframe)| f64::from(keyframe.camera.fx));
            let edge = if self.config.voxel_m > 0.0 {
                self.config.voxel_m
            } else {
                voxel_edge_m(self.config.voxel_factor, spec.radius_m, spec.box_size_m, focal)
            };
            self.progression.grid = Some(VoxelGrid::new(edge as f32));
        }
        let mut born: Vec<Gaussian> = Vec::new();
        if let Some(grid) = &mut self.progression.grid {
            for (id, keyframe) in &fresh {
                let first_id = self.progression.next_gaussian_id + born.len() as u64;
                born.extend(insertion::insert(
                    &insertion_rules(&self.config),
                    &keyframe.camera,
                    &keyframe.image,
                    &clip,
                    grid,
                    first_id,
                    spec.round,
                ));
                self.progression.inserted.push(*id);
            }
        }
        self.progression.inserted.sort_unstable();
        self.append(born)?;

        let window = self.window(&spec).len() as u32;
        self.progression.active = Some(ActiveRound {
            iterations: 0,
            order: ViewOrder::new(spec.seed, window),
            losses: LossHistory::new(self.config.flat_window),
            psnr_db: VecDeque::new(),
            spec,
        });
        Ok(())
    }

    /// Reads what a session taken from a checkpoint needs to go on with its round.
    ///
    /// # Errors
    /// When a keyframe cannot be read.
    pub fn resume(&mut self, source: &mut dyn KeyframeSource) -> Result<(), KeyframeError> {
        match self.active().cloned() {
            Some(spec) => self.prepare_views(&spec, &[], source),
            None => Ok(()),
        }
    }

    /// Trains at most `iterations` more, and tells whether the round is over: at its length, or flat where that ends it.
    /// `on_iteration` is called after each.
    ///
    /// # Errors
    /// When the back end failed.
    pub fn advance(&mut self, iterations: u32, mut on_iteration: impl FnMut()) -> Result<bool, BackendError> {
        let Some(spec) = self.active().cloned() else { return Ok(true) };
        let window = self.window(&spec);
        for _ in 0..iterations {
            if self.is_over() || !self.iterate(&spec, &window)? {
                return Ok(true);
            }
            on_iteration();
        }
        Ok(self.is_over())
    }

    /// Ends the round: prunes once more, so that what is scored and kept is clean.
    ///
    /// # Errors
    /// When the back end failed.
    pub fn finish(&mut self) -> Result<Option<FinishedRound>, BackendError> {
        let Some(spec) = self.active().cloned() else { return Ok(None) };
        self.prune(&spec)?;
        self.sync()?;
        self.checkpoint_begun = None;
        self.training.forget_copies();
        let progress = self.progress();
        self.progression.active = None;
        let generation = generation(progress.total_iterations, spec.round, true);
        let finished = FinishedRound { generation, progress, spec };
        self.progression.finished.push(finished.clone());
        Ok(Some(finished))
    }

    /// The model as it is published: live during a round, final between rounds; `None` before the first. Of the last
    /// [`Session::sync`].
    #[must_use]
    pub fn snapshot(&self) -> Option<Snapshot> {
        Some(Snapshot { rows: rows(self.model()), ..self.untaken_snapshot()? })
    }

    /// Begins a snapshot of the model as it is now, which training does not wait for.
    ///
    /// # Errors
    /// When the back end failed.
    pub fn begin_snapshot(&mut self) -> Result<(), BackendError> {
        self.snapshot_begun = self.untaken_snapshot();
        self.training.begin_copy()
    }

    /// The snapshot that was begun, once the model has arrived; with `wait` it is waited for.
    ///
    /// # Errors
    /// When the back end failed.
    pub fn take_snapshot(&mut self, wait: bool) -> Result<Option<Snapshot>, BackendError> {
        if self.snapshot_begun.is_none() {
            return Ok(None);
        }
        let model = self.training.take_copy(wait)?;
        Ok(model.and_then(|model| Some(Snapshot { rows: rows(&model), ..self.snapshot_begun.take()? })))
    }

    /// A snapshot without its rows.
    fn untaken_snapshot(&self) -> Option<Snapshot> {
        let (generation, is_final) = self.progression.generation()?;
        Some(Snapshot {
            generation,
            total_iterations: self.progression.total_iterations,
            is_final,
            rows: Vec::new(),
            spec: self.progression.last_spec()?.clone(),
        })
    }

    /// What a checkpoint holds, of the last [`Session::sync`].
    pub(crate) fn state(&self) -> State<'_> {
        let (model, optimiser) = (self.training.model(), self.training.optimiser());
        State { progression: &self.progression, model, optimiser }
    }

    /// Begins to bring here what a checkpoint holds, as it is now, which training does not wait for; `false` where it is
    /// here, as it always is on the CPU. One that is on its way already is left alone.
    ///
    /// # Errors
    /// When the back end failed.
    pub fn begin_checkpoint(&mut self) -> Result<bool, BackendError> {
        if self.checkpoint_begun.is_some() {
            return Ok(true);
        }
        let begun = self.training.begin_state_copy()?;
        self.checkpoint_begun = begun.then(|| self.awaited());
        Ok(begun)
    }

    /// Everything that is known here of a state that is on its way.
    fn awaited(&self) -> Awaited {
        Awaited { progression: self.progression.clone(), untold: self.have_foreground.len() }
    }

    /// The checkpoint that was begun, once it is here: of the iterations done when it was begun, or of some more where the
    /// back end had to do them again. The end of a round forgets it.
    ///
    /// # Errors
    /// When the back end failed.
    pub fn take_checkpoint(&mut self) -> Result<Option<Checkpoint>, BackendError> {
        if self.checkpoint_begun.is_none() {
            return Ok(None);
        }
        match self.training.take_state_copy()? {
            Arrival::Here((model, optimiser)) => {
                self.take_losses()?;
                let awaited = self.checkpoint_begun.take();
                Ok(awaited.map(|Awaited { progression, .. }| Checkpoint { model, optimiser, progression }))
            }
            Arrival::NotYet => Ok(None),
            Arrival::Anew => {
                self.checkpoint_begun = Some(self.awaited());
                Ok(None)
            }
        }
    }

    fn is_over(&self) -> bool {
        self.progression.active.as_ref().is_none_or(|round| {
            round.iterations >= round.spec.max_iterations
                || (round.spec.stop_when_flat
                    && round.iterations.is_multiple_of(self.config.slice_iterations.max(1))
                    && round.losses.is_flat(self.config.flat_gain))
        })
    }

    /// One step; false where there is nothing to train on.
    fn iterate(&mut self, spec: &RoundSpec, window: &[usize]) -> Result<bool, BackendError> {
        let settings = self.settings(spec);
        let Some(round) = &mut self.progression.active else { return Ok(false) };
        let view = round
            .order
            .next_view()
            .and_then(|k| window.get(k as usize))
            .and_then(|&index| spec.keyframes.get(index))
            .and_then(|id| self.views.get(id));
        let Some(view) = view else { return Ok(false) };
        self.training.step(&view.training, &settings)?;
        self.have_foreground.push_back(view.training.foreground_pixels() > 0);
        round.iterations += 1;
        self.progression.total_iterations += 1;
        self.take_losses()?;
        Ok(true)
    }

    /// Takes in the losses that are known by now.
    fn take_losses(&mut self) -> Result<(), BackendError> {
        let finished = self.training.finished()?;
        let Some(round) = &mut self.progression.active else { return Ok(()) };
        for terms in finished {
            let has_foreground = self.have_foreground.pop_front() == Some(true);
            round.take_loss(&terms, has_foreground);
            if let Some(awaited) = &mut self.checkpoint_begun {
                awaited.take_loss(&terms, has_foreground);
            }
        }
        Ok(())
    }

    fn settings(&self, spec: &RoundSpec) -> TrainingSettings {
        let config = &self.config;
        let edge = self.progression.grid.as_ref().map_or(0.01, VoxelGrid::edge_m);
        let lr_means = means_learning_rate(
            self.progression.total_iterations,
            config.lr_means_start_m,
            config.lr_means_end_m,
            config.lr_means_decay_iterations,
            spec.radius_m,
        );
        TrainingSettings {
            lr_means: lr_means as f32,
            lr_log_scales: config.lr_log_scales as f32,
            lr_rotations: config.lr_rotations as f32,
            lr_opacity: config.lr_opacities as f32,
            lr_sh: config.lr_sh0 as f32,
            l1_weight: config.weight_l1 as f32,
            ssim_weight: config.weight_ssim as f32,
            depth_weight: config.weight_depth as f32,
            free_weight: config.weight_free_space as f32,
            isotropic_weight: config.weight_isotropic as f32,
            sigma_limits_m: Some((config.sigma_min_voxels as f32 * edge, config.sigma_max_voxels as f32 * edge)),
            ..TrainingSettings::default()
        }
    }

    fn clip(&self, spec: &RoundSpec) -> ClipBox {
        ClipBox::new(spec.box_center_m, spec.box_size_m, spec.ground_z_m, self.config.ground_margin_m)
    }

    /// Indices into the round's keyframes that it trains on.
    fn window(&self, spec: &RoundSpec) -> Vec<usize> {
        let eyes: Vec<_> =
            spec.keyframes.iter().filter_map(|id| self.views.get(id)).map(|view| view.eye().as_dvec3()).collect();
        window_views(&eyes, spec.window)
    }

    /// Makes sure that every keyframe of the round is prepared, for its clip box; `loaded` ones need not be read.
    fn prepare_views(
        &mut self,
        spec: &RoundSpec,
        loaded: &[(u64, SmallKeyframe)],
        source: &mut dyn KeyframeSource,
    ) -> Result<(), KeyframeError> {
        let clip = self.clip(spec);
        if self.views_clip != Some(clip) {
            self.views.clear();
            self.views_clip = Some(clip);
        }
        for &id in &spec.keyframes {
            if !self.views.contains_key(&id) {
                let keyframe = match loaded.iter().find(|(other, _)| *other == id) {
                    Some((_, keyframe)) => keyframe.clone(),
                    None => keyframes::load(source, id, &self.model_config)?,
                };
                self.views.insert(id, View::new(id, keyframe, &self.config, &clip)?);
            }
        }
        Ok(())
    }

    fn prune(&mut self, spec: &RoundSpec) -> Result<(), BackendError> {
        let edge = self.progression.grid.as_ref().map_or(0.0, VoxelGrid::edge_m);
        let rules = PruneRules {
            clip: self.clip(spec),
            min_opacity: self.config.prune_opacity as f32,
            // A hair above the clamp, which rounds.
            max_sigma_m: self.config.sigma_max_voxels as f32 * edge * 1.001,
            front_m: self.config.prune_front_voxels as f32 * edge + 3.0 * self.config.depth_sigma_m as f32,
            front_views: self.config.prune_front_views,
        };
        let views: Vec<DepthView<'_>> = spec
            .keyframes
            .iter()
            .filter_map(|id| self.views.get(id))
            .map(|view| DepthView { id: view.training.id(), camera: &view.camera, depth_m: &view.depth_m })
            .collect();
        self.training.prune(&views, &rules)
    }

    /// Adds newborn Gaussians, making room at the cap, and brings neighbours together in memory.
    fn append(&mut self, mut born: Vec<Gaussian>) -> Result<(), BackendError> {
        let cap = self.model_config.max_gaussians as usize;
        born.truncate(cap);
        self.progression.next_gaussian_id += born.len() as u64;
        self.training.edit(|draft| {
            let kept = prune::keep_most_contributing(draft.model(), cap - born.len());
            draft.retain(|index| kept.get(index).copied().unwrap_or(false));
            born.iter().for_each(|gaussian| draft.push(gaussian));
            draft.sort_along_curve();
        })
    }

    /// Lets the least contributing go where there are more than the cap, which is lower after a death for memory.
    pub(crate) fn hold_at_cap(&mut self) -> Result<(), BackendError> {
        if self.model().len() <= self.model_config.max_gaussians as usize {
            return Ok(());
        }
        self.append(Vec::new())
    }

    pub(crate) fn reset(&mut self) {
        self.restore(Gaussians::new(), Optimiser::new(), Progression::new());
    }

    pub(crate) fn restore(&mut self, model: Gaussians, optimiser: Optimiser, progression: Progression) {
        self.training.restore(model, optimiser);
        self.have_foreground.clear();
        self.snapshot_begun = None;
        self.checkpoint_begun = None;
        self.progression = progression;
    }
}

fn insertion_rules(config: &TrainerConfig) -> InsertionRules {
    InsertionRules {
        shape: match config.birth_shape {
            BirthShape::Disc => insertion::BirthShape::Disc,
            BirthShape::Isotropic => insertion::BirthShape::Isotropic,
        },
        sigma_voxels: config.birth_sigma_voxels as f32,
        thickness_voxels: config.birth_thickness_voxels as f32,
        opacity: config.birth_opacity as f32,
        max_incidence_rad: (config.max_incidence_deg as f32).to_radians(),
        max_depth_jump: config.max_depth_jump as f32,
        reseed_ratio: config.reseed_ratio as f32,
    }
}

fn rows(model: &Gaussians) -> Vec<GaussianRow> {
    model.iter().map(|gaussian| row(&gaussian)).collect()
}

/// A Gaussian as on channels: its rotation has unit length there.
#[must_use]
pub fn row(gaussian: &Gaussian) -> GaussianRow {
    let rotation = gaussian.rotation.normalize();
    GaussianRow {
        mean_m: gaussian.mean.to_array(),
        log_scales: gaussian.log_scales.to_array(),
        rotation_xyzw: rotation.to_array(),
        opacity_logit: gaussian.opacity_logit,
        sh0: gaussian.sh,
        id: [gaussian.id as u32, (gaussian.id >> 32) as u32],
        birth_round: gaussian.birth_round,
        reserved: 0,
    }
}
