//! When the next image of a stream is due.

use shared_types::ns_from_s;

/// A rate on the mission clock. Instants missed are not made up for.
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    period_ns: Option<u64>,
    next_ns: u64,
}

impl Schedule {
    /// `rate_hz` times a second; at 0 (or what is no rate) never.
    #[must_use]
    pub fn new(rate_hz: f64) -> Self {
        let period_ns = (rate_hz.is_finite() && rate_hz > 0.0).then(|| ns_from_s(1.0 / rate_hz).max(1));
        Self { period_ns, next_ns: 0 }
    }

    /// Whether one is due now; if so, the next is due a period later.
    pub fn due(&mut self, now_ns: u64) -> bool {
        let Some(period_ns) = self.period_ns else { return false };
        if now_ns < self.next_ns {
            return false;
        }
        let on_time = now_ns - self.next_ns < period_ns;
        self.next_ns = if on_time { self.next_ns + period_ns } else { now_ns + period_ns };
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_that_does_not_divide_the_tick_is_kept_on_average() {
        let mut schedule = Schedule::new(30.0);
        let count = (500..600u64).filter(|tick| schedule.due(tick * 10_000_000)).count();
        assert!((29..=31).contains(&count), "{count}");
    }

    #[test]
    fn what_was_missed_is_not_made_up_for() {
        let mut schedule = Schedule::new(2.0);
        assert!(schedule.due(9_000_000_000));
        assert!(!schedule.due(9_010_000_000));
        assert!(schedule.due(20_000_000_000));
        assert!(!schedule.due(20_010_000_000));
    }

    #[test]
    fn no_rate_is_never() {
        for rate in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(!Schedule::new(rate).due(1_000_000_000), "{rate}");
        }
    }
}
