//! The engines against the machine's limits, on a synthetic scene.
//!
//! `cargo bench -p splatting --bench engine -- [thousands of Gaussians ...] [--only train|score95|score1000]
//! [--threads 2] [--repetitions 40] [--backend cpu|gpu] [--adapter NAME]`; 50, 100 and 200 thousand without numbers. Prints the tables and writes
//! `target/bench/splatting.json`. Figures are the least of many repetitions: other processes only ever add. On a busy
//! machine wall time says little; what counts is processor time, all threads together.

mod gpu;
mod machine;
mod report;
mod scene;

use std::hint::black_box;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use glam::Vec3;
use machine::Machine;
use report::Row;
use splatting::{
    Engine, Gaussians, MomentsView, Optimiser, RenderSettings, Rendered, TrainingSettings, TrainingView, Work,
};

/// Names of [`Engine::stage_times`].
const STAGES: [&str; 7] = ["project", "sort", "bin", "blend", "loss", "backward", "adam"];

/// Least wall and processor time of some repetitions, milliseconds.
#[derive(Clone, Copy)]
struct Least {
    wall_ms: f64,
    cpu_ms: f64,
}

/// Processor time of this process, all threads, milliseconds.
fn cpu_ms() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 * 1e-6
}

fn least(repetitions: usize, mut f: impl FnMut()) -> Least {
    f();
    (0..repetitions).fold(Least { wall_ms: f64::INFINITY, cpu_ms: f64::INFINITY }, |least, _| {
        let (start, start_cpu) = (Instant::now(), cpu_ms());
        f();
        let (cpu_ms, wall_ms) = (cpu_ms() - start_cpu, start.elapsed().as_secs_f64() * 1e3);
        Least { wall_ms: least.wall_ms.min(wall_ms), cpu_ms: least.cpu_ms.min(cpu_ms) }
    })
}

/// Forgets the largest memory use so far, and with `None` where the system does not say, reads it.
mod peak {
    /// From here on the peak is counted anew.
    pub fn forget() {
        // Without permission the peak is that of the whole run, which is no less.
        std::fs::write("/proc/self/clear_refs", "5").ok();
    }

    /// Most memory resident since, megabytes.
    pub fn megabytes() -> Option<f64> {
        let status = std::fs::read_to_string("/proc/self/status").ok()?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
        line.trim().strip_suffix("kB")?.trim().parse::<f64>().ok().map(|kb| kb / 1024.0)
    }
}

struct Options {
    counts: Vec<usize>,
    only: Option<String>,
    threads: usize,
    repetitions: usize,
    on_gpu: bool,
    adapter: Option<String>,
}

impl Options {
    fn parse() -> Self {
        let mut options =
            Self { counts: Vec::new(), only: None, threads: 2, repetitions: 40, on_gpu: false, adapter: None };
        let mut arguments = std::env::args().skip(1);
        while let Some(argument) = arguments.next() {
            match argument.as_str() {
                "--only" => options.only = arguments.next(),
                "--threads" => options.threads = arguments.next().and_then(|v| v.parse().ok()).unwrap_or(2),
                "--repetitions" => options.repetitions = arguments.next().and_then(|v| v.parse().ok()).unwrap_or(40),
                "--backend" => options.on_gpu = arguments.next().as_deref() == Some("gpu"),
                "--adapter" => options.adapter = arguments.next(),
                other => options.counts.extend(other.parse::<usize>()),
            }
        }
        if options.counts.is_empty() {
            options.counts = vec![50, 100, 200];
        }
        options
    }

    fn wants(&self, work: &str) -> bool {
        self.only.as_deref().is_none_or(|only| only == work)
    }
}

/// Learning rates that leave the scene as it is, so that every repetition does the same work.
fn still() -> TrainingSettings {
    TrainingSettings {
        lr_means: 1e-9,
        lr_log_scales: 1e-9,
        lr_rotations: 1e-9,
        lr_opacity: 1e-9,
        lr_sh: 1e-9,
        ..TrainingSettings::default()
    }
}

