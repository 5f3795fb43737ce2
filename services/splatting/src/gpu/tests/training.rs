//! Steps on the GPU against steps on the CPU.

use glam::Vec3;

use super::super::{Arrival, Copied, Engine, Options};
use super::{options, skipped, with_engine};
use crate::tests::harmonics::scene_of_degree;
use crate::tests::{camera, random_view, scene};
use crate::{
    Gaussians, LossTerms, Optimiser, Pose, RenderSettings, Rendered, ScreenStatistics, TrainingSettings, TrainingView,
};

/// Keyframes of a scene around it, and a disturbed copy to begin with.
pub(super) fn task(count: usize, size: (u32, u32), degree: u8) -> (Gaussians, Vec<TrainingView>) {
    let truth = scene_of_degree(count, 11, degree);
    let mut cpu = crate::Engine::new(1).unwrap();
    let views = (0..4)
        .map(|i| {
            let angle = 1.3 * i as f32;
            let camera = crate::Camera::from_hfov(Pose::IDENTITY, 1.0, size.0, size.1).look_at(
                Vec3::new(2.0 * angle.cos(), 2.0 * angle.sin(), 0.5),
                Vec3::ZERO,
                Vec3::Z,
            );
            let mut image = Rendered::default();
            cpu.render(&truth, &camera, &RenderSettings::default(), &mut image);
            TrainingView::full_image(camera, &image.color, &image.depth).unwrap()
        })
        .collect();
    let mut start = truth;
    for i in 0..start.len() {
        let mut gaussian = start.get(i);
        gaussian.mean += 0.03 * Vec3::new((i as f32).sin(), (2.0 * i as f32).cos(), (3.0 * i as f32).sin());
        gaussian.sh = gaussian.sh.map(|c| 0.6 * c);
        start.set(i, &gaussian);
    }
    (start, views)
}

/// Slow enough that a hundred iterations do not converge: there, rounding decides about decibels.
pub(super) fn settings() -> TrainingSettings {
    TrainingSettings {
        lr_means: 3e-4,
        lr_log_scales: 2e-3,
        lr_opacity: 0.01,
        lr_sh: 4e-3,
        lr_sh_rest: 4e-4,
        ..TrainingSettings::default()
    }
}

fn on_cpu(start: &Gaussians, views: &[TrainingView], iterations: usize) -> (Gaussians, Optimiser, Vec<LossTerms>) {
    let (mut model, mut optimiser) = (start.clone(), Optimiser::new());
    let mut engine = crate::Engine::new(1).unwrap();
    let step = |i: usize| engine.train_step(&mut model, &mut optimiser, &views[i % views.len()], &settings());
    let terms = (0..iterations).map(step).collect();
    (model, optimiser, terms)
}

fn on_gpu(
    engine: &mut Engine,
    start: &Gaussians,
    views: &[TrainingView],
    iterations: usize,
) -> (Gaussians, Optimiser, Vec<LossTerms>) {
    let (mut model, mut optimiser) = (start.clone(), Optimiser::new());
    engine.upload(&model, &mut optimiser, &mut ScreenStatistics::new()).unwrap();
    let mut terms = Vec::new();
    for i in 0..iterations {
        engine.step(&views[i % views.len()], &settings()).unwrap();
        terms.extend(engine.finished().unwrap());
    }
    engine.download(&mut model, &mut optimiser, &mut ScreenStatistics::new()).unwrap();
    terms.extend(engine.finished().unwrap());
    (model, optimiser, terms)
}

pub(super) fn mean_psnr(model: &Gaussians, views: &[TrainingView]) -> f64 {
    let mut engine = crate::Engine::new(1).unwrap();
    let one = |view| engine.gradient(model, view, &settings()).0.foreground_psnr_db();
    views.iter().map(one).sum::<f64>() / views.len() as f64
}

