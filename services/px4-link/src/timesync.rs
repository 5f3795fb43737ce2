//! The autopilot's clock against the mission's.
//!
//! On the wall's clock: TIMESYNC round trips. Of the last 10 s the trip with the least time decides, since delay is only
//! ever added; trips above 10 ms are dropped; the drift is fitted over the deciders of the last two minutes. In lockstep
//! both clocks are simulated time and differ by a constant, which the newest message of a tick shows exactly.

use std::collections::VecDeque;

const WINDOW_NS: u64 = 10_000_000_000;
const WORST_TRIP_NS: u64 = 10_000_000;
const DRIFT_POINTS: usize = 12;
/// Crystals differ by less than this; a fit beyond it is noise.
const WORST_DRIFT: f64 = 200e-6;
/// Without any round trip: what one-way delay may be.
const UNSYNCED_UNCERTAINTY_NS: u64 = 10_000_000;

#[derive(Debug, Clone, Copy)]
struct Trip {
    /// Mission time at the middle of the trip.
    at_ns: u64,
    /// Mission minus autopilot, nanoseconds.
    offset_ns: i128,
    trip_ns: u64,
}

/// Maps stamps of the autopilot to mission time.
#[derive(Debug, Clone)]
pub struct TimeSync {
    lockstep: bool,
    trips: VecDeque<Trip>,
    deciders: VecDeque<Trip>,
    drift: f64,
    /// The least (mission now - autopilot's stamp) of any message: an upper bound of the offset.
    least_lag_ns: Option<i128>,
    dropped: u64,
}

impl TimeSync {
    /// `lockstep`: both clocks are simulated time.
    #[must_use]
    pub fn new(lockstep: bool) -> Self {
        Self { lockstep, trips: VecDeque::new(), deciders: VecDeque::new(), drift: 0.0, least_lag_ns: None, dropped: 0 }
    }

    /// Takes the stamp of a message that arrived now.
    pub fn heard(&mut self, now_ns: u64, autopilot_ns: u64) {
        let lag = i128::from(now_ns) - i128::from(autopilot_ns);
        self.least_lag_ns = Some(self.least_lag_ns.map_or(lag, |least| least.min(lag)));
    }

    /// Takes the answer to a TIMESYNC request: what we sent (mission time then) and what the autopilot's clock said.
    pub fn answer(&mut self, now_ns: u64, sent_ns: u64, autopilot_ns: u64) {
        let Some(trip_ns) = now_ns.checked_sub(sent_ns) else { return };
        self.heard(now_ns, autopilot_ns);
        if trip_ns > WORST_TRIP_NS {
            self.dropped += 1;
            return;
        }
        let at_ns = sent_ns + trip_ns / 2;
        let trip = Trip { at_ns, offset_ns: i128::from(at_ns) - i128::from(autopilot_ns), trip_ns };
        self.trips.push_back(trip);
        while self.trips.front().is_some_and(|old| old.at_ns + WINDOW_NS < at_ns) {
            self.trips.pop_front();
        }
        if let Some(best) = self.best() {
            self.keep_decider(best);
        }
    }

    fn best(&self) -> Option<Trip> {
        self.trips.iter().copied().min_by_key(|trip| (trip.trip_ns, u64::MAX - trip.at_ns))
    }

    fn keep_decider(&mut self, best: Trip) {
        match self.deciders.back_mut() {
            Some(last) if best.at_ns < last.at_ns + WINDOW_NS => {
                if best.trip_ns < last.trip_ns {
                    *last = best;
                }
            }
            _ => {
                self.deciders.push_back(best);
                if self.deciders.len() > DRIFT_POINTS {
                    self.deciders.pop_front();
                }
            }
        }
        self.drift = self.fitted_drift();
    }

    /// Slope of the offset over mission time by least squares; 0 below three points.
    #[expect(clippy::cast_precision_loss, reason = "differences over two minutes fit 53 bits")]
    fn fitted_drift(&self) -> f64 {
        let (Some(first), true) = (self.deciders.front().copied(), self.deciders.len() >= 3) else { return 0.0 };
        let points: Vec<(f64, f64)> = self
            .deciders
            .iter()
            .map(|trip| ((trip.at_ns - first.at_ns) as f64, (trip.offset_ns - first.offset_ns) as f64))
            .collect();
        let n = points.len() as f64;
        let mean = points.iter().fold((0.0, 0.0), |sum, p| (sum.0 + p.0 / n, sum.1 + p.1 / n));
        let (mut over, mut under) = (0.0, 0.0);
        for (t, offset) in points {
            over += (t - mean.0) * (offset - mean.1);
            under += (t - mean.0) * (t - mean.0);
        }
        if under > 0.0 { (over / under).clamp(-WORST_DRIFT, WORST_DRIFT) } else { 0.0 }
    }

