//! Training end to end, without IPC: quality on views that were not trained on, determinism, checkpoints.

use crate::common::*;
use shared_types::config::{Config, TrainerConfig};
use shared_types::folder::MissionFolder;
use splatting::{Backend, BackendKind, BackendOptions};
use trainer::checkpoint;
use trainer::keyframes::KeyframeError;
use trainer::session::{Session, SessionError};
use trainer::untrained::untrained;

/// Runs a round in slices of 20.
fn train(session: &mut Session) -> u32 {
    while !session.advance(20, || ()).unwrap() {}
    let finished = session.finish().unwrap().unwrap();
    finished.progress.iterations
}

#[test]
fn training_improves_views_that_it_never_saw() {
    let mut session = session(TrainerConfig::default(), 2);
    session.begin(spec(0, 300, &[0, 1, 2, 3, 4, 5, 6, 7]), &mut Memory::new((WIDTH, HEIGHT))).unwrap();
    let inserted = session.model().len();
    let before = held_out_psnr_db(&mut session);
    assert_eq!(train(&mut session), 300);
    let after = held_out_psnr_db(&mut session);
    println!("{inserted} Gaussians, held-out PSNR {before:.2} -> {after:.2} dB");
    assert!(inserted > 2_000 && inserted < 30_000, "{inserted}");
    assert!(after > before + 3.0, "held-out PSNR went from {before:.2} to {after:.2} dB");
    assert!(after > 28.0, "held-out PSNR is {after:.2} dB");
    assert!(session.progress().psnr_train_db > after - 1.0, "{:?}", session.progress());
    let snapshot = session.snapshot().unwrap();
    assert!(snapshot.is_final && snapshot.rows.len() == session.model().len());
    for row in &snapshot.rows {
        let length: f32 = row.rotation_xyzw.iter().map(|v| v * v).sum();
        assert!((length - 1.0).abs() < 1e-4);
        assert!(row.mean_m.iter().zip([0.8, 0.8, 1.3]).all(|(m, limit)| m.abs() <= limit + 1e-5), "{row:?}");
    }
}

#[test]
fn images_of_twice_the_size_are_brought_to_training_size() {
    let ids = [0, 2, 4, 6];
    let mut small = session(TrainerConfig::default(), 1);
    small.begin(spec(0, 10, &ids), &mut Memory::new((WIDTH, HEIGHT))).unwrap();
    let mut large = session(TrainerConfig::default(), 1);
    large.begin(spec(0, 10, &ids), &mut Memory::new((2 * WIDTH, 2 * HEIGHT))).unwrap();
    let (a, b) = (small.model().len() as f64, large.model().len() as f64);
    // Boxes across a silhouette have no depth, so a rim of pixels is missing from the larger images.
    assert!((0.8..1.02).contains(&(b / a)), "{a} and {b} Gaussians");
    let (small_db, large_db) = (held_out_psnr_db(&mut small), held_out_psnr_db(&mut large));
    assert!((small_db - large_db).abs() < 1.5, "half a pixel of error would cost 6 dB: {small_db:.2} {large_db:.2}");

    let mut odd = session(TrainerConfig::default(), 1);
    let error = odd.begin(spec(0, 10, &ids), &mut Memory::new((100, 72))).unwrap_err();
    let is_size = matches!(error, SessionError::Keyframe(KeyframeError::Size { id: 0, .. }));
    assert!(is_size && error.to_string().contains("100x72"), "{error}");
    assert!(odd.model().is_empty() && odd.active().is_none());
}

#[test]
fn the_same_seed_gives_the_same_bits_and_threads_do_not_matter() {
    let run = |threads: usize, seed: u64| {
        let mut session = session(TrainerConfig::default(), threads);
        let mut source = Memory::new((WIDTH, HEIGHT));
        for (round, ids) in [&[0u64, 2, 4, 6][..], &[0, 2, 4, 6, 1, 5]].into_iter().enumerate() {
            let mut spec = spec(round as u32, 60, ids);
            spec.seed = seed + round as u64;
            session.begin(spec, &mut source).unwrap();
            train(&mut session);
        }
        checkpoint::to_bytes(&session)
    };
    let reference = run(1, 5);
    assert!(reference == run(2, 5), "two threads");
    assert!(reference != run(1, 6), "another seed trains in another order");
}

