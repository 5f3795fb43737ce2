//! The camera over real channels, tick by tick, with a vehicle and a world that are known exactly.

use std::path::Path;
use std::time::{Duration, Instant};

use crate::common::{Domain, Flight, Others, World, distance_to_scene, request, tick};
use camera::ports::Ports;
use camera::service::CameraService;
use camera::sources::simulator::SimulatorSource;
use glam::DVec3;
use shared_types::config::{CameraConfig, ClockMode};
use shared_types::folder::{Keyframe, MissionFolder};
use shared_types::frames::Intrinsics;
use shared_types::messages::{CaptureReply, CaptureRequest, CaptureStatus, FrameView, ServiceState};
use shared_types::payload::unpack_text;
use shared_types::service::{Context, Service as _, Step};

fn config() -> CameraConfig {
    CameraConfig {
        width_px: 160,
        height_px: 120,
        body_from_gimbal_m: [0.12, 0.03, -0.05],
        gimbal_from_camera_m: [0.02, -0.01, 0.03],
        stream_hz: 0.0,
        ..CameraConfig::default()
    }
}

/// From the south-west, above, moving and turning slowly.
fn flight() -> Flight {
    Flight {
        start_m: DVec3::new(-1.1, -1.0, 1.6),
        velocity_mps: DVec3::new(0.02, -0.01, 0.005),
        yaw_rad: 0.62,
        yaw_rate_radps: 0.01,
        pitch_rad: -0.55,
        lever_body_m: config().body_from_gimbal_m,
        lever_gimbal_m: config().gimbal_from_camera_m,
    }
}

/// Fields are dropped in their order: the domain, last, removes what all others use.
pub struct Rig {
    world: World,
    pub others: Others,
    pub service: CameraService,
    _context: Context,
    pub folder: MissionFolder,
    world_works: bool,
    at_view: u64,
    pub k: u64,
    domain: Domain,
}

fn start(domain: &Domain) -> (CameraService, Context) {
    let context = domain.camera();
    let (ports, client) = Ports::open(&context.bus).expect("ports");
    let source = Box::new(SimulatorSource::new(client));
    (CameraService::new(ports, source, &context).expect("service"), context)
}

impl Rig {
    pub fn new(root: &Path) -> Self {
        Self::with_clock(root, ClockMode::Lockstep)
    }

    pub fn with_clock(root: &Path, clock: ClockMode) -> Self {
        let folder = MissionFolder::create(root.join("mission")).expect("folder");
        let mut domain = Domain::new(config());
        domain.config.clock.mode = clock;
        domain.config.mission.folder = folder.root().display().to_string();
        let (world, others) = (World::new(&domain, flight()), Others::new(&domain));
        let (service, context) = start(&domain);
        Self { domain, world, others, service, _context: context, folder, world_works: true, at_view: 7, k: 0 }
    }

    /// Kills the camera and starts another.
    fn restart(&mut self) {
        let (service, context) = start(&self.domain);
        self.service = service;
        self._context = context;
    }

    /// One tick: the vehicle speaks at 50 Hz, the camera steps until it lets the tick go. Returns the waits.
    fn tick(&mut self) -> usize {
        let now = tick(self.k);
        if self.k.is_multiple_of(2) {
            let state = self.world.flight.state(now, self.at_view);
            self.others.fly(now, &state);
        }
        self.k += 1;
        let mut waits = 0;
        while self.service.step(now).expect("step") == Step::Waiting {
            if self.world_works {
                self.world.work();
            }
            waits += 1;
            std::thread::sleep(Duration::from_millis(1));
        }
        waits
    }

    /// One turn of the loop on the wall's clock, which lets no tick wait.
    pub fn tick_once(&mut self) {
        let waits = self.tick();
        assert_eq!(waits, 0, "the loop is held up");
        self.world.work();
        std::thread::sleep(Duration::from_millis(1));
    }

    pub fn ticks_until_reply(&mut self, most: usize) -> (u64, CaptureReply) {
        for _ in 0..most {
            self.tick();
            if let Some(reply) = self.others.reply(tick(self.k)) {
                return reply;
            }
        }
        panic!("no reply within {most} ticks; the camera: {:?}", self.service);
    }

    pub fn ask(&mut self, request_id: u64, request: &CaptureRequest) {
        self.others.ask(tick(self.k), request_id, request);
    }

