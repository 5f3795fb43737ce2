//! The link without sockets against the simulated autopilot, tick by tick.

use std::collections::BTreeMap;

use glam::DVec3;
use px4_link::logic::{Core, setpoint_message};
use px4_link::mavlink_io::{decode, encode};
use px4_link::path::{Point, waypoint};
use px4_link::state::Phase;
use px4_link::store::Store;
use px4_link::stream::{Settings, Streamer};
use shared_types::TICK_NS;
use shared_types::bus::ReplyAddress;
use shared_types::config::LinkConfig;
use shared_types::messages::{
    CommandReply, CommandRequest, CommandStatus, FlightMode, VehicleCommand, VehicleState, VehicleTarget, Waypoint,
};
use shared_types::payload::unpack_text;
use simulator::simulator::{LinkId, Simulator};
use simulator::vehicle::VehicleConfig;

/// The link, its streamer and the simulated autopilot.
pub struct Rig {
    pub config: LinkConfig,
    pub folder: tempfile::TempDir,
    pub simulator: Simulator,
    pub core: Core,
    pub streamer: Streamer,
    pub pending: Vec<Vec<u8>>,
    pub now_ns: u64,
    pub planner: bool,
    pub requests: u64,
    pub mission: u64,
    /// Nothing passes between px4-link and the autopilot.
    pub deaf: bool,
    pub replies: BTreeMap<u64, CommandReply>,
    pub path: Vec<DVec3>,
}

impl Rig {
    pub fn new(config: LinkConfig, vehicle: VehicleConfig) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        Self {
            core: Core::new(&config, true, 1, Store::new(folder.path())),
            streamer: Streamer::new(Settings::new(&config)),
            simulator: Simulator::new(vehicle, 0).expect("good parameters"),
            config,
            folder,
            pending: Vec::new(),
            now_ns: 0,
            planner: true,
            requests: 0,
            mission: 1,
            deaf: false,
            replies: BTreeMap::new(),
            path: Vec::new(),
        }
    }

    /// One tick of 10 ms. Without a link the datagrams are lost.
    pub fn tick(&mut self, with_link: bool) {
        self.now_ns += TICK_NS;
        for datagram in core::mem::take(&mut self.pending) {
            self.simulator.receive(LinkId::Onboard, &datagram, 0);
        }
        self.simulator.step();
        let datagrams = self.simulator.take_datagrams();
        self.path.push(self.simulator.truth().position_m);
        if !with_link {
            return;
        }
        for received in datagrams
            .iter()
            .filter(|(link, _)| *link == LinkId::Onboard && !self.deaf)
            .flat_map(|(_, bytes)| decode(bytes))
        {
            self.core.on_message(self.now_ns, &received);
        }
        self.core.on_report(self.streamer.report());
        if self.planner && self.now_ns.is_multiple_of(100_000_000) {
            self.core.on_alive(self.now_ns - TICK_NS);
        }
        let outputs = self.core.step(self.now_ns);
        self.pending.extend(outputs.messages.iter().map(|message| encode(1, 0, message)));
        outputs.orders.into_iter().for_each(|order| self.streamer.order(order));
        if let Some(to_send) = self.streamer.step(self.now_ns) {
            self.pending.push(encode(1, 0, &setpoint_message(1, self.now_ns, &to_send)));
        }
        if self.deaf {
            self.pending.clear();
        }
        self.core.on_report(self.streamer.report());
        self.replies.extend(outputs.replies.iter().map(|(to, reply)| (to.request_id, *reply)));
    }

    pub fn state(&self) -> VehicleState {
        self.core.state(self.now_ns)
    }

    /// Ticks until something holds.
    pub fn until(&mut self, what: &str, limit_s: u64, holds: impl Fn(&Self) -> bool) {
        let end_ns = self.now_ns + limit_s * 1_000_000_000;
        while !holds(self) {
            assert!(
                self.now_ns < end_ns,
                "not within {limit_s} s: {what}; {:?} {:#?}",
                self.core.phase(),
                self.state()
            );
            self.tick(true);
        }
    }

    pub fn seconds(&mut self, seconds: u64) {
        (0..seconds * 100).for_each(|_| self.tick(true));
    }

    pub fn request(&mut self, command: VehicleCommand) -> u64 {
        self.request_with(CommandRequest { command: command.code(), altitude_m: 2.5, ..CommandRequest::default() })
    }

    pub fn request_with(&mut self, request: CommandRequest) -> u64 {
        self.requests += 1;
        let address =
            ReplyAddress { client: 8, client_incarnation: 0, request_id: self.requests, sent_ns: self.now_ns };
        self.core.on_command(self.now_ns, address, &request);
        self.requests
    }

    pub fn status(&self, id: u64) -> (Option<CommandStatus>, String) {
        let reply = self.replies.get(&id).copied().unwrap_or_default();
        (CommandStatus::from_code(reply.status), unpack_text(&reply.reason))
    }

    pub fn command(&mut self, command: VehicleCommand, limit_s: u64) {
        let id = self.request(command);
        self.until(&format!("{command} confirmed"), limit_s, |rig| rig.status(id).0 == Some(CommandStatus::Confirmed));
    }

    pub fn take_off(&mut self) {
        self.until("ready", 60, |rig| rig.state().ready == 1 && rig.state().armable == 1);
        self.command(VehicleCommand::Arm, 10);
        self.command(VehicleCommand::Takeoff, 30);
        self.command(VehicleCommand::TakeControl, 10);
        assert_eq!((self.state().mode, self.core.phase()), (FlightMode::Offboard.code(), Phase::Offboard));
    }

    /// Sends a target whose path begins at the present setpoint and whose way back is the same way.
    pub fn target(&mut self, id: u64, points: &[Waypoint]) {
        let start = Point {
            position_m: DVec3::from_array(self.state().setpoint_position_m),
            yaw_rad: self.state().setpoint_yaw_rad,
            pitch_rad: 0.0,
        };
        let mut all = vec![waypoint(&start, 1.0)];
        all.extend_from_slice(points);
        let path_len = all.len() as u32;
        let back: Vec<Waypoint> = all.iter().rev().copied().collect();
        let return_len = back.len() as u32;
        all.extend(back);
        let header = VehicleTarget {
            id,
            mission: self.mission,
            volume_min_m: [-20.0, -20.0, 0.3],
            volume_max_m: [20.0, 20.0, 12.0],
            path_len,
            return_len,
        };
        self.core.on_target(&header, &all);
    }

    /// px4-link is killed and started again after a while.
    pub fn restart(&mut self, away_ticks: u32) {
        self.pending.clear();
        (0..away_ticks).for_each(|_| self.tick(false));
        self.core = Core::new(&self.config, true, 2, Store::new(self.folder.path()));
        self.streamer = Streamer::new(Settings::new(&self.config));
    }

    /// The fastest that the vehicle truly was over the last ticks, m/s.
    pub fn fastest(&self, ticks: usize) -> f64 {
        self.path[self.path.len() - ticks..]
            .windows(2)
            .map(|pair| pair[0].distance(pair[1]) * 100.0)
            .fold(0.0, f64::max)
    }
}

pub fn rig() -> Rig {
    Rig::new(LinkConfig::default(), VehicleConfig::default())
}

pub fn at(x: f64, y: f64, z: f64, yaw: f64, pitch: f64) -> Waypoint {
    waypoint(&Point { position_m: DVec3::new(x, y, z), yaw_rad: yaw, pitch_rad: pitch }, 1.5)
}
