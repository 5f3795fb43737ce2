//! The service: builds the scene, keeps the truth of the last seconds, and renders what is asked for.
//!
//! It is no member of the lockstep clock: it answers inside the tick of the request, as soon as the truth of the wanted stamp
//! is there. It keeps no answers: the same request gives the same image, and rendering again is as good as remembering.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};
use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};
use shared_types::bus::{Bus, Listener, ReplyAddress};
use shared_types::config::Config;
use shared_types::config::world::MeshUp;
use shared_types::frames::{Intrinsics, Pose};
use shared_types::messages::{RenderPurpose, RenderReply, RenderRequest, RenderStatus, ServiceState};
use shared_types::service::{Context, HealthReport, Service, ServiceError, Step};
use shared_types::stage;

use crate::history::{Lookup, TruthHistory};
use crate::mesh::UpAxis;
use crate::ports::Ports;
use crate::render::{DepthNoise, RenderOptions, RgbdImage, Threads, render};
use crate::scene::{Scene, SceneConfig, SceneError};
use crate::state::{Event, State};

/// Metres per unit of depth on the channel: half a millimetre reaches 32 m.
pub const DEPTH_UNIT_M: f64 = 0.0005;
/// Requests that wait for their truth; more are refused. There is one camera, and it asks for one image at a time.
const MAX_WAITING: usize = 16;
/// Time between turns while a request waits for its truth.
const ACTIVE_PERIOD: Duration = Duration::from_millis(1);
/// Time between turns while nobody asks; a request wakes the loop.
const IDLE_PERIOD: Duration = Duration::from_millis(20);

/// Runs the world until it is asked to stop.
///
/// # Errors
/// When the bus cannot be joined, or the object cannot be loaded.
pub fn run(mut context: Context) -> anyhow::Result<()> {
    let mut world = World::open(&context.bus, &context.config)?;
    context.run(&mut world)?;
    Ok(())
}

impl SceneConfig {
    /// The scene of a mission's configuration.
    #[must_use]
    pub fn of(config: &Config) -> Self {
        let world = &config.world;
        Self {
            object: world.object.clone(),
            size_m: world.size_m,
            yaw_deg: world.yaw_deg,
            up: match world.up {
                MeshUp::Auto => UpAxis::Auto,
                MeshUp::Y => UpAxis::Y,
                MeshUp::Z => UpAxis::Z,
            },
            seed: world.seed,
            sun_azimuth_deg: world.sun_azimuth_deg,
            sun_elevation_deg: world.sun_elevation_deg,
            ..Self::default()
        }
    }
}

/// Builds the scene on a thread of its own, so that the service is alive meanwhile.
fn build(config: SceneConfig, threads: Arc<Threads>) -> std::io::Result<Receiver<Result<Scene, SceneError>>> {
    let (sender, receiver) = sync_channel(1);
    std::thread::Builder::new().name("scene".to_owned()).spawn(move || {
        // Nobody receives any more once the service has been stopped: then nobody needs the scene either.
        sender.send(Scene::new(&config, &threads)).ok();
    })?;
    Ok(receiver)
}

struct World {
    ports: Ports,
    state: State,
    building: Receiver<Result<Scene, SceneError>>,
    scene: Option<Scene>,
    renderer: Renderer,
    truth: TruthHistory,
    waiting: VecDeque<(ReplyAddress, RenderRequest)>,
    rendered: u64,
    refused: u64,
    last_error: String,
}

impl Service for World {
    fn step(&mut self, now_ns: u64) -> Result<Step, ServiceError> {
        // Requests first: whoever asked for a stamp saw a message that was sent after its truth.
        while let Some((address, request)) = self.ports.receive_request(now_ns)? {
            self.accept(now_ns, address, request)?;
        }
        while let Some((stamp_ns, world_from_camera)) = self.ports.receive_truth(now_ns)? {
            self.truth.push(stamp_ns, world_from_camera);
        }
        if self.state == State::Building {
            self.poll_scene()?;
        }
        self.answer(now_ns)?;
        Ok(Step::Done)
    }

    fn period(&self) -> Duration {
        if self.waiting.is_empty() { IDLE_PERIOD } else { ACTIVE_PERIOD }
    }

    fn listeners(&self) -> Vec<&Listener> {
        vec![self.ports.wakes()]
    }

    fn health(&self) -> HealthReport {
        let (received, lost) = self.ports.counts();
        HealthReport {
            received,
            sent: self.rendered,
            dropped: lost + self.refused,
            last_error: self.last_error.clone(),
            state: if self.state == State::Building { ServiceState::Starting } else { ServiceState::Running },
        }
    }
}

impl World {
    fn open(bus: &Bus, config: &Config) -> anyhow::Result<Self> {
        let threads = Arc::new(Threads::new(match config.world.threads {
            0 => std::thread::available_parallelism().map_or(1, usize::from),
            count => count,
        }));
        Ok(Self {
            ports: Ports::open(bus)?,
            state: State::Building,
            building: build(SceneConfig::of(config), Arc::clone(&threads))?,
            scene: None,
            renderer: Renderer::of(config, threads),
            truth: TruthHistory::default(),
            waiting: VecDeque::new(),
            rendered: 0,
            refused: 0,
            last_error: String::new(),
        })
    }

    /// Puts a request in line, or refuses it. The same one sent again joins the first.
    fn accept(&mut self, now_ns: u64, address: ReplyAddress, request: RenderRequest) -> Result<(), ServiceError> {
        if self.waiting.iter().any(|(other, _)| *other == address) {
            return Ok(());
        }
        let fault = self.renderer.check(&request).err().or_else(|| {
            (self.waiting.len() >= MAX_WAITING).then(|| format!("{MAX_WAITING} render requests wait already"))
        });
        match fault {
            None => self.waiting.push_back((address, request)),
            Some(fault) => {
                tracing::warn!(request = address.request_id, fault, "render request refused");
                self.refused += 1;
                self.last_error = fault;
                self.ports.reply_without_image(now_ns, &address, &request, RenderStatus::Refused)?;
            }
        }
        Ok(())
    }

