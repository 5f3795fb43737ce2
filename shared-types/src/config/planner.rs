//! Section `[planner]`: the mission, from the survey point to the landing.
//!
//! The defaults are the better values (`default` preset); [`PlannerConfig::paper`] gives the paper's literal ones. Each
//! difference is a field of its own, so that either can be tried alone.

use serde::{Deserialize, Serialize};

use super::{Problem, Section};
use crate::messages::VarianceMode;

/// What decides where to fly.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Strategy {
    /// Next best views: seed orbit, then rounds of selected candidates (Algorithm 1).
    Nbv,
    /// The paper's baseline: 12 views at 1.0 m (-15 degrees) and 12 at 2.5 m (-30 degrees).
    Orbit24,
    /// The same with 24 views at each height.
    Orbit48,
    /// The heights of `orbit24`, each camera looking at the centre of the box.
    OrbitLookAt,
}

/// What chooses the views of a round.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SelectorName {
    /// Depth variance and angle (Eq. 4).
    DepthVariance,
    /// The uncertainty term of Eq. 4 alone.
    UncertaintyOnly,
    /// The angular term of Eq. 4 alone; needs no scores.
    AngleOnly,
    /// The Fibonacci points in an order whose every beginning is spread evenly.
    FibonacciOrder,
    /// Seeded random.
    Random,
}

/// How to fly from view to view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Transit {
    /// The shortest safe path.
    Shortest,
    /// Climb above the box, cross, descend (the paper).
    Climb,
}

/// In which order the views of a batch are flown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BatchOrder {
    /// The quickest of all orders.
    Time,
    /// As picked.
    Pick,
}

/// Whether flight waits for training.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MissionMode {
    /// The next batch is chosen on the round before the running one, while the vehicle flies.
    Concurrent,
    /// As Algorithm 1: fly, train, score, in turn.
    Serial,
}

/// Where the centre of the box lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BoxCenter {
    /// Middle of the extents.
    Midpoint,
    /// Median of the points (the paper; leans to the side that has more of them).
    Median,
}

/// Radius R of the candidate sphere from the edge B of the box.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RadiusRule {
    /// max(B + 0.5 m, 0.87 B + clearance): clear of the box's corners.
    Clear,
    /// B + 0.5 m.
    Paper,
}

/// `clearance_m` where nothing better than plain GNSS tells where the vehicle is, metres.
pub const GNSS_CLEARANCE_M: f64 = 0.92;

