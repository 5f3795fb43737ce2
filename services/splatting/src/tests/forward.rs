//! Images and moments against the reference.

use std::sync::atomic::AtomicBool;

use glam::Vec3;

use super::harmonics::scene_of_degree;
use super::{camera, isas, scene};
use crate::reference::{self, Pixel};
use crate::{
    Camera, DEPTH_ALPHA_TINY, Engine, EngineError, Gaussian, Gaussians, Isa, Moments, MomentsView, RenderSettings,
    Rendered,
};

fn settings() -> RenderSettings {
    RenderSettings { background: Vec3::new(0.1, 0.5, 0.9), ..RenderSettings::default() }
}

fn render(isa: Isa, model: &Gaussians, camera: &Camera, settings: &RenderSettings) -> Rendered {
    let mut rendered = Rendered::default();
    Engine::with_isa(1, isa).unwrap().render(model, camera, settings, &mut rendered);
    rendered
}

/// Colour, alpha and expected depth of a pixel.
type Values = [f64; 5];

fn rendered_values(rendered: &Rendered, i: usize) -> Values {
    let ([r, g, b], alpha) = (rendered.color[i].map(f64::from), rendered.alpha[i]);
    [r, g, b, alpha.into(), rendered.depth[i].into()]
}

fn reference_values(pixel: &Pixel, background: Vec3) -> Values {
    let color = pixel.color + (1.0 - pixel.alpha) * background.as_dvec3();
    let seen = pixel.alpha >= f64::from(DEPTH_ALPHA_TINY);
    [color.x, color.y, color.z, pixel.alpha, if seen { pixel.depth / pixel.alpha } else { 0.0 }]
}

/// Largest difference; that of depths in metres times alpha, because the depth of next to nothing says nothing.
fn difference(a: Values, b: Values) -> f64 {
    let weights = [1.0, 1.0, 1.0, 1.0, a[3].min(b[3])];
    (0..5).map(|k| weights[k] * (a[k] - b[k]).abs()).fold(0.0, f64::max)
}

/// Difference of every pixel to the reference.
pub(crate) fn errors(rendered: &Rendered, expected: &[Pixel], background: Vec3) -> Vec<f64> {
    let error = |(i, pixel)| difference(rendered_values(rendered, i), reference_values(pixel, background));
    expected.iter().enumerate().map(error).collect()
}

/// The bar of an image: errors within the tolerance, but for at most 0.1 % of the pixels, which must lie at a cut by the
/// reference, and there within 1/255.
pub(crate) fn assert_within(errors: &[f64], expected: &[Pixel], tolerance: f64, context: &str) {
    let beyond: Vec<usize> = (0..errors.len()).filter(|&i| errors[i] > tolerance).collect();
    for &i in &beyond {
        assert!(expected[i].at_cut, "{context}: error {} at pixel {i}, which is not at a cut", errors[i]);
        assert!(errors[i] < 1.0 / 255.0 + tolerance, "{context}: error {} at a cut", errors[i]);
    }
    assert!(1000 * beyond.len() <= errors.len(), "{context}: {} of {} pixels", beyond.len(), errors.len());
    let worst = errors.iter().zip(expected).filter(|(_, p)| !p.at_cut).map(|(e, _)| *e).fold(0.0, f64::max);
    println!("{context}: worst {worst:.1e}, beyond {}", beyond.len());
}

/// Scenes of every degree on images of odd sizes, and settings with and without opacity compensation.
fn cases() -> Vec<(Gaussians, Camera, RenderSettings)> {
    let mut cases = Vec::new();
    for (degree, count, (width, height)) in
        [(0, 300, (93, 71)), (1, 2000, (128, 96)), (2, 700, (75, 101)), (3, 1500, (159, 119))]
    {
        let model = scene_of_degree(count, 3 + u64::from(degree), degree);
        let plain = RenderSettings { opacity_compensation: false, low_pass_px2: 0.3, ..settings() };
        cases.push((model.clone(), camera(width, height), settings()));
        cases.push((model, camera(width, height), plain));
    }
    cases
}

#[test]
fn images_agree_with_the_reference_and_with_each_other_on_every_instruction_set() {
    for (model, camera, settings) in cases() {
        let expected = reference::render(&reference::parameters(&model), &camera, &settings, 0.0);
        let images: Vec<Rendered> = isas().into_iter().map(|isa| render(isa, &model, &camera, &settings)).collect();
        for (isa, image) in isas().into_iter().zip(&images) {
            let context = format!("{isa:?}, degree {}, {} Gaussians", model.sh_degree(), model.len());
            assert_within(&errors(image, &expected, settings.background), &expected, 1e-4, &context);
            let apart = |i| difference(rendered_values(image, i), rendered_values(&images[0], i));
            let apart: Vec<f64> = (0..expected.len()).map(apart).collect();
            assert_within(&apart, &expected, 1e-5, &format!("{context}, to {:?}", isas()[0]));
        }
    }
}

#[test]
fn half_a_pixel_is_noticed() {
    let (model, camera) = (scene(300, 3), camera(93, 71));
    let settings = settings();
    let expected = reference::render(&reference::parameters(&model), &camera, &settings, 0.0);
    let shifted = Camera { cx: camera.cx + 0.5, ..camera };
    let errors = errors(&render(Isa::detect(), &model, &shifted, &settings), &expected, settings.background);
    assert!(errors.iter().filter(|&&error| error > 0.02).count() > 100);
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
            let error = |(i, pixel): (usize, &Pixel)| {
                let got = [moments.alpha[i], moments.first[i], moments.second[i]].map(f64::from);
                let want = [pixel.alpha, pixel.first, pixel.second];
                got.iter().zip(want).map(|(got, want)| (got - want).abs()).fold(0.0, f64::max)
            };
            let errors: Vec<f64> = expected.iter().enumerate().map(error).collect();
            assert_within(&errors, &expected, 1e-4, &format!("{isa:?}, moments"));
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
