//! What the vehicle believes against what is true: four estimator models, and resets.
//!
//! Errors wander smoothly (a second-order Gauss-Markov process, so that the velocity error is the position error's
//! derivative). The figures are root-mean-square lengths of the error: of position over three axes, of attitude over
//! roll, pitch and yaw. The autopilot flies on the estimate, so the true vehicle wanders by the estimate's error.

use glam::{DQuat, DVec3};

use crate::dynamics::Body;
use crate::rng::Rng;

/// PX4's boot value of ODOMETRY.reset_counter, as seen on the real autopilot.
const RESET_COUNTER_AT_BOOT: u8 = 11;

/// Which estimator the vehicle has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EstimatorModel {
    /// The truth.
    Exact,
    /// Visual-inertial: 10 mm, 0.2°.
    Vio,
    /// RTK GNSS: 20 mm, 0.5°.
    Rtk,
    /// Plain GNSS: 0.3 m wander, 2° heading bias, 0.3° of tilt.
    Gnss,
}

impl EstimatorModel {
    /// The model of a name in the configuration.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "exact" => Self::Exact,
            "vio" => Self::Vio,
            "rtk" => Self::Rtk,
            "gnss" => Self::Gnss,
            _ => return None,
        })
    }

    fn figures(self) -> Figures {
        let figures = |position_m, position_tau_s, attitude_deg: f64, bias_deg: f64| Figures {
            position_sigma_m: position_m / 3f64.sqrt(),
            position_tau_s,
            attitude_sigma_rad: attitude_deg.to_radians() / 3f64.sqrt(),
            yaw_bias_rad: bias_deg.to_radians(),
        };
        match self {
            Self::Exact => figures(0.0, 1.0, 0.0, 0.0),
            Self::Vio => figures(0.010, 4.0, 0.2, 0.0),
            Self::Rtk => figures(0.020, 4.0, 0.5, 0.0),
            Self::Gnss => figures(0.3, 15.0, 0.3, 2.0),
        }
    }
}

#[derive(Debug, Clone, Copy)]
struct Figures {
    position_sigma_m: f64,
    position_tau_s: f64,
    attitude_sigma_rad: f64,
    yaw_bias_rad: f64,
}

/// Correlation time of the attitude error, s.
const ATTITUDE_TAU_S: f64 = 3.0;

/// What the autopilot believes. NED and FRD, metres, radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Position.
    pub position_m: DVec3,
    /// Velocity.
    pub velocity_mps: DVec3,
    /// Acceleration of the motion.
    pub acceleration_mps2: DVec3,
    /// Attitude.
    pub ned_from_frd: DQuat,
    /// Angular rates about the body's axes.
    pub rates_radps: DVec3,
    /// Counts resets, as ODOMETRY.reset_counter.
    pub reset_counter: u8,
}

impl Default for Estimate {
    fn default() -> Self {
        Self {
            position_m: DVec3::ZERO,
            velocity_mps: DVec3::ZERO,
            acceleration_mps2: DVec3::ZERO,
            ned_from_frd: DQuat::IDENTITY,
            rates_radps: DVec3::ZERO,
            reset_counter: RESET_COUNTER_AT_BOOT,
        }
    }
}

/// A smooth wander of three axes with standard deviation 1 each.
#[derive(Debug, Clone)]
struct Wander {
    inner: DVec3,
    value: DVec3,
    tau_s: f64,
}

impl Wander {
    /// Begins in its stationary distribution, so that the first second is like any other.
    fn new(tau_s: f64, rng: &mut Rng) -> Self {
        let mut draw = || DVec3::new(rng.normal(), rng.normal(), rng.normal());
        // Two cascaded lags of equal time constant: variance 1/2 of the inner one, covariance 1/2.
        let value = draw() * core::f64::consts::FRAC_1_SQRT_2;
        let inner = value + draw() * core::f64::consts::FRAC_1_SQRT_2;
        Self { inner, value, tau_s }
    }

    /// Advances and gives (value, derivative), each scaled to standard deviation 1 of the value.
    fn step(&mut self, dt_s: f64, rng: &mut Rng) -> (DVec3, DVec3) {
        let keep = (-dt_s / self.tau_s).exp();
        let noise = (1.0 - keep * keep).sqrt();
        self.inner = self.inner * keep + DVec3::new(rng.normal(), rng.normal(), rng.normal()) * noise;
        let rate = (self.inner - self.value) / self.tau_s;
        self.value += rate * dt_s;
        (self.value * core::f64::consts::SQRT_2, rate * core::f64::consts::SQRT_2)
    }
}

/// An estimator: a model, its wander, and the jumps it has made.
#[derive(Debug, Clone)]
pub struct Estimator {
    model: EstimatorModel,
    figures: Figures,
    rng: Rng,
    position: Wander,
    attitude: Wander,
    yaw_sign: f64,
    attitude_error: DQuat,
    jump_m: DVec3,
    reset_counter: u8,
}

