//! A path through waypoints, measured in the time that it takes at the limits.
//!
//! Position, yaw and gimbal pitch are one vector that moves along straight legs. A leg lasts as long as the slowest of the
//! three needs, so a pure turn is a leg as well, and a point at phase sigma never moves faster than any limit while sigma
//! grows no faster than time.

use core::ops::{Add, Mul, Sub};

use glam::DVec3;
use shared_types::messages::Waypoint;

use crate::frames::wrap_pi;

/// Limits that setpoints keep. SI units, radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// m/s.
    pub speed_mps: f64,
    /// m/s2.
    pub acceleration_mps2: f64,
    /// m/s3.
    pub jerk_mps3: f64,
    /// rad/s.
    pub yaw_rate_radps: f64,
    /// rad/s2.
    pub yaw_acceleration_radps2: f64,
    /// rad/s.
    pub gimbal_rate_radps: f64,
    /// How far the flown curve may leave the path, metres.
    pub tolerance_m: f64,
}

impl Limits {
    /// Limits as configured.
    #[must_use]
    pub fn new(config: &shared_types::config::LinkConfig) -> Self {
        Self {
            speed_mps: config.speed_mps,
            acceleration_mps2: config.acceleration_mps2,
            jerk_mps3: config.jerk_mps3,
            yaw_rate_radps: config.yaw_rate_deg_s.to_radians(),
            yaw_acceleration_radps2: config.yaw_acceleration_deg_s2.to_radians(),
            gimbal_rate_radps: config.gimbal_rate_deg_s.to_radians(),
            tolerance_m: config.corner_tolerance_m,
        }
    }
}

/// Position, yaw and gimbal pitch; also their differences and rates.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Point {
    /// World, metres.
    pub position_m: DVec3,
    /// From east, counter-clockwise, radians, not wrapped: neighbours on a path differ by less than half a turn.
    pub yaw_rad: f64,
    /// Gimbal pitch, radians, negative down.
    pub pitch_rad: f64,
}

impl Point {
    /// The point of a waypoint, its yaw as given.
    #[must_use]
    pub fn of(waypoint: &Waypoint) -> Self {
        Self {
            position_m: DVec3::from_array(waypoint.position_m),
            yaw_rad: waypoint.yaw_rad,
            pitch_rad: waypoint.gimbal_pitch_rad,
        }
    }

    /// Whether every number is finite.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.position_m.is_finite() && self.yaw_rad.is_finite() && self.pitch_rad.is_finite()
    }
}

impl Add for Point {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self {
            position_m: self.position_m + other.position_m,
            yaw_rad: self.yaw_rad + other.yaw_rad,
            pitch_rad: self.pitch_rad + other.pitch_rad,
        }
    }
}

impl Sub for Point {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        self + other * -1.0
    }
}

