//! The gimbal: manager protocol v2 with the autopilot as manager.
//!
//! Control is taken by MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE before the first demand, and again after a denial; demands are
//! MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW at 5 Hz at most. Attitudes come with yaw in the vehicle's frame or the earth's; in the
//! vehicle's it is resolved with the vehicle's yaw at the gimbal's own stamp. Without a gimbal the camera is fixed.

use glam::{DQuat, DVec3};
use mavlink::dialects::common::{GIMBAL_DEVICE_ATTITUDE_STATUS_DATA, GIMBAL_MANAGER_INFORMATION_DATA, MavCmd};

use crate::frames::{enu_from_flu, quaternion, swap_yaw, yaw_of};
use crate::telemetry::Telemetry;

const YAW_LOCK: u16 = 16;
const YAW_IN_VEHICLE: u16 = 32;
const YAW_IN_EARTH: u16 = 64;
/// Roll and pitch relative to the horizon.
const DEMAND_FLAGS: f32 = 12.0;
/// No gimbal's limits are wider.
const FULL_TURN_RAD: f64 = core::f64::consts::TAU;
/// Least time between two attitudes from which a rate is taken, seconds.
const LEAST_BETWEEN_S: f64 = 1e-3;
const PERIOD_NS: u64 = 200_000_000;
const REFRESH_NS: u64 = 2_000_000_000;
/// Time without an answer, after everything else was answered, after which there is no gimbal.
const PATIENCE_NS: u64 = 5_000_000_000;

/// What is said where no gimbal answers.
pub const NO_GIMBAL: &str = "no gimbal answers (MNT_MODE_IN = 4?): the camera is taken as fixed to the body";

/// The gimbal as far as it is known.
#[derive(Debug, Clone, Default)]
pub struct Gimbal {
    /// Lowest and highest pitch, radians, positive up; `None` until one answered.
    pub limits_rad: Option<(f64, f64)>,
    device: u8,
    /// World from the payload (FLU), with its mission time; stamp 0: never heard.
    pub world_from_gimbal: DQuat,
    /// Mission time of the attitude.
    pub stamp_ns: u64,
    /// Angular rate in the world, rad/s.
    pub rates_radps: DVec3,
    controlled: bool,
    last_pitch_rad: f64,
    last_sent_ns: Option<u64>,
    asked_ns: Option<u64>,
    warned: bool,
}

impl Gimbal {
    /// Whether one answered.
    #[must_use]
    pub fn present(&self) -> bool {
        self.limits_rad.is_some()
    }

    /// Whether it is settled that there is none.
    #[must_use]
    pub fn absent(&self, now_ns: u64, synced_ns: Option<u64>) -> bool {
        !self.present() && synced_ns.is_some_and(|synced_ns| now_ns.saturating_sub(synced_ns) >= PATIENCE_NS)
    }

    /// The command that asks whether there is one, every five seconds. Its absence is said once.
    pub fn ask(&mut self, now_ns: u64, synced_ns: u64) -> Option<(MavCmd, [f32; 7])> {
        if !self.warned && self.absent(now_ns, Some(synced_ns)) {
            self.warned = true;
            tracing::warn!("{NO_GIMBAL}");
        }
        if self.asked_ns.is_some_and(|asked_ns| now_ns < asked_ns + PATIENCE_NS) {
            return None;
        }
        self.asked_ns = Some(now_ns);
        let mut params = [f32::NAN; 7];
        params[0] = 280.0;
        Some((MavCmd::MAV_CMD_REQUEST_MESSAGE, params))
    }

    /// Takes the manager's description.
    pub fn information(&mut self, message: &GIMBAL_MANAGER_INFORMATION_DATA) {
        let (low, high) = (f64::from(message.pitch_min), f64::from(message.pitch_max));
        if low < high && low >= -FULL_TURN_RAD && high <= FULL_TURN_RAD {
            self.limits_rad = Some((low, high));
            self.device = message.gimbal_device_id;
        }
    }

