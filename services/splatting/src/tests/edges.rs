//! Scenes at the edge of what can be drawn.

use glam::{Quat, Vec3};

use super::{camera, isas, random_view, scene};
use crate::reference::{self, Pixel};
use crate::{Camera, Engine, Gaussian, Gaussians, Optimiser, Pose, RenderSettings, Rendered, TrainingSettings};

fn gaussian(mean: Vec3, sigma_m: f32, opacity_logit: f32) -> Gaussian {
    Gaussian {
        mean,
        log_scales: Vec3::splat(sigma_m.ln()),
        rotation: Quat::IDENTITY,
        opacity_logit,
        sh: [1.0, 0.0, -1.0],
        id: 0,
        birth_round: 0,
    }
}

/// Renders on every instruction set and compares with the reference.
fn check(model: &Gaussians, camera: &Camera) -> Vec<Pixel> {
    let settings = RenderSettings::default();
    let expected = reference::render(&reference::parameters(model), camera, &settings, 0.0);
    for isa in isas() {
        let mut rendered = Rendered::default();
        Engine::with_isa(2, isa).unwrap().render(model, camera, &settings, &mut rendered);
        assert_eq!(rendered.color.len(), camera.pixels());
        for (i, pixel) in expected.iter().enumerate().filter(|(_, p)| !p.at_cut) {
            let color = pixel.color + (1.0 - pixel.alpha) * 0.5;
            for k in 0..3 {
                let got = f64::from(rendered.color[i][k]);
                assert!((got - color[k]).abs() < 1e-4, "{isa:?}, pixel {i}: {got} instead of {}", color[k]);
            }
        }
    }
    expected
}

#[test]
fn nothing_is_the_background() {
    for pixel in check(&Gaussians::new(), &camera(19, 33)) {
        assert_eq!(pixel.alpha, 0.0);
    }
    let mut engine = Engine::new(2).unwrap();
    let (mut model, mut optimiser) = (Gaussians::new(), Optimiser::new());
    let view = random_view(camera(19, 33), 1);
    let terms = engine.train_step(&mut model, &mut optimiser, &view, &TrainingSettings::default());
    assert!(terms.total.is_finite() && terms.free_alpha == 0.0);
}

#[test]
fn one_splat_fills_the_screen() {
    let camera = camera(75, 53);
    let model = [gaussian(camera.backproject(30.0, 20.0, 2.0), 3.0, 9.0)].into_iter().collect();
    let pixels = check(&model, &camera);
    assert!(pixels.iter().all(|p| p.alpha > 0.8));
    assert!(pixels.iter().any(|p| p.alpha > 0.998), "opacity near 1 is clamped at 0.999, not lost");
}

#[test]
fn means_on_edges_of_tiles_blocks_and_pixels() {
    let camera = camera(64, 48);
    for sigma_px in [0.05, 0.4, 3.0] {
        let model: Gaussians = [(16.0, 16.0), (32.5, 15.5), (16.5, 32.0), (48.0, 20.5), (0.0, 0.0), (64.0, 48.0)]
            .into_iter()
            .map(|(u, v)| gaussian(camera.backproject(u, v, 2.0), sigma_px * 2.0 / camera.fx, 3.0))
            .collect();
        check(&model, &camera);
    }
}

#[test]
fn image_sizes_that_are_no_multiple_of_a_tile() {
    for (width, height) in [(1, 1), (3, 50), (17, 16), (16, 33), (31, 5)] {
        check(&scene(60, 2), &camera(width, height));
    }
}

#[test]
fn behind_the_camera_and_nearer_than_the_near_plane_is_not_drawn() {
    let camera = Camera::from_hfov(Pose::IDENTITY, 1.0, 40, 30);
    let model: Gaussians =
        [-2.0, -0.01, 0.0, 0.01, 0.049].map(|z| gaussian(Vec3::new(0.0, 0.0, z), 0.1, 5.0)).into_iter().collect();
    assert!(check(&model, &camera).iter().all(|p| p.alpha == 0.0));
}

#[test]
fn a_splat_beside_the_image_still_reaches_in() {
    let camera = Camera::from_hfov(Pose::IDENTITY, 1.0, 40, 30);
    let model = [gaussian(camera.backproject(-12.0, 15.0, 2.0), 0.5, 3.0)].into_iter().collect();
    assert!(check(&model, &camera).iter().any(|p| p.alpha > 0.05));
}

#[test]
fn broken_gaussians_are_left_out_and_break_nothing() {
    let healthy = scene(200, 7);
    let camera = camera(64, 48);
    let mut model = healthy.clone();
    let good = scene(1, 8).get(0);
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 3e38, -3e38] {
        model.push(&Gaussian { mean: Vec3::new(bad, 0.0, 0.0), ..good });
        model.push(&Gaussian { rotation: Quat::from_xyzw(bad, 0.0, 0.0, 1.0), ..good });
        model.push(&Gaussian { sh: [0.0, bad, 0.0], ..good });
        model.push(&Gaussian { log_scales: Vec3::new(bad, -2.0, -2.0), ..good });
        model.push(&Gaussian { opacity_logit: bad, ..good });
    }
    model.push(&Gaussian { rotation: Quat::from_xyzw(0.0, 0.0, 0.0, 0.0), ..good });
    model.push(&Gaussian { log_scales: Vec3::splat(80.0), ..good });
    let view = random_view(camera, 3);
    for isa in isas() {
        let mut engine = Engine::with_isa(2, isa).unwrap();
        let (mut with, mut without) = (Rendered::default(), Rendered::default());
        engine.render(&model, &camera, &RenderSettings::default(), &mut with);
        engine.render(&healthy, &camera, &RenderSettings::default(), &mut without);
        assert!(with == without, "{isa:?}");

        let mut trained = model.clone();
        let mut optimiser = Optimiser::new();
        for _ in 0..3 {
            let terms = engine.train_step(&mut trained, &mut optimiser, &view, &TrainingSettings::default());
            assert!(terms.total.is_finite());
        }
        assert!(trained.iter().take(healthy.len()).all(|g| g.is_finite()));
        for i in healthy.len()..model.len() {
            assert_eq!(format!("{:?}", trained.get(i)), format!("{:?}", model.get(i)), "{isa:?}");
            assert_eq!(optimiser.steps(i), 0);
        }
    }
}

#[test]
fn a_camera_that_cannot_project_sees_nothing() {
    let broken = Camera { fx: f32::NAN, ..camera(20, 10) };
    let mut rendered = Rendered::default();
    Engine::new(1).unwrap().render(&scene(20, 1), &broken, &RenderSettings::default(), &mut rendered);
    assert!(rendered.alpha.iter().all(|&a| a == 0.0));
}
