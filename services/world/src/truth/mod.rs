//! The truth about the object, for evaluation only: what of its surface could be seen, what was seen, held-out views, and
//! distances between a reconstruction and the true surface. No service reads it.

mod coverage;
mod distances;
mod held_out;
mod samples;
mod visibility;

pub use coverage::{Coverage, CoverageMeter};
pub use distances::{Geometry, compare};
pub use held_out::{HeldOutError, HeldOutRules, HeldOutView, held_out_views};
pub use samples::SurfaceSamples;
pub use visibility::{ViewLimits, shell_poses, visible_samples};

use glam::DVec3;

/// `count` nearly even unit directions on the part of the sphere with z >= `lowest`: a golden-angle spiral, equal in area.
#[must_use]
pub fn spiral_directions(count: usize, lowest: f64) -> Vec<DVec3> {
    let golden_rad = std::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
    (0..count)
        .map(|i| {
            let z = 1.0 - (1.0 - lowest) * (i as f64 + 0.5) / count as f64;
            let r = (1.0 - z * z).max(0.0).sqrt();
            let angle = golden_rad * i as f64;
            DVec3::new(r * angle.cos(), r * angle.sin(), z)
        })
        .collect()
}
