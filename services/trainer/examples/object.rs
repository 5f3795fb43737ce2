//! Trains on ideal views of a mesh, round by round as in a mission, and prints PSNR on views that were never trained on,
//! in the object's mask. The figures behind the default training values come from here.
//!
//! `cargo run --release -p trainer --example object -- MESH [tenth|flat|full] [key=value of the trainer's section]...`

use std::collections::BTreeMap;
use std::time::Instant;

use anyhow::{Context as _, bail};
use glam::DVec3;
use shared_types::config::{ModelConfig, TrainerConfig};
use shared_types::folder::{Exposure, FolderError, Frame, Gate, Keyframe};
use shared_types::frames::{Intrinsics, Pose, look_at};
use shared_types::messages::{KeyframeReason, RoundRequest};
use splatting::{Camera, Engine, RenderSettings, Rendered, metrics};
use trainer::keyframes::{KeyframeSource, renderer_camera};
use trainer::logic::rounds::paper_iterations;
use trainer::round::RoundSpec;
use trainer::session::Session;
use world::render::{RenderOptions, Threads, render};
use world::truth::{HeldOutRules, held_out_views, spiral_directions};
use world::{Scene, SceneConfig};

const VIEWS: usize = 48;
const HELD_OUT: usize = 40;
const BATCH: usize = 4;
const DEPTH_UNIT_M: f32 = 0.0005;
const HFOV_RAD: f64 = 1.204;

struct Memory(BTreeMap<u64, Keyframe>);

impl KeyframeSource for Memory {
    fn read(&mut self, id: u64) -> Result<Option<Keyframe>, FolderError> {
        Ok(self.0.get(&id).cloned())
    }
}

struct Truth {
    camera: Camera,
    color: Vec<[f32; 3]>,
    mask: Vec<bool>,
    near: bool,
}

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let object = arguments.next().context("expected the path of a mesh, or `rock`")?;
    let length = arguments.next().unwrap_or_else(|| "flat".to_owned());
    let mut config = TrainerConfig::default();
    for setting in arguments {
        if setting == "paper" {
            config = TrainerConfig::paper();
            continue;
        }
        let mut table = toml::Table::try_from(&config)?;
        table.extend(setting.parse::<toml::Table>()?);
        config = table.try_into()?;
    }
    if let Some(problem) = config.validate().first() {
        bail!("{problem}");
    }

    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let threads = Threads::new(cores);
    let scene = Scene::new(&SceneConfig { object, ..SceneConfig::default() }, &threads)?;
    let (low, high) = scene.mesh().bounds();
    let (low, high) = (low.as_dvec3(), high.as_dvec3());
    let center = (low + high) / 2.0;
    let box_size_m = (high - low).max_element() + 0.5;
    let radius_m = box_size_m + 0.5;

    let directions = spread(spiral_directions(VIEWS, 5f64.to_radians().sin()));
    let full = Intrinsics::from_hfov(640, 480, HFOV_RAD);
    let mut source = Memory(BTreeMap::new());
    for (id, direction) in (0..).zip(&directions) {
        let pose = look_at(center + *direction * radius_m, center);
        source.0.insert(id, keyframe(&scene, &threads, id, &pose, full));
    }
    let rules = HeldOutRules { count: HELD_OUT, ..HeldOutRules::default() };
    let truths: Vec<Truth> = held_out_views((low, high), radius_m, &directions, &rules)?
        .iter()
        .map(|view| truth(&scene, &threads, &view.world_from_camera, full.downsampled(2), view.near))
        .collect();
    println!("B {box_size_m:.2} m, R {radius_m:.2} m, null {:.2} dB", mean(&truths, false, null_psnr));

    let model = ModelConfig::default();
    let mut session = Session::new(config, model, Engine::new(cores)?);
    let (mut seconds, mut iterations) = (0.0, 0);
    for round in 0..(VIEWS / BATCH) as u32 {
        let views = (round + 1) * BATCH as u32;
        let cap = paper_iterations(views);
        let request = RoundRequest {
            round,
            max_iterations: if length == "tenth" { cap / 10 } else { cap },
            stop_when_flat: u32::from(length == "flat"),
            box_center_m: center.to_array(),
            box_size_m,
            radius_m,
            seed: 100 + u64::from(round),
            ..RoundRequest::default()
        };
        let ids: Vec<u64> = (0..u64::from(views)).collect();
        let spec = RoundSpec::from_request(&request, &ids).map_err(anyhow::Error::msg)?;
        let started = Instant::now();
        session.begin(spec, &mut source)?;
        let begun = started.elapsed().as_secs_f64();
        let untrained = psnr(&mut session, &truths);
        let started = Instant::now();
        while !session.advance(20, || ())? {}
        seconds += started.elapsed().as_secs_f64();
        session.finish()?;
        let progress = session.progress();
        iterations += progress.iterations;
        let trained = psnr(&mut session, &truths);
        println!(
            "round {round:2}: {views:2} views, {:6} Gaussians, {:4} iterations, inserted {:.2} / {:.2} dB, trained {:.2} / {:.2} dB, \
             training views {:.2} dB, loss {:.4}, begin {begun:.2} s",
            progress.gaussians,
            progress.iterations,
            untrained.0,
            untrained.1,
            trained.0,
            trained.1,
            progress.psnr_train_db,
            progress.loss,
        );
    }
    println!("{iterations} iterations in {seconds:.1} s: {:.1} it/s", f64::from(iterations) / seconds);

    let mut untrained = Session::new(session.config().clone(), ModelConfig::default(), Engine::new(cores)?);
    let request = RoundRequest { box_center_m: center.to_array(), box_size_m, radius_m, ..RoundRequest::default() };
    let ids: Vec<u64> = (0..VIEWS as u64).collect();
    untrained.begin(RoundSpec::from_request(&request, &ids).map_err(anyhow::Error::msg)?, &mut source)?;
    let init = psnr(&mut untrained, &truths);
    println!(
        "all {VIEWS} views inserted, untrained: {:.2} / {:.2} dB, {} Gaussians",
        init.0,
        init.1,
        untrained.model().len()
    );
    Ok(())
}

