//! Section `[simulator]`: the simulated vehicle.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::faults::Fault;

/// Which estimator the simulated autopilot flies on, and reports.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum EstimatorName {
    /// The truth.
    #[default]
    Exact,
    /// Visual-inertial: 10 mm, 0.2 degrees.
    Vio,
    /// RTK GNSS: 20 mm, 0.5 degrees.
    Rtk,
    /// Plain GNSS: 0.3 m of wander, 2 degrees of heading bias.
    Gnss,
}

impl EstimatorName {
    /// The name as in the file.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Exact => "exact",
            Self::Vio => "vio",
            Self::Rtk => "rtk",
            Self::Gnss => "gnss",
        }
    }
}

/// Section `[simulator]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimulatorConfig {
    /// Estimator of the autopilot: exact, vio, rtk or gnss.
    pub estimator: EstimatorName,
    /// Where the vehicle stands at boot: metres east and north in the world.
    pub start_m: [f64; 2],
    /// Heading at boot: counter-clockwise from east, degrees.
    pub start_yaw_deg: f64,
    /// Where the estimator puts its origin, from where the world's is: metres east, north and up. For `vantage resume`, as
    /// after a reboot; the world of a first flight lies where its estimator puts it.
    pub origin_m: [f64; 3],
    /// Mean wind: metres per second toward east, north and up.
    pub wind_mps: [f64; 3],
    /// Standard deviation of the gusts on each axis, m/s.
    pub gust_mps: f64,
    /// Charge at boot, 0 to 1.
    pub battery: f64,
    /// PX4's instance rule for ports (14540 + i, 14580 + i, 18570 + i); -1: the first that is free.
    pub instance: i32,
    /// Autopilot parameters that differ from PX4's defaults, by name.
    pub params: BTreeMap<String, f64>,
    /// What goes wrong with vehicle and link, seeded and in simulated time: `loss 0.05`, `gone at 60 for 5`, `delay 0.5 at 30
    /// for 10`, `jump 3 0 0 at 50`, `battery 0.06 at 70`, `pilot at 40 for 10`; a wrong word tells them all.
    pub faults: Vec<Fault>,
}

impl Default for SimulatorConfig {
    fn default() -> Self {
        Self {
            estimator: EstimatorName::Exact,
            start_m: [-6.0, 0.0],
            start_yaw_deg: 0.0,
            origin_m: [0.0; 3],
            wind_mps: [0.0; 3],
            gust_mps: 0.0,
            battery: 1.0,
            instance: -1,
            params: BTreeMap::new(),
            faults: Vec::new(),
        }
    }
}

impl SimulatorConfig {
    /// Values that cannot be, each as "key is VALUE; expected WHAT".
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = Vec::new();
        let mut within = |key: &str, value: f64, low: f64, high: f64| {
            if !(value.is_finite() && (low..=high).contains(&value)) {
                problems.push(format!("{key} is {value}; expected a number from {low} to {high}"));
            }
        };
        within("simulator.start_m[0]", self.start_m[0], -1e4, 1e4);
        within("simulator.start_m[1]", self.start_m[1], -1e4, 1e4);
        within("simulator.start_yaw_deg", self.start_yaw_deg, -360.0, 360.0);
        for axis in 0..3 {
            within("simulator.origin_m", self.origin_m[axis], -20.0, 20.0);
            within("simulator.wind_mps", self.wind_mps[axis], -30.0, 30.0);
        }
        within("simulator.gust_mps", self.gust_mps, 0.0, 15.0);
        within("simulator.battery", self.battery, 0.0, 1.0);
        within("simulator.instance", f64::from(self.instance), -1.0, 250.0);
        for (name, &value) in &self.params {
            within(&format!("simulator.params.{name}"), value, -1e9, 1e9);
        }
        problems
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_is_valid_and_nonsense_is_named() {
        assert!(SimulatorConfig::default().validate().is_empty());
        let wrong = SimulatorConfig { battery: 1.5, gust_mps: f64::NAN, ..SimulatorConfig::default() };
        let problems = wrong.validate();
        assert!(problems[0].contains("gust_mps is NaN") && problems[1].contains("battery is 1.5"), "{problems:?}");
    }
}
