//! What `/proc` says of a process: state, memory, start.

use std::fs;

/// Proportional set size of a process, bytes: private memory plus its share of what it shares. `None` when the process is
/// gone or may not be looked at.
#[must_use]
pub fn pss_bytes(pid: u32) -> Option<u64> {
    pss_of(&fs::read_to_string(format!("/proc/{pid}/smaps_rollup")).ok()?)
}

fn pss_of(rollup: &str) -> Option<u64> {
    bytes_of(rollup, "Pss:")
}

fn bytes_of(rollup: &str, key: &str) -> Option<u64> {
    let line = rollup.lines().find_map(|line| line.strip_prefix(key))?;
    Some(line.split_whitespace().next()?.parse::<u64>().ok()? * 1024)
}

/// Proportional memory of a process by kind, bytes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Memory {
    /// Its own: heap and stacks.
    pub anonymous: u64,
    /// Its program and mapped files.
    pub file: u64,
    /// Its share of shared memory: the channels.
    pub shared: u64,
}

/// The memory of a process by kind; `None` when it is gone or may not be looked at.
#[must_use]
pub fn memory(pid: u32) -> Option<Memory> {
    memory_of(&fs::read_to_string(format!("/proc/{pid}/smaps_rollup")).ok()?)
}

fn memory_of(rollup: &str) -> Option<Memory> {
    Some(Memory {
        anonymous: bytes_of(rollup, "Pss_Anon:")?,
        file: bytes_of(rollup, "Pss_File:")?,
        shared: bytes_of(rollup, "Pss_Shmem:")?,
    })
}

/// Whether a process runs (a zombie does not).
#[must_use]
pub fn is_alive(pid: u32) -> bool {
    fs::read_to_string(format!("/proc/{pid}/stat"))
        .ok()
        .and_then(|stat| state_of(&stat))
        .is_some_and(|state| state != 'Z')
}

/// State letter of a stat line; the process's name in it may hold anything, so the last ')' counts.
fn state_of(stat: &str) -> Option<char> {
    stat.rsplit_once(") ")?.1.chars().next()
}

/// The process that traces a process, such as a debugger; `None` where there is none.
#[must_use]
pub fn tracer(pid: u32) -> Option<u32> {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("TracerPid:"))?;
    line.trim().parse().ok().filter(|tracer| *tracer != 0)
}

/// Seconds since a process started; `None` when it is gone.
#[must_use]
pub fn age_s(pid: u32) -> Option<f64> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    let uptime: f64 = fs::read_to_string("/proc/uptime").ok()?.split_whitespace().next()?.parse().ok()?;
    let ticks = start_ticks_of(&stat)?;
    let per_second = rustix::param::clock_ticks_per_second();
    #[expect(clippy::cast_precision_loss, reason = "clock ticks since boot are far below 2^53")]
    let started_s = ticks as f64 / per_second as f64;
    Some((uptime - started_s).max(0.0))
}

/// Field 22 of a stat line: the start, clock ticks after boot.
fn start_ticks_of(stat: &str) -> Option<u64> {
    // What follows the name begins with field 3.
    stat.rsplit_once(") ")?.1.split_whitespace().nth(22 - 3)?.parse().ok()
}

/// The nice value of a process; `None` when it is gone.
#[must_use]
pub fn nice(pid: u32) -> Option<i32> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    stat.rsplit_once(") ")?.1.split_whitespace().nth(19 - 3)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stat_line_is_read_past_a_name_with_brackets() {
        let stat = "77 (a ) b) S 1 77 77 0 -1 4194560 100 0 0 0 5 3 0 0 20 7 4 0 123456 1000 200";
        assert_eq!((state_of(stat), start_ticks_of(stat)), (Some('S'), Some(123_456)));
    }

    #[test]
    fn this_process_is_alive_has_memory_and_a_start() {
        let pid = std::process::id();
        assert!(is_alive(pid));
        assert!(pss_bytes(pid).is_some_and(|bytes| bytes > 100_000));
        assert!(age_s(pid).is_some_and(|age| age < 3600.0));
        assert!(nice(pid).is_some());
        assert_eq!(tracer(pid), None);
        let rollup = "Pss: 9 kB\nPss_Dirty: 1 kB\nPss_Anon: 2 kB\nPss_File: 3 kB\nPss_Shmem: 4 kB\n";
        assert_eq!(memory_of(rollup), Some(Memory { anonymous: 2048, file: 3072, shared: 4096 }));
        assert!(memory(pid).is_some_and(|memory| memory.anonymous > 10_000));
        assert_eq!(pss_of("00400000-7ffd rollup\nRss:  900 kB\nPss:  123 kB\n"), Some(123 * 1024));
    }

    #[test]
    fn a_process_that_never_was_is_not_alive() {
        assert!(!is_alive(u32::MAX) && age_s(u32::MAX).is_none() && pss_bytes(u32::MAX).is_none());
    }
}
