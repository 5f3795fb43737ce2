//! Where the vehicle may be: the mission volume less the ground, the box inflated by the clearance (rounded), and the
//! occupied voxels.

use glam::DVec3;
use shared_types::config::planner::PlannerConfig;

use super::occupancy::Occupancy;
use super::prior::Prior;

/// The volume that no setpoint leaves, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Volume {
    /// Lowest corner.
    pub min_m: DVec3,
    /// Highest corner.
    pub max_m: DVec3,
}

impl Volume {
    /// Whether a point lies inside.
    #[must_use]
    pub fn contains(&self, point_m: DVec3) -> bool {
        point_m.cmpge(self.min_m).all() && point_m.cmple(self.max_m).all()
    }

    /// The volume about the survey point, from below the ground up, with home in it.
    #[must_use]
    pub fn of_mission(survey_m: DVec3, home_m: DVec3, config: &PlannerConfig) -> Self {
        let wide = DVec3::new(config.volume_half_width_m, config.volume_half_width_m, 0.0);
        let ground = survey_m.z.min(home_m.z);
        let top = survey_m.z.max(home_m.z) + config.volume_height_m;
        let (low, high) = (survey_m - wide, survey_m + wide);
        let beside = DVec3::new(2.0, 2.0, 0.0);
        let min_m = low.min(home_m - beside).with_z(ground - 0.5);
        let max_m = high.max(home_m + beside).with_z(top);
        Self { min_m, max_m }
    }
}

/// A box to keep clear of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Obstacle {
    /// Centre, metres.
    pub center_m: DVec3,
    /// Half the edges, metres.
    pub half_m: DVec3,
}

impl Obstacle {
    /// Distance of a point from the box, 0 inside, metres.
    #[must_use]
    pub fn distance(&self, point_m: DVec3) -> f64 {
        ((point_m - self.center_m).abs() - self.half_m).max(DVec3::ZERO).length()
    }
}

/// Free space. Points are of the vehicle's centre.
#[derive(Debug, Clone)]
pub struct FreeSpace {
    /// The object's box; before the prior is known, where the object may be.
    pub obstacle: Obstacle,
    /// Least distance from it, metres.
    pub clearance_m: f64,
    /// Kept besides, away from the ends of a path, metres.
    pub margin_m: f64,
    /// Lowest height of the vehicle's centre, metres.
    pub floor_z_m: f64,
    /// Everything beyond is forbidden.
    pub volume: Volume,
    /// Occupied voxels seen so far.
    pub occupancy: Occupancy,
}

/// Samples of a checked segment are at most so far apart where it is tight, metres.
/// Longer legs are not looked at, and not flown: a journal or a state with wild coordinates would be looked at for ever.
const LONGEST_LEG_M: f64 = 2_000.0;
const STEP_M: f64 = 0.01;
/// The clearance asked for grows from that of a path's ends by this much a metre, up to clearance + margin.
const GROWTH: f64 = 0.5;

impl FreeSpace {
    /// Free space about a known box. `camera_drop_m` is how far below the vehicle's centre its camera is at least: the
    /// lowest altitude is the camera's.
    #[must_use]
    pub fn around_prior(prior: &Prior, volume: Volume, camera_drop_m: f64, config: &PlannerConfig) -> Self {
        let obstacle = Obstacle { center_m: prior.center(), half_m: DVec3::splat(prior.size_m / 2.0) };
        Self::new(obstacle, prior.ground_z_m() + camera_drop_m, volume, config)
    }

    /// Free space before the prior is known: wherever the object may be is forbidden, up to the greatest box's height.
    #[must_use]
    pub fn around_survey(survey_m: DVec3, volume: Volume, config: &PlannerConfig) -> Self {
        let half = DVec3::new(config.box_max_m, config.box_max_m, config.box_max_m) / 2.0;
        // The overhead view must stay outside: where it is low, so is the forbidden box.
        let top = config.box_max_m.min(config.overhead_height_m - config.clearance_m - 0.05).max(0.5);
        let wide = half.x.min(config.side_distance_m - config.clearance_m - 0.05).max(0.5);
        let obstacle =
            Obstacle { center_m: survey_m + DVec3::Z * top / 2.0, half_m: DVec3::new(wide, wide, top / 2.0) };
        Self::new(obstacle, survey_m.z, volume, config)
    }

