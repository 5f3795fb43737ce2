//! The run: from a folder to a model, through kills.

use std::collections::VecDeque;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};
use splatting::order::ViewOrder;
use splatting::rgbd::prune::DepthView;
use splatting::{
    Densifier, Engine, Gaussians, InitialGaussians, Optimiser, ScreenStatistics, Strategy, TrainingSettings,
    scene_extent,
};

use crate::checkpoint::{self, Progression, State};
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
/// Wall time that the rate is a mean over.
const RATE_WINDOW: Duration = Duration::from_secs(10);

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
    let engine = Engine::new(options.thread_count())?;
    let strategy = strategy_for(options, &dataset);
    let identity = Identity::of(options, &dataset, &split, strategy, &format!("{:?}", engine.isa()));
    let resumed = output.admit(&identity, options.overwrite)?;
    let mut run = Run::new(options, &dataset, &split, engine, output, identity, memory_bytes, resumed)?;
    if run.resumed {
        flow = both(flow, observer.on(&Event::Resumed { iteration: run.state.progression.iteration }));
    } else {
        let began = Event::Began { origin: run.origin.name(), gaussians: run.state.model.len() };
        flow = both(flow, observer.on(&began));
        flow = both(flow, run.evaluate(observer)?);
    }
    run.train(observer, flow)
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
    engine: Engine,
    recipe: Recipe,
    densifier: Densifier,
    state: State,
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
        engine: Engine,
        output: Output,
        identity: Identity,
        memory_bytes: u64,
        resumed: Option<State>,
    ) -> Result<Self, ReconstructError> {
        let images = |indices: &[usize]| indices.iter().filter_map(|&i| dataset.images.get(i)).collect::<Vec<_>>();
        let training = images(&split.training);
        let extent_m = scene_extent(training.iter().map(|image| &image.camera)).unwrap_or(1.0);
        let recipe = Recipe::new(options, dataset, extent_m, start::voxel_m(dataset, &split.training));
        let (state, origin, resumed) = match resumed {
            Some(state) => (state, start::origin(dataset, &split.training), true),
            None => {
                let how = match recipe.strategy {
                    Strategy::Mcmc(_) => InitialGaussians::MCMC,
                    Strategy::None | Strategy::Default(_) => InitialGaussians::PUBLISHED,
                };
                let bounds = (options.max_gaussians, options.sh_degree, options.seed);
                let start = start::start(dataset, &split.training, how, bounds);
                if !start::is_seen(&start.model, &training, recipe.render(0).near_m) {
                    let (gaussians, origin) = (start.model.len(), start.origin.name());
                    return Err(ReconstructError::Unseen { gaussians, origin, images: training.len() });
                }
                let densifier = Densifier::new(recipe.strategy, extent_m, options.seed, &start.model)?;
                (State::begin(start.model, &densifier, options.seed, training.len()), start.origin, false)
            }
        };
        let densifier = Densifier::resume(recipe.strategy, extent_m, state.progression.densifier)?;
        let held_out_psnr_db = state.progression.rows.last().and_then(|row| row.held_out_psnr_db);
        Ok(Self {
            options,
            dataset,
            held_out: images(&split.held_out),
            views: Views::new(training, memory_bytes.saturating_sub(dataset.bytes())),
            engine,
            recipe,
            densifier,
            state,
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
        let mut rate = Rate::new(self.state.progression.iteration);
        while self.state.progression.iteration < iterations && flow.is_continue() {
            self.iterate()?;
            let done = self.state.progression.iteration;
            if self.is_evaluated(done) {
                watch.stop(&mut self.state.progression);
                flow = both(flow, self.evaluate(observer)?);
                watch = Watch::start();
                rate = Rate::new(done);
            }
            if checkpointed.elapsed() >= self.options.checkpoint_period && done < iterations {
                watch.stop(&mut self.state.progression);
                watch = Watch::start();
                self.checkpoint()?;
                checkpointed = Instant::now();
            }
            if told.elapsed() >= PROGRESS_PERIOD || done == iterations {
                told = Instant::now();
                flow = both(flow, observer.on(&Event::Trained(self.progress(rate.at(done)))));
            }
        }
        watch.stop(&mut self.state.progression);
        // What is on disk goes on: also a run that was told to stop after its last iteration.
        self.checkpoint()?;
        if flow.is_break() {
            let iteration = self.state.progression.iteration;
            return Ok(Outcome::Stopped { iteration, iterations, out: self.output.root().to_owned() });
        }
        self.finish()
    }

    /// One step, with what the strategy and a mission's rules do after it.
    fn iterate(&mut self) -> Result<(), ReconstructError> {
        let iteration = self.state.progression.iteration;
        let settings: TrainingSettings = self.recipe.settings(iteration);
        let State { model, optimiser, statistics, progression } = &mut self.state;
        let engine = &mut self.engine;
        let observes = self.densifier.observes(iteration);
        let index = progression.order.next_view().unwrap_or(0) as usize;
        let terms = self
            .views
            .with(index, |view| {
                let terms = if observes {
                    engine.train_step_observed(model, optimiser, view, &settings, statistics)
                } else {
                    engine.train_step(model, optimiser, view, &settings)
                };
                (terms, view.foreground_pixels())
            })
            .map_err(|(name, source)| ReconstructError::View { name, source })?;
        if let (terms, 1..) = terms {
            if progression.recent_psnr_db.len() == PSNR_IMAGES {
                progression.recent_psnr_db.pop_front();
            }
            progression.recent_psnr_db.push_back(terms.foreground_psnr_db().min(PSNR_MAX_DB));
        }
        self.densifier.after_step(engine, iteration, &settings, model, optimiser, statistics);
        progression.iteration = iteration + 1;
        if self.recipe.prunes(progression.iteration, self.options.iterations) {
            let views: Vec<DepthView<'_>> = self
                .views
                .images()
                .iter()
                .filter_map(|image| Some(DepthView { camera: &image.camera, depth_m: image.depth_m.as_deref()? }))
                .collect();
            let kept = self.recipe.keep(model, &views);
            retain(model, optimiser, statistics, &kept);
        }
        if model.is_empty() {
            return Err(ReconstructError::Empty { iteration: progression.iteration });
        }
        Ok(())
    }

    fn is_evaluated(&self, done: u32) -> bool {
        let every = self.options.eval_every;
        done == self.options.iterations || PUBLISHED.contains(&done) || (every > 0 && done.is_multiple_of(every))
    }

    /// Measures the model, and writes the curve so far.
    fn evaluate(&mut self, observer: &mut dyn Observer) -> Result<ControlFlow<()>, ReconstructError> {
        let render = self.recipe.render(self.state.progression.iteration);
        let quality = evaluate(&self.state.model, &self.held_out, &render, self.options.thread_count())?;
        self.held_out_psnr_db = quality.map(|quality| quality.psnr_db);
        let progression = &mut self.state.progression;
        let row = Row {
            iteration: progression.iteration,
            cpu_s: progression.cpu_s,
            wall_s: progression.wall_s,
            gaussians: self.state.model.len(),
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
            iteration: self.state.progression.iteration,
            iterations: self.options.iterations,
            per_s,
            train_psnr_db: mean(&self.state.progression.recent_psnr_db),
            held_out_psnr_db: self.held_out_psnr_db,
            gaussians: self.state.model.len(),
        }
    }

    fn checkpoint(&mut self) -> Result<(), ReconstructError> {
        self.state.progression.densifier = self.densifier.state();
        checkpoint::write(self.output.root(), &self.state, self.run_sum)?;
        Ok(())
    }

    /// Writes the results; `metrics.json`, which says that they are there, last.
    fn finish(self) -> Result<Outcome, ReconstructError> {
        let rows = &self.state.progression.rows;
        let render = self.recipe.render(self.state.progression.iteration);
        let mut ply = Vec::new();
        let path = self.output.path("model.ply");
        splatting::ply::write(&self.state.model, &mut ply)
            .map_err(|source| ReconstructError::Model { path: path.clone(), source })?;
        shared_types::folder::write_atomic(&path, &ply)?;
        drop(ply);
        let threads = self.options.thread_count();
        picture::write_curve(&self.output.path("curve.png"), rows)?;
        let held_out = self.output.path("held-out.png");
        picture::write_held_out(&held_out, &self.state.model, &self.held_out, &render, threads)?;
        let report = self.report();
        let json = serde_json::to_string_pretty(&report).unwrap_or_default() + "\n";
        shared_types::folder::write_atomic(&self.output.path("metrics.json"), json.as_bytes())?;
        checkpoint::remove_all(self.output.root());
        Ok(Outcome::Finished { report: Box::new(report), out: self.output.root().to_owned() })
    }

    fn report(&self) -> Report {
        let p = &self.state.progression;
        let widths = || self.dataset.images.iter().map(|image| image.camera.width);
        let iterations = f64::from(p.iteration.max(1));
        let megabytes = |bytes: u64| (bytes as f64 / 1e5).round() / 10.0;
        let coefficients = 14 + 3 * splatting::sh_rest_coefficients(self.state.model.sh_degree());
        Report {
            run: self.identity.clone(),
            origin: self.origin.name().to_owned(),
            first_gaussians: p.rows.first().map_or(0, |row| row.gaussians),
            gaussians: self.state.model.len(),
            width_px: [widths().min().unwrap_or(0), widths().max().unwrap_or(0)],
            up: self.dataset.up.to_array(),
            threads: self.engine.threads(),
            iterations_per_s: iterations / p.wall_s.max(1e-9),
            cpu_ms_per_iteration: 1e3 * p.cpu_s / iterations,
            evaluations: p.rows.clone(),
            memory: Memory {
                images_mb: megabytes(self.dataset.bytes()),
                views_mb: megabytes(self.views.bytes_used()),
                model_mb: megabytes((self.state.model.len() * (coefficients * 3 * 4 + 16)) as u64),
                peak_rss_mb: peak_rss_bytes().map(megabytes),
            },
        }
    }
}

impl State {
    fn begin(model: Gaussians, densifier: &Densifier, seed: u64, views: usize) -> Self {
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
            },
        }
    }
}

