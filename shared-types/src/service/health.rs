//! `health`: once a second from every service; and what its supervisor is told.

use std::time::Duration;

use super::notify::Notifier;
use super::{Context, Service, ServiceError};
use crate::bus::{BusError, Publisher};
use crate::channel::HealthChannel;
use crate::messages::{Health, ServiceState};
use crate::payload::pack_text;

/// What a service says of itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HealthReport {
    /// What it is doing.
    pub state: ServiceState,
    /// What went wrong last; empty when nothing did.
    pub last_error: String,
    /// Messages received.
    pub received: u64,
    /// Messages sent.
    pub sent: u64,
    /// Messages lost or not sent; those that the bus refused are added by the loop.
    pub dropped: u64,
}

impl HealthReport {
    /// A service that works and counts nothing.
    #[must_use]
    pub fn running() -> Self {
        Self { state: ServiceState::Running, last_error: String::new(), received: 0, sent: 0, dropped: 0 }
    }
}

const PERIOD_NS: u64 = 1_000_000_000;
const LONGEST_SAMPLE: usize = 4096;

/// Publishes health, with the times of the turns of the last second.
pub(super) struct HealthSender {
    publisher: Publisher<HealthChannel>,
    last_ns: u64,
    turns: u64,
    turn_ns: Vec<u64>,
    worked: Worked,
    notifier: Notifier,
}

/// When a worker was last seen to get on.
#[derive(Debug, Default)]
struct Worked {
    work: u64,
    at_ns: u64,
}

impl Worked {
    /// For how long the job in work has made no progress.
    fn stalled_ns(&mut self, busy: bool, work: u64, wall_ns: u64) -> u64 {
        if !busy || work != self.work || self.at_ns == 0 {
            *self = Self { work, at_ns: wall_ns };
        }
        wall_ns.saturating_sub(self.at_ns)
    }
}

impl HealthSender {
    pub(super) fn open(context: &Context) -> Result<Self, ServiceError> {
        Ok(Self {
            publisher: context.bus.publisher()?,
            last_ns: 0,
            turns: 0,
            turn_ns: Vec::with_capacity(LONGEST_SAMPLE),
            worked: Worked::default(),
            notifier: Notifier::new(Duration::from_secs_f64(context.config.launch.watchdog_work_s)),
        })
    }

    /// The service has begun to leave.
    pub(super) fn leaving(&self) {
        self.notifier.stopping();
    }

    pub(super) fn count_turn(&mut self, took_ns: u64) {
        self.turns += 1;
        if self.turn_ns.len() < LONGEST_SAMPLE {
            self.turn_ns.push(took_ns);
        }
    }

    pub(super) fn turn(
        &mut self,
        context: &Context,
        service: &impl Service,
        now_ns: u64,
        wall_ns: u64,
        stopping: bool,
    ) -> Result<(), ServiceError> {
        if wall_ns.saturating_sub(self.last_ns) < PERIOD_NS {
            return Ok(());
        }
        self.last_ns = wall_ns;
        self.turn_ns.sort_unstable();
        let quantile =
            |share: usize| self.turn_ns.get(self.turn_ns.len().saturating_sub(1) * share / 100).copied().unwrap_or(0);
        let report = service.health();
        let state = if stopping { ServiceState::Stopping } else { report.state };
        let stalled_ns = self.worked.stalled_ns(service.busy(), service.work(), wall_ns);
        self.notifier.turn(state, &report.last_error, Duration::from_nanos(stalled_ns));
        let health = Health {
            incarnation: context.incarnation,
            turns: self.turns,
            turn_p50_ns: quantile(50),
            turn_p99_ns: quantile(99),
            stalled_ns,
            rss_bytes: resident_bytes(),
            received: report.received,
            sent: report.sent,
            dropped: report.dropped.saturating_add(context.bus.refused()),
            service: context.name.code(),
            pid: std::process::id(),
            state: state.code(),
            restarts: 0,
            last_error: pack_text(&report.last_error),
        };
        self.turn_ns.clear();
        match self.publisher.send(now_ns, now_ns, &health) {
            Ok(()) | Err(BusError::NoChunk { .. }) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }
}

/// Resident memory of this process; 0 where the system does not tell.
fn resident_bytes() -> u64 {
    std::fs::read_to_string("/proc/self/statm")
        .ok()
        .and_then(|text| text.split_whitespace().nth(1)?.parse::<u64>().ok())
        .map_or(0, |pages| pages * rustix::param::page_size() as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_job_without_progress_is_stalled() {
        let mut worked = Worked::default();
        assert_eq!(worked.stalled_ns(true, 0, 5), 0, "it was just seen first");
        assert_eq!(worked.stalled_ns(true, 0, 9), 4);
        assert_eq!(worked.stalled_ns(true, 1, 12), 0, "it got on");
        assert_eq!(worked.stalled_ns(false, 1, 20), 0, "nothing to do");
        assert_eq!(worked.stalled_ns(true, 1, 25), 5, "a job since the last look, at the earliest");
    }
}