    fn new(obstacle: Obstacle, ground_z_m: f64, volume: Volume, config: &PlannerConfig) -> Self {
        Self {
            obstacle,
            clearance_m: config.clearance_m,
            margin_m: config.path_margin_m,
            floor_z_m: ground_z_m + config.lowest_altitude_m,
            volume,
            occupancy: Occupancy::new(volume.min_m, volume.max_m, config.clearance_m),
        }
    }

    /// Distance of a point from the box, metres.
    #[must_use]
    pub fn box_distance(&self, point_m: DVec3) -> f64 {
        self.obstacle.distance(point_m)
    }

    /// Whether the vehicle may stop at a point.
    #[must_use]
    pub fn is_place(&self, point_m: DVec3) -> bool {
        point_m.is_finite()
            && self.volume.contains(point_m)
            && point_m.z >= self.floor_z_m - 1e-9
            && self.box_distance(point_m) >= self.clearance_m - 1e-9
            && !self.occupancy.blocks(point_m)
    }

    /// Whether the vehicle may sink to the ground from a point: the whole way keeps the clearance from the box.
    #[must_use]
    pub fn may_sink(&self, from_m: DVec3) -> bool {
        // Of the points below, the one at the height of the box's centre is nearest to it.
        let nearest = from_m.with_z(from_m.z.min(self.obstacle.center_m.z));
        self.box_distance(nearest) >= self.clearance_m
    }

    /// Whether a segment of a path between two ends is free. Away from the ends the margin is kept as well. An end that is
    /// itself too near (the wind pushed the vehicle, or an obstacle was seen late) may be left, but only outward.
    #[must_use]
    pub fn is_free(&self, from_m: DVec3, to_m: DVec3, ends: [DVec3; 2]) -> bool {
        if !self.volume.contains(from_m) || !self.volume.contains(to_m) {
            return false;
        }
        let wanted = self.clearance_m + self.margin_m;
        let held = ends.map(|end| self.box_distance(end).min(wanted));
        let length = (to_m - from_m).length();
        // Not a number is not shorter.
        if length.is_nan() || length > LONGEST_LEG_M {
            return false;
        }
        let direction = (to_m - from_m).normalize_or_zero();
        let floor = |point: DVec3| {
            ends.iter().any(|end| end.z < self.floor_z_m && (point - *end).length() < 1e-6)
                || point.z >= self.floor_z_m - 1e-9
        };
        if !floor(from_m) || !floor(to_m) {
            return false;
        }
        let escapes = ends.map(|end| self.occupancy.blocks(end));
        let mut along = 0.0;
        loop {
            let point = from_m + direction * along;
            let asked =
                ends.iter().zip(held).map(|(end, held)| held + GROWTH * (point - *end).length()).fold(wanted, f64::min);
            let slack = self.box_distance(point) - asked;
            if slack < -1e-9 {
                return false;
            }
            let escaping = ends.iter().zip(escapes).any(|(end, inside)| inside && (point - *end).length() < 1.2);
            if !escaping && self.occupancy.blocks(point) {
                return false;
            }
            if along >= length {
                return true;
            }
            along = (along + (slack / (1.0 + GROWTH)).clamp(STEP_M, 0.1)).min(length);
        }
    }

    /// A point of free space near an intended one: pushed away from the box, lifted over the floor, into the volume.
    #[must_use]
    pub fn pushed_out(&self, point_m: DVec3) -> DVec3 {
        let mut point = point_m.clamp(self.volume.min_m, self.volume.max_m);
        point.z = point.z.max(self.floor_z_m);
        let mut steps = 0;
        while self.box_distance(point) < self.clearance_m && steps < 200 {
            let away = (point - self.obstacle.center_m).normalize_or(DVec3::Z);
            point += away * 0.05;
            point.z = point.z.max(self.floor_z_m);
            steps += 1;
        }
        point
    }
}
