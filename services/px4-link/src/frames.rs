//! NED and FRD to ENU and FLU, and the world frame that stays where it is when the estimator does not.
//!
//! The autopilot speaks of a local NED frame (x north, y east, z down) and a body frame FRD (x forward, y right, z down).
//! Everything else in Vantage speaks of the world ENU and bodies FLU. Both maps are their own inverse. The local frame's
//! origin moves when the estimator resets; [`WorldTransform`] moves the other way, so that the object stays in place.

use core::f64::consts::{FRAC_1_SQRT_2, FRAC_PI_2, PI};

use glam::{DQuat, DVec3};

/// NED to ENU, and ENU to NED: the same swap of axes.
#[must_use]
pub fn swap_ned_enu(v: DVec3) -> DVec3 {
    DVec3::new(v.y, v.x, -v.z)
}

/// FRD to FLU, and FLU to FRD.
#[must_use]
pub fn swap_frd_flu(v: DVec3) -> DVec3 {
    DVec3::new(v.x, -v.y, -v.z)
}

/// `enu_from_ned` as a rotation: half a turn about the diagonal of x and y.
fn enu_from_ned() -> DQuat {
    DQuat::from_xyzw(FRAC_1_SQRT_2, FRAC_1_SQRT_2, 0.0, 0.0)
}

/// `frd_from_flu` as a rotation: half a turn about x.
fn frd_from_flu() -> DQuat {
    DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0)
}

/// Attitude `enu_from_flu` of a body whose attitude `ned_from_frd` is given.
#[must_use]
pub fn enu_from_flu(ned_from_frd: DQuat) -> DQuat {
    (enu_from_ned() * ned_from_frd * frd_from_flu()).normalize()
}

/// Attitude `ned_from_frd` of a body whose attitude `enu_from_flu` is given.
#[must_use]
pub fn ned_from_frd(enu_from_flu: DQuat) -> DQuat {
    (enu_from_ned().conjugate() * enu_from_flu * frd_from_flu().conjugate()).normalize()
}

/// An angle moved into (-pi, pi] by whole turns.
#[must_use]
pub fn wrap_pi(angle_rad: f64) -> f64 {
    let wrapped = angle_rad.rem_euclid(2.0 * PI);
    if wrapped > PI { wrapped - 2.0 * PI } else { wrapped }
}

/// Yaw from east, counter-clockwise, of a yaw from north, clockwise; and the other way: the map is its own inverse.
#[must_use]
pub fn swap_yaw(yaw_rad: f64) -> f64 {
    wrap_pi(FRAC_PI_2 - yaw_rad)
}

/// Yaw of an attitude whose frame has z along the axis of yaw: the heading of its x axis.
#[must_use]
pub fn yaw_of(rotation: DQuat) -> f64 {
    let x = rotation * DVec3::X;
    x.y.atan2(x.x)
}

/// A quaternion of MAVLink (w, x, y, z), unit length; `None` when it is not one.
#[must_use]
pub fn quaternion(wxyz: [f32; 4]) -> Option<DQuat> {
    let [w, x, y, z] = wxyz.map(f64::from);
    let q = DQuat::from_xyzw(x, y, z, w);
    let length = q.length();
    (length.is_finite() && (length - 1.0).abs() < 0.1).then(|| q.normalize())
}

/// Where the estimator has put its origin on the earth.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct EarthOrigin {
    /// Latitude, 1e-7 deg.
    pub latitude_e7: i32,
    /// Longitude, 1e-7 deg.
    pub longitude_e7: i32,
    /// Height above the sea, millimetres.
    pub altitude_mm: i32,
}

