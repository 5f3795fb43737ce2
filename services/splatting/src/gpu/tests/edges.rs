//! What breaks GPU renderers.

use glam::{Quat, Vec3};
use naga_validation::validate;

use super::super::kernels::SOURCES;
use super::super::{GpuError, Options};
use super::{options, skipped, with_engine};
use crate::tests::forward::{assert_within, errors};
use crate::tests::{camera, random_view};
use crate::{
    Camera, Gaussian, Gaussians, Pose, RenderSettings, Rendered, ScreenStatistics, TrainingSettings, reference,
};

mod naga_validation {
    /// Parses and validates a kernel without any adapter.
    pub fn validate(wgsl: &str) -> Result<(), String> {
        use wgpu::naga::front::wgsl::parse_str;
        use wgpu::naga::valid::{Capabilities, ValidationFlags, Validator};
        let module = parse_str(wgsl).map_err(|error| error.emit_to_string(wgsl))?;
        let mut validator = Validator::new(ValidationFlags::all(), Capabilities::all());
        validator.validate(&module).map(|_| ()).map_err(|error| error.emit_to_string(wgsl))
    }
}

#[test]
fn every_kernel_passes_validation_without_a_gpu() {
    for source in SOURCES {
        if let Err(error) = validate(&source.wgsl()) {
            panic!("{}: {error}", source.name);
        }
    }
    // Of the benchmark, without the prelude of the others.
    validate(include_str!("../shaders/peak.wgsl")).unwrap();
}

fn gaussian(mean: Vec3, sigma: f32, logit: f32) -> Gaussian {
    Gaussian {
        mean,
        log_scales: Vec3::splat(sigma.ln()),
        rotation: Quat::IDENTITY,
        opacity_logit: logit,
        sh: [0.7, -0.3, 0.2],
        id: 0,
        birth_round: 0,
    }
}

/// Looks along +z from the origin: a mean at (x, y, 1) is at pixel (fx x + cx, fy y + cy).
fn straight(width: u32, height: u32) -> Camera {
    let (fx, cx, cy) = (32.0, 0.5 * width as f32, 0.5 * height as f32);
    Camera { world_from_camera: Pose::IDENTITY, fx, fy: fx, cx, cy, width, height }
}

fn check(test: &'static str, model: &Gaussians, camera: &Camera) {
    with_engine(test, |engine| {
        let settings = RenderSettings::default();
        let mut rendered = Rendered::default();
        engine.render(model, camera, &settings, &mut rendered).unwrap();
        let expected = reference::render(&reference::parameters(model), camera, &settings, 0.0);
        assert_within(&errors(&rendered, &expected, settings.background), &expected, 1e-3, test);
    });
}

#[test]
fn a_mean_exactly_on_the_edge_of_a_tile_is_in_both_tiles() {
    // Pixel coordinate 16 exactly, and the centre of the first pixel of the second tile.
    let at = |x: f32| gaussian(Vec3::new((x - 24.0) / 32.0, (16.0 - 24.0) / 32.0, 1.0), 0.02, 2.0);
    let model: Gaussians = [at(16.0), at(16.5), at(15.5)].into_iter().collect();
    check("a_mean_exactly_on_the_edge_of_a_tile_is_in_both_tiles", &model, &straight(48, 48));
}

#[test]
fn opacity_at_one_and_a_gaussian_that_fills_the_screen() {
    let model: Gaussians =
        [gaussian(Vec3::new(0.0, 0.0, 3.0), 50.0, 40.0), gaussian(Vec3::new(0.1, 0.0, 1.0), 0.05, 90.0)]
            .into_iter()
            .collect();
    check("opacity_at_one_and_a_gaussian_that_fills_the_screen", &model, &straight(40, 24));
}

#[test]
fn nothing_visible_is_the_background() {
    let behind: Gaussians = (0..40).map(|i| gaussian(Vec3::new(0.0, 0.0, -1.0 - i as f32), 0.1, 1.0)).collect();
    check("nothing_visible_is_the_background", &behind, &straight(33, 17));
    check("nothing_visible_is_the_background", &Gaussians::new(), &straight(33, 17));
}

