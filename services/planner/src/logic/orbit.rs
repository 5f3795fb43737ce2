//! The paper's baseline: circles about the object at two heights (A22, A28).

use core::f64::consts::TAU;

use glam::DVec3;
use shared_types::config::planner::{PlannerConfig, Strategy};

use super::candidates::{PitchLimits, radius_m};
use super::prior::Prior;
use super::view::View;

/// Heights above the ground and pitches of the two circles (Section V-A).
const CIRCLES: [(f64, f64); 2] = [(1.0, -15.0), (2.5, -30.0)];

/// The views of an orbit in the order of flight: the low circle, then the high one, starting at `azimuth_rad`. Empty for a
/// strategy that is no orbit. Fewer keyframes than the strategy has are spread over both circles as evenly.
///
/// At radius R the paper's pitches do not meet the centre (A22): the cameras look at the axis above or below it.
/// `orbit-look-at` looks at the centre. A gimbal that cannot look so low looks as low as it can.
#[must_use]
pub fn views(prior: &Prior, limits: PitchLimits, azimuth_rad: f64, config: &PlannerConfig) -> Vec<View> {
    let wanted = config.keyframes_wanted();
    let look_at_center = match config.strategy {
        Strategy::Nbv => return Vec::new(),
        Strategy::Orbit24 | Strategy::Orbit48 => false,
        Strategy::OrbitLookAt => true,
    };
    let center = prior.center();
    let radius = radius_m(prior.size_m, config);
    let counts = [wanted.div_ceil(2), wanted / 2];
    let mut views = Vec::new();
    for ((height, pitch_deg), count) in CIRCLES.into_iter().zip(counts) {
        for step in 0..count {
            let angle = azimuth_rad + TAU * f64::from(step) / f64::from(count);
            let mut position = center + DVec3::new(angle.cos(), angle.sin(), 0.0) * radius;
            position.z = prior.ground.z_at(position) + height.max(config.lowest_altitude_m);
            let pitch = pitch_deg.to_radians().clamp(limits.min_rad, limits.max_rad.max(limits.min_rad));
            let axis = DVec3::new(center.x, center.y, position.z + radius * pitch.tan());
            views.push(View { position_m: position, look_at_m: if look_at_center { center } else { axis } });
        }
    }
    views
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::logic::prior::Ground;
    use core::f64::consts::PI;

    #[test]
    fn orbit24_has_twelve_views_at_each_height_with_the_papers_pitches() {
        let prior = Prior {
            center_m: [0.5, 0.0, 0.75],
            size_m: 2.0,
            ground: Ground::level(0.1),
            extents_m: [1.5; 3],
            clamped: false,
        };
        let limits = PitchLimits { min_rad: -PI / 2.0, max_rad: 0.3 };
        let mut config = PlannerConfig { strategy: Strategy::Orbit24, ..PlannerConfig::paper() };
        let orbit = views(&prior, limits, 0.3, &config);
        assert_eq!(orbit.len(), 24);
        for (at, view) in orbit.iter().enumerate() {
            let (height, pitch) = if at < 12 { (1.1, -15.0) } else { (2.6, -30.0) };
            assert!((view.position_m.z - height).abs() < 1e-9);
            assert!((view.pitch_rad().to_degrees() - pitch).abs() < 1e-9);
            assert!(((view.position_m - prior.center()).truncate().length() - 2.5).abs() < 1e-9);
        }
        config.strategy = Strategy::OrbitLookAt;
        assert!(views(&prior, limits, 0.3, &config).iter().all(|view| view.look_at_m == prior.center()));
        config.keyframes = 6;
        assert_eq!(views(&prior, limits, 0.3, &config).len(), 6);
        config.strategy = Strategy::Nbv;
        assert!(views(&prior, limits, 0.3, &config).is_empty());
    }
}
