//! What clients say, read from frames.

use glam::{DQuat, DVec3};
use mavlink::dialects::common::MavMessage;

use crate::control::MotionSetpoint;
use crate::mav::codec::Frame;
use crate::mav::ping;

const COMMAND_INT: u32 = 75;
const COMMAND_LONG: u32 = 76;
const TYPE_GCS: u8 = 6;
const FRAME_LOCAL_NED: u8 = 1;
const FRAME_BODY_NED: u8 = 8;
const FORCE_SET: u16 = 512;

/// A command, of COMMAND_LONG or COMMAND_INT.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Command {
    /// MAV_CMD.
    pub id: u16,
    /// The seven parameters; x and y of COMMAND_INT as numbers.
    pub params: [f32; 7],
}

/// What a frame says.
#[derive(Debug, Clone, PartialEq)]
pub enum Inbound {
    /// A heartbeat.
    Heartbeat {
        /// Of a ground station (MAV_TYPE_GCS).
        gcs: bool,
    },
    /// A command.
    Command(Command),
    /// A setpoint; `Err` says why it is dropped.
    Setpoint(Result<(MotionSetpoint, bool), &'static str>),
    /// The gimbal's attitude (message 282): quaternion, rates (pitch, yaw) and whether yaw is locked.
    GimbalAttitude(DQuat, (f64, f64), bool),
    /// Read a parameter by name, or by index where it is not negative.
    ParamRead(String, i16),
    /// Read all parameters.
    ParamList,
    /// Set a parameter: name, value on the wire, type code.
    ParamSet(String, f32, u8),
    /// TIMESYNC: tc1 and ts1.
    Timesync(i64, i64),
    /// PING to everyone: time and sequence.
    Ping(u64, u32),
    /// A pilot's sticks.
    Sticks([f64; 4]),
    /// Asks for the list of a mission type.
    MissionList(mavlink::dialects::common::MavMissionType),
}

/// Reads a frame that is meant for a vehicle; `None` for what it ignores.
#[must_use]
pub fn read(frame: &Frame<'_>, system_id: u8) -> Option<Inbound> {
    // Where a message names a target, it must be this system's autopilot or everyone.
    let ours = |system: u8, component: u8| (system == system_id || system == 0) && component <= 1;
    match frame.message_id {
        COMMAND_LONG => return long(frame, ours),
        COMMAND_INT => return int(frame, ours),
        _ => {}
    }
    Some(match frame.message()? {
        MavMessage::HEARTBEAT(m) => Inbound::Heartbeat { gcs: m.mavtype as u8 == TYPE_GCS },
        MavMessage::SET_POSITION_TARGET_LOCAL_NED(m) if ours(m.target_system, m.target_component) => {
            Inbound::Setpoint(setpoint(&m))
        }
        MavMessage::GIMBAL_MANAGER_SET_ATTITUDE(m) if ours(m.target_system, m.target_component) => {
            let [w, x, y, z] = m.q.map(f64::from);
            Inbound::GimbalAttitude(
                DQuat::from_xyzw(x, y, z, w),
                (f64::from(m.angular_velocity_y), f64::from(m.angular_velocity_z)),
                m.flags.bits() & u32::from(crate::gimbal::flags::YAW_LOCK) != 0,
            )
        }
        MavMessage::PARAM_REQUEST_READ(m) if ours(m.target_system, m.target_component) => {
            Inbound::ParamRead(text(&m.param_id), m.param_index)
        }
        MavMessage::PARAM_REQUEST_LIST(m) if ours(m.target_system, m.target_component) => Inbound::ParamList,
        MavMessage::PARAM_SET(m) if ours(m.target_system, m.target_component) => {
            Inbound::ParamSet(text(&m.param_id), m.param_value, m.param_type as u8)
        }
        MavMessage::TIMESYNC(m) => Inbound::Timesync(m.tc1, m.ts1),
        MavMessage::MANUAL_CONTROL(m) if m.target == system_id => {
            let axis = |v: i16| f64::from(v.clamp(-1000, 1000)) / 1000.0;
            // Throttle is 0 to 1000 with rest at 500.
            Inbound::Sticks([axis(m.x), axis(m.y), (axis(m.z) - 0.5) * 2.0, axis(m.r)])
        }
        MavMessage::MISSION_REQUEST_LIST(m) if ours(m.target_system, m.target_component) => {
            Inbound::MissionList(m.mission_type)
        }
        other => {
            let (time_usec, seq) = ping::asked(&other)?;
            Inbound::Ping(time_usec, seq)
        }
    })
}

fn text<const N: usize>(id: &mavlink::types::CharArray<N>) -> String {
    id.to_str().unwrap_or("").trim_end_matches('\0').to_owned()
}

fn real(bytes: &[u8], at: usize) -> f32 {
    bytes.get(at..at + 4).and_then(|b| b.first_chunk::<4>()).map_or(f32::NAN, |b| f32::from_le_bytes(*b))
}

fn long(frame: &Frame<'_>, ours: impl Fn(u8, u8) -> bool) -> Option<Inbound> {
    let bytes = frame.padded::<33>();
    if !ours(bytes[30], bytes[31]) {
        return None;
    }
    let params = core::array::from_fn(|i| real(&bytes, 4 * i));
    Some(Inbound::Command(Command { id: u16::from_le_bytes([bytes[28], bytes[29]]), params }))
}

fn int(frame: &Frame<'_>, ours: impl Fn(u8, u8) -> bool) -> Option<Inbound> {
    let bytes = frame.padded::<35>();
    if !ours(bytes[30], bytes[31]) {
        return None;
    }
    let whole = |at: usize| {
        let value = i32::from_le_bytes(real(&bytes, at).to_le_bytes());
        // i32::MAX is COMMAND_INT's "not given".
        if value == i32::MAX { f32::NAN } else { value as f32 }
    };
    let params =
        [real(&bytes, 0), real(&bytes, 4), real(&bytes, 8), real(&bytes, 12), whole(16), whole(20), real(&bytes, 24)];
    Some(Inbound::Command(Command { id: u16::from_le_bytes([bytes[28], bytes[29]]), params }))
}

fn setpoint(
    m: &mavlink::dialects::common::SET_POSITION_TARGET_LOCAL_NED_DATA,
) -> Result<(MotionSetpoint, bool), &'static str> {
    let mask = m.type_mask.bits();
    let frame = m.coordinate_frame as u8;
    let in_body = match frame {
        FRAME_LOCAL_NED => false,
        FRAME_BODY_NED => true,
        _ => return Err("SET_POSITION_TARGET_LOCAL_NED: coordinate frame unsupported"),
    };
    if mask & FORCE_SET != 0 {
        return Err("SET_POSITION_TARGET_LOCAL_NED: force setpoint unsupported");
    }
    let take = |bit: u16, value: f32| {
        if mask & (1 << bit) != 0 || !value.is_finite() { f64::NAN } else { f64::from(value) }
    };
    let position = DVec3::new(take(0, m.x), take(1, m.y), take(2, m.z));
    let setpoint = MotionSetpoint {
        // PX4 takes velocity and acceleration in the body frame, positions only in the local one.
        position_m: if in_body { DVec3::NAN } else { position },
        velocity_mps: DVec3::new(take(3, m.vx), take(4, m.vy), take(5, m.vz)),
        acceleration_mps2: DVec3::new(take(6, m.afx), take(7, m.afy), take(8, m.afz)),
        yaw_rad: take(10, m.yaw),
        yaw_rate_radps: take(11, m.yaw_rate),
    };
    if setpoint.is_empty() {
        return Err("SET_POSITION_TARGET_LOCAL_NED: invalid setpoint");
    }
    Ok((setpoint, in_body))
}
