//! What 3DGS-MCMC does to a model, Gaussian by Gaussian.

use std::collections::HashMap;

use glam::{Mat3, Quat, Vec3};

use super::densify::{EXTENT_M, after_step, by_id, trained};
use super::{isas, scene};
use crate::{
    DefaultSettings, Densifier, DensifyReport, Engine, Gaussian, Gaussians, Isa, McmcSettings, Optimiser, Relocation,
    RenderSettings, Rendered, ScreenStatistics, Strategy, Training, TrainingSettings, metrics,
};

/// The published double sum for the scales, term by term.
fn published_scale_ratio(opacity: f64, new: f64, count: u32) -> f64 {
    let binomial = |n: u32, k: u32| (0..k).fold(1.0, |product, i| product * f64::from(n - i) / f64::from(i + 1));
    let mut sum = 0.0;
    for i in 1..=count {
        for k in 0..i {
            let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
            sum += binomial(i - 1, k) * sign * new.powi(k as i32 + 1) / f64::from(k + 1).sqrt();
        }
    }
    opacity / sum
}

#[test]
fn a_relocation_is_the_published_formula() {
    for opacity in [0.006, 0.1, 0.5, 0.9, 0.999, 1.0 - 1e-6] {
        for count in [1, 2, 3, 10, 50, 51] {
            let got = Relocation::new(opacity, count, 1e-9);
            let together = (1.0 - got.opacity).powi(count as i32);
            assert!((together - (1.0 - opacity)).abs() < 1e-9, "{opacity} {count}: {got:?}");
            let ratio = published_scale_ratio(opacity, got.opacity, count);
            assert!((got.scale_ratio / ratio - 1.0).abs() < 1e-6, "{opacity} {count}: {got:?} instead of {ratio}");
        }
        let one = Relocation::new(opacity, 1, 1e-9);
        assert!((one.opacity - opacity).abs() < 1e-12 && (one.scale_ratio - 1.0).abs() < 1e-9);
        assert_eq!(Relocation::new(opacity, 80, 1e-9), Relocation::new(opacity, 51, 1e-9));
    }
    // A certain one becomes two of 1 - ε, and what would die at once does not.
    assert!(Relocation::new(1.0, 2, 0.005).opacity < 1.0 && Relocation::new(1.0, 2, 0.005).scale_ratio.is_finite());
    assert_eq!(Relocation::new(0.02, 50, 0.005).opacity, f64::from(0.005_f32));
}

/// The dead move, the cap holds, and who shares a place shares opacity, scales, bands and a fresh state.
#[test]
fn the_dead_move_to_the_living_and_the_model_grows_to_its_cap() {
    for (seed, cap) in [(1, 250), (2, 255), (3, 1000)] {
        let mut state = trained(250, seed);
        let mut broken = state.0.get(17);
        broken.mean.x = f32::NAN;
        state.0.set(17, &broken);
        let (old, old_by_id) = (state.0.clone(), by_id(&state.0));
        let strategy = Strategy::Mcmc(McmcSettings { max_gaussians: cap, noise_rate: 0.0, ..McmcSettings::default() });
        let report = after_step(&mut Densifier::new(strategy, EXTENT_M, seed, &old).unwrap(), 600, &mut state);
        let (model, optimiser, _) = &state;
        let dead = old.iter().filter(|g| g.opacity() <= 0.005 || !g.is_finite()).count();
        assert_eq!(report, DensifyReport { relocated: dead, added: cap.min(262) - 250, ..DensifyReport::default() });
        assert!(dead > 30 && model.len() == cap.min(262) && model.is_finite());
        let mut groups: HashMap<[u32; 3], Vec<(usize, Gaussian)>> = HashMap::new();
        for (i, g) in model.iter().enumerate() {
            groups.entry(g.mean.to_array().map(f32::to_bits)).or_default().push((i, g));
        }
        let (mut shared, mut compared) = (0, 0);
        for group in groups.into_values() {
            let survivors: Vec<_> = group.iter().filter(|(_, g)| g.id <= 100 + 3 * 249).collect();
            assert_eq!(survivors.len(), 1, "a group is one that lived and its copies");
            let (at, survivor) = *survivors[0];
            let (old_at, before) = old_by_id[&survivor.id];
            if group.len() == 1 {
                assert_eq!((survivor, optimiser.steps(at)), (before, 3));
                continue;
            }
            shared += 1;
            for &(i, g) in &group {
                assert_eq!((model.sh_rest(i), optimiser.steps(i)), (old.sh_rest(old_at), 0));
                // Where only the dead have moved, all are equal; growth then shares what one of them has left.
                if cap == 250 {
                    assert_eq!(Gaussian { id: survivor.id, ..g }, survivor);
                }
                assert!((g.log_scales - before.log_scales).max_element() < 1e-6, "copies are not larger");
            }
            // Opacities that the formula would let fall below the limit do not count.
            if group.iter().all(|(_, g)| g.opacity() > 0.0051) {
                let together: f64 = group.iter().map(|(_, g)| 1.0 - f64::from(g.opacity())).product();
                let expected = 1.0 - f64::from(before.opacity());
                assert!((together - expected).abs() < 1e-5, "{together} instead of {expected}");
                compared += 1;
            }
        }
        assert!(shared > 20 && compared > 15, "{shared} {compared}");
    }
}

