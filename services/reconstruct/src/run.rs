//! The run: from a folder to a model, through kills.

use std::collections::VecDeque;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use splatting::order::ViewOrder;
use splatting::rgbd::prune::DepthView;
use splatting::{
    Backend, BackendOptions, Densifier, InitialGaussians, Optimiser, ScreenStatistics, Strategy, Training,
    TrainingSettings, scene_extent,
};

use crate::checkpoint::{self, Progression, State};
use crate::clocks::{Rate, Watch};
use crate::dataset::{self, Dataset, Image, LoadOptions};
use crate::error::ReconstructError;
use crate::evaluate::{PSNR_MAX_DB, evaluate};
use crate::options::{Identity, Options};
use crate::output::{Output, run_sum};
use crate::picture;
use crate::progress::{Event, Observer, Progress};
use crate::recipe::{Recipe, strategy_for};
use crate::report::{Memory, Report, Row, csv};
use crate::split::{Split, split};
use crate::start::{self, Origin};
use crate::views::Views;

/// Training images behind `train_psnr_db`.
const PSNR_IMAGES: usize = 100;
/// Iterations after which published results are given.
const PUBLISHED: [u32; 2] = [7_000, 30_000];
/// Wall time between two events of progress.
const PROGRESS_PERIOD: Duration = Duration::from_millis(200);

/// How a run ended.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// It is over; its results lie in the folder.
    Finished {
        /// What was measured.
        report: Box<Report>,
        /// Where the results are.
        out: PathBuf,
    },
    /// The observer ended it; the same command goes on with it.
    Stopped {
        /// Iterations run.
        iteration: u32,
        /// Iterations in all.
        iterations: u32,
        /// Where its checkpoint is.
        out: PathBuf,
    },
}

/// Reconstructs, going on with what the output folder holds of the same run.
///
/// # Errors
/// [`ReconstructError`]: what is wrong with the dataset, the options, or the output folder.
pub fn run(options: &Options, observer: &mut dyn Observer) -> Result<Outcome, ReconstructError> {
    options.check()?;
    let listing = dataset::list(&options.folder, options.images.as_deref())?;
    let split = split(&listing, options.hold_out)?;
    let output = Output::open(&options.out)?;
    output.check_finished(options.overwrite)?;
    let load = load_options(options);
    let memory_bytes = load.memory_bytes;
    let dataset = dataset::load(&listing, &load)?;
    dataset::check_counts(&listing, &dataset, &split.training)?;
    let loaded = Event::Loaded {
        format: dataset.format.name(),
        training: split.training.len(),
        held_out: split.held_out.len(),
        size: dataset.images.first().map_or((0, 0), |image| (image.camera.width, image.camera.height)),
        megabytes: dataset.bytes() as f64 / 1e6,
    };
    let mut flow = observer.on(&loaded);
    let backend = backend(options)?;
    let strategy = strategy_for(options, &dataset);
    let identity = Identity::of(options, &dataset, &split, strategy);
    let resumed = output.admit(&identity, options.overwrite)?;
    let mut run = Run::new(options, &dataset, &split, backend, output, identity, memory_bytes, resumed)?;
    if run.resumed {
        flow = both(flow, observer.on(&Event::Resumed { iteration: run.progression.iteration }));
    } else {
        let began = Event::Began { origin: run.origin.name(), gaussians: run.training.model().len() };
        flow = both(flow, observer.on(&began));
        flow = both(flow, run.evaluate(observer)?);
    }
    run.train(observer, flow)
}

/// What trains.
fn backend(options: &Options) -> Result<Backend, ReconstructError> {
    let wanted = BackendOptions {
        kind: options.backend,
        adapter: options.adapter.clone(),
        deterministic: options.deterministic,
        threads: options.thread_count(),
    };
    let (backend, why_not_gpu) = Backend::new(&wanted).map_err(ReconstructError::NoBackend)?;
    match why_not_gpu {
        Some(reason) => tracing::info!(%backend, %reason, "training"),
        None => tracing::info!(%backend, "training"),
    }
    Ok(backend)
}

/// How a run's images are brought into memory.
pub(crate) fn load_options(options: &Options) -> LoadOptions {
    let memory_bytes = options.memory_bytes.unwrap_or_else(default_memory_bytes);
    LoadOptions { downscale: options.downscale, mask: options.mask, memory_bytes }
}