fn retain(model: &mut Gaussians, optimiser: &mut Optimiser, statistics: &mut ScreenStatistics, kept: &[bool]) {
    let keep = |index: usize| kept.get(index).copied().unwrap_or(false);
    optimiser.fit(model);
    statistics.fit(model);
    model.retain(keep);
    optimiser.retain(keep);
    statistics.retain(keep);
}

fn mean(values: &VecDeque<f64>) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Processor and wall time of training.
struct Watch {
    wall: Instant,
    cpu_s: f64,
}

impl Watch {
    fn start() -> Self {
        Self { wall: Instant::now(), cpu_s: process_cpu_s() }
    }

    fn stop(self, progression: &mut Progression) {
        progression.wall_s += self.wall.elapsed().as_secs_f64();
        progression.cpu_s += process_cpu_s() - self.cpu_s;
    }
}

/// Iterations a second of late.
struct Rate {
    marks: VecDeque<(Instant, u32)>,
}

impl Rate {
    fn new(iteration: u32) -> Self {
        Self { marks: VecDeque::from([(Instant::now(), iteration)]) }
    }

    fn at(&mut self, iteration: u32) -> f64 {
        let now = Instant::now();
        self.marks.push_back((now, iteration));
        while self.marks.len() > 2 && self.marks.front().is_some_and(|mark| now - mark.0 > RATE_WINDOW) {
            self.marks.pop_front();
        }
        self.marks.front().map_or(0.0, |(when, first)| {
            f64::from(iteration.saturating_sub(*first)) / (now - *when).as_secs_f64().max(1e-9)
        })
    }
}

/// Processor time of all threads of this process, seconds.
fn process_cpu_s() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
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
