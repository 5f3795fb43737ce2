//! A scene that is ray-cast analytically: a textured ball on a textured floor.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};
use shared_types::config::{ModelConfig, TrainerConfig};
use shared_types::folder::{Exposure, FolderError, Frame, Gate, Keyframe};
use shared_types::frames::{Intrinsics, Pose, look_at};
use shared_types::messages::{KeyframeReason, RoundRequest};
use splatting::{Engine, RenderSettings, Rendered, metrics};
use trainer::keyframes::{KeyframeSource, renderer_camera};
use trainer::round::RoundSpec;
use trainer::session::Session;

pub const WIDTH: u32 = 96;
pub const HEIGHT: u32 = 72;
const BALL: DVec3 = DVec3::new(0.1, -0.05, 0.5);
const BALL_RADIUS: f64 = 0.5;
const DEPTH_UNIT_M: f64 = 0.0002;

fn texture(p: DVec3) -> DVec3 {
    let wave = |f: f64, phase: f64| (f * p.x + phase).sin() * (f * p.y - phase).cos() * (f * p.z + 0.5 * phase).cos();
    DVec3::new(
        0.5 + 0.3 * wave(9.0, 0.3) + 0.1 * wave(23.0, 1.0),
        0.45 + 0.35 * wave(7.0, 2.0),
        0.4 + 0.3 * wave(13.0, 0.9),
    )
}

/// Distance along a unit ray and colour; `None` for the sky. The last value tells whether the ball was hit.
fn cast(origin: DVec3, direction: DVec3) -> Option<(f64, DVec3, bool)> {
    let to_ball = origin - BALL;
    let (b, c) = (to_ball.dot(direction), to_ball.length_squared() - BALL_RADIUS * BALL_RADIUS);
    let root = b * b - c;
    if root > 0.0 && -b - root.sqrt() > 0.0 {
        let t = -b - root.sqrt();
        let point = origin + direction * t;
        let light = 0.6 + 0.4 * ((point - BALL) / BALL_RADIUS).dot(DVec3::new(0.3, -0.5, 0.8).normalize()).max(0.0);
        return Some((t, texture(point) * light, true));
    }
    let t = -origin.z / direction.z;
    (t > 0.0 && t < 12.0).then(|| (t, texture(origin + direction * t) * 0.8, false))
}

pub struct View {
    pub pose: Pose,
    pub keyframe: Keyframe,
    /// Pixels whose central ray hits the ball.
    pub mask: Vec<bool>,
}

/// A view from this direction (degrees) at radius R about the box centre.
pub fn view(id: u64, azimuth_deg: f64, elevation_deg: f64, size: (u32, u32)) -> View {
    let intrinsics = Intrinsics::from_hfov(size.0, size.1, 1.204);
    let (az, el) = (azimuth_deg.to_radians(), elevation_deg.to_radians());
    let center = DVec3::from_array(request(0, 0).box_center_m);
    let eye = center + request(0, 0).radius_m * DVec3::new(az.cos() * el.cos(), az.sin() * el.cos(), el.sin());
    let pose = look_at(eye, center);
    let ray = |x: f64, y: f64| {
        let at_one = intrinsics.backproject(DVec2::new(x, y), 1.0);
        let direction = pose.rotation * at_one;
        cast(pose.position_m, direction.normalize()).map(|(t, color, ball)| (t / at_one.length(), color, ball))
    };
    let (mut rgb, mut depth_units, mut mask) = (Vec::new(), Vec::new(), Vec::new());
    for row in 0..size.1 {
        for column in 0..size.0 {
            let (x, y) = (f64::from(column), f64::from(row));
            let mut color = DVec3::ZERO;
            for (dx, dy) in [(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)] {
                color += ray(x + dx, y + dy).map_or(DVec3::new(0.6, 0.7, 0.9), |(_, color, _)| color) / 4.0;
            }
            rgb.extend(color.to_array().map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8));
            let center = ray(x + 0.5, y + 0.5);
            depth_units.push(center.map_or(0, |(depth, ..)| (depth / DEPTH_UNIT_M).round() as u16));
            mask.push(center.is_some_and(|(.., ball)| ball));
        }
    }
    let frame = Frame {
        id,
        stamp_ns: id,
        reason: KeyframeReason::Selected,
        candidate: None,
        target_id: 0,
        look_at_m: center.to_array(),
        world_from_camera_position_m: pose.position_m.to_array(),
        world_from_camera_xyzw: pose.rotation.to_array(),
        intrinsics,
        depth_unit_m: DEPTH_UNIT_M,
        gate: Gate::default(),
        exposure: Exposure::default(),
    };
    View { pose, keyframe: Keyframe { frame, rgb, depth_units }, mask }
}

/// Eight views to train on, in a low and a high ring.
pub fn training_views(size: (u32, u32)) -> Vec<View> {
    (0..8).map(|k| view(k, 45.0 * k as f64, if k % 2 == 0 { 15.0 } else { 50.0 }, size)).collect()
}

/// Three views between them.
pub fn held_out_views() -> Vec<View> {
    [(20.0, 30.0), (110.0, 25.0), (245.0, 40.0)]
        .iter()
        .zip(100..)
        .map(|(&(azimuth, elevation), id)| view(id, azimuth, elevation, (WIDTH, HEIGHT)))
        .collect()
}

pub fn request(round: u32, max_iterations: u32) -> RoundRequest {
    RoundRequest {
        round,
        max_iterations,
        box_center_m: [0.0, 0.0, 0.5],
        box_size_m: 1.6,
        radius_m: 1.9,
        seed: 11 + u64::from(round),
        ..RoundRequest::default()
    }
}

pub fn spec(round: u32, max_iterations: u32, keyframes: &[u64]) -> RoundSpec {
    RoundSpec::from_request(&request(round, max_iterations), keyframes).unwrap()
}

/// Keyframes in memory.
pub struct Memory(pub BTreeMap<u64, Keyframe>);

impl Memory {
    pub fn new(size: (u32, u32)) -> Self {
        Self(training_views(size).into_iter().map(|view| (view.keyframe.frame.id, view.keyframe)).collect())
    }
}

impl KeyframeSource for Memory {
    fn read(&mut self, id: u64) -> Result<Option<Keyframe>, FolderError> {
        Ok(self.0.get(&id).cloned())
    }
}

pub fn model_config() -> ModelConfig {
    ModelConfig { max_gaussians: 50_000, width: WIDTH, height: HEIGHT }
}

pub fn session(config: TrainerConfig, threads: usize) -> Session {
    Session::new(config, model_config(), Engine::new(threads).unwrap())
}

/// Mean PSNR of held-out views over the ball, dB.
pub fn held_out_psnr_db(session: &mut Session) -> f64 {
    let views = held_out_views();
    let mut image = Rendered::default();
    let total: f64 = views
        .iter()
        .map(|view| {
            let camera = renderer_camera(&view.pose, &view.keyframe.frame.intrinsics);
            let (backend, model) = session.backend_and_model();
            backend.render(model, &camera, &RenderSettings::default(), &mut image).unwrap();
            let truth: Vec<[f32; 3]> =
                view.keyframe.rgb.chunks_exact(3).map(|c| [c[0], c[1], c[2]].map(|v| f32::from(v) / 255.0)).collect();
            metrics::psnr(&image.color, &truth, Some(&view.mask)).unwrap()
        })
        .sum();
    total / views.len() as f64
}
