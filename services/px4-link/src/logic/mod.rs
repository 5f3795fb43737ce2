//! The link without sockets and channels: messages, requests, targets and time go in; messages, replies and orders come out.

mod commander;
mod home;
mod messages;
mod requests;
mod seen;

use std::collections::VecDeque;

use mavlink::dialects::common::{MavCmd, MavMessage};
use shared_types::bus::ReplyAddress;
use shared_types::config::LinkConfig;
use shared_types::messages::{CommandReply, Commander, FailsafeReason, FlightMode, TargetStatus};

use crate::asks::{Ask, Asks};
use crate::commands::Procedure;
use crate::frames::WorldTransform;
use crate::gimbal::Gimbal;
use crate::mavlink_io::{OWN_COMPONENT, Received};
use crate::params::{self, Params};
use crate::path::Limits;
use crate::state::{Facts, Phase};
use crate::store::{Kept, Store, WayBack};
use crate::stream::{Order, Report};
use crate::telemetry::Telemetry;
use crate::timesync::TimeSync;

pub use messages::{command_long, setpoint_message};

/// A new target's path must begin this near to the present setpoint, metres.
const START_TOLERANCE_M: f64 = 0.3;
/// The stored way back is flown from no farther away than this, metres.
const WAY_TOLERANCE_M: f64 = 1.5;
const MOST_WAYPOINTS: usize = 1024;
/// Silence of the autopilot in which nothing is decided or commanded, nanoseconds.
const QUIET_NS: u64 = 500_000_000;
/// Silence of the autopilot after which its modes must be heard again, nanoseconds.
const DEAF_NS: u64 = 900_000_000;
/// How long an armed vehicle is looked at before it is decided without CURRENT_MODE, nanoseconds.
const INTENT_PATIENCE_NS: u64 = 2_000_000_000;
/// How long after a command the mode may still be the one before, nanoseconds.
const MODE_GRACE_NS: u64 = 4_000_000_000;
const ANSWERS_KEPT: usize = 128;

/// A request that is being worked on.
#[derive(Debug)]
struct Running {
    procedure: Procedure,
    address: Option<ReplyAddress>,
}

/// What a turn wants sent and done.
#[derive(Debug, Default)]
pub struct Outputs {
    /// To the autopilot.
    pub messages: Vec<MavMessage>,
    /// To the streamer, in order.
    pub orders: Vec<Order>,
    /// To clients.
    pub replies: Vec<(ReplyAddress, CommandReply)>,
}

/// The link's mind.
#[derive(Debug)]
pub struct Core {
    config: LinkConfig,
    limits: Limits,
    incarnation: u64,
    store: Store,
    kept: Kept,
    way_back: WayBack,
    telemetry: Telemetry,
    world: WorldTransform,
    sync: TimeSync,
    gimbal: Gimbal,
    params: Params,
    advised: bool,
    asks: Asks,
    system: Option<u8>,
    reboots: u32,
    phase: Phase,
    commander: Commander,
    failsafe: FailsafeReason,
    expected: FlightMode,
    before_expected: FlightMode,
    expected_since_ns: u64,
    /// The next sight of an armed vehicle is as after a start.
    first_sight: bool,
    /// Since when an armed vehicle could be looked at but for its intended mode.
    sight_since_ns: Option<u64>,
    /// Since when everything that was asked is answered.
    synced_ns: Option<u64>,
    running: Option<Running>,
    answered: VecDeque<(ReplyAddress, CommandReply)>,
    started_ns: Option<u64>,
    /// When the link was stepped last.
    stepped_ns: Option<u64>,
    alive_ns: u64,
    refused: Option<(u64, TargetStatus)>,
    report: Option<Report>,
    landing: bool,
    leaving: bool,
    /// A flight of ours was not yet followed by Hold on the ground.
    flown: bool,
    heartbeat_due_ns: u64,
    timesync_due_ns: u64,
    timesync_sent_ns: Option<u64>,
    ground_hold_due_ns: u64,
    out: Outputs,
}