    pub fn keyframes_seen(&mut self) -> Vec<u64> {
        let mut seen = Vec::new();
        while let Some(message) = self.others.keyframes.receive(tick(self.k + 1)).expect("keyframes") {
            let view = FrameView::new(message.header(), message.items()).expect("a sane frame");
            let stored =
                self.folder.read_keyframe(view.header.id).expect("readable").expect("on disk before it is published");
            assert_eq!(view.rgb, stored.rgb);
            assert_eq!(view.depth_units_vec(), stored.depth_units);
            seen.push(view.header.id);
        }
        seen
    }
}

/// The largest distance of a backprojected pixel from the scene, metres.
fn worst_error_m(keyframe: &Keyframe) -> f64 {
    let (camera, pose) = (keyframe.frame.intrinsics, keyframe.frame.world_from_camera());
    let depth_m = keyframe.depth_m();
    let mut worst = 0.0_f64;
    let mut measured = 0;
    for row in 0..camera.height {
        for column in 0..camera.width {
            let depth_m = f64::from(depth_m[(row * camera.width + column) as usize]);
            if depth_m > 0.0 {
                measured += 1;
                let point = pose.transform_point(camera.backproject(Intrinsics::pixel_center(column, row), depth_m));
                worst = worst.max(distance_to_scene(point));
            }
        }
    }
    assert!(measured > 10_000, "the scene fills the image: {measured}");
    worst
}

#[test]
fn a_cube_lands_where_it_is_and_half_a_pixel_is_noticed() {
    let dir = tempfile::tempdir().expect("tempdir");
    let mut rig = Rig::new(dir.path());
    rig.ask(1, &request(1, 7));
    let (_, reply) = rig.ticks_until_reply(400);
    assert_eq!(reply.status, CaptureStatus::Stored.code(), "{}", unpack_text(&reply.reason));
    let good = rig.folder.read_keyframe(1).expect("read").expect("stored");
    assert_eq!(good.frame.stamp_ns, reply.image_stamp_ns);
    let worst = worst_error_m(&good);
    assert!(worst < 0.001, "every pixel within 1 mm of the scene; the worst is {worst} m");

    rig.world.shift_px = 0.5;
    rig.ask(2, &request(2, 7));
    rig.ticks_until_reply(400);
    let shifted = worst_error_m(&rig.folder.read_keyframe(2).expect("read").expect("stored"));
    assert!(shifted > 0.001, "half a pixel must show; the worst is {shifted} m");
}

#[test]
fn a_keyframe_is_published_and_answered_once_it_is_stored() {
    let dir = tempfile::tempdir().expect("tempdir");
    let mut rig = Rig::new(dir.path());
    rig.at_view = 6;
    rig.ask(1, &request(1, 7));
    for _ in 0..50 {
        rig.tick();
        assert!(rig.others.reply(tick(rig.k)).is_none(), "the vehicle is not there yet");
    }
    rig.at_view = 7;
    let (id, reply) = rig.ticks_until_reply(150);
    assert_eq!((id, reply.keyframe_id, reply.status), (1, 1, CaptureStatus::Stored.code()));
    assert!(reply.image_stamp_ns >= tick(49), "after the arrival");
    assert_eq!(rig.keyframes_seen(), [1]);
}

#[test]
fn a_keyframe_exists_once_whoever_asks_and_whatever_dies() {
    let dir = tempfile::tempdir().expect("tempdir");
    let mut rig = Rig::new(dir.path());
    rig.ask(1, &request(1, 7));
    let (_, first) = rig.ticks_until_reply(400);
    assert_eq!(rig.keyframes_seen(), [1]);

    rig.ask(1, &request(1, 7));
    assert_eq!(rig.ticks_until_reply(5), (1, first), "the same request, the same answer");
    rig.ask(2, &CaptureRequest { target_id: 99, deadline_ns: 0, ..request(1, 7) });
    assert_eq!(rig.ticks_until_reply(5), (2, first), "the same view under a new request id");
    assert!(rig.keyframes_seen().is_empty(), "published already");

    rig.restart();
    rig.ask(3, &request(1, 7));
    assert_eq!(rig.ticks_until_reply(5), (3, first), "answered from the disk");
    assert_eq!(rig.keyframes_seen(), [1], "a new life tells those who may have missed it");

    rig.ask(4, &CaptureRequest { candidate: 6, ..request(1, 7) });
    let (_, other) = rig.ticks_until_reply(5);
    assert_eq!(other.status, CaptureStatus::Refused.code());
    assert!(unpack_text(&other.reason).contains("another view"));
    rig.ask(1, &CaptureRequest { candidate: 6, ..request(1, 7) });
    assert_eq!(rig.ticks_until_reply(5).1.status, CaptureStatus::Refused.code());
    assert_eq!(rig.folder.list_keyframes().expect("list"), [1]);
}