/// Section `[planner]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PlannerConfig {
    /// Begin as soon as everything is ready; else wait for the command to start.
    pub autostart: bool,
    /// What decides where to fly: nbv, orbit24, orbit48 or orbit-look-at.
    pub strategy: Strategy,
    /// What chooses the views of a round: depth-variance, uncertainty-only, angle-only, fibonacci-order or random.
    pub selector: SelectorName,
    /// How the depth variance of a pixel is taken: normalised or paper.
    pub variance: VarianceMode,
    /// Clip the angular term of Eq. 4 to [0, 1].
    pub clip_angle: bool,
    /// Weight of the uncertainty in Eq. 4.
    pub weight_uncertainty: f64,
    /// Weight of the angle in Eq. 4.
    pub weight_angle: f64,
    /// Width of the images scored, pixels.
    pub score_width_px: u32,
    /// Height of the images scored, pixels.
    pub score_height_px: u32,
    /// Views of a round (k).
    pub batch: u32,
    /// Keyframes of the mission, seed views included.
    pub keyframes: u32,
    /// concurrent or serial.
    pub mode: MissionMode,
    /// shortest or climb.
    pub transit: Transit,
    /// time or pick.
    pub order: BatchOrder,
    /// Where the object is, as far as known: metres east, north and up in the world.
    pub survey_point_m: [f64; 3],
    /// The object lies within this distance of the survey point, metres.
    pub survey_radius_m: f64,
    /// Height of the overhead view above the survey point, metres.
    pub overhead_height_m: f64,
    /// Distance of the side view from the survey point, metres.
    pub side_distance_m: f64,
    /// Height of the side view above the survey point, metres.
    pub side_height_m: f64,
    /// Points more than this above the ground belong to the object, metres.
    pub segment_height_m: f64,
    /// midpoint or median.
    pub box_center: BoxCenter,
    /// Added to the object's greatest extent, metres.
    pub box_margin_m: f64,
    /// Least edge of the box, metres.
    pub box_min_m: f64,
    /// Greatest edge of the box, metres.
    pub box_max_m: f64,
    /// Points of the full Fibonacci sphere.
    pub sphere_points: u32,
    /// clear or paper.
    pub radius: RadiusRule,
    /// Lowest altitude of a camera above the ground, metres.
    pub lowest_altitude_m: f64,
    /// Least distance of the vehicle's centre from the box, metres: 0.37 (X500's rotor tips) + 0.10 (exact, VIO, RTK) or
    /// 0.30 (GNSS) + 0.25. Not given, and with simulator.estimator = "gnss": 0.92.
    pub clearance_m: f64,
    /// Kept besides away from the ends of a path, for blended corners, metres.
    pub path_margin_m: f64,
    /// Elevation of the seed views, degrees.
    pub seed_elevation_deg: f64,
    /// Seed views.
    pub seed_views: u32,
    /// Half the width of the mission volume about the survey point, metres; home is always inside.
    pub volume_half_width_m: f64,
    /// Height of the mission volume above the ground, metres.
    pub volume_height_m: f64,
    /// Height of the takeoff above home, metres; also the height at which the vehicle comes home.
    pub takeoff_height_m: f64,
    /// Height above the box of a climbing transit, metres.
    pub climb_margin_m: f64,
    /// Highest speed, m/s.
    pub speed_mps: f64,
    /// Acceleration reckoned with, m/s^2.
    pub acceleration_mps2: f64,
    /// Yaw rate, degrees a second.
    pub yaw_rate_degps: f64,
    /// Rate of the gimbal, degrees a second.
    pub gimbal_rate_degps: f64,
    /// Time reckoned for settling and capture at a view, seconds.
    pub settle_s: f64,
    /// Least iterations of a round (Eq. 6).
    pub round_iterations_min: u32,
    /// Iterations for each view (Eq. 6).
    pub round_iterations_per_view: u32,
    /// Most iterations of a round (Eq. 6).
    pub round_iterations_max: u32,
    /// End a round once its loss has flattened; Eq. 6 is then the cap.
    pub stop_when_flat: bool,
    /// Iterations of a round of the orbits, at most.
    pub orbit_iterations: u32,
    /// Views of a round of the orbits, nearest to the newest; 0: all.
    pub orbit_window: u32,
    /// Points taken of each depth image for `paper_coverage`; 0: all.
    pub coverage_points: u32,
    /// End when nothing is left to gain: when the 95th percentile of the uncertainty is below this share of the first
    /// round's; 0: never.
    pub stop_gain: f64,
    /// Charge at which the mission ends, 0 to 1.
    pub return_battery: f64,
    /// Longest mission from takeoff to the way home, seconds.
    pub max_mission_s: f64,
    /// Wind at which the mission ends, m/s.
    pub max_wind_mps: f64,
    /// Longest time for a capture, seconds.
    pub capture_deadline_s: f64,
    /// Tries of a capture before its view is given up.
    pub capture_attempts: u32,
    /// Longest time for a command to be confirmed by the vehicle's state, seconds.
    pub command_deadline_s: f64,
    /// Longest time without progress of training or scoring, seconds.
    pub service_deadline_s: f64,
    /// Longest wait in the air for a disk that refuses the journal, seconds; then the vehicle comes home.
    pub disk_patience_s: f64,
}

