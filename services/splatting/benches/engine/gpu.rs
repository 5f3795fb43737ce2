//! The GPU engine: rates by wall time, processor time for recording, stages by the GPU's own clock.

use std::hint::black_box;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use glam::DVec3;
use splatting::gpu::{Engine, Options as Adapter, adapters};
use splatting::uncertainty::{BoundingBox, UncertaintySettings, VarianceMode};
use splatting::{Camera, Optimiser, RenderSettings, ScreenStatistics};

use crate::machine::Machine;
use crate::report::{self, Row};
use crate::{Least, Options, STAGES, cpu_ms, scene, scene_work, score_views, still, subject};

/// Iterations of one measurement: enough that the queue never runs empty.
const ITERATIONS: usize = 64;
/// Most measurements take no longer than this, seconds; software adapters would take hours.
const PATIENCE_S: f64 = 20.0;

/// Runs the bench on a GPU.
pub fn run(options: &Options) -> Result<(), Box<dyn std::error::Error>> {
    let adapter = Adapter { adapter: options.adapter.clone(), ..Adapter::default() };
    let mut engine = Engine::new(&adapter)?;
    let card = adapters().into_iter().find(|card| card.name == engine.name());
    let driver = card.map(|card| card.driver).unwrap_or_default();
    let (gflops, gb_s) = engine.measure_peaks()?;
    let machine =
        Machine { cpu: format!("{}, {driver}", engine.name()), fma_gflops_per_core: gflops, bandwidth_gb_s: gb_s };
    report::print_gpu(&machine);
    let mut rows = Vec::new();
    for &thousands in &options.counts {
        for work in ["train", "score95"].into_iter().filter(|work| options.wants(work)) {
            let row = match work {
                "train" => train(options, &mut engine, 1000 * thousands)?,
                _ => score(options, &mut engine, 1000 * thousands)?,
            };
            report::print_row(&machine, &row);
            rows.push(row);
        }
    }
    for (what, bytes) in engine.bytes() {
        println!("  {:8.1} MB {what}", bytes as f64 / 1e6);
    }
    report::write(&machine, &rows)
}

/// Least wall and processor time of `items` of something.
fn least(
    repetitions: usize,
    items: usize,
    mut f: impl FnMut() -> Result<(), Box<dyn std::error::Error>>,
) -> Result<Least, Box<dyn std::error::Error>> {
    let mut least = Least { wall_ms: f64::INFINITY, cpu_ms: f64::INFINITY };
    let begun = Instant::now();
    for _ in 0..repetitions {
        let (start, start_cpu) = (Instant::now(), cpu_ms());
        f()?;
        let (cpu, wall) = (cpu_ms() - start_cpu, start.elapsed().as_secs_f64() * 1e3);
        least = Least { wall_ms: least.wall_ms.min(wall / items as f64), cpu_ms: least.cpu_ms.min(cpu / items as f64) };
        if begun.elapsed().as_secs_f64() > PATIENCE_S {
            break;
        }
    }
    Ok(least)
}

fn train(options: &Options, engine: &mut Engine, count: usize) -> Result<Row, Box<dyn std::error::Error>> {
    let mut cpu = splatting::Engine::new(1)?;
    let (model, view) = subject(&mut cpu, count)?;
    engine.upload(&model, &mut Optimiser::new(), &mut ScreenStatistics::new())?;
    let still = still();
    engine.step(&view, &still)?;
    engine.finish()?;
    let mut stages = [f64::INFINITY; STAGES.len()];
    let begun = Instant::now();
    for _ in 0..options.repetitions {
        let Some(times) = engine.profile(&view, &still)? else { break };
        for (least, time) in stages.iter_mut().zip(times) {
            *least = least.min(1e3 * time);
        }
        if begun.elapsed().as_secs_f64() > PATIENCE_S {
            break;
        }
    }
    let single = begun.elapsed().as_secs_f64() / options.repetitions as f64;
    let iterations = if single > 0.1 { 1 } else { ITERATIONS };
    let times = least(options.repetitions, iterations, || {
        for _ in 0..iterations {
            engine.step(&view, &still)?;
        }
        engine.finish()?;
        Ok(())
    })?;
    let megabytes: u64 = engine.bytes().iter().map(|(_, bytes)| bytes).sum();
    let row = Row::of_gpu(format!("gpu {}", engine.name()), "train", scene_work(count)?, 1, times);
    let stages = STAGES.iter().copied().zip(stages).filter(|(_, ms)| ms.is_finite());
    Ok(row.with_stages(stages).with_memory(Some(megabytes as f64 / 1e6)))
}

fn score(options: &Options, engine: &mut Engine, count: usize) -> Result<Row, Box<dyn std::error::Error>> {
    let (model, views) = (scene::model(count), score_views("score95"));
    let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
    let (cancel, settings) = (AtomicBool::new(false), RenderSettings::default());
    // What the scorer asks: the box about the object.
    let bounding_box = BoundingBox { center_m: DVec3::ZERO, size_m: 2.0 };
    let asked = UncertaintySettings { mode: VarianceMode::Normalised, bounding_box, transparent_alpha: 0.1 };
    let mut once = || {
        engine.uncertainties(&model, &cameras, (&asked, &settings), &cancel, |_, found| {
            black_box(found);
        })
    };
    once()?;
    let times = least(options.repetitions.min(10), 1, || Ok(once()?))?;
    Ok(Row::of_gpu(format!("gpu {}", engine.name()), "score95", scene_work(count)?, views.len(), times))
}
