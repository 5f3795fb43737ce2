//! The link under whatever may happen, in any order: what must hold in every state is checked at every tick.
//!
//! The model is the real link against the simulated autopilot. Scripts of chance kill and stop it, silence the planner and the
//! autopilot, move the estimator's origin, send targets old and new, and let a pilot take over. The properties:
//! OFFBOARD is commanded only into a fresh stream; no target of before a restart is flown; setpoints never jump; a pilot is
//! left alone; and whatever happened, the vehicle comes down.

use glam::DVec3;
use mavlink::dialects::common::{MavCmd, MavMessage};
use proptest::prelude::*;
use px4_link::commands::set_mode;
use px4_link::logic::command_long;
use px4_link::mavlink_io::{decode, encode};
use shared_types::messages::{Commander, FlightMode, VehicleCommand};
use simulator::simulator::LinkId;

use crate::rig::{Rig, at, rig};

/// No setpoint is farther from the one before, or from the vehicle at the beginning of a stream, metres.
const LARGEST_STEP_M: f64 = 0.3;
/// A stream is fresh when its last setpoint is no older, ticks.
const FRESH_TICKS: u64 = 10;
/// Absences up to this long are none, ticks.
const QUIET_TICKS: u64 = 50;
/// Gap between setpoints after which they are a new stream, ticks.
const GAP_TICKS: u64 = 50;
/// A jump of the estimate is told within this time, ticks: ODOMETRY comes 30 times a second.
const TOLD_TICKS: u64 = 10;
/// A pilot is noticed within this time, ticks: CURRENT_MODE comes with every change, heartbeats once a second.
const NOTICED_TICKS: u64 = 150;

/// What happens.
#[derive(Debug, Clone)]
enum Chance {
    /// Nothing, for so many ticks.
    Pass(u16),
    /// A new target there.
    Target([f64; 3]),
    /// The first target again, as from a planner that knows no better.
    OldTarget,
    /// The planner dies, or lives again.
    Planner(bool),
    /// px4-link is killed and back after so many ticks.
    Restart(u16),
    /// px4-link is stopped for so many ticks.
    Stall(u16),
    /// Nothing passes on the link for so many ticks.
    Deaf(u16),
    /// The estimate jumps.
    Jump([f64; 3]),
    /// A ground station commands a mode.
    Station(FlightMode),
    /// A client asks.
    Ask(VehicleCommand),
}

fn chance() -> impl Strategy<Value = Chance> {
    let near = || [-6.0..6.0, -6.0..6.0, 2.0..6.0];
    prop_oneof![
        6 => (1u16..400).prop_map(Chance::Pass),
        6 => near().prop_map(Chance::Target),
        2 => Just(Chance::OldTarget),
        2 => any::<bool>().prop_map(Chance::Planner),
        3 => (0u16..400).prop_map(Chance::Restart),
        3 => (1u16..400).prop_map(Chance::Stall),
        3 => (1u16..400).prop_map(Chance::Deaf),
        1 => [-4.0..4.0, -4.0..4.0, -1.0..1.0].prop_map(Chance::Jump),
        2 => prop_oneof![Just(FlightMode::Hold), Just(FlightMode::Land), Just(FlightMode::Return)]
            .prop_map(Chance::Station),
        4 => prop_oneof![
            Just(VehicleCommand::TakeControl),
            Just(VehicleCommand::GoOn),
            Just(VehicleCommand::Hold),
            Just(VehicleCommand::Return),
        ]
        .prop_map(Chance::Ask),
    ]
}

/// The rig with what is known of its messages.
struct Model {
    rig: Rig,
    tick: u64,
    /// The last setpoint: tick, and place in the world.
    last: Option<(u64, DVec3)>,
    /// Targets of this life of px4-link, all of whose points may be flown to.
    next_target: u64,
    /// The last one that the vehicle's state has named; the planner sends others again.
    named_target: u64,
    /// Whether a target was given since px4-link was last seen to begin anew.
    may_move: bool,
    /// Where the vehicle was when px4-link began anew.
    anchor: Option<DVec3>,
    /// The estimate jumped at this tick: setpoints are in the frame of before until the autopilot has told.
    jumped_at: Option<u64>,
    /// The link was silent until this tick: what was streamed meanwhile was not seen.
    back_at: Option<u64>,
    /// End of the last absence that was too short to count.
    stalled_at: Option<u64>,
    /// A pilot commanded a mode at this tick, and nobody said go on since.
    pilot_since: Option<u64>,
}

