//! The cuboidal prior (Section IV-B, A17-A19): the box of the object from an overhead and a side depth image.
//!
//! A plane is fitted to the ground that both clouds show, seeded by the 85th percentile of depth (the lowest heights of
//! the overhead view); what stands more than 5 cm above it inside the survey radius is the object.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use shared_types::config::planner::{BoxCenter, PlannerConfig};

use super::depth::DepthView;

/// Points looked at of each image.
const POINTS: usize = 60_000;
/// Fewest object points, and least share of an image's points, that make an object.
const FEWEST_POINTS: usize = 40;
const LEAST_SHARE: f64 = 0.000_5;
/// How far from the expected ground the seed may lie, metres: an object that fills the image hides the ground.
const SEED_TOLERANCE_M: f64 = 1.5;

/// The ground: z = slope . (x, y) + offset.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Ground {
    /// Rise a metre to the east and to the north.
    pub slope: [f64; 2],
    /// Height at the origin of the world, metres.
    pub offset_m: f64,
}

impl Ground {
    /// Level ground at a height.
    #[must_use]
    pub fn level(z_m: f64) -> Self {
        Self { slope: [0.0; 2], offset_m: z_m }
    }

    /// Height under a point, metres.
    #[must_use]
    pub fn z_at(&self, point_m: DVec3) -> f64 {
        self.slope[0] * point_m.x + self.slope[1] * point_m.y + self.offset_m
    }
}

/// The prior.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Prior {
    /// Centre of the cube, metres.
    pub center_m: [f64; 3],
    /// Edge of the cube (B), metres.
    pub size_m: f64,
    /// The ground.
    pub ground: Ground,
    /// Extents of the object's points (1st to 99th percentile), metres.
    pub extents_m: [f64; 3],
    /// The object is larger than the largest box: the box cuts it.
    pub clamped: bool,
}

impl Prior {
    /// Centre of the cube.
    #[must_use]
    pub fn center(&self) -> DVec3 {
        DVec3::from_array(self.center_m)
    }

    /// Height of the ground under the centre, metres.
    #[must_use]
    pub fn ground_z_m(&self) -> f64 {
        self.ground.z_at(self.center())
    }
}

fn percentile(values: &mut [f64], share: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    #[expect(
        clippy::cast_precision_loss,
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "an index"
    )]
    let index = (share.clamp(0.0, 1.0) * (values.len() - 1) as f64).round() as usize;
    *values.select_nth_unstable_by(index, f64::total_cmp).1
}

/// Fits the ground to both clouds: seeded by the 15th percentile of the overhead's heights (its 85th percentile of depth),
/// then least squares on what is near, ever nearer, and less so above (there stands the object).
#[must_use]
pub fn fit_ground(overhead: &[DVec3], side: &[DVec3], survey_m: DVec3, reach_m: f64, expected_z_m: f64) -> Ground {
    let near = |point: &&DVec3| (point.truncate() - survey_m.truncate()).length() <= reach_m;
    let mut heights: Vec<f64> = overhead.iter().filter(near).map(|point| point.z).collect();
    let seed = percentile(&mut heights, 0.15);
    let seed = if heights.is_empty() || (seed - expected_z_m).abs() > SEED_TOLERANCE_M { expected_z_m } else { seed };
    let mut ground = Ground::level(seed);
    for (below, above) in [(0.30, 0.15), (0.15, 0.08), (0.10, 0.05), (0.08, 0.04), (0.06, 0.03)] {
        let mut normal = DMat3::ZERO;
        let mut right = DVec3::ZERO;
        let mut inliers = 0_u32;
        for point in overhead.iter().chain(side).filter(near) {
            let off = point.z - ground.z_at(*point);
            if off > -below && off < above {
                let row = DVec3::new(point.x - survey_m.x, point.y - survey_m.y, 1.0);
                normal += DMat3::from_cols(row * row.x, row * row.y, row * row.z);
                right += row * point.z;
                inliers += 1;
            }
        }
        if inliers < 30 || normal.determinant().abs() < 1e-6 {
            break;
        }
        let fit = normal.inverse() * right;
        // Steeper than 30 degrees is no ground to stand on: the fit caught the object.
        if !fit.is_finite() || fit.truncate().length() > 0.577 {
            break;
        }
        let offset_m = fit.z - fit.x * survey_m.x - fit.y * survey_m.y;
        ground = Ground { slope: [fit.x, fit.y], offset_m };
    }
    ground
}

