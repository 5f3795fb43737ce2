//! Which back end trains, and what is remembered of one that failed.
//!
//! A GPU that fails takes the model on it along; the newest checkpoint stands. The trainer then ends, is started again, and
//! tries the same back end once more; after that it trains on the CPU. `model/backend.json` remembers this.

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

/// The configured back end, or the CPU where the GPU failed twice in this mission.
///
/// # Errors
/// When it is not there, or the system refuses threads.
pub fn choose(config: &TrainerConfig, model_folder: &Path, threads: usize) -> Result<Backend, BackendError> {
    let mut record = Record::read(model_folder);
    let kind = match config.backend {
        _ if record.failures >= FAILURES_MAX => {
            tracing::warn!(
                failures = record.failures,
                last_failure = record.last_failure,
                "the GPU failed before in this mission; training on the CPU"
            );
            BackendKind::Cpu
        }
        BackendWord::Auto => BackendKind::Auto,
        BackendWord::Cpu => BackendKind::Cpu,
        BackendWord::Gpu => BackendKind::Gpu,
    };
    let adapter = Some(config.adapter.clone()).filter(|name| !name.is_empty());
    let wanted = BackendOptions { kind, adapter, deterministic: config.deterministic, threads };
    let (backend, why_not_gpu) = Backend::new(&wanted)?;
    match why_not_gpu {
        Some(reason) => tracing::info!(%backend, %reason, "training"),
        None => tracing::info!(%backend, "training"),
    }
    record.backend = backend.to_string();
    record.write(model_folder);
    Ok(backend)
}

/// Remembers that the back end failed.
pub(crate) fn record_failure(model_folder: &Path, error: &BackendError) {
    let mut record = Record::read(model_folder);
    record.failures += 1;
    record.last_failure = error.to_string();
    tracing::error!(failures = record.failures, %error, "the back end failed; the newest checkpoint stands");
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

    #[test]
    fn a_gpu_that_failed_twice_is_not_tried_again() {
        let folder = tempfile::tempdir().unwrap();
        let config = TrainerConfig {
            backend: BackendWord::Gpu,
            adapter: "No Such GPU 9000".to_owned(),
            ..TrainerConfig::default()
        };
        for failures in 1..=2 {
            assert!(choose(&config, folder.path(), 1).is_err(), "tried, and not there");
            record_failure(folder.path(), &BackendError::Gpu(GpuError::Lost("unplugged".to_owned())));
            assert_eq!(Record::read(folder.path()).failures, failures);
        }
        let backend = choose(&config, folder.path(), 1).unwrap();
        assert!(backend.to_string().starts_with("cpu-"), "{backend}");
        let record = Record::read(folder.path());
        assert!(record.last_failure.contains("unplugged") && record.backend == backend.to_string());
    }
}
