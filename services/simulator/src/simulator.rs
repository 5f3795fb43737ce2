//! The vehicle with its two MAVLink links: datagrams in, ticks, datagrams out. No socket and no clock of its own, so a
//! seed and the same datagrams give the same bytes.

use mavlink::dialects::common::{
    MESSAGE_INTERVAL_DATA, MISSION_COUNT_DATA, MavMessage, MavParamType, PARAM_VALUE_DATA, TIMESYNC_DATA,
};
use mavlink::types::CharArray;
use shared_types::config::Fault;

use crate::commands;
use crate::faults::Faults;
use crate::gimbal::Controller;
use crate::mav::codec::{Outbox, RawAck, frames};
use crate::mav::forwarding::Seen;
use crate::mav::inbound::{Inbound, read};
use crate::mav::telemetry::{self, LinkCounters};
use crate::mav::{ping, status};
use crate::params::{Params, TYPE_INT32, Value};
use crate::streams::{GROUND, ONBOARD, Streams};
use crate::vehicle::{BadParameter, TICK_NS, TrueState, Vehicle, VehicleConfig};

/// The autopilot's component.
const COMPONENT: u8 = 1;
/// Parameters sent per tick while a client reads the list.
const PARAMS_PER_TICK: usize = 10;
/// A ground station is gone for STATUSTEXT after this long without a heartbeat, ns.
const GCS_TIMEOUT_NS: u64 = 10_000_000_000;

/// A link, as PX4 has them in simulation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LinkId {
    /// 14580+i to 14540+i: clients on board.
    Onboard,
    /// 18570+i to 14550: ground stations.
    Ground,
}

impl LinkId {
    fn other(self) -> Self {
        match self {
            Self::Onboard => Self::Ground,
            Self::Ground => Self::Onboard,
        }
    }
}

#[derive(Debug, Clone)]
struct Link {
    outbox: Outbox,
    streams: Streams,
    counters: LinkCounters,
    gcs_at_ns: Option<u64>,
    /// Before anyone is heard on the ground link, only heartbeats go out on it.
    heard: bool,
    params_left: Option<usize>,
    text_id: u16,
    seen: Seen,
}

impl Link {
    fn new(system_id: u8, rates: &[(u32, u32)], heard: bool) -> Self {
        Self {
            outbox: Outbox::new(system_id, COMPONENT),
            streams: Streams::new(rates),
            counters: LinkCounters::default(),
            gcs_at_ns: None,
            heard,
            params_left: None,
            text_id: 0,
            seen: Seen::default(),
        }
    }

    fn send(&mut self, message: &MavMessage) {
        self.counters.sent = self.counters.sent.wrapping_add(1);
        self.outbox.push(message);
    }

    fn send_param(&mut self, params: &Params, index: usize) {
        let (Some(name), Some(value)) = (Params::name(index), params.at(index)) else { return };
        let mut id = [0u8; 16];
        for (to, from) in id.iter_mut().zip(name.bytes()) {
            *to = from;
        }
        let param_type = match value.type_code() {
            TYPE_INT32 => MavParamType::MAV_PARAM_TYPE_INT32,
            _ => MavParamType::MAV_PARAM_TYPE_REAL32,
        };
        self.send(&MavMessage::PARAM_VALUE(PARAM_VALUE_DATA {
            param_value: value.to_wire(),
            param_count: Params::count() as u16,
            param_index: index as u16,
            param_id: CharArray::new(id),
            param_type,
        }));
    }
}

/// The simulated vehicle with its links.
#[derive(Debug, Clone)]
pub struct Simulator {
    vehicle: Vehicle,
    onboard: Link,
    ground: Link,
    last_modes: (u32, u32),
    faults: Option<Faults>,
}

impl Simulator {
    /// Builds a vehicle of an instance: MAV_SYS_ID is instance + 1.
    ///
    /// # Errors
    /// A parameter of the configuration is unknown or not finite.
    pub fn new(mut config: VehicleConfig, instance: u8) -> Result<Self, BadParameter> {
        config.params.push(("MAV_SYS_ID".to_owned(), f64::from(instance) + 1.0));
        let vehicle = Vehicle::new(config)?;
        let system_id = vehicle.system_id();
        Ok(Self {
            vehicle,
            onboard: Link::new(system_id, ONBOARD, true),
            ground: Link::new(system_id, GROUND, false),
            last_modes: (0, 0),
            faults: None,
        })
    }

    /// The same with faults, which are decided by `seed`.
    #[must_use]
    pub fn with_faults(mut self, list: &[Fault], seed: u64) -> Self {
        self.faults = Faults::new(list, seed, self.vehicle.system_id());
        self
    }

