//! The vehicle's messages, built from its state. One function per message; the ids are the dialect's.

use glam::{DQuat, DVec3};
use mavlink::dialects::common::*;

use super::{gimbal, motion};
use crate::battery::Charge;
use crate::control::{GRAVITY_MPS2, THRUST_TO_WEIGHT};
use crate::frames::yaw_of;
use crate::modes::Mode;
use crate::vehicle::Vehicle;

/// Version 1.18.0, beta; and what PX4 says it can do.
const FLIGHT_SW_VERSION: u32 = 0x0112_0080;
const CAPABILITIES: u64 = 0xe8ff;
const SENSORS_PRESENT: u32 = 0x0300_c02f;
const SENSORS_ENABLED: u32 = 0x0301_c02f;
const SENSORS_HEALTH: u32 = 0x0320_c83f;
const PREARM_CHECK: u32 = 0x1000_0000;
/// Unix time of boot, microseconds: fixed, so that a seed gives the same bytes.
const BOOT_UNIX_US: u64 = 1_767_225_600_000_000;

/// Counters of the link that LINK_NODE_STATUS and PING report.
#[derive(Debug, Clone, Copy, Default)]
pub struct LinkCounters {
    /// Messages sent.
    pub sent: u32,
    /// Messages read.
    pub received: u32,
    /// PINGs sent.
    pub pings: u32,
}

/// The message of an id; `None` where the vehicle has nothing to say (no home yet, an id it does not send).
#[must_use]
pub fn message(vehicle: &Vehicle, id: u32, counters: &LinkCounters) -> Option<MavMessage> {
    let us = vehicle.boot_ns() / 1000;
    let ms = (us / 1000) as u32;
    Some(match id {
        0 => heartbeat(vehicle),
        1 => sys_status(vehicle),
        2 => MavMessage::SYSTEM_TIME(SYSTEM_TIME_DATA { time_unix_usec: BOOT_UNIX_US + us, time_boot_ms: ms }),
        4 => crate::mav::ping::message(us, counters.pings, (0, 0)),
        8 => MavMessage::LINK_NODE_STATUS(LINK_NODE_STATUS_DATA {
            timestamp: us / 1000,
            messages_sent: counters.sent,
            messages_received: counters.received,
            ..Default::default()
        }),
        24 => gps_raw(vehicle, us),
        29 => MavMessage::SCALED_PRESSURE(SCALED_PRESSURE_DATA {
            time_boot_ms: ms,
            press_abs: pressure_hpa(vehicle) as f32,
            temperature: 2500,
            ..Default::default()
        }),
        30 => motion::attitude(vehicle, ms),
        31 => motion::attitude_quaternion(vehicle, ms),
        32 => motion::local_position(vehicle, ms),
        33 => motion::global_position(vehicle, ms),
        36 => servo_output(vehicle, us),
        42 => MavMessage::MISSION_CURRENT(MISSION_CURRENT_DATA {
            total: 0,
            mission_state: MissionState::MISSION_STATE_NO_MISSION,
            ..Default::default()
        }),
        49 => {
            let (latitude, longitude, altitude) = vehicle.origin();
            MavMessage::GPS_GLOBAL_ORIGIN(GPS_GLOBAL_ORIGIN_DATA { latitude, longitude, altitude, time_usec: us })
        }
        74 => vfr_hud(vehicle),
        83 => motion::attitude_target(vehicle, ms),
        85 => motion::position_target(vehicle, ms),
        105 => motion::highres_imu(vehicle, us),
        111 => {
            MavMessage::TIMESYNC(TIMESYNC_DATA { tc1: 0, ts1: vehicle.boot_ns().cast_signed(), ..Default::default() })
        }
        132 => motion::distance(vehicle, ms),
        141 => motion::altitude(vehicle, us),
        147 => battery_status(vehicle),
        148 => version(),
        230 => estimator_status(us),
        231 => wind(vehicle, us),
        241 => MavMessage::VIBRATION(VIBRATION_DATA { time_usec: us, ..Default::default() }),
        242 => return home_position(vehicle, us),
        245 => MavMessage::EXTENDED_SYS_STATE(EXTENDED_SYS_STATE_DATA {
            vtol_state: MavVtolState::MAV_VTOL_STATE_UNDEFINED,
            landed_state: landed_state(vehicle.autopilot.landed_state()),
        }),
        280 => gimbal::gimbal_manager_information(vehicle, ms),
        281 => gimbal::gimbal_manager_status(vehicle, ms),
        283 => gimbal::gimbal_device_information(vehicle, ms),
        285 => gimbal::gimbal_attitude(vehicle, ms),
        290 => MavMessage::ESC_INFO(ESC_INFO_DATA {
            time_usec: us,
            count: 4,
            connection_type: EscConnectionType::ESC_CONNECTION_TYPE_DSHOT,
            info: if vehicle.autopilot.armed() { 0b1111 } else { 0 },
            ..Default::default()
        }),
        291 => esc_status(vehicle, us),
        331 => motion::odometry(vehicle, us),
        411 => MavMessage::CURRENT_EVENT_SEQUENCE(CURRENT_EVENT_SEQUENCE_DATA {
            sequence: 0,
            flags: MavEventCurrentSequenceFlags::empty(),
        }),
        436 => MavMessage::CURRENT_MODE(CURRENT_MODE_DATA {
            custom_mode: vehicle.autopilot.mode().custom_mode(),
            intended_custom_mode: vehicle.autopilot.intended_mode().custom_mode(),
            standard_mode: standard_mode(vehicle.autopilot.mode()),
        }),
        _ => return None,
    })
}

