//! What densification does to a model, Gaussian by Gaussian.

use std::collections::{HashMap, HashSet};

use glam::{Quat, Vec3};

use super::{Random, isas, random_view, scene};
use crate::{
    DefaultSettings, Densifier, DensifierState, DensifyError, DensifyReport, Engine, Gaussian, Gaussians, Isa,
    McmcSettings, Optimiser, Relocation, RenderSettings, Rendered, SH_REST_MAX, ScreenStatistics, Strategy,
    TrainingSettings, metrics,
};

const EXTENT_M: f32 = 2.0;

/// Statistics with given (gradient sum, views, radius) per Gaussian.
fn statistics(rows: &[[f32; 3]]) -> ScreenStatistics {
    let bytes: Vec<u8> = rows.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    ScreenStatistics::decode(&bytes, rows.len()).unwrap()
}

/// A model with bands of its own for each Gaussian, an optimiser with three steps for each, random statistics.
fn trained(count: usize, seed: u64) -> (Gaussians, Optimiser, ScreenStatistics) {
    let mut random = Random(seed);
    let mut model = Gaussians::with_sh_degree(1);
    for g in scene(count, seed).iter() {
        // Half of them smaller than a hundredth of the extent, some transparent, some very large.
        let size = [-4.5, -3.5, -2.0, -1.0][(g.id % 4) as usize];
        let log_scales = Vec3::new(size, size - random.uniform(0.0, 2.0), size - 0.5);
        let opacity_logit = if g.id % 7 == 0 { -6.0 } else { random.uniform(-4.0, 4.0) };
        model.push(&Gaussian { log_scales, opacity_logit, id: 100 + 3 * g.id, ..g });
        model.set_sh_rest(model.len() - 1, &[[g.id as f32, 1.0, -1.0]; SH_REST_MAX]);
    }
    let mut optimiser = Optimiser::new();
    let mut engine = Engine::new(1).unwrap();
    // With regularisers, every Gaussian takes a step.
    let settings = TrainingSettings { opacity_weight: 1e-9, scale_weight: 1e-9, ..TrainingSettings::default() };
    let view = random_view(super::camera(40, 30), seed);
    let mut moved = model.clone();
    for _ in 0..3 {
        engine.train_step(&mut moved, &mut optimiser, &view, &settings);
    }
    let rows: Vec<[f32; 3]> = (0..count)
        .map(|_| {
            let views = random.uniform(0.0, 30.0).floor();
            [views * random.uniform(0.0, 4e-4), views, random.uniform(0.0, 40.0)]
        })
        .collect();
    (model, optimiser, statistics(&rows))
}

fn after_step(
    densifier: &mut Densifier,
    iteration: u32,
    state: &mut (Gaussians, Optimiser, ScreenStatistics),
) -> DensifyReport {
    let engine = Engine::new(1).unwrap();
    let (model, optimiser, statistics) = (&mut state.0, &mut state.1, &mut state.2);
    let report = densifier.after_step(&engine, iteration, &TrainingSettings::default(), model, optimiser, statistics);
    assert_eq!((model.len(), model.len()), (optimiser.len(), statistics.len()));
    let ids: HashSet<u64> = model.iter().map(|g| g.id).collect();
    assert_eq!(ids.len(), model.len(), "ids are unique");
    report
}

fn by_id(model: &Gaussians) -> HashMap<u64, (usize, Gaussian)> {
    model.iter().enumerate().map(|(i, g)| (g.id, (i, g))).collect()
}