/// What relocation is for: the image stays.
#[test]
fn an_image_stays_nearly_the_same_where_gaussians_are_shared() {
    let model = scene(60, 31);
    let (mut relocated, mut naive) = (Gaussians::new(), Gaussians::new());
    for g in model.iter() {
        let count = 1 + (g.id % 4) as u32;
        let new = Relocation::new(f64::from(g.opacity()), count, 0.005);
        let opacity_logit = (new.opacity / (1.0 - new.opacity)).ln() as f32;
        let log_scales = g.log_scales + new.scale_ratio.ln() as f32;
        for _ in 0..count {
            relocated.push(&Gaussian { opacity_logit, log_scales, ..g });
            naive.push(&g);
        }
    }
    let mut engine = Engine::new(1).unwrap();
    let mut image = |model: &Gaussians| {
        let mut image = Rendered::default();
        engine.render(model, &super::camera(96, 80), &RenderSettings::default(), &mut image);
        image.color
    };
    let original = image(&model);
    let mut psnr = |model: &Gaussians| metrics::psnr(&original, &image(model), None).unwrap();
    let (relocated, naive) = (psnr(&relocated), psnr(&naive));
    assert!(relocated > 33.0 && relocated > naive + 10.0, "{relocated} dB, {naive} dB with plain copies");
}

#[test]
fn draws_are_in_proportion_to_opacity() {
    let strategy = McmcSettings { growth: 11.0, noise_rate: 0.0, ..McmcSettings::default() };
    let logit = |opacity: f32| (opacity / (1.0 - opacity)).ln();
    let opacity = |i: u64| [0.9, 0.3, 0.004][(i % 3) as usize];
    let model: Gaussians =
        scene(300, 6).iter().map(|g| Gaussian { opacity_logit: logit(opacity(g.id)), ..g }).collect();
    // Without the dead being moved first, as they would be.
    let strategy = Strategy::Mcmc(McmcSettings { dead_opacity: 0.001, ..strategy });
    let mut state = (model.clone(), Optimiser::new(), ScreenStatistics::new());
    let report = after_step(&mut Densifier::new(strategy, EXTENT_M, 5, &model).unwrap(), 600, &mut state);
    assert_eq!(report.added, 3000);
    let places: HashMap<[u32; 3], u64> =
        model.iter().map(|g| (g.mean.to_array().map(f32::to_bits), g.id % 3)).collect();
    let mut drawn = [0.0; 3];
    for g in state.0.iter().filter(|g| g.id >= 300) {
        drawn[places[&g.mean.to_array().map(f32::to_bits)] as usize] += 1.0;
    }
    for (kind, drawn) in drawn.into_iter().enumerate() {
        let expected = 3000.0 * f64::from(opacity(kind as u64)) / 1.204;
        assert!((drawn - expected).abs() < 4.0 * f64::sqrt(expected), "{drawn} instead of {expected}");
    }
}

#[test]
fn where_nothing_lives_nothing_is_moved() {
    let model: Gaussians = scene(20, 6).iter().map(|g| Gaussian { opacity_logit: -9.0, ..g }).collect();
    for model in [model, Gaussians::new()] {
        let mut state = (model.clone(), Optimiser::new(), ScreenStatistics::new());
        let strategy = Strategy::Mcmc(McmcSettings { noise_rate: 0.0, ..McmcSettings::default() });
        let report = after_step(&mut Densifier::new(strategy, EXTENT_M, 5, &model).unwrap(), 600, &mut state);
        assert_eq!((report, &state.0), (DensifyReport::default(), &model));
        let strategy = Strategy::Default(DefaultSettings::default());
        let report = after_step(&mut Densifier::new(strategy, EXTENT_M, 5, &model).unwrap(), 600, &mut state);
        assert_eq!((report.pruned, state.0.len()), (model.len(), 0));
    }
}

fn noisy(model: &Gaussians, isa: Isa, threads: usize, (seed, iteration): (u64, u32)) -> Gaussians {
    let strategy = McmcSettings { refine_start: u32::MAX - 1, ..McmcSettings::default() };
    let mut densifier = Densifier::new(Strategy::Mcmc(strategy), EXTENT_M, seed, model).unwrap();
    let mut training = Training::new(Engine::with_isa(threads, isa).unwrap());
    training.restore(model.clone(), Optimiser::new());
    let settings = TrainingSettings { lr_means: 2e-4, ..TrainingSettings::default() };
    densifier.after_step(iteration, &settings, &mut training).unwrap();
    training.into_model()
}

