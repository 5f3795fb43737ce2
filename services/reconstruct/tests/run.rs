//! Whole runs on a small rendered scene: they learn, they repeat bit for bit, they go on after being cut off.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

use std::fs;
use std::ops::ControlFlow;
use std::path::Path;
use std::time::Duration;

use glam::{Quat, Vec3};
use reconstruct::{Event, Options, Outcome, ReconstructError, StrategyName};
use splatting::order::Random;
use splatting::{BackendKind, Camera, Engine, Gaussian, Gaussians, Pose, RenderSettings, Rendered};

const SIZE: (u32, u32) = (48, 40);
const VIEWS: u32 = 17;

/// A ball of coloured Gaussians.
fn truth() -> Gaussians {
    let mut random = Random::new(5);
    let mut uniform = || f64::from(random.below(1 << 20)) as f32 / (1 << 20) as f32;
    (0..400)
        .map(|id| {
            let direction = Vec3::new(uniform() - 0.5, uniform() - 0.5, uniform() - 0.5).normalize_or_zero();
            Gaussian {
                mean: 0.5 * direction,
                log_scales: Vec3::splat(0.05f32.ln()),
                rotation: Quat::IDENTITY,
                opacity_logit: 2.0,
                sh: Gaussian::sh_from_color([uniform(), 0.5 + 0.5 * direction.x, 0.5 + 0.5 * direction.z]),
                id,
                birth_round: 0,
            }
        })
        .collect()
}

/// The scene as a COLMAP dataset in text, with every fourth Gaussian as a sparse point.
fn scene(root: &Path) {
    let model = truth();
    let mut engine = Engine::new(1).expect("engine");
    let mut rendered = Rendered::default();
    let settings = RenderSettings { background: Vec3::ZERO, ..RenderSettings::default() };
    fs::create_dir_all(root.join("images")).expect("folder");
    fs::create_dir_all(root.join("sparse/0")).expect("folder");
    let mut images = String::new();
    for id in 0..VIEWS {
        let angle = id as f32 * 2.4;
        let eye = Vec3::new(2.0 * angle.cos(), 2.0 * angle.sin(), (id % 5) as f32 * 0.4 - 0.6);
        let camera = Camera::from_hfov(Pose::IDENTITY, 0.7, SIZE.0, SIZE.1).look_at(eye, Vec3::ZERO, Vec3::Z);
        engine.render(&model, &camera, &settings, &mut rendered);
        let bytes = rendered.color.iter().flatten().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect();
        let image = image::RgbImage::from_raw(SIZE.0, SIZE.1, bytes).expect("size");
        image.save(root.join(format!("images/{id:03}.png"))).expect("saved");
        let pose = camera.world_from_camera.inverse();
        let (q, t) = (pose.rotation, pose.translation);
        images += &format!("{id} {} {} {} {} {} {} {} 1 {id:03}.png\n\n", q.w, q.x, q.y, q.z, t.x, t.y, t.z);
    }
    let focal = Camera::from_hfov(Pose::IDENTITY, 0.7, SIZE.0, SIZE.1).fx;
    let (w, h) = SIZE;
    let cameras = format!("1 SIMPLE_PINHOLE {w} {h} {focal} {} {}\n", w / 2, h / 2);
    let points: String = model
        .iter()
        .step_by(4)
        .map(|g| {
            let [r, g_, b] = g.color().map(|c| (c.clamp(0.0, 1.0) * 255.0) as u8);
            format!("{} {} {} {} {r} {g_} {b} 0\n", g.id, g.mean.x, g.mean.y, g.mean.z)
        })
        .collect();
    for (name, text) in [("cameras", cameras), ("images", images), ("points3D", points)] {
        fs::write(root.join(format!("sparse/0/{name}.txt")), text).expect("written");
    }
}

fn options(root: &Path, out: &str) -> Options {
    Options {
        out: root.join(out),
        iterations: 700,
        eval_every: 300,
        max_gaussians: 3000,
        sh_degree: 1,
        threads: 1,
        backend: BackendKind::Cpu,
        ..Options::new(root)
    }
}

fn finish(options: &Options) -> reconstruct::report::Report {
    match reconstruct::run(options, &mut |_: &Event| ControlFlow::Continue(())).expect("runs") {
        Outcome::Finished { report, .. } => *report,
        stopped @ Outcome::Stopped { .. } => panic!("{stopped:?}"),
    }
}

fn refused(options: &Options) -> ReconstructError {
    reconstruct::run(options, &mut |_: &Event| ControlFlow::Continue(())).expect_err("refused")
}