    fn poll_scene(&mut self) -> Result<(), ServiceError> {
        let outcome = match self.building.try_recv() {
            Err(TryRecvError::Empty) => return Ok(()),
            Ok(Ok(scene)) => Ok(scene),
            Ok(Err(error)) => Err(ServiceError::Unusable(error.to_string())),
            Err(TryRecvError::Disconnected) => {
                Err(ServiceError::Other("the thread that builds the scene ended; see the log".to_owned()))
            }
        };
        match outcome {
            Ok(scene) => {
                self.state = self.state.after(Event::Built);
                tracing::info!(triangles = scene.mesh().triangles.len(), "the world is built");
                self.scene = Some(scene);
                Ok(())
            }
            Err(error) => {
                self.state = self.state.after(Event::BuildFailed);
                Err(error)
            }
        }
    }

    /// Answers every request whose truth is decided; the others stay in line.
    fn answer(&mut self, now_ns: u64) -> Result<(), ServiceError> {
        let Some(scene) = &self.scene else { return Ok(()) };
        for (address, request) in std::mem::take(&mut self.waiting) {
            match self.truth.at(request.image_stamp_ns) {
                Lookup::NotYet => self.waiting.push_back((address, request)),
                Lookup::Gone => {
                    self.refused += 1;
                    self.ports.reply_without_image(now_ns, &address, &request, RenderStatus::NoTruth)?;
                }
                Lookup::At(pose) => {
                    let (header, image) = self.renderer.render(scene, &request, &pose);
                    self.rendered += 1;
                    self.ports.reply_with_image(now_ns, &address, &header, &image)?;
                }
            }
        }
        Ok(())
    }
}

/// Renders what requests ask for, with the settings of the configuration.
struct Renderer {
    threads: Arc<Threads>,
    capture_samples_per_edge: u32,
    depth_range_m: (f32, f32),
    depth_noise_m: f32,
    seed: u64,
    /// Bytes of the largest image that the channel carries.
    max_bytes: u64,
}

impl Renderer {
    fn of(config: &Config, threads: Arc<Threads>) -> Self {
        Self {
            threads,
            capture_samples_per_edge: config.world.samples_per_edge,
            depth_range_m: (config.camera.depth_min_m as f32, config.camera.depth_max_m as f32),
            depth_noise_m: config.world.depth_noise_m as f32,
            seed: config.world.seed,
            max_bytes: u64::from(config.camera.width_px) * u64::from(config.camera.height_px) * 5,
        }
    }

    /// Whether a request makes sense; else what is wrong with it.
    fn check(&self, request: &RenderRequest) -> Result<RenderPurpose, String> {
        let purpose = RenderPurpose::from_code(request.purpose).ok_or_else(|| {
            format!("render request: purpose {} is unknown; expected a camera of this version", request.purpose)
        })?;
        let bytes =
            u64::from(request.width) * u64::from(request.height) * if purpose == RenderPurpose::Depth { 2 } else { 5 };
        if bytes == 0 || bytes > self.max_bytes {
            return Err(format!(
                "render request: an image of {}x{} pixels; expected at least one pixel, and at most camera.width_px x camera.height_px",
                request.width, request.height
            ));
        }
        let lens = [request.focal_px, request.principal_px];
        if !lens.as_flattened().iter().all(|v| v.is_finite()) || request.focal_px.iter().any(|f| *f <= 0.0) {
            return Err(format!(
                "render request: focal lengths {:?} and principal point {:?}; expected finite numbers, focal lengths above 0",
                request.focal_px, request.principal_px
            ));
        }
        Ok(purpose)
    }

    fn render(&self, scene: &Scene, request: &RenderRequest, world_from_camera: &Pose) -> (RenderReply, RgbdImage) {
        let color = request.purpose != RenderPurpose::Depth.code();
        let samples_per_edge =
            if request.purpose == RenderPurpose::Capture.code() { self.capture_samples_per_edge } else { 1 };
        let (depth_min_m, depth_max_m) = self.depth_range_m;
        let noise = DepthNoise { sigma_at_1m_m: self.depth_noise_m, seed: self.seed, stamp_ns: request.image_stamp_ns };
        let options = RenderOptions { samples_per_edge, color, depth_min_m, depth_max_m, noise: Some(noise) };
        let intrinsics = Intrinsics {
            fx: request.focal_px[0],
            fy: request.focal_px[1],
            cx: request.principal_px[0],
            cy: request.principal_px[1],
            width: request.width,
            height: request.height,
        };
        let _stage = stage!("render", width = request.width, color);
        let before_ns = cpu_ns();
        let image = render(scene, world_from_camera, &intrinsics, &options, &self.threads);
        let header = RenderReply {
            image_stamp_ns: request.image_stamp_ns,
            depth_unit_m: DEPTH_UNIT_M,
            cpu_ns: cpu_ns().saturating_sub(before_ns),
            status: RenderStatus::Done.code(),
            width: request.width,
            height: request.height,
            has_color: u32::from(color),
        };
        (header, image)
    }
}

/// CPU time of this process, nanoseconds: over all threads of the renderer.
fn cpu_ns() -> u64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec.unsigned_abs() * 1_000_000_000 + time.tv_nsec.unsigned_abs()
}

#[cfg(test)]
mod tests;
