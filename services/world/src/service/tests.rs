//! The service over a real domain of its own: truth and requests in, images out.

use std::time::Instant;

use glam::DVec3;
use shared_types::bus::{Client, Limits, Publisher};
use shared_types::channel::{RenderChannel, TruthChannel};
use shared_types::frames::look_at;
use shared_types::messages::Truth;
use shared_types::service::ServiceName;
use shared_types::system::System;

use super::*;

const TICK_NS: u64 = shared_types::TICK_NS;

/// A world, a simulator that tells the truth, and a camera that asks.
struct Stage {
    world: World,
    truth: Publisher<TruthChannel>,
    camera: Client<RenderChannel>,
    system: System,
    _base: tempfile::TempDir,
}

impl Drop for Stage {
    fn drop(&mut self) {
        drop(self.system.remove());
    }
}

fn config() -> Config {
    let mut config = Config::default();
    config.camera.width_px = 96;
    config.camera.height_px = 72;
    config.world.threads = 1;
    config
}

impl Stage {
    fn new(config: &Config) -> Self {
        let base = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
        let system = System::create(base.path(), "w", 0).expect("a system");
        let join = |name| Bus::open(&system, Limits::of(config), name, 1, false).expect("joined");
        let world = World::open(&join(ServiceName::World), config).expect("opened");
        let truth = join(ServiceName::Simulator).publisher().expect("a publisher");
        let camera = join(ServiceName::Camera).client().expect("a client");
        Self { world, truth, camera, system, _base: base }
    }

    /// The camera flies east at 1 m/s past the object, looking at it.
    fn pose(stamp_ns: u64) -> Pose {
        look_at(DVec3::new(stamp_ns as f64 * 1e-9 - 1.0, -2.5, 1.2), DVec3::new(0.0, 0.0, 0.4))
    }

    fn tell(&mut self, stamp_ns: u64) {
        let pose = Self::pose(stamp_ns);
        let header = Truth {
            now_ns: stamp_ns,
            camera_position_m: pose.position_m.to_array(),
            world_from_camera_xyzw: pose.rotation.to_array(),
            ..Truth::default()
        };
        self.truth.send(stamp_ns, stamp_ns, &header).expect("sent");
        // As often as in flight, so that the queue does not run over.
        self.world.step(stamp_ns).expect("a turn");
    }

    fn ask(&mut self, id: u64, stamp_ns: u64, purpose: RenderPurpose, (width, height): (u32, u32)) {
        let intrinsics = Intrinsics::from_hfov(width, height, 1.204);
        let request = RenderRequest {
            image_stamp_ns: stamp_ns,
            focal_px: [intrinsics.fx, intrinsics.fy],
            principal_px: [intrinsics.cx, intrinsics.cy],
            width,
            height,
            purpose: purpose.code(),
            reserved: 0,
        };
        self.camera.send(stamp_ns, id, &request, &[]).expect("sent");
    }

    /// Turns until the answer is there; `None` if there is none after `turns`.
    fn answer(&mut self, turns: usize) -> Option<(u64, RenderReply, Vec<u8>)> {
        for _ in 0..turns {
            self.world.step(0).expect("a turn");
            if let Some(reply) = self.camera.receive(0).expect("received") {
                return Some((reply.request_id(), *reply.header(), reply.items().to_vec()));
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        None
    }

    fn wait_until_built(&mut self) {
        let start = Instant::now();
        while self.world.state == State::Building && start.elapsed() < Duration::from_secs(60) {
            self.world.step(0).expect("a turn");
            std::thread::sleep(Duration::from_millis(5));
        }
        assert_eq!(self.world.state, State::Serving);
    }
}

#[test]
fn images_are_rendered_at_the_true_pose_of_their_stamp() {
    let config = config();
    let mut stage = Stage::new(&config);
    // Asked before the scene is built, and before the truth has come so far: the answer waits for both.
    for tick in 0..=100 {
        stage.tell(tick * TICK_NS);
    }
    let stamp_ns = 100 * TICK_NS + TICK_NS / 2;
    stage.ask(7, stamp_ns, RenderPurpose::Capture, (96, 72));
    stage.wait_until_built();
    assert!(stage.answer(50).is_none(), "the truth of that stamp has not come yet");
    stage.tell(101 * TICK_NS);
    let (id, header, items) = stage.answer(500).expect("an answer");
    assert_eq!((id, header.status, header.image_stamp_ns), (7, RenderStatus::Done.code(), stamp_ns));
    assert_eq!((header.width, header.height, header.has_color, items.len()), (96, 72, 1, 96 * 72 * 5));
    assert!(header.cpu_ns > 0);

    // The same as the library renders at the pose in between.
    let scene = Scene::new(&SceneConfig::of(&config), &Threads::new(1)).expect("a scene");
    let pose = Stage::pose(100 * TICK_NS).interpolate(&Stage::pose(101 * TICK_NS), 0.5);
    let intrinsics = Intrinsics::from_hfov(96, 72, 1.204);
    let (depth_min_m, depth_max_m) = (config.camera.depth_min_m as f32, config.camera.depth_max_m as f32);
    let options = RenderOptions { depth_min_m, depth_max_m, ..RenderOptions::default() };
    let image = render(&scene, &pose, &intrinsics, &options, &Threads::new(1));
    assert!(image.object.iter().filter(|o| **o == 1).count() > 500);
    assert!(items[..96 * 72 * 3] == image.rgb[..]);
    let depth: Vec<u16> = items[96 * 72 * 3..].as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b)).collect();
    assert!(depth == image.depth_u16(header.depth_unit_m as f32));

    // Depth alone is as long as depth is; what is too old has no truth; what makes no sense is refused.
    stage.camera.finish(7);
    stage.ask(8, 50 * TICK_NS, RenderPurpose::Depth, (32, 24));
    let (_, header, items) = stage.answer(500).expect("an answer");
    assert_eq!((header.status, header.has_color, items.len()), (RenderStatus::Done.code(), 0, 32 * 24 * 2));
    stage.camera.finish(8);
    for tick in 102..=700 {
        stage.tell(tick * TICK_NS);
    }
    stage.ask(9, 50 * TICK_NS, RenderPurpose::Stream, (32, 24));
    let (_, header, items) = stage.answer(500).expect("an answer");
    assert_eq!((header.status, items.len()), (RenderStatus::NoTruth.code(), 0));
    stage.camera.finish(9);
    for (id, size) in [(10, (0, 24)), (11, (97, 72)), (12, (u32::MAX, u32::MAX))] {
        stage.ask(id, 700 * TICK_NS, RenderPurpose::Capture, size);
        let (_, header, _) = stage.answer(500).expect("an answer");
        assert_eq!(header.status, RenderStatus::Refused.code(), "{size:?}");
        stage.camera.finish(id);
    }
    assert_eq!(stage.world.rendered, 2, "nothing is rendered that nobody asked for");
}

#[test]
fn an_object_that_cannot_be_loaded_ends_the_service_with_its_reason() {
    let mut config = config();
    config.world.object = "/nowhere/stone.obj".to_owned();
    let mut stage = Stage::new(&config);
    let start = Instant::now();
    let error = loop {
        match stage.world.step(0) {
            Ok(_) => assert!(start.elapsed() < Duration::from_secs(30), "still building"),
            Err(error) => break error.to_string(),
        }
        std::thread::sleep(Duration::from_millis(2));
    };
    assert!(error.contains("/nowhere/stone.obj") && error.contains("check the path"), "{error}");
    assert_eq!(stage.world.state, State::Failed);
}