pub(super) fn wire(q: DQuat) -> [f32; 4] {
    // Of the two quaternions of a rotation, the one with a positive w, as PX4 sends it.
    let q = if q.w < 0.0 { -q } else { q };
    [q.w as f32, q.x as f32, q.y as f32, q.z as f32]
}

pub(super) fn floats(v: DVec3) -> [f32; 3] {
    v.to_array().map(|x| x as f32)
}

fn heartbeat(vehicle: &Vehicle) -> MavMessage {
    let autopilot = &vehicle.autopilot;
    let armed = if autopilot.armed() { MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED } else { MavModeFlag::empty() };
    let system_status = if autopilot.terminated() {
        MavState::MAV_STATE_FLIGHT_TERMINATION
    } else if autopilot.in_failsafe() {
        MavState::MAV_STATE_CRITICAL
    } else if autopilot.armed() {
        MavState::MAV_STATE_ACTIVE
    } else if autopilot.can_arm(&vehicle.params) {
        MavState::MAV_STATE_STANDBY
    } else {
        MavState::MAV_STATE_UNINIT
    };
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        custom_mode: autopilot.mode().custom_mode(),
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot: MavAutopilot::MAV_AUTOPILOT_PX4,
        base_mode: MavModeFlag::from_bits_retain(autopilot.mode().base_mode()) | armed,
        system_status,
        mavlink_version: 3,
    })
}

fn sys_status(vehicle: &Vehicle) -> MavMessage {
    let prearm = if vehicle.autopilot.can_arm(&vehicle.params) { PREARM_CHECK } else { 0 };
    // Position and local sensors are healthy once there is a home.
    let health = if vehicle.autopilot.home().is_some() { SENSORS_HEALTH } else { SENSORS_HEALTH & !0x20 };
    MavMessage::SYS_STATUS(SYS_STATUS_DATA {
        onboard_control_sensors_present: MavSysStatusSensor::from_bits_retain(SENSORS_PRESENT),
        onboard_control_sensors_enabled: MavSysStatusSensor::from_bits_retain(SENSORS_ENABLED | PREARM_CHECK),
        onboard_control_sensors_health: MavSysStatusSensor::from_bits_retain(health | prearm),
        load: 300,
        voltage_battery: (vehicle.battery.voltage_v() * 1e3) as u16,
        current_battery: -1,
        battery_remaining: percent(vehicle),
        ..Default::default()
    })
}

