//! Whole missions in one process: a vehicle that flies what it is told, a camera that sees a box, a trainer and a scorer
//! that take their time. No IPC, no wall time.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use glam::{DQuat, DVec3};

use shared_types::config::{CameraConfig, PlannerConfig};
use shared_types::frames::{Intrinsics, Pose, flu_from_optical};
use shared_types::messages::{
    CandidateScore, CaptureReply, CaptureRequest, CaptureStatus, ChargeState, CommandReply, CommandStatus, Commander,
    EndReason, FlightMode, KeyframeReason, MissionCommand, MissionState, RoundReply, RoundStatus, ScoreReply,
    ScoreStatus, TargetStatus, VehicleCommand, VehicleState, VehicleTarget, Waypoint,
};

use crate::io::{Effect, Inputs, Views};
use crate::journal::{Entry, Record, parse};
use crate::logic::depth::DepthView;
use crate::logic::selection::{angle_term, split_mix};
use crate::logic::space::Obstacle;
use crate::logic::view::wrap_angle;
use crate::mission::{Mission, PRIOR_IDS, Setup};
use crate::testing::Scene;

const TICK_NS: u64 = 10_000_000;

/// What goes wrong.
#[derive(Debug, Clone, Default)]
pub struct Faults {
    /// Every so-many-th capture fails; 0: none.
    pub failing_capture: u64,
    /// But not the first ones.
    pub failing_after: u64,
    /// Ticks that arming takes beyond the usual; meanwhile px4-link says that it works on it.
    pub arming_ticks: u64,
    /// The planner dies at these ticks, and lives again after so many ticks.
    pub restarts: BTreeMap<u64, u64>,
    /// px4-link dies at these ticks: it forgets the target, and flies again after a second.
    pub link_restarts: BTreeSet<u64>,
    /// Charge lost a second.
    pub drain_per_s: f64,
    /// Commands from outside, by tick.
    pub commands: BTreeMap<u64, MissionCommand>,
    /// A pilot takes over at these ticks, where the vehicle flies, and lets go after so many; until the operator says go on,
    /// the vehicle takes no orders.
    pub pilots: BTreeMap<u64, u64>,
    /// The scorer says that the snapshot is gone, the first time.
    pub generation_gone: bool,
    /// A lasting obstacle that only the small depth images show.
    pub wall: bool,
}

struct Stored(BTreeMap<(u32, u64), DepthView>);

impl Views for Stored {
    fn read(&mut self, reason: KeyframeReason, keyframe_id: u64) -> Option<(DepthView, bool)> {
        let code = if reason.is_survey() { reason.code() } else { 0 };
        self.0.get(&(code, keyframe_id)).map(|view| (view.clone(), false))
    }
}

pub struct World {
    pub setup: Setup,
    scene: Scene,
    mission: Option<Mission>,
    pub journal: Vec<Entry>,
    text: String,
    tick: u64,
    pub vehicle: VehicleState,
    target: Option<(VehicleTarget, Vec<Waypoint>)>,
    along_m: f64,
    speed_mps: f64,
    arrived_tick: u64,
    command: Option<(u64, VehicleCommand, f64, u64)>,
    shift: DVec3,
    replies: Vec<(u64, Reply)>,
    stored: Stored,
    pub captures: BTreeMap<u64, u32>,
    faults: Faults,
    dead_until: u64,
    link_back: u64,
    pilot_until: u64,
    capture_count: u64,
    gone_said: bool,
    pub state: Option<MissionState>,
    pub least_clearance_m: f64,
    /// Where the vehicle truly is, from where it says it is: the estimator's origin has moved.
    pub off_m: DVec3,
    pub seen_ids: BTreeSet<u64>,
}

#[derive(Clone)]
enum Reply {
    Command(u64, CommandReply),
    Capture(u64, CaptureReply),
    Round(u64, RoundReply),
    Score(u64, ScoreReply, Vec<CandidateScore>),
}

