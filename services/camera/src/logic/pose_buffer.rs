//! Where the camera was at the instant of an image: a short history of `vehicle/state`, interpolated.
//!
//! Position, attitude and gimbal arrive at their own rates with their own stamps; each is interpolated between its own
//! two neighbours of the wanted instant. Nothing is extrapolated further than the caller allows, and nothing is
//! interpolated over a long gap or from one life of px4-link to the next: a wrong pose is worse than none.

use std::collections::VecDeque;

use glam::{DQuat, DVec3};
use shared_types::config::CameraConfig;
use shared_types::frames::Pose;
use shared_types::messages::VehicleState;
use shared_types::{NS_PER_S, s_from_ns};

/// How long states are kept: as far back as a captured image may lie, and a little.
const KEEP_NS: u64 = 5 * NS_PER_S;
/// Longest gap between two samples that is interpolated. A gimbal speaks 5 times a second at the least.
const MAX_GAP_NS: u64 = NS_PER_S / 2;

/// Why there is no pose at an instant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PoseError {
    /// No state with this part has come yet.
    #[error("no {0} of the vehicle has been received")]
    Nothing(&'static str),
    /// The instant lies after the newest state.
    #[error("the newest {part} is {by_ns} ns older than the image")]
    TooNew {
        /// Which part.
        part: &'static str,
        /// By how much.
        by_ns: u64,
    },
    /// The instant lies before the oldest state kept.
    #[error("the image is older than the oldest {0} kept")]
    TooOld(&'static str),
    /// The states on both sides are too far apart.
    #[error("the {0} has a gap around the image")]
    Gap(&'static str),
}

/// Value and rate of one part of the state at a stamp.
#[derive(Debug, Clone, Copy)]
struct Sample<T> {
    stamp_ns: u64,
    value: T,
    rate: DVec3,
}

/// What can be moved along by a rate, and interpolated.
trait Moving: Copy {
    fn between(self, other: Self, share: f64) -> Self;
    fn moved(self, rate: DVec3, by_s: f64) -> Self;
}

impl Moving for DVec3 {
    fn between(self, other: Self, share: f64) -> Self {
        self.lerp(other, share)
    }

    fn moved(self, rate: DVec3, by_s: f64) -> Self {
        self + rate * by_s
    }
}

/// A rotation of something in the world; its rate is about the world's axes.
impl Moving for DQuat {
    fn between(self, other: Self, share: f64) -> Self {
        self.slerp(other, share).normalize()
    }

    fn moved(self, rate: DVec3, by_s: f64) -> Self {
        (Self::from_scaled_axis(rate * by_s) * self).normalize()
    }
}

/// The vehicle at an instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VehicleMotion {
    /// The body (FLU) in the world.
    pub world_from_body: Pose,
    /// The gimbal's payload (FLU) in the world; `None` without a gimbal.
    pub world_from_gimbal: Option<DQuat>,
    /// Velocity in the world, m/s.
    pub velocity_mps: DVec3,
    /// Angular rate of the body about the world's axes, rad/s.
    pub body_rate_radps: DVec3,
    /// Angular rate of the payload about the world's axes, rad/s; zero without a gimbal.
    pub gimbal_rate_radps: DVec3,
}

/// The camera at an instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraMotion {
    /// Pose of the camera (optical) in the world.
    pub world_from_camera: Pose,
    /// Speed of the optical centre, m/s.
    pub speed_mps: f64,
    /// Angular rate of the camera, rad/s.
    pub rate_radps: f64,
}

/// The camera's motion that follows from the vehicle's: both lever arms count.
#[must_use]
pub fn camera_motion(config: &CameraConfig, vehicle: &VehicleMotion) -> CameraMotion {
    let body = vehicle.world_from_body;
    let (gimbal, rate) = match vehicle.world_from_gimbal {
        Some(gimbal) => (gimbal, vehicle.gimbal_rate_radps),
        None => (config.world_from_fixed_mount(body.rotation), vehicle.body_rate_radps),
    };
    let to_pivot_m = body.rotation * DVec3::from_array(config.body_from_gimbal_m);
    let to_camera_m = gimbal * DVec3::from_array(config.gimbal_from_camera_m);
    let velocity = vehicle.velocity_mps + vehicle.body_rate_radps.cross(to_pivot_m) + rate.cross(to_camera_m);
    CameraMotion {
        world_from_camera: config.world_from_camera(body, gimbal),
        speed_mps: velocity.length(),
        rate_radps: rate.length(),
    }
}