fn percent(vehicle: &Vehicle) -> i8 {
    (vehicle.battery.remaining() * 100.0).round() as i8
}

fn gps_raw(vehicle: &Vehicle, us: u64) -> MavMessage {
    let estimate = vehicle.estimate();
    let (lat, lon, alt) = vehicle.global(estimate.position_m);
    let v = estimate.velocity_mps;
    let course = v.y.atan2(v.x).to_degrees().rem_euclid(360.0);
    MavMessage::GPS_RAW_INT(GPS_RAW_INT_DATA {
        time_usec: us,
        lat,
        lon,
        alt,
        eph: 70,
        epv: 110,
        vel: (v.truncate().length() * 100.0) as u16,
        cog: (course * 100.0) as u16,
        fix_type: GpsFixType::GPS_FIX_TYPE_3D_FIX,
        satellites_visible: 14,
        alt_ellipsoid: alt,
        h_acc: 300,
        v_acc: 400,
        vel_acc: 200,
        ..Default::default()
    })
}

/// Thrust over the largest thrust, 0 to 1.
pub(super) fn throttle(vehicle: &Vehicle) -> f64 {
    if vehicle.autopilot.armed() {
        (vehicle.body().specific_force_mps2().length() / (GRAVITY_MPS2 * THRUST_TO_WEIGHT)).clamp(0.0, 1.0)
    } else {
        0.0
    }
}

fn servo_output(vehicle: &Vehicle, us: u64) -> MavMessage {
    let pulse = if vehicle.autopilot.armed() { 1100 + (throttle(vehicle) * 800.0) as u16 } else { 900 };
    MavMessage::SERVO_OUTPUT_RAW(SERVO_OUTPUT_RAW_DATA {
        time_usec: us as u32,
        servo1_raw: pulse,
        servo2_raw: pulse,
        servo3_raw: pulse,
        servo4_raw: pulse,
        ..Default::default()
    })
}

fn esc_status(vehicle: &Vehicle, us: u64) -> MavMessage {
    // Thrust grows with the square of the speed; 1000 rad/s is the motors' limit.
    let rpm = (throttle(vehicle).sqrt() * 1000.0 * 30.0 / core::f64::consts::PI) as i32;
    MavMessage::ESC_STATUS(ESC_STATUS_DATA {
        time_usec: us,
        rpm: [rpm; 4],
        voltage: [vehicle.battery.voltage_v() as f32; 4],
        current: [0.0; 4],
        index: 0,
    })
}

fn vfr_hud(vehicle: &Vehicle) -> MavMessage {
    let estimate = vehicle.estimate();
    let (_, _, alt_mm) = vehicle.global(estimate.position_m);
    MavMessage::VFR_HUD(VFR_HUD_DATA {
        airspeed: 0.0,
        groundspeed: estimate.velocity_mps.truncate().length() as f32,
        alt: (f64::from(alt_mm) * 1e-3) as f32,
        climb: -estimate.velocity_mps.z as f32,
        heading: yaw_of(estimate.ned_from_frd).to_degrees().rem_euclid(360.0) as i16,
        throttle: (throttle(vehicle) * 100.0) as u16,
    })
}

pub(super) fn pressure_hpa(vehicle: &Vehicle) -> f64 {
    let (_, _, alt_mm) = vehicle.global(vehicle.body().position_m);
    1013.25 * (1.0 - 2.255_77e-5 * f64::from(alt_mm) * 1e-3).powf(5.255_88)
}

