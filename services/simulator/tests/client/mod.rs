//! An in-process MAVLink client: it speaks bytes to the simulator, as a real one would, in simulated time.
#![expect(clippy::expect_used, clippy::panic, reason = "test code: a failure is a panic")]

use mavlink::dialects::common::*;
use mavlink::{MAVLinkV2MessageRaw, MavHeader};
use simulator::mav::codec::frames;
use simulator::simulator::{LinkId, Simulator};
use simulator::vehicle::VehicleConfig;

/// Result codes of COMMAND_ACK.
pub const ACCEPTED: u8 = 0;
pub const REJECTED: u8 = 1;
pub const DENIED: u8 = 2;
pub const UNSUPPORTED: u8 = 3;

/// PX4's modes as HEARTBEAT.custom_mode.
pub const HOLD: u32 = 4 << 16 | 3 << 24;
pub const TAKEOFF: u32 = 4 << 16 | 2 << 24;
pub const RETURN: u32 = 4 << 16 | 5 << 24;
pub const LAND: u32 = 4 << 16 | 6 << 24;
pub const OFFBOARD: u32 = 6 << 16;
pub const POSCTL: u32 = 3 << 16;

pub struct Client {
    pub simulator: Simulator,
    pub component: u8,
    /// Every message of the vehicle on the onboard link.
    pub heard: Vec<MavMessage>,
    pub bytes: Vec<u8>,
    /// Sent at 20 Hz while it is there: north, east, down, yaw.
    pub setpoint: Option<[f32; 4]>,
    /// A ground station's heartbeat at 1 Hz.
    pub gcs: bool,
    ticks: u64,
}

impl Client {
    pub fn new(config: VehicleConfig) -> Self {
        let simulator = Simulator::new(config, 0).expect("a good configuration");
        Self { simulator, component: 190, heard: Vec::new(), bytes: Vec::new(), setpoint: None, gcs: true, ticks: 0 }
    }

    pub fn with(params: &[(&str, f64)]) -> Self {
        let params = params.iter().map(|&(name, value)| (name.to_owned(), value)).collect();
        let mut client = Self::new(VehicleConfig { params, ..VehicleConfig::default() });
        client.run(2.0);
        client
    }

    pub fn send(&mut self, message: &MavMessage) {
        let mut raw = MAVLinkV2MessageRaw::new();
        let header = MavHeader { system_id: 245, component_id: self.component, sequence: 0 };
        raw.serialize_message(header, message);
        let bytes = raw.raw_bytes().to_vec();
        self.simulator.receive(LinkId::Onboard, &bytes, 0);
    }

    fn read(&mut self) {
        for (link, datagram) in self.simulator.take_datagrams() {
            if link == LinkId::Onboard {
                self.heard.extend(frames(&datagram).filter_map(|f| f.message()));
                self.bytes.extend(datagram);
            }
        }
    }

    pub fn tick(&mut self) {
        if self.gcs && self.ticks.is_multiple_of(100) {
            self.send(&MavMessage::HEARTBEAT(HEARTBEAT_DATA {
                custom_mode: 0,
                mavtype: MavType::MAV_TYPE_GCS,
                autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
                base_mode: MavModeFlag::empty(),
                system_status: MavState::MAV_STATE_ACTIVE,
                mavlink_version: 3,
            }));
        }
        if let (Some([x, y, z, yaw]), true) = (self.setpoint, self.ticks.is_multiple_of(5)) {
            self.send(&target(x, y, z, yaw));
        }
        self.ticks += 1;
        self.simulator.step();
        self.read();
    }

    pub fn run(&mut self, seconds: f64) {
        for _ in 0..(seconds * 100.0).round() as u64 {
            self.tick();
        }
    }

    /// Ticks until something holds; gives the seconds it took.
    pub fn until(&mut self, most_s: f64, what: &str, holds: impl Fn(&Self) -> bool) -> f64 {
        for tick in 0..(most_s * 100.0) as u64 {
            if holds(self) {
                return tick as f64 * 0.01;
            }
            self.tick();
        }
        panic!("{what}: not within {most_s} s; mode {:#x}, height {:.2}", self.mode(), self.height());
    }

    /// Sends COMMAND_LONG from raw bytes, so that any number goes; gives the acknowledgement's result.
    pub fn command(&mut self, number: u16, params: &[f32]) -> Option<u8> {
        self.command_to(number, params, 1, 1)
    }

