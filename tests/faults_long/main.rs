//! Missions under random faults, for hours: how often a mission or a keyframe is lost, and how soon services work again.
//!
//! ```text
//! cargo test --release --test faults_long -- --missions 200
//! ```
//!
//! Not part of `cargo test`. Every fault and every mission is a line of a file as soon as it is over, and a run goes on
//! with the file it finds; the table at the end is of the whole file. Folders of missions that did not come out well stay.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

#[path = "../common/mod.rs"]
mod common;
mod judge;
mod load;
mod mission;
mod phase;
mod record;
mod starts;
mod table;

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::{Parser, ValueEnum};

use record::Results;

/// What is done to a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Blow {
    /// SIGKILL.
    Kill,
    /// SIGTERM: it ends in order and is started again.
    Term,
    /// SIGSTOP, and SIGCONT after a while.
    Stop,
}

/// Flies missions under random faults.
#[derive(Debug, Parser)]
#[command(after_help = "Examples:\n  \
    cargo test --release --test faults_long -- --missions 200 --kills 5\n  \
    cargo test --release --test faults_long -- --blow stop --stop-s 2 --set clock.mode=wall --out target/stops\n  \
    cargo test --release --test faults_long -- --starts 2000\n  \
    cargo test --release --test faults_long -- --at-once 2 --baseline target/undisturbed --vary-seed --out target/pairs")]
struct Options {
    /// Missions in all, those of the file included.
    #[arg(long, default_value_t = 20)]
    missions: u64,
    /// Faults of each mission, as far as it lasts.
    #[arg(long, default_value_t = 5)]
    kills: u32,
    /// What is done.
    #[arg(long, value_enum, default_value = "kill")]
    blow: Blow,
    /// How long a stopped process stands, seconds.
    #[arg(long, default_value_t = 2.0)]
    stop_s: f64,
    /// How many services are hit at once.
    #[arg(long, default_value_t = 1)]
    at_once: usize,
    /// Nobody is waited for: neither the phase that is drawn nor the recovery, only the pause.
    #[arg(long)]
    storm: bool,
    /// Every mission has a seed of its own, beginning with 21, instead of 21 for all.
    #[arg(long)]
    vary_seed: bool,
    /// Folder of results of missions without faults: PSNR is compared seed by seed.
    #[arg(long)]
    baseline: Option<PathBuf>,
    /// Keys of the missions' configuration.
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    sets: Vec<String>,
    /// Stop to begin missions after so many hours.
    #[arg(long, default_value_t = 24.0)]
    hours: f64,
    /// Preset of the missions.
    #[arg(long, default_value = "tiny")]
    preset: String,
    /// Seed of what is killed and when.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Only this service is hit; default: any, and launch.
    #[arg(long)]
    service: Option<String>,
    /// Longest wall time of a fault behind the beginning of the phase that is drawn for it, milliseconds; the least is 0.
    #[arg(long, default_value_t = 200)]
    pause_ms: u64,
    /// No missions: starts services beside a keeper, so often in all, and kills most of them while they start.
    #[arg(long, value_name = "CYCLES")]
    starts: Option<u64>,
    /// Where results go.
    #[arg(long, default_value = "target/faults")]
    out: PathBuf,
}

fn main() -> ExitCode {
    let options = Options::parse();
    if let Some(cycles) = options.starts {
        return if starts::storm(cycles, options.seed, &options.out) { ExitCode::SUCCESS } else { ExitCode::FAILURE };
    }
    let mut results = Results::open(&options.out);
    let began = Instant::now();
    let flown: BTreeSet<u64> = results.missions.iter().map(|mission| mission.mission).collect();
    let left: Vec<u64> = (0..options.missions).filter(|index| !flown.contains(index)).collect();
    for (done, index) in left.iter().copied().enumerate() {
        if began.elapsed() > Duration::from_secs_f64(3600.0 * options.hours) {
            break;
        }
        let outcome = mission::fly(&options, index);
        let each = began.elapsed().as_secs_f64() / (done + 1) as f64;
        println!(
            "mission {index}: {} faults, {}, {:.1} s; {:.0} min left",
            outcome.faults.len(),
            outcome.mission.verdict(),
            outcome.mission.wall_s,
            each * (left.len() - done - 1) as f64 / 60.0
        );
        results.add(outcome);
    }
    let baseline = options.baseline.as_deref().map(Results::open);
    print!("{}", table::table(&results, baseline.as_ref()));
    if results.missions.iter().all(record::Mission::is_well) { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