/// Runs until an event is what `is_enough` waits for.
fn cut_off(options: &Options, is_enough: impl Fn(&Event) -> bool) -> Outcome {
    let mut observer =
        |event: &Event| if is_enough(event) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
    reconstruct::run(options, &mut observer).expect("runs")
}

fn model(options: &Options) -> Vec<u8> {
    fs::read(options.out.join("model.ply")).expect("model.ply")
}

#[test]
fn a_run_learns_the_scene_and_leaves_its_figures() {
    let dir = tempfile::tempdir().expect("folder");
    scene(dir.path());
    let options = options(dir.path(), "out");
    let report = finish(&options);
    let [first, .., last] = &report.evaluations[..] else { panic!("{report:#?}") };
    assert_eq!((first.iteration, last.iteration), (0, 700));
    let gained = last.held_out_psnr_db.expect("held out") - first.held_out_psnr_db.expect("held out");
    assert!(gained > 5.0 && last.held_out_psnr_db > Some(22.0), "{report:#?}");
    assert!(last.held_out_ssim > first.held_out_ssim, "{report:#?}");
    assert_eq!((report.run.training, report.run.held_out), (14, 3));
    assert!(report.gaussians > 100, "densification added some: {}", report.gaussians);
    let csv = fs::read_to_string(options.out.join("metrics.csv")).expect("csv");
    assert_eq!(csv.lines().count(), 1 + report.evaluations.len());
    let json: serde_json::Value =
        serde_json::from_slice(&fs::read(options.out.join("metrics.json")).expect("json")).expect("JSON");
    assert_eq!(json["run"]["strategy"], "default");
    assert_eq!(splatting::ply::read(&model(&options)).expect("PLY").len(), report.gaussians);
    for picture in ["curve.png", "held-out.png"] {
        assert!(image::open(options.out.join(picture)).expect("a picture").width() > 90, "{picture}");
    }
    assert!(matches!(refused(&options), ReconstructError::Finished { .. }), "a finished run is not overwritten");
    let found = reconstruct::finished(&options).expect("read").expect("over");
    assert_eq!((found.run, found.gaussians), (report.run, report.gaussians));
    let other = Options { seed: 1, ..options.clone() };
    assert_eq!(reconstruct::finished(&other).expect("read"), None, "another run's");
    let absent = Options { out: dir.path().join("absent"), ..options };
    assert_eq!(reconstruct::finished(&absent).expect("read"), None);
    assert!(!absent.out.exists());
}

#[test]
fn any_number_of_threads_gives_the_same_bits_and_another_seed_others() {
    let dir = tempfile::tempdir().expect("folder");
    scene(dir.path());
    let one = options(dir.path(), "one");
    let three = Options { threads: 3, memory_bytes: Some(200_000), ..options(dir.path(), "three") };
    let other = Options { seed: 1, ..options(dir.path(), "other") };
    for options in [&one, &three, &other] {
        finish(options);
    }
    assert!(model(&one) == model(&three), "three threads, and views made anew for want of memory");
    assert!(model(&one) != model(&other), "another seed");
}

#[test]
fn a_run_that_was_cut_off_goes_on_with_the_same_bits() {
    for strategy in [StrategyName::Default, StrategyName::Mcmc, StrategyName::None] {
        let dir = tempfile::tempdir().expect("folder");
        scene(dir.path());
        let with = |out| Options { strategy: Some(strategy), ..options(dir.path(), out) };
        let unbroken = with("unbroken");
        let whole = finish(&unbroken);
        let broken = Options { checkpoint_period: Duration::ZERO, ..with("broken") };
        let stopped = cut_off(&broken, |event| matches!(event, Event::Evaluated(row) if row.iteration == 600));
        assert!(matches!(stopped, Outcome::Stopped { iteration: 600, .. }), "{stopped:?}");
        // The newest checkpoint is rotten: the one before it, one iteration earlier, takes its place.
        let newest = broken.out.join("checkpoint-000000600.ckpt");
        let mut bytes = fs::read(&newest).expect("newest");
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        fs::write(&newest, bytes).expect("damaged");
        let mut resumed_at = None;
        let outcome = reconstruct::run(&broken, &mut |event: &Event| {
            if let Event::Resumed { iteration } = event {
                resumed_at = Some(*iteration);
            }
            ControlFlow::Continue(())
        });
        assert_eq!(resumed_at, Some(599));
        let Outcome::Finished { report, .. } = outcome.expect("finishes") else { panic!("stopped") };
        assert!(model(&broken) == model(&unbroken), "{strategy:?}");
        let figures = |report: &reconstruct::report::Report| -> Vec<_> {
            report.evaluations.iter().map(|row| (row.iteration, row.gaussians, row.held_out_psnr_db)).collect()
        };
        assert_eq!(figures(&report), figures(&whole));
        assert!(
            !fs::read_dir(&broken.out)
                .expect("out")
                .any(|entry| { entry.expect("entry").file_name().to_string_lossy().ends_with(".ckpt") })
        );
    }
}

