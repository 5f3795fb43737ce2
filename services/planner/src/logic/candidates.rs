//! Candidate views (Section IV-C, A16, A21): points of a full Fibonacci sphere about the box that can be flown to and
//! looked from.

use core::f64::consts::{PI, TAU};

use glam::DVec3;
use shared_types::config::planner::{PlannerConfig, RadiusRule};

use super::prior::Prior;
use super::space::FreeSpace;
use super::view::{Mount, View, aim};

/// Lowest and highest pitch of the gimbal, radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PitchLimits {
    /// Lowest; negative looks down.
    pub min_rad: f64,
    /// Highest.
    pub max_rad: f64,
}

impl PitchLimits {
    /// Within a thousandth of a radian of the limits.
    #[must_use]
    pub fn allow(&self, pitch_rad: f64) -> bool {
        pitch_rad >= self.min_rad - 1e-3 && pitch_rad <= self.max_rad + 1e-3
    }
}

/// A candidate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Index on the Fibonacci sphere.
    pub index: u32,
    /// Place and what it looks at (the centre of the box).
    pub view: View,
    /// Unit vector from the centre of the box.
    pub direction: DVec3,
}

/// Why points of the sphere are no candidates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Dropped {
    /// Below the lowest altitude.
    pub low: u32,
    /// Too near to the box, or outside the mission volume.
    pub unsafe_place: u32,
    /// Beyond the gimbal's limits.
    pub gimbal: u32,
}

/// The candidates of a mission.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Candidates {
    /// In the order of their indices.
    pub list: Vec<Candidate>,
    /// What was left out.
    pub dropped: Dropped,
}

impl Candidates {
    /// The grid scale of Eq. 4: sqrt(2 pi / N), radians.
    #[must_use]
    pub fn grid_scale_rad(&self) -> f64 {
        #[expect(clippy::cast_precision_loss, reason = "a few hundred")]
        let count = self.list.len().max(1) as f64;
        (TAU / count).sqrt()
    }

    /// The candidate with this index.
    #[must_use]
    pub fn get(&self, index: u32) -> Option<&Candidate> {
        self.list.binary_search_by_key(&index, |candidate| candidate.index).ok().and_then(|at| self.list.get(at))
    }
}

/// Radius R of the candidate sphere, metres.
#[must_use]
pub fn radius_m(size_m: f64, config: &PlannerConfig) -> f64 {
    match config.radius {
        RadiusRule::Paper => size_m + 0.5,
        RadiusRule::Clear => (size_m + 0.5).max(0.87 * size_m + config.clearance_m),
    }
}

/// Unit vector of point `index` of `count` on the full Fibonacci sphere; the first is at the top.
#[must_use]
pub fn fibonacci_direction(index: u32, count: u32) -> DVec3 {
    let golden = PI * (3.0 - 5.0_f64.sqrt());
    let z = 1.0 - (2.0 * f64::from(index) + 1.0) / f64::from(count.max(1));
    let across = (1.0 - z * z).max(0.0).sqrt();
    let angle = golden * f64::from(index);
    DVec3::new(across * angle.cos(), across * angle.sin(), z)
}

/// Points of the sphere that can be flown to (altitude, clearance of camera and vehicle, mission volume) and from which
/// the gimbal can look at the centre.
#[must_use]
pub fn generate(
    prior: &Prior,
    space: &FreeSpace,
    mount: &Mount,
    limits: PitchLimits,
    config: &PlannerConfig,
) -> Candidates {
    let center = prior.center();
    let radius = radius_m(prior.size_m, config);
    let mut candidates = Candidates::default();
    for index in 0..config.sphere_points {
        let direction = fibonacci_direction(index, config.sphere_points);
        let view = View { position_m: center + direction * radius, look_at_m: center };
        let altitude = view.position_m.z - prior.ground.z_at(view.position_m);
        let placed = aim(&view, mount, 0.0);
        if altitude < config.lowest_altitude_m {
            candidates.dropped.low += 1;
        } else if space.box_distance(view.position_m) < config.clearance_m - 1e-9 || !space.is_place(placed.body_m) {
            candidates.dropped.unsafe_place += 1;
        } else if !limits.allow(view.pitch_rad()) {
            candidates.dropped.gimbal += 1;
        } else {
            candidates.list.push(Candidate { index, view, direction });
        }
    }
    candidates
}

