//! What holds for all formats, and the models that their tests write.

use glam::Vec3;

use super::*;
use crate::tests::{Random, scene};

/// A model with random coefficients in all bands of its degree.
pub fn model(count: usize, degree: u8, seed: u64) -> Gaussians {
    let mut model = scene(count, seed);
    model.set_sh_degree(degree);
    let mut random = Random(!seed);
    for index in 0..count {
        let bands = std::array::from_fn(|_| std::array::from_fn(|_| random.uniform(-0.9, 0.9)));
        model.set_sh_rest(index, &bands);
    }
    model
}

/// A model of degree 0.
pub fn bare(count: usize) -> Gaussians {
    model(count, 0, 1)
}

/// The bytes of a model.
pub fn bytes(format: Format, model: &Gaussians) -> Vec<u8> {
    let mut bytes = Vec::new();
    write(format, model, true, &mut bytes).unwrap();
    bytes
}

/// Angle between two rotations, radians.
pub fn angle_between(a: glam::Quat, b: glam::Quat) -> f64 {
    let dot = a.as_dquat().normalize().dot(b.as_dquat().normalize()).abs();
    2.0 * dot.min(1.0).acos()
}

#[test]
fn every_format_brings_a_model_back_nearly_as_it_was() {
    let model = model(50, 3, 9);
    for format in Format::ALL {
        let back = read(format, &bytes(format, &model)).unwrap();
        assert_eq!(back.len(), 50, "{format:?}");
        assert_eq!(back.sh_degree(), if format == Format::Splat { 0 } else { 3 }, "{format:?}");
        for g in back.iter() {
            let original = model.iter().min_by(|a, b| {
                let distance = |x: &Gaussian| (x.mean - g.mean).length();
                distance(a).total_cmp(&distance(b))
            });
            let original = original.unwrap();
            assert!((g.mean - original.mean).length() < 3e-4, "{format:?}");
            assert!((g.log_scales - original.log_scales).abs().max_element() < 0.04, "{format:?}");
            assert!(angle_between(g.rotation, original.rotation) < 0.03, "{format:?}");
            assert!((g.opacity() - original.opacity()).abs() < 0.003, "{format:?}");
            let colours = g.color().into_iter().zip(original.color());
            assert!(
                colours.into_iter().all(|(a, b)| (a.clamp(0.0, 1.0) - b.clamp(0.0, 1.0)).abs() < 0.005),
                "{format:?}"
            );
        }
    }
}

#[test]
fn a_broken_model_is_written_in_no_format_and_the_parameter_named() {
    let good = model(20, 1, 2);
    type Breaks = fn(&mut Gaussian);
    let cases: [(&str, Breaks); 6] = [
        ("mean[1] NaN", |g| g.mean.y = f32::NAN),
        ("log_scales[2] inf", |g| g.log_scales.z = f32::INFINITY),
        ("rotation[3] -inf", |g| g.rotation.w = f32::NEG_INFINITY),
        ("rotation 0", |g| g.rotation = glam::Quat::from_xyzw(0.0, 0.0, 0.0, 0.0)),
        ("opacity_logit[0] NaN", |g| g.opacity_logit = f32::NAN),
        ("sh[2] inf", |g| g.sh[2] = f32::INFINITY),
    ];
    for format in Format::ALL {
        for (expected, breaks) in cases {
            let mut model = good.clone();
            let mut g = model.get(17);
            breaks(&mut g);
            model.set(17, &g);
            let message = write(format, &model, true, &mut Vec::new()).unwrap_err().to_string();
            assert!(message.contains("Gaussian 17") && message.contains(expected), "{message}");
        }
        let mut model = good.clone();
        let mut bands = model.sh_rest(3);
        bands[1][2] = f32::NAN;
        model.set_sh_rest(3, &bands);
        let message = write(format, &model, true, &mut Vec::new()).unwrap_err().to_string();
        assert!(message.contains("Gaussian 3") && message.contains("sh_rest[5] NaN"), "{message}");
    }
}

#[test]
fn the_largest_parameters_stay_finite() {
    const MAX: f32 = f32::MAX;
    let mut model = model(2, 3, 1);
    let large = glam::Quat::from_xyzw(MAX, -MAX, MAX, MAX);
    let tiny = Vec3::splat(-MAX);
    model.set(0, &Gaussian { rotation: large, opacity_logit: MAX, sh: [MAX; 3], log_scales: tiny, ..model.get(0) });
    model.set(1, &Gaussian { rotation: -large, opacity_logit: -MAX, sh: [-MAX; 3], ..model.get(1) });
    model.set_sh_rest(0, &[[MAX, -MAX, MAX]; SH_REST_MAX]);
    for format in Format::ALL {
        let back = read(format, &bytes(format, &model)).unwrap();
        assert!(back.is_finite(), "{format:?}");
        for (i, g) in model.iter().enumerate() {
            let found = back.iter().find(|b| (b.mean - g.mean).length() < 1e-3).unwrap();
            assert!(angle_between(found.rotation, g.rotation) < 0.03, "{format:?}, {i}");
        }
    }
    frames::Turn::world_to_y_up().apply(&mut model);
    assert!(model.is_finite());
}

#[test]
fn scales_beyond_f32_are_refused_where_the_format_has_no_logarithms() {
    let mut model = bare(3);
    model.set(1, &Gaussian { log_scales: Vec3::new(0.0, 90.0, 0.0), ..model.get(1) });
    for format in [Format::Splat, Format::Glb] {
        let message = write(format, &model, true, &mut Vec::new()).unwrap_err().to_string();
        assert!(message.contains("Gaussian 1") && message.contains("log scale 90"), "{message}");
    }
}

#[test]
fn a_name_ends_with_its_format() {
    for format in Format::ALL {
        let name = format!("some.dir/Model.{}", format.extension().to_uppercase());
        assert_eq!(Format::of_path(Path::new(&name)), Some(format));
    }
    assert_eq!(Format::of_path(Path::new("ply")), None);
    assert_eq!(Format::of_path(Path::new("model.obj")), None);
}

#[test]
fn logits_and_opacities_are_inverse_and_bytes_come_back() {
    for i in -150..=150 {
        let value = 0.1 * i as f32;
        assert!((logit(opacity(value)) - value).abs() < 1e-5, "{value}");
    }
    assert_eq!((logit(0.0), logit(1.0)), (-16.0, 16.0));
    for byte in 0..=255 {
        assert_eq!(to_byte(255.0 * opacity(logit_of_byte(byte))), byte);
    }
}
