//! The scorer as a service over a real bus, ticked by hand: waiting for a snapshot, due times, answers, what is gone.
#![expect(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::time::{Duration, Instant};

use glam::DVec3;
use scorer::Scorer;
use scorer::ports::Ports;
use shared_types::TICK_NS;
use shared_types::bus::{Bus, Client, Limits, Publisher};
use shared_types::channel::{ScoreChannel, SnapshotChannel};
use shared_types::config::{Config, ModelConfig};
use shared_types::frames::{Intrinsics, look_at};
use shared_types::messages::{
    CandidateScore, CandidateView, GaussianRow, ScoreReply, ScoreRequest, ScoreStatus, SnapshotHeader, VarianceMode,
};
use shared_types::service::{Service, ServiceName, Step};
use shared_types::system::System;

struct Rig {
    system: System,
    scorer: Scorer,
    requests: Client<ScoreChannel>,
    snapshots: Publisher<SnapshotChannel>,
    tick: u64,
    replies: Vec<(u64, ScoreReply, Vec<CandidateScore>)>,
    _base: tempfile::TempDir,
}

impl Drop for Rig {
    fn drop(&mut self) {
        self.system.remove().ok();
    }
}

impl Rig {
    fn new() -> Self {
        let base = tempfile::tempdir_in("/dev/shm").unwrap();
        let system = System::create(base.path(), "scorer-test", 0).unwrap();
        let config = Config { model: ModelConfig { max_gaussians: 2_000, width: 96, height: 72 }, ..Config::default() };
        let join = |name| Bus::open(&system, Limits::of(&config), name, 7, true).unwrap();
        let requests = join(ServiceName::Planner).client().unwrap();
        let snapshots = join(ServiceName::Trainer).publisher().unwrap();
        let scorer = Scorer::new(Ports::open(&join(ServiceName::Scorer)).unwrap(), &config, true).unwrap();
        Self { system, scorer, requests, snapshots, tick: 1, replies: Vec::new(), _base: base }
    }

    fn publish(&mut self, generation: u64) {
        let row = GaussianRow {
            log_scales: [0.2f32.ln(); 3],
            rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
            opacity_logit: 2.0,
            ..GaussianRow::default()
        };
        let header = SnapshotHeader { generation, is_final: 1, ..SnapshotHeader::default() };
        let now_ns = self.tick * TICK_NS;
        self.snapshots.send_items(now_ns, now_ns, &header, &[row]).unwrap();
    }

    fn ask(&mut self, request_id: u64, generation: u64) {
        let camera = Intrinsics::from_hfov(96, 72, 1.204);
        let request = ScoreRequest {
            generation,
            variance: VarianceMode::Normalised.code(),
            clip_angle: 1,
            width: 96,
            height: 72,
            grid_candidates: 20,
            focal_px: [camera.fx, camera.fy],
            principal_px: [camera.cx, camera.cy],
            box_size_m: 1.0,
            weight_uncertainty: 0.6,
            weight_angle: 0.4,
            ..ScoreRequest::default()
        };
        let views: Vec<CandidateView> = (0..20)
            .map(|index| {
                let (sin, cos) = (f64::from(index) * 0.3).sin_cos();
                let pose = look_at(2.0 * DVec3::new(cos, sin, 0.2), DVec3::ZERO);
                CandidateView {
                    position_m: pose.position_m.to_array(),
                    world_from_camera_xyzw: pose.rotation.to_array(),
                    index,
                    visited: 0,
                }
            })
            .collect();
        self.requests.send(self.tick * TICK_NS, request_id, &request, &views).unwrap();
    }

    fn run(&mut self, ticks: u64) {
        for _ in 0..ticks {
            self.tick += 1;
            let now_ns = self.tick * TICK_NS;
            let patience = Instant::now() + Duration::from_secs(60);
            while self.scorer.step(now_ns).unwrap() == Step::Waiting {
                assert!(Instant::now() < patience, "the scorer never finishes a due result");
                std::thread::sleep(Duration::from_millis(1));
            }
            while let Some(reply) = self.requests.receive(now_ns + 1).unwrap() {
                self.replies.push((self.tick, *reply.header(), reply.items().to_vec()));
            }
        }
    }
}

#[test]
fn scores_come_when_they_are_due_and_again_when_asked_again() {
    let mut rig = Rig::new();
    rig.run(1);
    rig.ask(1, 8);
    rig.run(5);
    assert!(rig.replies.is_empty(), "the snapshot is not there yet");
    rig.publish(8);
    let published = rig.tick;
    rig.run(12);
    // Seen a tick later; 20 candidates of 4 ms are 8 ticks.
    let (tick, reply, scores) = rig.replies.first().cloned().unwrap();
    assert_eq!((tick, reply.status), (published + 1 + 8, ScoreStatus::Done.code()));
    assert_eq!((scores.len(), reply.candidates, reply.generation), (20, 20, 8));
    assert!(scores.iter().zip(0..).all(|(score, index)| score.index == index && score.mean_alpha > 0.0));
    rig.replies.clear();
    rig.ask(1, 8);
    rig.run(2);
    assert_eq!(
        rig.replies.first().map(|(_, r, s)| (*r, s.clone())),
        Some((reply, scores.clone())),
        "the same answer at once"
    );
    rig.replies.clear();
    rig.ask(2, 8);
    rig.run(12);
    assert_eq!(rig.replies.first().map(|(_, _, s)| s.clone()), Some(scores), "the same generation, the same scores");
}

#[test]
fn a_snapshot_that_is_gone_names_the_newest() {
    let mut rig = Rig::new();
    rig.run(1);
    for generation in [4, 9, 15] {
        rig.publish(generation);
        rig.run(1);
    }
    rig.ask(1, 4);
    rig.run(3);
    let (_, reply, _) = rig.replies.first().cloned().unwrap();
    assert_eq!((reply.status, reply.newest_generation), (ScoreStatus::GenerationGone.code(), 15));
    rig.requests.finish(1);
    rig.replies.clear();
    rig.ask(2, 9);
    rig.run(12);
    assert_eq!(rig.replies.first().map(|(_, r, _)| r.status), Some(ScoreStatus::Done.code()));
}
