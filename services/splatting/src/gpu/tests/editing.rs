//! Changes of the list of Gaussians on the GPU, bit for bit those on the host.

use glam::{Quat, Vec3};

use super::densify::{cpu, gpu, on};
use super::training::{settings, task};
use super::{options, skipped, with_engine};
use crate::edit::{Draft, Edit, Looks};
use crate::gpu::pruning::ASK;
use crate::gpu::{Engine, Options};
use crate::rgbd::clip_box::ClipBox;
use crate::rgbd::prune::{self, DepthView, PruneRules};
use crate::tests::densify::trained;
use crate::tests::{Random, camera};
use crate::{
    Backend, Camera, DefaultSettings, Densifier, Gaussian, Gaussians, McmcSettings, Optimiser, Pose, ScreenStatistics,
    Strategy, Training,
};

type Lists = (Gaussians, Optimiser, ScreenStatistics);

/// Everything that a draft can do, some of it to Gaussians that it was done to before.
fn change(draft: &mut Draft<'_>, random: &mut Random) {
    let count = draft.model().len();
    let mut some = |draft: &Draft<'_>| random.uniform(0.0, draft.model().len() as f32) as usize % draft.model().len();
    for k in 0..count / 5 {
        let (to, of) = (some(draft), some(draft));
        let gaussian = Gaussian { id: 10_000 + k as u64, ..draft.model().get(of) };
        match k % 3 {
            0 => draft.replace(to, &gaussian, of),
            1 => draft.push_beside(&Gaussian { opacity_logit: 0.25, ..gaussian }, of),
            _ => draft.push(&Gaussian { mean: gaussian.mean + 0.5, id: (k as u64) << 33, ..gaussian }),
        }
    }
    draft.retain(|index| index % 4 != 1);
}

