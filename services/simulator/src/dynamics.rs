//! The body: an X500 whose thrust follows the cascade through the lag of tilting, with drag, wind and the ground.
//!
//! The constants are tuned so that position and yaw steps of the whole loop match what a real PX4 flew: 15 m peaks at
//! 6.9 m/s with 0.2 m overshoot, 20 m at 8.3 m/s, a 170° turn at 168°/s with 20° overshoot.

use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::control::{ControlOutput, GRAVITY_MPS2};
use crate::frames::{from_euler, wrap_pi};

/// First-order lag of the attitude loop, s.
const TILT_LAG_S: f64 = 0.25;
/// Lag of the rate loop in front of it, s; keeps the angular rate continuous.
const RATE_LAG_S: f64 = 0.03;
/// Largest tilt of the body, radians: the attitude loop's overshoot over MPC_TILTMAX_AIR is small.
const TILT_MAX_RAD: f64 = 0.84;
/// Lag of the collective thrust, s.
const THRUST_LAG_S: f64 = 0.05;
/// Drag over mass, 1/s.
const DRAG_PER_S: f64 = 0.7;
/// Lag of the yaw rate loop, s, and the largest yaw acceleration, rad/s²: yaw authority of a quadcopter is small.
const YAW_LAG_S: f64 = 0.3;
const YAW_ACCELERATION_MAX_RADPS2: f64 = 4.0;
/// Height of the body's origin when it stands on the ground: the local frame's zero is where it stands.
const GROUND_Z_M: f64 = 0.0;

/// The true state of the body. NED and FRD, metres, radians.
#[derive(Debug, Clone)]
pub struct Body {
    /// Position.
    pub position_m: DVec3,
    /// Velocity.
    pub velocity_mps: DVec3,
    /// Acceleration (of the motion; 0 in a hover).
    pub acceleration_mps2: DVec3,
    /// Attitude.
    pub ned_from_frd: DQuat,
    /// Angular rates about the body's axes.
    pub rates_radps: DVec3,
    /// Standing on the ground.
    pub on_ground: bool,
    force_mps2: DVec3,
    force_rate_stage_mps2: DVec3,
    yaw_rad: f64,
    yaw_rate_radps: f64,
}

impl Body {
    /// A body standing on the ground at a place of the local frame.
    #[must_use]
    pub fn standing(north_m: f64, east_m: f64, yaw_rad: f64) -> Self {
        Self {
            position_m: DVec3::new(north_m, east_m, GROUND_Z_M),
            velocity_mps: DVec3::ZERO,
            acceleration_mps2: DVec3::ZERO,
            ned_from_frd: from_euler(0.0, 0.0, yaw_rad),
            rates_radps: DVec3::ZERO,
            on_ground: true,
            force_mps2: DVec3::ZERO,
            force_rate_stage_mps2: DVec3::ZERO,
            yaw_rad: wrap_pi(yaw_rad),
            yaw_rate_radps: 0.0,
        }
    }

    /// True heading, radians.
    #[must_use]
    pub fn yaw_rad(&self) -> f64 {
        self.yaw_rad
    }

    /// Thrust per mass that acts now, m/s².
    #[must_use]
    pub fn specific_force_mps2(&self) -> DVec3 {
        self.force_mps2
    }

    /// Height above the ground, metres.
    #[must_use]
    pub fn height_m(&self) -> f64 {
        GROUND_Z_M - self.position_m.z
    }

    /// Advances by `dt_s` (semi-implicit Euler). `command` is in the true NED frame.
    pub fn step(&mut self, command: &ControlOutput, wind_mps: DVec3, dt_s: f64) {
        self.step_force(command.specific_force_mps2, dt_s);
        self.step_yaw(command.yaw_rate_radps, dt_s);

        let drag = (wind_mps - self.velocity_mps) * DRAG_PER_S;
        let mut acceleration = self.force_mps2 + DVec3::Z * GRAVITY_MPS2 + drag;
        let touches = self.position_m.z >= GROUND_Z_M;
        if touches && acceleration.z >= 0.0 && self.velocity_mps.z >= 0.0 {
            // The ground carries it and holds its feet.
            acceleration = DVec3::ZERO;
            self.velocity_mps = DVec3::ZERO;
            self.position_m.z = GROUND_Z_M;
            self.on_ground = true;
        } else {
            self.velocity_mps += acceleration * dt_s;
            self.position_m += self.velocity_mps * dt_s;
            self.on_ground = self.position_m.z >= GROUND_Z_M;
            if self.on_ground {
                self.position_m.z = GROUND_Z_M;
                self.velocity_mps = DVec3::ZERO;
            }
        }
        self.acceleration_mps2 = acceleration;
        self.step_attitude(dt_s);
    }

