//! Targets and commands from the bus: what is refused, what is begun, and how the command at work goes on.

use glam::DVec3;
use shared_types::bus::ReplyAddress;
use shared_types::config::link::ArmMode;
use shared_types::fault_point;
use shared_types::messages::{
    CommandReply, CommandRequest, CommandStatus, Commander, FailsafeReason, FlightMode, TargetStatus, VehicleCommand,
    VehicleTarget, Waypoint,
};
use shared_types::payload::pack_text;

use super::{ANSWERS_KEPT, Core, MOST_WAYPOINTS, Running, START_TOLERANCE_M, command_long};
use crate::commands::{Outcome, Procedure, Stage, View, Wish};
use crate::params;
use crate::path::{Path, Point, rest_from};
use crate::setpoint::{LONGEST_S, plan};
use crate::state::Phase;
use crate::store::WayBack;
use crate::stream::{Order, Report};

/// A world that is farther off is not looked for: something else is wrong.
const MOST_SHIFT_M: f64 = 20.0;

/// What some commands need to know.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Details {
    /// Height above home for a takeoff, metres.
    pub altitude_m: f64,
    /// How the world is moved, metres.
    pub shift_m: DVec3,
}

fn reply(command: VehicleCommand, status: CommandStatus, reason: &str) -> CommandReply {
    CommandReply { status: status.code(), command: command.code(), reason: pack_text(reason) }
}

impl Core {
    /// Takes a target.
    pub fn on_target(&mut self, header: &VehicleTarget, waypoints: &[Waypoint]) {
        let Some(report) = self.report.filter(|_| self.phase == Phase::Offboard && !self.landing) else { return };
        let (path_len, return_len) = (header.path_len as usize, header.return_len as usize);
        let known = header.mission == self.kept.mission;
        if !known {
            // Another mission counts its targets anew.
            self.kept.mission = header.mission;
            self.kept.last_target_id = 0;
            self.refused = None;
        }
        if known && (header.id == report.target_id || self.refused.is_some_and(|(id, _)| id == header.id)) {
            return;
        }
        if header.id <= self.kept.last_target_id {
            self.refused = Some((header.id, TargetStatus::RefusedOld));
            return;
        }
        self.kept.last_target_id = header.id;
        // On disk whatever becomes of it: a target that was refused once is not flown by the next life.
        self.remember();
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
        let path = Path::new(report.input, path, &self.limits);
        if path.total_s() > LONGEST_S || !WayBack::of(waypoints).can_be_flown(&self.limits) {
            self.refused = Some((header.id, TargetStatus::RefusedPath));
            return;
        }
        self.refused = None;
        self.way_back = WayBack::of(waypoints);
        self.store.keep_way_back(&self.way_back);
        let plan = Box::new(plan(&path, &self.limits));
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
        let objection =
            self.phase.objection(command).or_else(|| self.objection_while_ending(command)).map(str::to_owned);
        let objection = objection.or(unsafe_to_fly).or_else(|| {
            let blind = command == VehicleCommand::TakeControl && !self.telemetry.ready(now_ns);
            let no_home = command == VehicleCommand::Takeoff && self.telemetry.home.is_none();
            let wild = command == VehicleCommand::Takeoff && !(0.5..=120.0).contains(&request.altitude_m);
            let shifts = command == VehicleCommand::ShiftWorld;
            let elsewhere = shifts && request.reset_count != self.world.reset_count();
            let shift_m = DVec3::from_array(request.shift_m).length();
            let far = shifts && shift_m > MOST_SHIFT_M;
            (blind || no_home)
                .then(|| "position, attitude or home are not known or not fresh".to_owned())
                .or_else(|| wild.then(|| format!("altitude_m is {}; expected 0.5 to 120", request.altitude_m)))
                .or_else(|| elsewhere.then(|| "the world has moved since; measure anew".to_owned()))
                .or_else(|| far.then(|| format!("shift_m is {shift_m:.1} m; expected at most {MOST_SHIFT_M}")))
        });
        if let Some(reason) = objection {
            self.answer(address, reply(command, CommandStatus::Refused, &reason));
            return;
        }
        tracing::info!(%command, "commanded");
        self.answer(address, reply(command, CommandStatus::Accepted, ""));
        let shift_m = DVec3::from_array(request.shift_m);
        self.begin(now_ns, command, Details { altitude_m: request.altitude_m, shift_m }, Some(address));
    }