/// A few seconds of `vehicle/state`.
#[derive(Debug, Default)]
pub struct PoseBuffer {
    incarnation: u64,
    position: VecDeque<Sample<DVec3>>,
    attitude: VecDeque<Sample<DQuat>>,
    gimbal: VecDeque<Sample<DQuat>>,
    gimbal_present: bool,
    time_uncertainty_s: f64,
}

impl PoseBuffer {
    /// Adds a state. Parts that are not newer than the last are passed over, and so is a state with numbers that are not
    /// finite: the writer is another process. Another life of px4-link begins a new history.
    pub fn push(&mut self, state: &VehicleState) {
        if state.incarnation != self.incarnation {
            *self = Self { incarnation: state.incarnation, ..Self::default() };
        }
        self.gimbal_present = state.gimbal_present == 1;
        self.time_uncertainty_s = s_from_ns(state.time_uncertainty_ns);
        let position = DVec3::from_array(state.position_m);
        add(
            &mut self.position,
            state.position_stamp_ns,
            position,
            DVec3::from_array(state.velocity_mps),
            position.is_finite(),
        );
        let attitude = DQuat::from_array(state.world_from_body_xyzw);
        let rate = attitude * DVec3::from_array(state.body_rates_radps);
        add(&mut self.attitude, state.attitude_stamp_ns, attitude, rate, is_rotation(attitude));
        let gimbal = DQuat::from_array(state.world_from_gimbal_xyzw);
        add(
            &mut self.gimbal,
            state.gimbal_stamp_ns,
            gimbal,
            DVec3::from_array(state.gimbal_rates_radps),
            is_rotation(gimbal),
        );
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// One standard deviation of the stamps as last reported, seconds.
    #[must_use]
    pub fn time_uncertainty_s(&self) -> f64 {
        self.time_uncertainty_s
    }

    /// The newest instant for which every part is known without extrapolation.
    #[must_use]
    pub fn newest_ns(&self) -> Option<u64> {
        let newest = self.position.back()?.stamp_ns.min(self.attitude.back()?.stamp_ns);
        if self.gimbal_present { Some(newest.min(self.gimbal.back()?.stamp_ns)) } else { Some(newest) }
    }

    /// The vehicle at an instant, extrapolated by at most `extrapolate_ns`.
    ///
    /// # Errors
    /// When the instant is too new, too old, or lies in a gap.
    pub fn motion_at(&self, stamp_ns: u64, extrapolate_ns: u64) -> Result<VehicleMotion, PoseError> {
        let (position_m, velocity_mps) = at(&self.position, "position", stamp_ns, extrapolate_ns)?;
        let (attitude, body_rate_radps) = at(&self.attitude, "attitude", stamp_ns, extrapolate_ns)?;
        let gimbal = if self.gimbal_present {
            Some(at(&self.gimbal, "gimbal attitude", stamp_ns, extrapolate_ns)?)
        } else {
            None
        };
        Ok(VehicleMotion {
            world_from_body: Pose { position_m, rotation: attitude },
            world_from_gimbal: gimbal.map(|(rotation, _)| rotation),
            velocity_mps,
            body_rate_radps,
            gimbal_rate_radps: gimbal.map_or(DVec3::ZERO, |(_, rate)| rate),
        })
    }
}

fn is_rotation(rotation: DQuat) -> bool {
    (0.999..=1.001).contains(&rotation.length())
}

fn add<T: Moving>(history: &mut VecDeque<Sample<T>>, stamp_ns: u64, value: T, rate: DVec3, sane: bool) {
    let newer = history.back().is_none_or(|last| last.stamp_ns < stamp_ns);
    if !sane || !rate.is_finite() || stamp_ns == 0 || !newer {
        return;
    }
    history.push_back(Sample { stamp_ns, value, rate });
    while history.front().is_some_and(|first| first.stamp_ns + KEEP_NS < stamp_ns) {
        history.pop_front();
    }
}

fn at<T: Moving>(
    history: &VecDeque<Sample<T>>,
    part: &'static str,
    stamp_ns: u64,
    extrapolate_ns: u64,
) -> Result<(T, DVec3), PoseError> {
    let after = history.partition_point(|sample| sample.stamp_ns < stamp_ns);
    let before = after.checked_sub(1).and_then(|index| history.get(index));
    match (before, history.get(after)) {
        (None, None) => Err(PoseError::Nothing(part)),
        (_, Some(next)) if next.stamp_ns == stamp_ns => Ok((next.value, next.rate)),
        (None, Some(_)) => Err(PoseError::TooOld(part)),
        (Some(last), None) => {
            let by_ns = stamp_ns - last.stamp_ns;
            if by_ns > extrapolate_ns {
                return Err(PoseError::TooNew { part, by_ns });
            }
            Ok((last.value.moved(last.rate, s_from_ns(by_ns)), last.rate))
        }
        (Some(last), Some(next)) => {
            let gap_ns = next.stamp_ns - last.stamp_ns;
            if gap_ns > MAX_GAP_NS {
                return Err(PoseError::Gap(part));
            }
            let share = s_from_ns(stamp_ns - last.stamp_ns) / s_from_ns(gap_ns);
            Ok((last.value.between(next.value, share), last.rate.lerp(next.rate, share)))
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const MS: u64 = 1_000_000;

    /// A vehicle that moves and turns steadily: every part is exactly known at every instant.
    struct Steady {
        velocity: DVec3,
        yaw_rate: f64,
        pitch_rate: f64,
    }

    impl Steady {
        fn position(&self, ns: u64) -> DVec3 {
            DVec3::new(1.0, 2.0, 3.0) + self.velocity * s_from_ns(ns)
        }

        fn attitude(&self, ns: u64) -> DQuat {
            DQuat::from_rotation_z(0.3 + self.yaw_rate * s_from_ns(ns))
        }

        fn gimbal(&self, ns: u64) -> DQuat {
            DQuat::from_rotation_y(0.5 + self.pitch_rate * s_from_ns(ns))
        }

        fn state(&self, position_ns: u64, attitude_ns: u64, gimbal_ns: u64) -> VehicleState {
            VehicleState {
                incarnation: 1,
                position_stamp_ns: position_ns,
                attitude_stamp_ns: attitude_ns,
                gimbal_stamp_ns: gimbal_ns,
                time_uncertainty_ns: MS,
                position_m: self.position(position_ns).to_array(),
                velocity_mps: self.velocity.to_array(),
                world_from_body_xyzw: self.attitude(attitude_ns).to_array(),
                body_rates_radps: [0.0, 0.0, self.yaw_rate],
                world_from_gimbal_xyzw: self.gimbal(gimbal_ns).to_array(),
                gimbal_rates_radps: [0.0, self.pitch_rate, 0.0],
                gimbal_present: 1,
                ..VehicleState::default()
            }
        }

        /// States at 50 Hz; position 7 ms old, gimbal at 20 Hz and up to 50 ms old.
        fn history(&self) -> PoseBuffer {
            let mut buffer = PoseBuffer::default();
            for turn in 1..100 {
                let now = turn * 20 * MS + 1_000 * MS;
                buffer.push(&self.state(now - 7 * MS, now, now / (50 * MS) * (50 * MS)));
            }
            buffer
        }
    }

    proptest! {
        #[test]
        fn steady_motion_is_interpolated_exactly_each_part_by_its_own_stamp(
            ms in 1_100..2_900u64, x in -2.0..2.0f64, yaw_rate in -1.0..1.0f64, pitch_rate in -1.0..1.0f64,
        ) {
            let steady = Steady { velocity: DVec3::new(x, -x, 0.5), yaw_rate, pitch_rate };
            let motion = steady.history().motion_at(ms * MS, 0).expect("inside the history");
            prop_assert!((motion.world_from_body.position_m - steady.position(ms * MS)).length() < 1e-9);
            prop_assert!(motion.world_from_body.rotation.angle_between(steady.attitude(ms * MS)) < 1e-6);
            prop_assert!(motion.world_from_gimbal.expect("gimbal").angle_between(steady.gimbal(ms * MS)) < 1e-6);
            prop_assert!((motion.velocity_mps - steady.velocity).length() < 1e-9);
        }

        #[test]
        fn a_short_extrapolation_follows_the_rates_and_a_longer_one_is_refused(
            ms in 0..60u64, yaw_rate in -1.0..1.0f64, pitch_rate in -1.0..1.0f64,
        ) {
            let steady = Steady { velocity: DVec3::new(0.4, -1.0, 0.5), yaw_rate, pitch_rate };
            let buffer = steady.history();
            let newest = buffer.newest_ns().expect("known");
            let stamp = newest + ms * MS;
            // The oldest part decides: the gimbal, whose newest sample is `newest`.
            let motion = buffer.motion_at(stamp, 30 * MS);
            prop_assert_eq!(motion.is_ok(), ms <= 30);
            if let Ok(motion) = motion {
                prop_assert!((motion.world_from_body.position_m - steady.position(stamp)).length() < 1e-9);
                prop_assert!(motion.world_from_gimbal.expect("gimbal").angle_between(steady.gimbal(stamp)) < 1e-6);
            }
        }

        #[test]
        fn the_cameras_speed_is_the_change_of_its_position(
            ms in 1_200..2_800u64, yaw_rate in -1.0..1.0f64, pitch_rate in -1.0..1.0f64,
        ) {
            let config = CameraConfig { body_from_gimbal_m: [0.3, 0.1, -0.2], gimbal_from_camera_m: [0.1, 0.0, 0.2], ..CameraConfig::default() };
            let steady = Steady { velocity: DVec3::new(0.4, -1.0, 0.5), yaw_rate, pitch_rate };
            let buffer = steady.history();
            let at = |ns| camera_motion(&config, &buffer.motion_at(ns, 0).expect("inside"));
            let here = at(ms * MS);
            let moved = at(ms * MS + MS / 2).world_from_camera.position_m - at(ms * MS - MS / 2).world_from_camera.position_m;
            prop_assert!((here.speed_mps - moved.length() / 1e-3).abs() < 1e-4);
            prop_assert!((here.rate_radps - pitch_rate.abs()).abs() < 1e-9);
        }
    }

    #[test]
    fn gaps_the_past_and_nothing_are_refused() {
        let steady = Steady { velocity: DVec3::X, yaw_rate: 0.0, pitch_rate: 0.0 };
        let mut buffer = PoseBuffer::default();
        assert_eq!(buffer.motion_at(MS, MS), Err(PoseError::Nothing("position")));
        assert_eq!(buffer.newest_ns(), None);
        buffer.push(&steady.state(1_000 * MS, 1_000 * MS, 1_000 * MS));
        buffer.push(&steady.state(1_600 * MS, 1_600 * MS, 1_600 * MS));
        assert_eq!(buffer.motion_at(900 * MS, 0), Err(PoseError::TooOld("position")));
        assert_eq!(buffer.motion_at(1_300 * MS, 0), Err(PoseError::Gap("position")));
        assert!(buffer.motion_at(1_600 * MS, 0).is_ok());
        let late = PoseError::TooNew { part: "position", by_ns: MS };
        assert_eq!(buffer.motion_at(1_601 * MS, 0), Err(late));
    }

    #[test]
    fn another_life_of_the_link_begins_a_new_history() {
        let steady = Steady { velocity: DVec3::X, yaw_rate: 0.0, pitch_rate: 0.0 };
        let mut buffer = steady.history();
        let state = VehicleState { incarnation: 2, ..steady.state(3_100 * MS, 3_100 * MS, 3_100 * MS) };
        buffer.push(&state);
        assert_eq!(buffer.motion_at(3_050 * MS, 0), Err(PoseError::TooOld("position")));
    }

    #[test]
    fn wild_numbers_and_old_stamps_are_passed_over() {
        let steady = Steady { velocity: DVec3::X, yaw_rate: 0.1, pitch_rate: 0.0 };
        let mut buffer = steady.history();
        let before = buffer.motion_at(2_000 * MS, 0).expect("known");
        let mut wild = steady.state(3_000 * MS, 3_000 * MS, 3_000 * MS);
        wild.position_m[1] = f64::NAN;
        wild.world_from_body_xyzw = [0.0; 4];
        wild.gimbal_rates_radps[0] = f64::INFINITY;
        let newest = buffer.newest_ns();
        buffer.push(&wild);
        let mut old = steady.state(1_990 * MS, 1_990 * MS, 1_990 * MS);
        old.position_m = [9.0; 3];
        buffer.push(&old);
        assert_eq!(buffer.newest_ns(), newest);
        assert_eq!(buffer.motion_at(2_000 * MS, 0).expect("known"), before);
    }

    #[test]
    fn without_a_gimbal_the_camera_turns_with_the_body() {
        let steady = Steady { velocity: DVec3::ZERO, yaw_rate: 0.5, pitch_rate: 0.0 };
        let mut buffer = PoseBuffer::default();
        for ms in [1_000, 1_020] {
            buffer.push(&VehicleState { gimbal_present: 0, ..steady.state(ms * MS, ms * MS, 0) });
        }
        let motion = buffer.motion_at(1_010 * MS, 0).expect("no gimbal is needed");
        assert_eq!(motion.world_from_gimbal, None);
        let camera = camera_motion(&CameraConfig::default(), &motion);
        assert!((camera.rate_radps - 0.5).abs() < 1e-9 && camera.speed_mps > 0.05);
    }
}
