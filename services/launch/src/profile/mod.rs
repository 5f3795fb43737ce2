//! `vantage profile`: where a running service spends its time, as a flame graph. Samples are taken by Linux's perf, which walks
//! stacks by frame pointers; the service does not notice.

mod flame;
mod stacks;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use shared_types::folder::write_atomic;
use shared_types::system::System;

use crate::cli::Profile;
use crate::exit::{Exit, Refusal};
use crate::progress::Progress;
use crate::{print, status};
use stacks::Stacks;

/// Samples a second: no multiple of what services do periodically.
const SAMPLES_HZ: u32 = 199;
/// What says who may look at whom.
const PARANOID: &str = "/proc/sys/kernel/perf_event_paranoid";

/// Samples a service and writes the graph.
///
/// # Errors
/// When there is no such service, no perf, or perf may not look at it: each with the way out.
pub fn run(arguments: &Profile) -> anyhow::Result<Exit> {
    let system = System::find(&System::base_dir(), arguments.system.as_deref())?;
    let (name, service) = (system.name.clone(), arguments.service.as_str());
    let running = status::pids(system)?;
    let Some(pid) = running.iter().find(|(known, _)| known == service).map(|&(_, pid)| pid) else {
        let known: Vec<&str> = running.iter().map(|(known, _)| known.as_str()).collect();
        let known = known.join(", ");
        return Err(Refusal::missing(format!("{service} does not run in system {name}; expected one of: {known}")));
    };
    let progress = Progress::new();
    progress.doing(&format!("looking at {service} (process {pid}) for {} s", arguments.seconds));
    let samples = Samples::take(pid, arguments.seconds)?;
    progress.doing("finding the names of what was seen");
    let stacks = stacks::read(&samples.script()?);
    progress.clear();
    if stacks.samples() == 0 {
        return Err(Refusal::failed(format!(
            "{service} used no processor time in {} s: there is nothing to draw; try more --seconds, or while it works",
            arguments.seconds
        )));
    }
    let path = arguments.output.clone().unwrap_or_else(|| PathBuf::from(format!("{service}.svg")));
    let title = format!("{service} of system {name}, process {pid}, {} s", arguments.seconds);
    write_atomic(&path, flame::draw(&stacks, &title).as_bytes())?;
    print(&told(&stacks, arguments.seconds, &path))
}

/// The functions that took most, and where the graph lies.
fn told(stacks: &Stacks, seconds: u32, path: &Path) -> String {
    let samples = stacks.samples();
    let cores = samples as f64 / f64::from(SAMPLES_HZ) / f64::from(seconds);
    let top: String = stacks
        .leaves()
        .into_iter()
        .take(8)
        .map(|(name, count)| format!("{:5.1} %  {name}\n", 100.0 * count as f64 / samples as f64))
        .collect();
    format!("{samples} samples, {cores:.2} cores\n{top}flame graph {}\n", path.display())
}

/// What perf recorded, removed when this is dropped.
struct Samples(PathBuf);

impl Samples {
    fn take(pid: u32, seconds: u32) -> anyhow::Result<Self> {
        let samples = Self(std::env::temp_dir().join(format!("vantage-profile-{}.data", std::process::id())));
        let rate = SAMPLES_HZ.to_string();
        let mut perf = Command::new("perf");
        perf.args(["record", "--quiet", "--call-graph", "fp", "-F", &rate, "-p", &pid.to_string(), "-o"]);
        perf.arg(&samples.0).args(["--", "sleep", &seconds.to_string()]);
        let output = perf.stdin(Stdio::null()).output().map_err(no_perf)?;
        if output.status.success() && samples.0.exists() {
            return Ok(samples);
        }
        let said = String::from_utf8_lossy(&output.stderr);
        let paranoid = std::fs::read_to_string(PARANOID).unwrap_or_default();
        Err(Refusal::missing(format!(
            "perf cannot look at process {pid}: {}; expected the same user and {PARANOID} (now {}) of at most 2 \
             (`sysctl kernel.perf_event_paranoid=2`), or run as root",
            said.lines().map(str::trim).find(|line| !line.is_empty()).unwrap_or("it says nothing"),
            paranoid.trim(),
        )))
    }

    fn script(&self) -> anyhow::Result<String> {
        let mut perf = Command::new("perf");
        // Names of inlined functions take minutes to find in a program of this size.
        perf.args(["script", "--no-inline", "-F", "comm,tid,ip,sym", "-i"]).arg(&self.0);
        let output = perf.stdin(Stdio::null()).output().map_err(no_perf)?;
        anyhow::ensure!(
            output.status.success(),
            "perf cannot read what it recorded: {}",
            String::from_utf8_lossy(&output.stderr)
        );
        Ok(String::from_utf8_lossy(&output.stdout).into_owned())
    }
}

impl Drop for Samples {
    fn drop(&mut self) {
        // It may never have been made.
        std::fs::remove_file(&self.0).ok();
    }
}

fn no_perf(error: std::io::Error) -> anyhow::Error {
    Refusal::missing(format!(
        "perf cannot be started ({error}); expected Linux's perf (Debian: apt install linux-perf; Ubuntu: linux-tools-generic)"
    ))
}