impl EarthOrigin {
    /// From this origin to another, east, north, up, metres; flat earth, good for a few kilometres.
    #[must_use]
    pub fn offset_to(&self, other: &Self) -> DVec3 {
        const METRES_PER_DEGREE: f64 = 6_371_000.0 * PI / 180.0;
        let degrees = |to: i32, from: i32| f64::from(to.wrapping_sub(from)) * 1e-7;
        let north = degrees(other.latitude_e7, self.latitude_e7) * METRES_PER_DEGREE;
        let shrink = (f64::from(self.latitude_e7) * 1e-7).to_radians().cos();
        let east = degrees(other.longitude_e7, self.longitude_e7) * METRES_PER_DEGREE * shrink;
        DVec3::new(east, north, f64::from(other.altitude_mm.wrapping_sub(self.altitude_mm)) * 1e-3)
    }
}

/// What of the transform outlives a restart of px4-link.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize, serde::Deserialize)]
pub struct KeptTransform {
    /// Added to a local position (as ENU) to get the world's, metres.
    pub offset_m: [f64; 3],
    /// The estimator's reset counter when the offset was right.
    pub reset_counter: Option<u8>,
    /// How often it has moved.
    pub reset_count: u32,
    /// The estimator's origin when the offset was right.
    pub origin: Option<EarthOrigin>,
}

/// A jump beyond what the velocity explains that counts as a reset although no counter said so, metres.
const UNANNOUNCED_JUMP_M: f64 = 1.0;

/// A position as the estimator last told it.
#[derive(Debug, Clone, Copy)]
struct LastFix {
    stamp_ns: u64,
    local_enu_m: DVec3,
    velocity_mps: DVec3,
}

/// World from local: an offset that moves against the estimator's resets.
#[derive(Debug, Clone, Default)]
pub struct WorldTransform {
    kept: KeptTransform,
    last: Option<LastFix>,
    /// The origin was heard since px4-link is (back) here.
    origin_checked: bool,
    /// It was another one than before.
    origin_moved: bool,
    /// The reset counter was another one than before.
    reset_away: bool,
}

impl WorldTransform {
    /// Goes on with the transform of an earlier life.
    #[must_use]
    pub fn new(kept: KeptTransform) -> Self {
        Self { kept, ..Self::default() }
    }

    /// What to store.
    #[must_use]
    pub fn kept(&self) -> KeptTransform {
        self.kept
    }

    /// Offset from local (as ENU) to the world, metres.
    #[must_use]
    pub fn offset_m(&self) -> DVec3 {
        DVec3::from_array(self.kept.offset_m)
    }

    /// How often it has moved.
    #[must_use]
    pub fn reset_count(&self) -> u32 {
        self.kept.reset_count
    }

    /// A local NED position in the world.
    #[must_use]
    pub fn world_from_ned(&self, ned_m: DVec3) -> DVec3 {
        swap_ned_enu(ned_m) + self.offset_m()
    }

    /// A world position in local NED.
    #[must_use]
    pub fn ned_from_world(&self, world_m: DVec3) -> DVec3 {
        swap_ned_enu(world_m - self.offset_m())
    }

    /// Moves the transform: the world was found to lie elsewhere.
    pub fn shift(&mut self, by_m: DVec3) {
        self.kept.offset_m = (self.offset_m() + by_m).to_array();
        self.kept.reset_count = self.kept.reset_count.saturating_add(1);
    }

    /// Takes a fix of the estimator and returns its position in the world. A changed counter, or a jump that the velocity
    /// cannot explain, moves the transform instead of the vehicle.
    pub fn fix(&mut self, stamp_ns: u64, ned_m: DVec3, velocity_ned_mps: DVec3, counter: Option<u8>) -> DVec3 {
        let local_enu_m = swap_ned_enu(ned_m);
        let velocity_mps = swap_ned_enu(velocity_ned_mps);
        let announced = matches!((counter, self.kept.reset_counter), (Some(new), Some(old)) if new != old);
        if let Some(last) = self.last {
            let dt_s = shared_types::s_from_ns(stamp_ns.saturating_sub(last.stamp_ns));
            let expected_m = last.local_enu_m + (last.velocity_mps + velocity_mps) * (0.5 * dt_s);
            let jump_m = local_enu_m - expected_m;
            let unannounced = dt_s < 0.5 && jump_m.length() > UNANNOUNCED_JUMP_M;
            if announced || unannounced {
                self.shift(-jump_m);
            }
        } else if announced {
            // The estimator reset while px4-link was away: how far is unknown unless its origin moved, which `origin` sees.
            self.reset_away = true;
            if !self.origin_moved {
                self.kept.reset_count = self.kept.reset_count.saturating_add(1);
            }
        }
        if counter.is_some() {
            self.kept.reset_counter = counter;
        }
        self.last = Some(LastFix { stamp_ns, local_enu_m, velocity_mps });
        self.world_from_ned(ned_m)
    }

