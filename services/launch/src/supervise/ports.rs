//! All IPC of the supervisor.

use shared_types::ServiceName;
use shared_types::bus::{Bus, BusError, Client, Limits, Subscriber};
use shared_types::channel::{
    ClockChannel, HealthChannel, MissionCommandChannel, MissionStateChannel, ScoreReplies, TruthChannel,
    VehicleCommandChannel, VehicleStateChannel,
};
use shared_types::config::{ClockMode, Config};
use shared_types::messages::{
    ClockTick, CommandRequest, MissionCommand, MissionRequest, MissionState, ScoreStatus, ServiceState, Truth,
    VehicleCommand, VehicleState,
};
use shared_types::payload::unpack_text;
use shared_types::system::System;

use crate::clock::monotonic_ns;

/// A service's health, as far as its supervisor needs it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Word {
    /// Who.
    pub service: ServiceName,
    /// For how long its worker has had a job without progress, milliseconds.
    pub stalled_ms: u64,
    /// What it lacks; empty where nothing.
    pub lacks: String,
}

/// What was heard in one turn.
#[derive(Debug, Default)]
pub struct Heard {
    /// Services whose health came.
    pub services: Vec<Word>,
    /// States of the mission, oldest first, with their stamps.
    pub missions: Vec<(u64, MissionState)>,
    /// The newest state of the vehicle.
    pub vehicle: Option<VehicleState>,
    /// Where the simulated vehicle truly is, tick by tick.
    pub truths: Vec<Truth>,
    /// Processor time of each scoring for a candidate, milliseconds.
    pub score_ms: Vec<f64>,
}

/// The supervisor's ends of the channels.
pub struct Ports {
    bus: Bus,
    health: Subscriber<HealthChannel>,
    missions: Subscriber<MissionStateChannel>,
    vehicles: Subscriber<VehicleStateChannel>,
    truths: Subscriber<TruthChannel>,
    scores: Subscriber<ScoreReplies>,
    /// The last request whose scoring was counted: answers may come twice.
    scored: Option<u64>,
    clock: Subscriber<ClockChannel>,
    mission_commands: Client<MissionCommandChannel>,
    vehicle_commands: Client<VehicleCommandChannel>,
    tick: Option<ClockTick>,
    wall_epoch_ns: Option<u64>,
    next_id: u64,
}

impl core::fmt::Debug for Ports {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Ports").field("bus", &self.bus).finish_non_exhaustive()
    }
}

impl Ports {
    /// Joins the system.
    ///
    /// # Errors
    /// When shared memory cannot be used.
    pub fn open(system: &System, config: &Config) -> Result<Self, BusError> {
        let born_ns = monotonic_ns();
        let bus = Bus::open(system, Limits::of(config), ServiceName::Launch, born_ns, false)?;
        Ok(Self {
            health: bus.subscriber()?,
            missions: bus.subscriber()?,
            vehicles: bus.subscriber()?,
            truths: bus.subscriber()?,
            scores: bus.subscriber()?,
            scored: None,
            clock: bus.subscriber()?,
            mission_commands: bus.client()?,
            vehicle_commands: bus.client()?,
            bus,
            tick: None,
            wall_epoch_ns: (config.clock.mode == ClockMode::Wall).then_some(config.mission.epoch_ns),
            // Unique over restarts of the supervisor: ids count up from its birth.
            next_id: born_ns,
        })
    }

    /// Receives everything that has come.
    ///
    /// # Errors
    /// When a channel is broken.
    pub fn receive(&mut self) -> Result<Heard, BusError> {
        if let Some(message) = self.clock.latest(0)? {
            self.tick = Some(*message.header());
        }
        let mut heard = Heard::default();
        let now_ns = self.now_ns();
        while let Some(message) = self.health.receive(now_ns)? {
            let health = message.header();
            let degraded = health.state == ServiceState::Degraded.code();
            let lacks = if degraded { unpack_text(&health.last_error) } else { String::new() };
            let word = |service| Word { service, stalled_ms: health.stalled_ns / 1_000_000, lacks };
            heard.services.extend(ServiceName::from_code(health.service).map(word));
        }
        while let Some(message) = self.missions.receive(now_ns)? {
            heard.missions.push((message.stamp_ns(), *message.header()));
        }
        heard.vehicle = self.vehicles.latest(now_ns)?.map(|message| *message.header());
        while let Some(message) = self.truths.receive(now_ns)? {
            heard.truths.push(*message.header());
        }
        while let Some(reply) = self.scores.receive(now_ns)? {
            let (id, header) = (reply.request_id(), reply.header());
            let done = header.status == ScoreStatus::Done.code() && header.candidates > 0;
            if done && self.scored.replace(id) != Some(id) {
                #[expect(clippy::cast_precision_loss, reason = "seconds in nanoseconds")]
                heard.score_ms.push(header.cpu_ns as f64 / 1e6 / f64::from(header.candidates));
            }
        }
        while let Some(reply) = self.mission_commands.receive(now_ns)? {
            let id = reply.request_id();
            if reply.header().accepted == 0 {
                let reason = unpack_text(&reply.header().reason);
                tracing::warn!(%reason, "the planner refuses the command");
            }
            drop(reply);
            self.mission_commands.finish(id);
        }
        while let Some(reply) = self.vehicle_commands.receive(now_ns)? {
            let id = reply.request_id();
            drop(reply);
            self.vehicle_commands.finish(id);
        }
        self.bus.serve_late_joiners();
        Ok(heard)
    }

    /// Mission time, as far as it is known here.
    #[must_use]
    pub fn now_ns(&self) -> u64 {
        match self.wall_epoch_ns {
            Some(epoch_ns) => monotonic_ns().saturating_add(epoch_ns),
            None => self.tick.as_ref().map_or(0, |tick| tick.now_ns),
        }
    }

    /// Whether the simulated clock says that the run repeats bit for bit so far; `None` before its first tick.
    #[must_use]
    pub fn repeats(&self) -> Option<bool> {
        self.tick.as_ref().map(|tick| tick.repeats == 1)
    }

    /// Tells the planner.
    ///
    /// # Errors
    /// When the request cannot be sent; it is kept and sent again.
    pub fn command_mission(&mut self, command: MissionCommand) -> Result<(), BusError> {
        self.next_id += 1;
        let request = MissionRequest { command: command.code(), reserved: 0 };
        self.mission_commands.send(self.now_ns(), self.next_id, &request, &[])
    }

    /// Tells the vehicle.
    ///
    /// # Errors
    /// When the request cannot be sent; it is kept and sent again.
    pub fn command_vehicle(&mut self, command: VehicleCommand) -> Result<(), BusError> {
        self.next_id += 1;
        let request = CommandRequest { command: command.code(), ..CommandRequest::default() };
        self.vehicle_commands.send(self.now_ns(), self.next_id, &request, &[])
    }
}
