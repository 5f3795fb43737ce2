//! Images and moments against the reference.

use std::sync::atomic::AtomicBool;

use glam::Vec3;

use super::{camera, isas, scene};
use crate::reference::{self, Pixel};
use crate::{Engine, EngineError, Gaussian, Moments, MomentsView, RenderSettings, Rendered};

fn settings() -> RenderSettings {
    RenderSettings { background: Vec3::new(0.1, 0.5, 0.9), ..RenderSettings::default() }
}

fn worst(rendered: &Rendered, expected: &[Pixel], background: Vec3) -> f64 {
    let mut worst = 0.0_f64;
    let mut compared = 0;
    for (i, pixel) in expected.iter().enumerate().filter(|(_, p)| !p.at_cut) {
        compared += 1;
        let color = pixel.color + (1.0 - pixel.alpha) * background.as_dvec3();
        for k in 0..3 {
            worst = worst.max((f64::from(rendered.color[i][k]) - color[k]).abs());
        }
        worst = worst.max((f64::from(rendered.alpha[i]) - pixel.alpha).abs());
        if pixel.alpha > 0.1 {
            worst = worst.max((f64::from(rendered.depth[i]) - pixel.depth / pixel.alpha).abs());
        }
    }
    assert!(compared * 10 > expected.len() * 9, "only {compared} of {} pixels are away from cuts", expected.len());
    worst
}

#[test]
fn images_agree_with_the_reference_on_every_instruction_set() {
    for (count, width, height) in [(300, 93, 71), (2000, 128, 96)] {
        let (model, camera) = (scene(count, 3), camera(width, height));
        let settings = settings();
        let expected = reference::render(&reference::parameters(&model), &camera, &settings, 0.0);
        for isa in isas() {
            let mut rendered = Rendered::default();
            Engine::with_isa(1, isa).unwrap().render(&model, &camera, &settings, &mut rendered);
            let worst = worst(&rendered, &expected, settings.background);
            assert!(worst < 3e-4, "{isa:?} with {count} Gaussians: {worst}");
        }
    }
}

#[test]
fn without_compensation_and_with_another_low_pass_images_agree_too() {
    let (model, camera) = (scene(200, 9), camera(64, 48));
    let settings = RenderSettings { opacity_compensation: false, low_pass_px2: 0.3, ..settings() };
    let expected = reference::render(&reference::parameters(&model), &camera, &settings, 0.0);
    let mut rendered = Rendered::default();
    Engine::new(1).unwrap().render(&model, &camera, &settings, &mut rendered);
    assert!(worst(&rendered, &expected, settings.background) < 3e-4);
}

#[test]
fn instruction_sets_agree_with_each_other() {
    let (model, camera) = (scene(1500, 5), camera(160, 120));
    let images: Vec<Rendered> = isas()
        .into_iter()
        .map(|isa| {
            let mut rendered = Rendered::default();
            Engine::with_isa(1, isa).unwrap().render(&model, &camera, &settings(), &mut rendered);
            rendered
        })
        .collect();
    for image in &images[1..] {
        let mut differences: Vec<f32> = image
            .color
            .iter()
            .zip(&images[0].color)
            .map(|(a, b)| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max))
            .collect();
        differences.sort_by(f32::total_cmp);
        // A pixel whose alpha lies on the cut may differ by 1/255.
        assert!(differences[differences.len() * 999 / 1000] < 2e-5, "{:?}", differences.last());
        assert!(*differences.last().unwrap() < 5e-3);
    }
}

#[test]
fn half_a_pixel_is_noticed() {
    let (model, camera) = (scene(300, 3), camera(93, 71));
    let settings = settings();
    let expected = reference::render(&reference::parameters(&model), &camera, &settings, 0.0);
    let shifted = crate::Camera { cx: camera.cx + 0.5, ..camera };
    let mut rendered = Rendered::default();
    Engine::new(1).unwrap().render(&model, &shifted, &settings, &mut rendered);
    assert!(worst(&rendered, &expected, settings.background) > 0.02);
}

