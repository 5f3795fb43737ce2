//! What is taken out of the model: each round what is wrong, at the cap what contributes least.

use glam::Vec3;
use rayon::prelude::*;

use super::clip_box::ClipBox;
use crate::{Camera, Gaussian, Gaussians};

/// When a Gaussian is wrong.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PruneRules {
    /// The part of the world that the model may fill.
    pub clip: ClipBox,
    /// Less opaque ones go.
    pub min_opacity: f32,
    /// Ones with a greater standard deviation go, metres.
    pub max_sigma_m: f32,
    /// Ones whose centre lies more than this before the measured depth go, metres.
    pub front_m: f32,
    /// In at least this many views; 0: that rule is off.
    pub front_views: u32,
}

/// A depth image and where it was taken.
#[derive(Debug, Clone, Copy)]
pub struct DepthView<'a> {
    /// Names image and camera among all that a model is pruned by, as long as it is trained: a GPU keeps them by it.
    pub id: u64,
    /// The camera at the image's size.
    pub camera: &'a Camera,
    /// Centre z, metres, 0 = no measurement.
    pub depth_m: &'a [f32],
}

impl DepthView<'_> {
    /// Whether a point lies more than `front_m` before everything measured in the 3x3 pixels about it. One pixel would not
    /// do: beside a silhouette, half a pixel decides between object and background, and each point of a surface lies at
    /// the silhouette of some views.
    fn is_before_measurement(&self, point: Vec3, front_m: f32) -> bool {
        let Some((uv, depth)) = self.camera.project(point) else { return false };
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        if !(uv.x >= 1.0 && uv.y >= 1.0 && uv.x < width as f32 - 1.0 && uv.y < height as f32 - 1.0) {
            return false;
        }
        let (x, y) = (uv.x as usize, uv.y as usize);
        (y - 1..=y + 1).all(|row| {
            self.depth_m
                .get(row * width + x - 1..=row * width + x + 1)
                .is_some_and(|depths| depths.iter().all(|&d| d > 0.0 && depth + front_m < d))
        })
    }
}