impl Core {
    /// A link that knows only what its store remembers.
    #[must_use]
    pub fn new(config: &LinkConfig, lockstep: bool, incarnation: u64, store: Store) -> Self {
        let kept = store.kept();
        let limits = Limits::new(config);
        let way_back = store.way_back(&limits);
        Self {
            limits,
            config: config.clone(),
            incarnation,
            world: WorldTransform::new(kept.transform),
            store,
            way_back,
            telemetry: Telemetry::default(),
            sync: TimeSync::new(lockstep),
            gimbal: Gimbal::default(),
            params: Params::new(),
            advised: false,
            asks: Asks::default(),
            system: None,
            reboots: 0,
            phase: Phase::Discover,
            commander: Commander::Nobody,
            failsafe: FailsafeReason::None,
            expected: FlightMode::Unknown,
            before_expected: FlightMode::Unknown,
            expected_since_ns: 0,
            first_sight: true,
            sight_since_ns: None,
            synced_ns: None,
            running: None,
            answered: VecDeque::new(),
            started_ns: None,
            stepped_ns: None,
            alive_ns: 0,
            refused: None,
            report: None,
            landing: false,
            leaving: false,
            flown: kept.flown,
            heartbeat_due_ns: 0,
            timesync_due_ns: 0,
            timesync_sent_ns: None,
            ground_hold_due_ns: 0,
            out: Outputs::default(),
            kept,
        }
    }

    /// Where the link is.
    #[must_use]
    pub fn phase(&self) -> Phase {
        self.phase
    }

    /// What is heard of the vehicle.
    #[must_use]
    pub fn telemetry(&self) -> &Telemetry {
        &self.telemetry
    }

    /// Whether the vehicle flies by our command.
    #[must_use]
    pub fn flies_for_us(&self) -> bool {
        self.telemetry.in_air() && self.commander == Commander::Vantage
    }

    /// Takes a message of the pinned autopilot's system.
    pub fn on_message(&mut self, now_ns: u64, received: &Received) {
        let heard_ns = self.telemetry.heard_ns;
        if heard_ns != 0 && now_ns.saturating_sub(heard_ns) > DEAF_NS {
            // After a silence nothing is decided by the modes of before.
            self.telemetry.forget_modes();
        }
        if self.system.is_none() {
            self.system = Some(received.system);
            self.asks = Asks::all();
        }
        match &received.message {
            MavMessage::COMMAND_ACK(ack) => {
                let to_us = (ack.target_system == 0 || ack.target_system == received.system)
                    && (ack.target_component == 0 || ack.target_component == OWN_COMPONENT);
                if received.component != 1 || !to_us {
                    return;
                }
                self.asks.acknowledged(ack.command);
                if ack.command == MavCmd::MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW && ack.result as u32 == 2 {
                    self.gimbal.denied();
                }
                let failed = self
                    .running
                    .as_mut()
                    .and_then(|running| running.procedure.acknowledged(now_ns, ack.command, ack.result));
                if let Some(reason) = failed {
                    self.fail(now_ns, &reason);
                }
            }
            MavMessage::PARAM_VALUE(message) if received.component == 1 => {
                let (name, value) = params::read(message);
                self.asks.valued(&name);
                self.params.insert(name, value);
            }
            MavMessage::TIMESYNC(message) if received.component == 1 => {
                let ours = self.timesync_sent_ns.filter(|&sent_ns| i64::try_from(sent_ns) == Ok(message.ts1));
                if let (Some(sent_ns), Ok(autopilot_ns)) = (ours, u64::try_from(message.tc1))
                    && autopilot_ns > 0
                {
                    self.timesync_sent_ns = None;
                    self.sync.answer(now_ns, sent_ns, autopilot_ns);
                }
            }
            MavMessage::GIMBAL_MANAGER_INFORMATION(message) => self.gimbal.information(message),
            MavMessage::GIMBAL_MANAGER_STATUS(message) => {
                let ours =
                    message.primary_control_sysid == received.system && message.primary_control_compid == OWN_COMPONENT;
                self.gimbal.primary(ours);
            }
            MavMessage::GIMBAL_DEVICE_ATTITUDE_STATUS(message) => {
                // A gimbal with a component of its own has a clock of its own: what is known is when it was heard.
                let boot_ns = u64::from(message.time_boot_ms) * 1_000_000;
                let stamp_ns = if received.component == 1 { self.sync.mission_ns(now_ns, boot_ns) } else { now_ns };
                self.gimbal.attitude(stamp_ns, message, &self.telemetry);
            }
            message if received.component == 1 => {
                self.telemetry.take(now_ns, message, &mut self.world, &mut self.sync);
            }
            _ => {}
        }
        if self.telemetry.reboots != self.reboots {
            self.reboots = self.telemetry.reboots;
            tracing::warn!("the autopilot was started again; asking anew");
            self.asks = Asks::all();
            self.advised = false;
            self.first_sight = true;
            self.sight_since_ns = None;
            self.synced_ns = None;
            self.world.forget_last();
        }
    }