impl Mul<f64> for Point {
    type Output = Self;
    fn mul(self, k: f64) -> Self {
        Self { position_m: self.position_m * k, yaw_rad: self.yaw_rad * k, pitch_rad: self.pitch_rad * k }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Node {
    point: Point,
    /// Phase at this node: the sum of the legs before it, seconds.
    at_s: f64,
    /// Highest speed on the leg that ends here.
    speed_mps: f64,
}

/// Straight legs through points, with the time each needs.
#[derive(Debug, Clone, PartialEq)]
pub struct Path {
    nodes: Vec<Node>,
}

/// Below this a leg's speed would make it last for ever; slower wishes are raised to it.
const SLOWEST_MPS: f64 = 0.05;

impl Path {
    /// A path from `start` through waypoints. Yaws turn the short way. Waypoints must be finite.
    #[must_use]
    pub fn new(start: Point, waypoints: &[Waypoint], limits: &Limits) -> Self {
        let mut nodes = vec![Node { point: start, at_s: 0.0, speed_mps: 0.0 }];
        let (mut last, mut at_s) = (start, 0.0);
        for waypoint in waypoints {
            let mut point = Point::of(waypoint);
            point.yaw_rad = last.yaw_rad + wrap_pi(point.yaw_rad - last.yaw_rad);
            let speed_mps = waypoint.speed_mps.min(limits.speed_mps).max(SLOWEST_MPS);
            let leg_s = leg_s(point - last, speed_mps, limits);
            if leg_s > 0.0 {
                at_s += leg_s;
                nodes.push(Node { point, at_s, speed_mps });
                last = point;
            }
        }
        Self { nodes }
    }

    /// The same path from another start.
    #[must_use]
    pub fn restarted(&self, start: Point, limits: &Limits) -> Self {
        let waypoints: Vec<Waypoint> =
            self.nodes.iter().skip(1).map(|node| waypoint(&node.point, node.speed_mps)).collect();
        Self::new(start, &waypoints, limits)
    }

    /// How long the whole path takes at the limits, corners not counted, seconds.
    #[must_use]
    pub fn total_s(&self) -> f64 {
        self.nodes.last().map_or(0.0, |node| node.at_s)
    }

    /// Where the path begins.
    #[must_use]
    pub fn start(&self) -> Point {
        self.nodes.first().map(|node| node.point).unwrap_or_default()
    }

    /// Where the path ends.
    #[must_use]
    pub fn end(&self) -> Point {
        self.nodes.last().map(|node| node.point).unwrap_or_default()
    }

    /// The point at a phase, clamped to the path's ends.
    #[must_use]
    pub fn at(&self, sigma_s: f64) -> Point {
        let next = self.nodes.partition_point(|node| node.at_s <= sigma_s);
        match (next.checked_sub(1).and_then(|i| self.nodes.get(i)), self.nodes.get(next)) {
            (Some(a), Some(b)) => a.point + (b.point - a.point) * ((sigma_s - a.at_s) / (b.at_s - a.at_s)),
            (Some(a), None) => a.point,
            (None, _) => self.start(),
        }
    }

    /// Distance of a position from the legs that lie within a range of phases, metres.
    #[must_use]
    pub fn distance_m(&self, position_m: DVec3, from_s: f64, to_s: f64) -> f64 {
        let first = self.nodes.partition_point(|node| node.at_s < from_s).saturating_sub(1);
        let mut best = f64::INFINITY;
        for pair in self.nodes.get(first..).unwrap_or_default().windows(2) {
            let [a, b] = pair else { continue };
            if a.at_s > to_s {
                break;
            }
            let nearest = nearest_on_leg(a.point.position_m, b.point.position_m, position_m);
            best = best.min(nearest.distance(position_m));
        }
        if best.is_finite() { best } else { self.end().position_m.distance(position_m) }
    }
}

/// A waypoint of a point.
#[must_use]
pub fn waypoint(point: &Point, speed_mps: f64) -> Waypoint {
    Waypoint {
        position_m: point.position_m.to_array(),
        yaw_rad: point.yaw_rad,
        gimbal_pitch_rad: point.pitch_rad,
        speed_mps,
    }
}

fn leg_s(leg: Point, speed_mps: f64, limits: &Limits) -> f64 {
    (leg.position_m.length() / speed_mps)
        .max(leg.yaw_rad.abs() / limits.yaw_rate_radps)
        .max(leg.pitch_rad.abs() / limits.gimbal_rate_radps)
}

/// The point of the segment from `a` to `b` nearest to `p`.
fn nearest_on_leg(a: DVec3, b: DVec3, p: DVec3) -> DVec3 {
    let leg = b - a;
    let length2 = leg.length_squared();
    if length2 > 0.0 { a + leg * ((p - a).dot(leg) / length2).clamp(0.0, 1.0) } else { a }
}

/// The part of a polyline that lies ahead of the point on it nearest to `position_m`, and that distance. The first
/// waypoint returned is the nearest point itself. Of equally near points the last counts: less to fly. `None` when empty.
#[must_use]
pub fn rest_from(waypoints: &[Waypoint], position_m: DVec3) -> Option<(Vec<Waypoint>, f64)> {
    let first = waypoints.first()?;
    let mut best = (0, DVec3::from_array(first.position_m).distance(position_m), *first);
    for (index, pair) in waypoints.windows(2).enumerate() {
        let [a, b] = pair else { continue };
        let nearest_m = nearest_on_leg(DVec3::from_array(a.position_m), DVec3::from_array(b.position_m), position_m);
        let distance_m = nearest_m.distance(position_m);
        if distance_m <= best.1 {
            best = (index, distance_m, Waypoint { position_m: nearest_m.to_array(), ..*b });
        }
    }
    let mut rest = vec![best.2];
    rest.extend_from_slice(waypoints.get(best.0 + 1..).unwrap_or_default());
    Some((rest, best.1))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f64, y: f64, yaw: f64) -> Waypoint {
        waypoint(&Point { position_m: DVec3::new(x, y, 1.0), yaw_rad: yaw, pitch_rad: 0.0 }, 1.0)
    }

    fn limits() -> Limits {
        Limits::new(&shared_types::config::LinkConfig::default())
    }

    #[test]
    fn a_leg_lasts_as_long_as_its_slowest_part() {
        let path = Path::new(
            Point::of(&at(0.0, 0.0, 3.0)),
            &[at(0.0, 0.0, 3.0), at(2.0, 0.0, 3.0), at(2.0, 0.0, -3.0)],
            &limits(),
        );
        let turn_s = (2.0 * core::f64::consts::PI - 6.0) / limits().yaw_rate_radps;
        assert!((path.total_s() - 2.0 - turn_s).abs() < 1e-9, "{}", path.total_s());
        assert!((path.at(1.0).position_m.x - 1.0).abs() < 1e-9);
        assert!(path.at(99.0).yaw_rad > 3.2, "the short way round");
        assert!((path.distance_m(DVec3::new(1.0, 0.5, 1.0), 0.0, 9.0) - 0.5).abs() < 1e-9);
    }

    #[test]
    fn the_rest_of_a_polyline_begins_at_its_nearest_point() {
        let line = [at(0.0, 0.0, 0.0), at(4.0, 0.0, 0.0), at(4.0, 4.0, 0.0)];
        let (rest, distance) = rest_from(&line, DVec3::new(3.0, 0.2, 1.0)).expect("not empty");
        assert!((distance - 0.2).abs() < 1e-9 && rest.len() == 3 && (rest[0].position_m[0] - 3.0).abs() < 1e-9);
        let (rest, _) = rest_from(&line, DVec3::new(4.5, 9.0, 1.0)).expect("not empty");
        assert_eq!(rest.last().map(|w| w.position_m), Some([4.0, 4.0, 1.0]));
        assert!(rest_from(&[], DVec3::ZERO).is_none());
    }
}