pub fn setup(planner: PlannerConfig, seed: u64) -> Setup {
    let camera = CameraConfig { width_px: 96, height_px: 72, ..CameraConfig::default() };
    Setup { planner, camera, mission_id: "test".to_owned(), folder: "/tmp/test".to_owned(), seed, epoch_ns: 0 }
}

impl World {
    pub fn new(setup: Setup, scene: Scene, faults: Faults) -> Self {
        let home = DVec3::new(-5.0, -1.0, 0.0);
        let vehicle = VehicleState {
            position_m: home.to_array(),
            home_m: home.to_array(),
            setpoint_position_m: home.to_array(),
            world_from_body_xyzw: [0.0, 0.0, 0.0, 1.0],
            gimbal_pitch_min_rad: -core::f64::consts::FRAC_PI_2,
            gimbal_pitch_max_rad: 0.35,
            gimbal_present: 1,
            battery_fraction: 1.0,
            charge_state: ChargeState::Ok.code(),
            mode: FlightMode::Hold.code(),
            position_stamp_ns: 1,
            landed: 1,
            ready: 1,
            armable: 1,
            ..VehicleState::default()
        };
        Self {
            mission: Some(Mission::new(setup.clone(), &[])),
            setup,
            scene,
            journal: Vec::new(),
            text: String::new(),
            tick: 0,
            vehicle,
            target: None,
            along_m: 0.0,
            speed_mps: 0.0,
            arrived_tick: 0,
            command: None,
            shift: DVec3::ZERO,
            replies: Vec::new(),
            stored: Stored(BTreeMap::new()),
            captures: BTreeMap::new(),
            faults,
            dead_until: 0,
            link_back: 0,
            pilot_until: 0,
            capture_count: 0,
            gone_said: false,
            state: None,
            least_clearance_m: f64::INFINITY,
            off_m: DVec3::ZERO,
            seen_ids: BTreeSet::new(),
        }
    }

    pub fn seconds(&self) -> f64 {
        self.tick as f64 * 0.01
    }

    pub fn tick(&self) -> u64 {
        self.tick
    }

    /// Flies until the mission is over; panics after `limit_s`.
    pub fn fly(&mut self, limit_s: f64) -> EndReason {
        while self.seconds() < limit_s {
            self.step();
            if self.mission.as_ref().is_some_and(Mission::is_over) {
                assert_eq!((self.vehicle.landed, self.vehicle.armed), (1, 0), "over, and on the ground");
                return EndReason::from_code(self.state.unwrap().end_reason).unwrap();
            }
        }
        let mission = self.mission.as_ref().unwrap();
        panic!("not over after {limit_s} s: {:?}, last {:?}", mission.state(), self.journal.last());
    }

    /// The planner's process is asked to end at this tick.
    pub fn step_down_at(&mut self, tick: u64) {
        while self.tick < tick {
            self.step();
        }
        self.mission.as_mut().unwrap().step_down();
    }

    /// Everything is started anew: the estimator's origin has moved by this, and `vantage resume` goes on. `scene`: what
    /// stands there now.
    pub fn reboot(&mut self, moved_m: DVec3, scene: Scene) {
        self.setup.epoch_ns = self.tick * TICK_NS + 1_000_000_000;
        self.tick += 100;
        let moved_m = moved_m - self.off_m;
        self.move_world(-moved_m);
        self.scene = scene;
        self.resume();
    }

    fn move_world(&mut self, by_m: DVec3) {
        self.off_m -= by_m;
        self.vehicle.reset_count += 1;
        for place in [&mut self.vehicle.position_m, &mut self.vehicle.setpoint_position_m, &mut self.vehicle.home_m] {
            *place = (DVec3::from_array(*place) + by_m).to_array();
        }
    }

