//! Which back end trains, and what is remembered of one that failed.
//!
//! A GPU that fails takes the model on it along; the newest checkpoint stands. The trainer then ends, is started again, and
//! tries the same back end once more; after that it trains on the CPU. So it is where the GPU is gone that trained before, or
//! its driver has ended the process. `model/backend.json` remembers this for a flight; `vantage resume` tries again.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};
use shared_types::config::TrainerConfig;
use shared_types::config::trainer::BackendWord;
use shared_types::folder::write_atomic;
use splatting::{Backend, BackendError, BackendKind, BackendOptions};

const FILE: &str = "backend.json";
/// A GPU that failed so often in a mission is not tried again.
const FAILURES_MAX: u32 = 2;

/// What is known of a mission's back end.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Record {
    /// The one in use: instruction set or adapter.
    pub backend: String,
    /// How often it failed in this mission.
    pub failures: u32,
    /// How it failed last; empty where it did not.
    pub last_failure: String,
    /// The flight in which it failed: mission time of its beginning.
    pub flight_ns: u64,
    /// Whether any of the model was trained on a GPU that adds up in no order, so that it does not repeat bit for bit.
    pub unordered: bool,
    /// Most that was allocated on the GPU in a round, bytes by what for; nothing on the CPU.
    pub gpu_bytes: BTreeMap<String, u64>,
}

impl Record {
    /// What a model folder remembers; nothing where it remembers nothing that can be read.
    #[must_use]
    pub fn read(model_folder: &Path) -> Self {
        let text = std::fs::read_to_string(model_folder.join(FILE)).unwrap_or_default();
        serde_json::from_str(&text).unwrap_or_default()
    }

    /// Most that was allocated on the GPU in a round, megabytes; `None` on the CPU.
    #[must_use]
    pub fn gpu_mb(&self) -> Option<f64> {
        let bytes: u64 = self.gpu_bytes.values().sum();
        (bytes > 0).then(|| (bytes as f64 / 1e5).round() / 10.0)
    }

    fn write(&self, model_folder: &Path) {
        let written = serde_json::to_vec_pretty(self)
            .map_err(|error| error.to_string())
            .and_then(|bytes| write_atomic(&model_folder.join(FILE), &bytes).map_err(|error| error.to_string()));
        if let Err(error) = written {
            tracing::warn!(error, "cannot remember the back end; training goes on");
        }
    }
}

/// Signals by which a process ends that a driver has led astray.
const DRIVER_SIGNALS: [&str; 4] = ["signal 4", "signal 7", "signal 8", "signal 11"];

/// Why there is no back end.
#[derive(Debug, thiserror::Error)]
pub enum NoBackend {
    /// What is configured was never there: the same start would fail the same way.
    #[error("trainer.backend, trainer.adapter: {0}; expected one that `vantage doctor` lists, or trainer.backend=cpu")]
    Configured(BackendError),
    /// It was there before, and is to be tried once more.
    #[error(transparent)]
    Failed(BackendError),
}

/// What is known of a mission and its last trainer, for the choice of the next one's back end.
#[derive(Debug, Clone, Copy)]
pub struct Past<'a> {
    /// Mission time at which this flight began.
    pub flight_ns: u64,
    /// How the last process of this service ended, in the supervisor's words.
    pub last_exit: Option<&'a str>,
}

/// The configured back end, or the CPU where the GPU failed twice in this flight.
///
/// # Errors
/// When it is not there, or the system refuses threads.
pub fn choose(
    config: &TrainerConfig,
    model_folder: &Path,
    threads: usize,
    past: Past<'_>,
) -> Result<Backend, NoBackend> {
    let mut record = Record::read(model_folder);
    if record.flight_ns != past.flight_ns {
        (record.failures, record.flight_ns) = (0, past.flight_ns);
    }
    let on_gpu = !record.backend.is_empty() && !record.backend.starts_with("cpu");
    if on_gpu && past.last_exit.is_some_and(|exit| DRIVER_SIGNALS.contains(&exit)) {
        let exit = past.last_exit.unwrap_or_default();
        count_failure(&mut record, format!("the process ended by {exit}, as by a driver's fault"));
    }
    let kind = match config.backend {
        BackendWord::Auto => BackendKind::Auto,
        BackendWord::Cpu => BackendKind::Cpu,
        BackendWord::Gpu => BackendKind::Gpu,
    };
    let adapter = Some(config.adapter.clone()).filter(|name| !name.is_empty());
    let wanted = BackendOptions { kind, adapter, deterministic: config.deterministic, threads };
    let chosen = if record.failures < FAILURES_MAX { Backend::new(&wanted) } else { on_cpu(&record, &wanted) };
    let (backend, why_not_gpu) = match chosen {
        Ok(chosen) => chosen,
        // Nothing was ever trained on it.
        Err(error) if record.backend.is_empty() => return Err(NoBackend::Configured(error)),
        Err(error) => {
            count_failure(&mut record, error.to_string());
            if record.failures < FAILURES_MAX {
                record.write(model_folder);
                return Err(NoBackend::Failed(error));
            }
            on_cpu(&record, &wanted).map_err(NoBackend::Failed)?
        }
    };
    match why_not_gpu {
        Some(reason) => tracing::info!(%backend, %reason, "training"),
        None => tracing::info!(%backend, "training"),
    }
    record.unordered |= matches!(backend, Backend::Gpu(_)) && !config.deterministic;
    record.backend = backend.to_string();
    record.write(model_folder);
    Ok(backend)
}

