//! What the processes of a mission hold: descriptors, maps, threads, memory. A leak shows as a figure that grows from mission
//! to mission, or with the age of a process.

use std::collections::BTreeMap;
use std::fs;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::common::children_of;

/// Between two looks.
const PERIOD: Duration = Duration::from_millis(250);

/// The most that was seen of a process.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Load {
    /// Open descriptors.
    pub fds: u64,
    /// Maps of memory.
    pub maps: u64,
    /// Threads.
    pub threads: u64,
    /// Resident memory, kilobytes.
    pub rss_kb: u64,
}

impl Load {
    /// Of a process; `None` when it is gone.
    fn of(pid: u32) -> Option<Self> {
        let status = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
        let figure = |key: &str| -> Option<u64> {
            status.lines().find_map(|line| line.strip_prefix(key))?.split_whitespace().next()?.parse().ok()
        };
        Some(Self {
            fds: fs::read_dir(format!("/proc/{pid}/fd")).ok()?.count() as u64,
            maps: fs::read_to_string(format!("/proc/{pid}/maps")).ok()?.lines().count() as u64,
            threads: figure("Threads:")?,
            rss_kb: figure("VmRSS:")?,
        })
    }

    fn max(self, other: Self) -> Self {
        Self {
            fds: self.fds.max(other.fds),
            maps: self.maps.max(other.maps),
            threads: self.threads.max(other.threads),
            rss_kb: self.rss_kb.max(other.rss_kb),
        }
    }
}

/// The most of each process of a mission, by name; of `/dev/shm` too.
pub type Loads = BTreeMap<String, Load>;

/// Bytes in use in `/dev/shm`.
pub fn shared_memory_bytes() -> u64 {
    rustix::fs::statvfs("/dev/shm").map_or(0, |shm| (shm.f_blocks - shm.f_bfree) * shm.f_frsize)
}

/// A thread that looks again and again until it is asked.
pub struct Meter {
    most: Arc<Mutex<Loads>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Meter {
    /// Looks at process `launch` and its children.
    pub fn begin(launch: u32) -> Self {
        let (most, stop) = (Arc::new(Mutex::new(Loads::new())), Arc::new(AtomicBool::new(false)));
        let (notes, end) = (Arc::clone(&most), Arc::clone(&stop));
        let thread = std::thread::spawn(move || {
            while !end.load(Ordering::Relaxed) {
                let pids = children_of(launch).into_iter().chain([("launch".to_owned(), launch)]);
                let loads: Vec<(String, Load)> = pids.filter_map(|(name, pid)| Some((name, Load::of(pid)?))).collect();
                merge(&mut notes.lock().unwrap_or_else(PoisonError::into_inner), loads);
                std::thread::sleep(PERIOD);
            }
        });
        Self { most, stop, thread: Some(thread) }
    }

    /// Ends it.
    pub fn end(mut self) -> Loads {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            drop(thread.join());
        }
        core::mem::take(&mut *self.most.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// Keeps the most of both.
pub fn merge(most: &mut Loads, loads: impl IntoIterator<Item = (String, Load)>) {
    for (name, load) in loads {
        let kept = most.entry(name).or_default();
        *kept = kept.max(load);
    }
}