impl Estimator {
    /// An estimator with a seed of its own.
    #[must_use]
    pub fn new(model: EstimatorModel, seed: u64) -> Self {
        let figures = model.figures();
        let mut rng = Rng::new(seed ^ 0x6573_7469_6d61_7465);
        let position = Wander::new(figures.position_tau_s, &mut rng);
        let attitude = Wander::new(ATTITUDE_TAU_S, &mut rng);
        let yaw_sign = if rng.uniform() < 0.5 { -1.0 } else { 1.0 };
        Self {
            model,
            figures,
            rng,
            position,
            attitude,
            yaw_sign,
            attitude_error: DQuat::IDENTITY,
            jump_m: DVec3::ZERO,
            reset_counter: RESET_COUNTER_AT_BOOT,
        }
    }

    /// Which model it is.
    #[must_use]
    pub fn model(&self) -> EstimatorModel {
        self.model
    }

    /// The rotation from the true to the believed NED frame at the last step.
    #[must_use]
    pub fn attitude_error(&self) -> DQuat {
        self.attitude_error
    }

    /// The estimator has put its origin elsewhere when it was started: from the world's, metres.
    pub fn set_origin(&mut self, origin_m: DVec3) {
        self.jump_m = -origin_m;
    }

    /// The estimate jumps by a vector, as when an EKF resets; the reset counter says so.
    pub fn reset_by(&mut self, jump_m: DVec3) {
        if jump_m.is_finite() {
            self.jump_m += jump_m;
            self.reset_counter = self.reset_counter.wrapping_add(1);
        }
    }

    /// The estimate of a true state after `dt_s`.
    pub fn step(&mut self, truth: &Body, dt_s: f64) -> Estimate {
        let mut estimate = Estimate {
            position_m: truth.position_m + self.jump_m,
            velocity_mps: truth.velocity_mps,
            acceleration_mps2: truth.acceleration_mps2,
            ned_from_frd: truth.ned_from_frd,
            rates_radps: truth.rates_radps,
            reset_counter: self.reset_counter,
        };
        if self.model == EstimatorModel::Exact {
            return estimate;
        }
        let (error, rate) = self.position.step(dt_s, &mut self.rng);
        estimate.position_m += error * self.figures.position_sigma_m;
        estimate.velocity_mps += rate * self.figures.position_sigma_m;
        let (tilt, _) = self.attitude.step(dt_s, &mut self.rng);
        let mut rotation = tilt * self.figures.attitude_sigma_rad;
        rotation.z += self.yaw_sign * self.figures.yaw_bias_rad;
        self.attitude_error = DQuat::from_scaled_axis(rotation);
        estimate.ned_from_frd = (self.attitude_error * truth.ned_from_frd).normalize();
        estimate
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn errors(model: EstimatorModel) -> (f64, f64, f64) {
        let body = Body::standing(0.0, 0.0, 0.3);
        let (mut position, mut attitude, mut velocity_gap, mut n) = (0.0, 0.0, 0.0f64, 0.0);
        for seed in 0..60 {
            let mut estimator = Estimator::new(model, seed);
            let mut last = estimator.step(&body, 0.01);
            for _ in 0..2000 {
                let next = estimator.step(&body, 0.01);
                let moved = (next.position_m - last.position_m) / 0.01;
                velocity_gap = velocity_gap.max((moved - next.velocity_mps).length());
                position += next.position_m.length_squared();
                attitude += (next.ned_from_frd * body.ned_from_frd.inverse()).to_scaled_axis().length_squared();
                n += 1.0;
                last = next;
            }
        }
        ((position / n).sqrt(), (attitude / n).sqrt().to_degrees(), velocity_gap)
    }

    #[test]
    fn each_model_errs_by_its_figures() {
        for (model, metres, degrees) in [
            (EstimatorModel::Exact, 0.0, 0.0),
            (EstimatorModel::Vio, 0.010, 0.2),
            (EstimatorModel::Rtk, 0.020, 0.5),
            (EstimatorModel::Gnss, 0.3, 2.02),
        ] {
            let (position, attitude, gap) = errors(model);
            assert!((position - metres).abs() <= 0.2 * metres, "{model:?}: {position:.4} m");
            assert!((attitude - degrees).abs() <= 0.2 * degrees, "{model:?}: {attitude:.3}°");
            assert!(gap < 1e-9, "{model:?}: velocity is not the derivative of position");
        }
    }

    #[test]
    fn a_reset_jumps_once_and_is_counted() {
        let body = Body::standing(1.0, 2.0, 0.0);
        let mut estimator = Estimator::new(EstimatorModel::Exact, 1);
        let before = estimator.step(&body, 0.01);
        estimator.reset_by(DVec3::new(0.5, 0.0, -1.0));
        let after = estimator.step(&body, 0.01);
        assert!((after.position_m - before.position_m).abs_diff_eq(DVec3::new(0.5, 0.0, -1.0), 1e-12));
        assert_eq!(after.reset_counter, before.reset_counter + 1);
        assert_eq!(estimator.step(&body, 0.01), after);
    }

    #[test]
    fn seeds_decide_the_wander() {
        let body = Body::standing(0.0, 0.0, 0.0);
        let run = |seed| {
            let mut e = Estimator::new(EstimatorModel::Gnss, seed);
            (0..100).map(|_| e.step(&body, 0.01)).last()
        };
        assert_eq!(run(3), run(3));
        assert_ne!(run(3), run(4));
    }
}