#[test]
fn a_folder_with_another_run_is_not_gone_on_with() {
    let dir = tempfile::tempdir().expect("folder");
    scene(dir.path());
    let options = options(dir.path(), "out");
    cut_off(&options, |event| matches!(event, Event::Evaluated(row) if row.iteration == 300));
    let other = Options { iterations: 800, ..options.clone() };
    let message = refused(&other).to_string();
    assert!(message.contains("another --iterations (700 there, 800 now)"), "{message}");
    // Another image under the same name.
    let changed = image::RgbImage::new(SIZE.0, SIZE.1);
    changed.save(dir.path().join("images/003.png")).expect("saved");
    let message = refused(&options).to_string();
    assert!(message.contains("another content of the dataset"), "{message}");
    let report = finish(&Options { overwrite: true, iterations: 20, ..options });
    assert_eq!(report.evaluations.first().map(|row| row.iteration), Some(0), "begun anew");
}

#[test]
fn checkpoints_of_a_damaged_run_are_not_thrown_away_unasked() {
    let dir = tempfile::tempdir().expect("folder");
    scene(dir.path());
    let options = Options { iterations: 40, ..options(dir.path(), "out") };
    cut_off(&options, |event| matches!(event, Event::Began { .. }));
    let checkpoint = options.out.join("checkpoint-000000000.ckpt");
    for damaged in ["", "{"] {
        fs::write(options.out.join("run.json"), damaged).expect("damaged");
        let message = refused(&options).to_string();
        assert!(message.contains("run.json is damaged") && message.contains("--overwrite"), "{message}");
        assert!(checkpoint.exists());
    }
    finish(&Options { overwrite: true, ..options });
}

#[test]
fn without_points_training_begins_at_random_and_without_held_out_images_nothing_is_measured() {
    let dir = tempfile::tempdir().expect("folder");
    scene(dir.path());
    fs::remove_file(dir.path().join("sparse/0/points3D.txt")).expect("removed");
    let report = finish(&Options { hold_out: 0, iterations: 50, max_gaussians: 500, ..options(dir.path(), "out") });
    assert_eq!(report.origin, "random points");
    assert!(report.evaluations.iter().all(|row| row.held_out_psnr_db.is_none()));
    let last = report.last().expect("a row");
    assert!(last.train_psnr_db.is_some());
}

#[test]
fn points_of_another_scene_and_masks_that_leave_nothing_are_named() {
    let dir = tempfile::tempdir().expect("folder");
    scene(dir.path());
    let options = options(dir.path(), "out");
    fs::create_dir_all(dir.path().join("masks")).expect("folder");
    for id in 0..VIEWS {
        let mask = dir.path().join(format!("masks/{id:03}.png.png"));
        image::GrayImage::new(SIZE.0, SIZE.1).save(mask).expect("saved");
    }
    let error = refused(&options);
    let message = error.to_string();
    assert!(message.contains("001.png.png is a mask") && message.contains("--mask off"), "{message}");
    assert_eq!(error.kind(), reconstruct::ErrorKind::Usage);
    let points: String = (0..9).map(|id| format!("{id} {} 0 {} 9 9 9 0\n", 5000 + id, id % 3)).collect();
    fs::write(dir.path().join("sparse/0/points3D.txt"), points).expect("written");
    let error = refused(&Options { mask: reconstruct::MaskUse::Off, ..options });
    assert!(error.to_string().contains("do not belong together"), "{error}");
    assert_eq!(error.kind(), reconstruct::ErrorKind::Usage);
}

#[test]
fn an_output_that_cannot_be_written_and_one_in_use_are_named() {
    let dir = tempfile::tempdir().expect("folder");
    scene(dir.path());
    fs::write(dir.path().join("file"), "mine").expect("written");
    let message = refused(&options(dir.path(), "file/out")).to_string();
    assert!(message.contains("file/out") && message.contains("--out"), "{message}");
    let options = options(dir.path(), "out");
    let mut busy = None;
    cut_off(&options, |event| matches!(event, Event::Began { .. }));
    let mut observer = |event: &Event| {
        if busy.is_none() && matches!(event, Event::Resumed { .. }) {
            busy = Some(refused(&options).to_string());
        }
        ControlFlow::Break(())
    };
    reconstruct::run(&options, &mut observer).expect("stops");
    assert!(busy.as_ref().is_some_and(|message| message.contains("another reconstruction runs")), "{busy:?}");
}

