//! What decides every setpoint: the generator, the leash, the planner's sign of life, and the check for stalls.
//!
//! The streamer knows no MAVLink and no IPC. It takes [`Order`]s and a time, and says what to send. In lockstep it is stepped
//! in line; on the wall's clock it runs on a thread of its own and gets its orders through a bounded queue.

use glam::DVec3;
use shared_types::messages::TargetStatus;

use crate::path::{Limits, Point};
use crate::setpoint::{Generator, PERIOD_S, Plan, Setpoint, leashed, share_of_speed};

/// Time between setpoints, nanoseconds.
const PERIOD_NS: u64 = 50_000_000;
/// Telemetry older than this: the setpoint stays where it is.
const QUIET_NS: u64 = 500_000_000;
/// Telemetry older than this: nothing is sent. Just below the autopilot's own limit for setpoints (COM_OF_LOSS_T), so that
/// a link that comes back after a failsafe does not find a stream that flies it on, from where it no longer is.
const DEAF_NS: u64 = 900_000_000;
/// A gap beyond this is a restart: the autopilot may have taken over.
const STALL_NS: u64 = 500_000_000;
/// Upper borders of the histogram of gaps, milliseconds; the last class has none.
pub const GAP_BORDERS_MS: [u64; 5] = [55, 75, 100, 200, 500];

/// What the streamer is told.
#[derive(Debug, Clone)]
pub enum Order {
    /// Where the vehicle is, in the world, and the world's offset from the autopilot's local frame (as ENU), metres.
    Measured {
        /// Position, metres.
        position_m: DVec3,
        /// Speed, m/s.
        speed_mps: f64,
        /// Offset, metres.
        offset_m: DVec3,
        /// Mission time when the autopilot was last heard.
        heard_ns: u64,
    },
    /// The planner's loop turned at this mission time.
    Alive(u64),
    /// Stream this pose, at rest.
    Anchor(Point),
    /// Fly a plan.
    Fly {
        /// The target's id; 0 for flights of px4-link's own.
        id: u64,
        /// How.
        plan: Box<Plan>,
        /// Brake when the planner is silent.
        needs_planner: bool,
    },
    /// Brake along the path and stay.
    Brake,
    /// Send nothing.
    Off,
}

/// What the streamer says of itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Report {
    /// Setpoints are being sent.
    pub streaming: bool,
    /// It was off too long between two setpoints and stopped.
    pub stalled: bool,
    /// The target being flown; 0: none.
    pub target_id: u64,
    /// What became of it.
    pub status: TargetStatus,
    /// 0 to 1.
    pub progress: f64,
    /// What was sent last.
    pub setpoint: Setpoint,
    /// Where the setpoint would come to rest.
    pub input: Point,
    /// Setpoints sent.
    pub sent: u64,
    /// Gaps between setpoints, by the classes of [`GAP_BORDERS_MS`].
    pub gaps: [u64; GAP_BORDERS_MS.len() + 1],
    /// The longest gap, nanoseconds.
    pub longest_gap_ns: u64,
}

/// A setpoint to send, in the world, and the offset to the autopilot's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ToSend {
    /// Position and rates.
    pub setpoint: Setpoint,
    /// World minus local (as ENU), metres.
    pub offset_m: DVec3,
}

/// Fixed settings of a streamer.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// Limits of setpoints.
    pub limits: Limits,
    /// Longest distance from the measured position, metres.
    pub leash_m: f64,
    /// A target is reached within this distance, metres.
    pub arrival_m: f64,
    /// The planner is silent from this age, nanoseconds.
    pub planner_timeout_ns: u64,
}

impl Settings {
    /// Settings as configured.
    #[must_use]
    pub fn new(config: &shared_types::config::LinkConfig) -> Self {
        Self {
            limits: Limits::new(config),
            leash_m: config.leash_m,
            arrival_m: config.arrival_tolerance_m,
            planner_timeout_ns: shared_types::ns_from_s(config.planner_timeout_s),
        }
    }
}

/// The streamer.
#[derive(Debug, Clone)]
pub struct Streamer {
    settings: Settings,
    generator: Generator,
    streaming: bool,
    stalled: bool,
    braked: bool,
    needs_planner: bool,
    target_id: u64,
    arrived: bool,
    held: bool,
    measured: Option<(DVec3, f64)>,
    offset_m: DVec3,
    heard_ns: Option<u64>,
    alive_ns: Option<u64>,
    last_sent_ns: Option<u64>,
    sent: u64,
    gaps: [u64; GAP_BORDERS_MS.len() + 1],
    longest_gap_ns: u64,
}

impl Streamer {
    /// A streamer that sends nothing.
    #[must_use]
    pub fn new(settings: Settings) -> Self {
        Self {
            settings,
            generator: Generator::new(settings.limits, Point::default()),
            streaming: false,
            stalled: false,
            braked: false,
            needs_planner: false,
            target_id: 0,
            arrived: false,
            held: false,
            measured: None,
            offset_m: DVec3::ZERO,
            heard_ns: None,
            alive_ns: None,
            last_sent_ns: None,
            sent: 0,
            gaps: [0; GAP_BORDERS_MS.len() + 1],
            longest_gap_ns: 0,
        }
    }