    fn step_force(&mut self, wanted: DVec3, dt_s: f64) {
        let stage = 1.0 - (-dt_s / RATE_LAG_S).exp();
        let tilt = 1.0 - (-dt_s / TILT_LAG_S).exp();
        let thrust = 1.0 - (-dt_s / THRUST_LAG_S).exp();
        self.force_rate_stage_mps2 += (wanted - self.force_rate_stage_mps2) * stage;
        let horizontal = self.force_mps2.truncate();
        let lagged: DVec2 = horizontal + (self.force_rate_stage_mps2.truncate() - horizontal) * tilt;
        let vertical = self.force_mps2.z + (wanted.z - self.force_mps2.z) * thrust;
        // Less thrust at the same tilt pulls less sideways: the tilt never passes its limit.
        let tilted = (-vertical).max(0.0) * TILT_MAX_RAD.tan();
        self.force_mps2 = lagged.clamp_length_max(tilted).extend(vertical);
    }

    fn step_yaw(&mut self, wanted_radps: f64, dt_s: f64) {
        let acceleration = ((wanted_radps - self.yaw_rate_radps) / YAW_LAG_S)
            .clamp(-YAW_ACCELERATION_MAX_RADPS2, YAW_ACCELERATION_MAX_RADPS2);
        self.yaw_rate_radps += acceleration * dt_s;
        if self.on_ground {
            self.yaw_rate_radps = 0.0;
        }
        self.yaw_rad = wrap_pi(self.yaw_rad + self.yaw_rate_radps * dt_s);
    }

