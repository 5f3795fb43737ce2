//! What a message must be before a reader gets to see it: its writer is another process, and may be wild.
//!
//! Every header of a channel says by [`Check`] what it and its items must be: lengths that fit, codes that are known where
//! nobody answers for them, numbers that are finite and of this world where they steer anything. The bus applies it to
//! every message that it receives; a service never sees one that fails. Requests whose server answers nonsense with a
//! sentence (unknown commands, rounds and scores that make no sense, images too large) are left to it: a refusal tells
//! the client more than silence.

use core::fmt::Debug;

use super::{
    Alive, CandidateScore, CandidateState, CandidateStatus, CandidateView, CaptureReply, CaptureRequest, CaptureStatus,
    ChargeState, ClockGrant, ClockTick, CommandReply, CommandRequest, CommandStatus, Commander, ControlReply,
    ControlRequest, EndReason, FailsafeReason, FlightMode, FrameHeader, FrameView, GaussianRow, Health, KeyframeReason,
    MissionPhase, MissionReply, MissionRequest, MissionState, RenderReply, RenderRequest, RenderStatus, RoundReply,
    RoundRequest, RoundStatus, ScoreReply, ScoreRequest, ScoreStatus, ServiceState, SnapshotHeader, TargetStatus,
    Truth, VehicleState, VehicleTarget, Waypoint,
};
use crate::service::ServiceName;

/// No position, size or speed of a mission is larger, in metres and m/s: beyond it numbers are garbage.
pub const FARTHEST: f64 = 1e6;
/// No mission time and no counter is larger (146 years of nanoseconds): sums of two do not overflow.
pub const LATEST: u64 = 1 << 62;

/// Why a message is refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{field} is {found}; expected {expected}")]
pub struct Fault {
    /// The field.
    pub field: &'static str,
    /// Its value.
    pub found: String,
    /// What it should be.
    pub expected: &'static str,
}

fn fault(field: &'static str, found: impl Debug, expected: &'static str) -> Fault {
    Fault { field, found: format!("{found:?}"), expected }
}

/// What a header and its items must be.
pub trait Check<Item = u8> {
    /// Looks at a received message.
    ///
    /// # Errors
    /// The first field that cannot be.
    fn check(&self, items: &[Item]) -> Result<(), Fault>;
}

fn ensure(fits: bool, field: &'static str, found: impl Debug, expected: &'static str) -> Result<(), Fault> {
    if fits { Ok(()) } else { Err(fault(field, found, expected)) }
}

/// Finite, and of this world.
pub(crate) fn real(field: &'static str, values: &[f64]) -> Result<(), Fault> {
    // NaN is in no range.
    let wild = values.iter().find(|value| !(-FARTHEST..=FARTHEST).contains(*value));
    wild.map_or(Ok(()), |value| Err(fault(field, value, "a finite number of at most a million")))
}

/// A rotation; all zero where it was never measured and `absent` says that this may be.
fn rotation(field: &'static str, xyzw: [f64; 4], absent: bool) -> Result<(), Fault> {
    let length2: f64 = xyzw.iter().map(|value| value * value).sum();
    let fits = (0.98..=1.02).contains(&length2) || (absent && length2 == 0.0);
    ensure(fits, field, xyzw, "a quaternion of length 1")
}