    /// Takes an order.
    pub fn order(&mut self, order: Order) {
        match order {
            Order::Measured { position_m, speed_mps, offset_m, heard_ns } => {
                self.measured = Some((position_m, speed_mps));
                self.offset_m = offset_m;
                self.heard_ns = Some(heard_ns);
            }
            Order::Alive(at_ns) => self.alive_ns = Some(self.alive_ns.map_or(at_ns, |old| old.max(at_ns))),
            Order::Anchor(at) => {
                self.generator.anchor(at);
                self.streaming = true;
                self.stalled = false;
                self.forget_target();
            }
            Order::Fly { id, plan, needs_planner } => {
                self.generator.fly(*plan);
                self.forget_target();
                self.target_id = id;
                self.needs_planner = needs_planner;
            }
            Order::Brake => self.braked = true,
            Order::Off => {
                self.streaming = false;
                self.stalled = false;
                self.last_sent_ns = None;
                self.forget_target();
            }
        }
    }

    fn forget_target(&mut self) {
        self.target_id = 0;
        self.arrived = false;
        self.held = false;
        self.braked = false;
        self.needs_planner = false;
    }

    /// When the next setpoint is due; `None` while nothing is streamed.
    #[must_use]
    pub fn due_ns(&self) -> Option<u64> {
        self.streaming.then(|| self.last_sent_ns.map_or(0, |last| last + PERIOD_NS))
    }

    /// The setpoint to send at `now_ns`, when one is due.
    pub fn step(&mut self, now_ns: u64) -> Option<ToSend> {
        if self.due_ns().is_none_or(|due_ns| now_ns < due_ns) {
            return None;
        }
        if let Some(last_ns) = self.last_sent_ns {
            let gap_ns = now_ns - last_ns;
            self.longest_gap_ns = self.longest_gap_ns.max(gap_ns);
            let class =
                GAP_BORDERS_MS.iter().position(|&border| gap_ns < border * 1_000_000).unwrap_or(GAP_BORDERS_MS.len());
            if let Some(count) = self.gaps.get_mut(class) {
                *count += 1;
            }
            if gap_ns > STALL_NS {
                return self.stall();
            }
        }
        let deaf_ns = self.heard_ns.map_or(0, |heard_ns| now_ns.saturating_sub(heard_ns));
        if deaf_ns > DEAF_NS {
            return self.stall();
        }
        let silent = self.needs_planner
            && self.alive_ns.is_none_or(|alive_ns| now_ns.saturating_sub(alive_ns) > self.settings.planner_timeout_ns);
        self.held = silent && self.target_id != 0;
        let lag_m = self.measured.map_or(0.0, |(at_m, _)| at_m.distance(self.generator.sent().point.position_m));
        let share = if silent || self.braked || deaf_ns > QUIET_NS {
            0.0
        } else {
            share_of_speed(lag_m, self.settings.leash_m)
        };
        let mut setpoint = self.generator.step(share);
        if let Some((at_m, speed_mps)) = self.measured {
            setpoint.point.position_m = leashed(setpoint.point.position_m, at_m, self.settings.leash_m);
            let near = at_m.distance(self.generator.sent().point.position_m) <= self.settings.arrival_m;
            self.arrived = self.generator.arrived() && (self.arrived || (near && speed_mps < 0.5));
        }
        self.last_sent_ns = Some(now_ns);
        self.sent += 1;
        Some(ToSend { setpoint, offset_m: self.offset_m })
    }

    /// Stops, and says so: control has to be taken anew.
    fn stall(&mut self) -> Option<ToSend> {
        self.order(Order::Off);
        self.stalled = true;
        None
    }

    /// What the streamer says of itself.
    #[must_use]
    pub fn report(&self) -> Report {
        let status = match (self.target_id, self.arrived, self.held) {
            _ if !self.streaming => TargetStatus::None,
            (0, false, _) => TargetStatus::None,
            (_, true, _) => TargetStatus::Arrived,
            (_, _, true) => TargetStatus::Held,
            _ => TargetStatus::Flying,
        };
        Report {
            streaming: self.streaming,
            stalled: self.stalled,
            target_id: self.target_id,
            status,
            progress: self.generator.progress(),
            setpoint: self.generator.sent(),
            input: self.generator.input(),
            sent: self.sent,
            gaps: self.gaps,
            longest_gap_ns: self.longest_gap_ns,
        }
    }
}