#[test]
fn a_deadline_that_passes_is_answered() {
    let dir = tempfile::tempdir().expect("tempdir");
    let mut rig = Rig::new(dir.path());
    rig.at_view = 6;
    rig.ask(1, &CaptureRequest { deadline_ns: tick(20), ..request(1, 7) });
    let (_, reply) = rig.ticks_until_reply(40);
    assert_eq!((reply.status, rig.k), (CaptureStatus::TimedOut.code(), 21));
    assert!(rig.folder.list_keyframes().expect("list").is_empty());
}

#[test]
fn a_dead_world_is_waited_for_at_the_view() {
    let dir = tempfile::tempdir().expect("tempdir");
    let mut rig = Rig::new(dir.path());
    rig.world_works = false;
    rig.ask(1, &request(1, 7));
    let started = Instant::now();
    let held = (0..200).any(|_| rig.tick() > 0);
    assert!(held && started.elapsed() > Duration::from_millis(1_400), "the tick is held for an image");
    assert!(started.elapsed() < Duration::from_millis(1_900), "but not so long that the camera is found out");
    assert_eq!(rig.service.health().state, ServiceState::Degraded);
    let waiting = Instant::now();
    for _ in 0..20 {
        rig.tick();
    }
    let waited = waiting.elapsed();
    assert!(waited < Duration::from_millis(1_000), "ticks pass while it waits: {waited:?} for 20");
    assert!(waited >= Duration::from_millis(200), "but not faster than the wall's time: {waited:?} for 20");
    // The world comes back and knows nothing of the instant it was asked for.
    rig.world.known_ns = tick(rig.k)..=u64::MAX;
    rig.world_works = true;
    std::thread::sleep(Duration::from_millis(600));
    rig.tick();
    rig.world.work();
    let (_, reply) = rig.ticks_until_reply(400);
    assert_eq!(reply.status, CaptureStatus::Stored.code());
    assert!(reply.image_stamp_ns >= *rig.world.known_ns.start(), "another instant was chosen");
    assert_eq!(rig.service.health().state, ServiceState::Running);
}

#[test]
fn without_a_folder_a_capture_fails_with_the_way_out() {
    let dir = tempfile::tempdir().expect("tempdir");
    let mut rig = Rig::new(dir.path());
    rig.domain.config.mission.folder = dir.path().join("none").display().to_string();
    rig.restart();
    assert_eq!(rig.service.health().state, ServiceState::Degraded);
    rig.ask(1, &request(1, 7));
    let (_, reply) = rig.ticks_until_reply(5);
    assert_eq!(reply.status, CaptureStatus::Failed.code());
    assert!(unpack_text(&reply.reason).contains("mission.folder"));
}

#[test]
fn depth_images_come_at_their_rate_with_the_pose_of_their_instant() {
    let dir = tempfile::tempdir().expect("tempdir");
    let mut rig = Rig::new(dir.path());
    let mut stamps = Vec::new();
    for _ in 0..300 {
        rig.tick();
        while let Some(message) = rig.others.depths.receive(tick(rig.k)).expect("depth") {
            let view = FrameView::new(message.header(), message.items()).expect("sane");
            let (eye, [_, _, forward]) = flight().camera(message.stamp_ns());
            let pose = view.header.world_from_camera();
            assert!((pose.position_m - eye).length() < 1e-9);
            assert!((pose.rotation * DVec3::Z - forward).length() < 1e-6);
            assert!(view.rgb.is_empty() && view.header.width == 80);
            stamps.push(message.stamp_ns());
        }
    }
    assert!((6..=7).contains(&stamps.len()), "2 Hz for 3 s: {stamps:?}");
}
