//! The trainer as a service over a real bus, ticked by hand: due times, replies, restarts.

use std::path::Path;
use std::time::{Duration, Instant};

use crate::common::*;
use shared_types::TICK_NS;
use shared_types::bus::{Bus, Client, Limits, Subscriber};
use shared_types::channel::{RoundChannel, SnapshotChannel};
use shared_types::config::Config;
use shared_types::folder::MissionFolder;
use shared_types::messages::{GaussianRow, RoundReply, RoundStatus, SnapshotHeader};
use shared_types::payload::unpack_text;
use shared_types::service::{Service, ServiceName, Step};
use shared_types::system::System;
use trainer::Trainer;
use trainer::ports::Ports;

pub struct Rig {
    system: System,
    pub config: Config,
    planner: Bus,
    rounds: Client<RoundChannel>,
    snapshots: Subscriber<SnapshotChannel>,
    pub tick: u64,
    replies: Vec<(u64, RoundReply)>,
    published: Vec<(u64, SnapshotHeader, Vec<GaussianRow>)>,
    _base: tempfile::TempDir,
}

impl Drop for Rig {
    fn drop(&mut self) {
        self.system.remove().ok();
    }
}

impl Rig {
    pub fn new(folder: &Path) -> Self {
        let base = tempfile::tempdir_in("/dev/shm").unwrap();
        let system = System::create(base.path(), "trainer-test", 0).unwrap();
        let mut config = Config { model: model_config(), ..Config::default() };
        config.mission.folder = folder.display().to_string();
        let planner = Bus::open(&system, Limits::of(&config), ServiceName::Planner, 7, true).unwrap();
        let (rounds, snapshots) = (planner.client().unwrap(), planner.subscriber().unwrap());
        Self {
            system,
            config,
            planner,
            rounds,
            snapshots,
            tick: 1,
            replies: Vec::new(),
            published: Vec::new(),
            _base: base,
        }
    }

    pub fn trainer(&self, incarnation: u64) -> Trainer {
        self.trainer_by(incarnation, true)
    }

    /// On the mission clock in lockstep, or on the wall's.
    pub fn trainer_by(&self, incarnation: u64, lockstep: bool) -> Trainer {
        let limits = Limits::of(&self.config);
        let bus = Bus::open(&self.system, limits, ServiceName::Trainer, incarnation, lockstep).unwrap();
        Trainer::new(Ports::open(&bus).unwrap(), &self.config, lockstep).unwrap()
    }

    /// Asks for round 0 with 100 iterations on four views.
    pub fn ask(&mut self, request_id: u64) {
        self.rounds.send(self.tick * TICK_NS, request_id, &request(0, 100), &[0, 2, 4, 6]).unwrap();
    }

    /// Grants `ticks` ticks, reading what is published as the planner would.
    pub fn run(&mut self, trainer: &mut Trainer, ticks: u64) {
        for _ in 0..ticks {
            self.tick += 1;
            let now_ns = self.tick * TICK_NS;
            let patience = Instant::now() + Duration::from_secs(60);
            while trainer.step(now_ns).unwrap() == Step::Waiting {
                assert!(Instant::now() < patience, "the trainer never finishes a due result");
                std::thread::sleep(Duration::from_millis(1));
            }
            while let Some(reply) = self.rounds.receive(now_ns + 1).unwrap() {
                if reply.header().status == RoundStatus::Done.code() {
                    // As the planner does: else a slow machine, where it is asked again, is answered twice.
                    self.rounds.finish(reply.envelope().request_id);
                }
                self.replies.push((self.tick, *reply.header()));
            }
            while let Some(snapshot) = self.snapshots.receive(now_ns + 1).unwrap() {
                self.published.push((self.tick, *snapshot.header(), snapshot.items().to_vec()));
            }
        }
    }

    pub fn done(&self) -> Vec<(u64, RoundReply)> {
        let done = |reply: &&(u64, RoundReply)| reply.1.status == RoundStatus::Done.code();
        self.replies.iter().filter(done).copied().collect()
    }
}

pub fn mission() -> (tempfile::TempDir, MissionFolder) {
    let dir = tempfile::tempdir().unwrap();
    let folder = MissionFolder::create(dir.path()).unwrap();
    for view in training_views((WIDTH, HEIGHT)) {
        folder.write_keyframe(&view.keyframe).unwrap();
    }
    (dir, folder)
}