/// Every rule of adaptive density control, over random models.
#[test]
fn gaussians_are_cloned_split_and_pruned_by_the_published_rules() {
    let settings = DefaultSettings { prune_radius_px: Some(30.0), ..DefaultSettings::default() };
    let (mut totals, mut square_offsets, mut children_count) = (DensifyReport::default(), 0.0, 0.0);
    for (seed, iteration) in (0..12).zip([600, 3100].into_iter().cycle()) {
        let mut state = trained(250, seed);
        let (old, old_statistics) = (state.0.clone(), state.2.clone());
        let mut densifier = Densifier::new(Strategy::Default(settings), EXTENT_M, seed, &old).unwrap();
        let report = after_step(&mut densifier, iteration, &mut state);
        let (model, optimiser, _) = &state;
        let new = by_id(model);
        // What is new, by the bands that it has from its parent.
        let mut offspring: HashMap<u32, Vec<(usize, Gaussian)>> = HashMap::new();
        for (i, g) in model.iter().enumerate().filter(|(_, g)| g.id > 100 + 3 * 249) {
            assert_eq!(optimiser.steps(i), 0);
            offspring.entry(model.sh_rest(i)[2][0] as u32).or_default().push((i, g));
        }
        let mut expected = DensifyReport::default();
        for (i, parent) in old.iter().enumerate() {
            let bands = old.sh_rest(i);
            let gradient = old_statistics.mean_gradient(i);
            let largest = parent.log_scales.max_element().exp();
            let prunable = |scale: f32, radius: f32| {
                let too_big = scale > 0.1 * EXTENT_M || radius > 30.0;
                parent.opacity() < 0.005 || iteration > 3000 && too_big
            };
            let pruned = prunable(largest, old_statistics.radius_px(i));
            let children = offspring.remove(&(bands[2][0] as u32)).unwrap_or_default();
            assert!(children.iter().all(|&(at, _)| model.sh_rest(at)[..3] == bands[..3]));
            let (grows, small) = (gradient >= 2e-4, largest <= 0.01 * EXTENT_M);
            if grows && !small {
                expected.split += 1;
                assert!(!new.contains_key(&parent.id), "the parent is gone");
                let pruned = prunable(largest / 1.6, 0.0);
                expected.pruned += 2 * usize::from(pruned);
                assert_eq!(children.len(), if pruned { 0 } else { 2 });
                for (_, child) in children {
                    let shrunk = parent.log_scales - 1.6_f32.ln();
                    assert!((child.log_scales - shrunk).abs().max_element() < 1e-6);
                    let same = Gaussian { mean: parent.mean, log_scales: parent.log_scales, id: parent.id, ..child };
                    assert_eq!(same, parent);
                    let along = parent.rotation.normalize().conjugate() * (child.mean - parent.mean);
                    let sigmas = along / parent.log_scales.exp();
                    assert!(sigmas.length() < 6.0, "{sigmas}");
                    square_offsets += f64::from(sigmas.length_squared());
                    children_count += 1.0;
                }
                continue;
            }
            expected.pruned += usize::from(pruned);
            assert_eq!(new.contains_key(&parent.id), !pruned);
            if !pruned {
                let (at, same) = new[&parent.id];
                assert_eq!((same, optimiser.steps(at)), (parent, 3));
            }
            if grows {
                // The clone has not been seen yet, so its radius is no reason.
                expected.cloned += 1;
                let pruned = prunable(largest, 0.0);
                expected.pruned += usize::from(pruned);
                assert_eq!(children.len(), usize::from(!pruned));
                assert!(children.iter().all(|(_, clone)| Gaussian { id: parent.id, ..*clone } == parent));
            } else {
                assert!(children.is_empty());
            }
        }
        assert!(offspring.is_empty());
        assert_eq!(report, DensifyReport { reset: false, ..expected });
        assert_eq!(model.len(), old.len() + report.cloned + report.split - report.pruned);
        assert!((0..model.len()).all(|i| state.2.views(i) == 0), "statistics begin again");
        let order = model.morton_order();
        assert!(order.iter().enumerate().all(|(i, &o)| i as u32 == o), "along the curve");
        totals.cloned += report.cloned;
        totals.split += report.split;
        totals.pruned += report.pruned;
    }
    assert!(totals.cloned > 200 && totals.split > 200 && totals.pruned > 200, "{totals:?}");
    // Places are drawn from the parent: their squared distance in standard deviations has mean 3 and deviation √6.
    let mean = square_offsets / children_count;
    assert!((mean - 3.0).abs() < 4.0 * (6.0_f64 / children_count).sqrt(), "{mean}");
}

