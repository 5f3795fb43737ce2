//! The table and the JSON file.

use std::path::Path;

use serde::Serialize;
use splatting::Work;

use crate::Least;
use crate::machine::{Machine, REFERENCE};

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
    /// Largest resident memory of the process while training (on a GPU: bytes allocated there), megabytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    memory_mb: Option<f64>,
    stages: serde_json::Map<String, serde_json::Value>,
    /// What an iteration on this scene has to do.
    #[serde(skip)]
    counted: Work,
}

impl Row {
    /// What the CPU did, with so many threads.
    pub fn of_cpu(
        (backend, threads): (String, usize),
        work: &'static str,
        counted: Work,
        items: usize,
        times: Least,
    ) -> Self {
        let per_s = 1e3 * (items * threads) as f64 / times.cpu_ms;
        Self::new((backend, threads, per_s), work, counted, times)
    }

    /// What a GPU did: its rates are of wall time.
    pub fn of_gpu(backend: String, work: &'static str, counted: Work, items: usize, times: Least) -> Self {
        Self::new((backend, 0, 1e3 * items as f64 / times.wall_ms), work, counted, times)
    }

    fn new((backend, threads, per_s): (String, usize, f64), work: &'static str, counted: Work, times: Least) -> Self {
        Self {
            backend,
            work,
            gaussians: counted.gaussians,
            threads,
            wall_ms: times.wall_ms,
            cpu_ms: times.cpu_ms,
            per_s,
            memory_mb: None,
            stages: serde_json::Map::new(),
            counted,
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

    /// Rate to reach and aim at, on the reference machine: per second for training, seconds for scoring.
    fn goal(&self) -> Option<(f64, f64)> {
        Some(match (self.work, self.gaussians / 1000) {
            // On an H200.
            ("train", 200) if self.is_gpu() => (1500.0, 2500.0),
            ("score95", 200) if self.is_gpu() => (0.015, 0.008),
            _ if self.is_gpu() => return None,
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

    fn is_gpu(&self) -> bool {
        self.threads == 0
    }

    /// Least time of an item on so many cores of a machine, milliseconds: each stage at the peak of multiply-adds or at
    /// the memory's bandwidth, whichever takes longer.
    fn floor_ms(&self, machine: &Machine) -> f64 {
        let stages: &[&str] = match self.work {
            "train" => &crate::STAGES,
            _ => &["project", "sort", "bin", "blend"],
        };
        let seconds = |stage: &&str| {
            let (flops, bytes) = floor(stage, self.counted);
            let compute = flops / (machine.fma_gflops_per_core * self.threads.max(1) as f64 * 1e9);
            compute.max(bytes / (machine.bandwidth_gb_s * 1e9))
        };
        1e3 * stages.iter().map(seconds).sum::<f64>()
    }

    /// How many times the reference machine's floor this machine's is.
    fn scale(&self, machine: &Machine) -> f64 {
        if self.is_gpu() { 1.0 } else { self.floor_ms(machine) / self.floor_ms(&REFERENCE.with_cores(self.threads)) }
    }
}

pub fn print_gpu(machine: &Machine) {
    println!(
        "{}\npeak {:.1} TFLOP/s, {:.0} GB/s",
        machine.cpu,
        machine.fma_gflops_per_core / 1e3,
        machine.bandwidth_gb_s
    );
}

pub fn print_machine(machine: &Machine) {
    println!("{}", machine.cpu);
    println!(
        "peak {:.0} GFLOP/s per core, {:.1} GB/s; figures to reach are set for {:.0} GFLOP/s per core, {:.1} GB/s",
        machine.fma_gflops_per_core, machine.bandwidth_gb_s, REFERENCE.fma_gflops_per_core, REFERENCE.bandwidth_gb_s
    );
}

pub fn print_row(machine: &Machine, row: &Row) {
    println!("\n{} {} Gaussians, {}, {} threads", row.work, row.gaussians, row.backend, row.threads);
    println!("  {:8.2} ms processor, {:8.2} ms wall, {:.1} per s", row.cpu_ms, row.wall_ms, row.per_s);
    if let Some((least, aim)) = row.goal() {
        // A slower floor lowers rates and raises times in the same proportion.
        let scale = row.scale(machine);
        let (found, factor, unit) = match row.work {
            "train" => (row.per_s, 1.0 / scale, "/s"),
            _ if row.is_gpu() => (row.wall_ms / 1e3, scale, " s"),
            _ => (row.cpu_ms / 1e3 / row.threads as f64, scale, " s"),
        };
        let reached = |goal: f64| if row.work == "train" { found / goal } else { goal / found };
        println!(
            "  {found:.3}{unit}; to reach {least}{unit}: {:.2}, by this machine's floor {:.2}{unit}: {:.2}; aim {aim}{unit}: {:.2}, by the floor {:.2}{unit}: {:.2}",
            reached(least),
            least * factor,
            reached(least * factor),
            reached(aim),
            aim * factor,
            reached(aim * factor),
        );
    }
    if let Some(megabytes) = row.memory_mb {
        let kind = if row.is_gpu() { "allocated on the GPU" } else { "resident at most, everything included" };
        println!("  {megabytes:.0} MB {kind}");
    }
    let work = row.counted;
    if !row.stages.is_empty() {
        println!("  floor {:.3} ms here", row.floor_ms(machine));
        if !row.is_gpu() {
            println!("  floor {:.3} ms on the reference machine", row.floor_ms(&REFERENCE.with_cores(row.threads)));
        }
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
            "    {name:<10} {ms:8.3} ms   {:7.1} MFLOP {:4.0} % of peak   {:6.1} MB {:4.0} % of bandwidth",
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