fn on_cpu(
    record: &Record,
    wanted: &BackendOptions,
) -> Result<(Backend, Option<splatting::gpu::GpuError>), BackendError> {
    let (failures, last_failure) = (record.failures, &record.last_failure);
    tracing::warn!(failures, last_failure, "the GPU failed in this flight; training on the CPU");
    Backend::new(&BackendOptions { kind: BackendKind::Cpu, adapter: None, ..wanted.clone() })
}

fn count_failure(record: &mut Record, why: String) {
    record.failures += 1;
    tracing::error!(failures = record.failures, why, "the back end failed; the newest checkpoint stands");
    record.last_failure = why;
}

/// Remembers that the back end failed.
pub(crate) fn record_failure(model_folder: &Path, error: &BackendError) {
    let mut record = Record::read(model_folder);
    count_failure(&mut record, error.to_string());
    record.write(model_folder);
}

/// Remembers, and tells, what is allocated on the GPU where it is more than before.
pub(crate) fn record_memory(model_folder: &Path, backend: &Backend) {
    let gpu_bytes: BTreeMap<String, u64> =
        backend.gpu_bytes().into_iter().map(|(what, bytes)| (what.to_owned(), bytes)).collect();
    let mut record = Record::read(model_folder);
    if gpu_bytes.values().sum::<u64>() > record.gpu_bytes.values().sum() {
        record.gpu_bytes = gpu_bytes;
        tracing::info!(gpu_mb = record.gpu_mb(), bytes = ?record.gpu_bytes, "memory on the GPU");
        record.write(model_folder);
    }
}

#[cfg(test)]
mod tests {
    use splatting::gpu::GpuError;

    use super::*;

    const FIRST: Past<'_> = Past { flight_ns: 0, last_exit: None };

    fn gone() -> TrainerConfig {
        TrainerConfig { backend: BackendWord::Gpu, adapter: "No Such GPU 9000".to_owned(), ..TrainerConfig::default() }
    }

    fn trained_on_a_gpu(folder: &Path) {
        Record { backend: "gpu No Such GPU 9000".to_owned(), ..Record::default() }.write(folder);
    }

    #[test]
    fn a_gpu_that_never_was_is_a_mistake_of_the_configuration() {
        let folder = tempfile::tempdir().unwrap();
        for _ in 0..3 {
            let error = choose(&gone(), folder.path(), 1, FIRST).unwrap_err();
            assert!(matches!(error, NoBackend::Configured(_)), "{error}");
            assert!(error.to_string().contains("No Such GPU 9000"), "{error}");
        }
        assert_eq!(Record::read(folder.path()).failures, 0);
    }

    #[test]
    fn a_gpu_that_is_gone_is_tried_once_more_and_then_the_cpu_trains() {
        let folder = tempfile::tempdir().unwrap();
        trained_on_a_gpu(folder.path());
        assert!(matches!(choose(&gone(), folder.path(), 1, FIRST), Err(NoBackend::Failed(_))));
        assert_eq!(Record::read(folder.path()).failures, 1);
        let backend = choose(&gone(), folder.path(), 1, FIRST).unwrap();
        assert!(backend.to_string().starts_with("cpu-"), "{backend}");
        assert!(Record::read(folder.path()).last_failure.contains("No Such GPU 9000"));
        // Still in this flight; the next one tries again.
        assert!(choose(&gone(), folder.path(), 1, FIRST).is_ok());
        trained_on_a_gpu(folder.path());
        assert!(choose(&gone(), folder.path(), 1, Past { flight_ns: 7, last_exit: None }).is_err());
    }

    #[test]
    fn a_gpu_that_failed_twice_is_not_tried_again() {
        let folder = tempfile::tempdir().unwrap();
        trained_on_a_gpu(folder.path());
        record_failure(folder.path(), &BackendError::Gpu(GpuError::Lost("unplugged".to_owned())));
        // The driver takes the process along.
        let crashed = Past { flight_ns: 0, last_exit: Some("signal 11") };
        let backend = choose(&gone(), folder.path(), 1, crashed).unwrap();
        assert!(backend.to_string().starts_with("cpu-"), "{backend}");
        assert_eq!(Record::read(folder.path()).failures, 2);
        // What kills a trainer on the CPU is not the driver's fault.
        choose(&gone(), folder.path(), 1, crashed).unwrap();
        assert_eq!(Record::read(folder.path()).failures, 2);
    }
}