fn both(a: ControlFlow<()>, b: ControlFlow<()>) -> ControlFlow<()> {
    if a.is_break() { a } else { b }
}

/// A run under work.
struct Run<'a> {
    options: &'a Options,
    dataset: &'a Dataset,
    held_out: Vec<&'a Image>,
    views: Views<'a>,
    training: Training,
    /// Whether the images of steps whose losses are not known yet have pixels that count.
    outstanding: VecDeque<bool>,
    recipe: Recipe,
    densifier: Densifier,
    progression: Progression,
    output: Output,
    identity: Identity,
    run_sum: u64,
    origin: Origin,
    resumed: bool,
    held_out_psnr_db: Option<f64>,
}

impl<'a> Run<'a> {
    #[expect(clippy::too_many_arguments, reason = "the parts of a run, made one after the other by one caller")]
    fn new(
        options: &'a Options,
        dataset: &'a Dataset,
        split: &Split,
        backend: Backend,
        output: Output,
        identity: Identity,
        memory_bytes: u64,
        resumed: Option<State>,
    ) -> Result<Self, ReconstructError> {
        let images = |indices: &[usize]| indices.iter().filter_map(|&i| dataset.images.get(i)).collect::<Vec<_>>();
        let trained_on = images(&split.training);
        let extent_m = scene_extent(trained_on.iter().map(|image| &image.camera)).unwrap_or(1.0);
        let recipe = Recipe::new(options, dataset, extent_m, start::voxel_m(dataset, &split.training));
        let (mut state, origin, resumed) = match resumed {
            Some(state) => (state, start::origin(dataset, &split.training), true),
            None => {
                let how = match recipe.strategy {
                    Strategy::Mcmc(_) => InitialGaussians::MCMC,
                    Strategy::None | Strategy::Default(_) => InitialGaussians::PUBLISHED,
                };
                let bounds = (options.max_gaussians, options.sh_degree, options.seed);
                let start = start::start(dataset, &split.training, how, bounds);
                if !start::is_seen(&start.model, &trained_on, recipe.render(0).near_m) {
                    let (gaussians, origin) = (start.model.len(), start.origin.name());
                    return Err(ReconstructError::Unseen { gaussians, origin, images: trained_on.len() });
                }
                let densifier = Densifier::new(recipe.strategy, extent_m, options.seed, &start.model)?;
                (State::begin(start.model, &densifier, options.seed, trained_on.len()), start.origin, false)
            }
        };
        let densifier = Densifier::resume(recipe.strategy, extent_m, state.progression.densifier)?;
        let name = backend.to_string();
        if state.progression.backends.last() != Some(&name) {
            state.progression.backends.push(name);
        }
        let mut training = Training::new(backend);
        training.restore_observed(state.model, state.optimiser, state.statistics);
        let held_out_psnr_db = state.progression.rows.last().and_then(|row| row.held_out_psnr_db);
        Ok(Self {
            options,
            dataset,
            held_out: images(&split.held_out),
            views: Views::new(trained_on, memory_bytes.saturating_sub(dataset.bytes())),
            training,
            outstanding: VecDeque::new(),
            recipe,
            densifier,
            progression: state.progression,
            run_sum: run_sum(&identity),
            output,
            identity,
            origin,
            resumed,
            held_out_psnr_db,
        })
    }

    fn train(mut self, observer: &mut dyn Observer, mut flow: ControlFlow<()>) -> Result<Outcome, ReconstructError> {
        let iterations = self.options.iterations;
        let mut watch = Watch::start();
        let mut checkpointed = Instant::now();
        let mut told = Instant::now();
        let mut rate = Rate::new(self.progression.iteration);
        while self.progression.iteration < iterations && flow.is_continue() {
            self.iterate()?;
            let done = self.progression.iteration;
            if self.is_evaluated(done) {
                self.sync()?;
                watch.stop(&mut self.progression);
                flow = both(flow, self.evaluate(observer)?);
                watch = Watch::start();
                rate = Rate::new(done);
            }
            if checkpointed.elapsed() >= self.options.checkpoint_period && done < iterations {
                self.sync()?;
                watch.stop(&mut self.progression);
                watch = Watch::start();
                self.checkpoint()?;
                checkpointed = Instant::now();
            }
            if told.elapsed() >= PROGRESS_PERIOD || done == iterations {
                told = Instant::now();
                flow = both(flow, observer.on(&Event::Trained(self.progress(rate.at(done)))));
            }
        }
        self.sync()?;
        watch.stop(&mut self.progression);
        // What is on disk goes on: also a run that was told to stop after its last iteration.
        self.checkpoint()?;
        if flow.is_break() {
            let iteration = self.progression.iteration;
            return Ok(Outcome::Stopped { iteration, iterations, out: self.output.root().to_owned() });
        }
        self.finish()
    }

