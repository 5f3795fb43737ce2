//! How many Gaussians memory has room for.
//!
//! Who is killed for its memory would be killed again by the same model. Where the supervisor says that the last process was
//! killed, and it was for memory, the next one keeps three quarters of what the newest checkpoint holds at most, remembers
//! that in `model/memory.json`, and says so.

use std::path::{Path, PathBuf};

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use serde::{Deserialize, Serialize};
use shared_types::folder::write_atomic;

const FILE: &str = "memory.json";
/// A smaller model shows nothing.
const LEAST: u64 = 500;

/// What is known of memory in a mission.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Record {
    /// Trainers that were killed for their memory.
    pub deaths: u32,
    /// Most Gaussians after that.
    pub most: Option<u64>,
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

/// Processes that the kernel has killed for memory: of this process's control group where it counts them, else of the whole
/// machine; 0 where nobody tells.
#[must_use]
pub fn kernel_kills() -> u64 {
    let read = |path: &Path| std::fs::read_to_string(path).ok();
    let group =
        read(Path::new("/proc/self/cgroup")).and_then(|groups| events_file(&groups)).and_then(|path| read(&path));
    group.as_deref().and_then(kills_of).or_else(|| kills_of(&read(Path::new("/proc/vmstat"))?)).unwrap_or(0)
}

/// Where the kernel counts what befell a control group, of the lines of `/proc/self/cgroup`; version 2 only.
fn events_file(groups: &str) -> Option<PathBuf> {
    let group = groups.lines().find_map(|line| line.strip_prefix("0::/"))?;
    Some(Path::new("/sys/fs/cgroup").join(group).join("memory.events"))
}

fn kills_of(counts: &str) -> Option<u64> {
    counts.lines().find_map(|line| line.strip_prefix("oom_kill ")).and_then(|count| count.trim().parse().ok())
}

/// Most Gaussians, of `most` that are configured: fewer where the last trainer died of them. `held` gives how many the newest
/// checkpoint holds.
#[must_use]
pub fn most_gaussians(
    model_folder: &Path,
    most: u32,
    last_exit: Option<&str>,
    kernel_kills: u64,
    held: impl FnOnce() -> Option<usize>,
) -> u32 {
    let mut record = Record::read(model_folder);
    // An allocation that the system refuses ends the process by SIGABRT; the kernel's own choice is SIGKILL.
    let for_memory = match last_exit {
        Some("signal 6") => true,
        Some("signal 9") => kernel_kills > record.kernel_kills,
        _ => false,
    };
    if for_memory {
        // Before the first checkpoint nobody knows how many there were.
        let held = held().map_or(u64::MAX, |count| count as u64);
        let before = record.most.unwrap_or(u64::MAX).min(held).min(u64::from(most));
        let now = (before * 3 / 4).max(LEAST.min(before));
        record.deaths += 1;
        record.most = Some(now);
        tracing::warn!(
            before,
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
        let most = |last_exit, kills, held| most_gaussians(folder.path(), 100_000, last_exit, kills, || held);
        for (last_exit, kills) in [(None, 3), (Some("signal 9"), 3), (Some("exit code 70"), 3), (Some("signal 15"), 4)]
        {
            assert_eq!(most(last_exit, kills, Some(40_000)), 100_000, "{last_exit:?}");
        }
        assert_eq!(most(Some("signal 9"), 5, Some(40_000)), 30_000, "the kernel killed somebody since");
        assert_eq!(most(Some("signal 9"), 5, Some(40_000)), 30_000, "but not again");
        assert_eq!(most(Some("signal 6"), 5, Some(30_000)), 22_500);
        assert_eq!(Record::read(folder.path()).deaths, 2);
        // However often: what shows nothing helps nobody.
        for _ in 0..40 {
            most(Some("signal 6"), 5, None);
        }
        assert_eq!(most(None, 5, None), 500);
    }

    #[test]
    fn kills_are_counted_by_the_control_group_or_by_the_machine() {
        let path = events_file("1:cpu:/a\n0::/vantage.slice/vantage-trainer.service\n");
        assert_eq!(
            path.as_deref(),
            Some(Path::new("/sys/fs/cgroup/vantage.slice/vantage-trainer.service/memory.events"))
        );
        assert_eq!(events_file("4:memory:/a\n"), None);
        assert_eq!(kills_of("low 0\noom 3\noom_kill 2\noom_group_kill 0\n"), Some(2));
        assert_eq!(kills_of("nr_free_pages 5\n"), None);
    }

    #[test]
    fn one_that_died_before_its_first_checkpoint_begins_with_less_room() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(most_gaussians(folder.path(), 100_000, Some("signal 6"), 0, || None), 75_000);
    }
}