/// Seconds as the generator counts them equal the streamer's nanoseconds.
const _: () = assert!(PERIOD_NS == (PERIOD_S * 1e9) as u64);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::path::{Path, waypoint};
    use crate::setpoint::plan;

    fn streamer() -> Streamer {
        Streamer::new(Settings::new(&shared_types::config::LinkConfig::default()))
    }

    fn flight(to: DVec3) -> Order {
        let limits = streamer().settings.limits;
        let end = waypoint(&Point { position_m: to, ..Point::default() }, 2.0);
        Order::Fly {
            id: 7,
            plan: Box::new(plan(&Path::new(Point::default(), &[end], &limits), &limits)),
            needs_planner: true,
        }
    }

    /// Runs in steps of 10 ms with a vehicle that follows at once, or not at all.
    fn fly(streamer: &mut Streamer, from_ms: u64, to_ms: u64, alive: bool, follows: bool) -> Vec<DVec3> {
        let mut sent = Vec::new();
        for ms in (from_ms..to_ms).step_by(10) {
            if alive {
                streamer.order(Order::Alive(ms * 1_000_000));
            }
            if let Some((position_m, speed_mps)) = streamer.measured {
                let heard_ns = ms * 1_000_000;
                streamer.order(Order::Measured { position_m, speed_mps, offset_m: DVec3::ZERO, heard_ns });
            }
            if let Some(to_send) = streamer.step(ms * 1_000_000) {
                let position_m = to_send.setpoint.point.position_m;
                sent.push(position_m);
                let position_m = if follows { position_m } else { DVec3::ZERO };
                let heard_ns = ms * 1_000_000;
                streamer.order(Order::Measured { position_m, speed_mps: 0.0, offset_m: DVec3::ZERO, heard_ns });
            }
        }
        sent
    }

    #[test]
    fn a_target_is_flown_at_20_hz_and_reached() {
        let mut streamer = streamer();
        assert!(fly(&mut streamer, 0, 100, true, true).is_empty(), "nothing before an order");
        streamer.order(Order::Anchor(Point::default()));
        streamer.order(flight(DVec3::new(4.0, 0.0, 0.0)));
        assert_eq!(fly(&mut streamer, 100, 10_100, true, true).len(), 200);
        assert_eq!((streamer.report().status, streamer.report().progress), (TargetStatus::Arrived, 1.0));
        assert_eq!(streamer.report().gaps[0], 199);
    }

    #[test]
    fn a_silent_planner_stops_it_and_a_planner_that_is_back_lets_it_go_on() {
        let mut streamer = streamer();
        streamer.order(Order::Anchor(Point::default()));
        streamer.order(flight(DVec3::new(20.0, 0.0, 0.0)));
        fly(&mut streamer, 0, 4_000, true, true);
        let held = fly(&mut streamer, 4_000, 9_000, false, true);
        assert_eq!(streamer.report().status, TargetStatus::Held);
        assert_eq!(held[held.len() - 1], held[held.len() - 20], "stands");
        // 0.5 s on at 2 m/s, then at most v (T1 + T2) / 2 to brake.
        assert!(held[held.len() - 1].x - held[0].x < 1.0 + 2.2);
        fly(&mut streamer, 9_000, 30_000, true, true);
        assert_eq!(streamer.report().status, TargetStatus::Arrived);
    }

    #[test]
    fn a_vehicle_that_does_not_follow_is_not_left_behind() {
        let mut streamer = streamer();
        streamer.order(Order::Anchor(Point::default()));
        streamer.order(flight(DVec3::new(20.0, 0.0, 0.0)));
        let sent = fly(&mut streamer, 0, 20_000, true, false);
        assert!(sent.iter().all(|at| at.length() <= 3.0 + 1e-9));
        assert_eq!(streamer.report().status, TargetStatus::Flying);
    }

    #[test]
    fn silence_of_the_autopilot_stops_the_setpoint_first_and_then_the_stream() {
        let mut streamer = streamer();
        streamer.order(Order::Anchor(Point::default()));
        streamer.order(flight(DVec3::new(20.0, 0.0, 0.0)));
        fly(&mut streamer, 0, 4_000, true, true);
        let mut sent = Vec::new();
        for ms in (4_000..6_000u64).step_by(10) {
            streamer.order(Order::Alive(ms * 1_000_000));
            sent.extend(streamer.step(ms * 1_000_000).map(|to_send| (ms, to_send.setpoint.rate.position_m.x)));
        }
        let (last_ms, _) = sent[sent.len() - 1];
        assert!((4_800..=4_900).contains(&last_ms) && streamer.report().stalled, "{last_ms}");
        assert!(sent[2].1 > 1.0 && sent[sent.len() - 1].1 < sent[2].1, "braking");
    }

    #[test]
    fn a_stall_stops_the_stream_until_it_is_anchored_again() {
        let mut streamer = streamer();
        streamer.order(Order::Anchor(Point::default()));
        fly(&mut streamer, 0, 1_000, true, true);
        assert!(streamer.step(1_600_000_000).is_none() && streamer.report().stalled);
        assert!(fly(&mut streamer, 1_700, 3_000, true, true).is_empty());
        streamer.order(Order::Anchor(Point::default()));
        assert!(!fly(&mut streamer, 3_000, 4_000, true, true).is_empty() && !streamer.report().stalled);
    }
}