    pub fn command_to(&mut self, number: u16, params: &[f32], system: u8, component: u8) -> Option<u8> {
        let mut payload = [0u8; 33];
        for i in 0..7 {
            let value = params.get(i).copied().unwrap_or(f32::NAN);
            payload[4 * i..4 * i + 4].copy_from_slice(&value.to_le_bytes());
        }
        payload[28..30].copy_from_slice(&number.to_le_bytes());
        payload[30] = system;
        payload[31] = component;
        let bytes = frame(76, 152, self.component, &payload);
        self.simulator.receive(LinkId::Onboard, &bytes, 0);
        let datagrams = self.simulator.take_datagrams();
        let mut result = None;
        for (_, datagram) in datagrams {
            for f in frames(&datagram) {
                if f.message_id == 77 {
                    let ack = f.padded::<10>();
                    assert_eq!((u16::from_le_bytes([ack[0], ack[1]]), ack[8], ack[9]), (number, 245, self.component));
                    result = Some(ack[2]);
                }
                self.heard.extend(f.message());
            }
        }
        result
    }

    pub fn set_mode(&mut self, custom_mode: u32) -> Option<u8> {
        self.command(176, &[1.0, (custom_mode >> 16 & 0xff) as f32, (custom_mode >> 24) as f32])
    }

    pub fn mode(&self) -> u32 {
        self.simulator.vehicle().autopilot.mode().custom_mode()
    }

    pub fn armed(&self) -> bool {
        self.simulator.vehicle().autopilot.armed()
    }

    pub fn can_arm(&self) -> bool {
        let vehicle = self.simulator.vehicle();
        vehicle.autopilot.can_arm(&vehicle.params)
    }

    pub fn height(&self) -> f64 {
        -self.simulator.vehicle().body().position_m.z
    }

    pub fn north(&self) -> f64 {
        self.simulator.vehicle().body().position_m.x
    }

    pub fn heartbeat(&self) -> HEARTBEAT_DATA {
        self.last(|m| if let MavMessage::HEARTBEAT(h) = m { Some(h.clone()) } else { None })
    }

    pub fn last<T>(&self, pick: impl Fn(&MavMessage) -> Option<T>) -> T {
        self.heard.iter().rev().find_map(pick).expect("such a message was heard")
    }

    pub fn texts(&self) -> Vec<String> {
        self.heard
            .iter()
            .filter_map(|m| match m {
                MavMessage::STATUSTEXT(t) => Some(t.text.to_str().unwrap_or("").to_owned()),
                _ => None,
            })
            .collect()
    }

    /// Arms, takes off, and waits for Hold.
    pub fn take_off(&mut self) {
        assert_eq!(self.command(400, &[1.0]), Some(ACCEPTED));
        assert_eq!(self.command(22, &[]), Some(ACCEPTED));
        self.until(20.0, "takeoff", |c| c.mode() == HOLD && c.height() > 2.0);
    }

    /// Flies OFFBOARD at a setpoint until it is there.
    pub fn fly_to(&mut self, setpoint: [f32; 4]) {
        self.setpoint = Some(setpoint);
        self.run(0.1);
        assert_eq!(self.set_mode(OFFBOARD), Some(ACCEPTED));
        let [x, _, z, _] = setpoint.map(f64::from);
        self.until(30.0, "flight", |c| (c.north() - x).abs() < 0.3 && (c.height() + z).abs() < 0.3);
    }
}

pub fn target(x: f32, y: f32, z: f32, yaw: f32) -> MavMessage {
    MavMessage::SET_POSITION_TARGET_LOCAL_NED(SET_POSITION_TARGET_LOCAL_NED_DATA {
        x,
        y,
        z,
        yaw,
        type_mask: PositionTargetTypemask::from_bits_retain(0x9F8),
        target_system: 1,
        target_component: 1,
        coordinate_frame: MavFrame::MAV_FRAME_LOCAL_NED,
        ..Default::default()
    })
}

/// A frame of a message id with any payload.
pub fn frame(message_id: u32, crc_extra: u8, component: u8, payload: &[u8]) -> Vec<u8> {
    let [id0, id1, id2, _] = message_id.to_le_bytes();
    let mut bytes = vec![0xFD, payload.len() as u8, 0, 0, 0, 245, component, id0, id1, id2];
    bytes.extend_from_slice(payload);
    let crc = mavlink::calculate_crc(&bytes[1..], crc_extra);
    bytes.extend_from_slice(&crc.to_le_bytes());
    bytes
}
