//! The true camera poses of the last seconds, and the pose at a stamp between two of them.

use std::collections::VecDeque;

use shared_types::NS_PER_S;
use shared_types::frames::Pose;

/// Truth older than this is forgotten.
const KEPT_NS: u64 = 5 * NS_PER_S;
/// Poses further apart than this are not interpolated: the truth between them was lost, and a guess would be a wrong pose
/// under a right image.
const MAX_GAP_NS: u64 = NS_PER_S / 10;

/// True poses in the order of their stamps.
#[derive(Debug, Default)]
pub(crate) struct TruthHistory {
    poses: VecDeque<(u64, Pose)>,
}

/// What is known about a stamp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Lookup {
    /// The camera was there.
    At(Pose),
    /// The truth has not come so far yet.
    NotYet,
    /// The truth of that stamp is forgotten, or was never had.
    Gone,
}

impl TruthHistory {
    /// Takes the true `world_from_camera` of a stamp. One that is not sane is left out; a stamp that lies before the last
    /// one begins a new history (another simulator).
    pub(crate) fn push(&mut self, stamp_ns: u64, world_from_camera: Pose) {
        if !world_from_camera.is_sane() {
            return;
        }
        match self.poses.back() {
            Some((last, _)) if stamp_ns == *last => return,
            Some((last, _)) if stamp_ns < *last => self.poses.clear(),
            _ => {}
        }
        self.poses.push_back((stamp_ns, world_from_camera));
        while self.poses.front().is_some_and(|(first, _)| first + KEPT_NS < stamp_ns) {
            self.poses.pop_front();
        }
    }

    /// The pose at a stamp: linear in position, shortest arc in rotation.
    pub(crate) fn at(&self, stamp_ns: u64) -> Lookup {
        let after = self.poses.partition_point(|(stamp, _)| *stamp < stamp_ns);
        let Some((next_ns, next)) = self.poses.get(after) else { return Lookup::NotYet };
        if *next_ns == stamp_ns {
            return Lookup::At(*next);
        }
        let Some((last_ns, last)) = after.checked_sub(1).and_then(|i| self.poses.get(i)) else { return Lookup::Gone };
        if next_ns - last_ns > MAX_GAP_NS {
            return Lookup::Gone;
        }
        Lookup::At(last.interpolate(next, (stamp_ns - last_ns) as f64 / (next_ns - last_ns) as f64))
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;

    fn pose(x: f64, yaw: f64) -> Pose {
        Pose { position_m: DVec3::new(x, 0.0, 1.0), rotation: DQuat::from_rotation_z(yaw) }
    }

    #[test]
    fn between_two_stamps_the_pose_is_interpolated() {
        let mut history = TruthHistory::default();
        assert_eq!(history.at(5), Lookup::NotYet);
        history.push(10_000_000, pose(1.0, 0.0));
        history.push(20_000_000, pose(2.0, 0.2));
        assert_eq!(history.at(10_000_000), Lookup::At(pose(1.0, 0.0)));
        let Lookup::At(middle) = history.at(12_500_000) else { panic!("known") };
        assert!((middle.position_m.x - 1.25).abs() < 1e-12);
        assert!(middle.rotation.angle_between(DQuat::from_rotation_z(0.05)) < 1e-6);
        assert_eq!(history.at(20_000_001), Lookup::NotYet);
        assert_eq!(history.at(9_999_999), Lookup::Gone);
    }

    #[test]
    fn old_truth_is_forgotten_and_gaps_are_not_guessed() {
        let mut history = TruthHistory::default();
        for i in 0..1000 {
            history.push(i * 10_000_000, pose(i as f64, 0.0));
        }
        assert_eq!(history.at(4_000_000_000), Lookup::Gone);
        assert!(matches!(history.at(5_000_000_000), Lookup::At(_)));
        history.push(10_500_000_000, pose(0.0, 0.0));
        assert_eq!(history.at(10_200_000_000), Lookup::Gone, "half a second was lost");
    }

    #[test]
    fn a_clock_that_goes_back_begins_anew_and_wild_poses_are_left_out() {
        let mut history = TruthHistory::default();
        history.push(1_000, pose(1.0, 0.0));
        history.push(2_000, pose(f64::NAN, 0.0));
        assert_eq!(history.at(2_000), Lookup::NotYet);
        history.push(500, pose(3.0, 0.0));
        assert_eq!(history.at(500), Lookup::At(pose(3.0, 0.0)));
        assert_eq!(history.at(1_000), Lookup::NotYet);
    }
}
