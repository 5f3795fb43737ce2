//! Section `[link]`: the autopilot, how it is reached, and the limits that setpoints keep.

use serde::{Deserialize, Serialize};

/// Who arms the motors.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ArmMode {
    /// px4-link arms when the planner asks.
    Auto,
    /// A pilot arms; px4-link waits for it.
    Pilot,
}

/// Section `[link]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LinkConfig {
    /// The autopilot: `udpin:ADDRESS:PORT` (listen, as PX4's onboard API expects), `udpout:ADDRESS:PORT`,
    /// `tcpout:ADDRESS:PORT`, `tcpin:ADDRESS:PORT` or `serial:DEVICE:BAUD`.
    pub url: String,
    /// `auto` or `pilot`. Not given: `auto` towards this machine (127.0.0.1: a simulator), `pilot` towards anything else.
    pub arm: Option<ArmMode>,
    /// Whether COM_OBL_RC_ACT = 5 (hold when setpoints stop) and COM_LOW_BAT_ACT = 3 are set where they differ. Not given:
    /// only towards this machine.
    pub set_params: Option<bool>,
    /// Whether px4-link also sends a ground station's heartbeat: gives the autopilot's texts, but hides the loss of a real
    /// ground station from it. Not given: only towards this machine.
    pub gcs_heartbeat: Option<bool>,
    /// Whether ground stations may start, stop, land, hold and continue the mission, by MAV_CMD_USER_1 to USER_5 for component
    /// 191.
    pub take_orders: bool,
    /// Fly although COM_OBL_RC_ACT is 0 to 2 and no remote control is there (the autopilot then climbs and returns when
    /// setpoints stop).
    pub allow_unsafe_offboard_loss: bool,
    /// Highest speed of setpoints, m/s.
    pub speed_mps: f64,
    /// Highest acceleration of setpoints, m/s2.
    pub acceleration_mps2: f64,
    /// Highest jerk of setpoints, m/s3.
    pub jerk_mps3: f64,
    /// Highest yaw rate of setpoints, deg/s.
    pub yaw_rate_deg_s: f64,
    /// Highest yaw acceleration of setpoints, deg/s2.
    pub yaw_acceleration_deg_s2: f64,
    /// Highest rate of the gimbal's pitch demand, deg/s.
    pub gimbal_rate_deg_s: f64,
    /// How far rounded corners may leave the path, metres; sharper ones are flown slower.
    pub corner_tolerance_m: f64,
    /// A target is reached when its setpoint rests at the end and the vehicle is within this distance, metres.
    pub arrival_tolerance_m: f64,
    /// No setpoint is farther from the measured position than this, metres; progress slows before.
    pub leash_m: f64,
    /// Age of `planner/alive` from which the vehicle brakes and holds, seconds.
    pub planner_timeout_s: f64,
    /// Age of `planner/alive` from which the vehicle returns and lands, seconds.
    pub planner_return_s: f64,
}

impl Default for LinkConfig {
    fn default() -> Self {
        Self {
            url: "udpin:127.0.0.1:14540".to_owned(),
            arm: None,
            set_params: None,
            gcs_heartbeat: None,
            take_orders: true,
            allow_unsafe_offboard_loss: false,
            speed_mps: 3.0,
            acceleration_mps2: 2.5,
            jerk_mps3: 8.0,
            yaw_rate_deg_s: 60.0,
            yaw_acceleration_deg_s2: 120.0,
            gimbal_rate_deg_s: 60.0,
            corner_tolerance_m: 0.1,
            arrival_tolerance_m: 0.4,
            leash_m: 3.0,
            planner_timeout_s: 0.5,
            planner_return_s: 20.0,
        }
    }
}

impl LinkConfig {
    /// Whether the autopilot is reached on this machine only: a simulator.
    #[must_use]
    pub fn is_local(&self) -> bool {
        ["udpin:127.0.0.1:", "udpout:127.0.0.1:", "tcpout:127.0.0.1:", "tcpin:127.0.0.1:"]
            .iter()
            .any(|prefix| self.url.starts_with(prefix))
    }

