//! The loop on the machine's clock: vehicles, services that are no members, tests of latency and load.

use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};

use super::{Context, Housekeeping, Service, ServiceError, Step};
use crate::bus::wait;

const WAITING: Duration = Duration::from_millis(2);

/// The machine's monotonic clock, nanoseconds.
pub(crate) fn monotonic_ns() -> u64 {
    let time = clock_gettime(ClockId::Monotonic);
    time.tv_sec.unsigned_abs() * 1_000_000_000 + time.tv_nsec.unsigned_abs()
}

pub(super) fn run(context: &mut Context, service: &mut impl Service) -> Result<(), ServiceError> {
    let mut housekeeping = Housekeeping::new(context)?;
    let mut next_ns = monotonic_ns();
    loop {
        let started = monotonic_ns();
        let now_ns = context.wall_now_ns();
        let step = service.step(now_ns)?;
        housekeeping.health.count_turn(monotonic_ns() - started);
        if step == Step::Leave || housekeeping.turn(context, service, now_ns)? {
            return Ok(());
        }
        let period = u64::try_from(service.period().as_nanos()).unwrap_or(u64::MAX);
        let late = monotonic_ns();
        next_ns = if next_ns.saturating_add(period) > late { next_ns + period } else { late + period.min(1_000_000) };
        let timeout = if step == Step::Waiting { WAITING } else { Duration::from_nanos(next_ns.saturating_sub(late)) };
        wait(&service.listeners(), &service.fds(), timeout)?;
    }
}