    /// Takes an attitude that was heard with the mission time `stamp_ns`.
    pub fn attitude(&mut self, stamp_ns: u64, message: &GIMBAL_DEVICE_ATTITUDE_STATUS_DATA, vehicle: &Telemetry) {
        let flags = message.flags.bits();
        let in_vehicle = flags & YAW_IN_VEHICLE != 0 || (flags & YAW_IN_EARTH == 0 && flags & YAW_LOCK == 0);
        let Some(q) = quaternion(message.q) else { return };
        let ned_from_gimbal = if in_vehicle {
            let Some(world_from_body) = vehicle.attitude_at(stamp_ns) else { return };
            DQuat::from_rotation_z(swap_yaw(yaw_of(world_from_body))) * q
        } else {
            q
        };
        let world_from_gimbal = enu_from_flu(ned_from_gimbal);
        if self.stamp_ns != 0 && stamp_ns > self.stamp_ns {
            let mut turn = world_from_gimbal * self.world_from_gimbal.conjugate();
            if turn.w < 0.0 {
                turn = -turn;
            }
            #[expect(clippy::cast_precision_loss, reason = "milliseconds")]
            let dt_s = (stamp_ns - self.stamp_ns) as f64 * 1e-9;
            // Two stamps that are almost the same say nothing about a rate.
            if dt_s > LEAST_BETWEEN_S {
                self.rates_radps = if dt_s < 1.0 { turn.to_scaled_axis() / dt_s } else { DVec3::ZERO };
            }
        }
        if stamp_ns >= self.stamp_ns {
            self.world_from_gimbal = world_from_gimbal;
            self.stamp_ns = stamp_ns;
        }
    }

    /// Takes the manager's word on who has primary control.
    pub fn primary(&mut self, is_ours: bool) {
        self.controlled = is_ours;
    }

    /// Takes the answer to a demand.
    pub fn denied(&mut self) {
        self.controlled = false;
    }

    /// The command that brings the gimbal to a pitch, when one is due.
    pub fn demand(&mut self, now_ns: u64, pitch_rad: f64, own: (u8, u8)) -> Option<(MavCmd, [f32; 7])> {
        let (low, high) = self.limits_rad?;
        let since_ns = self.last_sent_ns.map_or(u64::MAX, |last| now_ns.saturating_sub(last));
        let pitch_rad = pitch_rad.clamp(low, high);
        let moved = (pitch_rad - self.last_pitch_rad).abs() > 1e-4;
        if since_ns < PERIOD_NS || (self.controlled && !moved && since_ns < REFRESH_NS) {
            return None;
        }
        self.last_sent_ns = Some(now_ns);
        if !self.controlled {
            // Taken for granted until a status or a denial says otherwise.
            self.controlled = true;
            self.last_pitch_rad = f64::NAN;
            self.last_sent_ns = None;
            let configure = [f32::from(own.0), f32::from(own.1), -1.0, -1.0, f32::NAN, f32::NAN, 0.0];
            return Some((MavCmd::MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE, configure));
        }
        self.last_pitch_rad = pitch_rad;
        #[expect(clippy::cast_possible_truncation, reason = "MAVLink speaks f32")]
        let pitch_deg = pitch_rad.to_degrees() as f32;
        let demand = [pitch_deg, 0.0, f32::NAN, f32::NAN, DEMAND_FLAGS, f32::NAN, f32::from(self.device)];
        Some((MavCmd::MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW, demand))
    }
}

#[cfg(test)]
mod tests {
    use core::f64::consts::FRAC_PI_2;

    use mavlink::dialects::common::GimbalDeviceFlags;

    use super::*;
    use crate::telemetry::AttitudeSample;

    fn status(q: DQuat, flags: u16) -> GIMBAL_DEVICE_ATTITUDE_STATUS_DATA {
        #[expect(clippy::cast_possible_truncation, reason = "MAVLink speaks f32")]
        let q = [q.w, q.x, q.y, q.z].map(|v| v as f32);
        GIMBAL_DEVICE_ATTITUDE_STATUS_DATA {
            q,
            flags: GimbalDeviceFlags::from_bits_retain(flags),
            ..Default::default()
        }
    }