#[test]
fn a_round_is_done_when_its_iterations_are_due_and_a_restarted_trainer_knows_it() {
    let (dir, folder) = mission();
    let mut rig = Rig::new(dir.path());
    let mut trainer = rig.trainer(1);
    rig.run(&mut trainer, 3);
    rig.ask(41);
    let asked = rig.tick;
    rig.run(&mut trainer, 140);
    // Taken at the next tick; 100 iterations at 80 a second are 1.25 s.
    let done = rig.done();
    assert_eq!(done.iter().map(|(tick, _)| *tick).collect::<Vec<_>>(), [asked + 1 + 125]);
    let reply = done[0].1;
    assert_eq!((reply.iterations, reply.total_iterations, reply.round), (100, 100, 0));
    assert!(reply.psnr_train_db > 15.0 && reply.loss > 0.0 && reply.gaussians > 500, "{reply:?}");
    let progress: Vec<u64> =
        rig.replies.iter().filter(|(_, r)| r.status == RoundStatus::Progress.code()).map(|(tick, _)| *tick).collect();
    assert_eq!(progress, [asked + 1 + 100], "a second after it began");
    let published: Vec<(u64, u64, u32)> =
        rig.published.iter().map(|(tick, h, _)| (*tick, h.iterations, h.is_final)).collect();
    assert_eq!(published, [(asked + 1 + 100, 80, 0), (asked + 1 + 125, 100, 1)]);
    let (_, header, rows) = rig.published[1].clone();
    assert_eq!((header.generation, rows.len() as u64), (reply.generation, reply.gaussians));
    for file in ["rounds/00.ply", "model.ply"] {
        let bytes = std::fs::read(folder.model_path().join(file)).unwrap();
        assert_eq!(splatting::ply::read(&bytes).unwrap().len(), rows.len());
    }

    // The process dies; the next one publishes the model again and answers the same request from the folder.
    drop(trainer);
    // As if it had died between the round's checkpoint and its model.
    std::fs::remove_file(folder.model_path().join("model.ply")).unwrap();
    rig.published.clear();
    rig.replies.clear();
    let mut trainer = rig.trainer(2);
    rig.run(&mut trainer, 1);
    assert!(rig.published.iter().any(|(_, h, again)| h.generation == header.generation && *again == rows));
    assert_eq!(
        splatting::ply::read(&std::fs::read(folder.model_path().join("model.ply")).unwrap()).unwrap().len(),
        rows.len()
    );
    rig.ask(41);
    rig.run(&mut trainer, 2);
    assert_eq!(rig.done().iter().map(|(_, reply)| *reply).collect::<Vec<_>>(), [reply]);
}

#[test]
fn a_trainer_stopped_within_a_round_goes_on_to_the_same_model() {
    let whole = {
        let (dir, _folder) = mission();
        let mut rig = Rig::new(dir.path());
        let mut trainer = rig.trainer(1);
        rig.ask(1);
        rig.run(&mut trainer, 140);
        rig.published.last().unwrap().clone()
    };
    let (dir, _folder) = mission();
    let mut rig = Rig::new(dir.path());
    let mut trainer = rig.trainer(1);
    rig.ask(1);
    rig.run(&mut trainer, 60);
    assert!(rig.done().is_empty());
    trainer.stop(rig.tick * TICK_NS);
    drop(trainer);
    let mut trainer = rig.trainer(2);
    rig.ask(1);
    rig.run(&mut trainer, 140);
    let resumed = rig.published.last().unwrap();
    assert_eq!(resumed.1, whole.1);
    assert!(resumed.2 == whole.2, "the same bits");
    assert_eq!(rig.done().len(), 1);
}

#[test]
fn a_round_that_cannot_be_run_says_why_and_the_next_one_runs() {
    let (dir, _folder) = mission();
    let mut rig = Rig::new(dir.path());
    let mut trainer = rig.trainer(1);
    rig.rounds.send(rig.tick * TICK_NS, 1, &request(0, 40), &[0, 55]).unwrap();
    rig.run(&mut trainer, 60);
    let (_, failed) = rig.replies.last().copied().unwrap();
    assert_eq!(failed.status, RoundStatus::Failed.code());
    assert!(unpack_text(&failed.reason).contains("000055"), "{}", unpack_text(&failed.reason));
    rig.rounds.finish(1);
    rig.ask(2);
    rig.run(&mut trainer, 140);
    assert_eq!(rig.done().len(), 1);
    drop(trainer);
    assert_eq!(rig.planner.client::<RoundChannel>().unwrap().pending().count(), 0);
}