    /// Flies until the journal's last entry is such a one.
    pub fn fly_until(&mut self, is_it: impl Fn(&Entry) -> bool) {
        let end = self.tick + 100_000;
        while !self.journal.last().is_some_and(&is_it) {
            assert!(self.tick < end, "no such entry");
            self.step();
        }
    }

    /// Another planner for the same folder: its journal is all that it knows.
    pub fn resume(&mut self) {
        self.mission = Some(Mission::new(self.setup.clone(), &self.journal));
    }

    pub fn keyframes(&self) -> usize {
        self.stored.0.keys().filter(|(code, _)| *code == 0).count()
    }

    /// The batches chosen, each as a set.
    pub fn selections(&self) -> Vec<BTreeSet<u32>> {
        let chosen = |entry: &Entry| match &entry.record {
            Record::Selected { shots, .. } => Some(shots.iter().map(|shot| shot.candidate).collect()),
            _ => None,
        };
        self.journal.iter().filter_map(chosen).collect()
    }

    fn step(&mut self) {
        self.tick += 1;
        let now_ns = self.tick * TICK_NS;
        self.faults_turn();
        self.fly_tick();
        if let Some(after) = self.faults.restarts.get(&self.tick).copied() {
            // What the planner wrote is all that is left of it.
            self.mission = None;
            self.dead_until = self.tick + after;
        }
        if self.mission.is_none() && self.tick >= self.dead_until {
            let (entries, good) = parse(self.text.as_bytes(), Path::new("journal.jsonl")).unwrap();
            assert_eq!(good, self.text.len());
            assert_eq!(entries, self.journal);
            self.mission = Some(Mission::new(self.setup.clone(), &entries));
        }
        let mut inputs = Inputs { vehicle: Some(self.vehicle), ..Inputs::default() };
        if let Some(command) = self.faults.commands.get(&self.tick) {
            inputs.commands.push((0, *command));
        }
        let due: Vec<Reply> =
            self.replies.iter().filter(|(at, _)| *at <= self.tick).map(|(_, reply)| reply.clone()).collect();
        self.replies.retain(|(at, _)| *at > self.tick);
        for reply in due {
            match reply {
                Reply::Command(id, reply) => inputs.command_replies.push((id, reply)),
                Reply::Capture(id, reply) => inputs.capture_replies.push((id, reply)),
                Reply::Round(id, reply) => inputs.round_replies.push((id, reply)),
                Reply::Score(id, reply, scores) => inputs.score_replies.push((id, reply, scores)),
            }
        }
        if self.tick.is_multiple_of(50) && self.vehicle.landed == 0 {
            let small = Intrinsics::from_hfov(40, 30, 1.204);
            let mut scene = self.scene.clone();
            if self.faults.wall {
                scene.boxes.push((DVec3::new(-0.2, 3.4, 0.0), DVec3::new(0.2, 5.0, 3.0)));
            }
            inputs.depths.push(self.look(&scene, now_ns, small));
        }
        let Some(mission) = &mut self.mission else { return };
        let outputs = mission.step(now_ns, inputs, &mut self.stored);
        for entry in outputs.entries {
            assert_eq!(entry.id, self.journal.len() as u64 + 1);
            self.text.push_str(&serde_json::to_string(&entry).unwrap());
            self.text.push('\n');
            self.journal.push(entry);
        }
        for effect in outputs.effects {
            self.effect(effect);
        }
        self.check_clearance();
    }

    fn check_clearance(&mut self) {
        if let Some((low, high)) = self.scene.boxes.first() {
            let object = Obstacle { center_m: (*low + *high) / 2.0, half_m: (*high - *low) / 2.0 };
            let distance = object.distance(DVec3::from_array(self.vehicle.position_m) + self.off_m);
            self.least_clearance_m = self.least_clearance_m.min(distance);
        }
    }

    /// What the camera sees where it truly is, with the pose that is measured.
    fn look(&self, scene: &Scene, now_ns: u64, intrinsics: Intrinsics) -> DepthView {
        let measured = self.camera_pose();
        let truly = Pose { position_m: measured.position_m + self.off_m, ..measured };
        DepthView { world_from_camera: measured, ..scene.render(now_ns, truly, intrinsics) }
    }

