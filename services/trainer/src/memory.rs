//! How many Gaussians memory has room for.
//!
//! Who is killed for its memory would be killed again by the same model. The trainer remembers in `model/memory.json` how
//! large the model was when it last grew; where its supervisor says that the last process was killed, and it was for memory,
//! the next one keeps three quarters of that at most, and says so.

use std::path::Path;

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use serde::{Deserialize, Serialize};
use shared_types::folder::write_atomic;

const FILE: &str = "memory.json";
/// A smaller model shows nothing.
const LEAST: u64 = 500;

/// How the last process of this service ended, in the supervisor's words: `exit code 70`, `signal 9`.
pub const LAST_EXIT: &str = "VANTAGE_LAST_EXIT";

/// What is known of memory in a mission.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Record {
    /// Trainers that were killed for their memory.
    pub deaths: u32,
    /// Most Gaussians after that.
    pub most: Option<u64>,
    /// Gaussians when the model last grew.
    pub gaussians: u64,
    /// The kernel's count of processes that it killed for memory, when this trainer began.
    pub kernel_kills: u64,
}

impl Record {
    /// What a model folder remembers; nothing where it remembers nothing that can be read.
    #[must_use]
    pub fn read(model_folder: &Path) -> Self {
        let text = std::fs::read_to_string(model_folder.join(FILE)).unwrap_or_default();
        serde_json::from_str(&text).unwrap_or_default()
    }

    fn write(&self, model_folder: &Path) {
        let written = serde_json::to_vec_pretty(self)
            .map_err(|error| error.to_string())
            .and_then(|bytes| write_atomic(&model_folder.join(FILE), &bytes).map_err(|error| error.to_string()));
        if let Err(error) = written {
            tracing::warn!(error, "cannot remember how large the model is; training goes on");
        }
    }
}

/// Processes that the kernel has killed for memory since it was started; 0 where it does not tell.
#[must_use]
pub fn kernel_kills() -> u64 {
    let text = std::fs::read_to_string("/proc/vmstat").unwrap_or_default();
    text.lines()
        .find_map(|line| line.strip_prefix("oom_kill "))
        .and_then(|count| count.trim().parse().ok())
        .unwrap_or(0)
}

/// Most Gaussians, of `most` that are configured: fewer where the last trainer died of them.
#[must_use]
pub fn most_gaussians(model_folder: &Path, most: u32, last_exit: Option<&str>, kernel_kills: u64) -> u32 {
    let mut record = Record::read(model_folder);
    // An allocation that the system refuses ends the process by SIGABRT; the kernel's own choice is SIGKILL.
    let for_memory = match last_exit {
        Some("signal 6") => true,
        Some("signal 9") => kernel_kills > record.kernel_kills,
        _ => false,
    };
    if for_memory && record.gaussians > 0 {
        let before = record.most.unwrap_or(u64::MAX).min(record.gaussians).min(u64::from(most));
        let now = (before * 3 / 4).max(LEAST.min(before));
        record.deaths += 1;
        record.most = Some(now);
        tracing::warn!(
            gaussians = record.gaussians,
            most = now,
            "the last trainer was killed for its memory: the model is held smaller; trainer.memory_mb or model.max_gaussians say more"
        );
    }
    if record.kernel_kills != kernel_kills || for_memory {
        record.kernel_kills = kernel_kills;
        record.write(model_folder);
    }
    record.most.map_or(most, |limit| u32::try_from(limit).unwrap_or(most).min(most))
}

/// Remembers that the model is to grow.
pub(crate) fn note(model_folder: &Path, gaussians: usize) {
    let mut record = Record::read(model_folder);
    if record.gaussians != gaussians as u64 {
        record.gaussians = gaussians as u64;
        record.write(model_folder);
    }
}

/// Lets this process have so many megabytes of its own (shared memory does not count); 0 lets it have what there is.
pub fn limit(memory_mb: u32) {
    if memory_mb == 0 {
        return;
    }
    let bytes = u64::from(memory_mb) << 20;
    let limit = Rlimit { current: Some(bytes), maximum: getrlimit(Resource::Data).maximum };
    if let Err(error) = setrlimit(Resource::Data, limit) {
        tracing::warn!(memory_mb, %error, "the system does not take the limit");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_trainer_killed_for_memory_holds_the_model_smaller_and_one_killed_otherwise_does_not() {
        let folder = tempfile::tempdir().unwrap();
        let most = |last_exit, kills| most_gaussians(folder.path(), 100_000, last_exit, kills);
        assert_eq!(most(Some("signal 6"), 3), 100_000, "nothing was trained yet");
        note(folder.path(), 40_000);
        for (last_exit, kills) in [(None, 3), (Some("signal 9"), 3), (Some("exit code 70"), 3), (Some("signal 15"), 4)]
        {
            assert_eq!(most(last_exit, kills), 100_000, "{last_exit:?}");
        }
        assert_eq!(most(Some("signal 9"), 5), 30_000, "the kernel killed somebody since");
        assert_eq!(most(Some("signal 9"), 5), 30_000, "but not again");
        note(folder.path(), 30_000);
        assert_eq!(most(Some("signal 6"), 5), 22_500);
        assert_eq!(Record::read(folder.path()).deaths, 2);
        // However often: what shows nothing helps nobody.
        for _ in 0..40 {
            most(Some("signal 6"), 5);
        }
        assert_eq!(most(None, 5), 500);
    }
}