#[test]
fn a_hundred_iterations_end_where_the_cpu_ends() {
    with_engine("a_hundred_iterations_end_where_the_cpu_ends", |engine| {
        let (start, views) = task(300, (48, 40), 0);
        let (cpu, cpu_state, cpu_terms) = on_cpu(&start, &views, 100);
        let (gpu, gpu_state, gpu_terms) = on_gpu(engine, &start, &views, 100);
        let (before, on_cpu, on_gpu) = (mean_psnr(&start, &views), mean_psnr(&cpu, &views), mean_psnr(&gpu, &views));
        println!("{before:.2} dB at first, {on_cpu:.3} dB on the CPU, {on_gpu:.3} dB on the GPU");
        assert!(on_cpu > before + 3.0 && (on_cpu - on_gpu).abs() < 0.1, "{before} {on_cpu} {on_gpu}");
        assert_eq!(gpu_terms.len(), 100);
        for (i, (cpu, gpu)) in cpu_terms.iter().zip(&gpu_terms).enumerate().take(10) {
            assert!((cpu.total - gpu.total).abs() < 1e-3 * cpu.total, "iteration {i}: {cpu:?} {gpu:?}");
        }
        let same = (0..cpu.len()).filter(|&i| cpu_state.steps(i) == gpu_state.steps(i)).count();
        assert!(100 * same > 95 * cpu.len(), "Gaussians move only when they are drawn: {same} of {}", cpu.len());
        assert!(gpu.is_finite());
    });
}

/// Keyframes that have to make room while iterations that need them are waiting.
#[test]
fn fewer_keyframes_than_views_fit_and_nothing_is_left_out() {
    let Some(options) = options() else { return skipped("fewer_keyframes_than_views_fit_and_nothing_is_left_out") };
    let (start, views) = task(200, (48, 40), 0);
    let run = |keyframe_bytes: u64| {
        let mut engine = Engine::new(&Options { keyframe_bytes, deterministic: true, ..options.clone() }).unwrap();
        let (model, _, terms) = on_gpu(&mut engine, &start, &views, 40);
        let kept = engine.bytes().into_iter().find(|(what, _)| *what == "keyframes").unwrap().1;
        (model, terms, kept)
    };
    let (all, terms, bytes) = run(0);
    // Room for one and a half of the four.
    let (few, few_terms, few_bytes) = run(bytes * 3 / 8);
    assert!(few_bytes <= bytes * 3 / 8 && few_bytes > 0, "{few_bytes} of {bytes}");
    assert_eq!((terms.len(), few_terms.len()), (40, 40));
    assert!(terms == few_terms && all == few, "the same iterations, in the same order");
}

#[test]
fn the_first_step_moves_every_parameter_as_on_the_cpu() {
    with_engine("the_first_step_moves_every_parameter_as_on_the_cpu", |engine| {
        for degree in [0, 2] {
            let (start, views) = task(120, (40, 40), degree);
            let (cpu, ..) = on_cpu(&start, &views, 1);
            let (gpu, ..) = on_gpu(engine, &start, &views, 1);
            let mut apart = 0;
            for i in 0..cpu.len() {
                // A first step is the learning rate times the sign of the gradient: it may differ where that is next to 0.
                let (a, b) = (cpu.get(i), gpu.get(i));
                let near = (a.mean - b.mean).length() < 1e-5
                    && (a.log_scales - b.log_scales).length() < 1e-4
                    && (a.rotation - b.rotation).length() < 1e-4
                    && (a.opacity_logit - b.opacity_logit).abs() < 1e-3
                    && (0..3).all(|k| (a.sh[k] - b.sh[k]).abs() < 1e-4);
                let (a, b) = (cpu.sh_rest(i), gpu.sh_rest(i));
                let bands = a.iter().flatten().zip(b.iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-4);
                apart += usize::from(!near || !bands);
            }
            assert!(apart <= 3, "degree {degree}: {apart} of {} Gaussians", cpu.len());
        }
    });
}