    /// One step, with what the strategy and a mission's rules do after it.
    fn iterate(&mut self) -> Result<(), ReconstructError> {
        let iteration = self.progression.iteration;
        let settings: TrainingSettings = self.recipe.settings(iteration);
        let observes = self.densifier.observes(iteration);
        let index = self.progression.order.next_view().unwrap_or(0) as usize;
        let training = &mut self.training;
        let (stepped, counts) = self
            .views
            .with(index, |view| {
                let stepped =
                    if observes { training.step_observed(view, &settings) } else { training.step(view, &settings) };
                (stepped, view.foreground_pixels() > 0)
            })
            .map_err(|(name, source)| ReconstructError::View { name, source })?;
        stepped?;
        self.outstanding.push_back(counts);
        self.densifier.after_step(iteration, &settings, training)?;
        self.progression.iteration = iteration + 1;
        if self.recipe.prunes(self.progression.iteration, self.options.iterations) {
            self.prune()?;
        }
        if self.training.model().is_empty() {
            return Err(ReconstructError::Empty { iteration: self.progression.iteration });
        }
        self.take_losses()
    }

    /// Takes away what a mission's rules say.
    fn prune(&mut self) -> Result<(), ReconstructError> {
        let Some(rules) = self.recipe.rules() else { return Ok(()) };
        let images = self.views.images().iter().zip(0..);
        let views: Vec<DepthView<'_>> = images
            .filter_map(|(image, id)| Some(DepthView { id, camera: &image.camera, depth_m: image.depth_m.as_deref()? }))
            .collect();
        Ok(self.training.prune(&views, rules)?)
    }

    /// Brings the newest model here, wherever it is trained.
    fn sync(&mut self) -> Result<(), ReconstructError> {
        self.training.sync()?;
        self.take_losses()
    }

    /// Takes in the losses that are known by now.
    fn take_losses(&mut self) -> Result<(), ReconstructError> {
        let recent = &mut self.progression.recent_psnr_db;
        for terms in self.training.finished()? {
            if self.outstanding.pop_front() == Some(true) {
                if recent.len() == PSNR_IMAGES {
                    recent.pop_front();
                }
                recent.push_back(terms.foreground_psnr_db().min(PSNR_MAX_DB));
            }
        }
        Ok(())
    }

    fn is_evaluated(&self, done: u32) -> bool {
        let every = self.options.eval_every;
        done == self.options.iterations || PUBLISHED.contains(&done) || (every > 0 && done.is_multiple_of(every))
    }

    /// Measures the model, and writes the curve so far.
    fn evaluate(&mut self, observer: &mut dyn Observer) -> Result<ControlFlow<()>, ReconstructError> {
        let render = self.recipe.render(self.progression.iteration);
        let quality = evaluate(self.training.model(), &self.held_out, &render, self.options.thread_count())?;
        self.held_out_psnr_db = quality.map(|quality| quality.psnr_db);
        let progression = &mut self.progression;
        let row = Row {
            iteration: progression.iteration,
            cpu_s: progression.cpu_s,
            wall_s: progression.wall_s,
            gaussians: self.training.model().len(),
            train_psnr_db: mean(&progression.recent_psnr_db),
            held_out_psnr_db: None,
            held_out_ssim: None,
            held_out_frame_psnr_db: None,
        }
        .with(quality.as_ref());
        progression.rows.push(row);
        shared_types::folder::write_atomic(&self.output.path("metrics.csv"), csv(&progression.rows).as_bytes())?;
        tracing::info!(
            iteration = row.iteration,
            gaussians = row.gaussians,
            cpu_s = row.cpu_s,
            train_psnr_db = row.train_psnr_db,
            held_out_psnr_db = row.held_out_psnr_db,
            held_out_ssim = row.held_out_ssim,
            "evaluated"
        );
        Ok(observer.on(&Event::Evaluated(row)))
    }

