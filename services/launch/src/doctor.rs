//! `vantage doctor`: whether this machine is fit for a mission, and what to do where it is not.

use std::fmt::Write as _;
use std::path::Path;

use serde::Serialize;
use shared_types::config::Config;
use shared_types::system::{SHARED_MEMORY_DIR, System};
use splatting::gpu::{self, AdapterReport};

use crate::cli::Doctor;
use crate::exit::Exit;
use crate::machine_check::{
    DESCRIPTORS, memory_available_bytes, memory_need_bytes, raised_descriptors, shared_memory_need_bytes, space_bytes,
};
use crate::{instance, print, settings};

/// How a check came out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// Fit.
    Ok,
    /// A mission flies, but something could be better.
    Advice,
    /// A mission cannot fly.
    Problem,
}

/// One check.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What was looked at.
    pub check: &'static str,
    /// How it came out.
    pub verdict: Verdict,
    /// What was found.
    pub found: String,
    /// What to do; empty when nothing is.
    pub advice: String,
}

impl Finding {
    fn new(check: &'static str, verdict: Verdict, found: impl Into<String>, advice: impl Into<String>) -> Self {
        Self { check, verdict, found: found.into(), advice: advice.into() }
    }
}

/// `vantage doctor`. Exit 69 when a mission cannot fly here.
///
/// # Errors
/// When the configuration cannot be read.
pub fn run(arguments: &Doctor) -> anyhow::Result<Exit> {
    let config = settings::resolve(&arguments.settings)?;
    let base = System::base_dir();
    let findings: Vec<Finding> = [memory(&config), shared_memory(&config), runtime_folder(&base)]
        .into_iter()
        .chain(leftovers(&base, arguments.clean))
        .chain([ports(), real_time(), processor(), open_files()])
        .chain(gpus())
        .collect();
    let text = if arguments.json { serde_json::to_string_pretty(&findings)? + "\n" } else { describe(&findings) };
    print(&text)?;
    let unfit = findings.iter().any(|finding| finding.verdict == Verdict::Problem);
    Ok(if unfit { Exit::Missing } else { Exit::Ok })
}

fn describe(findings: &[Finding]) -> String {
    let mut text = String::new();
    for finding in findings {
        let mark = match finding.verdict {
            Verdict::Ok => "ok",
            Verdict::Advice => "advice",
            Verdict::Problem => "PROBLEM",
        };
        writeln!(text, "{mark:<8} {:<16} {}", finding.check, finding.found).ok();
        if !finding.advice.is_empty() {
            writeln!(text, "{:<25} -> {}", "", finding.advice).ok();
        }
    }
    text
}

fn memory(config: &Config) -> Finding {
    let need = memory_need_bytes(config) >> 20;
    match memory_available_bytes() {
        None => Finding::new("memory", Verdict::Advice, "the system does not say how much is available", ""),
        Some(available) if available >> 20 >= need => {
            let found = format!("{} MiB available, a mission needs {need} MiB", available >> 20);
            Finding::new("memory", Verdict::Ok, found, "")
        }
        Some(available) => {
            let found = format!("{} MiB available, a mission needs {need} MiB", available >> 20);
            let advice =
                "a smaller model.max_gaussians, or the profile of a small computer (/usr/share/vantage/profiles)";
            Finding::new("memory", Verdict::Problem, found, advice)
        }
    }
}

fn shared_memory(config: &Config) -> Finding {
    let need = shared_memory_need_bytes(config) >> 20;
    match space_bytes(Path::new(SHARED_MEMORY_DIR)) {
        Err(error) => {
            let advice = format!("mount one: mount -t tmpfs -o size=1G tmpfs {SHARED_MEMORY_DIR}");
            Finding::new("shared memory", Verdict::Problem, format!("{SHARED_MEMORY_DIR}: {error}"), advice)
        }
        Ok((size, free)) => {
            let found = format!("{} MiB free of {} MiB, a mission needs {need} MiB", free >> 20, size >> 20);
            if free >> 20 >= need {
                Finding::new("shared memory", Verdict::Ok, found, "")
            } else {
                let advice = format!(
                    "mount -o remount,size=1G {SHARED_MEMORY_DIR}, or docker --shm-size 1g, or a smaller model.max_gaussians"
                );
                Finding::new("shared memory", Verdict::Problem, found, advice)
            }
        }
    }
}