    fn camera_pose(&self) -> Pose {
        let yaw = self.vehicle.setpoint_yaw_rad;
        let pitch = self.target.as_ref().map_or(0.0, |(target, points)| {
            let path = &points[..target.path_len as usize];
            let (before, after, share) = leg_at(path, self.along_m);
            before.gimbal_pitch_rad + (after.gimbal_pitch_rad - before.gimbal_pitch_rad) * share
        });
        let body =
            Pose { position_m: DVec3::from_array(self.vehicle.position_m), rotation: DQuat::from_rotation_z(yaw) };
        let pose = self.setup.camera.world_from_camera(body, CameraConfig::world_from_level_gimbal(yaw, pitch));
        assert!(
            (pose.rotation.angle_between(body.rotation * DQuat::from_rotation_y(-pitch) * flu_from_optical())) < 1e-6
        );
        pose
    }

    fn faults_turn(&mut self) {
        let piloted = self.vehicle.commander == Commander::Pilot.code();
        if self.faults.link_restarts.contains(&self.tick) && self.vehicle.landed == 0 && !piloted {
            // It takes back only what it had.
            let flew = self.vehicle.mode == FlightMode::Offboard.code();
            self.vehicle.mode = FlightMode::Hold.code();
            self.vehicle.streaming = 0;
            self.drop_target();
            if let Some((id, ..)) = self.command.take() {
                self.answer(id, CommandStatus::Restarted);
            }
            self.link_back = if flew { self.tick + 100 } else { 0 };
        }
        if self.link_back == self.tick
            && !piloted
            && self.vehicle.mode == FlightMode::Hold.code()
            && self.vehicle.landed == 0
        {
            self.take_control();
        }
        if let Some(&ticks) = self.faults.pilots.get(&self.tick)
            && self.vehicle.landed == 0
        {
            self.vehicle.mode = FlightMode::Pilot.code();
            self.vehicle.commander = Commander::Pilot.code();
            self.vehicle.streaming = 0;
            self.pilot_until = self.tick + ticks;
            self.drop_target();
            if let Some((id, ..)) = self.command.take() {
                self.answer(id, CommandStatus::Refused);
            }
        }
        if self.vehicle.landed == 0 {
            self.vehicle.battery_fraction -= self.faults.drain_per_s * 0.01;
        }
        let dead = self.mission.is_none() && self.tick + 50 > self.dead_until;
        if dead && self.target.is_some() {
            self.vehicle.target_status = TargetStatus::Held.code();
            self.speed_mps = 0.0;
        }
    }

    fn drop_target(&mut self) {
        self.target = None;
        self.vehicle.target_id = 0;
        self.vehicle.target_status = TargetStatus::None.code();
        self.speed_mps = 0.0;
    }

    fn take_control(&mut self) {
        self.vehicle.mode = FlightMode::Offboard.code();
        self.vehicle.commander = Commander::Vantage.code();
        self.vehicle.streaming = 1;
        self.vehicle.setpoint_position_m = self.vehicle.position_m;
    }

    fn answer(&mut self, id: u64, status: CommandStatus) {
        let reply = CommandReply { status: status.code(), ..CommandReply::default() };
        self.replies.push((self.tick + 2, Reply::Command(id, reply)));
    }