#[test]
fn a_session_from_a_checkpoint_goes_on_with_the_same_bits() {
    let mut source = Memory::new((WIDTH, HEIGHT));
    let rounds = [spec(0, 80, &[0, 2, 4, 6]), spec(1, 100, &[0, 2, 4, 6, 1, 3])];
    let mut whole = session(TrainerConfig::default(), 2);
    let mut cut = Vec::new();
    for round in rounds.clone() {
        whole.begin(round, &mut source).unwrap();
        whole.advance(37, || ()).unwrap();
        cut.push(checkpoint::to_bytes(&whole));
        train(&mut whole);
        cut.push(checkpoint::to_bytes(&whole));
    }
    let last = cut.last().unwrap().clone();
    for bytes in &cut {
        let mut resumed = session(TrainerConfig::default(), 1);
        checkpoint::from_bytes(bytes).unwrap().restore_into(&mut resumed);
        assert!(checkpoint::to_bytes(&resumed) == *bytes, "nothing is lost on the way");
        resumed.resume(&mut source).unwrap();
        if resumed.active().is_some() {
            train(&mut resumed);
        }
        for round in &rounds[resumed.finished().len()..] {
            resumed.begin(round.clone(), &mut source).unwrap();
            train(&mut resumed);
        }
        assert!(checkpoint::to_bytes(&resumed) == last);
    }
}

#[test]
fn the_untrained_model_is_all_keyframes_of_the_last_round_inserted_at_once() {
    let parent = tempfile::tempdir().unwrap();
    let folder = MissionFolder::create(parent.path().join("mission")).unwrap();
    for view in training_views((WIDTH, HEIGHT)) {
        folder.write_keyframe(&view.keyframe).unwrap();
    }
    let config = Config { model: model_config(), ..Config::default() };
    assert!(untrained(&folder, &config).unwrap().is_none(), "no round has ended");
    let mut source = folder.clone();
    let mut trained = session(config.trainer.clone(), 1);
    for (round, ids) in [&[0u64, 2, 4][..], &[0, 2, 4, 1, 5]].into_iter().enumerate() {
        trained.begin(spec(round as u32, 20, ids), &mut source).unwrap();
        train(&mut trained);
    }
    checkpoint::write(&folder.model_path(), &trained).unwrap();
    let mut inserted = session(config.trainer.clone(), 1);
    inserted.begin(spec(0, 20, &[0, 2, 4, 1, 5]), &mut source).unwrap();
    let found = untrained(&folder, &config).unwrap().unwrap();
    let positions = |model: &splatting::Gaussians| model.iter().map(|g| g.mean.to_array()).collect::<Vec<_>>();
    assert_eq!(positions(&found), positions(inserted.model()));
    assert!(positions(&found) != positions(trained.model()), "training moves them");
}

/// Name of a GPU's adapter; where there is none, the test says that it was skipped.
fn gpu(test: &str) -> Option<String> {
    let adapter = splatting::gpu::adapters().into_iter().next();
    if adapter.is_none() {
        assert!(std::env::var_os("VANTAGE_EXPECT_GPU").is_none(), "no GPU adapter, but one was expected");
        println!("{test}: skipped, no GPU adapter");
    }
    adapter.map(|adapter| adapter.name)
}

/// A round that was begun on one back end goes on on the other, and back.
#[test]
fn a_round_changes_its_back_end_by_a_checkpoint() {
    let Some(adapter) = gpu("a_round_changes_its_back_end_by_a_checkpoint") else { return };
    let options = |kind| BackendOptions { kind, adapter: Some(adapter.clone()), threads: 1, deterministic: false };
    let gpu = || Backend::new(&options(BackendKind::Gpu)).unwrap().0;
    let cpu = || Backend::new(&options(BackendKind::Cpu)).unwrap().0;
    let mut source = Memory::new((48, 36));
    let model = shared_types::config::ModelConfig { width: 48, height: 36, ..model_config() };
    let mut bytes = None;
    for (backend, iterations) in [(cpu(), 30), (gpu(), 60), (cpu(), 90)] {
        let mut session = Session::new(TrainerConfig::default(), model.clone(), backend);
        match bytes.take() {
            None => session.begin(spec(0, 90, &[0, 2, 4]), &mut source).unwrap(),
            Some(bytes) => {
                let checkpoint: Vec<u8> = bytes;
                checkpoint::from_bytes(&checkpoint).unwrap().restore_into(&mut session);
                session.resume(&mut source).unwrap();
            }
        }
        let before = session.model().iter().next().unwrap();
        assert_eq!(session.advance(30, || ()).unwrap(), iterations == 90);
        session.sync().unwrap();
        assert_eq!(session.progress().iterations, iterations);
        assert!(session.progress().psnr_train_db > 10.0 && session.model().is_finite());
        assert!(session.model().iter().next().unwrap() != before, "it trains: {:?}", session.backend());
        bytes = Some(checkpoint::to_bytes(&session));
    }
}