fn runtime_folder(base: &Path) -> Finding {
    let probe = base.join(format!(".doctor-{}", std::process::id()));
    let written = std::fs::create_dir_all(base)
        .and_then(|()| std::fs::write(&probe, b""))
        .and_then(|()| std::fs::remove_file(&probe));
    match written {
        Ok(()) => Finding::new("runtime folder", Verdict::Ok, base.display().to_string(), ""),
        Err(error) => Finding::new(
            "runtime folder",
            Verdict::Problem,
            format!("{}: {error}", base.display()),
            "make it writable for this user, or set XDG_RUNTIME_DIR to a folder on tmpfs",
        ),
    }
}

/// Every adapter, with what it can do and a check of a second.
fn gpus() -> Vec<Finding> {
    let adapters = gpu::adapters();
    if adapters.is_empty() {
        return vec![Finding::new("gpu", Verdict::Ok, "no adapter: the CPU trains and scores", "")];
    }
    adapters.iter().map(gpu_finding).collect()
}

fn gpu_finding(adapter: &AdapterReport) -> Finding {
    let subgroups = match adapter.subgroups {
        Some((low, high)) if low == high => format!("subgroups of {low}"),
        Some((low, high)) => format!("subgroups of {low} to {high}"),
        None => "no subgroups".to_owned(),
    };
    let has = |what: bool, name: &str| if what { name.to_owned() } else { format!("no {name}") };
    let described = format!(
        "{} ({}, {}): {subgroups}, {}, {}, binds {} MiB of {} MiB buffers, {} storage buffers, {} KiB shared",
        adapter.name,
        adapter.interface,
        adapter.driver,
        has(adapter.float_atomics, "float atomics"),
        has(adapter.timestamps, "timestamps"),
        adapter.max_binding_bytes >> 20,
        adapter.max_buffer_bytes >> 20,
        adapter.storage_buffers,
        adapter.workgroup_bytes >> 10,
    );
    match gpu::check(&adapter.name) {
        Err(error) => Finding::new("gpu", Verdict::Advice, described, format!("it does not work here: {error}")),
        Ok(check) => {
            let found = format!(
                "{described}; {:.0} iterations/s of {} Gaussians in {}x{}, images within {:.0e} of the CPU's, gradients 1 - {:.0e}",
                check.iterations_per_s,
                check.gaussians,
                check.width,
                check.height,
                check.image_error,
                1.0 - check.gradient_cosine,
            );
            if !check.is_correct() {
                let advice = "its images or gradients are wrong: update the driver, and set trainer.backend and \
                              scorer.backend to \"cpu\" until then";
                Finding::new("gpu", Verdict::Advice, found, advice)
            } else if adapter.is_software {
                Finding::new("gpu", Verdict::Ok, found + "; software, which \"auto\" leaves alone", "")
            } else {
                Finding::new("gpu", Verdict::Ok, found, "")
            }
        }
    }
}

fn leftovers(base: &Path, clean: bool) -> Vec<Finding> {
    let mut findings = Vec::new();
    for system in System::list(base) {
        if system.is_alive() {
            findings.push(Finding::new(
                "system",
                Verdict::Ok,
                format!("{} runs in {}", system.name, system.runtime_dir.display()),
                "",
            ));
            continue;
        }
        let bytes: u64 =
            system.shared_memory_files().iter().filter_map(|file| Some(std::fs::metadata(file).ok()?.len())).sum();
        let found = format!("{} is dead and holds {} MiB of shared memory", system.name, bytes >> 20);
        findings.push(if clean {
            match system.remove_if_dead() {
                Ok(true) => Finding::new("leftovers", Verdict::Ok, format!("{found}: removed"), ""),
                Ok(false) => Finding::new("system", Verdict::Ok, format!("{} was joined just now", system.name), ""),
                Err(error) => {
                    Finding::new("leftovers", Verdict::Advice, format!("{found}: {error}"), "remove it as its owner")
                }
            }
        } else {
            Finding::new("leftovers", Verdict::Advice, found, "vantage doctor --clean removes it")
        });
    }
    if findings.is_empty() {
        findings.push(Finding::new("leftovers", Verdict::Ok, "none", ""));
    }
    findings
}