    fn fly_tick(&mut self) {
        self.command_tick();
        let v = &mut self.vehicle;
        let mode = FlightMode::from_code(v.mode).unwrap();
        match mode {
            FlightMode::Land if v.landed == 0 => {
                v.position_m[2] -= 0.007;
                if v.position_m[2] + self.off_m.z <= 0.0 {
                    v.position_m[2] = -self.off_m.z;
                    v.landed = 1;
                    v.streaming = 0;
                    self.arrived_tick = self.tick;
                }
            }
            FlightMode::Land if self.tick > self.arrived_tick + 200 => {
                v.armed = 0;
                v.mode = FlightMode::Hold.code();
                v.commander = Commander::Nobody.code();
            }
            FlightMode::Return => {
                let above = DVec3::from_array(v.home_m).with_z(6.0 - self.off_m.z);
                let to = above - DVec3::from_array(v.position_m);
                let step = to.clamp_length_max(0.03);
                v.position_m = (DVec3::from_array(v.position_m) + step).to_array();
                if to.length() < 0.05 {
                    v.mode = FlightMode::Land.code();
                }
            }
            _ => {}
        }
        if mode == FlightMode::Offboard {
            self.target_tick();
        }
    }

    fn target_tick(&mut self) {
        let Some((target, points)) = &self.target else { return };
        if self.vehicle.target_status != TargetStatus::Flying.code() {
            return;
        }
        let path = &points[..target.path_len as usize];
        let whole = path_length(path);
        let (_, next, _) = leg_at(path, self.along_m);
        let brake = (2.0 * 1.5 * (whole - self.along_m).max(0.0)).sqrt();
        self.speed_mps = (self.speed_mps + 0.015).min(next.speed_mps).min(brake.max(0.02));
        self.along_m = (self.along_m + self.speed_mps * 0.01).min(whole);
        let (before, after, share) = leg_at(path, self.along_m);
        let position = DVec3::from_array(before.position_m).lerp(DVec3::from_array(after.position_m), share);
        self.vehicle.position_m = position.to_array();
        self.vehicle.setpoint_position_m = self.vehicle.position_m;
        let yaw = before.yaw_rad + wrap_angle(after.yaw_rad - before.yaw_rad) * share;
        self.vehicle.setpoint_yaw_rad = wrap_angle(yaw);
        if self.along_m >= whole - 1e-6 {
            if self.arrived_tick == 0 {
                self.arrived_tick = self.tick;
            }
            // Time to settle and, where there is hardly any way, to turn.
            if self.tick > self.arrived_tick + 50 {
                self.vehicle.target_status = TargetStatus::Arrived.code();
            }
        }
    }

    fn command_tick(&mut self) {
        let Some((id, command, altitude_m, since)) = self.command else { return };
        let v = &mut self.vehicle;
        let confirmed = match command {
            VehicleCommand::Arm => {
                let armed = self.tick > since + 50 + self.faults.arming_ticks;
                v.armed = u32::from(armed);
                if !armed && (self.tick - since).is_multiple_of(100) {
                    self.answer(id, CommandStatus::Accepted);
                }
                armed
            }
            VehicleCommand::Takeoff => {
                v.mode = FlightMode::Takeoff.code();
                v.commander = Commander::Vantage.code();
                v.landed = 0;
                v.position_m[2] += 0.015;
                let up = v.position_m[2] + self.off_m.z >= altitude_m;
                if up {
                    v.mode = FlightMode::Hold.code();
                }
                up
            }
            VehicleCommand::TakeControl => {
                let done = self.tick > since + 20;
                if done {
                    self.take_control();
                }
                done
            }
            VehicleCommand::GoOn => {
                v.commander = Commander::Vantage.code();
                v.mode = FlightMode::Hold.code();
                true
            }
            VehicleCommand::Hold => {
                v.mode = FlightMode::Hold.code();
                v.streaming = 0;
                true
            }
            VehicleCommand::ShiftWorld => {
                if v.landed == 0 {
                    v.mode = FlightMode::Hold.code();
                    v.streaming = 0;
                }
                let done = self.tick > since + 20;
                if done {
                    let by_m = self.shift;
                    self.move_world(by_m);
                }
                done
            }
            VehicleCommand::Land => {
                v.mode = FlightMode::Land.code();
                true
            }
            VehicleCommand::Return => {
                v.mode = FlightMode::Return.code();
                true
            }
        };
        if confirmed {
            self.command = None;
            self.answer(id, CommandStatus::Confirmed);
        }
    }