#[test]
fn what_goes_up_comes_down_bit_for_bit() {
    with_engine("what_goes_up_comes_down_bit_for_bit", |engine| {
        let (start, views) = task(77, (24, 24), 1);
        let (model, optimiser, _) = on_cpu(&start, &views, 5);
        let (mut back, mut state) = (model.clone(), optimiser.clone());
        engine.upload(&model, &mut state, &mut ScreenStatistics::new()).unwrap();
        engine.download(&mut back, &mut state, &mut ScreenStatistics::new()).unwrap();
        assert!(back == model && state == optimiser);
    });
}

#[test]
fn lists_that_do_not_fit_cost_time_and_nothing_else() {
    let test = "lists_that_do_not_fit_cost_time_and_nothing_else";
    let Some(options) = options() else { return skipped(test) };
    let (start, views) = task(400, (64, 48), 0);
    let mut small = Engine::new(&Options { pairs: 40, ..options.clone() }).unwrap();
    let mut large = Engine::new(&options).unwrap();
    let (a, state_a, terms_a) = on_gpu(&mut small, &start, &views, 40);
    let (b, state_b, terms_b) = on_gpu(&mut large, &start, &views, 40);
    assert_eq!((terms_a.len(), terms_b.len()), (40, 40), "every iteration is there once");
    let steps = |state: &Optimiser| (0..start.len()).map(|i| u64::from(state.steps(i))).sum::<u64>();
    // Sums of floats have no order on a GPU, so a splat at a cut may differ.
    assert!(steps(&state_a).abs_diff(steps(&state_b)) <= 40, "{} {}", steps(&state_a), steps(&state_b));
    assert!((mean_psnr(&a, &views) - mean_psnr(&b, &views)).abs() < 0.1);
}

#[test]
fn ordered_sums_repeat_bit_for_bit_and_are_the_same_gradients() {
    let test = "ordered_sums_repeat_bit_for_bit_and_are_the_same_gradients";
    let Some(options) = options() else { return skipped(test) };
    let (start, views) = task(400, (64, 48), 1);
    let options = Options { deterministic: true, ..options };
    let run = |pairs: u32| {
        let mut engine = Engine::new(&Options { pairs, ..options.clone() }).unwrap();
        on_gpu(&mut engine, &start, &views, 20)
    };
    let (model, optimiser, terms) = run(0);
    // Lists that do not fit at first change nothing, to the bit.
    for (again, other_optimiser, other_terms) in [run(0), run(100)] {
        assert!(again == model && other_optimiser == optimiser && other_terms == terms);
    }
    let (_, ordered) = Engine::new(&options).unwrap().gradient(&start, &views[0], &settings()).unwrap();
    let (_, expected) = crate::Engine::new(1).unwrap().gradient(&start, &views[0], &settings());
    let (mut dot, mut a2, mut b2) = (0.0, 0.0, 0.0);
    for (a, b) in ordered.parameters.iter().flatten().zip(expected.parameters.iter().flatten()) {
        let (a, b) = (f64::from(*a), f64::from(*b));
        (dot, a2, b2) = (dot + a * b, a2 + a * a, b2 + b * b);
    }
    // The scene's own image has depths that differ from those rendered by little.
    assert!(dot / (a2 * b2).sqrt() > 0.999, "{}", dot / (a2 * b2).sqrt());
}