    /// The body's z axis lies against the thrust; on the ground it stands level.
    fn step_attitude(&mut self, dt_s: f64) {
        let thrust = self.force_mps2;
        let down = if self.on_ground || thrust.z > -1.0 { DVec3::Z } else { -thrust / thrust.length() };
        let (sin, cos) = self.yaw_rad.sin_cos();
        let heading = DVec3::new(cos, sin, 0.0);
        let right = down.cross(heading).normalize_or(DVec3::Y);
        let forward = right.cross(down);
        let next = DQuat::from_mat3(&DMat3::from_cols(forward, right, down)).normalize();
        let turn = self.ned_from_frd.inverse() * next;
        let turn = if turn.w < 0.0 { -turn } else { turn };
        self.rates_radps = turn.to_scaled_axis() / dt_s;
        self.ned_from_frd = next;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::{MotionSetpoint, PositionControl};
    use crate::estimator::Estimate;
    use crate::frames::yaw_of;
    use crate::params::{Params, Value};

    const DT_S: f64 = 0.0025;

    fn estimate(body: &Body) -> Estimate {
        Estimate {
            position_m: body.position_m,
            velocity_mps: body.velocity_mps,
            acceleration_mps2: body.acceleration_mps2,
            ned_from_frd: body.ned_from_frd,
            rates_radps: body.rates_radps,
            reset_counter: 0,
        }
    }

    fn hovering() -> Body {
        let mut body = Body::standing(0.0, 0.0, 0.0);
        body.position_m.z = -20.0;
        body.on_ground = false;
        body.force_mps2 = -DVec3::Z * GRAVITY_MPS2;
        body.force_rate_stage_mps2 = body.force_mps2;
        body
    }

    /// Flies a setpoint of the time and gives each step's state.
    fn fly(params: &Params, wind: DVec3, seconds: f64, setpoint: impl Fn(f64) -> MotionSetpoint) -> Vec<(f64, Body)> {
        let mut body = hovering();
        let mut control = PositionControl::new(0.0);
        let steps = (seconds / DT_S) as usize;
        (0..steps)
            .map(|i| {
                let t = i as f64 * DT_S;
                let out = control.update(&setpoint(t), &estimate(&body), params, 3.0, DT_S);
                body.step(&out, wind, DT_S);
                (t, body.clone())
            })
            .collect()
    }

    fn go_to(target: DVec3) -> impl Fn(f64) -> MotionSetpoint {
        move |_| MotionSetpoint { position_m: target, yaw_rad: 0.0, ..MotionSetpoint::NONE }
    }

    fn peak_speed(track: &[(f64, Body)]) -> (f64, f64) {
        track.iter().fold((0.0, 0.0), |best, (t, b)| {
            let v = b.velocity_mps.length();
            if v > best.0 { (v, *t) } else { best }
        })
    }

    fn step(metres: f64) -> Vec<(f64, Body)> {
        fly(&Params::default(), DVec3::ZERO, 12.0, go_to(DVec3::new(metres, 0.0, -20.0)))
    }

    #[test]
    fn position_steps_peak_as_the_real_autopilot_does() {
        for (metres, low, high) in
            [(10.0, 5.1 * 0.85, 5.9 * 1.15), (15.0, 6.9 * 0.85, 6.9 * 1.15), (20.0, 8.3 * 0.85, 8.3 * 1.15)]
        {
            let track = step(metres);
            let (peak, at) = peak_speed(&track);
            assert!((low..high).contains(&peak), "{metres} m peaks at {peak:.2} m/s after {at:.2} s");
        }
        let track = step(15.0);
        let (_, at) = peak_speed(&track);
        assert!((1.4..2.6).contains(&at), "peak after {at:.2} s, measured 1.9");
        let overshoot = track.iter().map(|(_, b)| b.position_m.x).fold(0.0, f64::max) - 15.0;
        assert!((0.0..0.6).contains(&overshoot), "{overshoot:.2} m");
        let settled = track.iter().rev().find(|(_, b)| (b.position_m.x - 15.0).abs() > 0.25).map_or(0.0, |(t, _)| *t);
        assert!((3.5..7.5).contains(&settled), "settled after {settled:.2} s, measured 5");
    }

    #[test]
    fn climbs_and_sinks_at_the_limits_of_the_parameters() {
        let up = fly(&Params::default(), DVec3::ZERO, 6.0, go_to(DVec3::new(0.0, 0.0, -25.0)));
        let down = fly(&Params::default(), DVec3::ZERO, 8.0, go_to(DVec3::new(0.0, 0.0, -15.0)));
        let (up, _) = peak_speed(&up);
        let (down, _) = peak_speed(&down);
        assert!((2.2..3.1).contains(&up), "{up:.2}, measured 2.6");
        assert!((1.2..1.6).contains(&down), "{down:.2}, measured 1.4");

        let mut slow = Params::default();
        assert!(slow.set("MPC_XY_VEL_MAX", Value::Real(2.0)).is_ok());
        let (peak, _) = peak_speed(&fly(&slow, DVec3::ZERO, 10.0, go_to(DVec3::new(15.0, 0.0, -20.0))));
        assert!((1.6..2.2).contains(&peak), "{peak:.2}, measured 1.8");
    }

    #[test]
    fn velocity_feed_forward_shortens_the_lag() {
        // 10 m with 1 m/s² up to 2 m/s, as measured: 3.2 m behind without feed-forward, 1.25 m with it.
        let profile = |t: f64| -> (f64, f64) {
            if t < 2.0 {
                (0.5 * t * t, t)
            } else if t < 5.0 {
                (2.0 + 2.0 * (t - 2.0), 2.0)
            } else if t < 7.0 {
                let u = 7.0 - t;
                (10.0 - 0.5 * u * u, u)
            } else {
                (10.0, 0.0)
            }
        };
        let lag = |with: bool| {
            fly(&Params::default(), DVec3::ZERO, 10.0, |t| MotionSetpoint {
                position_m: DVec3::new(profile(t).0, 0.0, -20.0),
                velocity_mps: if with { DVec3::new(profile(t).1, 0.0, 0.0) } else { DVec3::NAN },
                yaw_rad: 0.0,
                ..MotionSetpoint::NONE
            })
            .iter()
            .map(|(t, b)| (profile(*t).0 - b.position_m.x).abs())
            .fold(0.0, f64::max)
        };
        let (without, with) = (lag(false), lag(true));
        assert!((2.2..3.6).contains(&without), "{without:.2}, measured 3.2");
        assert!((0.3..1.5).contains(&with), "{with:.2}, measured 1.25");
    }

    #[test]
    fn a_yaw_step_turns_fast_and_overshoots() {
        let target = 170.0f64.to_radians();
        let track = fly(&Params::default(), DVec3::ZERO, 6.0, |_| MotionSetpoint {
            position_m: DVec3::new(0.0, 0.0, -20.0),
            yaw_rad: target,
            ..MotionSetpoint::NONE
        });
        let rate = track.iter().map(|(_, b)| b.rates_radps.z.to_degrees()).fold(0.0, f64::max);
        let overshoot = track
            .iter()
            .map(|(_, b)| wrap_pi(yaw_of(b.ned_from_frd) - target))
            .filter(|e| e.abs() < 1.0)
            .fold(0.0, f64::max)
            .to_degrees();
        assert!((145.0..190.0).contains(&rate), "{rate:.1}°/s, measured 168");
        assert!((10.0..30.0).contains(&overshoot), "{overshoot:.1}°, measured 20");
        let last = track.last().map_or(0.0, |(_, b)| wrap_pi(yaw_of(b.ned_from_frd) - target)).to_degrees();
        assert!(last.abs() < 1.0, "{last:.2}");
    }

    #[test]
    fn wind_is_leaned_into_and_held_against() {
        let track = fly(&Params::default(), DVec3::new(5.0, 0.0, 0.0), 25.0, go_to(DVec3::new(0.0, 0.0, -20.0)));
        let Some((_, last)) = track.last() else { return };
        assert!(last.position_m.truncate().length() < 0.1, "{}", last.position_m);
        assert!((last.ned_from_frd * DVec3::Z).x > 0.05, "leans north, against the wind to the north");
    }

    #[test]
    fn without_thrust_it_falls_and_stays_down() {
        let mut body = hovering();
        for _ in 0..4000 {
            body.step(&ControlOutput::IDLE, DVec3::ZERO, DT_S);
        }
        assert!(body.on_ground && body.position_m.z == 0.0 && body.velocity_mps == DVec3::ZERO);
    }

    proptest::proptest! {
        #![proptest_config(proptest::prelude::ProptestConfig::with_cases(40))]
        #[test]
        fn never_nan_never_below_ground_never_beyond_the_limits(
            targets in proptest::collection::vec(proptest::array::uniform4(-60.0..60.0f64), 1..5),
            wind in proptest::array::uniform3(-8.0..8.0f64),
        ) {
            let params = Params::default();
            let mut body = Body::standing(0.0, 0.0, 1.0);
            let mut control = PositionControl::new(1.0);
            for t in targets {
                let setpoint = MotionSetpoint {
                    position_m: DVec3::new(t[0], t[1], t[2]),
                    yaw_rad: t[3],
                    ..MotionSetpoint::NONE
                };
                for _ in 0..2000 {
                    let out = control.update(&setpoint, &estimate(&body), &params, 3.0, DT_S);
                    body.step(&out, DVec3::from_array(wind), DT_S);
                    proptest::prop_assert!(body.position_m.is_finite() && body.velocity_mps.is_finite());
                    proptest::prop_assert!(body.ned_from_frd.is_finite() && body.rates_radps.is_finite());
                    proptest::prop_assert!(body.position_m.z <= 0.0);
                    proptest::prop_assert!(body.velocity_mps.truncate().length() < 14.0);
                    let tilt = (body.ned_from_frd * DVec3::Z).z.clamp(-1.0, 1.0).acos().to_degrees();
                    proptest::prop_assert!(tilt < 49.0, "{tilt}");
                }
            }
        }
    }
}