impl Model {
    fn new() -> Self {
        let mut rig = rig();
        rig.take_off();
        Self {
            rig,
            tick: 0,
            last: None,
            next_target: 10,
            named_target: 0,
            may_move: true,
            anchor: None,
            jumped_at: None,
            back_at: None,
            stalled_at: None,
            pilot_since: None,
        }
    }

    fn tick(&mut self, with_link: bool) -> Result<(), TestCaseError> {
        self.rig.tick(with_link);
        self.tick += 1;
        if !with_link || self.rig.deaf {
            return Ok(());
        }
        let sent: Vec<MavMessage> =
            self.rig.pending.iter().flat_map(|bytes| decode(bytes)).map(|received| received.message).collect();
        for message in &sent {
            self.look_at(message)?;
        }
        Ok(())
    }

    fn look_at(&mut self, message: &MavMessage) -> Result<(), TestCaseError> {
        if let Some(since) = self.pilot_since.filter(|_| self.rig.state().commander == Commander::Pilot.code())
            && self.tick > since + NOTICED_TICKS
        {
            let asks = matches!(message, MavMessage::COMMAND_LONG(command) if matches!(
                command.command,
                MavCmd::MAV_CMD_REQUEST_MESSAGE | MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL
            ));
            let id = mavlink::Message::message_id(message);
            prop_assert!(
                asks || !matches!(id, 84 | 76),
                "tick {}: a pilot flies, and px4-link sends {message:?}",
                self.tick
            );
        }
        match message {
            MavMessage::SET_POSITION_TARGET_LOCAL_NED(setpoint) => {
                // East, north and up are y, x and -z of NED; the world is moved by what the estimator's origin has moved.
                let local_m = DVec3::new(f64::from(setpoint.y), f64::from(setpoint.x), f64::from(-setpoint.z));
                let believed = self.rig.simulator.vehicle().estimate().position_m;
                let believed_m = DVec3::new(believed.y, believed.x, -believed.z);
                if self.jumped_at.is_some_and(|tick| self.tick <= tick + TOLD_TICKS) {
                    self.last = None;
                    return Ok(());
                }
                let fresh = self.last.filter(|(tick, _)| self.tick - tick <= GAP_TICKS);
                // Within a stream from setpoint to setpoint, both relative to the vehicle: a jump of the origin moves both.
                let relative_m = local_m - believed_m;
                let truth_m = self.rig.simulator.truth().position_m;
                let world_m = truth_m + relative_m;
                // After a jump or a silence the stream goes on, and the vehicle is wherever it was on the way.
                let lately = |at: Option<u64>| at.is_some_and(|tick| self.tick <= tick + GAP_TICKS);
                let goes_on = lately(self.jumped_at) || lately(self.back_at);
                let begins_m = if goes_on { 0.0 } else { relative_m.length() };
                let step_m = fresh.map_or(begins_m, |(_, last_m)| world_m.distance(last_m));
                prop_assert!(step_m <= LARGEST_STEP_M, "tick {}: a setpoint is {step_m:.2} m off", self.tick);
                if fresh.is_none() {
                    self.anchor = Some(truth_m);
                }
                if let (false, Some(anchor_m)) = (self.may_move, self.anchor) {
                    let away_m = world_m.distance(anchor_m);
                    prop_assert!(away_m < 1.0, "tick {}: flown {away_m:.2} m without a target", self.tick);
                }
                self.last = Some((self.tick, world_m));
            }
            MavMessage::COMMAND_LONG(command)
                if command.command == MavCmd::MAV_CMD_DO_SET_MODE && command.param2 == 6.0 =>
            {
                let age = self.last.map(|(tick, _)| self.tick - tick);
                let unseen = self.jumped_at.is_some_and(|tick| self.tick <= tick + TOLD_TICKS + FRESH_TICKS)
                    || self.back_at.max(self.stalled_at).is_some_and(|tick| self.tick <= tick + FRESH_TICKS);
                prop_assert!(
                    unseen || age.is_some_and(|age| age <= FRESH_TICKS),
                    "tick {}: OFFBOARD without a fresh stream (last setpoint {age:?} ticks ago)",
                    self.tick
                );
            }
            _ => {}
        }
        Ok(())
    }