    /// A vehicle that turned from north (NED yaw 0) to east (NED yaw 90 deg) between 0.1 s and 0.2 s.
    fn turning() -> Telemetry {
        let mut vehicle = Telemetry::default();
        for (stamp_ns, yaw) in [(100_000_000, 0.0), (200_000_000, FRAC_PI_2)] {
            vehicle
                .attitudes
                .push_back(AttitudeSample { stamp_ns, world_from_body: enu_from_flu(DQuat::from_rotation_z(yaw)) });
        }
        vehicle
    }

    #[test]
    fn both_conventions_of_yaw_end_in_the_world() {
        let down = DQuat::from_rotation_y(-0.5);
        let axis = |flags, q, stamp| {
            let mut gimbal = Gimbal::default();
            gimbal.attitude(stamp, &status(q, flags), &turning());
            gimbal.world_from_gimbal * DVec3::X
        };
        let north_down = DVec3::new(0.0, 0.5f64.cos(), -(0.5f64.sin()));
        let east_down = DVec3::new(0.5f64.cos(), 0.0, -(0.5f64.sin()));
        assert!((axis(YAW_IN_VEHICLE | 12, down, 100_000_000) - north_down).length() < 1e-6);
        assert!((axis(YAW_IN_VEHICLE | 12, down, 200_000_000) - east_down).length() < 1e-6);
        assert!((axis(12, down, 200_000_000) - east_down).length() < 1e-6, "neither flag: the vehicle's");
        assert!((axis(YAW_IN_EARTH | 12, down, 200_000_000) - north_down).length() < 1e-6);
        assert!((axis(YAW_LOCK | 12, down, 200_000_000) - north_down).length() < 1e-6, "locked yaw: the earth's");
        let between = axis(YAW_IN_VEHICLE, DQuat::IDENTITY, 150_000_000);
        assert!((between.x - between.y).abs() < 1e-6 && between.x > 0.7, "the yaw at the gimbal's own stamp");
    }

    #[test]
    fn control_is_taken_first_and_again_after_a_denial_and_demands_are_rare() {
        let mut gimbal = Gimbal::default();
        assert!(gimbal.demand(0, -0.5, (1, 191)).is_none() && !gimbal.absent(9_000_000_000, None));
        assert!(
            gimbal.absent(9_000_000_000, Some(4_000_000_000)) && !gimbal.absent(8_000_000_000, Some(4_000_000_000))
        );
        let asked = (0..1200).filter(|i| gimbal.ask(i * 10_000_000, 0).is_some()).count();
        assert!(asked == 3 && gimbal.warned, "{asked} in twelve seconds");
        gimbal.information(&GIMBAL_MANAGER_INFORMATION_DATA {
            pitch_min: -0.7,
            pitch_max: 0.7,
            gimbal_device_id: 1,
            ..Default::default()
        });
        let configure = |sent: Option<(MavCmd, [f32; 7])>| {
            sent.map(|(command, _)| command == MavCmd::MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE)
        };
        assert_eq!(configure(gimbal.demand(0, -1.5, (1, 191))), Some(true));
        let (_, demand) = gimbal.demand(10_000_000, -1.5, (1, 191)).expect("a demand");
        assert!((demand[0] + 0.7f32.to_degrees()).abs() < 1e-3 && demand[4] == 12.0 && demand[6] == 1.0);
        let sent = (0..100u64)
            .filter(|i| gimbal.demand(20_000_000 + i * 10_000_000, -0.001 * *i as f64, (1, 191)).is_some())
            .count();
        assert!(sent <= 5, "{sent} in a second");
        gimbal.denied();
        assert_eq!(configure(gimbal.demand(3_000_000_000, -0.5, (1, 191))), Some(true));
    }

    #[test]
    fn rates_come_from_successive_attitudes() {
        let mut gimbal = Gimbal::default();
        gimbal.attitude(100_000_000, &status(DQuat::from_rotation_z(0.0), YAW_IN_EARTH), &turning());
        gimbal.attitude(200_000_000, &status(DQuat::from_rotation_z(0.02), YAW_IN_EARTH), &turning());
        assert!((gimbal.rates_radps - DVec3::new(0.0, 0.0, -0.2)).length() < 1e-5, "{}", gimbal.rates_radps);
    }
}