    /// Mission time of a stamp of the autopilot that was heard at `now_ns`; never later than that.
    #[must_use]
    pub fn mission_ns(&self, now_ns: u64, autopilot_ns: u64) -> u64 {
        let offset_ns = match (self.lockstep, self.best(), self.least_lag_ns) {
            (false, Some(best), _) => best.offset_ns + self.drift_since(best, now_ns),
            (_, _, Some(lag)) => lag,
            _ => return now_ns,
        };
        u64::try_from((i128::from(autopilot_ns) + offset_ns).max(0)).unwrap_or(now_ns).min(now_ns)
    }

    #[expect(clippy::cast_precision_loss, clippy::cast_possible_truncation, reason = "a drift of microseconds")]
    fn drift_since(&self, best: Trip, now_ns: u64) -> i128 {
        (self.drift * now_ns.saturating_sub(best.at_ns) as f64) as i128
    }

    /// One standard deviation of a mapped stamp, nanoseconds: the asymmetry of the deciding trip (uniform within half of
    /// it) and what its age may have drifted.
    #[must_use]
    #[expect(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "small")]
    pub fn uncertainty_ns(&self, now_ns: u64) -> u64 {
        match (self.lockstep, self.best()) {
            (true, _) => 0,
            (false, None) => UNSYNCED_UNCERTAINTY_NS,
            (false, Some(best)) => {
                let age_ns = now_ns.saturating_sub(best.at_ns) as f64;
                let unfitted = if self.deciders.len() >= 3 { 5e-6 } else { 50e-6 };
                (best.trip_ns as f64 / 2.0 / 3f64.sqrt()).hypot(age_ns * unfitted) as u64
            }
        }
    }

    /// Round trips dropped because they took too long.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Forgets everything: another autopilot, or it was started again.
    pub fn reset(&mut self) {
        *self = Self::new(self.lockstep);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn stamps_are_right_within_what_is_claimed(
            offset_ms in -5_000i64..50_000, ppm in -60.0..60.0f64,
            delays in proptest::collection::vec((20_000u64..3_000_000, 20_000u64..3_000_000), 160..200),
        ) {
            let mut sync = TimeSync::new(false);
            let start = 100_000_000_000u64;
            let autopilot = |mission: u64| {
                (mission as f64 - start as f64).mul_add(1.0 + ppm * 1e-6, (start as i64 - offset_ms * 1_000_000) as f64) as u64
            };
            let mut now = start;
            for (out, back) in delays {
                now += 500_000_000;
                sync.answer(now + out + back, now, autopilot(now + out));
            }
            let stamp = now + 3_000_000;
            let mapped = sync.mission_ns(now + 4_000_000, autopilot(stamp));
            let error = mapped.abs_diff(stamp);
            prop_assert!(error as f64 <= 4.0 * sync.uncertainty_ns(now) as f64 + 400_000.0, "error {error} ns");
            prop_assert!(error < 2_000_000);
        }
    }

    #[test]
    fn slow_trips_are_dropped_and_the_fastest_decides() {
        let mut sync = TimeSync::new(false);
        sync.answer(1_020_000_000, 1_000_000_000, 500_000_000);
        assert_eq!((sync.dropped(), sync.uncertainty_ns(1_020_000_000)), (1, UNSYNCED_UNCERTAINTY_NS));
        sync.answer(2_004_000_000, 2_000_000_000, 1_001_500_000);
        sync.answer(2_100_200_000, 2_100_000_000, 1_100_100_000);
        assert_eq!(sync.mission_ns(2_200_000_000, 1_150_000_000), 2_150_000_000);
        assert!(sync.uncertainty_ns(2_100_200_000) < 100_000);
    }

    #[test]
    fn in_lockstep_the_newest_stamp_is_now() {
        let mut sync = TimeSync::new(true);
        sync.heard(30_000_000, 7_010_000_000);
        sync.heard(40_000_000, 7_030_000_000);
        sync.heard(50_000_000, 7_020_000_000);
        assert_eq!((sync.mission_ns(60_000_000, 7_030_000_000), sync.uncertainty_ns(1)), (40_000_000, 0));
    }
}
