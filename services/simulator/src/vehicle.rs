//! The whole vehicle: body, estimator, autopilot, gimbal and battery, advanced together by one tick of 10 ms.

use glam::{DQuat, DVec3};

use crate::autopilot::{Autopilot, Senses};
use crate::battery::Battery;
use crate::control::{ControlOutput, PositionControl};
use crate::dynamics::Body;
use crate::estimator::{Estimate, Estimator, EstimatorModel};
use crate::frames::{enu_from_flu, enu_from_ned, yaw_of};
use crate::gimbal::Gimbal;
use crate::params::{Param, Params, Value};

/// Length of a tick, ns.
pub const TICK_NS: u64 = 10_000_000;
/// Length of a tick, s.
pub const TICK_S: f64 = 0.01;
/// Steps of the body within a tick.
const SUBSTEPS: u32 = 4;
/// The local frame's origin on the earth, where PX4's simulation starts: degrees times 1e7, and millimetres above the sea.
const ORIGIN_LAT_E7: i32 = 473_977_435;
const ORIGIN_LON_E7: i32 = 85_455_941;
const ORIGIN_ALT_MM: i32 = 489_367;
const EARTH_RADIUS_M: f64 = 6_371_000.0;

/// How a vehicle is built.
#[derive(Debug, Clone)]
pub struct VehicleConfig {
    /// Decides every random number.
    pub seed: u64,
    /// Which estimator it flies on.
    pub estimator: EstimatorModel,
    /// Where it stands at boot, in the world (ENU), metres.
    pub start_enu_m: [f64; 2],
    /// Its heading at boot: counter-clockwise from east, radians.
    pub start_yaw_enu_rad: f64,
    /// Where the estimator puts its origin, in the world (ENU), metres.
    pub origin_enu_m: [f64; 3],
    /// Mean wind in the world (ENU), m/s.
    pub wind_enu_mps: [f64; 3],
    /// Gusts' standard deviation per axis, m/s.
    pub gust_mps: f64,
    /// Charge at boot, 0 to 1.
    pub battery: f64,
    /// Parameters that differ from their defaults.
    pub params: Vec<(String, f64)>,
    /// Jumps of the estimate: (seconds since boot, vector in the world's ENU, metres).
    pub resets: Vec<(f64, [f64; 3])>,
}

impl Default for VehicleConfig {
    fn default() -> Self {
        Self {
            seed: 1,
            estimator: EstimatorModel::Exact,
            start_enu_m: [0.0, 0.0],
            start_yaw_enu_rad: core::f64::consts::FRAC_PI_2,
            origin_enu_m: [0.0; 3],
            wind_enu_mps: [0.0; 3],
            gust_mps: 0.0,
            battery: 1.0,
            params: Vec::new(),
            resets: Vec::new(),
        }
    }
}

/// The true poses of a moment, in the world's frames: ENU and FLU.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrueState {
    /// Body, metres.
    pub position_m: DVec3,
    /// Velocity, m/s.
    pub velocity_mps: DVec3,
    /// Attitude of the body.
    pub world_from_body: DQuat,
    /// Attitude of the gimbal's payload (FLU: x along the optical axis).
    pub world_from_gimbal: DQuat,
}

/// The vehicle.
#[derive(Debug, Clone)]
pub struct Vehicle {
    /// Parameters.
    pub params: Params,
    /// Arming, modes, failsafes.
    pub autopilot: Autopilot,
    /// The gimbal.
    pub gimbal: Gimbal,
    /// The battery.
    pub battery: Battery,
    config: VehicleConfig,
    body: Body,
    estimator: Estimator,
    estimate: Estimate,
    control: PositionControl,
    gust: crate::rng::Rng,
    gust_mps: DVec3,
    ticks: u64,
    resets_done: usize,
    system_id: u8,
}

/// A parameter of the configuration that the vehicle does not take.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("simulator parameter {name} = {value}: {source}")]
pub struct BadParameter {
    /// Its name.
    pub name: String,
    /// The value that was wanted.
    pub value: f64,
    /// Why not.
    #[source]
    pub source: crate::params::ParamError,
}

impl Vehicle {
    /// Builds a vehicle standing at its start.
    ///
    /// # Errors
    /// A parameter of the configuration is unknown or not finite.
    pub fn new(mut config: VehicleConfig) -> Result<Self, BadParameter> {
        let mut params = Params::default();
        for (name, value) in &config.params {
            let index = Params::index_of(name);
            let typed = match index.and_then(|i| params.at(i)) {
                Some(Value::Int(_)) => Value::Int(value.round() as i32),
                _ => Value::Real(*value as f32),
            };
            params.set(name, typed).map_err(|source| BadParameter { name: name.clone(), value: *value, source })?;
        }
        config.resets.sort_by(|a, b| a.0.total_cmp(&b.0));
        let yaw = core::f64::consts::FRAC_PI_2 - config.start_yaw_enu_rad;
        let body = Body::standing(config.start_enu_m[1], config.start_enu_m[0], yaw);
        let mut estimator = Estimator::new(config.estimator, config.seed);
        estimator.set_origin(enu_from_ned(DVec3::from_array(config.origin_enu_m)));
        let estimate = estimator.step(&body, TICK_S / f64::from(SUBSTEPS));
        Ok(Self {
            autopilot: Autopilot::default(),
            gimbal: Gimbal::default(),
            battery: Battery::new(config.battery),
            body,
            estimator,
            estimate,
            control: PositionControl::new(yaw),
            gust: crate::rng::Rng::new(config.seed ^ 0x6775_7374),
            gust_mps: DVec3::ZERO,
            ticks: 0,
            resets_done: 0,
            system_id: u8::try_from(params.int(Param::MAV_SYS_ID)).unwrap_or(1).max(1),
            params,
            config,
        })
    }

