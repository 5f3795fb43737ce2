//! What the link shows of itself and of the vehicle: `vehicle/state`, and what keeps it from working.

use glam::{DQuat, DVec3};
use shared_types::messages::{TargetStatus, VehicleState};

use super::Core;
use crate::frames::{wrap_pi, yaw_of};
use crate::gimbal::NO_GIMBAL;
use crate::params;
use crate::path::Point;

impl Core {
    /// Whether the vehicle can be flown: for `vehicle/state`.
    #[must_use]
    pub fn state(&self, now_ns: u64) -> VehicleState {
        let t = &self.telemetry;
        let attitude = t.attitude();
        let body = attitude.map_or(DQuat::IDENTITY, |sample| sample.world_from_body);
        let attitude_stamp_ns = attitude.map_or(0, |sample| sample.stamp_ns);
        let has_gimbal = self.gimbal.present() && self.gimbal.stamp_ns > 0;
        let report = self.report.filter(|report| report.streaming);
        let at = report.map_or_else(|| self.measured_point(), |report| report.setpoint.point);
        let (target_id, status) = match (self.refused, report) {
            (Some((id, status)), _) => (id, status),
            (None, Some(report)) if report.target_id != 0 => (report.target_id, report.status),
            _ => (0, TargetStatus::None),
        };
        let (pitch_min, pitch_max) = self.gimbal.limits_rad.unwrap_or_default();
        VehicleState {
            incarnation: self.incarnation,
            position_stamp_ns: t.position_stamp_ns,
            attitude_stamp_ns,
            gimbal_stamp_ns: if has_gimbal { self.gimbal.stamp_ns } else { attitude_stamp_ns },
            time_uncertainty_ns: self.sync.uncertainty_ns(now_ns),
            // Never heard in this life: the age counts from its start, not from the clock's.
            link_age_ns: now_ns.saturating_sub(t.heard_ns.max(self.started_ns.unwrap_or(now_ns))),
            target_id,
            position_m: t.position_m.to_array(),
            velocity_mps: t.velocity_mps.to_array(),
            world_from_body_xyzw: body.to_array(),
            body_rates_radps: t.body_rates_radps.to_array(),
            world_from_gimbal_xyzw: if has_gimbal { self.gimbal.world_from_gimbal } else { body }.to_array(),
            gimbal_rates_radps: if has_gimbal { self.gimbal.rates_radps } else { body * t.body_rates_radps }.to_array(),
            gimbal_pitch_min_rad: pitch_min,
            gimbal_pitch_max_rad: pitch_max,
            setpoint_position_m: at.position_m.to_array(),
            setpoint_yaw_rad: wrap_pi(at.yaw_rad),
            home_m: t.home.map_or(DVec3::ZERO, |(local_m, _)| local_m + self.world.offset_m()).to_array(),
            wind_mps: t.wind_mps.to_array(),
            battery_fraction: t.battery_fraction.max(0.0),
            target_progress: report
                .filter(|report| report.target_id == target_id)
                .map_or(0.0, |report| report.progress),
            charge_state: t.charge.code(),
            mode: t.mode.code(),
            armed: u32::from(t.armed),
            landed: u32::from(t.landed == Some(true) || (t.landed.is_none() && !t.armed)),
            failsafe: self.failsafe.code(),
            commander: self.commander.code(),
            target_status: status.code(),
            reset_count: self.world.reset_count(),
            ready: u32::from(
                t.ready(now_ns)
                    && self.asks.done()
                    && (self.gimbal.present() || self.gimbal.absent(now_ns, self.synced_ns)),
            ),
            armable: u32::from(t.armable),
            gimbal_present: u32::from(self.gimbal.present()),
            streaming: u32::from(report.is_some()),
        }
    }

    /// Pitch of the gimbal now, radians, negative down; 0 without one.
    pub(super) fn gimbal_pitch_rad(&self) -> f64 {
        if self.gimbal.stamp_ns == 0 {
            0.0
        } else {
            (self.gimbal.world_from_gimbal * DVec3::X).z.clamp(-1.0, 1.0).asin()
        }
    }

    pub(super) fn measured_point(&self) -> Point {
        let yaw_rad = self.telemetry.attitude().map_or(0.0, |sample| yaw_of(sample.world_from_body));
        Point { position_m: self.telemetry.position_m, yaw_rad, pitch_rad: self.gimbal_pitch_rad() }
    }

    /// What keeps it from working, for `health`.
    #[must_use]
    pub fn trouble(&self, now_ns: u64) -> Option<String> {
        if self.system.is_none() {
            return Some(format!("no autopilot at {}; is it running?", self.config.url));
        }
        let age_s = shared_types::s_from_ns(now_ns.saturating_sub(self.telemetry.heard_ns));
        if age_s > 3.0 {
            return Some(format!("nothing heard of the autopilot for {age_s:.1} s"));
        }
        let unsafe_to_fly =
            params::refusal(&self.params, self.telemetry.remote_control, self.config.allow_unsafe_offboard_loss);
        unsafe_to_fly
            .filter(|_| self.asks.done())
            .or_else(|| self.gimbal.absent(now_ns, self.synced_ns).then(|| NO_GIMBAL.to_owned()))
    }
}
