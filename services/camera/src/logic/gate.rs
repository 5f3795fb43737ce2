//! The capture gate: which instant after the arrival gives the image whose pose is known best.
//!
//! An image stamped with an uncertainty σ_t by a camera that moves at v and turns at ω has a pose that is off by |v|·σ_t
//! and |ω|·σ_t; seen at a distance d both are angles, and their sum is the cost of an instant. A real hover wanders, so
//! limits alone may never be met: after a while the stillest instant is taken and flagged.

use shared_types::config::CameraConfig;
use shared_types::ns_from_s;

use super::pose_buffer::CameraMotion;

/// How still the camera is at an instant, and what that costs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stillness {
    /// Camera speed times uncertainty of the stamp, metres.
    pub position_m: f64,
    /// Angular rate times uncertainty of the stamp, radians.
    pub angle_rad: f64,
    /// Motion blur at what the camera looks at, pixels.
    pub blur_px: f64,
    /// |v|·σ_t/d + |ω|·σ_t, radians: the gate minimises it.
    pub cost_rad: f64,
    /// Uncertainty of the stamp that was reckoned with, seconds.
    pub time_uncertainty_s: f64,
}

impl Stillness {
    /// Stillness of a camera that looks at something `distance_m` away.
    #[must_use]
    pub fn of(config: &CameraConfig, motion: &CameraMotion, distance_m: f64, time_uncertainty_s: f64) -> Self {
        let sigma = time_uncertainty_s.max(config.time_uncertainty_min_s);
        let turn_radps = motion.speed_mps / distance_m.max(0.1) + motion.rate_radps;
        Self {
            position_m: motion.speed_mps * sigma,
            angle_rad: motion.rate_radps * sigma,
            blur_px: config.intrinsics().fx * turn_radps * config.exposure_s,
            cost_rad: turn_radps * sigma,
            time_uncertainty_s: sigma,
        }
    }
}

/// Limits of the gate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Time after arrival within which the stillest instant is looked for, nanoseconds.
    pub window_ns: u64,
    /// Time after arrival at which any instant will do, nanoseconds.
    pub give_up_ns: u64,
    /// See [`Stillness::position_m`].
    pub position_m: f64,
    /// See [`Stillness::angle_rad`].
    pub angle_rad: f64,
    /// See [`Stillness::blur_px`].
    pub blur_px: f64,
    /// Share of every limit below which an instant is taken at once.
    pub at_once: f64,
}

impl Limits {
    /// The limits of a configuration.
    #[must_use]
    pub fn of(config: &CameraConfig) -> Self {
        Self {
            window_ns: ns_from_s(config.gate_window_s),
            give_up_ns: ns_from_s(config.gate_give_up_s),
            position_m: config.gate_position_m,
            angle_rad: config.gate_angle_rad,
            blur_px: config.gate_blur_px,
            at_once: config.gate_at_once,
        }
    }

    /// Whether an instant is within a share of every limit.
    #[must_use]
    pub fn admit(&self, still: &Stillness, share: f64) -> bool {
        still.position_m <= self.position_m * share
            && still.angle_rad <= self.angle_rad * share
            && still.blur_px <= self.blur_px * share
    }
}

/// An instant at which the image could be taken.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shot {
    /// Mission time.
    pub stamp_ns: u64,
    /// The camera then.
    pub motion: CameraMotion,
    /// How still it was.
    pub still: Stillness,
    /// Whether the gate was never met and this is the stillest.
    pub gate_missed: bool,
}

/// The gate of one view, from the arrival on.
#[derive(Debug, Clone, PartialEq)]
pub struct Gate {
    limits: Limits,
    arrived_ns: u64,
    admitted: Option<Shot>,
    stillest: Option<Shot>,
}

impl Gate {
    /// Opens at the arrival.
    #[must_use]
    pub fn new(limits: Limits, arrived_ns: u64) -> Self {
        Self { limits, arrived_ns, admitted: None, stillest: None }
    }

    /// Considers an instant. Of equally still ones the earlier counts.
    pub fn offer(&mut self, shot: Shot) {
        if shot.stamp_ns < self.arrived_ns || !shot.still.cost_rad.is_finite() {
            return;
        }
        let better = |held: &Option<Shot>| held.is_none_or(|held| shot.still.cost_rad < held.still.cost_rad);
        if better(&self.stillest) {
            self.stillest = Some(shot);
        }
        if self.limits.admit(&shot.still, 1.0) && better(&self.admitted) {
            self.admitted = Some(shot);
        }
    }