fn flags(fields: &[(&'static str, u32)]) -> Result<(), Fault> {
    fields.iter().try_for_each(|(field, value)| ensure(*value <= 1, field, value, "0 or 1"))
}

fn times(fields: &[(&'static str, u64)]) -> Result<(), Fault> {
    fields.iter().try_for_each(|(field, value)| ensure(*value <= LATEST, field, value, "at most 2^62"))
}

fn known<T>(field: &'static str, code: u32, variant: Option<T>) -> Result<(), Fault> {
    ensure(variant.is_some(), field, code, "a code of this version")
}

fn none<T>(items: &[T]) -> Result<(), Fault> {
    ensure(items.is_empty(), "items", items.len(), "none")
}

impl Check for VehicleState {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)?;
        times(&[
            ("position_stamp_ns", self.position_stamp_ns),
            ("attitude_stamp_ns", self.attitude_stamp_ns),
            ("gimbal_stamp_ns", self.gimbal_stamp_ns),
            ("time_uncertainty_ns", self.time_uncertainty_ns),
            ("link_age_ns", self.link_age_ns),
        ])?;
        real("position_m", &self.position_m)?;
        real("velocity_mps", &self.velocity_mps)?;
        rotation("world_from_body_xyzw", self.world_from_body_xyzw, true)?;
        real("body_rates_radps", &self.body_rates_radps)?;
        rotation("world_from_gimbal_xyzw", self.world_from_gimbal_xyzw, true)?;
        real("gimbal_rates_radps", &self.gimbal_rates_radps)?;
        real("gimbal_pitch_min_rad, gimbal_pitch_max_rad", &[self.gimbal_pitch_min_rad, self.gimbal_pitch_max_rad])?;
        real("setpoint_position_m", &self.setpoint_position_m)?;
        real("setpoint_yaw_rad", &[self.setpoint_yaw_rad])?;
        real("home_m", &self.home_m)?;
        real("wind_mps", &self.wind_mps)?;
        let share = |value: f64| (0.0..=1.0 + 1e-6).contains(&value);
        ensure(share(self.battery_fraction), "battery_fraction", self.battery_fraction, "0 to 1")?;
        ensure(share(self.target_progress), "target_progress", self.target_progress, "0 to 1")?;
        known("charge_state", self.charge_state, ChargeState::from_code(self.charge_state))?;
        known("mode", self.mode, FlightMode::from_code(self.mode))?;
        known("failsafe", self.failsafe, FailsafeReason::from_code(self.failsafe))?;
        known("commander", self.commander, Commander::from_code(self.commander))?;
        known("target_status", self.target_status, TargetStatus::from_code(self.target_status))?;
        flags(&[
            ("armed", self.armed),
            ("landed", self.landed),
            ("ready", self.ready),
            ("armable", self.armable),
            ("gimbal_present", self.gimbal_present),
            ("streaming", self.streaming),
        ])
    }
}

impl Check<Waypoint> for VehicleTarget {
    fn check(&self, items: &[Waypoint]) -> Result<(), Fault> {
        times(&[("id", self.id)])?;
        let announced = u64::from(self.path_len) + u64::from(self.return_len);
        ensure(announced == items.len() as u64, "path_len + return_len", announced, "the number of waypoints")?;
        real("volume_min_m", &self.volume_min_m)?;
        real("volume_max_m", &self.volume_max_m)?;
        items.iter().try_for_each(|w| {
            real("position_m of a waypoint", &w.position_m)?;
            real("a waypoint", &[w.yaw_rad, w.gimbal_pitch_rad, w.speed_mps])
        })
    }
}

impl Check for CommandRequest {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)?;
        real("altitude_m", &[self.altitude_m])?;
        real("shift_m", &self.shift_m)
    }
}

impl Check for CommandReply {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)?;
        known("status", self.status, CommandStatus::from_code(self.status))
    }
}

impl Check for Alive {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)
    }
}

impl Check for MissionRequest {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)
    }
}

impl Check for MissionReply {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)?;
        flags(&[("accepted", self.accepted)])
    }
}

impl Check<CandidateState> for MissionState {
    fn check(&self, items: &[CandidateState]) -> Result<(), Fault> {
        times(&[("started_ns", self.started_ns)])?;
        known("phase", self.phase, MissionPhase::from_code(self.phase))?;
        known("end_reason", self.end_reason, EndReason::from_code(self.end_reason))?;
        flags(&[("exposure_locked", self.exposure_locked), ("prior_known", self.prior_known)])?;
        // Readers open this folder, and write into it.
        let text = |packed: &[u8]| {
            let end = packed.iter().position(|&byte| byte == 0).unwrap_or(packed.len());
            core::str::from_utf8(&packed[..end]).map(str::to_owned).ok().filter(|text| !text.contains(char::is_control))
        };
        ensure(text(&self.mission_id).is_some(), "mission_id", &self.mission_id[..8], "text")?;
        let folder = text(&self.folder).is_some_and(|folder| folder.is_empty() || folder.starts_with('/'));
        ensure(folder, "folder", &self.folder[..8], "an absolute path, or none")?;
        real("box_center_m", &self.box_center_m)?;
        real("box_size_m, radius_m, ground_z_m", &[self.box_size_m, self.radius_m, self.ground_z_m])?;
        items.iter().try_for_each(|candidate| {
            real("position_m of a candidate", &candidate.position_m)?;
            known("status of a candidate", candidate.status, CandidateStatus::from_code(candidate.status))
        })
    }
}

impl Check for FrameHeader {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        known("reason", self.reason, KeyframeReason::from_code(self.reason))?;
        real("world_from_camera_position_m", &self.world_from_camera_position_m)?;
        rotation("world_from_camera_xyzw", self.world_from_camera_xyzw, false)?;
        real("focal_px, principal_px", [self.focal_px, self.principal_px].as_flattened())?;
        real("depth_unit_m", &[self.depth_unit_m])?;
        let sides = (self.width, self.height, self.has_color, items.len());
        ensure(FrameView::new(self, items).is_some(), "width, height, has_color, bytes", sides, "sizes that fit")
    }
}

impl Check for CaptureRequest {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)?;
        times(&[("keyframe_id", self.keyframe_id), ("target_id", self.target_id), ("deadline_ns", self.deadline_ns)])?;
        real("look_at_m", &self.look_at_m)
    }
}

impl Check for CaptureReply {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)?;
        times(&[("keyframe_id", self.keyframe_id), ("image_stamp_ns", self.image_stamp_ns)])?;
        known("status", self.status, CaptureStatus::from_code(self.status))?;
        flags(&[("gate_missed", self.gate_missed)])
    }
}