/// Displacements have mean 0 and the covariance (rate gate Σ)², and an opaque Gaussian stays.
#[test]
fn noise_has_the_covariance_of_the_paper() {
    let [template] = [scene(1, 3).get(0)];
    let opacity_logit = (0.01_f32 / 0.99).ln();
    let log_scales = Vec3::new(-3.0, -4.0, -3.5);
    let many: Gaussians = (0..6000)
        .map(|id| Gaussian { id, opacity_logit, log_scales, mean: Vec3::new(0.3, -0.2, 0.1), ..template })
        .collect();
    let rotation = Mat3::from_quat(template.rotation.normalize());
    let covariance = rotation * Mat3::from_diagonal((2.0 * log_scales).exp()) * rotation.transpose();
    let gate = 1.0 / (1.0 + (100.0 * (0.01_f32 - 0.005)).exp());
    let map = covariance * (5e5 * 2e-4 * gate);
    let expected = map * map.transpose();
    for isa in isas() {
        let moved = noisy(&many, isa, 1, (7, 40));
        let (mut mean, mut spread) = (Vec3::ZERO, Mat3::ZERO);
        for (new, old) in moved.iter().zip(many.iter()) {
            assert_eq!(Gaussian { mean: old.mean, ..new }, old, "nothing but means moves");
            let by = new.mean - old.mean;
            mean += by / 6000.0;
            spread += Mat3::from_cols(by * by.x, by * by.y, by * by.z) * (1.0 / 6000.0);
        }
        for i in 0..3 {
            let deviation = expected.col(i)[i].sqrt();
            assert!(mean[i].abs() < 4.0 * deviation / 6000_f32.sqrt(), "{isa:?} mean {mean}");
            for k in 0..3 {
                let size = (expected.col(i)[i] * expected.col(k)[k]).sqrt();
                assert!((spread.col(i)[k] - expected.col(i)[k]).abs() < 0.07 * size, "{isa:?} {spread} {expected}");
            }
        }
        let opaque: Gaussians = many.iter().map(|g| Gaussian { opacity_logit: 0.0, ..g }).collect();
        assert_eq!(noisy(&opaque, isa, 1, (7, 40)), opaque);
    }
}

#[test]
fn noise_belongs_to_the_gaussian_and_the_iteration_and_to_nothing_else() {
    let model: Gaussians =
        scene(3000, 12).iter().map(|g| Gaussian { opacity_logit: g.opacity_logit - 4.0, ..g }).collect();
    let isa = Isa::detect();
    let one = noisy(&model, isa, 1, (7, 40));
    assert!(one == noisy(&model, isa, 2, (7, 40)) && one == noisy(&model, isa, 3, (7, 40)));
    let order: Vec<u32> = (0..3000).rev().collect();
    let mut reversed = model.clone();
    reversed.permute(&order);
    let mut back = noisy(&reversed, isa, 1, (7, 40));
    back.permute(&order);
    assert!(back == one);
    for isa in isas() {
        let other = noisy(&model, isa, 1, (7, 40));
        assert!(other.iter().zip(one.iter()).all(|(a, b)| (a.mean - b.mean).length() < 1e-5 * (1.0 + b.mean.length())));
    }
    // Other iterations, seeds and Gaussians have displacements that have nothing to do with these.
    let displacement = |m: &Gaussians| -> Vec<Vec3> {
        m.iter().zip(model.iter()).map(|(a, b)| (a.mean - b.mean).normalize_or_zero()).collect()
    };
    let correlation = |a: &[Vec3], b: &[Vec3]| a.iter().zip(b).map(|(a, b)| a.dot(*b)).sum::<f32>() / a.len() as f32;
    let own = displacement(&one);
    assert!(own.iter().filter(|d| **d != Vec3::ZERO).count() > 2000);
    for other in [(7, 41), (8, 40), (7, 1 << 30)] {
        let correlation = correlation(&own, &displacement(&noisy(&model, isa, 1, other)));
        assert!(correlation.abs() < 0.05, "{other:?}: {correlation}");
    }
    assert!(correlation(&own[1..], &own[..2999]).abs() < 0.05);
    // What is broken stays as it is, and nothing becomes broken.
    let mut broken = model.clone();
    broken.set(5, &Gaussian { rotation: Quat::from_xyzw(0.0, 0.0, 0.0, 0.0), ..model.get(5) });
    broken.set(6, &Gaussian { log_scales: Vec3::splat(70.0), ..model.get(6) });
    broken.set(7, &Gaussian { mean: Vec3::NAN, ..model.get(7) });
    let moved = noisy(&broken, isa, 1, (7, 40));
    assert_eq!((moved.get(5), moved.get(6)), (broken.get(5), broken.get(6)));
    assert!(moved.get(7).mean.is_nan() && moved.get(8) == one.get(8));
}
