//! The path that the auto modes follow: towards a point with limited speed and acceleration.

use glam::{DVec2, DVec3};

/// Limits of a moment, m/s and m/s².
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Horizontal speed.
    pub horizontal_mps: f64,
    /// Climb.
    pub up_mps: f64,
    /// Descent.
    pub down_mps: f64,
    /// Acceleration of any direction.
    pub acceleration_mps2: f64,
}

/// A moving setpoint. NED.
#[derive(Debug, Clone, Copy)]
pub struct Trajectory {
    /// Where the setpoint is, metres.
    pub position_m: DVec3,
    /// How it moves, m/s.
    pub velocity_mps: DVec3,
}

impl Trajectory {
    /// Begins where the vehicle is, as it moves.
    #[must_use]
    pub fn from_state(position_m: DVec3, velocity_mps: DVec3) -> Self {
        Self { position_m, velocity_mps }
    }

    /// Where it would stop if it braked now.
    #[must_use]
    pub fn stopping_point(&self, acceleration_mps2: f64) -> DVec3 {
        let a = acceleration_mps2.max(0.1);
        self.position_m + self.velocity_mps * (self.velocity_mps.length() / (2.0 * a))
    }

    /// Shifts with a jump of the estimate.
    pub fn shift(&mut self, jump_m: DVec3) {
        self.position_m += jump_m;
    }

    /// Moves for `dt_s` towards a target.
    pub fn step(&mut self, target_m: DVec3, limits: &Limits, dt_s: f64) {
        let a = limits.acceleration_mps2.max(0.1);
        let away = target_m - self.position_m;
        let horizontal = slow_to(away.truncate(), limits.horizontal_mps, a, dt_s);
        let limit_z = if away.z < 0.0 { limits.up_mps } else { limits.down_mps };
        let vertical = slow_to(DVec2::new(away.z, 0.0), limit_z, a, dt_s).x;
        let change = horizontal.extend(vertical) - self.velocity_mps;
        let flat = change.truncate().clamp_length_max(a * dt_s);
        self.velocity_mps += flat.extend(change.z.clamp(-a * dt_s, a * dt_s));
        self.position_m += self.velocity_mps * dt_s;
        if (target_m - self.position_m).length() < 0.01 && self.velocity_mps.length() < 0.05 {
            *self = Self::from_state(target_m, DVec3::ZERO);
        }
    }
}

/// The velocity from which the way that is left still suffices to stop, braking with a margin.
fn slow_to(away: DVec2, limit_mps: f64, acceleration_mps2: f64, dt_s: f64) -> DVec2 {
    let distance = away.length();
    let braking = (2.0 * 0.7 * acceleration_mps2 * distance).sqrt().min(distance / (2.0 * dt_s));
    away.normalize_or_zero() * braking.min(limit_mps.max(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    proptest::proptest! {
        #[test]
        fn it_arrives_within_its_limits(
            from in proptest::array::uniform3(-20.0..20.0f64),
            to in proptest::array::uniform3(-20.0..20.0f64),
            velocity in proptest::array::uniform3(-3.0..3.0f64),
        ) {
            let limits = Limits { horizontal_mps: 5.0, up_mps: 3.0, down_mps: 1.5, acceleration_mps2: 3.0 };
            let target = DVec3::from_array(to);
            let mut t = Trajectory::from_state(DVec3::from_array(from), DVec3::from_array(velocity));
            for _ in 0..6000 {
                let before = t.velocity_mps;
                t.step(target, &limits, 0.01);
                proptest::prop_assert!((t.velocity_mps - before).length() <= 3.0 * 1.5 * 0.01 + 0.06);
                proptest::prop_assert!(t.velocity_mps.truncate().length() <= 5.1);
            }
            proptest::prop_assert!((t.position_m - target).length() < 0.02, "{:?}", t);
        }
    }
}