    /// The instant to take, once that is decided.
    #[must_use]
    pub fn decide(&self, now_ns: u64) -> Option<Shot> {
        let waited_ns = now_ns.saturating_sub(self.arrived_ns);
        match (self.admitted, self.stillest) {
            (Some(shot), _) if self.limits.admit(&shot.still, self.limits.at_once) => Some(shot),
            (Some(shot), _) if waited_ns >= self.limits.window_ns => Some(shot),
            (None, Some(shot)) if waited_ns >= self.limits.give_up_ns => Some(Shot { gate_missed: true, ..shot }),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use shared_types::frames::Pose;

    use super::*;

    const MS: u64 = 1_000_000;

    fn shot(ms: u64, speed_mps: f64, rate_radps: f64) -> Shot {
        let motion = CameraMotion { world_from_camera: Pose::IDENTITY, speed_mps, rate_radps };
        let still = Stillness::of(&CameraConfig::default(), &motion, 1.5, 0.002);
        Shot { stamp_ns: ms * MS, motion, still, gate_missed: false }
    }

    fn patient() -> Limits {
        Limits { at_once: 0.0, ..Limits::of(&CameraConfig::default()) }
    }

    #[test]
    fn the_figures_are_those_of_the_formula() {
        let still = shot(0, 0.3, 0.2).still;
        assert!((still.position_m - 0.3 * 0.002).abs() < 1e-12);
        assert!((still.angle_rad - 0.2 * 0.002).abs() < 1e-12);
        assert!((still.cost_rad - (0.3 / 1.5 + 0.2) * 0.002).abs() < 1e-12);
        // f = 320 / tan(0.602) = 465.7 px; 0.4 rad/s over 4 ms.
        assert!((still.blur_px - 465.7 * 0.4 * 0.004).abs() < 1e-3, "{}", still.blur_px);
    }

    #[test]
    fn each_limit_alone_closes_the_gate() {
        let limits = Limits { blur_px: 1e9, ..patient() };
        assert!(limits.admit(&shot(0, 0.99, 0.0).still, 1.0) && !limits.admit(&shot(0, 1.01, 0.0).still, 1.0));
        // 0.06 degrees in 2 ms is 0.5236 rad/s.
        assert!(limits.admit(&shot(0, 0.0, 0.52).still, 1.0) && !limits.admit(&shot(0, 0.0, 0.53).still, 1.0));
        // 0.3 px of blur is 0.161 rad/s.
        assert!(patient().admit(&shot(0, 0.0, 0.160).still, 1.0) && !patient().admit(&shot(0, 0.0, 0.162).still, 1.0));
    }

    #[test]
    fn a_very_still_instant_is_taken_at_once() {
        let mut gate = Gate::new(Limits::of(&CameraConfig::default()), 1_000 * MS);
        gate.offer(shot(1_020, 0.1, 0.02));
        assert_eq!(gate.decide(1_030 * MS), None, "within the limits, but better may come");
        gate.offer(shot(1_040, 0.01, 0.01));
        assert_eq!(gate.decide(1_050 * MS).map(|shot| shot.stamp_ns), Some(1_040 * MS));
    }

    #[test]
    fn after_the_window_the_first_that_meets_the_limits_is_taken() {
        let mut gate = Gate::new(patient(), 1_000 * MS);
        gate.offer(shot(1_500, 2.0, 2.0));
        assert_eq!(gate.decide(2_500 * MS), None);
        gate.offer(shot(2_510, 0.01, 0.01));
        let taken = gate.decide(2_520 * MS).expect("taken");
        assert!(taken.stamp_ns == 2_510 * MS && !taken.gate_missed);
    }

    proptest! {
        #[test]
        fn the_gate_takes_the_cheapest_admitted_else_the_stillest_flagged(
            speeds in prop::collection::vec((0.0..0.5f64, 0.0..0.4f64), 1..60), still_share in 0.0..1.0f64,
        ) {
            let mut gate = Gate::new(patient(), 1_000 * MS);
            let shots: Vec<Shot> = speeds.iter().zip(0..).map(|(&(v, w), i)| {
                let scale = if still_share > 0.5 { 0.1 } else { 1.0 };
                shot(1_010 + i * 16, v * scale, w * scale)
            }).collect();
            gate.offer(shot(990, 0.0, 0.0));
            for &shot in &shots {
                gate.offer(shot);
                prop_assert_eq!(gate.decide(1_999 * MS), None);
            }
            let limits = patient();
            let cheapest = |only: &dyn Fn(&Shot) -> bool| shots.iter().filter(|s| only(s))
                .map(|s| s.still.cost_rad).fold(f64::INFINITY, f64::min);
            let admitted = cheapest(&|s| limits.admit(&s.still, 1.0));
            let taken = gate.decide(2_000 * MS);
            if admitted.is_finite() {
                let taken = taken.expect("one is admitted");
                prop_assert!(!taken.gate_missed && taken.still.cost_rad <= admitted);
            } else {
                prop_assert_eq!(taken, None);
                prop_assert_eq!(gate.decide(3_999 * MS), None);
                let taken = gate.decide(4_000 * MS).expect("after 3 s any will do");
                prop_assert!(taken.gate_missed && taken.still.cost_rad <= cheapest(&|_| true));
            }
        }
    }
}