    /// Who arms, with the default resolved.
    #[must_use]
    pub fn arm_mode(&self) -> ArmMode {
        self.arm.unwrap_or(if self.is_local() { ArmMode::Auto } else { ArmMode::Pilot })
    }

    /// Whether parameters are set, with the default resolved.
    #[must_use]
    pub fn sets_params(&self) -> bool {
        self.set_params.unwrap_or(self.is_local())
    }

    /// Whether a ground station's heartbeat is sent, with the default resolved.
    #[must_use]
    pub fn sends_gcs_heartbeat(&self) -> bool {
        self.gcs_heartbeat.unwrap_or(self.is_local())
    }

    /// Values that cannot be, one sentence each: "link.key is VALUE; expected WHAT".
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = Vec::new();
        if !url_is_sane(&self.url) {
            problems.push(format!(
                "link.url is \"{}\"; expected udpin:ADDRESS:PORT, udpout:ADDRESS:PORT, tcpout:ADDRESS:PORT, \
                 tcpin:ADDRESS:PORT or serial:DEVICE:BAUD",
                self.url
            ));
        }
        let ranges = [
            ("speed_mps", self.speed_mps, 0.1, 10.0),
            ("acceleration_mps2", self.acceleration_mps2, 0.1, 5.0),
            ("jerk_mps3", self.jerk_mps3, 0.5, 40.0),
            ("yaw_rate_deg_s", self.yaw_rate_deg_s, 5.0, 180.0),
            ("yaw_acceleration_deg_s2", self.yaw_acceleration_deg_s2, 10.0, 720.0),
            ("gimbal_rate_deg_s", self.gimbal_rate_deg_s, 5.0, 360.0),
            ("corner_tolerance_m", self.corner_tolerance_m, 0.01, 1.0),
            ("arrival_tolerance_m", self.arrival_tolerance_m, 0.02, 2.0),
            ("leash_m", self.leash_m, 0.5, 20.0),
            ("planner_timeout_s", self.planner_timeout_s, 0.2, 10.0),
            ("planner_return_s", self.planner_return_s, 1.0, 600.0),
        ];
        for (key, value, low, high) in ranges {
            if !(value.is_finite() && (low..=high).contains(&value)) {
                problems.push(format!("link.{key} is {value}; expected a number from {low} to {high}"));
            }
        }
        problems
    }
}

/// Whether an address has one of the known forms; the port or baud rate must be a number.
fn url_is_sane(url: &str) -> bool {
    let Some((scheme, rest)) = url.split_once(':') else { return false };
    let Some((place, number)) = rest.rsplit_once(':') else { return false };
    let network = matches!(scheme, "udpin" | "udpout" | "tcpin" | "tcpout");
    !place.is_empty()
        && ((network && number.parse::<u16>().is_ok_and(|port| port > 0))
            || (scheme == "serial" && number.parse::<u32>().is_ok_and(|baud| baud > 0)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_is_valid_and_trusts_only_this_machine() {
        let config = LinkConfig::default();
        assert!(config.validate().is_empty());
        assert_eq!((config.arm_mode(), config.sets_params()), (ArmMode::Auto, true));
        let real = LinkConfig { url: "serial:/dev/ttyACM0:921600".to_owned(), ..config };
        assert!(real.validate().is_empty());
        assert_eq!((real.arm_mode(), real.sets_params(), real.sends_gcs_heartbeat()), (ArmMode::Pilot, false, false));
    }

    #[test]
    fn impossible_values_are_named() {
        let config = LinkConfig { url: "udp:14540".to_owned(), speed_mps: f64::NAN, ..LinkConfig::default() };
        let problems = config.validate();
        assert!(
            problems.len() == 2
                && problems[0].starts_with("link.url is ")
                && problems[1].starts_with("link.speed_mps is NaN")
        );
    }
}