#[test]
fn broken_gaussians_are_left_out_and_left_alone() {
    with_engine("broken_gaussians_are_left_out_and_left_alone", |engine| {
        let good = gaussian(Vec3::new(0.02, 0.01, 1.0), 0.05, 1.0);
        let whole: Gaussians = (0..3).map(|i| Gaussian { id: i, ..good }).collect();
        let mut broken = whole.clone();
        for bad in [
            Gaussian { mean: Vec3::new(f32::NAN, 0.0, 1.0), ..good },
            Gaussian { mean: Vec3::splat(f32::INFINITY), ..good },
            Gaussian { log_scales: Vec3::splat(f32::NAN), ..good },
            Gaussian { log_scales: Vec3::splat(1e30), ..good },
            Gaussian { rotation: Quat::from_xyzw(0.0, 0.0, 0.0, 0.0), ..good },
            Gaussian { rotation: Quat::from_xyzw(1e38, 0.0, 0.0, 0.0), ..good },
            Gaussian { opacity_logit: f32::NAN, ..good },
            Gaussian { sh: [f32::NAN, 0.0, 1e38], ..good },
        ] {
            broken.push(&bad);
        }
        let camera = straight(32, 32);
        let [mut a, mut b] = [Rendered::default(), Rendered::default()];
        engine.render(&whole, &camera, &RenderSettings::default(), &mut a).unwrap();
        engine.render(&broken, &camera, &RenderSettings::default(), &mut b).unwrap();
        assert!(a == b);
        let mut optimiser = crate::Optimiser::new();
        let before: Vec<_> = broken.iter().collect();
        engine.upload(&broken, &mut optimiser, &mut ScreenStatistics::new()).unwrap();
        engine.step(&random_view(camera, 1), &TrainingSettings::default()).unwrap();
        engine.download(&mut broken, &mut optimiser, &mut ScreenStatistics::new()).unwrap();
        assert!(engine.finished().unwrap()[0].total.is_finite());
        for i in 0..broken.len() {
            if i < 3 {
                assert!(broken.get(i).is_finite() && broken.get(i).mean != before[i].mean);
            } else {
                assert_eq!(format!("{:?}", broken.get(i)), format!("{:?}", before[i]));
            }
        }
    });
}

/// In tests a dimension has five workgroups (`job::fold`), so that every kernel with a thread for each Gaussian folds its grid
/// from 1,280 on, as it does from 16.8 million on outside of them.
#[test]
fn more_workgroups_than_a_dimension_has() {
    with_engine("more_workgroups_than_a_dimension_has", |engine| {
        let at = |i: u64| {
            let (x, y) = ((i % 64) as f32 + 0.5, (i / 64) as f32 + 0.5);
            Gaussian { id: i, ..gaussian(Vec3::new((x - 32.0) / 32.0, (y - 24.0) / 32.0, 1.0), 0.01, 2.0) }
        };
        // One for each pixel: what is folded wrongly leaves a hole, or does one twice.
        let model: Gaussians = (0..64 * 48).map(at).collect();
        let camera = straight(64, 48);
        let settings = RenderSettings::default();
        let mut rendered = Rendered::default();
        engine.render(&model, &camera, &settings, &mut rendered).unwrap();
        let expected = reference::render(&reference::parameters(&model), &camera, &settings, 0.0);
        assert_within(&errors(&rendered, &expected, settings.background), &expected, 1e-3, "folded");
        let (mut moved, mut optimiser) = (model.clone(), crate::Optimiser::new());
        engine.upload(&moved, &mut optimiser, &mut ScreenStatistics::new()).unwrap();
        engine.step(&random_view(camera, 1), &TrainingSettings::default()).unwrap();
        engine.download(&mut moved, &mut optimiser, &mut ScreenStatistics::new()).unwrap();
        assert!(engine.finished().unwrap()[0].total.is_finite());
        let still = (0..model.len()).filter(|&i| moved.get(i).opacity_logit == model.get(i).opacity_logit).count();
        assert_eq!(still, 0, "each has made its step");
    });
}

#[test]
fn an_image_too_large_is_refused_with_its_size() {
    with_engine("an_image_too_large_is_refused_with_its_size", |engine| {
        let error = engine
            .render(&Gaussians::new(), &straight(4097, 8), &RenderSettings::default(), &mut Rendered::default())
            .unwrap_err();
        assert_eq!(error, GpuError::TooManyPixels { width: 4097, height: 8 });
        assert!(error.to_string().contains("4097x8"));
    });
}

#[test]
fn an_unknown_adapter_is_refused_with_those_that_exist() {
    let test = "an_unknown_adapter_is_refused_with_those_that_exist";
    let Some(known) = options().and_then(|options| options.adapter) else { return skipped(test) };
    let wanted = "No Such GPU 9000".to_owned();
    let Err(error) = super::Engine::new(&Options { adapter: Some(wanted), ..Options::default() }) else {
        panic!("an adapter that does not exist was found")
    };
    assert!(error.to_string().contains("No Such GPU 9000") && error.to_string().contains(&known), "{error}");
}

#[test]
fn a_model_larger_than_a_binding_is_refused_with_both_numbers() {
    with_engine("a_model_larger_than_a_binding_is_refused_with_both_numbers", |engine| {
        let limit = engine.max_binding();
        if limit > 1 << 30 {
            println!("a_model_larger_than_a_binding_is_refused_with_both_numbers: skipped, {limit} bytes can be bound");
            return;
        }
        let camera = camera(16, 16);
        let count = limit / 48 + 1;
        let model: Gaussians = (0..count).map(|_| gaussian(Vec3::new(0.0, 0.0, -9.0), 0.1, 0.0)).collect();
        let error = engine.render(&model, &camera, &RenderSettings::default(), &mut Rendered::default()).unwrap_err();
        let GpuError::TooLarge { needed, limit: named, .. } = error else { panic!("{error}") };
        assert!(needed > limit && named == limit);
    });
}