/// The seed orbit (A20): views evenly about the box at radius R, at an elevation, looking at the centre. Where the box
/// lies so low that they would be below the lowest altitude, they are raised on the sphere to it; where the gimbal cannot
/// look so low, likewise lowered.
#[must_use]
pub fn seed_orbit(prior: &Prior, limits: PitchLimits, config: &PlannerConfig) -> Vec<View> {
    let center = prior.center();
    let radius = radius_m(prior.size_m, config);
    let steepest = (-limits.min_rad).clamp(0.0, PI / 2.0);
    let count = config.seed_views;
    (0..count)
        .map(|step| {
            let azimuth = TAU * f64::from(step) / f64::from(count.max(1));
            let around = DVec3::new(azimuth.cos(), azimuth.sin(), 0.0);
            let mut elevation = config.seed_elevation_deg.to_radians().min(steepest);
            let ground = prior.ground.z_at(center + around * radius * elevation.cos());
            let least = (ground + config.lowest_altitude_m + 0.01 - center.z) / radius;
            elevation = elevation.max(least.clamp(-1.0, 1.0).asin());
            let direction = around * elevation.cos() + DVec3::Z * elevation.sin();
            View { position_m: center + direction * radius, look_at_m: center }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::logic::prior::Ground;
    use crate::logic::space::Volume;

    fn prior(size_m: f64, z: f64) -> Prior {
        Prior {
            center_m: [1.0, -2.0, z],
            size_m,
            ground: Ground::level(0.0),
            extents_m: [size_m - 0.5; 3],
            clamped: false,
        }
    }

    fn space(prior: &Prior, config: &PlannerConfig) -> FreeSpace {
        FreeSpace::around_prior(
            prior,
            Volume { min_m: DVec3::new(-20.0, -20.0, 0.0), max_m: DVec3::splat(20.0) },
            0.0,
            config,
        )
    }

    const FREE: PitchLimits = PitchLimits { min_rad: -PI / 2.0, max_rad: 0.35 };

    #[test]
    fn the_paper_preset_keeps_about_half_the_sphere() {
        for size in [1.0, 1.5, 2.0, 3.0] {
            let config = PlannerConfig::paper();
            let prior = prior(size, size / 2.0 - 0.25);
            let candidates = generate(&prior, &space(&prior, &config), &Mount::default(), FREE, &config);
            assert!((85..=130).contains(&candidates.list.len()), "{size}: {}", candidates.list.len());
            let total = candidates.list.len() as u32
                + candidates.dropped.low
                + candidates.dropped.unsafe_place
                + candidates.dropped.gimbal;
            assert_eq!(total, 200);
        }
    }

    #[test]
    fn candidates_are_as_high_as_far_and_as_steep_as_allowed() {
        let config = PlannerConfig::default();
        let prior = prior(2.0, 0.75);
        let limits = PitchLimits { min_rad: -PI / 4.0, max_rad: PI / 4.0 };
        let candidates = generate(&prior, &space(&prior, &config), &Mount::default(), limits, &config);
        assert!(candidates.dropped.gimbal > 10 && candidates.dropped.low > 50);
        for candidate in &candidates.list {
            let position = candidate.view.position_m;
            assert!(position.z >= 0.8 && candidate.view.pitch_rad() >= -PI / 4.0 - 1e-3);
            assert!(((position - prior.center()).length() - 2.5).abs() < 1e-9);
            assert_eq!(candidates.get(candidate.index), Some(candidate));
        }
        let scale = candidates.grid_scale_rad();
        assert!((scale * scale * candidates.list.len() as f64 - TAU).abs() < 1e-9);
    }

    #[test]
    fn fibonacci_points_have_unit_length_and_keep_apart() {
        let points: Vec<DVec3> = (0..200).map(|index| fibonacci_direction(index, 200)).collect();
        for (i, a) in points.iter().enumerate() {
            assert!((a.length() - 1.0).abs() < 1e-12);
            for b in &points[..i] {
                assert!(a.angle_between(*b) > 0.15, "closer than 8.6 degrees");
            }
        }
        assert!(points.iter().sum::<DVec3>().length() < 1.0, "balanced about the centre");
    }

    #[test]
    fn seed_views_stand_at_right_angles_and_never_too_low() {
        let config = PlannerConfig::default();
        for z in [0.1, 0.75] {
            let prior = prior(1.0, z);
            let seeds = seed_orbit(&prior, FREE, &config);
            assert_eq!(seeds.len(), 4);
            for pair in seeds.windows(2) {
                let flat = |view: &View| (view.position_m - prior.center()).truncate();
                assert!((flat(&pair[0]).angle_to(flat(&pair[1])) - PI / 2.0).abs() < 1e-9);
            }
            for seed in &seeds {
                assert!(seed.position_m.z >= 0.8);
                assert!(((seed.position_m - prior.center()).length() - radius_m(1.0, &config)).abs() < 1e-9);
            }
        }
        let high = prior(2.0, 3.0);
        let elevation = -seed_orbit(&high, FREE, &config)[0].pitch_rad();
        assert!((elevation.to_degrees() - 20.0).abs() < 1e-9);
    }
}