    fn effect(&mut self, effect: Effect) {
        match effect {
            Effect::Target(target, points) => self.take_target(target, points),
            Effect::Command(id, request) => {
                let command = VehicleCommand::from_code(request.command).unwrap();
                if command == VehicleCommand::ShiftWorld {
                    assert_eq!(request.reset_count, self.vehicle.reset_count);
                    self.shift = DVec3::from_array(request.shift_m);
                }
                // A px4-link that was just started knows nothing yet.
                if self.tick < self.link_back {
                    self.answer(id, CommandStatus::Refused);
                    return;
                }
                let piloted = self.vehicle.commander == Commander::Pilot.code();
                if piloted && (command != VehicleCommand::GoOn || self.tick < self.pilot_until) {
                    self.answer(id, CommandStatus::Refused);
                    return;
                }
                self.command = Some((id, command, request.altitude_m, self.tick));
                if [VehicleCommand::Land, VehicleCommand::Return, VehicleCommand::Hold, VehicleCommand::ShiftWorld]
                    .contains(&command)
                {
                    self.drop_target();
                }
            }
            Effect::Capture(id, request) => self.capture(id, &request),
            Effect::Round(id, request, keyframes) => {
                for id in &keyframes {
                    assert!(self.stored.0.contains_key(&(0, *id)), "keyframe {id} is not on disk");
                }
                assert_eq!(keyframes.iter().collect::<BTreeSet<_>>().len(), keyframes.len());
                let iterations =
                    if request.stop_when_flat == 1 { request.max_iterations / 6 } else { request.max_iterations };
                let reply = RoundReply {
                    generation: u64::from(request.round) + 1,
                    round: request.round,
                    status: RoundStatus::Done.code(),
                    iterations,
                    total_iterations: iterations * (request.round + 1),
                    psnr_train_db: 30.0,
                    ..RoundReply::default()
                };
                self.replies.push((self.tick + u64::from(iterations) * 100 / 80, Reply::Round(id, reply)));
            }
            Effect::Score(id, request, views) => {
                let center = DVec3::from_array(request.box_center_m);
                let direction = |position: [f64; 3]| (DVec3::from_array(position) - center).normalize();
                let visited: Vec<DVec3> =
                    views.iter().filter(|view| view.visited == 1).map(|view| direction(view.position_m)).collect();
                let gone = self.faults.generation_gone && !self.gone_said;
                self.gone_said |= gone;
                let mut reply = ScoreReply {
                    generation: request.generation,
                    newest_generation: request.generation,
                    status: ScoreStatus::Done.code(),
                    uncertainty_p95: 1.0 / request.generation as f64,
                    ..ScoreReply::default()
                };
                if gone {
                    reply.status = ScoreStatus::GenerationGone.code();
                    self.replies.push((self.tick + 2, Reply::Score(id, reply, Vec::new())));
                    return;
                }
                let to_score = views.iter().filter(|view| view.visited == 0);
                let scores: Vec<CandidateScore> = to_score
                    .map(|view| {
                        let noise =
                            split_mix(request.generation << 32 | u64::from(view.index)) as f64 / u64::MAX as f64;
                        let angle = angle_term(direction(view.position_m), &visited, 0.25, request.clip_angle == 1);
                        let score = 0.6 * noise + 0.4 * angle;
                        CandidateScore {
                            index: view.index,
                            score,
                            angle_normalised: angle,
                            ..CandidateScore::default()
                        }
                    })
                    .collect();
                self.replies.push((self.tick + scores.len() as u64 * 4 / 10 + 2, Reply::Score(id, reply, scores)));
            }
            Effect::State(state, candidates) => {
                assert!(candidates.len() <= 512);
                self.state = Some(*state);
            }
            // An operator may be told no.
            Effect::Answer(..)
            | Effect::CommandOver(_)
            | Effect::CaptureOver(_)
            | Effect::RoundOver(_)
            | Effect::ScoreOver(_) => {}
        }
    }