    /// Takes the estimator's origin. When it moved while px4-link was away, the transform moves with it, whether positions
    /// were heard before the origin or not; while px4-link watches, the jump of the position itself has already been taken.
    pub fn origin(&mut self, origin: EarthOrigin) {
        if let (Some(old), false) = (self.kept.origin, self.origin_checked)
            && old != origin
        {
            self.origin_moved = true;
            let counted = self.kept.reset_count;
            self.shift(old.offset_to(&origin));
            if self.reset_away {
                self.kept.reset_count = counted;
            }
        }
        self.origin_checked = true;
        self.kept.origin = Some(origin);
    }

    /// Whether the estimator was reset while px4-link was away and its origin does not say by how much.
    #[must_use]
    pub fn moved_unexplained(&self) -> bool {
        self.reset_away && !self.origin_moved
    }

    /// Goes on with the world as it is: the vehicle was looked at.
    pub fn accept(&mut self) {
        self.reset_away = false;
        self.origin_moved = false;
    }

    /// px4-link was away: the next fix is no jump, and the origin has to be heard again.
    pub fn forget_last(&mut self) {
        self.last = None;
        self.origin_checked = false;
        self.accept();
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn rotations() -> impl Strategy<Value = DQuat> {
        (-3.0..3.0f64, -1.5..1.5f64, -3.0..3.0f64)
            .prop_map(|(a, b, c)| DQuat::from_rotation_z(a) * DQuat::from_rotation_y(b) * DQuat::from_rotation_x(c))
    }

    #[test]
    fn known_directions() {
        assert_eq!(swap_ned_enu(DVec3::new(1.0, 2.0, 3.0)), DVec3::new(2.0, 1.0, -3.0));
        // Heading north in NED is no rotation; its FLU x axis must point north (y) and its z axis up.
        let north = enu_from_flu(DQuat::IDENTITY);
        assert!((north * DVec3::X - DVec3::Y).length() < 1e-12 && (north * DVec3::Z - DVec3::Z).length() < 1e-12);
        // 90 deg of yaw in NED is east.
        let east = enu_from_flu(DQuat::from_rotation_z(FRAC_PI_2));
        assert!((east * DVec3::X - DVec3::X).length() < 1e-12 && (east * DVec3::Y - DVec3::Y).length() < 1e-12);
        assert!(yaw_of(east).abs() < 1e-12 && (swap_yaw(FRAC_PI_2)).abs() < 1e-12);
        // Nose up is positive pitch in NED, and x rises in ENU.
        assert!((enu_from_flu(DQuat::from_rotation_y(0.3)) * DVec3::X).z > 0.29);
    }

    proptest! {
        #[test]
        fn attitude_maps_commute_with_vectors(q in rotations(), x in -1.0..1.0f64, y in -1.0..1.0f64, z in -1.0..1.0f64) {
            let body_frd = DVec3::new(x, y, z);
            let through_ned = swap_ned_enu(q * body_frd);
            let through_enu = enu_from_flu(q) * swap_frd_flu(body_frd);
            prop_assert!((through_ned - through_enu).length() < 1e-9);
            prop_assert!(ned_from_frd(enu_from_flu(q)).angle_between(q) < 1e-6);
        }

        #[test]
        fn yaw_maps_agree_with_attitudes(yaw in -3.1..3.1f64) {
            let enu = enu_from_flu(DQuat::from_rotation_z(yaw));
            prop_assert!(wrap_pi(yaw_of(enu) - swap_yaw(yaw)).abs() < 1e-9);
            prop_assert!(wrap_pi(swap_yaw(swap_yaw(yaw)) - yaw).abs() < 1e-9);
        }

        #[test]
        fn the_world_does_not_move_with_the_estimator(
            jumps in proptest::collection::vec((-9.0..9.0f64, -9.0..9.0f64, -3.0..3.0f64), 1..6),
            announced in any::<bool>(),
        ) {
            let mut world = WorldTransform::default();
            let velocity = DVec3::new(1.0, -0.5, 0.2);
            let (mut origin, mut counter, mut resets) = (DVec3::ZERO, 7u8, 0);
            let mut last: Option<DVec3> = None;
            for step in 0..60u64 {
                if step % 10 == 9 && let Some(&(x, y, z)) = jumps.get(step as usize / 10) {
                    let jump = DVec3::new(x, y, z);
                    if announced || jump.length() > UNANNOUNCED_JUMP_M {
                        origin += jump;
                        resets += 1;
                        counter = counter.wrapping_add(u8::from(announced));
                    }
                }
                let truth = velocity * (step as f64 * 0.02);
                let seen = world.fix(1 + step * 20_000_000, truth + origin, velocity, Some(counter));
                if let Some(last) = last {
                    prop_assert!((seen - last).length() < 0.03, "moved {} m", (seen - last).length());
                }
                prop_assert!((world.ned_from_world(seen) - (truth + origin)).length() < 1e-9);
                last = Some(seen);
            }
            prop_assert_eq!(world.reset_count(), resets);
        }
    }

    #[test]
    fn an_origin_that_moved_while_away_is_made_up_for() {
        let old = EarthOrigin { latitude_e7: 473_977_435, longitude_e7: 85_455_941, altitude_mm: 489_367 };
        let mut world = WorldTransform::new(KeptTransform { origin: Some(old), ..KeptTransform::default() });
        world.origin(EarthOrigin { latitude_e7: old.latitude_e7 + 1000, altitude_mm: old.altitude_mm + 2000, ..old });
        // 1e-4 deg of latitude are 11.12 m: the new origin lies that far north, so its zero is there in the world.
        assert!((world.offset_m() - DVec3::new(0.0, 11.12, 2.0)).length() < 0.01);
    }

    #[test]
    fn an_origin_that_is_heard_after_the_position_counts_all_the_same_and_a_reset_without_one_is_told() {
        let old = EarthOrigin { latitude_e7: 473_977_435, longitude_e7: 85_455_941, altitude_mm: 489_367 };
        let kept = KeptTransform { origin: Some(old), reset_counter: Some(4), ..KeptTransform::default() };
        let mut world = WorldTransform::new(kept);
        world.fix(1, DVec3::ZERO, DVec3::ZERO, Some(5));
        assert!(world.moved_unexplained());
        world.origin(EarthOrigin { altitude_mm: old.altitude_mm + 2000, ..old });
        assert!(!world.moved_unexplained() && world.reset_count() == 1);
        assert!((world.fix(20_000_000, DVec3::ZERO, DVec3::ZERO, Some(5)).z - 2.0).abs() < 1e-9);
        // The same origin again, and one that moves while px4-link watches, change nothing.
        world.origin(old);
        assert!((world.offset_m().z - 2.0).abs() < 1e-9);
        let mut unexplained = WorldTransform::new(kept);
        unexplained.fix(1, DVec3::ZERO, DVec3::ZERO, Some(5));
        unexplained.origin(old);
        assert!(unexplained.moved_unexplained() && unexplained.offset_m() == DVec3::ZERO);
        unexplained.accept();
        assert!(!unexplained.moved_unexplained());
    }
}
