//! The messages that px4-link sends.

use mavlink::dialects::common::{
    COMMAND_LONG_DATA, HEARTBEAT_DATA, MavAutopilot, MavCmd, MavFrame, MavMessage, MavModeFlag, MavState, MavType,
    PositionTargetTypemask, SET_POSITION_TARGET_LOCAL_NED_DATA, TIMESYNC_DATA,
};

use super::Core;
use crate::frames::{swap_ned_enu, swap_yaw};
use crate::stream::ToSend;

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

impl Core {
    pub(super) fn beat(&mut self, now_ns: u64) {
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
}