    fn progress(&self, per_s: f64) -> Progress {
        Progress {
            iteration: self.progression.iteration,
            iterations: self.options.iterations,
            per_s,
            train_psnr_db: mean(&self.progression.recent_psnr_db),
            held_out_psnr_db: self.held_out_psnr_db,
            gaussians: self.training.model().len(),
        }
    }

    fn checkpoint(&mut self) -> Result<(), ReconstructError> {
        self.progression.densifier = self.densifier.state();
        checkpoint::write(self.output.root(), &self.training, &self.progression, self.run_sum)?;
        Ok(())
    }

    /// Writes the results; `metrics.json`, which says that they are there, last.
    fn finish(self) -> Result<Outcome, ReconstructError> {
        let rows = &self.progression.rows;
        let render = self.recipe.render(self.progression.iteration);
        let mut ply = Vec::new();
        let path = self.output.path("model.ply");
        splatting::ply::write(self.training.model(), &mut ply)
            .map_err(|source| ReconstructError::Model { path: path.clone(), source })?;
        shared_types::folder::write_atomic(&path, &ply)?;
        drop(ply);
        let threads = self.options.thread_count();
        picture::write_curve(&self.output.path("curve.png"), rows)?;
        let held_out = self.output.path("held-out.png");
        picture::write_held_out(&held_out, self.training.model(), &self.held_out, &render, threads)?;
        let report = self.report();
        let json = serde_json::to_string_pretty(&report).unwrap_or_default() + "\n";
        shared_types::folder::write_atomic(&self.output.path("metrics.json"), json.as_bytes())?;
        checkpoint::remove_all(self.output.root());
        Ok(Outcome::Finished { report: Box::new(report), out: self.output.root().to_owned() })
    }

    fn report(&self) -> Report {
        let p = &self.progression;
        let widths = || self.dataset.images.iter().map(|image| image.camera.width);
        let iterations = f64::from(p.iteration.max(1));
        let megabytes = |bytes: u64| (bytes as f64 / 1e5).round() / 10.0;
        let coefficients = 14 + 3 * splatting::sh_rest_coefficients(self.training.model().sh_degree());
        Report {
            run: self.identity.clone(),
            origin: self.origin.name().to_owned(),
            first_gaussians: p.rows.first().map_or(0, |row| row.gaussians),
            gaussians: self.training.model().len(),
            width_px: [widths().min().unwrap_or(0), widths().max().unwrap_or(0)],
            up: self.dataset.up.to_array(),
            threads: self.options.thread_count(),
            backends: p.backends.clone(),
            iterations_per_s: iterations / p.wall_s.max(1e-9),
            cpu_ms_per_iteration: 1e3 * p.cpu_s / iterations,
            evaluations: p.rows.clone(),
            memory: Memory {
                images_mb: megabytes(self.dataset.bytes()),
                views_mb: megabytes(self.views.bytes_used()),
                model_mb: megabytes((self.training.model().len() * (coefficients * 3 * 4 + 16)) as u64),
                peak_rss_mb: peak_rss_bytes().map(megabytes),
            },
        }
    }
}

impl State {
    fn begin(model: splatting::Gaussians, densifier: &Densifier, seed: u64, views: usize) -> Self {
        Self {
            model,
            optimiser: Optimiser::new(),
            statistics: ScreenStatistics::new(),
            progression: Progression {
                iteration: 0,
                order: ViewOrder::new(seed, u32::try_from(views).unwrap_or(u32::MAX)),
                recent_psnr_db: VecDeque::new(),
                rows: Vec::new(),
                cpu_s: 0.0,
                wall_s: 0.0,
                densifier: densifier.state(),
                backends: Vec::new(),
            },
        }
    }
}

fn mean(values: &VecDeque<f64>) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Half of what the machine has free; 1 GiB where it does not tell.
fn default_memory_bytes() -> u64 {
    proc_kilobytes("/proc/meminfo", "MemAvailable:").map_or(1 << 30, |kilobytes| kilobytes * 1024 / 2)
}

fn peak_rss_bytes() -> Option<u64> {
    proc_kilobytes("/proc/self/status", "VmHWM:").map(|kilobytes| kilobytes * 1024)
}

fn proc_kilobytes(path: &str, key: &str) -> Option<u64> {
    let text = std::fs::read_to_string(path).ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix(key))?;
    line.split_ascii_whitespace().next()?.parse().ok()
}