    /// The vehicle.
    #[must_use]
    pub fn vehicle(&self) -> &Vehicle {
        &self.vehicle
    }

    /// The vehicle, for tests and scenarios that push it.
    pub fn vehicle_mut(&mut self) -> &mut Vehicle {
        &mut self.vehicle
    }

    /// True poses of this tick.
    #[must_use]
    pub fn truth(&self) -> TrueState {
        self.vehicle.truth()
    }

    /// Reads a datagram. `late_ns` is how long after the last tick it came (0 in lockstep), so that TIMESYNC is exact.
    pub fn receive(&mut self, link: LinkId, datagram: &[u8], late_ns: u64) {
        let (tick, boot_s) = (self.tick(), self.vehicle.boot_s());
        let Some(faults) = self.faults.as_mut().filter(|_| link == LinkId::Onboard) else {
            self.read(link, datagram, late_ns);
            return;
        };
        let disturbance = faults.disturbance(boot_s);
        faults.inbound.push(tick, datagram, &disturbance);
        self.read_what_arrives(late_ns);
    }

    fn tick(&self) -> u64 {
        self.vehicle.boot_ns() / TICK_NS
    }

    /// Reads what has come through a disturbed link by now.
    fn read_what_arrives(&mut self, late_ns: u64) {
        let tick = self.tick();
        let arrived = self.faults.as_mut().map_or_else(Vec::new, |faults| faults.inbound.take(tick));
        for datagram in arrived {
            self.read(LinkId::Onboard, &datagram, late_ns);
        }
    }

    fn read(&mut self, link: LinkId, datagram: &[u8], late_ns: u64) {
        let system_id = self.vehicle.system_id();
        for frame in frames(datagram) {
            let sender = (frame.system_id, frame.component_id);
            if sender == (system_id, COMPONENT) {
                continue;
            }
            let side = self.side(link);
            side.heard = true;
            side.counters.received = side.counters.received.wrapping_add(1);
            side.seen.note(&frame);
            let other = self.side(link.other());
            if other.seen.wants(&frame, (system_id, COMPONENT)) {
                other.outbox.pass_on(frame.bytes);
            }
            if let Some(inbound) = read(&frame, system_id) {
                self.handle(link, sender, inbound, late_ns);
            }
        }
    }

    fn side(&mut self, link: LinkId) -> &mut Link {
        match link {
            LinkId::Onboard => &mut self.onboard,
            LinkId::Ground => &mut self.ground,
        }
    }

    fn handle(&mut self, link: LinkId, sender: Controller, inbound: Inbound, late_ns: u64) {
        let now_ns = self.vehicle.boot_ns();
        let now_s = self.vehicle.boot_s();
        let Self { vehicle, onboard, ground, .. } = self;
        let side = match link {
            LinkId::Onboard => onboard,
            LinkId::Ground => ground,
        };
        match inbound {
            Inbound::Heartbeat { gcs: true } => {
                side.gcs_at_ns = Some(now_ns);
                vehicle.autopilot.on_gcs_heartbeat(now_s);
            }
            Inbound::Heartbeat { gcs: false } => {}
            Inbound::Command(command) => {
                let outcome = commands::execute(vehicle, &mut side.streams, sender, &command);
                side.counters.sent = side.counters.sent.wrapping_add(1);
                side.outbox.push_ack(&RawAck {
                    command: command.id,
                    result: outcome.result as u8,
                    target_system: sender.0,
                    target_component: sender.1,
                });
                if let Some(id) = outcome.tell_interval_of {
                    let interval_us = side.streams.interval_us(id).unwrap_or(0);
                    side.send(&MavMessage::MESSAGE_INTERVAL(MESSAGE_INTERVAL_DATA {
                        interval_us,
                        message_id: id as u16,
                    }));
                }
                Self::send_requested(vehicle, side);
            }
            Inbound::Setpoint(Ok((setpoint, in_body))) => vehicle.autopilot.on_setpoint(now_s, setpoint, in_body),
            Inbound::Setpoint(Err(why)) => {
                vehicle.autopilot.notify(3, why);
            }
            Inbound::GimbalAttitude(q, rates, lock) => {
                let params = vehicle.params.clone();
                vehicle.gimbal.aim_attitude(sender, q, rates, lock, &params);
            }
            Inbound::ParamRead(name, index) => {
                let index = usize::try_from(index).ok().or_else(|| Params::index_of(&name));
                if let Some(index) = index {
                    side.send_param(&vehicle.params, index);
                }
            }
            Inbound::ParamList => side.params_left = Some(0),
            Inbound::ParamSet(name, value, kind) => set_param(vehicle, side, &name, value, kind),
            Inbound::Timesync(0, ts1) => side.send(&MavMessage::TIMESYNC(TIMESYNC_DATA {
                tc1: (now_ns + late_ns).cast_signed(),
                ts1,
                target_system: sender.0,
                target_component: sender.1,
            })),
            // An answer to our own request.
            Inbound::Timesync(..) => {}
            Inbound::Ping(time_usec, seq) => side.send(&ping::message(time_usec, seq, sender)),
            Inbound::Sticks(sticks) => vehicle.autopilot.on_sticks(now_s, sticks),
            Inbound::MissionList(mission_type) => side.send(&MavMessage::MISSION_COUNT(MISSION_COUNT_DATA {
                count: 0,
                target_system: sender.0,
                target_component: sender.1,
                mission_type,
                opaque_id: 0,
            })),
        }
    }

