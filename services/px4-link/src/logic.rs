//! The link without sockets and channels: messages, requests, targets and time go in; messages, replies and orders come out.

use std::collections::VecDeque;

use glam::{DQuat, DVec3};
use mavlink::dialects::common::{
    COMMAND_LONG_DATA, HEARTBEAT_DATA, MavAutopilot, MavCmd, MavFrame, MavMessage, MavModeFlag, MavState, MavType,
    PositionTargetTypemask, SET_POSITION_TARGET_LOCAL_NED_DATA, TIMESYNC_DATA,
};
use shared_types::bus::ReplyAddress;
use shared_types::config::LinkConfig;
use shared_types::config::link::ArmMode;
use shared_types::messages::{
    ChargeState, CommandReply, CommandRequest, CommandStatus, Commander, FailsafeReason, FlightMode, TargetStatus,
    VehicleCommand, VehicleState, VehicleTarget, Waypoint,
};
use shared_types::payload::pack_text;

use crate::asks::{Ask, Asks};
use crate::commands::{Outcome, Procedure, Stage, View, Wish};
use crate::frames::{WorldTransform, swap_ned_enu, swap_yaw, wrap_pi, yaw_of};
use crate::gimbal::Gimbal;
use crate::mavlink_io::{OWN_COMPONENT, Received};
use crate::params::{self, Params};
use crate::path::{Limits, Path, Point, rest_from};
use crate::setpoint::plan;
use crate::state::{Facts, Found, Phase, found_in_air};
use crate::store::{Kept, Store, WayBack};
use crate::stream::{Order, Report, ToSend};
use crate::telemetry::Telemetry;
use crate::timesync::TimeSync;

/// A new target's path must begin this near to the present setpoint, metres.
const START_TOLERANCE_M: f64 = 0.3;
/// The stored way back is flown from no farther away than this, metres.
const WAY_TOLERANCE_M: f64 = 1.5;
const MOST_WAYPOINTS: usize = 1024;
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
    running: Option<Running>,
    answered: VecDeque<(ReplyAddress, CommandReply)>,
    started_ns: Option<u64>,
    alive_ns: u64,
    refused: Option<(u64, TargetStatus)>,
    report: Option<Report>,
    landing: bool,
    leaving: bool,
    heartbeat_due_ns: u64,
    timesync_due_ns: u64,
    timesync_sent_ns: Option<u64>,
    ground_hold_due_ns: u64,
    out: Outputs,
}

/// A COMMAND_LONG to the autopilot.
#[must_use]
pub fn command_long(system: u8, command: MavCmd, params: [f32; 7], confirmation: u8) -> MavMessage {
    let [param1, param2, param3, param4, param5, param6, param7] = params;
    MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
        param1,
        param2,
        param3,
        param4,
        param5,
        param6,
        param7,
        command,
        target_system: system,
        target_component: 1,
        confirmation,
    })
}

/// A setpoint as the autopilot takes it: local NED position with velocity and acceleration fed
/// forward, yaw and yaw rate: nothing is masked.
#[must_use]
#[expect(clippy::cast_possible_truncation, reason = "MAVLink speaks f32 and milliseconds in 32 bits")]
pub fn setpoint_message(system: u8, now_ns: u64, to_send: &ToSend) -> MavMessage {
    let position = swap_ned_enu(to_send.setpoint.point.position_m - to_send.offset_m);
    let velocity = swap_ned_enu(to_send.setpoint.rate.position_m);
    let acceleration = swap_ned_enu(to_send.setpoint.acceleration_mps2);
    MavMessage::SET_POSITION_TARGET_LOCAL_NED(SET_POSITION_TARGET_LOCAL_NED_DATA {
        time_boot_ms: (now_ns / 1_000_000) as u32,
        x: position.x as f32,
        y: position.y as f32,
        z: position.z as f32,
        vx: velocity.x as f32,
        vy: velocity.y as f32,
        vz: velocity.z as f32,
        afx: acceleration.x as f32,
        afy: acceleration.y as f32,
        afz: acceleration.z as f32,
        yaw: swap_yaw(to_send.setpoint.point.yaw_rad) as f32,
        yaw_rate: -to_send.setpoint.rate.yaw_rad as f32,
        type_mask: PositionTargetTypemask::from_bits_retain(0),
        target_system: system,
        target_component: 1,
        coordinate_frame: MavFrame::MAV_FRAME_LOCAL_NED,
    })
}

