//! Which messages go out how often, by simulated time.

use std::collections::BTreeMap;

/// Nanoseconds of a second.
const SECOND_NS: u64 = 1_000_000_000;
/// No message goes out more often than each tick.
const SHORTEST_NS: u64 = crate::vehicle::TICK_NS;
/// Longest interval that is kept, an hour, us: a sum with the time since boot stays in range.
const LONGEST_US: f64 = 3.6e9;

/// Rates of PX4's onboard link as measured over 45 s of the real autopilot: (message id, Hz times 100).
pub const ONBOARD: &[(u32, u32)] = &[
    (30, 10_000), // ATTITUDE
    (31, 5000),   // ATTITUDE_QUATERNION
    (33, 5000),   // GLOBAL_POSITION_INT
    (105, 5000),  // HIGHRES_IMU
    (32, 3000),   // LOCAL_POSITION_NED
    (331, 3000),  // ODOMETRY
    (141, 1000),  // ALTITUDE
    (132, 1000),  // DISTANCE_SENSOR
    (290, 1000),  // ESC_INFO
    (291, 1000),  // ESC_STATUS
    (85, 1000),   // POSITION_TARGET_LOCAL_NED
    (36, 1000),   // SERVO_OUTPUT_RAW
    (111, 1000),  // TIMESYNC
    (74, 1000),   // VFR_HUD
    (83, 1000),   // ATTITUDE_TARGET
    (24, 800),    // GPS_RAW_INT
    (245, 500),   // EXTENDED_SYS_STATE
    (1, 500),     // SYS_STATUS
    (285, 500),   // GIMBAL_DEVICE_ATTITUDE_STATUS
    (0, 100),     // HEARTBEAT
    (230, 100),   // ESTIMATOR_STATUS
    (2, 100),     // SYSTEM_TIME
    (4, 100),     // PING
    (42, 100),    // MISSION_CURRENT
    (29, 100),    // SCALED_PRESSURE
    (8, 100),     // LINK_NODE_STATUS
    (147, 50),    // BATTERY_STATUS
    (242, 50),    // HOME_POSITION
    (436, 50),    // CURRENT_MODE
    (281, 50),    // GIMBAL_MANAGER_STATUS
    (241, 50),    // VIBRATION
    (411, 33),    // CURRENT_EVENT_SEQUENCE
];

/// Rates of the ground station's link once somebody is heard on it.
pub const GROUND: &[(u32, u32)] = &[
    (30, 1500),
    (31, 1000),
    (33, 500),
    (32, 100),
    (141, 100),
    (85, 150),
    (74, 400),
    (83, 200),
    (24, 100),
    (245, 100),
    (1, 100),
    (285, 100),
    (0, 100),
    (230, 50),
    (2, 100),
    (111, 1000),
    (42, 50),
    (147, 50),
    (242, 50),
    (436, 50),
    (281, 50),
];

/// Messages that are sent only when something asks for them or sets an interval.
const ON_REQUEST: &[u32] = &[49, 148, 231, 280, 283];

#[derive(Debug, Clone, Copy)]
struct Stream {
    default_ns: u64,
    /// 0: off.
    interval_ns: u64,
    due_ns: u64,
}

/// The streams of one link.
#[derive(Debug, Clone)]
pub struct Streams {
    streams: BTreeMap<u32, Stream>,
    requested: Vec<u32>,
}

fn interval_ns(centihertz: u32) -> u64 {
    if centihertz == 0 { 0 } else { 100 * SECOND_NS / u64::from(centihertz) }
}

impl Streams {
    /// Streams with their default rates.
    #[must_use]
    pub fn new(rates: &[(u32, u32)]) -> Self {
        let known = ONBOARD.iter().map(|&(id, _)| id).chain(ON_REQUEST.iter().copied());
        let mut streams: BTreeMap<u32, Stream> =
            known.map(|id| (id, Stream { default_ns: 0, interval_ns: 0, due_ns: 0 })).collect();
        for &(id, centihertz) in rates {
            let ns = interval_ns(centihertz);
            streams.insert(id, Stream { default_ns: ns, interval_ns: ns, due_ns: ns });
        }
        Self { streams, requested: Vec::new() }
    }

