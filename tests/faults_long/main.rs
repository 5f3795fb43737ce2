//! Missions under random kills, for hours: how often a mission or a keyframe is lost, and how soon the dead are back.
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
mod mission;
mod phase;
mod record;
mod table;

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::Parser;

use record::Results;

/// Flies missions under random kills.
#[derive(Debug, Parser)]
#[command(after_help = "Example: cargo test --release --test faults_long -- --missions 200 --kills 5")]
struct Options {
    /// Missions in all, those of the file included.
    #[arg(long, default_value_t = 20)]
    missions: u64,
    /// Kills of each mission, as far as it lasts.
    #[arg(long, default_value_t = 5)]
    kills: u32,
    /// Stop to begin missions after so many hours.
    #[arg(long, default_value_t = 24.0)]
    hours: f64,
    /// Preset of the missions.
    #[arg(long, default_value = "tiny")]
    preset: String,
    /// Seed of what is killed and when.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Only this service is killed; default: any, and launch.
    #[arg(long)]
    service: Option<String>,
    /// Longest wall time of a kill behind the beginning of the phase that is drawn for it, milliseconds; the least is 0.
    #[arg(long, default_value_t = 200)]
    pause_ms: u64,
    /// Where results go.
    #[arg(long, default_value = "target/faults")]
    out: PathBuf,
}

fn main() -> ExitCode {
    let options = Options::parse();
    let mut results = Results::open(&options.out);
    let began = Instant::now();
    let done_before = results.missions.len() as u64;
    for index in done_before..options.missions {
        if began.elapsed() > Duration::from_secs_f64(3600.0 * options.hours) {
            break;
        }
        let outcome = mission::fly(&options, index);
        let each = began.elapsed().as_secs_f64() / (index + 1 - done_before) as f64;
        println!(
            "mission {index}: {} kills, {}, {:.1} s; {:.0} min left",
            outcome.faults.len(),
            outcome.mission.verdict(),
            outcome.mission.wall_s,
            each * (options.missions - index - 1) as f64 / 60.0
        );
        results.add(outcome);
    }
    print!("{}", table::table(&results));
    if results.missions.iter().all(record::Mission::is_well) { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