fn ports() -> Finding {
    let free: Vec<String> =
        (0..instance::INSTANCES).filter(|i| instance::busy_ports(*i).is_empty()).map(|i| i.to_string()).collect();
    let busy = instance::busy_ports(0);
    let in_use = busy.iter().map(u16::to_string).collect::<Vec<_>>().join(", ");
    match (free.is_empty(), busy.is_empty()) {
        (true, _) => Finding::new(
            "ports",
            Verdict::Problem,
            "no instance has its ports 14540+i, 14580+i, 18570+i free",
            "end what uses them: ss -lupn 'sport >= 14540 and sport <= 18579'",
        ),
        (false, true) => Finding::new("ports", Verdict::Ok, "14540, 14580, 18570 are free", ""),
        (false, false) => {
            Finding::new("ports", Verdict::Ok, format!("{in_use} in use; instances {} are free", free.join(", ")), "")
        }
    }
}

fn real_time() -> Finding {
    let limit = rustix::process::getrlimit(rustix::process::Resource::Rtprio).current.unwrap_or(u64::MAX);
    if rustix::process::geteuid().is_root() || limit >= 20 {
        Finding::new("real time", Verdict::Ok, "SCHED_FIFO is permitted", "")
    } else {
        let advice = "for setpoints on time under load: `@vantage - rtprio 20` in /etc/security/limits.conf, or systemd's LimitRTPRIO=20";
        Finding::new("real time", Verdict::Advice, "SCHED_FIFO is not permitted", advice)
    }
}

fn processor() -> Finding {
    let cores = crate::evaluate::truth::cores();
    let found = format!("{cores} cores, {:?} instructions", splatting::Isa::detect());
    let fast = splatting::Isa::detect() != splatting::Isa::Portable;
    let (verdict, advice) = match (cores >= 2, fast) {
        (false, _) => (Verdict::Advice, "training and rendering share one core: use --preset quick"),
        (true, false) => (Verdict::Advice, "no AVX2: training runs several times slower"),
        (true, true) => (Verdict::Ok, ""),
    };
    Finding::new("processor", verdict, found, advice)
}

fn open_files() -> Finding {
    let limit = raised_descriptors();
    if limit >= DESCRIPTORS {
        Finding::new("open files", Verdict::Ok, format!("limit {limit}"), "")
    } else {
        Finding::new(
            "open files",
            Verdict::Problem,
            format!("limit {limit}, expected at least {DESCRIPTORS}"),
            "ulimit -n 1024",
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dead_system_is_found_and_removed_only_when_asked() {
        let base = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
        let system = System::create(base.path(), "gone", u32::MAX).expect("made");
        // Without a supervisor, as under systemd: who holds it counts.
        let (alive, hold) = System::create_held(base.path(), "here", 0).expect("made");
        let found = leftovers(base.path(), false);
        assert_eq!(found.iter().filter(|f| f.verdict == Verdict::Advice).count(), 1);
        assert!(system.runtime_dir.exists());
        leftovers(base.path(), true);
        assert!(!system.runtime_dir.exists() && alive.runtime_dir.exists());
        drop(hold);
        leftovers(base.path(), true);
        assert!(!alive.runtime_dir.exists());
    }

    #[test]
    fn a_runtime_folder_that_cannot_be_made_is_a_problem() {
        let dir = tempfile::tempdir().expect("folder");
        std::fs::write(dir.path().join("file"), "").expect("written");
        assert_eq!(runtime_folder(&dir.path().join("file/below")).verdict, Verdict::Problem);
        assert_eq!(runtime_folder(&dir.path().join("below")).verdict, Verdict::Ok);
    }

    #[test]
    fn too_little_shared_memory_is_a_problem_with_a_way_out() {
        let mut config = Config::default();
        config.model.max_gaussians = 4_000_000_000;
        let finding = shared_memory(&config);
        assert_eq!(finding.verdict, Verdict::Problem);
        assert!(describe(&[finding]).contains("remount"));
    }
}