#[test]
fn a_lost_device_is_an_error_and_a_new_engine_goes_on() {
    let test = "a_lost_device_is_an_error_and_a_new_engine_goes_on";
    let Some(options) = options() else { return skipped(test) };
    let (start, views) = task(50, (24, 24), 0);
    let mut engine = Engine::new(&options).unwrap();
    let (mut model, mut optimiser) = (start.clone(), Optimiser::new());
    engine.upload(&model, &mut optimiser, &mut ScreenStatistics::new()).unwrap();
    engine.step(&views[0], &settings()).unwrap();
    engine.finish().unwrap();
    engine.lose_device();
    let failed = (0..64).find_map(|_| engine.step(&views[0], &settings()).err());
    assert!(failed.is_some_and(|error| !error.to_string().is_empty()));
    assert!(engine.download(&mut model, &mut optimiser, &mut ScreenStatistics::new()).is_err());
    assert!(model == start, "what the host has is as it was");
    assert!(engine.render(&model, views[0].camera(), &settings().render, &mut Rendered::default()).is_err());
    let mut fresh = Engine::new(&options).unwrap();
    let (after, ..) = on_gpu(&mut fresh, &start, &views, 3);
    assert!(after.is_finite() && after != start);
}

#[test]
fn half_a_million_gaussians_and_48_keyframes_fit_420_mb() {
    let test = "half_a_million_gaussians_and_48_keyframes_fit_420_mb";
    let Some(options) = options() else { return skipped(test) };
    let mut engine = Engine::new(&options).unwrap();
    let model = scene(500_000, 1);
    engine.upload(&model, &mut Optimiser::new(), &mut ScreenStatistics::new()).unwrap();
    // With a snapshot on its way. The step is asked for and never run: what counts is what is allocated.
    engine.begin_copy(Copied::Model).unwrap();
    engine.step(&random_view(camera(320, 240), 1), &settings()).unwrap();
    let mut all = 0;
    for (what, bytes) in engine.bytes() {
        let bytes = if what == "keyframes" { 48 * bytes } else { bytes };
        println!("{:6.1} MB {what}", bytes as f64 / 1e6);
        all += bytes;
    }
    println!("{:6.1} MB in all", all as f64 / 1e6);
    assert!(all > 100_000_000 && all < 420_000_000, "{all} bytes");
}

#[test]
fn stages_are_timed_where_the_adapter_can() {
    with_engine("stages_are_timed_where_the_adapter_can", |engine| {
        let (start, views) = task(100, (32, 32), 0);
        engine.upload(&start, &mut Optimiser::new(), &mut ScreenStatistics::new()).unwrap();
        engine.step(&views[0], &settings()).unwrap();
        if let Some(times) = engine.profile(&views[0], &settings()).unwrap() {
            assert!(times.iter().all(|&t| (0.0..10.0).contains(&t)) && times.iter().sum::<f64>() > 0.0, "{times:?}");
        }
    });
}

#[test]
fn views_of_different_sizes_take_turns() {
    with_engine("views_of_different_sizes_take_turns", |engine| {
        let model = scene(100, 3);
        let views = [random_view(camera(32, 24), 1), random_view(camera(24, 40), 2)];
        let (_, _, gpu) = on_gpu(engine, &model, &views, 4);
        let (_, _, cpu) = on_cpu(&model, &views, 4);
        assert_eq!(gpu.len(), 4);
        for (gpu, cpu) in gpu.iter().zip(&cpu) {
            assert!((gpu.total - cpu.total).abs() < 2e-3 * cpu.total, "{gpu:?} {cpu:?}");
        }
    });
}

/// A copy comes while training goes on, and is the model of the iterations that were asked for before it.
#[test]
fn a_copy_is_of_the_moment_it_was_begun() {
    let test = "a_copy_is_of_the_moment_it_was_begun";
    let Some(options) = options() else { return skipped(test) };
    let (start, views) = task(200, (48, 40), 1);
    // In order, so that runs repeat bit for bit.
    let engine = |pairs| Engine::new(&Options { deterministic: true, pairs, ..options.clone() }).unwrap();
    let (expected, ..) = on_gpu(&mut engine(0), &start, &views, 21);
    let mut gpu = engine(0);
    gpu.upload(&start, &mut Optimiser::new(), &mut ScreenStatistics::new()).unwrap();
    assert!(gpu.take_copy(&start, true).unwrap().is_none(), "none was begun");
    for i in 0..60 {
        gpu.step(&views[i % views.len()], &settings()).unwrap();
        if i == 5 || i == 20 {
            // The first is forgotten for the second.
            gpu.begin_copy(Copied::Model).unwrap();
        }
    }
    assert!(gpu.take_copy(&start, true).unwrap() == Some(expected.clone()), "of 21 iterations");
    assert!(gpu.take_copy(&start, false).unwrap().is_none(), "it is taken once");
    // Lists that do not fit: what was copied was not trained, so it is copied again.
    let mut small = engine(40);
    small.upload(&start, &mut Optimiser::new(), &mut ScreenStatistics::new()).unwrap();
    for i in 0..21 {
        small.step(&views[i % views.len()], &settings()).unwrap();
    }
    small.begin_copy(Copied::Model).unwrap();
    assert!(small.take_copy(&start, true).unwrap() == Some(expected));
}

