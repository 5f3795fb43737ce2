//! A GPU whose memory is full. Software allocates from the process, so a process with little left is such a GPU.

use std::process::Command;

use super::training::{settings, task};
use super::{options, skipped};
use crate::gpu::GpuError;
use crate::{
    Backend, BackendError, BackendKind, BackendOptions, Engine, Gaussian, Gaussians, Optimiser, ScreenStatistics,
    Training,
};

/// What tells the process that it is the one with little memory, and by the name of which adapter.
const LITTLE: &str = "VANTAGE_TEST_LITTLE_MEMORY";

/// Runs this test again in a process of its own, which takes its memory away.
#[test]
fn a_full_memory_is_an_error_and_training_goes_on_without_the_gpu() {
    let test = "a_full_memory_is_an_error_and_training_goes_on_without_the_gpu";
    if let Ok(adapter) = std::env::var(LITTLE) {
        return run_out_of_memory(adapter);
    }
    let Some(adapter) = options().and_then(|options| options.adapter) else { return skipped(test) };
    let is_software = crate::gpu::adapters().iter().any(|found| found.name == adapter && found.is_software);
    if !is_software || Command::new("prlimit").arg("--version").output().is_err() {
        println!("{test}: skipped, only memory of software can be taken away, by prlimit");
        return;
    }
    let name = format!("{}::{test}", module_path!().split_once("::").unwrap().1);
    let mut child = Command::new(std::env::current_exe().unwrap());
    let output = child.args(["--exact", &name, "--nocapture"]).env(LITTLE, adapter).output().unwrap();
    let said = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success() && said.contains("1 passed"), "{said}");
}

/// Bytes of address space that this process has.
fn address_space() -> u64 {
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap();
    4096 * statm.split(' ').next().unwrap().parse::<u64>().unwrap()
}

fn limit(bytes: &str) {
    let pid = std::process::id().to_string();
    let limited = Command::new("prlimit").args(["--pid", &pid, &format!("--as={bytes}:unlimited")]).status();
    assert!(limited.unwrap().success());
}

/// As a mission does it: the back end by its options, a model under training, an error from a step; and then the CPU.
fn run_out_of_memory(adapter: String) {
    let (start, views) = task(300, (32, 24), 0);
    let mut many = Gaussians::with_sh_degree(3);
    for id in 0..300_000 {
        many.push(&Gaussian { id, ..start.get(id as usize % start.len()) });
    }
    let wanted = BackendOptions { kind: BackendKind::Gpu, adapter: Some(adapter), ..BackendOptions::default() };
    let mut training = Training::new(Backend::new(&wanted).unwrap().0);
    training.restore(start.clone(), Optimiser::new());
    training.step(&views[0], &settings()).unwrap();
    training.sync().unwrap();
    // What the host needs is there before.
    let (mut optimiser, mut statistics) = (Optimiser::new(), ScreenStatistics::new());
    optimiser.fit(&many);
    statistics.fit(&many);
    training.restore_observed(many.clone(), optimiser, statistics);
    limit(&(address_space() + (48 << 20)).to_string());
    let failed = (0..3).find_map(|_| training.step(&views[0], &settings()).err());
    limit("unlimited");
    match failed {
        Some(BackendError::Gpu(GpuError::OutOfMemory(reason))) => println!("out of memory: {reason}"),
        other => panic!("{other:?}"),
    }
    assert!(training.step(&views[0], &settings()).is_err(), "its engine is not used again");
    assert!(*training.model() == many, "what is here is as it was");
    let (model, optimiser, _) = training.into_parts();
    let mut training = Training::new(Engine::new(1).unwrap());
    training.restore(model, optimiser);
    training.step(&views[0], &settings()).unwrap();
    assert!(training.finished().unwrap()[0].total.is_finite());
}
