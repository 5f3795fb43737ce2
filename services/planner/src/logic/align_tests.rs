use proptest::prelude::*;
use shared_types::frames::{Intrinsics, look_at};

use super::*;
use crate::testing::Scene;

/// A rock of three boxes, and a wall far away.
fn rock() -> Scene {
    let at = |x: f64, y: f64, edges: DVec3| Scene::single(x, y, edges).boxes;
    let mut boxes = at(0.1, -0.2, DVec3::new(1.5, 1.1, 0.9));
    boxes.extend(at(-0.4, 0.3, DVec3::new(0.7, 0.8, 1.4)));
    boxes.extend(at(0.7, 0.5, DVec3::new(0.5, 0.6, 0.5)));
    boxes.extend(at(-6.0, 1.0, DVec3::new(0.3, 4.0, 2.0)));
    Scene { boxes }
}

/// The prior's two views by a vehicle whose world lies off by `off_m`, with a noise of the depth that grows with it.
fn views(scene: &Scene, off_m: DVec3, intrinsics: Intrinsics, noise: f64, seed: u64) -> [DepthView; 2] {
    let wanted = [
        (DVec3::new(-0.3, 0.0, 6.0), DVec3::new(0.0, 0.0, 0.0)),
        (DVec3::new(-4.6, 0.3, 2.0), DVec3::new(0.0, 0.0, 0.7)),
    ];
    let mut state = seed | 1;
    wanted.map(|(position_m, at_m)| {
        let mut pose = look_at(position_m, at_m);
        // Where it truly is.
        pose.position_m += off_m;
        let mut view = scene.render(1, pose, intrinsics);
        for depth in &mut view.depth_m {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let uniform = (state >> 40) as f32 / (1 << 24) as f32 - 0.5;
            *depth *= 1.0 + noise as f32 * uniform;
        }
        view.world_from_camera.position_m -= off_m;
        view
    })
}

fn fit(stored: &[DepthView; 2], seen: &[&DepthView]) -> Option<Fit> {
    align(&[&stored[0], &stored[1]], seen, &Ground::level(0.0), DVec3::ZERO, 2.5)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_world_that_moved_is_found(
        x in -2.2..2.2f64, y in -1.8..1.8f64, z in -1.0..1.0f64, noise in 0.0..0.02f64, seed: u64, small: bool,
    ) {
        let intrinsics = if small { Intrinsics::from_hfov(96, 72, 1.204) } else { Intrinsics::from_hfov(192, 144, 1.204) };
        let off_m = DVec3::new(x, y, z);
        let stored = views(&rock(), DVec3::ZERO, intrinsics, noise, seed);
        let seen = views(&rock(), off_m, intrinsics, noise, !seed);
        // First from above, then, with the world about right, from both.
        let above = fit(&stored, &[&seen[0]]).expect("seen from above");
        prop_assert!((above.shift_m - off_m).length() < 0.3, "{above:?} for {off_m}");
        let rest_m = off_m - above.shift_m;
        let again = views(&rock(), rest_m, intrinsics, noise, seed ^ 7);
        let both = fit(&stored, &[&again[0], &again[1]]).expect("seen from both");
        prop_assert!((both.shift_m - rest_m).length() < 0.025 + 3.0 * noise, "{both:?} for {rest_m}");
        prop_assert!(both.residual_m < 0.04, "{both:?}");
    }
}

#[test]
fn another_object_or_none_does_not_fit() {
    let intrinsics = Intrinsics::from_hfov(192, 144, 1.204);
    let stored = views(&rock(), DVec3::ZERO, intrinsics, 0.01, 3);
    let bare = views(&Scene::default(), DVec3::ZERO, intrinsics, 0.01, 4);
    assert_eq!(fit(&stored, &[&bare[0], &bare[1]]), None);
    // Turned by 90 degrees.
    let turned = Scene {
        boxes: rock()
            .boxes
            .into_iter()
            .map(|(low, high)| {
                let (a, b) = (DVec3::new(-low.y, low.x, low.z), DVec3::new(-high.y, high.x, high.z));
                (a.min(b), a.max(b))
            })
            .collect(),
    };
    let seen = views(&turned, DVec3::ZERO, intrinsics, 0.01, 5);
    let turned = fit(&stored, &[&seen[0], &seen[1]]);
    assert!(turned.is_none_or(|fit| fit.residual_m > 0.05), "{turned:?}");
}