/// The lists after a change, on the host and on the GPU.
fn both(engine: &mut Engine, lists: &Lists, change: impl FnOnce(&mut Draft<'_>)) -> (Lists, Lists, Edit) {
    let (mut model, mut optimiser, mut statistics) = lists.clone();
    engine.upload(&model, &mut optimiser, &mut statistics).unwrap();
    let mut draft = Draft::new(&mut model, &statistics);
    change(&mut draft);
    let edit = draft.finish();
    engine.edit(&edit, &model).unwrap();
    // What the host has of the others is of no use.
    let mut down = (model.clone(), Optimiser::new(), ScreenStatistics::new());
    engine.download(&mut down.0, &mut down.1, &mut down.2).unwrap();
    if let Some(sources) = &edit.sources {
        optimiser.follow(sources);
        statistics.follow(sources);
    }
    if edit.forgets_statistics {
        statistics.reset();
    }
    if edit.logit_ceiling.is_some() {
        optimiser.reset_opacities();
    }
    ((model, optimiser, statistics), down, edit)
}

#[test]
fn lists_are_changed_on_the_gpu_as_on_the_host() {
    with_engine("lists_are_changed_on_the_gpu_as_on_the_host", |engine| {
        for (count, degree) in [(300, 0), (77, 1), (33, 3), (6, 2)] {
            let mut lists = trained(count, 5);
            lists.0.set_sh_degree(degree);
            lists.1.fit(&lists.0);
            let mut random = Random(count as u64);
            let (host, device, edit) = both(engine, &lists, |draft| change(draft, &mut random));
            assert!(host == device && edit.sources.is_some(), "{count}");
            let (host, device, _) = both(engine, &host, |draft| {
                change(draft, &mut random);
                draft.forget_statistics();
                draft.lower_opacities(-1.5);
                draft.sort_along_curve();
            });
            assert!(host == device, "{count}");
            let (host, device, edit) = both(engine, &host, |draft| draft.lower_opacities(-3.0));
            assert!(host == device && edit.sources.is_none(), "{count}");
            let (host, device, edit) = both(engine, &host, |draft| draft.forget_statistics());
            assert!(host == device && edit.sources.is_none(), "{count}");
        }
    });
}

#[test]
fn lists_are_emptied_and_filled_again() {
    with_engine("lists_are_emptied_and_filled_again", |engine| {
        let lists = trained(40, 2);
        let (host, device, _) = both(engine, &lists, |draft| draft.retain(|_| false));
        assert!(host == device && host.0.is_empty());
        let (host, device, _) = both(engine, &host, |draft| lists.0.iter().for_each(|gaussian| draft.push(&gaussian)));
        assert!(host == device && host.0.len() == 40 && host.1.steps(7) == 0);
    });
}

/// One densification of a model that is on the GPU, against one of the same model here.
#[test]
fn both_back_ends_densify_to_the_same_bits() {
    let test = "both_back_ends_densify_to_the_same_bits";
    let Some(options) = options() else { return skipped(test) };
    let (start, views) = task(400, (64, 48), 2);
    // In order, so that runs repeat bit for bit.
    let mut engine = Some(gpu(&Options { deterministic: true, ..options }));
    let begin = |engine: &mut Option<Backend>| {
        let mut training = Training::new(engine.take().unwrap());
        training.restore(start.clone(), Optimiser::new());
        training
    };
    let observed = |mut training: Training| {
        for view in &views {
            training.step_observed(view, &settings()).unwrap();
        }
        training
    };
    let lists =
        |training: &Training| (training.model().clone(), training.optimiser().clone(), training.statistics().clone());
    let default = DefaultSettings { grow_gradient: 5e-5, ..DefaultSettings::default() };
    // Of what noise is made the last bits differ.
    let mcmc = McmcSettings { growth: 1.3, dead_opacity: 0.4, noise_rate: 0.0, ..McmcSettings::default() };
    for (strategy, iteration) in [
        (Strategy::Default(default), 600),
        (Strategy::Default(default), 3000),
        (Strategy::Default(DefaultSettings { refine_start: 9000, ..default }), 3000),
        (Strategy::Mcmc(mcmc), 600),
    ] {
        let densify = |training: &mut Training| {
            let mut densifier = Densifier::new(strategy, 0.5, 5, training.model()).unwrap();
            let report = densifier.after_step(iteration, &settings(), training).unwrap();
            (report, densifier.state())
        };
        // On the GPU alone.
        let mut training = observed(begin(&mut engine));
        let on_gpu = densify(&mut training);
        training.sync().unwrap();
        let after = lists(&training);
        engine = Some(training.into_backend());
        // On the CPU, from the same state.
        let mut training = observed(begin(&mut engine));
        training.sync().unwrap();
        let mut here = Training::new(cpu());
        let (model, optimiser, statistics) = lists(&training);
        here.restore_observed(model, optimiser, statistics);
        assert_eq!(densify(&mut here), on_gpu);
        assert!(lists(&here) == after, "{strategy:?}: {:?}", on_gpu.0);
        assert!(on_gpu.0.changed_list() || on_gpu.0.reset, "{:?}", on_gpu.0);
        // In both places: what the GPU goes on with is the same too.
        assert_eq!(densify(&mut training), on_gpu);
        assert!(lists(&training) == after);
        training.step(&views[0], &settings()).unwrap();
        training.sync().unwrap();
        let twice = lists(&training);
        training.restore_observed(after.0, after.1, after.2);
        training.step(&views[0], &settings()).unwrap();
        training.sync().unwrap();
        assert!(lists(&training) == twice, "{strategy:?}");
        engine = Some(training.into_backend());
    }
}

/// Losses of steps before a change of the list are told after it, and a copy that was begun before is forgotten.
#[test]
fn a_change_of_the_list_loses_no_losses() {
    let test = "a_change_of_the_list_loses_no_losses";
    let Some(options) = options() else { return skipped(test) };
    let (start, views) = task(60, (24, 24), 0);
    let mut training = on(gpu(&options), &start);
    for _ in 0..3 {
        for view in &views {
            training.step(view, &settings()).unwrap();
        }
        training.begin_copy().unwrap();
        training.edit(|draft| draft.retain(|index| index % 9 != 0)).unwrap();
        assert!(training.take_copy(true).unwrap().is_none());
    }
    training.begin_copy().unwrap();
    assert_eq!(training.take_copy(true).unwrap().unwrap().len(), training.model().len());
    training.sync().unwrap();
    assert_eq!(training.finished().unwrap().len(), 3 * views.len());
}

fn rules() -> PruneRules {
    PruneRules {
        clip: ClipBox { min: Vec3::splat(-0.9), max: Vec3::new(0.9, 0.9, 1.25) },
        min_opacity: 0.02,
        max_sigma_m: 0.04,
        front_m: 0.03,
        front_views: 2,
    }
}

/// Gaussians about a wall that three cameras see, many of them where rounding decides.
fn about_a_wall(count: usize, seed: u64) -> (Gaussians, Vec<Camera>, Vec<Vec<f32>>) {
    let mut random = Random(seed);
    let cameras: Vec<Camera> = [-0.4, 0.0, 0.5]
        .map(|x| camera(64, 48).look_at(Vec3::new(x, -2.0, 0.1), Vec3::new(0.0, 0.3, 0.0), Vec3::Z))
        .to_vec();
    let images = cameras.iter().map(|camera| {
        let depth = |i: usize| {
            if i.is_multiple_of(37) { 0.0 } else { 1.7 + 0.2 * ((i % camera.width as usize) as f32 * 0.2).sin() }
        };
        (0..camera.pixels()).map(depth).collect::<Vec<f32>>()
    });
    let images: Vec<Vec<f32>> = images.collect();
    let model = (0..count)
        .map(|k| {
            let place = |random: &mut Random| random.uniform(-1.0, 1.0);
            let mut mean = Vec3::new(place(&mut random), place(&mut random) - 0.5, place(&mut random));
            let camera = &cameras[k % 3];
            let (x, y) = (random.uniform(0.0, 64.0).floor(), random.uniform(0.0, 48.0).floor());
            match k % 6 {
                // On the corner of a pixel, and as far before a measurement as counts.
                0 => mean = camera.backproject(x, y, 1.3),
                1 => mean = camera.backproject(x + 0.5, y + 0.5, images[k % 3][(y * 64.0 + x) as usize] - 0.03),
                2 => mean = Vec3::new(0.9, mean.y, mean.z),
                _ => {}
            }
            let sigma = if k % 11 == 0 { 0.04 } else { random.uniform(0.005, 0.042) };
            let opacity = if k % 7 == 0 { 0.02_f32 } else { random.uniform(0.015, 0.9) };
            Gaussian {
                mean,
                log_scales: Vec3::new(sigma.ln(), -5.0, -6.0),
                rotation: if k % 97 == 0 { Quat::from_xyzw(0.0, 0.0, 0.0, 0.0) } else { Quat::IDENTITY },
                opacity_logit: if k % 89 == 0 { f32::NAN } else { (opacity / (1.0 - opacity)).ln() },
                sh: [0.1, 0.2, if k % 83 == 0 { f32::INFINITY } else { 0.3 }],
                id: k as u64,
                birth_round: 0,
            }
        })
        .collect();
    (model, cameras, images)
}

#[test]
fn both_back_ends_prune_the_same_gaussians() {
    with_engine("both_back_ends_prune_the_same_gaussians", |engine| {
        let (model, cameras, images) = about_a_wall(6000, 3);
        let views: Vec<DepthView<'_>> = cameras
            .iter()
            .zip(&images)
            .zip(0..)
            .map(|((camera, depth_m), id)| DepthView { id, camera, depth_m })
            .collect();
        engine.upload(&model, &mut Optimiser::new(), &mut ScreenStatistics::new()).unwrap();
        let of_random = |k: &usize| k % 6 > 2 && [7, 11, 97].iter().all(|by| !k.is_multiple_of(*by));
        let random_ones = (0..model.len()).filter(of_random).count();
        for (views, rules) in [
            (&views[..], rules()),
            (&views[1..], rules()),
            (&views[..], PruneRules { front_views: 1, ..rules() }),
            (&views[..], PruneRules { front_views: 0, ..rules() }),
            (&[], rules()),
        ] {
            let expected = prune::keep(&model, views, &rules);
            let found = engine.keep(views, &rules).unwrap();
            let apart = expected.iter().zip(&found).filter(|(a, b)| a != b).count();
            assert_eq!((apart, found.len()), (0, model.len()));
            assert!(expected.contains(&true) && expected.contains(&false));
            // The host is asked about what lies at a cut, and about little else.
            let asked = engine.verdicts(views, &rules).unwrap();
            let asked = (0..model.len()).filter(|k| of_random(k) && asked[*k] == ASK).count();
            assert!(100 * asked < random_ones, "{asked} of {random_ones}");
        }
        // An image that is too short has no measurements at its end; another camera's ray points up.
        let short = [DepthView { id: 9, depth_m: &images[0][..1500], ..views[0] }, views[2]];
        assert_eq!(engine.keep(&short, &rules()).unwrap(), prune::keep(&model, &short, &rules()));
        let away = Camera { world_from_camera: Pose { rotation: Quat::IDENTITY, ..Pose::IDENTITY }, ..cameras[0] };
        let away = [DepthView { id: 10, camera: &away, ..views[0] }, views[1]];
        let rules = PruneRules { front_views: 1, ..rules() };
        assert_eq!(engine.keep(&away, &rules).unwrap(), prune::keep(&model, &away, &rules));
    });
}

/// What changes of the list move, against what it would take to have the model here and back.
#[test]
fn changes_move_few_bytes_of_the_model() {
    with_engine("changes_move_few_bytes_of_the_model", |engine| {
        for (degree, most) in [(0, 0.35), (3, 0.10)] {
            let mut lists = trained(2000, 5);
            lists.0.set_sh_degree(degree);
            lists.1.fit(&lists.0);
            let (mut model, mut optimiser, mut statistics) = lists;
            let count = model.len() as f64;
            let spent = |engine: &mut Engine, work: &mut dyn FnMut(&mut Engine)| {
                let before = engine.traffic();
                work(engine);
                let after = engine.traffic();
                ((after.0 - before.0) as f64 / count, (after.1 - before.1) as f64 / count)
            };
            let up = spent(engine, &mut |engine| engine.upload(&model, &mut optimiser, &mut statistics).unwrap()).0;
            let (mut a, mut b, mut c) = (model.clone(), optimiser.clone(), statistics.clone());
            let down = spent(engine, &mut |engine| engine.download(&mut a, &mut b, &mut c).unwrap()).1;
            let edited = spent(engine, &mut |engine| {
                engine.look(Looks::Seen, &mut model, &mut statistics).unwrap();
                let mut draft = Draft::new(&mut model, &statistics);
                for k in 0..100 {
                    let gaussian = Gaussian { id: 10_000 + k as u64, ..draft.model().get(9 * k) };
                    draft.push_beside(&gaussian, 9 * k);
                }
                draft.retain(|index| index % 20 != 0);
                draft.sort_along_curve();
                let edit = draft.finish();
                engine.edit(&edit, &model).unwrap();
            });
            println!("degree {degree}: {up:.0} up and {down:.0} down before, {:.1} and {:.1} now", edited.0, edited.1);
            assert!(edited.0 + edited.1 < most * (up + down), "{edited:?} of {up} and {down}");
            // Four bytes of each of 1,995, 68 of each of 95 that are new.
            assert_eq!(edited, ((4.0 * 1995.0 + 68.0 * 95.0) / count, 68.0));
            let count = |bytes: f64| bytes / count;
            let looked =
                spent(engine, &mut |engine| engine.look(Looks::Parameters, &mut model, &mut statistics).unwrap());
            assert_eq!(looked, (0.0, count(896.0 * 125.0)));
            let lowered = Edit { logit_ceiling: Some(-3.0), forgets_statistics: true, ..Edit::default() };
            assert_eq!(spent(engine, &mut |engine| engine.edit(&lowered, &model).unwrap()), (0.0, 0.0));
            // A word for 16 Gaussians.
            let judged = spent(engine, &mut |engine| drop(engine.verdicts(&[], &rules()).unwrap()));
            assert_eq!(judged, (0.0, count(4.0 * 125.0)));
        }
    });
}