fn battery_status(vehicle: &Vehicle) -> MavMessage {
    let mut voltages = [u16::MAX; 10];
    for cell in voltages.iter_mut().take(vehicle.battery.cells()) {
        *cell = (vehicle.battery.cell_voltage_v() * 1e3) as u16;
    }
    MavMessage::BATTERY_STATUS(BATTERY_STATUS_DATA {
        current_consumed: -1,
        energy_consumed: -1,
        temperature: i16::MAX,
        voltages,
        current_battery: -1,
        battery_function: MavBatteryFunction::MAV_BATTERY_FUNCTION_ALL,
        mavtype: MavBatteryType::MAV_BATTERY_TYPE_LIPO,
        battery_remaining: percent(vehicle),
        charge_state: match vehicle.battery.charge(&vehicle.params) {
            Charge::Ok => MavBatteryChargeState::MAV_BATTERY_CHARGE_STATE_OK,
            Charge::Low => MavBatteryChargeState::MAV_BATTERY_CHARGE_STATE_LOW,
            Charge::Critical => MavBatteryChargeState::MAV_BATTERY_CHARGE_STATE_CRITICAL,
            Charge::Emergency => MavBatteryChargeState::MAV_BATTERY_CHARGE_STATE_EMERGENCY,
        },
        ..Default::default()
    })
}

fn version() -> MavMessage {
    MavMessage::AUTOPILOT_VERSION(AUTOPILOT_VERSION_DATA {
        capabilities: MavProtocolCapability::from_bits_retain(CAPABILITIES),
        uid: 0x5641_4e54_4147_4531,
        flight_sw_version: FLIGHT_SW_VERSION,
        middleware_sw_version: FLIGHT_SW_VERSION,
        ..Default::default()
    })
}

fn estimator_status(time_usec: u64) -> MavMessage {
    MavMessage::ESTIMATOR_STATUS(ESTIMATOR_STATUS_DATA {
        time_usec,
        vel_ratio: 0.05,
        pos_horiz_ratio: 0.05,
        pos_vert_ratio: 0.05,
        mag_ratio: 0.05,
        pos_horiz_accuracy: 0.3,
        pos_vert_accuracy: 0.4,
        // Attitude, velocities, relative and absolute positions, predictions of both.
        flags: EstimatorStatusFlags::from_bits_retain(0x33f),
        ..Default::default()
    })
}

fn wind(vehicle: &Vehicle, time_usec: u64) -> MavMessage {
    let [wind_x, wind_y, wind_z] = floats(vehicle.wind_mps());
    MavMessage::WIND_COV(WIND_COV_DATA { time_usec, wind_x, wind_y, wind_z, ..Default::default() })
}

fn home_position(vehicle: &Vehicle, time_usec: u64) -> Option<MavMessage> {
    let home = vehicle.autopilot.home()?;
    let (latitude, longitude, altitude) = vehicle.global(home.position_m);
    let [x, y, z] = floats(home.position_m);
    Some(MavMessage::HOME_POSITION(HOME_POSITION_DATA {
        latitude,
        longitude,
        altitude,
        x,
        y,
        z,
        q: wire(DQuat::from_rotation_z(home.yaw_rad)),
        approach_x: f32::NAN,
        approach_y: f32::NAN,
        approach_z: f32::NAN,
        time_usec,
    }))
}

fn landed_state(code: u8) -> MavLandedState {
    match code {
        1 => MavLandedState::MAV_LANDED_STATE_ON_GROUND,
        3 => MavLandedState::MAV_LANDED_STATE_TAKEOFF,
        4 => MavLandedState::MAV_LANDED_STATE_LANDING,
        _ => MavLandedState::MAV_LANDED_STATE_IN_AIR,
    }
}

fn standard_mode(mode: Mode) -> MavStandardMode {
    match mode {
        Mode::Posctl => MavStandardMode::MAV_STANDARD_MODE_POSITION_HOLD,
        Mode::Altctl => MavStandardMode::MAV_STANDARD_MODE_ALTITUDE_HOLD,
        Mode::AutoRtl => MavStandardMode::MAV_STANDARD_MODE_SAFE_RECOVERY,
        Mode::AutoLand => MavStandardMode::MAV_STANDARD_MODE_LAND,
        Mode::AutoTakeoff => MavStandardMode::MAV_STANDARD_MODE_TAKEOFF,
        _ => MavStandardMode::MAV_STANDARD_MODE_NON_STANDARD,
    }
}
