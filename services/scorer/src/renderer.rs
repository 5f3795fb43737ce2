//! What renders candidates, and goes on when a GPU fails: once more on the same, then on the CPU.
//!
//! A score depends on the snapshot and the request alone, so nothing is lost with a GPU but time.

use std::sync::atomic::{AtomicBool, AtomicU64};

use shared_types::config::ScorerConfig;
use shared_types::config::trainer::BackendWord;
use splatting::{Backend, BackendError, BackendKind, BackendOptions, Gaussians};

use crate::job::{Job, Scores};

/// A back end, and how to make another.
#[derive(Debug)]
pub struct Renderer {
    backend: Backend,
    wanted: BackendOptions,
    failures: u32,
}

impl Renderer {
    /// The configured back end. `restarted`: there was a scorer before this one, so that a GPU which is not there is gone, and
    /// no mistake of the configuration: then the CPU scores.
    ///
    /// # Errors
    /// When it is not there, or the system refuses threads.
    pub fn new(config: &ScorerConfig, threads: usize, restarted: bool) -> Result<Self, BackendError> {
        let kind = match config.backend {
            BackendWord::Auto => BackendKind::Auto,
            BackendWord::Cpu => BackendKind::Cpu,
            BackendWord::Gpu => BackendKind::Gpu,
        };
        let adapter = Some(config.adapter.clone()).filter(|name| !name.is_empty());
        // Rendering adds nothing up out of order.
        let wanted = BackendOptions { kind, adapter, deterministic: false, threads };
        let (backend, why_not_gpu) = match Backend::new(&wanted) {
            Err(error) if restarted => {
                tracing::warn!(%error, "the GPU is gone; the CPU scores");
                Backend::new(&BackendOptions { kind: BackendKind::Cpu, adapter: None, ..wanted.clone() })?
            }
            chosen => chosen?,
        };
        match why_not_gpu {
            Some(reason) => tracing::info!(%backend, %reason, "scoring"),
            None => tracing::info!(%backend, "scoring"),
        }
        Ok(Self { backend, wanted, failures: 0 })
    }

    /// What renders now.
    pub fn backend(&mut self) -> &mut Backend {
        &mut self.backend
    }

    /// Scores a job. `None` when cancelled, or when not even the CPU is left.
    pub fn score(&mut self, job: &Job, model: &Gaussians, cancel: &AtomicBool, done: &AtomicU64) -> Option<Scores> {
        loop {
            match job.run(&mut self.backend, model, cancel, done) {
                Ok(scores) => return scores,
                Err(error) => {
                    self.failures += 1;
                    tracing::error!(%error, failures = self.failures, backend = %self.backend, "scoring failed; again");
                }
            }
            if let Err(error) = self.replace() {
                tracing::error!(%error, "no back end is left");
                return None;
            }
        }
    }

    /// The same back end once more, then the CPU.
    fn replace(&mut self) -> Result<(), BackendError> {
        let fresh = if self.failures < 2 { Backend::new(&self.wanted).ok() } else { None };
        let (backend, _) = match fresh {
            Some(fresh) => fresh,
            None => Backend::new(&BackendOptions { kind: BackendKind::Cpu, adapter: None, ..self.wanted.clone() })?,
        };
        tracing::warn!(%backend, "scoring goes on");
        self.backend = backend;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gpu_that_is_not_there_is_a_mistake_at_first_and_gone_later() {
        let config = ScorerConfig {
            backend: BackendWord::Gpu,
            adapter: "No Such GPU 9000".to_owned(),
            ..ScorerConfig::default()
        };
        assert!(Renderer::new(&config, 1, false).unwrap_err().to_string().contains("No Such GPU 9000"));
        let mut renderer = Renderer::new(&config, 1, true).unwrap();
        assert!(renderer.backend().to_string().starts_with("cpu-"));
    }
}