impl Default for PlannerConfig {
    fn default() -> Self {
        Self {
            autostart: true,
            strategy: Strategy::Nbv,
            selector: SelectorName::DepthVariance,
            variance: VarianceMode::Normalised,
            clip_angle: true,
            weight_uncertainty: 0.6,
            weight_angle: 0.4,
            score_width_px: 320,
            score_height_px: 240,
            batch: 4,
            keyframes: 48,
            mode: MissionMode::Concurrent,
            transit: Transit::Shortest,
            order: BatchOrder::Time,
            survey_point_m: [0.0; 3],
            survey_radius_m: 2.5,
            overhead_height_m: 5.0,
            side_distance_m: 4.0,
            side_height_m: 1.5,
            segment_height_m: 0.05,
            box_center: BoxCenter::Midpoint,
            box_margin_m: 0.5,
            box_min_m: 1.0,
            box_max_m: 4.0,
            sphere_points: 200,
            radius: RadiusRule::Clear,
            lowest_altitude_m: 0.8,
            clearance_m: 0.72,
            path_margin_m: 0.1,
            seed_elevation_deg: 20.0,
            seed_views: 4,
            volume_half_width_m: 10.0,
            volume_height_m: 10.0,
            takeoff_height_m: 2.5,
            climb_margin_m: 1.0,
            speed_mps: 3.0,
            acceleration_mps2: 2.5,
            yaw_rate_degps: 60.0,
            gimbal_rate_degps: 60.0,
            settle_s: 1.0,
            round_iterations_min: 750,
            round_iterations_per_view: 50,
            round_iterations_max: 2500,
            stop_when_flat: true,
            orbit_iterations: 500,
            orbit_window: 10,
            coverage_points: 500,
            stop_gain: 0.0,
            return_battery: 0.28,
            max_mission_s: 900.0,
            max_wind_mps: 10.0,
            capture_deadline_s: 20.0,
            capture_attempts: 2,
            command_deadline_s: 30.0,
            service_deadline_s: 120.0,
            disk_patience_s: 30.0,
        }
    }
}

impl PlannerConfig {
    /// The paper's literal values.
    #[must_use]
    pub fn paper() -> Self {
        Self {
            variance: VarianceMode::Paper,
            clip_angle: false,
            mode: MissionMode::Serial,
            transit: Transit::Climb,
            order: BatchOrder::Pick,
            box_center: BoxCenter::Median,
            radius: RadiusRule::Paper,
            lowest_altitude_m: 0.3,
            clearance_m: 0.5,
            path_margin_m: 0.0,
            stop_when_flat: false,
            ..Self::default()
        }
    }

    /// Keyframes that the strategy wants: the orbits end when they are flown.
    #[must_use]
    pub fn keyframes_wanted(&self) -> u32 {
        match self.strategy {
            Strategy::Nbv => self.keyframes,
            Strategy::Orbit24 | Strategy::OrbitLookAt => self.keyframes.min(24),
            Strategy::Orbit48 => self.keyframes.min(48),
        }
    }
}