/// Which Gaussians to keep, by index.
#[must_use]
pub fn keep(model: &Gaussians, views: &[DepthView<'_>], rules: &PruneRules) -> Vec<bool> {
    (0..model.len())
        .into_par_iter()
        .map(|index| {
            let gaussian = model.get(index);
            if !gaussian.is_finite()
                || gaussian.opacity() < rules.min_opacity
                || gaussian.log_scales.max_element().exp() > rules.max_sigma_m
                || !rules.clip.contains(gaussian.mean)
            {
                return false;
            }
            let mut before = 0;
            rules.front_views == 0
                || !views.iter().any(|view| {
                    before += u32::from(view.is_before_measurement(gaussian.mean, rules.front_m));
                    before >= rules.front_views
                })
        })
        .collect()
}

/// What a Gaussian can contribute to images: its opacity times the area of its largest cross-section, m^2.
#[must_use]
pub fn contribution(gaussian: &Gaussian) -> f32 {
    let sigma = gaussian.log_scales.exp();
    let smallest = sigma.min_element().max(f32::MIN_POSITIVE);
    gaussian.opacity() * (sigma.x * sigma.y * sigma.z / smallest)
}

/// Which Gaussians to keep so that at most `keep_count` remain: those that contribute most; ties go to the older.
#[must_use]
pub fn keep_most_contributing(model: &Gaussians, keep_count: usize) -> Vec<bool> {
    let mut kept = vec![true; model.len()];
    if model.len() > keep_count {
        let mut ranked: Vec<(f32, usize)> =
            model.iter().enumerate().map(|(index, gaussian)| (contribution(&gaussian), index)).collect();
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        for &(_, index) in ranked.iter().skip(keep_count) {
            kept[index] = false;
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use crate::Pose;
    use glam::Quat;

    use super::*;

    fn gaussian(mean: Vec3) -> Gaussian {
        Gaussian {
            mean,
            log_scales: Vec3::splat(0.01f32.ln()),
            rotation: Quat::IDENTITY,
            opacity_logit: 1.0,
            sh: [0.0; 3],
            id: 0,
            birth_round: 0,
        }
    }

    fn rules() -> PruneRules {
        PruneRules {
            clip: ClipBox { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) },
            min_opacity: 0.02,
            max_sigma_m: 0.04,
            front_m: 0.03,
            front_views: 2,
        }
    }

    #[test]
    fn faint_large_broken_and_outside_ones_go() {
        let good = gaussian(Vec3::ZERO);
        let model: Gaussians = [
            good,
            Gaussian { opacity_logit: -4.0, ..good },
            Gaussian { log_scales: Vec3::new(-5.0, -5.0, 0.05f32.ln()), ..good },
            Gaussian { opacity_logit: f32::NAN, ..good },
            gaussian(Vec3::new(0.0, 0.0, 1.1)),
            gaussian(Vec3::new(0.9, 0.0, 0.0)),
        ]
        .into_iter()
        .collect();
        assert_eq!(keep(&model, &[], &rules()), [true, false, false, false, false, true]);
    }

    #[test]
    fn floaters_go_once_two_views_look_through_them() {
        // Two cameras look at a wall at y = 0 from the south; a floater hangs 0.5 m before it.
        let camera = |x: f32| {
            Camera::from_hfov(Pose::IDENTITY, 1.204, 64, 48).look_at(
                Vec3::new(x, -2.0, 0.0),
                Vec3::new(x, 0.0, 0.0),
                Vec3::Z,
            )
        };
        let cameras = [camera(-0.2), camera(0.2)];
        let wall = vec![2.0f32; 64 * 48];
        let model: Gaussians = [
            gaussian(Vec3::new(0.0, -0.5, 0.0)),
            gaussian(Vec3::new(0.0, -0.02, 0.0)),
            gaussian(Vec3::new(0.0, 0.5, 0.0)),
        ]
        .into_iter()
        .collect();
        let views: Vec<DepthView<'_>> =
            cameras.iter().zip(0..).map(|(camera, id)| DepthView { id, camera, depth_m: &wall }).collect();
        assert_eq!(keep(&model, &views, &rules()), [false, true, true], "behind the wall is not before it");
        assert_eq!(keep(&model, &views[..1], &rules()), [true; 3], "one view is not enough");
        assert_eq!(keep(&model, &views, &PruneRules { front_views: 0, ..rules() }), [true; 3]);
        // A hole beside the pixel: nothing is known for sure.
        let (uv, _) = cameras[0].project(Vec3::new(0.0, -0.5, 0.0)).unwrap();
        let mut holed = wall.clone();
        holed[uv.y as usize * 64 + uv.x as usize + 1] = 0.0;
        let views = [DepthView { id: 2, camera: &cameras[0], depth_m: &holed }, views[1]];
        assert_eq!(keep(&model, &views, &rules()), [true; 3]);
    }

    #[test]
    fn at_the_cap_the_largest_and_most_opaque_stay() {
        let base = gaussian(Vec3::ZERO);
        let model: Gaussians = [
            Gaussian { opacity_logit: -2.0, ..base },
            base,
            Gaussian { log_scales: base.log_scales + 1.0, ..base },
            base,
        ]
        .into_iter()
        .collect();
        assert_eq!(keep_most_contributing(&model, 2), [false, true, true, false]);
        assert_eq!(keep_most_contributing(&model, 4), [true; 4]);
        // A disc counts by its face, not by its edge.
        let disc = Gaussian { log_scales: Vec3::new(-3.0, -8.0, -3.0), ..base };
        assert!((contribution(&disc) - disc.opacity() * (-6.0f32).exp()).abs() < 1e-7);
    }
}