impl Check<u64> for RoundRequest {
    fn check(&self, _items: &[u64]) -> Result<(), Fault> {
        Ok(())
    }
}

impl Check for RoundReply {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)?;
        times(&[("generation", self.generation), ("gaussians", self.gaussians)])?;
        known("status", self.status, RoundStatus::from_code(self.status))
    }
}

impl Check<GaussianRow> for SnapshotHeader {
    /// Single Gaussians that are not finite are left out by the reader instead: training may bring one forth, and a round
    /// without its snapshot would never be scored.
    fn check(&self, _items: &[GaussianRow]) -> Result<(), Fault> {
        times(&[("generation", self.generation), ("iterations", self.iterations)])?;
        real("box_center_m", &self.box_center_m)?;
        real("box_size_m", &[self.box_size_m])?;
        ensure(self.sh_degree <= 3, "sh_degree", self.sh_degree, "0 to 3")?;
        flags(&[("is_final", self.is_final)])
    }
}

impl Check<CandidateView> for ScoreRequest {
    fn check(&self, _items: &[CandidateView]) -> Result<(), Fault> {
        Ok(())
    }
}

impl Check<CandidateScore> for ScoreReply {
    fn check(&self, items: &[CandidateScore]) -> Result<(), Fault> {
        times(&[("generation", self.generation), ("newest_generation", self.newest_generation)])?;
        known("status", self.status, ScoreStatus::from_code(self.status))?;
        if self.status == ScoreStatus::Done.code() {
            ensure(self.candidates as usize == items.len(), "candidates", self.candidates, "the number of scores")?;
        }
        let finite = |values: &[f64]| values.iter().all(|value| value.is_finite());
        ensure(finite(&[self.uncertainty_p95]), "uncertainty_p95", self.uncertainty_p95, "a finite number")?;
        items.iter().try_for_each(|score| {
            let terms = [score.uncertainty, score.uncertainty_normalised, score.angle_normalised, score.score];
            let seen = [score.mean_variance_m2, score.area_fraction, score.mean_alpha, score.transparent_fraction];
            ensure(finite(&terms) && finite(&seen), "a score", terms, "finite numbers")
        })
    }
}

impl Check for Truth {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)?;
        times(&[("now_ns", self.now_ns)])?;
        real("position_m", &self.position_m)?;
        real("velocity_mps", &self.velocity_mps)?;
        rotation("world_from_body_xyzw", self.world_from_body_xyzw, true)?;
        real("camera_position_m", &self.camera_position_m)?;
        rotation("world_from_camera_xyzw", self.world_from_camera_xyzw, false)
    }
}

impl Check for RenderRequest {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)?;
        times(&[("image_stamp_ns", self.image_stamp_ns)])
    }
}

impl Check for RenderReply {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        times(&[("image_stamp_ns", self.image_stamp_ns)])?;
        known("status", self.status, RenderStatus::from_code(self.status))?;
        flags(&[("has_color", self.has_color)])?;
        if self.status != RenderStatus::Done.code() {
            return none(items);
        }
        real("depth_unit_m", &[self.depth_unit_m])?;
        ensure(self.depth_unit_m > 0.0, "depth_unit_m", self.depth_unit_m, "above 0")?;
        let pixels = u64::from(self.width) * u64::from(self.height);
        let bytes = pixels.saturating_mul(if self.has_color == 1 { 5 } else { 2 });
        let fits = bytes > 0 && bytes == items.len() as u64;
        ensure(fits, "width, height", (self.width, self.height, items.len()), "sizes that fit the bytes")
    }
}

impl Check for ClockTick {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)?;
        times(&[("tick", self.tick), ("now_ns", self.now_ns), ("datagrams", self.datagrams)])
    }
}

impl Check for ClockGrant {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)?;
        times(&[("incarnation", self.incarnation), ("work", self.work), ("datagrams", self.datagrams)])?;
        known("service", self.service, ServiceName::from_code(self.service))?;
        ensure(i32::try_from(self.pid).is_ok_and(|pid| pid > 0), "pid", self.pid, "a process")?;
        flags(&[("leaving", self.leaving), ("held", self.held)])
    }
}

impl Check for Health {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)?;
        known("service", self.service, ServiceName::from_code(self.service))?;
        known("state", self.state, ServiceState::from_code(self.state))
    }
}

impl Check<Health> for Health {
    fn check(&self, items: &[Health]) -> Result<(), Fault> {
        items.iter().try_for_each(|health| Check::<u8>::check(health, &[]))
    }
}

impl Check for ControlRequest {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)?;
        known("service", self.service, ServiceName::from_code(self.service))
    }
}

impl Check for ControlReply {
    fn check(&self, items: &[u8]) -> Result<(), Fault> {
        none(items)?;
        flags(&[("accepted", self.accepted)])?;
        known("service", self.service, ServiceName::from_code(self.service))
    }
}

#[cfg(test)]
mod tests;
