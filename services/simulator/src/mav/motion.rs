//! Messages of where the vehicle is and how it moves.

use glam::DVec3;
use mavlink::dialects::common::*;

use super::telemetry::{floats, pressure_hpa, throttle, wire};
use crate::control::GRAVITY_MPS2;
use crate::frames::{euler_of, yaw_of};
use crate::vehicle::Vehicle;

pub(super) fn attitude(vehicle: &Vehicle, time_boot_ms: u32) -> MavMessage {
    let estimate = vehicle.estimate();
    let (roll, pitch, yaw) = euler_of(estimate.ned_from_frd);
    let [rollspeed, pitchspeed, yawspeed] = floats(estimate.rates_radps);
    MavMessage::ATTITUDE(ATTITUDE_DATA {
        time_boot_ms,
        roll: roll as f32,
        pitch: pitch as f32,
        yaw: yaw as f32,
        rollspeed,
        pitchspeed,
        yawspeed,
    })
}

pub(super) fn attitude_quaternion(vehicle: &Vehicle, time_boot_ms: u32) -> MavMessage {
    let [q1, q2, q3, q4] = wire(vehicle.estimate().ned_from_frd);
    let [rollspeed, pitchspeed, yawspeed] = floats(vehicle.estimate().rates_radps);
    MavMessage::ATTITUDE_QUATERNION(ATTITUDE_QUATERNION_DATA {
        time_boot_ms,
        q1,
        q2,
        q3,
        q4,
        rollspeed,
        pitchspeed,
        yawspeed,
        repr_offset_q: [1.0, 0.0, 0.0, 0.0],
    })
}

pub(super) fn local_position(vehicle: &Vehicle, time_boot_ms: u32) -> MavMessage {
    let [x, y, z] = floats(vehicle.estimate().position_m);
    let [vx, vy, vz] = floats(vehicle.estimate().velocity_mps);
    MavMessage::LOCAL_POSITION_NED(LOCAL_POSITION_NED_DATA { time_boot_ms, x, y, z, vx, vy, vz })
}

pub(super) fn global_position(vehicle: &Vehicle, time_boot_ms: u32) -> MavMessage {
    let estimate = vehicle.estimate();
    let (lat, lon, alt) = vehicle.global(estimate.position_m);
    let home_z = vehicle.autopilot.home().map_or(0.0, |h| h.position_m.z);
    let [vx, vy, vz] = estimate.velocity_mps.to_array().map(|v| (v * 100.0) as i16);
    MavMessage::GLOBAL_POSITION_INT(GLOBAL_POSITION_INT_DATA {
        time_boot_ms,
        lat,
        lon,
        alt,
        relative_alt: ((home_z - estimate.position_m.z) * 1e3).round() as i32,
        vx,
        vy,
        vz,
        hdg: (yaw_of(estimate.ned_from_frd).to_degrees().rem_euclid(360.0) * 100.0) as u16,
    })
}

pub(super) fn attitude_target(vehicle: &Vehicle, time_boot_ms: u32) -> MavMessage {
    MavMessage::ATTITUDE_TARGET(ATTITUDE_TARGET_DATA {
        time_boot_ms,
        q: wire(vehicle.estimate().ned_from_frd),
        thrust: throttle(vehicle) as f32,
        ..Default::default()
    })
}

pub(super) fn position_target(vehicle: &Vehicle, time_boot_ms: u32) -> MavMessage {
    let setpoint = vehicle.autopilot.order().setpoint;
    let [x, y, z] = floats(setpoint.position_m);
    let [vx, vy, vz] = floats(setpoint.velocity_mps);
    let [afx, afy, afz] = floats(setpoint.acceleration_mps2);
    MavMessage::POSITION_TARGET_LOCAL_NED(POSITION_TARGET_LOCAL_NED_DATA {
        time_boot_ms,
        x,
        y,
        z,
        vx,
        vy,
        vz,
        afx,
        afy,
        afz,
        yaw: setpoint.yaw_rad as f32,
        yaw_rate: setpoint.yaw_rate_radps as f32,
        type_mask: PositionTargetTypemask::empty(),
        coordinate_frame: MavFrame::MAV_FRAME_LOCAL_NED,
    })
}

