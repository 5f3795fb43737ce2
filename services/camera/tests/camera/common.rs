//! A vehicle that hovers, and a world with one cube: what the camera talks to in its tests.

use glam::{DMat3, DQuat, DVec3};
use shared_types::TICK_NS;
use shared_types::bus::{Bus, Client, Limits, Publisher, Server, Subscriber};
use shared_types::channel::{CaptureChannel, DepthChannel, KeyframeChannel, RenderChannel, VehicleStateChannel};
use shared_types::config::{CameraConfig, Config};
use shared_types::messages::{
    CaptureReply, CaptureRequest, KeyframeReason, RenderPurpose, RenderReply, RenderRequest, RenderStatus,
    TargetStatus, VehicleState,
};
use shared_types::service::{Context, ServiceName};
use shared_types::system::System;

/// A system of its own, gone with the test.
pub struct Domain {
    pub system: System,
    pub config: Config,
    _base: tempfile::TempDir,
}

impl Domain {
    pub fn new(camera: CameraConfig) -> Self {
        let base = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
        let config = Config { camera, ..Config::default() };
        Self { system: System::create(base.path(), "t", 0).expect("system"), config, _base: base }
    }

    pub fn join(&self, name: ServiceName) -> Bus {
        Bus::open(&self.system, Limits::of(&self.config), name, 7, name.is_member(&self.config)).expect("joined")
    }

    pub fn camera(&self) -> Context {
        Context::open(ServiceName::Camera, self.config.clone(), self.system.clone(), false).expect("context")
    }
}

impl Drop for Domain {
    fn drop(&mut self) {
        drop(self.system.remove());
    }
}

pub const CUBE_CENTER_M: DVec3 = DVec3::new(0.1, -0.2, 0.6);
pub const CUBE_HALF_M: f64 = 0.4;
pub const DEPTH_UNIT_M: f64 = 0.000_2;

/// A steady motion of the vehicle, with what follows for the camera reckoned without any code of Vantage.
#[derive(Clone, Copy)]
pub struct Flight {
    pub start_m: DVec3,
    pub velocity_mps: DVec3,
    pub yaw_rad: f64,
    pub yaw_rate_radps: f64,
    pub pitch_rad: f64,
    pub lever_body_m: [f64; 3],
    pub lever_gimbal_m: [f64; 3],
}

impl Flight {
    fn at(&self, stamp_ns: u64) -> (DVec3, f64) {
        let t = stamp_ns as f64 * 1e-9;
        (self.start_m + self.velocity_mps * t, self.yaw_rad + self.yaw_rate_radps * t)
    }

    /// Eye, and the directions right, down and forward of the image.
    pub fn camera(&self, stamp_ns: u64) -> (DVec3, [DVec3; 3]) {
        let (body, yaw) = self.at(stamp_ns);
        let (north, east) = yaw.sin_cos();
        let (up, level) = self.pitch_rad.sin_cos();
        let forward = DVec3::new(level * east, level * north, up);
        let right = DVec3::new(north, -east, 0.0);
        let down = forward.cross(right);
        let ahead = DVec3::new(east, north, 0.0);
        let [x, y, z] = self.lever_body_m;
        let pivot = body + ahead * x - right * y + DVec3::Z * z;
        let [x, y, z] = self.lever_gimbal_m;
        (pivot + forward * x - right * y - down * z, [right, down, forward])
    }

    /// What px4-link would say: position, attitude and gimbal at instants of their own.
    pub fn state(&self, now_ns: u64, target_id: u64) -> VehicleState {
        let (position_ns, gimbal_ns) = (now_ns - 4_000_000, now_ns / 50_000_000 * 50_000_000);
        let (position, _) = self.at(position_ns);
        let (_, yaw) = self.at(now_ns);
        let (_, gimbal_yaw) = self.at(gimbal_ns);
        let gimbal = DQuat::from_rotation_z(gimbal_yaw) * DQuat::from_rotation_y(-self.pitch_rad);
        VehicleState {
            incarnation: 1,
            position_stamp_ns: position_ns,
            attitude_stamp_ns: now_ns,
            gimbal_stamp_ns: gimbal_ns,
            target_id,
            position_m: position.to_array(),
            velocity_mps: self.velocity_mps.to_array(),
            world_from_body_xyzw: DQuat::from_rotation_z(yaw).to_array(),
            body_rates_radps: [0.0, 0.0, self.yaw_rate_radps],
            world_from_gimbal_xyzw: gimbal.to_array(),
            gimbal_rates_radps: [0.0, 0.0, self.yaw_rate_radps],
            target_status: TargetStatus::Arrived.code(),
            gimbal_present: 1,
            armed: 1,
            ..VehicleState::default()
        }
    }
}

/// Distance of a point to the surface of the cube or of the ground, metres.
pub fn distance_to_scene(point: DVec3) -> f64 {
    let q = (point - CUBE_CENTER_M).abs() - DVec3::splat(CUBE_HALF_M);
    let cube = q.max(DVec3::ZERO).length() + q.max_element().min(0.0);
    cube.abs().min(point.z.abs())
}

