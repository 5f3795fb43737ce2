//! MAVLink: what px4-link hears of an autopilot, and what the simulated one hears of its clients.

use mavlink::dialects::common::{
    COMMAND_LONG_DATA, HEARTBEAT_DATA, MANUAL_CONTROL_DATA, MavAutopilot, MavCmd, MavFrame, MavMessage, MavType,
    PARAM_SET_DATA, PositionTargetTypemask, SET_POSITION_TARGET_LOCAL_NED_DATA, TIMESYNC_DATA,
};
use px4_link::logic::Core;
use px4_link::mavlink_io::{decode, encode, take_frames};
use px4_link::store::Store;
use shared_types::config::LinkConfig;
use simulator::simulator::{LinkId, Simulator};
use simulator::vehicle::VehicleConfig;

use crate::seal;

const TICK_NS: u64 = 10_000_000;

/// Frames to px4-link's mind, a tick after each, and what it then tells of the vehicle.
pub fn px4_link(data: &[u8]) {
    let bytes = seal::mavlink(data);
    let mut line = Vec::new();
    for part in bytes.chunks(61) {
        line.extend_from_slice(part);
        take_frames(&mut line);
    }
    assert!(line.len() < 300, "{} bytes of a line are kept; expected less than a frame", line.len());
    let mut core = Core::new(&LinkConfig::default(), true, 1, Store::new("/nonexistent".as_ref()));
    let mut now_ns = TICK_NS;
    for received in decode(&bytes).iter().take(400) {
        core.on_message(now_ns, received);
        now_ns += TICK_NS;
        let outputs = core.step(now_ns);
        assert!(outputs.messages.len() < 100, "{} messages to the autopilot in one tick", outputs.messages.len());
    }
    core.step(now_ns + 1_000 * TICK_NS);
    let state = core.state(now_ns);
    let vectors =
        [state.position_m, state.velocity_mps, state.body_rates_radps, state.gimbal_rates_radps, state.wind_mps];
    let rotations = [state.world_from_body_xyzw, state.world_from_gimbal_xyzw];
    let numbers = vectors.as_flattened().iter().chain(rotations.as_flattened());
    assert!(numbers.chain(&[state.battery_fraction]).all(|value| value.is_finite()), "{state:?}");
    assert!(state.battery_fraction <= 1.0, "a battery of {}", state.battery_fraction);
}

/// What the simulated vehicle tells in its first second and in the air, some datagrams each.
pub fn telemetry_seeds() -> Vec<Vec<u8>> {
    let Ok(mut vehicle) = Simulator::new(VehicleConfig::default(), 0) else { return Vec::new() };
    let mut seeds = Vec::new();
    for (at, order) in client_orders().iter().enumerate() {
        vehicle.receive(LinkId::Onboard, order, 0);
        let mut seed = Vec::new();
        for _ in 0..40 + 60 * at {
            vehicle.step();
            seed.extend(vehicle.take_datagrams().into_iter().flat_map(|(_, datagram)| datagram));
        }
        let from = seed.len().saturating_sub(3000);
        seeds.push(seed.split_off(from));
    }
    seeds
}

/// Datagrams to the simulated vehicle, a tick after each.
pub fn simulator(data: &[u8]) {
    let bytes = seal::mavlink(data);
    let Ok(mut vehicle) = Simulator::new(VehicleConfig::default(), 0) else { return };
    let (mut at, mut frames) = (0, 0);
    while at < bytes.len() && frames < 200 {
        // A datagram ends where the next frame begins.
        let next =
            bytes[at + 1..].iter().position(|&byte| byte == mavlink::MAV_STX_V2).map_or(bytes.len(), |n| at + 1 + n);
        // Payloads may hold that byte as well: every other datagram is longer.
        let end = if frames % 2 == 0 { next } else { (next + 40).min(bytes.len()) };
        vehicle.receive(if frames % 3 == 2 { LinkId::Ground } else { LinkId::Onboard }, &bytes[at..end], 0);
        vehicle.step();
        vehicle.take_datagrams();
        (at, frames) = (next, frames + 1);
    }
    vehicle.receive(LinkId::Onboard, &bytes, 0);
    for _ in 0..20 {
        vehicle.step();
    }
    vehicle.take_datagrams();
    let truth = vehicle.truth();
    assert!(
        truth.position_m.is_finite() && truth.velocity_mps.is_finite() && truth.world_from_gimbal.is_finite(),
        "the vehicle is at {}, {} m/s",
        truth.position_m,
        truth.velocity_mps
    );
}

/// What clients say to fly, one after the other and each alone.
pub fn client_seeds() -> Vec<Vec<u8>> {
    let orders = client_orders();
    let mut seeds = vec![orders.concat()];
    seeds.extend(orders);
    seeds
}

fn client_orders() -> Vec<Vec<u8>> {
    let command = |command, param1, param2, param7| {
        MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
            param1,
            param2,
            param7,
            command,
            target_system: 1,
            target_component: 1,
            ..Default::default()
        })
    };
    let setpoint = MavMessage::SET_POSITION_TARGET_LOCAL_NED(SET_POSITION_TARGET_LOCAL_NED_DATA {
        x: 1.0,
        z: -2.5,
        type_mask: PositionTargetTypemask::from_bits_retain(0b1101_1111_1000),
        target_system: 1,
        target_component: 1,
        coordinate_frame: MavFrame::MAV_FRAME_LOCAL_NED,
        ..Default::default()
    });
    let mut param_id = [0; 16];
    param_id[..12].copy_from_slice(b"MPC_XY_VEL_M");
    let messages = [
        MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            mavtype: MavType::MAV_TYPE_GCS,
            autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
            ..Default::default()
        }),
        MavMessage::TIMESYNC(TIMESYNC_DATA { ts1: 5_000_000, ..Default::default() }),
        command(MavCmd::MAV_CMD_REQUEST_MESSAGE, 148.0, 0.0, 0.0),
        command(MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL, 32.0, 20_000.0, 0.0),
        setpoint.clone(),
        command(MavCmd::MAV_CMD_DO_SET_MODE, 1.0, 6.0, 0.0),
        command(MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, 1.0, 0.0, 0.0),
        command(MavCmd::MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 492.0),
        setpoint,
        MavMessage::PARAM_SET(PARAM_SET_DATA {
            param_value: 3.0,
            target_system: 1,
            target_component: 1,
            param_id: mavlink::types::CharArray::new(param_id),
            ..Default::default()
        }),
        command(MavCmd::MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW, -30.0, 0.0, 0.0),
        MavMessage::MANUAL_CONTROL(MANUAL_CONTROL_DATA {
            target: 1,
            x: 500,
            y: -500,
            z: 600,
            r: 1000,
            ..Default::default()
        }),
    ];
    messages.iter().zip(0..).map(|(message, sequence)| encode(255, sequence, message)).collect()
}
