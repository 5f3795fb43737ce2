//! Milliseconds per stage of a training iteration, a render and a scoring pass, on a synthetic scene.
//!
//! `cargo bench -p splatting --bench engine -- [thousands of Gaussians ...]`; 50, 100 and 200 without arguments. Figures
//! are the least and the median of 40 repetitions. On a busy machine only processor time says something.

use std::hint::black_box;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use glam::{Quat, Vec3};
use splatting::{
    Camera, Engine, Gaussian, Gaussians, Moments, MomentsView, Optimiser, PixelClass, Pose, RenderSettings, Rendered,
    TrainingSettings, TrainingView,
};

const REPETITIONS: usize = 40;

/// A bumpy sphere of radius 0.75 m covered by discs about as far apart as they are wide, in Morton order.
fn scene(count: usize) -> Gaussians {
    let spacing = 0.75 * (4.0 * std::f32::consts::PI / count as f32).sqrt();
    let mut state = 0x1234_5678_u64;
    let mut random = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1_u64 << 24) as f32
    };
    let golden = std::f32::consts::PI * (3.0 - 5.0_f32.sqrt());
    let mut model: Gaussians = (0..count)
        .map(|i| {
            let z = 1.0 - 2.0 * (i as f32 + 0.5) / count as f32;
            let angle = golden * i as f32;
            let normal = Vec3::new((1.0 - z * z).sqrt() * angle.cos(), (1.0 - z * z).sqrt() * angle.sin(), z);
            let bump = 0.05 * ((8.0 * normal.x).sin() + (9.0 * normal.y).sin() + (7.0 * normal.z).cos());
            let opacity: f32 = random() + random() + random() - 1.5;
            Gaussian {
                mean: normal * (0.75 + bump),
                log_scales: Vec3::splat((spacing * (0.7 + 0.6 * random())).ln()),
                rotation: Quat::from_rotation_arc(Vec3::Z, normal),
                opacity_logit: 1.0 + 2.0 * opacity,
                sh: Gaussian::sh_from_color([random(), random(), random()]),
                id: i as u64,
                birth_round: 0,
            }
        })
        .collect();
    let order = model.morton_order();
    model.permute(&order);
    model
}

fn camera(index: usize, of: usize) -> Camera {
    let angle = index as f32 / of as f32 * std::f32::consts::TAU;
    let eye = 2.0 * Vec3::new(angle.cos() * 0.9, angle.sin() * 0.9, 0.436);
    Camera::from_hfov(Pose::IDENTITY, 1.204, 320, 240).look_at(eye, Vec3::ZERO, Vec3::Z)
}

/// Processor time of this process, all threads, milliseconds.
fn cpu_ms() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 * 1e-6
}

/// Least and median, of wall and processor time.
type Times = [f64; 4];

/// Times `f` in milliseconds.
fn time(mut f: impl FnMut()) -> Times {
    f();
    let (mut wall, mut cpu) = (Vec::new(), Vec::new());
    for _ in 0..REPETITIONS {
        let (start, start_cpu) = (Instant::now(), cpu_ms());
        f();
        cpu.push(cpu_ms() - start_cpu);
        wall.push(start.elapsed().as_secs_f64() * 1e3);
    }
    wall.sort_by(f64::total_cmp);
    cpu.sort_by(f64::total_cmp);
    [wall[0], wall[REPETITIONS / 2], cpu[0], cpu[REPETITIONS / 2]]
}

fn row(name: &str, times: &[f64]) {
    print!("  {name:<34}");
    times.iter().for_each(|t| print!(" {t:8.2}"));
    println!();
}

fn bench(count: usize, threads: usize) {
    let mut engine = match Engine::new(threads) {
        Ok(engine) => engine,
        Err(error) => return eprintln!("{error}"),
    };
    println!(
        "{count} Gaussians, {threads} threads, {:?}; ms: least and median wall, then processor time",
        engine.isa()
    );
    let mut model = scene(count);
    let settings = RenderSettings::default();
    let view_camera = camera(0, 1);
    let mut rendered = Rendered::default();
    row("render (colour, depth, alpha)", &time(|| engine.render(&model, &view_camera, &settings, &mut rendered)));
    let mut moments = Moments::default();
    row("moments", &time(|| engine.moments(&model, &view_camera, &settings, 2.0, &mut moments)));
    let class: Vec<PixelClass> =
        rendered.alpha.iter().map(|&a| if a > 0.5 { PixelClass::Foreground } else { PixelClass::Free }).collect();
    let target: Vec<[f32; 3]> = rendered.color.iter().map(|c| c.map(|v| v * 0.9 + 0.05)).collect();
    let view = match TrainingView::new(view_camera, &target, &rendered.depth, &class) {
        Ok(view) => view,
        Err(error) => return eprintln!("{error}"),
    };
    // Learning rates that leave the scene as it is, so that every repetition does the same work.
    let still = TrainingSettings {
        lr_means: 1e-9,
        lr_log_scales: 1e-9,
        lr_rotations: 1e-9,
        lr_opacity: 1e-9,
        lr_sh: 1e-9,
        ..TrainingSettings::default()
    };
    let mut optimiser = Optimiser::new();
    let mut stages = Vec::new();
    let total = time(|| {
        black_box(engine.train_step(&mut model, &mut optimiser, &view, &still));
        stages.push(engine.stage_times());
    });
    for (stage, name) in
        ["project", "sort", "bin", "blend", "loss", "backward blend", "backward project + Adam"].iter().enumerate()
    {
        let mut times: Vec<f64> = stages.iter().map(|s| s[stage].as_secs_f64() * 1e3).collect();
        times.sort_by(f64::total_cmp);
        row(&format!("  {name}"), &[times[0], times[times.len() / 2]]);
    }
    row("training iteration", &total);
    let views: Vec<MomentsView> = (0..95).map(|i| MomentsView { camera: camera(i, 95), reference_m: 2.0 }).collect();
    let (start, start_cpu) = (Instant::now(), cpu_ms());
    let cancel = AtomicBool::new(false);
    let result = engine.moments_batch(&model, &views, &settings, &cancel, |_, m| {
        black_box(m);
    });
    if let Err(error) = result {
        eprintln!("{error}");
    }
    let cpu = cpu_ms() - start_cpu;
    row("95 views' moments, wall and processor", &[start.elapsed().as_secs_f64() * 1e3, cpu]);
}

fn main() {
    let counts: Vec<usize> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let counts = if counts.is_empty() { vec![50, 100, 200] } else { counts };
    for thousands in counts {
        for threads in [1, 2] {
            bench(1000 * thousands, threads);
        }
    }
}
