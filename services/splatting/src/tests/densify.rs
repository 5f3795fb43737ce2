//! What densification does to a model, Gaussian by Gaussian: adaptive density control, and what both strategies share.

use std::collections::{HashMap, HashSet};

use glam::Vec3;

use super::{Random, random_view, scene};
use crate::{
    DefaultSettings, Densifier, DensifierState, DensifyError, DensifyReport, Engine, Gaussian, Gaussians, McmcSettings,
    Optimiser, SH_REST_MAX, ScreenStatistics, Strategy, Training, TrainingSettings,
};

pub(super) const EXTENT_M: f32 = 2.0;

/// Statistics with given (gradient sum, views, radius) per Gaussian.
fn statistics(rows: &[[f32; 3]]) -> ScreenStatistics {
    let bytes: Vec<u8> = rows.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    ScreenStatistics::decode(&bytes, rows.len()).unwrap()
}

/// A model with bands of its own for each Gaussian, an optimiser with three steps for each, random statistics.
pub(crate) fn trained(count: usize, seed: u64) -> (Gaussians, Optimiser, ScreenStatistics) {
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

pub(super) fn after_step(
    densifier: &mut Densifier,
    iteration: u32,
    state: &mut (Gaussians, Optimiser, ScreenStatistics),
) -> DensifyReport {
    let mut training = Training::new(Engine::new(1).unwrap());
    let (model, optimiser, statistics) = std::mem::take(state);
    training.restore_observed(model, optimiser, statistics);
    let report = densifier.after_step(iteration, &TrainingSettings::default(), &mut training).unwrap();
    training.lists_mut().unwrap();
    *state = training.into_parts();
    let (model, optimiser, statistics) = (&state.0, &state.1, &state.2);
    assert_eq!((model.len(), model.len()), (optimiser.len(), statistics.len()));
    let ids: HashSet<u64> = model.iter().map(|g| g.id).collect();
    assert_eq!(ids.len(), model.len(), "ids are unique");
    report
}

pub(super) fn by_id(model: &Gaussians) -> HashMap<u64, (usize, Gaussian)> {
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