/// Points of the object: above the ground, inside the survey radius.
#[must_use]
pub fn segment(points: &[DVec3], ground: &Ground, survey_m: DVec3, config: &PlannerConfig) -> Vec<DVec3> {
    let stands = |point: &&DVec3| {
        let height = point.z - ground.z_at(**point);
        height > config.segment_height_m && (point.truncate() - survey_m.truncate()).length() <= config.survey_radius_m
    };
    points.iter().filter(stands).copied().collect()
}

fn enough(object: usize, all: usize) -> bool {
    #[expect(clippy::cast_precision_loss, reason = "counts of points")]
    let share = object as f64 / (all.max(1)) as f64;
    object >= FEWEST_POINTS && share >= LEAST_SHARE
}

/// The prior from both views; `None` when nothing stands at the survey point.
#[must_use]
pub fn estimate(
    overhead: &DepthView,
    side: &DepthView,
    survey_m: DVec3,
    expected_ground_z_m: f64,
    config: &PlannerConfig,
) -> Option<Prior> {
    let (above, beside) = (overhead.points(POINTS), side.points(POINTS));
    let ground = fit_ground(&above, &beside, survey_m, 2.0 * config.survey_radius_m, expected_ground_z_m);
    let clouds = [segment(&above, &ground, survey_m, config), segment(&beside, &ground, survey_m, config)];
    if !enough(clouds[0].len(), above.len()) && !enough(clouds[1].len(), beside.len()) {
        return None;
    }
    let mut low = DVec3::splat(f64::INFINITY);
    let mut high = DVec3::splat(f64::NEG_INFINITY);
    let mut median = DVec3::ZERO;
    for axis in 0..3 {
        let mut all = Vec::new();
        for cloud in clouds.iter().filter(|cloud| cloud.len() >= FEWEST_POINTS) {
            let mut values: Vec<f64> = cloud.iter().map(|point| point[axis]).collect();
            low[axis] = low[axis].min(percentile(&mut values, 0.01));
            high[axis] = high[axis].max(percentile(&mut values, 0.99));
            all.append(&mut values);
        }
        median[axis] = percentile(&mut all, 0.5);
    }
    if !low.is_finite() || !high.is_finite() {
        return None;
    }
    let middle = (low + high) / 2.0;
    // What stands on the ground begins there, though its foot is hidden or within 5 cm of it.
    low.z = low.z.min(ground.z_at(middle));
    let extents = high - low;
    let wanted = extents.max_element() + config.box_margin_m;
    let center = match config.box_center {
        BoxCenter::Midpoint => (low + high) / 2.0,
        BoxCenter::Median => median,
    };
    Some(Prior {
        center_m: center.to_array(),
        size_m: wanted.clamp(config.box_min_m, config.box_max_m),
        ground,
        extents_m: extents.to_array(),
        clamped: wanted > config.box_max_m,
    })
}