    fn ticks(&mut self, count: u16, with_link: bool) -> Result<(), TestCaseError> {
        (0..count).try_for_each(|_| self.tick(with_link))
    }

    /// px4-link begins anew: nothing that it was told before counts.
    fn anew(&mut self) {
        self.may_move = false;
        self.anchor = None;
    }

    fn happen(&mut self, chance: &Chance) -> Result<(), TestCaseError> {
        match *chance {
            Chance::Pass(ticks) => self.ticks(ticks, true)?,
            Chance::Target([x, y, z]) => {
                self.next_target += 1;
                self.may_move = true;
                self.rig.target(self.next_target, &[at(x, y, z, 0.5, -0.3)]);
                self.ticks(20, true)?;
                if self.rig.state().target_id == self.next_target {
                    self.named_target = self.next_target;
                }
            }
            Chance::OldTarget => {
                self.rig.target(self.named_target, &[at(7.0, 7.0, 7.0, 0.5, -0.3)]);
                self.ticks(20, true)?;
            }
            Chance::Planner(alive) => {
                self.rig.planner = alive;
                // Silent for long, px4-link flies home by itself.
                self.may_move |= !alive;
                self.ticks(20, true)?;
            }
            Chance::Restart(away) => {
                self.rig.restart(u32::from(away));
                self.tick += u64::from(away);
                self.anew();
                self.may_move |= !self.rig.planner;
                self.ticks(100, true)?;
            }
            Chance::Stall(ticks) => {
                // In lockstep the clock tells a member that it was out; a shorter absence is its own to notice.
                self.ticks(ticks, false)?;
                if u64::from(ticks) <= QUIET_TICKS {
                    // px4-link takes it for none, and the autopilot waits longer for setpoints.
                    self.stalled_at = Some(self.tick);
                }
                if ticks > 200 {
                    self.rig.core.rejoin(self.rig.now_ns);
                    self.anew();
                    self.may_move |= !self.rig.planner;
                }
                self.ticks(20, true)?;
            }
            Chance::Deaf(ticks) => {
                self.rig.deaf = true;
                self.ticks(ticks, true)?;
                self.rig.deaf = false;
                self.back_at = Some(self.tick);
                self.ticks(20, true)?;
            }
            Chance::Jump([x, y, z]) => {
                self.rig.simulator.vehicle_mut().reset_estimate(DVec3::new(x, y, z));
                self.jumped_at = Some(self.tick);
                self.ticks(100, true)?;
            }
            Chance::Station(mode) => {
                let (command, params) = set_mode(mode);
                self.rig.simulator.receive(LinkId::Ground, &encode(255, 0, &command_long(1, command, params, 0)), 0);
                self.pilot_since = Some(self.tick);
                self.ticks(200, true)?;
            }
            Chance::Ask(command) => {
                if command == VehicleCommand::GoOn {
                    self.pilot_since = None;
                }
                self.may_move |= command == VehicleCommand::Return;
                self.rig.request(command);
                self.ticks(100, true)?;
            }
        }
        Ok(())
    }

    /// The planner is dead for good, and an operator lets go whatever is held: it comes down.
    fn comes_down(&mut self) -> Result<(), TestCaseError> {
        self.rig.planner = false;
        self.may_move = true;
        for second in 0..300 {
            if self.rig.simulator.vehicle().autopilot.landed() && !self.rig.simulator.vehicle().autopilot.armed() {
                return Ok(());
            }
            if second % 20 == 0
                && [Commander::Pilot.code(), Commander::Failsafe.code()].contains(&self.rig.state().commander)
            {
                self.pilot_since = None;
                self.rig.request(VehicleCommand::GoOn);
            }
            self.ticks(100, true)?;
        }
        let (state, mode) = (self.rig.state(), self.rig.simulator.vehicle().autopilot.mode());
        Err(TestCaseError::fail(format!(
            "still in the air after 300 s: {mode:?}, {:?}, {state:#?}",
            self.rig.core.phase()
        )))
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, max_shrink_iters: 300, ..ProptestConfig::default() })]

    #[test]
    fn whatever_happens_the_rules_hold_and_the_vehicle_comes_down(script in prop::collection::vec(chance(), 1..14)) {
        let mut model = Model::new();
        for chance in &script {
            model.happen(chance)?;
        }
        model.comes_down()?;
    }
}
