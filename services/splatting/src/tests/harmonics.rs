//! Colours that depend on the direction: what is drawn, what moves, and what stays.

use glam::{Quat, Vec3};

use super::{Random, camera, isas, random_view, scene};
use crate::{Engine, Gaussian, Gaussians, Optimiser, RenderSettings, Rendered, SH_REST_MAX, TrainingSettings};

/// The scene with random higher bands.
pub fn scene_of_degree(count: usize, seed: u64, degree: u8) -> Gaussians {
    let mut model = scene(count, seed);
    model.set_sh_degree(degree);
    let mut random = Random(seed ^ 0x5eed);
    for i in 0..count {
        model.set_sh_rest(i, &std::array::from_fn(|_| random.vector(-0.4, 0.4).to_array()));
    }
    model
}

#[test]
fn one_splat_is_drawn_in_its_colour_from_there() {
    for degree in 0..=3 {
        let mut model = scene_of_degree(1, 90 + u64::from(degree), degree);
        let camera = camera(40, 30);
        let mean = camera.backproject(20.5, 15.5, 2.0);
        model.set(0, &Gaussian { mean, log_scales: Vec3::splat(-2.0), rotation: Quat::IDENTITY, ..model.get(0) });
        for highest in 0..=4 {
            let mut bounded = model.clone();
            bounded.set_sh_degree(degree.min(highest));
            let expected = bounded.color_from(0, camera.world_from_camera.translation);
            let settings = RenderSettings { sh_degree: highest, background: Vec3::ZERO, ..RenderSettings::default() };
            for isa in isas() {
                let mut rendered = Rendered::default();
                Engine::with_isa(1, isa).unwrap().render(&model, &camera, &settings, &mut rendered);
                let at = 15 * 40 + 20;
                for k in 0..3 {
                    let got = rendered.color[at][k] / rendered.alpha[at];
                    assert!((got - expected[k]).abs() < 2e-5, "{isa:?}, {degree}, {highest}: {got}, {expected:?}");
                }
            }
        }
    }
}

#[test]
fn bands_above_the_evaluated_degree_stay_and_the_others_move_by_their_learning_rate() {
    let view = random_view(camera(50, 40), 4);
    for highest in 0..=3 {
        let render = RenderSettings { sh_degree: highest, ..RenderSettings::default() };
        let settings = TrainingSettings { render, lr_sh_rest: 1e-3, ..TrainingSettings::default() };
        for isa in isas() {
            let mut model = scene_of_degree(60, 3, 3);
            let before = model.clone();
            let mut engine = Engine::with_isa(1, isa).unwrap();
            let mut optimiser = Optimiser::new();
            let (_, gradient) = engine.gradient(&model, &view, &settings);
            engine.train_step(&mut model, &mut optimiser, &view, &settings);
            let active = crate::sh_rest_coefficients(highest);
            let mut moved = 0;
            for i in 0..60 {
                let (old, new) = (before.sh_rest(i), model.sh_rest(i));
                for k in 0..SH_REST_MAX {
                    for channel in 0..3 {
                        let (change, slope) = (new[k][channel] - old[k][channel], gradient.sh_rest[i][k][channel]);
                        if k >= active {
                            assert_eq!((change, slope), (0.0, 0.0));
                        } else if slope.abs() > 1e-8 {
                            assert!((change + 1e-3 * slope.signum()).abs() < 2e-6, "{isa:?}: {change} for {slope}");
                            moved += 1;
                        }
                    }
                }
            }
            assert!(moved >= 60 * active, "{isa:?}, degree {highest}: {moved} coefficients moved");
        }
    }
}

#[test]
fn what_a_gaussian_out_of_sight_does_not_depend_on_its_neighbours_in_memory() {
    let view = random_view(camera(50, 40), 4);
    // With this weight every Gaussian takes steps, drawn or not.
    let settings = TrainingSettings { opacity_weight: 0.01, ..TrainingSettings::default() };
    let trained = |place: usize| {
        let mut model = scene_of_degree(17, 3, 1);
        let mut order: Vec<u32> = (0..17).collect();
        order.swap(place, 16);
        model.permute(&order);
        let (mut engine, mut optimiser) = (Engine::new(1).unwrap(), Optimiser::new());
        engine.train_step(&mut model, &mut optimiser, &view, &settings);
        let before = model.sh_rest(place);
        model.set(place, &Gaussian { mean: Vec3::new(30.0, 0.0, 0.0), ..model.get(place) });
        engine.train_step(&mut model, &mut optimiser, &view, &settings);
        assert_eq!(optimiser.steps(place), 2);
        (before, model.sh_rest(place))
    };
    let (alone, among_others) = (trained(16), trained(3));
    assert_eq!(alone, among_others);
    assert_ne!(alone.0, alone.1, "its moments move it on");
}