/// A checkpoint comes while training goes on: model and optimiser of one moment, with every loss up to it told.
#[test]
fn a_copy_of_everything_is_what_a_download_at_that_moment_is() {
    let test = "a_copy_of_everything_is_what_a_download_at_that_moment_is";
    let Some(options) = options() else { return skipped(test) };
    for degree in [0, 2] {
        let (start, views) = task(200, (48, 40), degree);
        let settings = TrainingSettings {
            render: RenderSettings { sh_degree: degree, ..RenderSettings::default() },
            ..settings()
        };
        let engine = |pairs| Engine::new(&Options { deterministic: true, pairs, ..options.clone() }).unwrap();
        let ready = |pairs| {
            let mut engine = engine(pairs);
            engine.upload(&start, &mut Optimiser::new(), &mut ScreenStatistics::new()).unwrap();
            engine
        };
        let at = |iterations: usize| {
            let mut engine = ready(0);
            (0..iterations).for_each(|i| engine.step(&views[i % views.len()], &settings).unwrap());
            let (mut model, mut optimiser) = (start.clone(), Optimiser::new());
            engine.download(&mut model, &mut optimiser, &mut ScreenStatistics::new()).unwrap();
            (model, optimiser)
        };
        let mut gpu = ready(0);
        assert!(gpu.take_state(&start).unwrap() == Arrival::NotYet, "none was begun");
        let mut told = 0;
        let (found, steps) = (0..)
            .find_map(|i: usize| {
                assert!(i < 100_000, "a copy never arrived");
                gpu.step(&views[i % views.len()], &settings).unwrap();
                if i == 20 {
                    gpu.begin_copy(Copied::State).unwrap();
                }
                told += gpu.finished().unwrap().len();
                match gpu.take_state(&start).unwrap() {
                    Arrival::Here(found) => Some((found, i + 1)),
                    Arrival::NotYet => None,
                    Arrival::Anew => panic!("all lists fit"),
                }
            })
            .unwrap();
        told += gpu.finished().unwrap().len();
        assert!(told >= 21 && told <= steps, "{told} losses of {steps} steps");
        assert!(found == at(21), "degree {degree}");
        // Lists that do not fit: it is copied anew, and says so.
        let mut small = ready(40);
        (0..21).for_each(|i| small.step(&views[i % views.len()], &settings).unwrap());
        small.begin_copy(Copied::State).unwrap();
        (21..25).for_each(|i| small.step(&views[i % views.len()], &settings).unwrap());
        let mut anew = 0;
        let found = loop {
            small.finish().unwrap();
            match small.take_state(&start).unwrap() {
                Arrival::Here(found) => break found,
                Arrival::NotYet => std::thread::yield_now(),
                Arrival::Anew => anew += 1,
            }
        };
        assert!(anew > 0 && found == at(25), "degree {degree}");
        // Forgotten when the model is replaced.
        small.begin_copy(Copied::State).unwrap();
        small.upload(&start, &mut Optimiser::new(), &mut ScreenStatistics::new()).unwrap();
        assert!(small.take_state(&start).unwrap() == Arrival::NotYet);
    }
}