#[test]
fn where_there_is_little_room_the_largest_gradients_grow() {
    let mut state = trained(300, 4);
    let (old, seen) = (state.0.clone(), state.2.clone());
    let strategy = Strategy::Default(DefaultSettings { max_gaussians: 320, ..DefaultSettings::default() });
    let report = after_step(&mut Densifier::new(strategy, EXTENT_M, 1, &old).unwrap(), 600, &mut state);
    assert_eq!(report.cloned + report.split, 20);
    let mut gradients: Vec<f32> = (0..300).map(|i| seen.mean_gradient(i)).collect();
    gradients.sort_by(|a, b| b.total_cmp(a));
    let offspring: HashSet<u32> = (0..state.0.len())
        .filter(|&i| state.0.get(i).id > 100 + 3 * 299)
        .map(|i| state.0.sh_rest(i)[2][0] as u32)
        .collect();
    assert!(offspring.len() > 10 && offspring.iter().all(|&i| seen.mean_gradient(i as usize) >= gradients[19]));
    let full = Strategy::Default(DefaultSettings { max_gaussians: 10, ..DefaultSettings::default() });
    let report = after_step(&mut Densifier::new(full, EXTENT_M, 1, &old).unwrap(), 600, &mut (old, state.1, seen));
    assert_eq!((report.cloned, report.split), (0, 0));
}

#[test]
fn opacities_are_reset_and_their_moments_with_them() {
    let mut state = trained(120, 9);
    let old = state.0.clone();
    let mut densifier = Densifier::new(Strategy::Default(DefaultSettings::default()), EXTENT_M, 1, &old).unwrap();
    state.2.reset();
    let report = after_step(&mut densifier, 3000, &mut state);
    assert!(report.reset && report.cloned + report.split == 0 && report.pruned > 0);
    let old = by_id(&old);
    let mut lowered = 0;
    for (i, g) in state.0.iter().enumerate() {
        let before = old[&g.id].1;
        let opacity = before.opacity().min(0.01);
        assert!(
            (g.opacity() - opacity).abs() < 1e-6 && Gaussian { opacity_logit: before.opacity_logit, ..g } == before
        );
        assert_eq!(state.1.steps(i), 3);
        lowered += usize::from(before.opacity() > 0.01);
    }
    assert!(lowered > 50);
    let moments = |o: &Optimiser, row: usize| {
        o.first.iter().chain(&o.second).flat_map(|b| b.0[row].0).filter(|m| *m != 0.0).count()
    };
    assert!(moments(&state.1, 10) == 0 && moments(&state.1, 9) > 0 && moments(&state.1, 11) > 0);
}