/// What pruning and insertion leave on a GPU is, to the bit, what a checkpoint of it brings there.
#[test]
fn a_second_round_on_a_gpu_is_the_one_of_a_checkpoint() {
    let Some(adapter) = gpu("a_second_round_on_a_gpu_is_the_one_of_a_checkpoint") else { return };
    let (kind, adapter) = (BackendKind::Gpu, Some(adapter));
    let options = BackendOptions { kind, adapter, threads: 1, deterministic: true };
    let mut source = Memory::new((48, 36));
    let model = shared_types::config::ModelConfig { width: 48, height: 36, ..model_config() };
    // So that something is pruned and the cap is reached.
    let model = shared_types::config::ModelConfig { max_gaussians: 700, ..model };
    let config = TrainerConfig { prune_opacity: 0.7, ..TrainerConfig::default() };
    let ends = [false, true].map(|restored| {
        let mut session = Session::new(config.clone(), model.clone(), Backend::new(&options).unwrap().0);
        for (round, ids) in [&[0u64, 2, 4][..], &[0, 2, 4, 1, 5]].into_iter().enumerate() {
            session.begin(spec(round as u32, 20, ids), &mut source).unwrap();
            let inserted = session.model().len();
            session.advance(20, || ()).unwrap();
            session.finish().unwrap();
            assert!(session.model().len() < inserted, "some are pruned of {inserted}");
            if restored {
                let bytes = checkpoint::to_bytes(&session);
                checkpoint::from_bytes(&bytes).unwrap().restore_into(&mut session);
            }
        }
        checkpoint::to_bytes(&session)
    });
    assert!(ends[0] == ends[1]);
}

/// A checkpoint within a round is that of the moment it was begun, though training went on before it arrived.
#[test]
fn a_checkpoint_that_a_gpu_brings_later_is_of_the_moment_it_was_begun() {
    let Some(adapter) = gpu("a_checkpoint_that_a_gpu_brings_later_is_of_the_moment_it_was_begun") else { return };
    let options = BackendOptions { kind: BackendKind::Gpu, adapter: Some(adapter), threads: 1, deterministic: true };
    let model = shared_types::config::ModelConfig { width: 48, height: 36, ..model_config() };
    let mut source = Memory::new((48, 36));
    let begun = |source: &mut Memory| {
        let mut session = Session::new(TrainerConfig::default(), model.clone(), Backend::new(&options).unwrap().0);
        session.begin(spec(0, 50_000, &[0, 2, 4]), source).unwrap();
        assert!(!session.begin_checkpoint().unwrap(), "nothing is newer on the GPU yet");
        session.advance(37, || ()).unwrap();
        session
    };
    let mut waited_for = begun(&mut source);
    waited_for.sync().unwrap();
    assert!(!waited_for.begin_checkpoint().unwrap(), "it is here");
    let expected = checkpoint::to_bytes(&waited_for);

    let mut session = begun(&mut source);
    assert!(session.begin_checkpoint().unwrap());
    let (found, after) = (38..)
        .find_map(|iterations| {
            assert!(!session.advance(1, || ()).unwrap(), "it never arrived");
            session.take_checkpoint().unwrap().map(|found| (found, iterations))
        })
        .unwrap();
    assert!(found.to_bytes() == expected, "taken after {after} iterations");
    assert!(session.take_checkpoint().unwrap().is_none(), "it is taken once");
    // One that has not arrived by the round's end is not wanted any more.
    assert!(session.begin_checkpoint().unwrap());
    session.finish().unwrap();
    assert!(session.take_checkpoint().unwrap().is_none());
}