/// The world's process: casts one ray through each pixel. `shift_px` moves the rays, to show that it matters.
pub struct World {
    server: Server<RenderChannel>,
    pub flight: Flight,
    pub shift_px: f64,
    pub known_ns: std::ops::RangeInclusive<u64>,
    pub served: usize,
}

impl World {
    pub fn new(domain: &Domain, flight: Flight) -> Self {
        let server = domain.join(ServiceName::World).server().expect("server");
        Self { server, flight, shift_px: 0.0, known_ns: 0..=u64::MAX, served: 0 }
    }

    pub fn work(&mut self) {
        while let Some(message) = self.server.receive(0).expect("requests") {
            let (request, to) = (*message.header(), message.address());
            drop(message);
            self.served += 1;
            let color = request.purpose != RenderPurpose::Depth.code();
            let known = self.known_ns.contains(&request.image_stamp_ns);
            let reply = RenderReply {
                image_stamp_ns: request.image_stamp_ns,
                depth_unit_m: DEPTH_UNIT_M,
                status: if known { RenderStatus::Done.code() } else { RenderStatus::NoTruth.code() },
                width: request.width,
                height: request.height,
                has_color: u32::from(color),
                ..RenderReply::default()
            };
            let items = if known { self.render(&request, color) } else { Vec::new() };
            self.server.reply(0, &to, &reply, &items).expect("reply");
        }
    }

    fn render(&self, request: &RenderRequest, color: bool) -> Vec<u8> {
        let (eye, [right, down, forward]) = self.flight.camera(request.image_stamp_ns);
        let (mut rgb, mut depth) = (Vec::new(), Vec::new());
        for row in 0..request.height {
            for column in 0..request.width {
                let x = (f64::from(column) + 0.5 + self.shift_px - request.principal_px[0]) / request.focal_px[0];
                let y = (f64::from(row) + 0.5 + self.shift_px - request.principal_px[1]) / request.focal_px[1];
                // Of unit depth along the optical axis, so that the ray's parameter is the depth.
                let ray = DMat3::from_cols(right, down, forward) * DVec3::new(x, y, 1.0);
                let t = hit(eye, ray);
                depth.extend(((t / DEPTH_UNIT_M).round().min(65_535.0) as u16).to_le_bytes());
                let point = eye + ray * t;
                rgb.extend([column as u8, row as u8, (point.z * 100.0) as u8]);
            }
        }
        if color { [rgb, depth].concat() } else { depth }
    }
}

/// Where a ray first meets the cube or the ground; 0 when it meets neither.
fn hit(eye: DVec3, ray: DVec3) -> f64 {
    let (a, b) = ((CUBE_CENTER_M - CUBE_HALF_M - eye) / ray, (CUBE_CENTER_M + CUBE_HALF_M - eye) / ray);
    let (near, far) = (a.min(b).max_element(), a.max(b).min_element());
    let ground = if ray.z < 0.0 { -eye.z / ray.z } else { f64::INFINITY };
    let cube = if near <= far && near > 0.0 { near } else { f64::INFINITY };
    let t = cube.min(ground);
    if t.is_finite() { t } else { 0.0 }
}

/// The planner's and px4-link's ends.
pub struct Others {
    states: Publisher<VehicleStateChannel>,
    client: Client<CaptureChannel>,
    pub keyframes: Subscriber<KeyframeChannel>,
    pub depths: Subscriber<DepthChannel>,
}

impl Others {
    pub fn new(domain: &Domain) -> Self {
        let (link, planner) = (domain.join(ServiceName::Px4Link), domain.join(ServiceName::Planner));
        Self {
            states: link.publisher().expect("states"),
            client: planner.client().expect("client"),
            keyframes: planner.subscriber().expect("keyframes"),
            depths: planner.subscriber().expect("depths"),
        }
    }

    pub fn fly(&mut self, now_ns: u64, state: &VehicleState) {
        self.states.send(now_ns, state.position_stamp_ns, state).expect("sent");
    }

    pub fn ask(&mut self, now_ns: u64, request_id: u64, request: &CaptureRequest) {
        self.client.send(now_ns, request_id, request, &[]).expect("sent");
    }

    pub fn reply(&mut self, now_ns: u64) -> Option<(u64, CaptureReply)> {
        let message = self.client.receive(now_ns).expect("replies")?;
        Some((message.request_id(), *message.header()))
    }
}

pub fn request(keyframe_id: u64, target_id: u64) -> CaptureRequest {
    CaptureRequest {
        keyframe_id,
        target_id,
        deadline_ns: 60_000_000_000,
        look_at_m: CUBE_CENTER_M.to_array(),
        reason: KeyframeReason::Selected.code(),
        candidate: 5,
    }
}

/// Mission time of a tick.
pub fn tick(k: u64) -> u64 {
    1_000_000_000 + k * TICK_NS
}