    /// Why a command cannot be taken on the way down.
    fn objection_while_ending(&self, command: VehicleCommand) -> Option<&'static str> {
        use VehicleCommand::{Hold, Land, Return, ShiftWorld, TakeControl};
        if self.leaving && !matches!(command, Hold | Return | Land) {
            return Some("px4-link was told to end; it takes hold, return and land");
        }
        (self.landing && matches!(command, TakeControl | ShiftWorld))
            .then_some("the vehicle returns or lands; command hold first")
    }

    /// Starts a command; the one at work is superseded.
    pub(super) fn begin(
        &mut self,
        now_ns: u64,
        command: VehicleCommand,
        details: Details,
        address: Option<ReplyAddress>,
    ) {
        self.drop_running(&format!("superseded by {command}"));
        self.landing = matches!(command, VehicleCommand::Return | VehicleCommand::Land);
        // While a change that was commanded is not yet seen, the mode that is seen proves nothing.
        let unseen = self.before_expected != self.expected;
        let mode = |mode| Stage::Mode { mode, always: unseen && mode != FlightMode::Offboard };
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
                let home_m = self.telemetry.home.map_or(0.0, |(_, above_sea_m)| above_sea_m);
                let above_sea_m = home_m + details.altitude_m;
                vec![Stage::Takeoff { above_sea_m }, Stage::UntilHovering]
            }
            VehicleCommand::Hold => {
                self.out.orders.push(Order::Brake);
                vec![mode(FlightMode::Hold)]
            }
            VehicleCommand::Return | VehicleCommand::Land | VehicleCommand::GoOn if on_ground => Vec::new(),
            VehicleCommand::ShiftWorld if on_ground => vec![Stage::ShiftWorld(details.shift_m)],
            // Setpoints of the world before must not flow while it moves.
            VehicleCommand::ShiftWorld => {
                vec![Stage::Mode { mode: FlightMode::Hold, always: true }, Stage::ShiftWorld(details.shift_m)]
            }
            VehicleCommand::Return => self.stages_home(in_control),
            VehicleCommand::Land => vec![mode(FlightMode::Land), Stage::UntilDisarmed],
            VehicleCommand::GoOn => {
                self.commander = Commander::Vantage;
                self.failsafe = FailsafeReason::None;
                self.expect_from(now_ns, FlightMode::Hold, self.telemetry.mode);
                vec![Stage::Mode { mode: FlightMode::Hold, always: true }]
            }
        };
        self.running = Some(Running { procedure: Procedure::new(command, &stages), address });
        if command == VehicleCommand::Arm {
            // On disk before it is sent: a px4-link that dies now must know the armed vehicle for its own.
            self.remember();
        }
    }

    /// The world moves under a vehicle that stays where it is: everything that is known in the world moves along.
    fn shift_world(&mut self, by_m: DVec3) {
        tracing::info!(?by_m, "the world is moved");
        self.out.orders.push(Order::Off);
        // A death in between leaves no way back of the other world: the autopilot's own return is left then.
        self.store.keep_way_back(&WayBack::default());
        self.world.shift(by_m);
        self.telemetry.position_m += by_m;
        self.remember();
        self.way_back.shift(by_m);
        self.store.keep_way_back(&self.way_back);
    }

    pub(super) fn answer(&mut self, address: ReplyAddress, reply: CommandReply) {
        self.answered.retain(|(old, _)| *old != address);
        self.answered.push_back((address, reply));
        if self.answered.len() > ANSWERS_KEPT {
            self.answered.pop_front();
        }
        self.out.replies.push((address, reply));
    }

    pub(super) fn drop_running(&mut self, reason: &str) {
        if let Some(Running { procedure, address: Some(address) }) = self.running.take() {
            self.answer(address, reply(procedure.command, CommandStatus::Refused, reason));
        }
    }

    pub(super) fn fail(&mut self, now_ns: u64, reason: &str) {
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

    pub(super) fn run_procedure(&mut self, now_ns: u64) {
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
        let enters = matches!(running.procedure.stage(), Some(Stage::Mode { mode: FlightMode::Offboard, .. }));
        if enters && !view.streaming {
            // It stopped since it was begun: a silence of the autopilot, or a stall. OFFBOARD without it would fly nothing.
            self.fail(now_ns, "the stream of setpoints stopped before OFFBOARD was on");
            return;
        }
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
                Wish::ShiftWorld(by_m) => self.shift_world(by_m),
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
                    match procedure.command {
                        VehicleCommand::Arm => fault_point::reach("vehicle", "armed"),
                        VehicleCommand::TakeControl => fault_point::reach("vehicle", "offboard"),
                        _ => {}
                    }
                    self.answer(address, reply(procedure.command, CommandStatus::Confirmed, ""));
                }
            }
            Outcome::Failed(reason) => self.fail(now_ns, &reason),
        }
    }
}
