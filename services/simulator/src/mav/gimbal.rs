//! Messages of the gimbal protocol v2.

use glam::DQuat;
use mavlink::dialects::common::*;
use mavlink::types::CharArray;

use super::telemetry::wire;
use crate::frames::yaw_of;
use crate::gimbal::Gimbal;
use crate::vehicle::Vehicle;

/// What GIMBAL_MANAGER_INFORMATION says it can do: PX4's value for a pitch-and-yaw gimbal.
const GIMBAL_CAPABILITIES: u32 = 132_530;
/// The gimbal's device id: below 7, so the autopilot speaks for it.
pub const GIMBAL_DEVICE_ID: u8 = 1;

fn padded<const N: usize>(text: &str) -> CharArray<N> {
    let mut bytes = [0u8; N];
    for (to, from) in bytes.iter_mut().zip(text.bytes()) {
        *to = from;
    }
    CharArray::new(bytes)
}

pub(super) fn gimbal_manager_information(vehicle: &Vehicle, time_boot_ms: u32) -> MavMessage {
    let (low, high) = Gimbal::pitch_range_rad(&vehicle.params);
    MavMessage::GIMBAL_MANAGER_INFORMATION(GIMBAL_MANAGER_INFORMATION_DATA {
        time_boot_ms,
        cap_flags: GimbalManagerCapFlags::from_bits_retain(GIMBAL_CAPABILITIES),
        roll_min: 0.0,
        roll_max: 0.0,
        pitch_min: low as f32,
        pitch_max: high as f32,
        yaw_min: -core::f32::consts::PI,
        yaw_max: core::f32::consts::PI,
        gimbal_device_id: GIMBAL_DEVICE_ID,
    })
}

pub(super) fn gimbal_manager_status(vehicle: &Vehicle, time_boot_ms: u32) -> MavMessage {
    let (primary, secondary) = (vehicle.gimbal.primary(), vehicle.gimbal.secondary());
    MavMessage::GIMBAL_MANAGER_STATUS(GIMBAL_MANAGER_STATUS_DATA {
        time_boot_ms,
        flags: GimbalManagerFlags::from_bits_retain(u32::from(vehicle.gimbal.flags())),
        gimbal_device_id: GIMBAL_DEVICE_ID,
        primary_control_sysid: primary.0,
        primary_control_compid: primary.1,
        secondary_control_sysid: secondary.0,
        secondary_control_compid: secondary.1,
    })
}

pub(super) fn gimbal_device_information(vehicle: &Vehicle, time_boot_ms: u32) -> MavMessage {
    let (low, high) = Gimbal::pitch_range_rad(&vehicle.params);
    MavMessage::GIMBAL_DEVICE_INFORMATION(GIMBAL_DEVICE_INFORMATION_DATA {
        time_boot_ms,
        pitch_min: low as f32,
        pitch_max: high as f32,
        yaw_min: -core::f32::consts::PI,
        yaw_max: core::f32::consts::PI,
        // Neutral, roll axis and lock, pitch axis and lock, yaw axis, follow and lock.
        cap_flags: GimbalDeviceCapFlagsU16::from_bits_retain(0x07b6),
        vendor_name: padded("Vantage"),
        model_name: padded("simulated"),
        gimbal_device_id: GIMBAL_DEVICE_ID,
        ..Default::default()
    })
}

pub(super) fn gimbal_attitude(vehicle: &Vehicle, time_boot_ms: u32) -> MavMessage {
    let believed = vehicle.believed_payload();
    // Against the vehicle's heading while it follows, against north while it is locked; the flags say which.
    let q = if vehicle.gimbal.yaw_lock() {
        believed
    } else {
        DQuat::from_rotation_z(-yaw_of(vehicle.estimate().ned_from_frd)) * believed
    };
    let (pitch_rate, yaw_rate) = vehicle.gimbal.rates_radps();
    MavMessage::GIMBAL_DEVICE_ATTITUDE_STATUS(GIMBAL_DEVICE_ATTITUDE_STATUS_DATA {
        time_boot_ms,
        q: wire(q),
        angular_velocity_x: 0.0,
        angular_velocity_y: pitch_rate as f32,
        angular_velocity_z: yaw_rate as f32,
        failure_flags: GimbalDeviceErrorFlags::empty(),
        flags: GimbalDeviceFlags::from_bits_retain(vehicle.gimbal.flags()),
        target_system: 0,
        target_component: 0,
        delta_yaw: f32::NAN,
        delta_yaw_velocity: f32::NAN,
        gimbal_device_id: GIMBAL_DEVICE_ID,
    })
}