#[test]
fn a_small_splat_lights_the_pixel_whose_centre_it_covers() {
    // A splat at the ray of pixel (20, 11)'s centre is brightest there and equal on its neighbours.
    let camera = camera(64, 48);
    let mean = camera.backproject(20.5, 11.5, 2.0);
    let sigma_m = 2.0 / camera.fx;
    let model = [Gaussian {
        mean,
        log_scales: Vec3::splat(sigma_m.ln()),
        rotation: glam::Quat::IDENTITY,
        opacity_logit: 2.0,
        sh: [0.0; 3],
        id: 0,
        birth_round: 0,
    }]
    .into_iter()
    .collect();
    let mut rendered = Rendered::default();
    Engine::new(1).unwrap().render(&model, &camera, &RenderSettings::default(), &mut rendered);
    let alpha = |x: usize, y: usize| rendered.alpha[y * 64 + x];
    let brightest = (0..alpha_len(&rendered)).max_by(|&a, &b| rendered.alpha[a].total_cmp(&rendered.alpha[b]));
    assert_eq!(brightest, Some(11 * 64 + 20));
    assert!((alpha(19, 11) - alpha(21, 11)).abs() < 1e-3 && (alpha(20, 10) - alpha(20, 12)).abs() < 1e-3);
    assert!((rendered.depth[11 * 64 + 20] - 2.0).abs() < 1e-5);
}

fn alpha_len(rendered: &Rendered) -> usize {
    rendered.alpha.len()
}

#[test]
fn moments_agree_with_the_reference_and_batches_with_single_views() {
    let model = scene(500, 8);
    let settings = settings();
    let views: Vec<MomentsView> =
        [(70, 50), (33, 40), (96, 64)].map(|(w, h)| MomentsView { camera: camera(w, h), reference_m: 2.1 }).to_vec();
    for isa in isas() {
        let mut engine = Engine::with_isa(2, isa).unwrap();
        let batch = std::sync::Mutex::new(vec![Moments::default(); 3]);
        let cancel = AtomicBool::new(false);
        let visit = |i: usize, m: &Moments| batch.lock().unwrap()[i] = m.clone();
        engine.moments_batch(&model, &views, &settings, &cancel, visit).unwrap();
        for (view, moments) in views.iter().zip(batch.into_inner().unwrap()) {
            let mut single = Moments::default();
            engine.moments(&model, &view.camera, &settings, view.reference_m, &mut single);
            assert!(single == moments);
            let parameters = reference::parameters(&model);
            let expected = reference::render(&parameters, &view.camera, &settings, f64::from(view.reference_m));
            for (i, pixel) in expected.iter().enumerate().filter(|(_, p)| !p.at_cut) {
                let pairs = [
                    (moments.alpha[i], pixel.alpha),
                    (moments.first[i], pixel.first),
                    (moments.second[i], pixel.second),
                ];
                for (got, want) in pairs {
                    assert!((f64::from(got) - want).abs() < 3e-4, "{isa:?}: {got} instead of {want}");
                }
            }
        }
    }
}

#[test]
fn a_cancelled_batch_says_so() {
    let model = scene(50, 8);
    let views = vec![MomentsView { camera: camera(32, 32), reference_m: 2.0 }; 5];
    let cancel = AtomicBool::new(true);
    let result = Engine::new(2).unwrap().moments_batch(&model, &views, &settings(), &cancel, |_, _| {});
    assert!(matches!(result, Err(EngineError::Cancelled)));
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let (model, camera) = (scene(20_000, 5), camera(200, 150));
    let render = |threads: usize| {
        let mut rendered = Rendered::default();
        Engine::new(threads).unwrap().render(&model, &camera, &settings(), &mut rendered);
        rendered
    };
    let one = render(1);
    assert!(one == render(2));
    assert!(one == render(3));
}
