//! The trainer on disks that lose power or are full.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::mpsc::sync_channel;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use shared_types::TICK_NS;
use shared_types::folder::MissionFolder;
use shared_types::messages::ServiceState;
use shared_types::service::{Service as _, Step};
use shared_types::storage;
use shared_types::storage::faulty::{Full, Slow};
use shared_types::storage::record::{Op, Recorder};
use shared_types::storage::replay::every_outcome;
use trainer::backend::Record;
use trainer::checkpoint;

use crate::service::{Rig, mission};

/// A checkpoint each half second.
fn rig(folder: &Path) -> Rig {
    let mut rig = Rig::new(folder);
    rig.config.trainer.checkpoint_period_s = 0.5;
    rig
}

#[test]
fn a_cut_leaves_whole_checkpoints_and_whole_models() {
    let dir = tempfile::tempdir_in("/dev/shm").unwrap();
    let folder = MissionFolder::create(dir.path().join("m")).unwrap();
    for view in crate::common::training_views((crate::common::WIDTH, crate::common::HEIGHT)) {
        folder.write_keyframe(&view.keyframe).unwrap();
    }
    let model = folder.model_path();
    let recorder = Recorder::new(&model).unwrap();
    let mount = storage::mount(&model, Arc::new(recorder.clone()));
    let mut rig = rig(folder.root());
    let mut trainer = rig.trainer(1);
    rig.ask(1);
    rig.run(&mut trainer, 140);
    assert_eq!(rig.done().len(), 1);
    drop(trainer);
    drop(mount);
    let trace = recorder.trace();
    let named = |kind: &str| {
        let is = |op: &&Op| matches!(op, Op::Rename(_, to) if to.to_string_lossy().contains(kind));
        trace.ops.iter().filter(is).count()
    };
    assert!(named("-live.ckpt") >= 2 && named("-final.ckpt") == 1 && named("model.ply") == 1, "{:?}", trace.ops.len());
    let whole = std::fs::read(model.join("model.ply")).unwrap();
    let mut generations = BTreeSet::new();
    let findings = every_outcome(&trace, &dir.path().join("after"), |root| {
        let end = checkpoint::newest(root, true).is_some();
        let any = checkpoint::newest(root, false).is_some();
        for entry in std::fs::read_dir(root).unwrap().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.starts_with("checkpoint-") {
                let bytes = std::fs::read(entry.path()).unwrap();
                checkpoint::from_bytes(&bytes).map_err(|error| format!("{name}: {error}"))?;
                generations.insert(name);
            }
        }
        for file in ["model.ply", "rounds/00.ply"] {
            match std::fs::read(root.join(file)) {
                Ok(bytes) if bytes != whole => return Err(format!("{file} is another model")),
                Ok(_) if !end => return Err(format!("{file} of a round that is not over")),
                _ => {}
            }
        }
        let record = root.join("backend.json");
        if record.exists() && !Record::read(root).backend.starts_with("cpu-") {
            return Err("backend.json says nothing".to_owned());
        }
        Ok(match (end, any) {
            (true, _) => "a round's end",
            (false, true) => "within the round",
            (false, false) => "nothing",
        })
    })
    .unwrap_or_else(|why| panic!("{why}"));
    println!("model/: {} cuts, {} outcomes: {:?}", findings.places, findings.distinct, findings.by_name);
    assert_eq!(findings.by_name.len(), 3, "{findings:?}");
    assert!(generations.len() >= 3, "{generations:?}");
}

