//! Views that no mission trains on, to judge appearance: fixed by the true box of the object and the candidates' directions
//! alone, so that they are the same for every method.

use glam::DVec3;

use super::spiral_directions;
use shared_types::frames::{Pose, look_at};

/// How held-out views are spread.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeldOutRules {
    /// How many, over both radii together.
    pub count: usize,
    /// Lowest elevation above the horizon, seen from the centre of the box, degrees.
    pub min_elevation_deg: f64,
    /// Least angle to each direction that is to be avoided, degrees.
    pub min_separation_deg: f64,
    /// The second radius as a share of the first.
    pub near_share: f64,
}

impl Default for HeldOutRules {
    fn default() -> Self {
        Self { count: 100, min_elevation_deg: 5.0, min_separation_deg: 5.0, near_share: 0.8 }
    }
}

/// A held-out view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeldOutView {
    /// Where the camera is; it looks at the centre of the box.
    pub world_from_camera: Pose,
    /// At the second, smaller radius.
    pub near: bool,
}

/// The directions to be avoided leave no room.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error(
    "held-out views: {found} directions are at least {min_separation_deg} degrees from all {avoided} candidates, {wanted} were expected; use fewer candidates or a smaller separation"
)]
pub struct HeldOutError {
    /// Directions found.
    pub found: usize,
    /// Directions needed.
    pub wanted: usize,
    /// Directions to be avoided.
    pub avoided: usize,
    /// The separation asked for, degrees.
    pub min_separation_deg: f64,
}

/// Views around the true box, every second one at the near radius. `avoid` holds unit directions from the box's centre
/// (those of the candidates).
///
/// # Errors
/// [`HeldOutError`] if `avoid` leaves too little of the sphere.
pub fn held_out_views(
    (box_min_m, box_max_m): (DVec3, DVec3),
    radius_m: f64,
    avoid: &[DVec3],
    rules: &HeldOutRules,
) -> Result<Vec<HeldOutView>, HeldOutError> {
    let center = (box_min_m + box_max_m) / 2.0;
    let limit = rules.min_separation_deg.to_radians().cos();
    let lowest = rules.min_elevation_deg.to_radians().sin();
    let mut free = Vec::new();
    // Ever denser spirals, until enough of one is free.
    for density in 0..8 {
        free = spiral_directions(rules.count.max(1) << density, lowest);
        free.retain(|direction| avoid.iter().all(|other| other.dot(*direction) < limit));
        if free.len() >= rules.count {
            break;
        }
    }
    if free.len() < rules.count {
        let (found, wanted, min_separation_deg) = (free.len(), rules.count, rules.min_separation_deg);
        return Err(HeldOutError { found, wanted, avoided: avoid.len(), min_separation_deg });
    }
    // The spiral runs from the zenith down: taking evenly along it keeps the views even over the elevations.
    Ok((0..rules.count)
        .map(|i| {
            let direction = free[i * free.len() / rules.count];
            let near = i % 2 == 1;
            let radius = radius_m * if near { rules.near_share } else { 1.0 };
            HeldOutView { world_from_camera: look_at(center + direction * radius, center), near }
        })
        .collect())
}