    fn send_requested(vehicle: &Vehicle, side: &mut Link) {
        for id in side.streams.take_requested() {
            if let Some(message) = telemetry::message(vehicle, id, &side.counters) {
                side.send(&message);
            }
        }
    }

    /// Advances by one tick of 10 ms and queues what is due.
    pub fn step(&mut self) {
        if let Some(faults) = &mut self.faults {
            faults.strike(&mut self.vehicle);
        }
        self.vehicle.step();
        self.let_strangers_speak();
        let now_ns = self.vehicle.boot_ns();
        let notices = self.vehicle.autopilot.take_notices();
        let modes = (self.vehicle.autopilot.mode().custom_mode(), self.vehicle.autopilot.intended_mode().custom_mode());
        let changed = core::mem::replace(&mut self.last_modes, modes) != modes;
        let Self { vehicle, onboard, ground, .. } = self;
        for side in [onboard, ground] {
            if changed && side.heard {
                // CURRENT_MODE goes out at its rate and on change.
                side.streams.request(436);
            }
            Self::send_requested(vehicle, side);
            for id in side.streams.due(now_ns) {
                if !side.heard && id != 0 {
                    continue;
                }
                if id == 4 {
                    side.counters.pings = side.counters.pings.wrapping_add(1);
                }
                if let Some(message) = telemetry::message(vehicle, id, &side.counters) {
                    side.send(&message);
                }
            }
            if side.gcs_at_ns.is_some_and(|at| now_ns - at < GCS_TIMEOUT_NS) {
                for notice in &notices {
                    side.text_id = side.text_id.wrapping_add(1).max(1);
                    for message in status::messages(notice, side.text_id) {
                        side.send(&message);
                    }
                }
            }
            if let Some(next) = side.params_left {
                let end = (next + PARAMS_PER_TICK).min(Params::count());
                for index in next..end {
                    side.send_param(&vehicle.params, index);
                }
                side.params_left = (end < Params::count()).then_some(end);
            }
        }
    }

    fn let_strangers_speak(&mut self) {
        let (tick, boot_s) = (self.tick(), self.vehicle.boot_s());
        if let Some(faults) = &mut self.faults {
            faults.speak(tick, boot_s);
            self.read_what_arrives(0);
        }
    }

    /// The datagrams to send now.
    pub fn take_datagrams(&mut self) -> Vec<(LinkId, Vec<u8>)> {
        let (tick, boot_s) = (self.tick(), self.vehicle.boot_s());
        let mut onboard = self.onboard.outbox.take();
        if let Some(faults) = &mut self.faults {
            let disturbance = faults.disturbance(boot_s);
            for datagram in &onboard {
                faults.outbound.push(tick, datagram, &disturbance);
            }
            onboard = faults.outbound.take(tick);
        }
        let onboard = onboard.into_iter().map(|d| (LinkId::Onboard, d));
        let ground = self.ground.outbox.take().into_iter().map(|d| (LinkId::Ground, d));
        onboard.chain(ground).collect()
    }
}

/// Sets a parameter; whatever comes of it, its present value is told.
fn set_param(vehicle: &mut Vehicle, side: &mut Link, name: &str, value: f32, kind: u8) {
    let index = match Value::from_wire(value, kind) {
        Some(value) => match vehicle.params.set(name, value) {
            Ok(index) => Some(index),
            Err(error) => {
                vehicle.autopilot.notify(3, &error.to_string());
                Params::index_of(name)
            }
        },
        None => Params::index_of(name),
    };
    if let Some(index) = index {
        side.send_param(&vehicle.params, index);
    }
}