#[test]
fn a_full_disk_skips_live_checkpoints_and_the_end_of_a_round_waits_for_room() {
    let (dir, folder) = mission();
    let disk = Full::with_room(0);
    let _mount = storage::mount(dir.path(), Arc::new(disk.clone()));
    let mut rig = rig(dir.path());
    let mut trainer = rig.trainer(1);
    rig.ask(1);
    rig.run(&mut trainer, 110);
    let health = trainer.health();
    assert_eq!(health.state, ServiceState::Degraded, "{health:?}");
    assert!(health.dropped >= 2, "counted: {health:?}");
    let told = |text: &str| {
        assert!(text.contains("bytes of") && text.contains(".ckpt") && text.contains("free disk space"), "{text}");
    };
    assert!(health.last_error.contains("checkpoints skipped"), "{health:?}");
    told(&health.last_error);
    // 1.26 s: the round is over, and there is no room for it.
    rig.run(&mut trainer, 60);
    let health = trainer.health();
    assert_eq!((health.state, rig.done().len()), (ServiceState::Degraded, 0), "{health:?}");
    assert!(health.last_error.contains("-final.ckpt"), "{health:?}");
    told(&health.last_error);
    assert!(std::fs::read_dir(folder.model_path()).unwrap().next().is_none(), "nothing half-made is left");
    // Room for the checkpoint, not for the models.
    disk.free(50_000);
    rig.run(&mut trainer, 120);
    assert_eq!(rig.done().len(), 0);
    disk.free(100_000_000);
    rig.run(&mut trainer, 120);
    assert_eq!(rig.done().len(), 1, "{:?}", trainer.health());
    let health = trainer.health();
    assert_eq!((health.state, health.last_error.as_str()), (ServiceState::Running, ""), "{health:?}");
    assert!(checkpoint::newest(&folder.model_path(), true).is_some());
    let ply = std::fs::read(folder.model_path().join("model.ply")).unwrap();
    assert!(splatting::ply::read(&ply).unwrap().len() > 500);
}

#[test]
fn a_trainer_that_waits_for_room_can_be_stopped() {
    let (dir, _folder) = mission();
    let _mount = storage::mount(dir.path(), Arc::new(Full::with_room(0)));
    let mut rig = rig(dir.path());
    let mut trainer = rig.trainer(1);
    rig.ask(1);
    rig.run(&mut trainer, 140);
    assert!(trainer.health().last_error.contains("-final.ckpt"), "{:?}", trainer.health());
    let began = Instant::now();
    trainer.stop(0);
    assert!(began.elapsed().as_secs() < 7, "it did not wait for its patience to end");
}

#[test]
fn a_slow_disk_does_not_hold_the_loop_up_on_the_walls_clock() {
    let (dir, _folder) = mission();
    let (pass, passed) = sync_channel::<()>(0);
    let waits = Arc::new(Mutex::new((Duration::ZERO, passed)));
    let noted = Arc::clone(&waits);
    let slow = Slow::new(
        1e6,
        Arc::new(move |wait| {
            let mut noted = noted.lock().unwrap();
            noted.0 += wait;
            // Until the test says that this time is over.
            noted.1.recv().ok();
        }),
    );
    let mut rig = rig(dir.path());
    let mut trainer = rig.trainer_by(1, false);
    let _mount = storage::mount(dir.path(), Arc::new(slow));
    rig.ask(1);
    let began = Instant::now();
    // The round is trained and its checkpoint on its way to the disk; the loop turns meanwhile.
    for turn in 0.. {
        assert_eq!(trainer.step((turn + 2) * TICK_NS).unwrap(), Step::Done, "the loop is held up");
        let trained = trainer.work() > 0 && waits.try_lock().is_err();
        if trained && turn > 300 {
            break;
        }
        std::thread::sleep(Duration::from_millis(1));
        assert!(began.elapsed() < Duration::from_secs(60));
    }
    drop(pass);
    rig.tick = 400;
    while rig.done().is_empty() {
        rig.run(&mut trainer, 1);
        std::thread::sleep(Duration::from_millis(1));
        assert!(began.elapsed() < Duration::from_secs(60));
    }
    let waited = waits.lock().unwrap().0;
    println!("a round's files keep a disk of 1 MB/s busy for {:.1} s", waited.as_secs_f64());
    assert!(waited > Duration::from_millis(100));
}
