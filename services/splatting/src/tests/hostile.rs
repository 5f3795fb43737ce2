//! Models that no training would make: nothing panics, and nothing that is finite becomes infinite or NaN.

use std::sync::atomic::AtomicBool;

use glam::{Quat, Vec3};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

use super::{camera, isas, random_view};
use crate::{
    Camera, Engine, Gaussian, Gaussians, Isa, Moments, MomentsView, Optimiser, RenderSettings, Rendered, SH_REST_MAX,
    TrainingSettings,
};

/// Mostly a number of the given size, sometimes one that breaks things.
fn number(size: f32) -> impl Strategy<Value = f32> {
    let bad = [
        f32::NAN,
        f32::INFINITY,
        f32::NEG_INFINITY,
        f32::MAX,
        f32::MIN,
        f32::MIN_POSITIVE,
        1e-45,
        0.0,
        -0.0,
        1e4,
        -1e4,
        9e8,
        -9e8,
        1e19,
        -1e19,
    ];
    prop_oneof![29 => -size..size, 1 => prop::sample::select(bad.to_vec())]
}

fn vector(size: f32) -> impl Strategy<Value = Vec3> {
    [number(size), number(size), number(size)].prop_map(Vec3::from_array)
}

fn gaussian() -> impl Strategy<Value = (Gaussian, Vec<[f32; 3]>)> {
    let rotation = [number(1.0), number(1.0), number(1.0), number(1.0)];
    let sh = vector(2.0).prop_map(|v| v.to_array());
    let rest = prop::collection::vec([number(1.0), number(1.0), number(1.0)], SH_REST_MAX);
    (vector(0.8), vector(6.0), rotation, number(8.0), sh, rest).prop_map(
        |(mean, log_scales, q, opacity_logit, sh, rest)| {
            let rotation = Quat::from_array(q);
            (Gaussian { mean, log_scales, rotation, opacity_logit, sh, id: 0, birth_round: 0 }, rest)
        },
    )
}

fn model() -> impl Strategy<Value = Gaussians> {
    (0..=3_u8, prop::collection::vec(gaussian(), 0..50)).prop_map(|(degree, gaussians)| {
        let mut model = Gaussians::with_sh_degree(degree);
        for (i, (gaussian, rest)) in gaussians.iter().enumerate() {
            model.push(gaussian);
            model.set_sh_rest(i, &std::array::from_fn(|k| rest[k]));
        }
        model
    })
}

/// Outside of the model or inside, on images of any small size.
fn any_camera() -> impl Strategy<Value = Camera> {
    let eye = prop_oneof![[-0.5..0.5_f32, -0.5..0.5, -0.5..0.5], [-3.0..3.0_f32, -3.0..3.0, -3.0..3.0]];
    (eye, 1..45_u32, 1..45_u32).prop_map(|(eye, width, height)| {
        camera(width, height).look_at(Vec3::from_array(eye), Vec3::new(0.05, 0.02, -0.03), Vec3::Z)
    })
}

fn settings() -> impl Strategy<Value = TrainingSettings> {
    let limits = prop::option::of(Just((0.01, 0.5)));
    let low_pass = prop::sample::select(vec![0.0, 0.1, 0.3]);
    let regularisers = (0.0..5.0_f32, prop::sample::select(vec![0.0, 0.01, 1.0]));
    (any::<bool>(), low_pass, 0..=3_u8, regularisers, limits, any::<bool>()).prop_map(
        |(opacity_compensation, low_pass_px2, sh_degree, (isotropic_weight, of_all), sigma_limits_m, fast)| {
            let render = RenderSettings { opacity_compensation, low_pass_px2, sh_degree, ..RenderSettings::default() };
            let rate = if fast { 10.0 } else { 1.0 };
            let usual = TrainingSettings::default();
            TrainingSettings {
                render,
                isotropic_weight,
                opacity_weight: of_all,
                scale_weight: of_all,
                sigma_limits_m,
                lr_means: 1e-2 * rate,
                lr_opacity: usual.lr_opacity * rate,
                lr_sh_rest: usual.lr_sh * rate,
                ..usual
            }
        },
    )
}

/// Every parameter of a model.
fn numbers(model: &Gaussians) -> Vec<f32> {
    model.blocks().iter().flat_map(|block| block.0.iter()).chain(model.rest()).flat_map(|lanes| lanes.0).collect()
}