    /// Sets an interval as SET_MESSAGE_INTERVAL: microseconds, 0 the default, negative off. False for a message that is
    /// not sent.
    pub fn set_interval(&mut self, id: u32, interval_us: f64, now_ns: u64) -> bool {
        let Some(stream) = self.streams.get_mut(&id) else { return false };
        stream.interval_ns = if interval_us < 0.0 || interval_us.is_nan() {
            0
        } else if interval_us == 0.0 {
            stream.default_ns
        } else {
            ((interval_us.min(LONGEST_US) * 1e3) as u64).max(SHORTEST_NS)
        };
        stream.due_ns = now_ns + stream.interval_ns;
        true
    }

    /// Interval of a message, microseconds; -1 off, `None` for a message that is not sent.
    #[must_use]
    pub fn interval_us(&self, id: u32) -> Option<i32> {
        let stream = self.streams.get(&id)?;
        Some(if stream.interval_ns == 0 { -1 } else { i32::try_from(stream.interval_ns / 1000).unwrap_or(i32::MAX) })
    }

    /// Asks for one message with the next batch. False for a message that is not sent.
    pub fn request(&mut self, id: u32) -> bool {
        let known = self.streams.contains_key(&id);
        if known && !self.requested.contains(&id) {
            self.requested.push(id);
        }
        known
    }

    /// What was asked for since the last call.
    pub fn take_requested(&mut self) -> Vec<u32> {
        core::mem::take(&mut self.requested)
    }

    /// The messages that are due, in the order of their ids.
    pub fn due(&mut self, now_ns: u64) -> Vec<u32> {
        let mut due = Vec::new();
        for (&id, stream) in &mut self.streams {
            if stream.interval_ns == 0 || now_ns < stream.due_ns {
                continue;
            }
            due.push(id);
            // The next one is due an interval after this one was, so that the mean rate is exact.
            stream.due_ns += stream.interval_ns;
            if stream.due_ns <= now_ns {
                stream.due_ns = now_ns + stream.interval_ns;
            }
        }
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn count(streams: &mut Streams, from_ns: u64, seconds: u64) -> BTreeMap<u32, u64> {
        let mut counts = BTreeMap::new();
        let ticks = seconds * SECOND_NS / SHORTEST_NS;
        for tick in 1..=ticks {
            for id in streams.due(from_ns + tick * SHORTEST_NS) {
                *counts.entry(id).or_insert(0) += 1;
            }
        }
        counts
    }

    #[test]
    fn rates_over_45_seconds_are_those_of_the_real_autopilot() {
        let counts = count(&mut Streams::new(ONBOARD), 0, 45);
        for &(id, centihertz) in ONBOARD {
            let expected = 45.0 * f64::from(centihertz) / 100.0;
            let sent = counts.get(&id).copied().unwrap_or(0) as f64;
            assert!((sent - expected).abs() <= 1.0, "message {id}: {sent} of {expected}");
        }
    }

    #[test]
    fn intervals_are_set_reset_and_switched_off() {
        let mut streams = Streams::new(ONBOARD);
        assert!(streams.set_interval(32, 10_000.0, 0));
        assert_eq!(streams.interval_us(32), Some(10_000));
        assert_eq!(count(&mut streams, 0, 10).get(&32), Some(&1000));
        assert!(streams.set_interval(32, -1.0, 10 * SECOND_NS));
        assert_eq!(count(&mut streams, 10 * SECOND_NS, 10).get(&32), None);
        assert!(streams.set_interval(32, 0.0, 20 * SECOND_NS));
        assert_eq!(count(&mut streams, 20 * SECOND_NS, 10).get(&32), Some(&300));
        for never in [1e30, f64::INFINITY] {
            assert!(streams.set_interval(32, never, 30 * SECOND_NS));
            assert_eq!(count(&mut streams, 30 * SECOND_NS, 10).get(&32), None);
            assert_eq!(streams.interval_us(32), Some(i32::MAX));
        }
        assert!(!streams.set_interval(12_345, 1e6, 0));
        assert!(streams.request(148) && !streams.request(12_345));
        assert_eq!(streams.take_requested(), [148]);
    }
}