impl Section for PlannerConfig {
    fn problems(&self) -> Vec<Problem> {
        let numbers = [
            ("weight_uncertainty", self.weight_uncertainty, 0.0, 100.0),
            ("weight_angle", self.weight_angle, 0.0, 100.0),
            ("score_width_px", f64::from(self.score_width_px), 16.0, 4096.0),
            ("score_height_px", f64::from(self.score_height_px), 16.0, 4096.0),
            ("batch", f64::from(self.batch), 1.0, 6.0),
            ("keyframes", f64::from(self.keyframes), 1.0, 400.0),
            ("seed_views", f64::from(self.seed_views), 1.0, 8.0),
            ("survey_point_m[0]", self.survey_point_m[0], -1e5, 1e5),
            ("survey_point_m[1]", self.survey_point_m[1], -1e5, 1e5),
            ("survey_point_m[2]", self.survey_point_m[2], -1e4, 1e4),
            ("survey_radius_m", self.survey_radius_m, 0.2, 20.0),
            ("overhead_height_m", self.overhead_height_m, 1.0, 30.0),
            ("side_distance_m", self.side_distance_m, 1.0, 30.0),
            ("side_height_m", self.side_height_m, 0.3, 30.0),
            ("segment_height_m", self.segment_height_m, 0.005, 1.0),
            ("box_margin_m", self.box_margin_m, 0.0, 5.0),
            ("box_min_m", self.box_min_m, 0.1, self.box_max_m.clamp(0.1, 20.0)),
            ("box_max_m", self.box_max_m, 0.1, 20.0),
            ("sphere_points", f64::from(self.sphere_points), 8.0, 500.0),
            ("lowest_altitude_m", self.lowest_altitude_m, 0.1, 10.0),
            ("clearance_m", self.clearance_m, 0.2, 10.0),
            ("path_margin_m", self.path_margin_m, 0.0, 1.0),
            ("seed_elevation_deg", self.seed_elevation_deg, 0.0, 80.0),
            ("volume_half_width_m", self.volume_half_width_m, 2.0, 500.0),
            ("volume_height_m", self.volume_height_m, 2.0, 120.0),
            ("takeoff_height_m", self.takeoff_height_m, 1.0, (self.volume_height_m - 0.5).clamp(1.0, 119.0)),
            ("climb_margin_m", self.climb_margin_m, 0.2, 20.0),
            ("speed_mps", self.speed_mps, 0.1, 12.0),
            ("acceleration_mps2", self.acceleration_mps2, 0.1, 5.0),
            ("yaw_rate_degps", self.yaw_rate_degps, 1.0, 200.0),
            ("gimbal_rate_degps", self.gimbal_rate_degps, 1.0, 400.0),
            ("settle_s", self.settle_s, 0.0, 60.0),
            ("round_iterations_min", f64::from(self.round_iterations_min), 1.0, 1e6),
            ("round_iterations_per_view", f64::from(self.round_iterations_per_view), 0.0, 1e5),
            ("round_iterations_max", f64::from(self.round_iterations_max), f64::from(self.round_iterations_min), 1e6),
            ("orbit_iterations", f64::from(self.orbit_iterations), 1.0, 1e6),
            ("orbit_window", f64::from(self.orbit_window), 0.0, 400.0),
            ("stop_gain", self.stop_gain, 0.0, 1.0),
            ("return_battery", self.return_battery, 0.0, 0.95),
            ("max_mission_s", self.max_mission_s, 10.0, 1e5),
            ("max_wind_mps", self.max_wind_mps, 0.5, 50.0),
            ("capture_deadline_s", self.capture_deadline_s, 1.0, 600.0),
            ("capture_attempts", f64::from(self.capture_attempts), 1.0, 10.0),
            ("command_deadline_s", self.command_deadline_s, 1.0, 600.0),
            ("service_deadline_s", self.service_deadline_s, 1.0, 1e5),
            ("disk_patience_s", self.disk_patience_s, 0.0, 600.0),
        ];
        let mut problems: Vec<Problem> = numbers
            .iter()
            .filter_map(|&(key, value, low, high)| Problem::unless_within(key, value, low, high))
            .collect();
        if self.strategy == Strategy::Nbv && self.seed_views > self.keyframes {
            problems.push(Problem::new(
                "seed_views",
                self.seed_views,
                format!("at most keyframes ({})", self.keyframes),
            ));
        }
        if self.weight_uncertainty + self.weight_angle <= 0.0 {
            problems.push(Problem::new("weight_angle", self.weight_angle, "more than 0 where weight_uncertainty is 0"));
        }
        problems
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_presets_are_possible_and_survive_toml() {
        for config in [PlannerConfig::default(), PlannerConfig::paper()] {
            assert_eq!(config.problems(), Vec::new());
            let text = toml::to_string(&config).unwrap();
            assert_eq!(toml::from_str::<PlannerConfig>(&text).unwrap(), config);
        }
    }

    #[test]
    fn impossible_values_are_named() {
        let bad = PlannerConfig {
            keyframes: 0,
            clearance_m: f64::NAN,
            round_iterations_max: 10,
            return_battery: 28.0,
            ..PlannerConfig::default()
        };
        let keys: Vec<String> = bad.problems().into_iter().map(|problem| problem.key).collect();
        assert_eq!(keys, ["keyframes", "clearance_m", "round_iterations_max", "return_battery", "seed_views"]);
    }

    #[test]
    fn strategies_are_named_as_on_the_command_line() {
        let read = |text: &str| toml::from_str::<PlannerConfig>(text);
        assert_eq!(read("strategy = \"orbit24\"").unwrap().strategy, Strategy::Orbit24);
        assert_eq!(read("selector = \"angle-only\"").unwrap().selector, SelectorName::AngleOnly);
        assert!(read("strategy = \"orbit\"").is_err());
    }
}
