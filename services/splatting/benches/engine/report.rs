//! The table and the JSON file.

use std::path::Path;

use serde::Serialize;
use splatting::{Engine, Work};

use crate::Least;
use crate::machine::{Machine, REFERENCE_FMA_GFLOPS};

/// One measured piece of work.
#[derive(Serialize)]
pub struct Row {
    backend: String,
    work: &'static str,
    gaussians: usize,
    threads: usize,
    wall_ms: f64,
    cpu_ms: f64,
    /// Iterations or views per second, by processor time on as many cores as there are threads.
    per_s: f64,
    /// Largest resident memory of the process while training, megabytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    memory_mb: Option<f64>,
    stages: serde_json::Map<String, serde_json::Value>,
    #[serde(skip)]
    counted: Option<Work>,
}

impl Row {
    pub fn new(engine: &Engine, work: &'static str, gaussians: usize, items: usize, times: Least) -> Self {
        Self {
            backend: format!("cpu-{:?}", engine.isa()).to_lowercase(),
            work,
            gaussians,
            threads: engine.threads(),
            wall_ms: times.wall_ms,
            cpu_ms: times.cpu_ms,
            per_s: 1e3 * (items * engine.threads()) as f64 / times.cpu_ms,
            memory_mb: None,
            stages: serde_json::Map::new(),
            counted: None,
        }
    }

    pub fn with_memory(mut self, megabytes: Option<f64>) -> Self {
        self.memory_mb = megabytes;
        self
    }

    pub fn with_stages(mut self, stages: impl Iterator<Item = (&'static str, f64)>) -> Self {
        self.stages.extend(stages.map(|(name, ms)| (name.to_owned(), ms.into())));
        self
    }

    pub fn with_work(mut self, work: Work) -> Self {
        self.counted = Some(work);
        self
    }

    /// Rate to reach and aim at, on the reference machine: per second for training, seconds for scoring.
    fn goal(&self) -> Option<(f64, f64)> {
        Some(match (self.work, self.gaussians / 1000) {
            ("train", 50) => (130.0, 190.0),
            ("train", 100) => (85.0, 125.0),
            ("train", 200) => (45.0, 65.0),
            ("score95", 50) => (0.25, 0.15),
            ("score95", 100) => (0.45, 0.25),
            ("score95", 200) => (0.8, 0.45),
            ("score1000", 100) => (2.5, 2.5),
            _ => return None,
        })
    }
}

pub fn print_machine(machine: &Machine) {
    println!("{}", machine.cpu);
    println!(
        "peak {:.0} GFLOP/s per core, {:.1} GB/s; figures to reach are set for {REFERENCE_FMA_GFLOPS:.0} GFLOP/s per core",
        machine.fma_gflops_per_core, machine.bandwidth_gb_s
    );
}

pub fn print_row(machine: &Machine, row: &Row) {
    println!("\n{} {} Gaussians, {}, {} threads", row.work, row.gaussians, row.backend, row.threads);
    println!("  {:8.2} ms processor, {:8.2} ms wall, {:.1} per s", row.cpu_ms, row.wall_ms, row.per_s);
    let scale = machine.fma_gflops_per_core / REFERENCE_FMA_GFLOPS;
    if let Some((least, aim)) = row.goal() {
        if row.work == "train" {
            println!(
                "  to reach {least:.0}/s, here {:.0}: {:.2}; aim {aim:.0}/s, here {:.0}: {:.2}",
                least * scale,
                row.per_s / (least * scale),
                aim * scale,
                row.per_s / (aim * scale)
            );
        } else {
            let seconds = row.cpu_ms / 1e3 / row.threads as f64;
            println!(
                "  {seconds:.2} s; to reach {least:.2} s, here {:.2}: {:.2}; aim {aim:.2} s, here {:.2}: {:.2}",
                least / scale,
                least / scale / seconds,
                aim / scale,
                aim / scale / seconds
            );
        }
    }
    if let Some(megabytes) = row.memory_mb {
        println!("  {megabytes:.0} MB resident at most, everything included");
    }
    let work = row.counted.unwrap_or_default();
    if row.counted.is_some() {
        println!(
            "  {} visible, {} (tile, splat) pairs, {} (4x4 block, splat) pairs",
            work.visible, work.entries, work.contributions
        );
    }
    for (name, ms) in &row.stages {
        let ms = ms.as_f64().unwrap_or(f64::NAN);
        let (flops, bytes) = floor(name, work);
        let (compute, memory) =
            (flops / ms / 1e6 / machine.fma_gflops_per_core, bytes / ms / 1e6 / machine.bandwidth_gb_s);
        println!(
            "    {name:<10} {ms:7.2} ms   {:7.1} MFLOP {:4.0} % of peak   {:6.1} MB {:4.0} % of bandwidth",
            flops / 1e6,
            100.0 * compute,
            bytes / 1e6,
            100.0 * memory
        );
    }
}

/// Floating-point operations and bytes that a stage cannot do without, as this engine does it: counted by hand from the
/// kernels, per Gaussian, (tile, splat) pair, (block, splat) pair of 16 pixels, or pixel. Bytes are those of the data
/// that does not stay in a core's caches.
fn floor(stage: &str, work: Work) -> (f64, f64) {
    let [gaussians, visible, entries, pairs, pixels] =
        [work.gaussians, work.visible, work.entries, work.contributions, work.pixels].map(|n| n as f64);
    match stage {
        // 14 parameters in; a row of 64 bytes and an item of 16 out.
        "project" => (260.0 * gaussians, 56.0 * gaussians + 80.0 * visible),
        // Pack, two passes: read and write 16 bytes each.
        "sort" => (0.0, 96.0 * visible),
        // Items twice, one index out.
        "bin" => (0.0, 32.0 * visible + 4.0 * entries),
        // Block test 34 per block; 34 per pixel. Rows, indices, contributors.
        "blend" => (34.0 * 16.0 * entries + 34.0 * 16.0 * pairs, 68.0 * entries + 4.0 * pairs + 20.0 * pixels),
        // Two separable 11-tap filters over five and three planes of three channels, and back.
        "loss" => (3.0 * (5.0 + 3.0) * 2.0 * 22.0 * pixels, 60.0 * pixels),
        "backward" => (62.0 * 16.0 * pairs, 132.0 * entries + 4.0 * pairs + 40.0 * pixels),
        // Sums in; parameters and two moments in and out.
        "adam" => (600.0 * visible, 64.0 * entries + 336.0 * visible),
        _ => (0.0, 0.0),
    }
}

/// Writes `target/bench/splatting.json` beside the build that ran.
pub fn write(machine: &Machine, rows: &[Row]) -> Result<(), Box<dyn std::error::Error>> {
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target"),
        |directory| Path::new(&directory).to_path_buf(),
    );
    let directory = target.join("bench");
    std::fs::create_dir_all(&directory)?;
    let file = directory.join("splatting.json");
    let json = serde_json::json!({
        "machine": {
            "cpu": machine.cpu,
            "fma_gflops_per_core": machine.fma_gflops_per_core,
            "bandwidth_gb_s": machine.bandwidth_gb_s,
        },
        "rows": rows,
    });
    std::fs::write(&file, serde_json::to_string_pretty(&json)?)?;
    println!("\nwrote {}", file.display());
    Ok(())
}