pub(super) fn highres_imu(vehicle: &Vehicle, time_usec: u64) -> MavMessage {
    let body = vehicle.body();
    // What an accelerometer feels: everything but gravity, in the body's axes.
    let felt = body.ned_from_frd.inverse() * (body.acceleration_mps2 - DVec3::Z * GRAVITY_MPS2);
    let field = body.ned_from_frd.inverse() * DVec3::new(0.215, 0.01, 0.427);
    let [xacc, yacc, zacc] = floats(felt);
    let [xgyro, ygyro, zgyro] = floats(body.rates_radps);
    let [xmag, ymag, zmag] = floats(field);
    MavMessage::HIGHRES_IMU(HIGHRES_IMU_DATA {
        time_usec,
        xacc,
        yacc,
        zacc,
        xgyro,
        ygyro,
        zgyro,
        xmag,
        ymag,
        zmag,
        abs_pressure: pressure_hpa(vehicle) as f32,
        diff_pressure: 0.0,
        pressure_alt: (f64::from(vehicle.origin().2) * 1e-3 - body.position_m.z) as f32,
        temperature: 25.0,
        fields_updated: HighresImuUpdatedFlags::from_bits_retain(0x1fff),
        id: 0,
    })
}

pub(super) fn distance(vehicle: &Vehicle, time_boot_ms: u32) -> MavMessage {
    MavMessage::DISTANCE_SENSOR(DISTANCE_SENSOR_DATA {
        time_boot_ms,
        min_distance: 1,
        max_distance: 5000,
        current_distance: (vehicle.body().height_m() * 100.0).clamp(1.0, 5000.0) as u16,
        mavtype: MavDistanceSensor::MAV_DISTANCE_SENSOR_LASER,
        orientation: MavSensorOrientation::MAV_SENSOR_ROTATION_PITCH_270,
        signal_quality: 100,
        ..Default::default()
    })
}

pub(super) fn altitude(vehicle: &Vehicle, time_usec: u64) -> MavMessage {
    let up = -vehicle.estimate().position_m.z;
    let amsl = f64::from(vehicle.origin().2) * 1e-3 + up;
    let home_z = vehicle.autopilot.home().map_or(0.0, |h| h.position_m.z);
    MavMessage::ALTITUDE(ALTITUDE_DATA {
        time_usec,
        altitude_monotonic: amsl as f32,
        altitude_amsl: amsl as f32,
        altitude_local: up as f32,
        altitude_relative: (home_z + up) as f32,
        altitude_terrain: f32::NAN,
        bottom_clearance: vehicle.body().height_m() as f32,
    })
}

pub(super) fn odometry(vehicle: &Vehicle, time_usec: u64) -> MavMessage {
    let estimate = vehicle.estimate();
    let [x, y, z] = floats(estimate.position_m);
    let [vx, vy, vz] = floats(estimate.velocity_mps);
    let [rollspeed, pitchspeed, yawspeed] = floats(estimate.rates_radps);
    MavMessage::ODOMETRY(ODOMETRY_DATA {
        time_usec,
        x,
        y,
        z,
        q: wire(estimate.ned_from_frd),
        vx,
        vy,
        vz,
        rollspeed,
        pitchspeed,
        yawspeed,
        pose_covariance: [f32::NAN; 21],
        velocity_covariance: [f32::NAN; 21],
        frame_id: MavFrame::MAV_FRAME_LOCAL_NED,
        // PX4 gives the velocities in NED, and says so here.
        child_frame_id: MavFrame::MAV_FRAME_LOCAL_NED,
        reset_counter: estimate.reset_counter,
        estimator_type: MavEstimatorType::MAV_ESTIMATOR_TYPE_AUTOPILOT,
        quality: 0,
    })
}