/// A run that was begun on the CPU goes on on a GPU, and is worth as much as on the CPU alone.
#[test]
fn a_run_changes_its_back_end() {
    let Some(adapter) = splatting::gpu::adapters().into_iter().next() else {
        assert!(std::env::var_os("VANTAGE_EXPECT_GPU").is_none(), "no GPU adapter, but one was expected");
        println!("a_run_changes_its_back_end: skipped, no GPU adapter");
        return;
    };
    for strategy in [StrategyName::Default, StrategyName::Mcmc] {
        let dir = tempfile::tempdir().expect("folder");
        scene(dir.path());
        let with = |out| Options { strategy: Some(strategy), ..options(dir.path(), out) };
        let whole = finish(&with("whole"));
        let begun = with("changed");
        cut_off(&begun, |event| matches!(event, Event::Evaluated(row) if row.iteration == 300));
        let changed = Options { backend: BackendKind::Gpu, adapter: Some(adapter.name.clone()), ..begun };
        let report = finish(&changed);
        let [first, second] = &report.backends[..] else { panic!("{:?}", report.backends) };
        assert!(first.starts_with("cpu-") && second.contains(&adapter.name), "{:?}", report.backends);
        let psnr = |report: &reconstruct::report::Report| {
            report.last().and_then(|row| row.held_out_psnr_db).expect("held out")
        };
        assert!((psnr(&whole) - psnr(&report)).abs() < 1.0, "{} dB and {} dB", psnr(&whole), psnr(&report));
    }
    let missing = Options { adapter: Some("No Such GPU 9000".to_owned()), ..options(Path::new("nowhere"), "out") };
    let dir = tempfile::tempdir().expect("folder");
    scene(dir.path());
    let message = refused(&Options {
        folder: dir.path().to_owned(),
        out: dir.path().join("out"),
        backend: BackendKind::Gpu,
        ..missing
    });
    let message = message.to_string();
    assert!(message.contains("No Such GPU 9000") && message.contains(&adapter.name), "{message}");
}

/// A loss of power at any place of a run: what it then finds in its folder is its own, and it goes on from the newest whole
/// checkpoint to the same model.
#[test]
fn a_run_whose_power_was_cut_goes_on_to_the_same_bits() {
    use reconstruct::output::Output;
    use shared_types::storage;
    use shared_types::storage::record::Recorder;
    use shared_types::storage::replay::every_outcome;

    let dir = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
    scene(dir.path());
    let broken = Options {
        iterations: 2,
        eval_every: 2,
        max_gaussians: 150,
        checkpoint_period: Duration::ZERO,
        ..options(dir.path(), "broken")
    };
    let disk = dir.path().join("broken");
    fs::create_dir(&disk).expect("folder");
    let recorder = Recorder::new(&disk).expect("read");
    let mount = storage::mount(&disk, std::sync::Arc::new(recorder.clone()));
    finish(&broken);
    drop(mount);
    let whole = model(&broken);
    fs::remove_dir_all(&disk).expect("removed");
    let (mut shown, mut completed) = (0_usize, 0);
    let findings = every_outcome(&recorder.trace(), &disk, |_| {
        shown += 1;
        let text = |error: ReconstructError| error.to_string();
        if disk.join("metrics.json").exists() {
            return match reconstruct::finished(&broken).map_err(text)? {
                Some(report) if report.gaussians > 0 && model(&broken) == whole => Ok("finished"),
                other => Err(format!("finished, and not: {other:?}")),
            };
        }
        // All are looked at as a run does that begins; some are gone on with to the end.
        let output = Output::open(&disk).map_err(text)?;
        let state = match output.identity().map_err(text)? {
            Some(identity) => output.admit(&identity, false).map_err(text)?,
            None => None,
        };
        drop(output);
        if shown.is_multiple_of(5003) {
            completed += 1;
            finish(&broken);
            if model(&broken) != whole {
                return Err("another model".to_owned());
            }
        }
        Ok(if state.is_some() { "resumed" } else { "begun anew" })
    });
    let findings = findings.unwrap_or_else(|why| panic!("{why}"));
    println!(
        "a run's folder: {} cuts, {} outcomes: {:?}; {completed} completed",
        findings.places, findings.distinct, findings.by_name
    );
    assert_eq!(findings.by_name.len(), 3, "{findings:?}");
    assert!(completed > 3, "{completed}");
}