    /// Time since boot, ns.
    #[must_use]
    pub fn boot_ns(&self) -> u64 {
        self.ticks * TICK_NS
    }

    /// Time since boot, s.
    #[must_use]
    pub fn boot_s(&self) -> f64 {
        self.ticks as f64 * TICK_S
    }

    /// The true body.
    #[must_use]
    pub fn body(&self) -> &Body {
        &self.body
    }

    /// What the vehicle believes.
    #[must_use]
    pub fn estimate(&self) -> &Estimate {
        &self.estimate
    }

    /// Wind that blows now, NED, m/s.
    #[must_use]
    pub fn wind_mps(&self) -> DVec3 {
        enu_from_ned(DVec3::from_array(self.config.wind_enu_mps)) + self.gust_mps
    }

    /// The estimate jumps (NED), as when an EKF resets.
    pub fn reset_estimate(&mut self, jump_m: DVec3) {
        self.estimator.reset_by(jump_m);
        self.autopilot.on_reset(jump_m);
    }

    /// Advances by one tick.
    pub fn step(&mut self) {
        self.ticks += 1;
        let now_s = self.boot_s();
        while let Some(&(at_s, jump)) = self.config.resets.get(self.resets_done)
            && at_s <= now_s
        {
            self.resets_done += 1;
            self.reset_estimate(enu_from_ned(DVec3::from_array(jump)));
        }
        let senses = Senses {
            now_s,
            estimate: self.estimate,
            contact: self.body.on_ground,
            height_m: self.body.height_m(),
            charge: self.battery.charge(&self.params),
        };
        let order = self.autopilot.update(&senses, TICK_S, &self.params);
        self.step_gust();
        let wind = self.wind_mps();
        let dt_s = TICK_S / f64::from(SUBSTEPS);
        for _ in 0..SUBSTEPS {
            let command = if order.lift {
                self.control.update(&order.setpoint, &self.estimate, &self.params, order.up_limit_mps, dt_s)
            } else {
                self.control.reset(yaw_of(self.estimate.ned_from_frd));
                ControlOutput::IDLE
            };
            // The autopilot turns its thrust by the heading it believes; the body is turned by the true one.
            let heading_error = yaw_of(self.estimator.attitude_error());
            let true_command = ControlOutput {
                specific_force_mps2: DQuat::from_rotation_z(-heading_error) * command.specific_force_mps2,
                ..command
            };
            self.body.step(&true_command, wind, dt_s);
            self.estimate = self.estimator.step(&self.body, dt_s);
            self.gimbal.step(self.body.yaw_rad(), dt_s, &self.params);
        }
        self.battery.step(TICK_S, self.autopilot.armed(), order.lift, &self.params);
    }

    fn step_gust(&mut self) {
        if self.config.gust_mps <= 0.0 {
            return;
        }
        // First-order Gauss-Markov with 2 s.
        let keep = (-TICK_S / 2.0f64).exp();
        let noise = self.config.gust_mps * (1.0 - keep * keep).sqrt();
        let draw = DVec3::new(self.gust.normal(), self.gust.normal(), 0.3 * self.gust.normal());
        self.gust_mps = self.gust_mps * keep + draw * noise;
    }

    /// The true poses of this tick.
    #[must_use]
    pub fn truth(&self) -> TrueState {
        TrueState {
            position_m: enu_from_ned(self.body.position_m),
            velocity_mps: enu_from_ned(self.body.velocity_mps),
            world_from_body: enu_from_flu(self.body.ned_from_frd),
            world_from_gimbal: enu_from_flu(self.gimbal.ned_from_payload(self.body.yaw_rad())),
        }
    }

    /// The gimbal's payload as its own sensor sees it (FRD in the believed NED).
    #[must_use]
    pub fn believed_payload(&self) -> DQuat {
        (self.estimator.attitude_error() * self.gimbal.ned_from_payload(self.body.yaw_rad())).normalize()
    }

    /// The local frame's origin: latitude and longitude in degrees times 1e7, altitude in mm above the sea.
    #[must_use]
    pub fn origin(&self) -> (i32, i32, i32) {
        (ORIGIN_LAT_E7, ORIGIN_LON_E7, ORIGIN_ALT_MM)
    }

    /// A local position (NED) on the earth, in the units of [`Self::origin`].
    #[must_use]
    pub fn global(&self, position_m: DVec3) -> (i32, i32, i32) {
        let lat0_rad = (f64::from(ORIGIN_LAT_E7) * 1e-7).to_radians();
        let lat = (position_m.x / EARTH_RADIUS_M).to_degrees() * 1e7;
        let lon = (position_m.y / (EARTH_RADIUS_M * lat0_rad.cos())).to_degrees() * 1e7;
        (
            ORIGIN_LAT_E7 + lat.round() as i32,
            ORIGIN_LON_E7 + lon.round() as i32,
            ORIGIN_ALT_MM - (position_m.z * 1e3).round() as i32,
        )
    }

    /// MAV_SYS_ID as it was at the start: a new value counts from the next one, as on PX4.
    #[must_use]
    pub fn system_id(&self) -> u8 {
        self.system_id
    }
}