    fn take_target(&mut self, target: VehicleTarget, points: Vec<Waypoint>) {
        if self.vehicle.mode != FlightMode::Offboard.code() || self.vehicle.target_id == target.id {
            return;
        }
        assert_eq!(points.len(), (target.path_len + target.return_len) as usize);
        assert!(points.len() <= 256 && target.path_len >= 2);
        assert!(self.seen_ids.insert(target.id), "an id is never used twice");
        for point in &points {
            let position = DVec3::from_array(point.position_m);
            assert!(position.cmpge(DVec3::from_array(target.volume_min_m)).all());
            assert!(position.cmple(DVec3::from_array(target.volume_max_m)).all());
            assert!(point.yaw_rad.is_finite() && point.speed_mps > 0.0);
        }
        let start = DVec3::from_array(points[0].position_m);
        assert!((start - DVec3::from_array(self.vehicle.setpoint_position_m)).length() < 0.3);
        if target.return_len > 0 {
            let (end, back) = (&points[target.path_len as usize - 1], &points[target.path_len as usize]);
            assert!((DVec3::from_array(end.position_m) - DVec3::from_array(back.position_m)).length() < 1e-9);
        }
        self.vehicle.target_id = target.id;
        self.vehicle.target_status = TargetStatus::Flying.code();
        self.target = Some((target, points));
        self.along_m = 0.0;
        self.speed_mps = 0.0;
        self.arrived_tick = 0;
    }

    fn capture(&mut self, id: u64, request: &CaptureRequest) {
        let reason = KeyframeReason::from_code(request.reason).unwrap();
        let code = if request.keyframe_id >= PRIOR_IDS { request.reason } else { 0 };
        let key = (code, request.keyframe_id);
        let mut reply = CaptureReply {
            keyframe_id: request.keyframe_id,
            status: CaptureStatus::Stored.code(),
            ..CaptureReply::default()
        };
        if !self.stored.0.contains_key(&key) {
            self.capture_count += 1;
            let failing = self.faults.failing_capture > 0 && self.capture_count > self.faults.failing_after;
            if failing && self.capture_count.is_multiple_of(self.faults.failing_capture) {
                reply.status = CaptureStatus::TimedOut.code();
                self.replies.push((self.tick + 300, Reply::Capture(id, reply)));
                return;
            }
            assert_eq!(request.target_id, self.vehicle.target_id);
            let pose = self.camera_pose();
            let to = (DVec3::from_array(request.look_at_m) - pose.position_m).normalize();
            assert!((pose.rotation * DVec3::Z).angle_between(to) < 0.37, "{reason} looks elsewhere");
            let view = self.look(&self.scene, self.tick * TICK_NS, self.setup.camera.intrinsics());
            self.stored.0.insert(key, view);
            *self.captures.entry(request.keyframe_id).or_insert(0) += 1;
        }
        self.replies.push((self.tick + 60, Reply::Capture(id, reply)));
    }
}

fn path_length(path: &[Waypoint]) -> f64 {
    let position = |waypoint: &Waypoint| DVec3::from_array(waypoint.position_m);
    path.windows(2).map(|leg| (position(&leg[1]) - position(&leg[0])).length()).sum()
}

/// The leg at a length along a path, and how far along it.
fn leg_at(path: &[Waypoint], along_m: f64) -> (Waypoint, Waypoint, f64) {
    let mut left = along_m;
    for (at, leg) in path.windows(2).enumerate() {
        let length = path_length(leg);
        if left <= length && length > 1e-12 || at + 2 == path.len() {
            return (leg[0], leg[1], if length > 1e-12 { (left / length).min(1.0) } else { 1.0 });
        }
        left -= length;
    }
    (path[0], path[0], 1.0)
}