    /// The planner's loop turned.
    pub fn on_alive(&mut self, at_ns: u64) {
        self.alive_ns = self.alive_ns.max(at_ns);
        self.out.orders.push(Order::Alive(at_ns));
    }

    /// What the streamer says of itself.
    pub fn on_report(&mut self, report: Report) {
        self.report = Some(report);
    }

    /// This process was away: look at the state as after a restart.
    pub fn rejoin(&mut self, now_ns: u64) {
        self.first_sight = true;
        self.sight_since_ns = None;
        self.started_ns = Some(now_ns);
        self.telemetry.forget_modes();
        self.world.forget_last();
        if self.system.is_some() {
            self.asks.push(Ask::origin());
        }
        self.drop_running("px4-link was stopped for a while");
        self.out.orders.push(Order::Off);
    }

    /// One turn, after everything received was taken.
    pub fn step(&mut self, now_ns: u64) -> Outputs {
        self.started_ns.get_or_insert(now_ns);
        // After a stall the stream is not what it was: the streamer finds that out, and says so in its next report.
        let stalled = self.stepped_ns.replace(now_ns).is_some_and(|last_ns| now_ns.saturating_sub(last_ns) > QUIET_NS);
        self.beat(now_ns);
        if let Some(system) = self.system {
            if let Some(message) = self.asks.step(now_ns, system) {
                self.out.messages.push(message);
            }
            self.check_params();
            self.ask_for_gimbal(now_ns, system);
        }
        self.see_commander(now_ns);
        self.phase = self.phase.next(&Facts {
            found: self.system.is_some(),
            synced: self.asks.done() && self.telemetry.heartbeats > 0 && self.telemetry.mode != FlightMode::Unknown,
            armed: self.telemetry.armed,
            landed: self.telemetry.landed == Some(true),
            ready: self.telemetry.ready(now_ns) && self.telemetry.armable,
            streaming: self.report.is_some_and(|report| report.streaming),
            mode: self.telemetry.mode,
            commander: self.commander,
        });
        self.hold_on_ground(now_ns);
        if !self.deaf(now_ns) && !stalled {
            self.mind_the_planner(now_ns);
            self.run_procedure(now_ns);
        }
        self.forget_arming();
        if self.telemetry.position_stamp_ns > 0 {
            self.out.orders.push(Order::Measured {
                position_m: self.telemetry.position_m,
                speed_mps: self.telemetry.velocity_mps.length(),
                offset_m: self.world.offset_m(),
                heard_ns: self.telemetry.heard_ns,
            });
        }
        self.point_gimbal(now_ns);
        if self.world.kept() != self.kept.transform && self.telemetry.position_stamp_ns > 0 {
            self.remember();
        }
        core::mem::take(&mut self.out)
    }

    fn check_params(&mut self) {
        if self.advised || !self.asks.done() {
            return;
        }
        self.advised = true;
        if self.config.sets_params() {
            for (name, value) in params::WANTED {
                if self.params.get(name).is_some_and(|now| now.number() != f64::from(value)) {
                    tracing::info!(name, value, "setting a parameter");
                    self.asks.push(Ask::Set(name, value));
                }
            }
        }
        if !self.telemetry.is_our_simulator() {
            for line in params::advice(&self.params, self.telemetry.remote_control, self.config.speed_mps) {
                tracing::warn!("{line}");
            }
        }
    }

    /// A gimbal may start after the autopilot: on the ground it is asked for again and again.
    fn ask_for_gimbal(&mut self, now_ns: u64, system: u8) {
        if !self.asks.done() {
            return;
        }
        let synced_ns = *self.synced_ns.get_or_insert(now_ns);
        if self.gimbal.present() || self.telemetry.armed {
            return;
        }
        if let Some((command, params)) = self.gimbal.ask(now_ns, synced_ns) {
            self.out.messages.push(command_long(system, command, params, 0));
        }
    }

    fn point_gimbal(&mut self, now_ns: u64) {
        let Some(system) = self.system else { return };
        let (Phase::Offboard, Some(report)) = (self.phase, self.report) else { return };
        let own = (system, OWN_COMPONENT);
        if let Some((command, params)) = self.gimbal.demand(now_ns, report.setpoint.point.pitch_rad, own) {
            self.out.messages.push(command_long(system, command, params, 0));
        }
    }
}