#[test]
fn the_newest_whole_checkpoint_wins() {
    let folder = tempfile::tempdir().unwrap();
    let mut source = Memory::new((WIDTH, HEIGHT));
    let mut session_ = session(TrainerConfig::default(), 1);
    session_.begin(spec(0, 40, &[0, 4]), &mut source).unwrap();
    session_.advance(20, || ()).unwrap();
    checkpoint::write(folder.path(), &session_).unwrap();
    train(&mut session_);
    let at_end = checkpoint::write(folder.path(), &session_).unwrap();
    session_.begin(spec(1, 100, &[0, 4, 2]), &mut source).unwrap();
    for _ in 0..3 {
        session_.advance(20, || ()).unwrap();
        checkpoint::write(folder.path(), &session_).unwrap();
    }
    let left = || std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().path()).collect::<Vec<_>>();
    assert_eq!(left().len(), 3, "two, and the last round's end: {:?}", left());
    assert!(at_end.exists());
    let restored = |only_final| {
        let mut other = session(TrainerConfig::default(), 1);
        checkpoint::newest(folder.path(), only_final).map(|found| {
            found.restore_into(&mut other);
            (other.progress().total_iterations, other.active().is_some())
        })
    };
    assert_eq!(restored(false), Some((100, true)));
    assert_eq!(restored(true), Some((40, false)));

    // Cut the newest, rot the one before: the round's end is left.
    let mut live = left();
    live.retain(|path| *path != at_end);
    live.sort();
    let bytes = std::fs::read(&live[1]).unwrap();
    std::fs::write(&live[1], &bytes[..bytes.len() / 2]).unwrap();
    assert_eq!(restored(false), Some((80, true)));
    let mut bytes = std::fs::read(&live[0]).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    std::fs::write(&live[0], &bytes).unwrap();
    assert_eq!(restored(false), Some((40, false)));
    std::fs::write(&at_end, b"VNTGCKPT").unwrap();
    assert_eq!(restored(false), None);
}

#[test]
fn a_round_ends_when_its_loss_has_flattened() {
    let mut session = session(TrainerConfig { flat_gain: 0.05, ..TrainerConfig::default() }, 2);
    let mut flat = spec(0, 1500, &[0, 1, 2, 3, 4, 5, 6, 7]);
    flat.stop_when_flat = true;
    session.begin(flat, &mut Memory::new((WIDTH, HEIGHT))).unwrap();
    let iterations = train(&mut session);
    assert!((200..1500).contains(&iterations) && iterations.is_multiple_of(20), "{iterations}");
}

#[test]
fn at_the_cap_late_views_still_find_room() {
    let cap = 2_500;
    let mut session = Session::new(
        TrainerConfig::default(),
        shared_types::config::ModelConfig { max_gaussians: cap, ..model_config() },
        splatting::Engine::new(1).unwrap(),
    );
    let mut source = Memory::new((WIDTH, HEIGHT));
    session.begin(spec(0, 20, &[0, 1, 2, 3]), &mut source).unwrap();
    train(&mut session);
    session.begin(spec(1, 20, &[0, 1, 2, 3, 4, 5]), &mut source).unwrap();
    train(&mut session);
    let born_late = session.model().iter().filter(|gaussian| gaussian.birth_round == 1).count();
    assert!(session.model().len() <= cap as usize && session.model().len() > 2_300, "{}", session.model().len());
    assert!(born_late > 300, "{born_late}");
}

#[test]
fn the_paper_s_settings_train_too() {
    let config = TrainerConfig { voxel_m: 0.03, ..TrainerConfig::paper() };
    let mut session = session(config, 2);
    session.begin(spec(0, 150, &[0, 1, 2, 3, 4, 5, 6, 7]), &mut Memory::new((WIDTH, HEIGHT))).unwrap();
    let before = held_out_psnr_db(&mut session);
    train(&mut session);
    assert!(session.model().is_finite());
    assert!(held_out_psnr_db(&mut session) > before, "{before}");
}

#[test]
fn a_missing_keyframe_is_named_and_nothing_has_changed() {
    let mut session = session(TrainerConfig::default(), 1);
    let mut source = Memory::new((WIDTH, HEIGHT));
    let error = session.begin(spec(0, 20, &[0, 77]), &mut source).unwrap_err();
    assert!(error.to_string().contains("000077"), "{error}");
    assert!(session.model().is_empty() && session.active().is_none() && session.snapshot().is_none());
}