/// Looks for an object anywhere in a depth image, within `reach_m` of the survey point: the median of what stands above
/// the level ground, or `None`. For the yaw scan, when nothing stood at the survey point.
#[must_use]
pub fn find_object(view: &DepthView, survey_m: DVec3, reach_m: f64, ground_z_m: f64) -> Option<DVec3> {
    let points = view.points(20_000);
    let ground = fit_ground(&points, &[], survey_m, reach_m, ground_z_m);
    let object: Vec<DVec3> = points
        .iter()
        .filter(|point| {
            let height = point.z - ground.z_at(**point);
            height > 0.15 && height < 5.0 && (point.truncate() - survey_m.truncate()).length() <= reach_m
        })
        .copied()
        .collect();
    if !enough(object.len(), points.len().min(4_000)) {
        return None;
    }
    let axis = |index: usize| percentile(&mut object.iter().map(|point| point[index]).collect::<Vec<_>>(), 0.5);
    let (x, y) = (axis(0), axis(1));
    Some(DVec3::new(x, y, ground.z_at(DVec3::new(x, y, 0.0))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Scene;
    use shared_types::frames::{Intrinsics, look_at};

    fn views(scene: &Scene) -> (DepthView, DepthView) {
        let camera = Intrinsics::from_hfov(160, 120, 1.204);
        let overhead = scene.render(0, look_at(DVec3::new(0.0, 0.0, 5.0), DVec3::ZERO), camera);
        let side = scene.render(0, look_at(DVec3::new(-4.0, 0.0, 1.5), DVec3::new(0.0, 0.0, 0.75)), camera);
        (overhead, side)
    }

    fn prior_of(scene: &Scene, config: &PlannerConfig) -> Option<Prior> {
        let (overhead, side) = views(scene);
        estimate(&overhead, &side, DVec3::ZERO, 0.0, config)
    }

    #[test]
    fn a_box_is_found_where_it_stands_and_as_large_as_it_is() {
        for edges in [DVec3::new(1.2, 0.8, 0.6), DVec3::new(0.6, 0.6, 1.8), DVec3::new(2.4, 1.0, 1.0)] {
            let scene = Scene::single(0.3, -0.4, edges);
            let prior = prior_of(&scene, &PlannerConfig::default()).unwrap();
            let truth = DVec3::new(0.3, -0.4, edges.z / 2.0);
            assert!((prior.center() - truth).length() < 0.08, "{prior:?}");
            assert!((prior.size_m - (edges.max_element() + 0.5).clamp(1.0, 4.0)).abs() < 0.10, "{prior:?}");
            assert!(prior.ground_z_m().abs() < 0.02 && !prior.clamped);
        }
    }

    #[test]
    fn the_papers_median_leans_to_what_is_seen_more() {
        let scene = Scene::single(0.0, 0.0, DVec3::new(1.0, 1.0, 1.0));
        let paper = prior_of(&scene, &PlannerConfig::paper()).unwrap();
        let ours = prior_of(&scene, &PlannerConfig::default()).unwrap();
        assert!(paper.center_m[2] > ours.center_m[2] + 0.1, "the top is seen most: {paper:?} {ours:?}");
        assert!((ours.center_m[2] - 0.5).abs() < 0.05);
    }

    #[test]
    fn a_small_object_gets_the_least_box_and_a_large_one_is_cut_with_a_word() {
        let config = PlannerConfig::default();
        let small = prior_of(&Scene::single(0.0, 0.0, DVec3::splat(0.3)), &config).unwrap();
        assert_eq!((small.size_m, small.clamped), (1.0, false));
        let large = prior_of(&Scene::single(0.0, 0.0, DVec3::new(4.4, 2.0, 1.0)), &config).unwrap();
        assert_eq!((large.size_m, large.clamped), (4.0, true));
    }

    #[test]
    fn bare_ground_and_things_outside_the_survey_radius_are_no_object() {
        let config = PlannerConfig::default();
        assert_eq!(prior_of(&Scene::default(), &config), None);
        let far = Scene { boxes: vec![(DVec3::new(3.0, -1.0, 0.0), DVec3::new(3.8, 1.0, 1.0))] };
        assert_eq!(prior_of(&far, &config), None);
        let (overhead, _) = views(&far);
        let found = find_object(&overhead, DVec3::ZERO, 6.0, 0.0).unwrap();
        assert!((found.truncate() - glam::DVec2::new(3.2, 0.0)).length() < 0.5, "{found}");
    }

    #[test]
    fn sloping_ground_is_no_object_and_the_slope_is_found() {
        // 4 degrees of slope to the east.
        let plane = |x: f64, y: f64| DVec3::new(x, y, 0.07 * x + 0.2);
        let points: Vec<DVec3> =
            (0..4000).map(|i| plane(f64::from(i % 63) * 0.08 - 2.5, f64::from(i / 63) * 0.08 - 2.5)).collect();
        let ground = fit_ground(&points, &points, DVec3::ZERO, 5.0, 0.0);
        assert!((ground.slope[0] - 0.07).abs() < 0.005 && (ground.offset_m - 0.2).abs() < 0.01, "{ground:?}");
        assert!(segment(&points, &ground, DVec3::ZERO, &PlannerConfig::default()).is_empty());
    }
}