#[test]
fn nothing_happens_out_of_season() {
    let default = Strategy::Default(DefaultSettings::default());
    let mcmc = Strategy::Mcmc(McmcSettings { noise_rate: 0.0, ..McmcSettings::default() });
    for (strategy, iterations) in [
        (Strategy::None, vec![0, 600, 3000]),
        (default, vec![0, 100, 500, 650, 15_000, 15_100, 18_000]),
        (mcmc, vec![0, 100, 500, 650, 25_000, 25_100]),
    ] {
        for iteration in iterations {
            let mut state = trained(60, 2);
            let old = state.clone();
            let report = after_step(&mut Densifier::new(strategy, EXTENT_M, 1, &old.0).unwrap(), iteration, &mut state);
            assert_eq!(report, DensifyReport::default());
            assert!(state == old, "{strategy:?} in iteration {iteration}");
        }
    }
    assert!(default.observes(14_999) && !default.observes(15_000) && !mcmc.observes(600));
    let Strategy::Default(short) = default.scaled(7.0 / 30.0) else { panic!("the strategy stays") };
    let iterations = (short.refine_every, short.refine_start, short.refine_stop, short.reset_every);
    assert_eq!(iterations, (23, 116, 3500, 700));
}

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
    let (mut moved, mut optimiser, mut statistics) = (model.clone(), Optimiser::new(), ScreenStatistics::new());
    let engine = Engine::with_isa(threads, isa).unwrap();
    let settings = TrainingSettings { lr_means: 2e-4, ..TrainingSettings::default() };
    densifier.after_step(&engine, iteration, &settings, &mut moved, &mut optimiser, &mut statistics);
    moved
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
    let rotation = glam::Mat3::from_quat(template.rotation.normalize());
    let covariance = rotation * glam::Mat3::from_diagonal((2.0 * log_scales).exp()) * rotation.transpose();
    let gate = 1.0 / (1.0 + (100.0 * (0.01_f32 - 0.005)).exp());
    let map = covariance * (5e5 * 2e-4 * gate);
    let expected = map * map.transpose();
    for isa in isas() {
        let moved = noisy(&many, isa, 1, (7, 40));
        let (mut mean, mut spread) = (Vec3::ZERO, glam::Mat3::ZERO);
        for (new, old) in moved.iter().zip(many.iter()) {
            assert_eq!(Gaussian { mean: old.mean, ..new }, old, "nothing but means moves");
            let by = new.mean - old.mean;
            mean += by / 6000.0;
            spread += glam::Mat3::from_cols(by * by.x, by * by.y, by * by.z) * (1.0 / 6000.0);
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

/// A run that is interrupted, saved and resumed is the run that was not.
#[test]
fn a_resumed_densifier_goes_on_with_the_same_bits() {
    let settings = DefaultSettings { reset_every: 300, ..DefaultSettings::default() };
    for strategy in [Strategy::Default(settings), Strategy::Mcmc(McmcSettings::default())] {
        let run = |seed: u64, interrupted: bool| {
            let mut state = trained(200, 8);
            let mut densifier = Densifier::new(strategy, EXTENT_M, seed, &state.0).unwrap();
            for iteration in [600, 601, 700, 800, 900] {
                state.2.fit(&state.0);
                state.2 = statistics(
                    &(0..state.0.len()).map(|i| [(i % 9) as f32 * 1e-4, 1.0, 5.0]).collect::<Vec<[f32; 3]>>(),
                );
                after_step(&mut densifier, iteration, &mut state);
                if interrupted {
                    let saved = densifier.state().to_bytes();
                    densifier = Densifier::resume(strategy, EXTENT_M, DensifierState::from_bytes(&saved)).unwrap();
                }
            }
            (state, densifier.state())
        };
        let whole = run(3, false);
        assert!(whole == run(3, true));
        assert!(whole.0.0 != run(4, false).0.0, "another seed is another run");
    }
}

#[test]
fn settings_out_of_range_are_named() {
    let model = Gaussians::new();
    let refused = |strategy: Strategy, extent: f32| Densifier::new(strategy, extent, 1, &model).err().unwrap();
    let default = DefaultSettings::default();
    let mcmc = McmcSettings::default();
    for (error, name) in [
        (refused(Strategy::None, 0.0), "extent_m"),
        (refused(Strategy::None, f32::NAN), "extent_m"),
        (refused(Strategy::Default(DefaultSettings { refine_every: 0, ..default }), 1.0), "refine_every"),
        (refused(Strategy::Default(DefaultSettings { reset_every: 0, ..default }), 1.0), "reset_every"),
        (refused(Strategy::Default(DefaultSettings { grow_gradient: f32::NAN, ..default }), 1.0), "grow_gradient"),
        (refused(Strategy::Default(DefaultSettings { reset_opacity: 1.0, ..default }), 1.0), "reset_opacity"),
        (refused(Strategy::Default(DefaultSettings { split_shrink: -1.0, ..default }), 1.0), "split_shrink"),
        (refused(Strategy::Mcmc(McmcSettings { growth: 0.9, ..mcmc }), 1.0), "growth"),
        (refused(Strategy::Mcmc(McmcSettings { noise_rate: f32::INFINITY, ..mcmc }), 1.0), "noise_rate"),
        (refused(Strategy::Mcmc(McmcSettings { refine_every: 0, ..mcmc }), 1.0), "refine_every"),
    ] {
        let DensifyError::Setting { name: found, .. } = &error;
        assert!(*found == name && error.to_string().contains(name), "{error}");
    }
    let wide = Strategy::Mcmc(McmcSettings { refine_every: 1, refine_start: 0, noise_stop: 0, ..mcmc });
    assert!(Densifier::new(wide.scaled(1e-9), 1.0, 1, &model).is_ok(), "scaling leaves no interval of 0");
}
