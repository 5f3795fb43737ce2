//! Densification around steps on the GPU: what it sees, its noise, and what comes of it.

use super::training::{mean_psnr, task};
use super::{options, skipped};
use crate::densify::Noise;
use crate::gpu::{Engine, Options};
use crate::{
    Backend, DefaultSettings, Densifier, Gaussians, McmcSettings, Optimiser, Strategy, Training, TrainingSettings,
    TrainingView,
};

/// Nothing moves, so that both back ends see the same in every iteration.
fn still() -> TrainingSettings {
    TrainingSettings {
        lr_means: 0.0,
        lr_log_scales: 0.0,
        lr_rotations: 0.0,
        lr_opacity: 0.0,
        lr_sh: 0.0,
        lr_sh_rest: 0.0,
        ..TrainingSettings::default()
    }
}

pub(super) fn on(backend: impl Into<Backend>, start: &Gaussians) -> Training {
    let mut training = Training::new(backend);
    training.restore(start.clone(), Optimiser::new());
    training
}

pub(super) fn gpu(options: &Options) -> Backend {
    Backend::Gpu(Box::new(Engine::new(options).unwrap()))
}

pub(super) fn cpu() -> crate::Engine {
    crate::Engine::new(1).unwrap()
}

#[test]
fn both_back_ends_see_the_same_of_every_gaussian() {
    let test = "both_back_ends_see_the_same_of_every_gaussian";
    let Some(options) = options() else { return skipped(test) };
    let (start, views) = task(300, (64, 48), 1);
    let seen = |mut training: Training| {
        // With lists that do not fit at first, each view still counts once; a plain step in between does not.
        for view in &views {
            training.step_observed(view, &still()).unwrap();
            training.step(view, &still()).unwrap();
        }
        training.sync().unwrap();
        training.statistics().clone()
    };
    let expected = seen(on(cpu(), &start));
    let found = seen(on(gpu(&Options { pairs: 100, ..options }), &start));
    let near = |a: f32, b: f32| (a - b).abs() <= 2e-3 * a.abs().max(b.abs()) + 1e-9;
    let apart = (0..start.len())
        .filter(|&i| {
            !near(expected.gradient_sum(i), found.gradient_sum(i))
                || expected.views(i) != found.views(i)
                || !near(expected.radius_px(i), found.radius_px(i))
        })
        .count();
    assert!((0..start.len()).filter(|&i| expected.gradient_sum(i) > 0.0).count() > 200);
    assert!(apart <= 3, "{apart} of {}", start.len());
}

#[test]
fn noise_is_the_same_numbers_wherever_it_is_made() {
    let test = "noise_is_the_same_numbers_wherever_it_is_made";
    let Some(options) = options() else { return skipped(test) };
    let (mut start, views) = task(200, (32, 32), 0);
    for i in 0..start.len() {
        let gaussian = start.get(i);
        start.set(i, &crate::Gaussian { opacity_logit: -5.0 + 0.05 * i as f32, id: (i as u64) << 30, ..gaussian });
    }
    let noise = |iteration| Noise::new(&McmcSettings::default(), 2e-4, 7, iteration);
    let moved = |mut training: Training| {
        training.step(&views[0], &still()).unwrap();
        training.add_noise(&noise(1)).unwrap();
        training.step(&views[1], &still()).unwrap();
        // At once, for the step is over.
        training.sync().unwrap();
        training.add_noise(&noise(2)).unwrap();
        training.sync().unwrap();
        training.into_model()
    };
    let (a, b) = (moved(on(cpu(), &start)), moved(on(gpu(&options), &start)));
    let mut shifts = 0;
    for i in 0..start.len() {
        let shift = a.get(i).mean - start.get(i).mean;
        shifts += usize::from(shift.length() > 1e-3);
        let apart = (a.get(i).mean - b.get(i).mean).length();
        assert!(apart <= 1e-3 * shift.length() + 1e-6, "Gaussian {i}: {apart} m of {}", shift.length());
    }
    assert!(shifts > 20, "{shifts} of {} moved", start.len());
}

fn strategies() -> [Strategy; 2] {
    let (max_gaussians, refine_every, refine_start) = (900, 20, 30);
    let default = DefaultSettings { max_gaussians, refine_every, refine_start, ..DefaultSettings::default() };
    let mcmc = McmcSettings { max_gaussians, refine_every, refine_start, growth: 1.3, ..McmcSettings::default() };
    [Strategy::Default(DefaultSettings { reset_every: 70, ..default }), Strategy::Mcmc(mcmc)]
}

fn densified(mut training: Training, views: &[TrainingView], strategy: Strategy) -> Gaussians {
    let mut densifier = Densifier::new(strategy, 1.0, 5, training.model()).unwrap();
    let mut settings = super::training::settings();
    strategy.apply(&mut settings);
    for iteration in 0..120 {
        let view = &views[iteration as usize % views.len()];
        if densifier.observes(iteration) {
            training.step_observed(view, &settings).unwrap();
        } else {
            training.step(view, &settings).unwrap();
        }
        densifier.after_step(iteration, &settings, &mut training).unwrap();
    }
    training.sync().unwrap();
    assert_eq!(training.finished().unwrap().len(), 120, "every loss is told once");
    training.into_model()
}

#[test]
fn densified_runs_come_to_the_same_on_both_back_ends() {
    let test = "densified_runs_come_to_the_same_on_both_back_ends";
    let Some(options) = options() else { return skipped(test) };
    let (start, views) = task(300, (64, 48), 1);
    for strategy in strategies() {
        let expected = densified(on(cpu(), &start), &views, strategy);
        let found = densified(on(gpu(&options), &start), &views, strategy);
        assert!(expected.len() > 400, "{strategy:?}: {}", expected.len());
        let share = found.len() as f64 / expected.len() as f64;
        let (a, b) = (mean_psnr(&expected, &views), mean_psnr(&found, &views));
        assert!((share - 1.0).abs() < 0.02 && (a - b).abs() < 0.5, "{} {} {a} {b}", expected.len(), found.len());
    }
}