/// The scene's model, and a keyframe of it.
fn subject(engine: &mut Engine, count: usize) -> Result<(Gaussians, TrainingView), Box<dyn std::error::Error>> {
    let model = scene::model(count);
    let camera = scene::camera(0, 1, 2.0, Vec3::ZERO);
    let mut rendered = Rendered::default();
    engine.render(&model, &camera, &RenderSettings::default(), &mut rendered);
    let view = scene::keyframe(camera, &rendered)?;
    Ok((model, view))
}

/// What an iteration on the scene has to do.
fn scene_work(count: usize) -> Result<Work, Box<dyn std::error::Error>> {
    let mut engine = Engine::new(1)?;
    let (mut model, view) = subject(&mut engine, count)?;
    engine.train_step(&mut model, &mut Optimiser::new(), &view, &still());
    Ok(engine.work())
}

fn name(engine: &Engine) -> (String, usize) {
    (format!("cpu-{:?}", engine.isa()).to_lowercase(), engine.threads())
}

/// A training iteration: stages on one thread, the whole on all threads.
fn train(options: &Options, count: usize) -> Result<Row, Box<dyn std::error::Error>> {
    let still = still();
    let mut optimiser = Optimiser::new();
    let mut single = Engine::new(1)?;
    let (mut model, view) = subject(&mut single, count)?;
    let mut stages = [f64::INFINITY; STAGES.len()];
    least(options.repetitions, || {
        black_box(single.train_step(&mut model, &mut optimiser, &view, &still));
        for (least, time) in stages.iter_mut().zip(single.stage_times()) {
            *least = least.min(time.as_secs_f64() * 1e3);
        }
    });
    let work = single.work();
    drop(single);
    peak::forget();
    let mut engine = Engine::new(options.threads)?;
    let times = least(options.repetitions, || {
        black_box(engine.train_step(&mut model, &mut optimiser, &view, &still));
    });
    let row = Row::of_cpu(name(&engine), "train", work, 1, times).with_memory(peak::megabytes());
    Ok(row.with_stages(STAGES.iter().copied().zip(stages)))
}

/// The views of a request.
fn score_views(work: &str) -> Vec<MomentsView> {
    let mut views = Vec::new();
    if work == "score95" {
        views.extend((0..95).map(|i| (scene::camera(i, 95, 2.0, Vec3::ZERO), 2.0)));
    } else {
        // Four radii; from each place the camera looks at five points.
        for i in 0..1000 {
            let radius = [1.6, 2.0, 2.4, 2.8][i % 4];
            let target = 0.3 * [Vec3::ZERO, Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::Z][i / 4 % 5];
            views.push((scene::camera(i / 20, 50, radius, target), radius));
        }
    }
    views.into_iter().map(|(camera, reference_m)| MomentsView { camera, reference_m }).collect()
}

/// Moments of many views in one request.
fn score(options: &Options, work: &'static str, count: usize) -> Result<Row, Box<dyn std::error::Error>> {
    let model: Gaussians = scene::model(count);
    let views = score_views(work);
    let mut engine = Engine::new(options.threads)?;
    let cancel = AtomicBool::new(false);
    let repetitions = if work == "score95" { 3 } else { 1 };
    let mut failure = None;
    let times = least(repetitions, || {
        let result = engine.moments_batch(&model, &views, &RenderSettings::default(), &cancel, |_, moments| {
            black_box(moments);
        });
        failure = result.err();
    });
    match failure {
        Some(error) => Err(error.into()),
        None => Ok(Row::of_cpu(name(&engine), work, scene_work(count)?, views.len(), times)),
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let options = Options::parse();
    if options.on_gpu {
        return gpu::run(&options);
    }
    let machine = Machine::measure(options.threads);
    report::print_machine(&machine);
    let mut rows = Vec::new();
    for &thousands in &options.counts {
        let count = 1000 * thousands;
        for work in ["train", "score95", "score1000"].into_iter().filter(|work| options.wants(work)) {
            // A thousand views take minutes where the machine is slow: one size is enough.
            if work == "score1000" && thousands != 100 && options.only.is_none() {
                continue;
            }
            let row = if work == "train" { train(&options, count)? } else { score(&options, work, count)? };
            report::print_row(&machine, &row);
            rows.push(row);
        }
    }
    report::write(&machine, &rows)
}