fn reply(command: VehicleCommand, status: CommandStatus, reason: &str) -> CommandReply {
    CommandReply { status: status.code(), command: command.code(), reason: pack_text(reason) }
}

impl Core {
    /// A link that knows only what its store remembers.
    #[must_use]
    pub fn new(config: &LinkConfig, lockstep: bool, incarnation: u64, store: Store) -> Self {
        let kept = store.kept();
        let way_back = store.way_back();
        Self {
            limits: Limits::new(config),
            config: config.clone(),
            incarnation,
            world: WorldTransform::new(kept.transform),
            store,
            kept,
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
            running: None,
            answered: VecDeque::new(),
            started_ns: None,
            alive_ns: 0,
            refused: None,
            report: None,
            landing: false,
            leaving: false,
            heartbeat_due_ns: 0,
            timesync_due_ns: 0,
            timesync_sent_ns: None,
            ground_hold_due_ns: 0,
            out: Outputs::default(),
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

    /// What keeps it from working, for `health`.
    #[must_use]
    pub fn trouble(&self, now_ns: u64) -> Option<String> {
        if self.system.is_none() {
            return Some(format!("no autopilot at {}; is it running?", self.config.url));
        }
        let age_s = shared_types::s_from_ns(now_ns.saturating_sub(self.telemetry.heard_ns));
        if age_s > 3.0 {
            return Some(format!("nothing heard of the autopilot for {age_s:.1} s"));
        }
        params::refusal(&self.params, self.telemetry.remote_control, self.config.allow_unsafe_offboard_loss)
    }

    /// Takes a message of the pinned autopilot's system.
    pub fn on_message(&mut self, now_ns: u64, received: &Received) {
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
            self.first_sight = true;
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
        self.started_ns = Some(now_ns);
        self.world.forget_last();
        self.drop_running("px4-link was stopped for a while");
        self.out.orders.push(Order::Off);
    }

    /// Asked to end. True when that must wait until the vehicle has landed.
    pub fn stop(&mut self, now_ns: u64) -> bool {
        if self.flies_for_us() {
            self.leaving = true;
            self.go_home(now_ns, None);
        } else if self.telemetry.armed && self.commander == Commander::Vantage {
            // Armed and about to take off: a landing disarms it where it stands, or brings it down if it is just leaving.
            self.leaving = true;
            self.begin(now_ns, VehicleCommand::Land, 0.0, None);
        }
        self.leaving
    }

    /// Whether a stop that had to wait can end now.
    #[must_use]
    pub fn may_leave(&self) -> bool {
        self.leaving && !self.flies_for_us() && !self.telemetry.armed
            || self.leaving && matches!(self.commander, Commander::Pilot | Commander::Failsafe)
    }

    /// Takes a target.
    pub fn on_target(&mut self, header: &VehicleTarget, waypoints: &[Waypoint]) {
        let Some(report) = self.report.filter(|_| self.phase == Phase::Offboard && !self.landing) else { return };
        let (path_len, return_len) = (header.path_len as usize, header.return_len as usize);
        if header.id == report.target_id || self.refused.is_some_and(|(id, _)| id == header.id) {
            return;
        }
        if header.id <= self.kept.last_target_id {
            self.refused = Some((header.id, TargetStatus::RefusedOld));
            return;
        }
        self.kept.last_target_id = header.id;
        let (low, high) = (DVec3::from_array(header.volume_min_m), DVec3::from_array(header.volume_max_m));
        let fits = |w: &Waypoint| {
            let at = DVec3::from_array(w.position_m);
            Point::of(w).is_finite()
                && w.speed_mps.is_finite()
                && w.speed_mps > 0.0
                && at.cmpge(low).all()
                && at.cmple(high).all()
        };
        let counted = path_len > 0 && path_len + return_len == waypoints.len() && waypoints.len() <= MOST_WAYPOINTS;
        if !counted || !waypoints.iter().all(fits) {
            self.refused = Some((header.id, TargetStatus::RefusedPath));
            return;
        }
        let path = waypoints.get(..path_len).unwrap_or_default();
        let near = path.first().is_some_and(|first| {
            DVec3::from_array(first.position_m).distance(report.setpoint.point.position_m) <= START_TOLERANCE_M
        });
        if !near {
            self.refused = Some((header.id, TargetStatus::RefusedStart));
            return;
        }
        self.refused = None;
        self.way_back = WayBack::of(waypoints);
        self.store.keep_way_back(&self.way_back);
        self.remember();
        let plan = Box::new(plan(&Path::new(report.input, path, &self.limits), &self.limits));
        tracing::info!(id = header.id, duration_s = plan.duration_s, "flying a target");
        self.out.orders.push(Order::Fly { id: header.id, plan, needs_planner: true });
        if let Some(report) = &mut self.report {
            report.target_id = header.id;
            report.status = TargetStatus::Flying;
            report.progress = 0.0;
        }
    }

    /// Takes a request.
    pub fn on_command(&mut self, now_ns: u64, address: ReplyAddress, request: &CommandRequest) {
        if let Some((_, known)) = self.answered.iter().find(|(old, _)| *old == address) {
            self.out.replies.push((address, *known));
            return;
        }
        let Some(command) = VehicleCommand::from_code(request.command) else {
            let refused = CommandReply {
                status: CommandStatus::Refused.code(),
                command: request.command,
                reason: pack_text("unknown command; is the client of another version?"),
            };
            self.answer(address, refused);
            return;
        };
        let started_ns = *self.started_ns.get_or_insert(now_ns);
        // Commands from outside the mission's clock carry no time.
        if address.sent_ns != 0 && address.sent_ns < started_ns {
            self.answer(address, reply(command, CommandStatus::Restarted, "px4-link was restarted since"));
            return;
        }
        let unsafe_to_fly =
            matches!(command, VehicleCommand::Arm | VehicleCommand::Takeoff | VehicleCommand::TakeControl)
                .then(|| {
                    params::refusal(&self.params, self.telemetry.remote_control, self.config.allow_unsafe_offboard_loss)
                })
                .flatten();
        let objection = self.phase.objection(command).map(str::to_owned).or(unsafe_to_fly).or_else(|| {
            let blind = command == VehicleCommand::TakeControl && !self.telemetry.ready(now_ns);
            let no_home = command == VehicleCommand::Takeoff && self.telemetry.home.is_none();
            let wild = command == VehicleCommand::Takeoff && !(0.5..=120.0).contains(&request.altitude_m);
            (blind || no_home)
                .then(|| "position, attitude or home are not known or not fresh".to_owned())
                .or_else(|| wild.then(|| format!("altitude_m is {}; expected 0.5 to 120", request.altitude_m)))
        });
        if let Some(reason) = objection {
            self.answer(address, reply(command, CommandStatus::Refused, &reason));
            return;
        }
        tracing::info!(%command, "commanded");
        self.answer(address, reply(command, CommandStatus::Accepted, ""));
        self.begin(now_ns, command, request.altitude_m, Some(address));
    }

    /// Starts a command; the one at work is superseded.
    fn begin(&mut self, now_ns: u64, command: VehicleCommand, altitude_m: f64, address: Option<ReplyAddress>) {
        self.drop_running(&format!("superseded by {command}"));
        self.landing = matches!(command, VehicleCommand::Return | VehicleCommand::Land);
        let mode = |mode| Stage::Mode { mode, always: false };
        let on_ground = !self.telemetry.armed;
        let in_control =
            self.telemetry.mode == FlightMode::Offboard && self.report.is_some_and(|report| report.streaming);
        let stages: Vec<Stage> = match command {
            VehicleCommand::TakeControl if in_control => Vec::new(),
            VehicleCommand::TakeControl => vec![Stage::UntilSlow, Stage::StreamPose, mode(FlightMode::Offboard)],
            VehicleCommand::Arm if self.config.arm_mode() == ArmMode::Pilot => vec![Stage::UntilArmed],
            VehicleCommand::Arm if in_control => vec![Stage::UntilArmable, Stage::Arm],
            VehicleCommand::Arm => vec![mode(FlightMode::Hold), Stage::UntilArmable, Stage::Arm],
            VehicleCommand::Takeoff => {
                let above_sea_m = self.telemetry.home.map_or(0.0, |(_, above_sea_m)| above_sea_m) + altitude_m;
                vec![Stage::Takeoff { above_sea_m }, Stage::UntilHovering]
            }
            VehicleCommand::Hold => {
                self.out.orders.push(Order::Brake);
                vec![mode(FlightMode::Hold)]
            }
            VehicleCommand::Return | VehicleCommand::Land | VehicleCommand::GoOn if on_ground => Vec::new(),
            VehicleCommand::Return => self.stages_home(in_control),
            VehicleCommand::Land => vec![mode(FlightMode::Land), Stage::UntilDisarmed],
            VehicleCommand::GoOn => {
                self.commander = Commander::Vantage;
                self.failsafe = FailsafeReason::None;
                self.expect(now_ns, FlightMode::Hold);
                self.before_expected = self.telemetry.mode;
                vec![Stage::Mode { mode: FlightMode::Hold, always: true }]
            }
        };
        self.running = Some(Running { procedure: Procedure::new(command, &stages), address });
    }

    /// The way home: by the stored path where it begins near, else the autopilot's own return.
    fn stages_home(&mut self, in_control: bool) -> Vec<Stage> {
        let near = rest_from(&self.way_back.waypoints(), self.telemetry.position_m)
            .is_some_and(|(_, distance_m)| distance_m <= WAY_TOLERANCE_M);
        if !near {
            return vec![Stage::Mode { mode: FlightMode::Return, always: false }, Stage::UntilDisarmed];
        }
        let mut stages = Vec::new();
        if in_control {
            self.out.orders.push(Order::Brake);
        } else {
            stages.extend([
                Stage::UntilSlow,
                Stage::StreamPose,
                Stage::Mode { mode: FlightMode::Offboard, always: false },
            ]);
        }
        stages.extend([Stage::FlyBack, Stage::Mode { mode: FlightMode::Land, always: false }, Stage::UntilDisarmed]);
        stages
    }

    /// Returns, lands and disarms on px4-link's own account.
    fn go_home(&mut self, now_ns: u64, after_failure: Option<VehicleCommand>) {
        match after_failure {
            None => self.begin(now_ns, VehicleCommand::Return, 0.0, None),
            // The way back could not be flown: the autopilot's own return, and when that fails too, down.
            Some(VehicleCommand::Return) if !self.way_back.points.is_empty() => {
                self.way_back = WayBack::default();
                self.begin(now_ns, VehicleCommand::Return, 0.0, None);
            }
            Some(_) => self.begin(now_ns, VehicleCommand::Land, 0.0, None),
        }
    }

    fn answer(&mut self, address: ReplyAddress, reply: CommandReply) {
        self.answered.retain(|(old, _)| *old != address);
        self.answered.push_back((address, reply));
        if self.answered.len() > ANSWERS_KEPT {
            self.answered.pop_front();
        }
        self.out.replies.push((address, reply));
    }

    fn drop_running(&mut self, reason: &str) {
        if let Some(Running { procedure, address: Some(address) }) = self.running.take() {
            self.answer(address, reply(procedure.command, CommandStatus::Refused, reason));
        }
    }

    fn fail(&mut self, now_ns: u64, reason: &str) {
        let Some(running) = &self.running else { return };
        let command = running.procedure.command;
        let own = running.address.is_none();
        let text = if self.telemetry.text.is_empty() {
            reason.to_owned()
        } else {
            format!("{reason} ({})", self.telemetry.text)
        };
        tracing::warn!(%command, reason = %text, "not done");
        self.drop_running(&text);
        self.running = None;
        // A vehicle that should come down and does not is never left in the air.
        if self.landing && self.flies_for_us() || own && self.leaving {
            self.go_home(now_ns, Some(command));
        }
    }

    fn expect(&mut self, now_ns: u64, mode: FlightMode) {
        if self.expected != mode {
            self.before_expected = self.expected;
        }
        self.expected = mode;
        self.expected_since_ns = now_ns;
    }

    fn outside_fence(&self) -> bool {
        let number = |name: &str| self.params.get(name).map_or(0.0, |value| value.number());
        let (far_m, high_m) = (number("GF_MAX_HOR_DIST"), number("GF_MAX_VER_DIST"));
        let Some((home_local_m, _)) = self.telemetry.home else { return false };
        let from_home_m = self.telemetry.position_m - (home_local_m + self.world.offset_m());
        (far_m > 0.0 && from_home_m.truncate().length() > far_m - 0.2) || (high_m > 0.0 && from_home_m.z > high_m - 0.2)
    }

    /// Decides who commands, from what the autopilot does and what was asked of it.
    fn see_commander(&mut self, now_ns: u64) {
        let before = self.commander;
        let (mode, intended) = (self.telemetry.mode, self.telemetry.intended);
        if !self.telemetry.armed {
            self.commander = Commander::Nobody;
            self.failsafe = FailsafeReason::None;
            self.first_sight &= self.telemetry.heartbeats == 0;
            if before != Commander::Nobody {
                self.out.orders.push(Order::Off);
            }
        } else if self.first_sight {
            if mode == FlightMode::Unknown || !self.asks.done() || !self.telemetry.ready(now_ns) {
                return;
            }
            self.first_sight = false;
            self.see_first(now_ns, mode, intended);
        } else {
            match before {
                Commander::Nobody => {
                    let arming =
                        self.running.as_ref().is_some_and(|running| running.procedure.command == VehicleCommand::Arm);
                    self.commander = if arming { Commander::Vantage } else { Commander::Pilot };
                    self.expected = mode;
                }
                Commander::Vantage => self.see_modes(now_ns, mode, intended),
                Commander::Failsafe if mode == FlightMode::Pilot => self.commander = Commander::Pilot,
                // The reason may be told after the mode; that setpoints have stopped since is our own doing.
                Commander::Failsafe if self.failsafe == FailsafeReason::Other => {
                    let reason = self.failsafe_reason();
                    if matches!(reason, FailsafeReason::Battery | FailsafeReason::Geofence) {
                        self.failsafe = reason;
                    }
                }
                Commander::Failsafe | Commander::Pilot => {}
            }
        }
        if self.commander != before {
            tracing::info!(commander = %self.commander, %mode, failsafe = %self.failsafe, "who commands changed");
            if matches!(self.commander, Commander::Pilot | Commander::Failsafe) {
                let who = if self.commander == Commander::Pilot { "a pilot took over" } else { "a failsafe acts" };
                self.drop_running(who);
                self.running = None;
                self.landing = false;
                self.out.orders.push(Order::Off);
            }
            self.remember();
        }
    }

    fn see_first(&mut self, now_ns: u64, mode: FlightMode, intended: FlightMode) {
        let found = found_in_air(mode, intended, self.telemetry.charge, self.outside_fence(), self.kept.ours);
        tracing::info!(?found, %mode, %intended, "found the vehicle armed");
        match found {
            Found::Recover => {
                self.commander = Commander::Vantage;
                self.recover(now_ns);
            }
            Found::Ours => {
                self.commander = Commander::Vantage;
                self.expected = mode;
            }
            Found::LeaveTo(commander) => {
                self.commander = commander;
                self.failsafe =
                    if commander == Commander::Failsafe { self.failsafe_reason() } else { FailsafeReason::None };
            }
        }
    }

    /// Hold, the present pose, OFFBOARD: as after a restart.
    fn recover(&mut self, now_ns: u64) {
        self.drop_running("setpoints were interrupted");
        self.out.orders.push(Order::Off);
        self.expect(now_ns, FlightMode::Hold);
        self.before_expected = self.telemetry.mode;
        let stages = [
            Stage::Mode { mode: FlightMode::Hold, always: true },
            Stage::UntilSlow,
            Stage::StreamPose,
            Stage::Mode { mode: FlightMode::Offboard, always: false },
        ];
        self.running = Some(Running { procedure: Procedure::new(VehicleCommand::TakeControl, &stages), address: None });
        if self.landing {
            // On its way home when it was interrupted: by the autopilot's own return, which needs no setpoints.
            self.way_back = WayBack::default();
            self.begin(now_ns, VehicleCommand::Return, 0.0, None);
        }
    }

    fn failsafe_reason(&self) -> FailsafeReason {
        if matches!(self.telemetry.charge, ChargeState::Critical | ChargeState::Emergency) {
            FailsafeReason::Battery
        } else if self.outside_fence() {
            FailsafeReason::Geofence
        } else if self.telemetry.intended == FlightMode::Offboard && self.report.is_none_or(|report| !report.streaming)
        {
            FailsafeReason::OffboardLost
        } else {
            FailsafeReason::Other
        }
    }

    fn see_modes(&mut self, now_ns: u64, mode: FlightMode, intended: FlightMode) {
        if self.expected == FlightMode::Takeoff && mode == FlightMode::Hold {
            self.expect(now_ns, FlightMode::Hold);
        }
        // Down by our command: what mode the autopilot goes back to before it disarms is nobody's choice.
        if self.telemetry.landed == Some(true) && matches!(self.expected, FlightMode::Land | FlightMode::Return) {
            return;
        }
        let changing = now_ns.saturating_sub(self.expected_since_ns) < MODE_GRACE_NS;
        if mode == self.expected || (changing && mode == self.before_expected) || self.expected == FlightMode::Unknown {
            if mode == self.expected {
                self.failsafe = FailsafeReason::None;
            }
            if self.report.is_some_and(|report| report.stalled) && mode == FlightMode::Offboard {
                tracing::warn!("no setpoint for more than 0.5 s: taking control anew");
                self.recover(now_ns);
                self.report = self.report.map(|report| Report { stalled: false, ..report });
            }
            return;
        }
        let failsafe = self.telemetry.critical || (intended != FlightMode::Unknown && intended != mode);
        if !failsafe {
            self.commander = Commander::Pilot;
            return;
        }
        let reason = self.failsafe_reason();
        let stream_stopped = self.report.is_some_and(|report| report.stalled);
        if stream_stopped
            && mode == FlightMode::Hold
            && !matches!(reason, FailsafeReason::Battery | FailsafeReason::Geofence)
        {
            tracing::warn!("the autopilot holds because setpoints stopped: taking control anew");
            self.recover(now_ns);
            self.report = self.report.map(|report| Report { stalled: false, ..report });
            return;
        }
        self.failsafe = reason;
        self.commander = Commander::Failsafe;
    }

    fn remember(&mut self) {
        let kept = Kept {
            transform: self.world.kept(),
            ours: self.commander == Commander::Vantage,
            last_target_id: self.kept.last_target_id,
        };
        self.store.keep(&kept);
        self.kept = kept;
    }

    /// Pitch of the gimbal now, radians, negative down; 0 without one.
    fn gimbal_pitch_rad(&self) -> f64 {
        if self.gimbal.stamp_ns == 0 {
            0.0
        } else {
            (self.gimbal.world_from_gimbal * DVec3::X).z.clamp(-1.0, 1.0).asin()
        }
    }

    fn measured_point(&self) -> Point {
        let yaw_rad = self.telemetry.attitude().map_or(0.0, |sample| yaw_of(sample.world_from_body));
        Point { position_m: self.telemetry.position_m, yaw_rad, pitch_rad: self.gimbal_pitch_rad() }
    }

    fn run_procedure(&mut self, now_ns: u64) {
        let report = self.report;
        let view = View {
            now_ns,
            mode: self.telemetry.mode,
            armed: self.telemetry.armed,
            landed: self.telemetry.landed == Some(true),
            armable: self.telemetry.armable,
            speed_mps: self.telemetry.velocity_mps.length(),
            flown_back: report.is_some_and(|report| report.target_id == 0 && report.status == TargetStatus::Arrived),
            streaming: report.is_some_and(|report| report.streaming),
        };
        let Some(running) = &mut self.running else { return };
        let (wishes, outcome) = running.procedure.turn(&view);
        let commanded = running.procedure.commanded.take();
        if let Some(mode) = commanded {
            self.expect(now_ns, mode);
        }
        for wish in wishes {
            match wish {
                Wish::Command(command, params, confirmation) => {
                    if let Some(system) = self.system {
                        self.out.messages.push(command_long(system, command, params, confirmation));
                    }
                }
                Wish::Anchor => self.out.orders.push(Order::Anchor(self.measured_point())),
                Wish::StopStream => self.out.orders.push(Order::Off),
                Wish::FlyBack => {
                    let from = report.map_or_else(|| self.measured_point(), |report| report.input);
                    let rest = rest_from(&self.way_back.waypoints(), from.position_m)
                        .map(|(rest, _)| rest)
                        .unwrap_or_default();
                    let plan = Box::new(plan(&Path::new(from, &rest, &self.limits), &self.limits));
                    self.out.orders.push(Order::Fly { id: 0, plan, needs_planner: false });
                    self.report = report.map(|report| Report { target_id: 0, status: TargetStatus::Flying, ..report });
                }
            }
        }
        match outcome {
            Outcome::Working => {}
            Outcome::Done => {
                if let Some(Running { procedure, address }) = self.running.take()
                    && let Some(address) = address
                {
                    self.answer(address, reply(procedure.command, CommandStatus::Confirmed, ""));
                }
            }
            Outcome::Failed(reason) => self.fail(now_ns, &reason),
        }
    }

    /// One turn, after everything received was taken.
    pub fn step(&mut self, now_ns: u64) -> Outputs {
        self.started_ns.get_or_insert(now_ns);
        self.beat(now_ns);
        if let Some(system) = self.system {
            if let Some(message) = self.asks.step(now_ns, system) {
                self.out.messages.push(message);
            }
            self.check_params();
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
        self.mind_the_planner(now_ns);
        self.run_procedure(now_ns);
        if self.telemetry.position_stamp_ns > 0 {
            self.out.orders.push(Order::Measured {
                position_m: self.telemetry.position_m,
                speed_mps: self.telemetry.velocity_mps.length(),
                offset_m: self.world.offset_m(),
            });
        }
        self.point_gimbal(now_ns);
        if self.world.kept() != self.kept.transform && self.telemetry.position_stamp_ns > 0 {
            self.remember();
        }
        core::mem::take(&mut self.out)
    }

    fn beat(&mut self, now_ns: u64) {
        if now_ns >= self.heartbeat_due_ns {
            self.heartbeat_due_ns = now_ns + shared_types::NS_PER_S;
            let beat = |mavtype| {
                MavMessage::HEARTBEAT(HEARTBEAT_DATA {
                    custom_mode: 0,
                    mavtype,
                    autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
                    base_mode: MavModeFlag::empty(),
                    system_status: MavState::MAV_STATE_ACTIVE,
                    mavlink_version: 3,
                })
            };
            self.out.messages.push(beat(MavType::MAV_TYPE_ONBOARD_CONTROLLER));
            if self.config.sends_gcs_heartbeat() {
                self.out.messages.push(beat(MavType::MAV_TYPE_GCS));
            }
        }
        if self.system.is_some() && now_ns >= self.timesync_due_ns {
            self.timesync_due_ns = now_ns + shared_types::NS_PER_S / 2;
            self.timesync_sent_ns = Some(now_ns);
            let ts1 = i64::try_from(now_ns).unwrap_or(i64::MAX);
            self.out.messages.push(MavMessage::TIMESYNC(TIMESYNC_DATA {
                tc1: 0,
                ts1,
                target_system: 0,
                target_component: 0,
            }));
        }
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
        if !self.config.is_local() {
            for line in params::advice(&self.params, self.config.speed_mps) {
                tracing::warn!("{line}");
            }
        }
    }

    /// After a landing the autopilot goes back to the mode flown before, often OFFBOARD, in which it is never ready to arm.
    fn hold_on_ground(&mut self, now_ns: u64) {
        let stuck = matches!(
            self.telemetry.mode,
            FlightMode::Offboard | FlightMode::Takeoff | FlightMode::Land | FlightMode::Return | FlightMode::Other
        );
        let idle = self.running.is_none() && self.report.is_none_or(|report| !report.streaming);
        if self.phase == Phase::Ground && stuck && idle && now_ns >= self.ground_hold_due_ns {
            self.ground_hold_due_ns = now_ns + 2 * shared_types::NS_PER_S;
            let hold = [Stage::Mode { mode: FlightMode::Hold, always: false }];
            self.running = Some(Running { procedure: Procedure::new(VehicleCommand::Hold, &hold), address: None });
        }
    }

    /// A planner that is silent for too long ends the flight.
    fn mind_the_planner(&mut self, now_ns: u64) {
        let since_ns = self.alive_ns.max(self.started_ns.unwrap_or(now_ns));
        let silent_s = shared_types::s_from_ns(now_ns.saturating_sub(since_ns));
        if silent_s > self.config.planner_return_s && self.flies_for_us() && !self.landing {
            tracing::warn!(silent_s, "the planner is silent: returning and landing");
            self.go_home(now_ns, None);
        }
        // On its way down without anything at work (a restart): keep at it.
        if self.landing && self.running.is_none() && self.flies_for_us() {
            self.go_home(now_ns, Some(VehicleCommand::Return));
        }
        self.landing &= self.telemetry.armed;
    }

    fn point_gimbal(&mut self, now_ns: u64) {
        let Some(system) = self.system else { return };
        let (Phase::Offboard, Some(report)) = (self.phase, self.report) else { return };
        let own = (system, OWN_COMPONENT);
        if let Some((command, params)) = self.gimbal.demand(now_ns, report.setpoint.point.pitch_rad, own) {
            self.out.messages.push(command_long(system, command, params, 0));
        }
    }

    /// Whether the vehicle can be flown: for `vehicle/state`.
    #[must_use]
    pub fn state(&self, now_ns: u64) -> VehicleState {
        let t = &self.telemetry;
        let attitude = t.attitude();
        let body = attitude.map_or(DQuat::IDENTITY, |sample| sample.world_from_body);
        let attitude_stamp_ns = attitude.map_or(0, |sample| sample.stamp_ns);
        let has_gimbal = self.gimbal.present() && self.gimbal.stamp_ns > 0;
        let report = self.report.filter(|report| report.streaming);
        let at = report.map_or_else(|| self.measured_point(), |report| report.setpoint.point);
        let (target_id, status) = match (self.refused, report) {
            (Some((id, status)), _) => (id, status),
            (None, Some(report)) if report.target_id != 0 => (report.target_id, report.status),
            _ => (0, TargetStatus::None),
        };
        let (pitch_min, pitch_max) = self.gimbal.limits_rad.unwrap_or_default();
        VehicleState {
            incarnation: self.incarnation,
            position_stamp_ns: t.position_stamp_ns,
            attitude_stamp_ns,
            gimbal_stamp_ns: if has_gimbal { self.gimbal.stamp_ns } else { attitude_stamp_ns },
            time_uncertainty_ns: self.sync.uncertainty_ns(now_ns),
            // Never heard in this life: the age counts from its start, not from the clock's.
            link_age_ns: now_ns.saturating_sub(t.heard_ns.max(self.started_ns.unwrap_or(now_ns))),
            target_id,
            position_m: t.position_m.to_array(),
            velocity_mps: t.velocity_mps.to_array(),
            world_from_body_xyzw: body.to_array(),
            body_rates_radps: t.body_rates_radps.to_array(),
            world_from_gimbal_xyzw: if has_gimbal { self.gimbal.world_from_gimbal } else { body }.to_array(),
            gimbal_rates_radps: if has_gimbal { self.gimbal.rates_radps } else { body * t.body_rates_radps }.to_array(),
            gimbal_pitch_min_rad: pitch_min,
            gimbal_pitch_max_rad: pitch_max,
            setpoint_position_m: at.position_m.to_array(),
            setpoint_yaw_rad: wrap_pi(at.yaw_rad),
            home_m: t.home.map_or(DVec3::ZERO, |(local_m, _)| local_m + self.world.offset_m()).to_array(),
            wind_mps: t.wind_mps.to_array(),
            battery_fraction: t.battery_fraction.max(0.0),
            target_progress: report
                .filter(|report| report.target_id == target_id)
                .map_or(0.0, |report| report.progress),
            charge_state: t.charge.code(),
            mode: t.mode.code(),
            armed: u32::from(t.armed),
            landed: u32::from(t.landed == Some(true) || (t.landed.is_none() && !t.armed)),
            failsafe: self.failsafe.code(),
            commander: self.commander.code(),
            target_status: status.code(),
            reset_count: self.world.reset_count(),
            ready: u32::from(
                t.ready(now_ns) && self.asks.done() && (self.gimbal.present() || self.gimbal.absent(t.heartbeats)),
            ),
            armable: u32::from(t.armable),
            gimbal_present: u32::from(self.gimbal.present()),
            streaming: u32::from(report.is_some()),
        }
    }
}