fn moments_are_finite(optimiser: &Optimiser) -> bool {
    let blocks = optimiser.first.iter().chain(&optimiser.second).flat_map(|block| block.0.iter());
    let rest = optimiser.first_rest.iter().chain(&optimiser.second_rest);
    blocks.chain(rest).flat_map(|lanes| lanes.0).all(f32::is_finite)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, rng_seed: RngSeed::Fixed(11), ..ProptestConfig::default() })]

    #[test]
    fn training_makes_nothing_infinite_that_was_finite(
        model in model(), camera in any_camera(), settings in settings(), seed in 0..1000_u64,
    ) {
        let view = random_view(camera, seed);
        for isa in isas() {
            let mut engine = Engine::with_isa(1, isa).unwrap();
            let (mut trained, mut optimiser) = (model.clone(), Optimiser::new());
            for step in 0..4 {
                let terms = engine.train_step(&mut trained, &mut optimiser, &view, &settings);
                prop_assert!(!terms.total.is_nan(), "{:?}, step {}: {:?}", isa, step, terms);
                for (before, after) in numbers(&model).into_iter().zip(numbers(&trained)) {
                    // What was broken is left as it was, to the bit.
                    let same = before.to_bits() == after.to_bits();
                    prop_assert!(after.is_finite() || same, "{:?}, step {}: {} became {}", isa, step, before, after);
                }
                prop_assert!(moments_are_finite(&optimiser));
            }
            let (terms, gradient) = engine.gradient(&trained, &view, &settings);
            prop_assert!(!terms.total.is_nan());
            prop_assert!(gradient.parameters.iter().flatten().all(|g| g.is_finite()));
            prop_assert!(gradient.sh_rest.iter().flatten().flatten().all(|g| g.is_finite()));
        }
    }

    #[test]
    fn images_of_anything_are_finite(model in model(), camera in any_camera(), settings in settings()) {
        for isa in isas() {
            let mut engine = Engine::with_isa(1, isa).unwrap();
            let (mut rendered, mut moments) = (Rendered::default(), Moments::default());
            engine.render(&model, &camera, &settings.render, &mut rendered);
            prop_assert_eq!(rendered.color.len(), camera.pixels());
            prop_assert!(rendered.color.iter().flatten().chain(&rendered.alpha).chain(&rendered.depth).all(|v| v.is_finite()));
            prop_assert!(rendered.alpha.iter().all(|a| (-1e-6..=1.0).contains(a)));
            engine.moments(&model, &camera, &settings.render, 2.0, &mut moments);
            prop_assert!(moments.alpha.iter().chain(&moments.first).chain(&moments.second).all(|v| v.is_finite()));
            let views = [MomentsView { camera, reference_m: 2.0 }];
            let never = AtomicBool::new(false);
            let visit = |_, batched: &Moments| assert!(*batched == moments, "{isa:?}: a batch differs from its view");
            engine.moments_batch(&model, &views, &settings.render, &never, visit).unwrap();
        }
    }

    #[test]
    fn cameras_of_anything_break_nothing(
        numbers in prop::collection::vec(number(60.0), 11), width in 0..40_u32, height in 0..40_u32, seed in 0..1000_u64,
    ) {
        let model = super::scene(60, seed);
        let mut camera = camera(width, height);
        camera.world_from_camera.rotation = Quat::from_slice(&numbers[..4]);
        camera.world_from_camera.translation = Vec3::from_slice(&numbers[4..]);
        (camera.fx, camera.fy, camera.cx, camera.cy) = (numbers[7], numbers[8], numbers[9], numbers[10]);
        let settings = RenderSettings::default();
        let mut engine = Engine::with_isa(1, Isa::detect()).unwrap();
        let mut rendered = Rendered::default();
        engine.render(&model, &camera, &settings, &mut rendered);
        prop_assert_eq!(rendered.alpha.len(), camera.pixels());
        prop_assert!(rendered.color.iter().flatten().chain(&rendered.alpha).chain(&rendered.depth).all(|v| v.is_finite()));
        let views = [MomentsView { camera, reference_m: numbers[0] }];
        let never = AtomicBool::new(false);
        engine.moments_batch(&model, &views, &settings, &never, |_, _| {}).unwrap();
    }
}