/// Reorders directions so that each is as far as can be from those before it.
fn spread(mut directions: Vec<DVec3>) -> Vec<DVec3> {
    let mut ordered = vec![directions.swap_remove(directions.len() / 2)];
    while !directions.is_empty() {
        let nearest = |d: &DVec3| ordered.iter().map(|o| o.dot(*d)).fold(f64::NEG_INFINITY, f64::max);
        let next = (0..directions.len()).min_by(|&a, &b| nearest(&directions[a]).total_cmp(&nearest(&directions[b])));
        ordered.extend(next.map(|next| directions.remove(next)));
    }
    ordered
}

fn keyframe(scene: &Scene, threads: &Threads, id: u64, pose: &Pose, intrinsics: Intrinsics) -> Keyframe {
    let image = render(scene, pose, &intrinsics, &RenderOptions::default(), threads);
    let frame = Frame {
        id,
        stamp_ns: id,
        reason: KeyframeReason::Selected,
        candidate: None,
        target_id: 0,
        look_at_m: [0.0; 3],
        world_from_camera_position_m: pose.position_m.to_array(),
        world_from_camera_xyzw: pose.rotation.to_array(),
        intrinsics,
        depth_unit_m: f64::from(DEPTH_UNIT_M),
        gate: Gate::default(),
        exposure: Exposure::default(),
    };
    Keyframe { frame, depth_units: image.depth_u16(DEPTH_UNIT_M), rgb: image.rgb }
}

fn truth(scene: &Scene, threads: &Threads, pose: &Pose, intrinsics: Intrinsics, near: bool) -> Truth {
    let options = RenderOptions { samples_per_edge: 4, ..RenderOptions::default() };
    let image = render(scene, pose, &intrinsics, &options, threads);
    Truth {
        camera: renderer_camera(pose, &intrinsics),
        color: image.rgb.chunks_exact(3).map(|c| [c[0], c[1], c[2]].map(|v| f32::from(v) / 255.0)).collect(),
        mask: image.object.iter().map(|&hit| hit == 1).collect(),
        near,
    }
}

/// PSNR of held-out views at R and at the near radius, dB.
fn psnr(session: &mut Session, truths: &[Truth]) -> (f64, f64) {
    let (backend, model) = session.backend_and_model();
    let mut image = Rendered::default();
    let mut of = |truth: &Truth| {
        if backend.render(model, &truth.camera, &RenderSettings::default(), &mut image).is_err() {
            return f64::NAN;
        }
        metrics::psnr(&image.color, &truth.color, Some(&truth.mask)).unwrap_or(f64::NAN)
    };
    (mean(truths, false, &mut of), mean(truths, true, &mut of))
}

fn null_psnr(truth: &Truth) -> f64 {
    let object: Vec<[f32; 3]> = truth.color.iter().zip(&truth.mask).filter(|(_, hit)| **hit).map(|(c, _)| *c).collect();
    let average = [0, 1, 2].map(|k| object.iter().map(|c| c[k]).sum::<f32>() / object.len().max(1) as f32);
    metrics::psnr(&vec![average; truth.color.len()], &truth.color, Some(&truth.mask)).unwrap_or(f64::NAN)
}

fn mean(truths: &[Truth], near: bool, of: impl FnMut(&Truth) -> f64) -> f64 {
    let values: Vec<f64> = truths.iter().filter(|truth| truth.near == near).map(of).collect();
    values.iter().sum::<f64>() / values.len().max(1) as f64
}
