//! Others who speak on the link: a second autopilot, a second ground station, components that fly nothing, and answers that
//! are meant for somebody else.

use mavlink::dialects::common::{
    ATTITUDE_DATA, COMMAND_LONG_DATA, HEARTBEAT_DATA, LOCAL_POSITION_NED_DATA, MavAutopilot, MavCmd, MavMessage,
    MavModeFlag, MavState, MavType, PARAM_REQUEST_LIST_DATA,
};
use shared_types::config::FaultKind;

use crate::mav::codec::{Outbox, RawAck};
use crate::modes::Mode;

/// Where the second autopilot flies, local NED, metres: nowhere near anything.
const ELSEWHERE_M: [f32; 3] = [120.0, -80.0, -60.0];
/// The second ground station.
const STATION: (u8, u8) = (250, 190);
/// A camera's component, which flies nothing.
const CAMERA_COMPONENT: u8 = 100;
/// A client that is not there.
const NOBODY: (u8, u8) = (200, 5);

/// What is said in a tick, in datagrams.
#[derive(Debug, Default)]
pub struct Said {
    /// To the client on board.
    pub to_client: Vec<Vec<u8>>,
    /// To the vehicle.
    pub to_vehicle: Vec<Vec<u8>>,
}

/// Those who speak.
#[derive(Debug, Clone)]
pub struct Strangers {
    autopilot: Outbox,
    station: Outbox,
    camera: Outbox,
    /// Writes as the vehicle itself, to somebody else.
    vehicle: Outbox,
    system_id: u8,
}

impl Strangers {
    /// The strangers around a vehicle of a system id.
    #[must_use]
    pub fn new(system_id: u8) -> Self {
        Self {
            autopilot: Outbox::new(system_id.wrapping_add(1).max(1), 1),
            station: Outbox::new(STATION.0, STATION.1),
            camera: Outbox::new(system_id, CAMERA_COMPONENT),
            vehicle: Outbox::new(system_id, 1),
            system_id,
        }
    }

    /// What is said of a fault in a tick of 10 ms.
    pub fn say(&mut self, fault: FaultKind, tick: u64) -> Said {
        match fault {
            FaultKind::SecondAutopilot => self.second_autopilot(tick),
            FaultKind::SecondStation => self.second_station(tick),
            FaultKind::WrongIds => self.wrong_ids(tick),
            _ => Said::default(),
        }
    }

    /// Heartbeats each second, armed and flying by hand; position and attitude ten times a second.
    fn second_autopilot(&mut self, tick: u64) -> Said {
        if tick.is_multiple_of(100) {
            self.autopilot.push(&MavMessage::HEARTBEAT(HEARTBEAT_DATA {
                custom_mode: Mode::Posctl.custom_mode(),
                mavtype: MavType::MAV_TYPE_QUADROTOR,
                autopilot: MavAutopilot::MAV_AUTOPILOT_PX4,
                base_mode: MavModeFlag::from_bits_retain(Mode::Posctl.base_mode() | 128),
                system_status: MavState::MAV_STATE_ACTIVE,
                mavlink_version: 3,
            }));
        }
        if tick.is_multiple_of(10) {
            let [x, y, z] = ELSEWHERE_M;
            let time_boot_ms = (tick * 10) as u32;
            self.autopilot.push(&MavMessage::LOCAL_POSITION_NED(LOCAL_POSITION_NED_DATA {
                time_boot_ms,
                x,
                y,
                z,
                vx: 3.0,
                vy: 0.0,
                vz: 0.0,
            }));
            self.autopilot.push(&MavMessage::ATTITUDE(ATTITUDE_DATA { time_boot_ms, yaw: 2.0, ..Default::default() }));
        }
        Said { to_client: self.autopilot.take(), to_vehicle: Vec::new() }
    }

    /// Heartbeats each second to both; every five seconds it reads all parameters and asks the client to arm.
    fn second_station(&mut self, tick: u64) -> Said {
        let mut said = Said::default();
        if tick.is_multiple_of(100) {
            self.station.push(&MavMessage::HEARTBEAT(HEARTBEAT_DATA {
                mavtype: MavType::MAV_TYPE_GCS,
                autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
                mavlink_version: 3,
                ..Default::default()
            }));
            said.to_client = self.station.take();
            said.to_vehicle.clone_from(&said.to_client);
        }
        if tick % 500 == 50 {
            self.station.push(&MavMessage::PARAM_REQUEST_LIST(PARAM_REQUEST_LIST_DATA {
                target_system: self.system_id,
                target_component: 1,
            }));
            said.to_vehicle.extend(self.station.take());
            self.station.push(&MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
                command: MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
                param1: 1.0,
                ..Default::default()
            }));
            said.to_client.extend(self.station.take());
        }
        said
    }

    /// A camera's heartbeats, and refusals of everything that answer somebody else.
    fn wrong_ids(&mut self, tick: u64) -> Said {
        let mut to_client = Vec::new();
        if tick.is_multiple_of(100) {
            self.camera.push(&MavMessage::HEARTBEAT(HEARTBEAT_DATA {
                mavtype: MavType::MAV_TYPE_CAMERA,
                autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
                system_status: MavState::MAV_STATE_CRITICAL,
                mavlink_version: 3,
                ..Default::default()
            }));
            to_client.extend(self.camera.take());
        }
        if tick.is_multiple_of(10) {
            // Set mode, arm, take off, gimbal: DENIED.
            for command in [176, 400, 22, 21, 1000, 1001] {
                let ack = RawAck { command, result: 2, target_system: NOBODY.0, target_component: NOBODY.1 };
                self.vehicle.push_ack(&ack);
                self.autopilot.push_ack(&RawAck { target_system: self.system_id, ..ack });
            }
            to_client.extend(self.vehicle.take());
            to_client.extend(self.autopilot.take());
        }
        Said { to_client, to_vehicle: Vec::new() }
    }
}
