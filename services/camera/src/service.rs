//! One turn of the camera: what has come goes through the state machines, and what they ask for is done.
//!
//! In lockstep a tick is held until an image that decides something has come and a keyframe is on the disk, so that what
//! other members see does not depend on how fast this machine is. A world that does not answer is not waited for inside
//! a tick for longer than [`HOLD`]: the camera then waits at the view, tick after tick, until it is back. Those ticks take
//! as long as on a vehicle, for deadlines in mission time would else pass before any service could be started again.

mod storing;

use std::collections::{BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use glam::DVec3;
use shared_types::bus::ReplyAddress;
use shared_types::config::CameraConfig;
use shared_types::folder::{Keyframe, MissionFolder};
use shared_types::messages::{CaptureRequest, KeyframeReason, RenderPurpose, ServiceState, TargetStatus, VehicleState};
use shared_types::payload::unpack_text;
use shared_types::service::{Context, HealthReport, Service, ServiceError, Step, StopAnswer};
use shared_types::trace::Stage;
use shared_types::{NS_PER_S, TICK_NS, stage};

use crate::logic::gate::{Limits, Shot, Stillness};
use crate::logic::image::{keyframe, stream_header};
use crate::logic::pose_buffer::{CameraMotion, PoseBuffer, PoseError, camera_motion};
use crate::logic::schedule::Schedule;
use crate::ports::Ports;
use crate::source::{Delivery, Image, ImageRequest, RgbdSource, SourceError};
use crate::state::{Capture, Captures, Effect, Event};
use crate::writer::Writer;

/// Longest wait inside a tick for an image, wall time: below the 2 s after which a member that stands still is found out.
const HOLD: Duration = Duration::from_millis(1_500);
/// Age of the newest pose above which no depth image is taken with it.
const STALE_NS: u64 = NS_PER_S / 2;
/// Instants that wait for the states on their other side; more than a second of them is never needed.
const MAX_INSTANTS: usize = 64;

/// An image that was asked for.
#[derive(Debug)]
struct InFlight {
    id: u64,
    stamp_ns: u64,
    motion: CameraMotion,
    since: Instant,
    told: bool,
    _stage: Stage,
}

impl InFlight {
    /// Whether the present tick should still be held for it.
    fn holds(&self) -> bool {
        self.since.elapsed() < HOLD
    }
}

/// Everything but the source, so that the source can hand images over while the rest works on them.
struct Core {
    ports: Ports,
    config: CameraConfig,
    lockstep: bool,
    poses: PoseBuffer,
    captures: Captures,
    instants: VecDeque<u64>,
    folder: Option<MissionFolder>,
    exposure_locked: bool,
    landed: bool,
    writer: Writer,
    writing: bool,
    built: Option<Keyframe>,
    published: BTreeSet<(u32, u64)>,
    depth_schedule: Schedule,
    stream_schedule: Schedule,
    stream_sent_at: Option<Instant>,
    capture: Option<InFlight>,
    depth: Option<InFlight>,
    stream: Option<InFlight>,
    to_request: VecDeque<ImageRequest>,
    to_cancel: Vec<u64>,
    next_id: u64,
    frames: u64,
    progress: u64,
    last_error: String,
    world_error: String,
    /// The present tick, and when its first turn began.
    tick: (u64, Instant),
    failed: Option<ServiceError>,
}

/// The camera.
pub struct CameraService {
    source: Box<dyn RgbdSource>,
    core: Core,
    stopping: bool,
}

impl core::fmt::Debug for CameraService {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("CameraService").field("capture", self.core.captures.state()).finish_non_exhaustive()
    }
}

impl CameraService {
    /// A camera over its channels and a source.
    ///
    /// # Errors
    /// When the writer's thread cannot be started.
    pub fn new(ports: Ports, source: Box<dyn RgbdSource>, context: &Context) -> Result<Self, ServiceError> {
        let config = context.config.camera.clone();
        let writer = Writer::start()
            .map_err(|error| ServiceError::Other(format!("cannot start the thread that writes keyframes: {error}")))?;
        let mut core = Core {
            ports,
            lockstep: context.lockstep(),
            poses: PoseBuffer::default(),
            captures: Captures::new(Limits::of(&config)),
            instants: VecDeque::new(),
            folder: None,
            exposure_locked: false,
            landed: true,
            writer,
            writing: false,
            built: None,
            published: BTreeSet::new(),
            depth_schedule: Schedule::new(config.depth_hz),
            stream_schedule: Schedule::new(config.stream_hz),
            stream_sent_at: None,
            capture: None,
            depth: None,
            stream: None,
            to_request: VecDeque::new(),
            to_cancel: Vec::new(),
            // Render requests of an earlier life must not be answered to this one: its start is later than all their ids.
            next_id: context.incarnation,
            frames: 0,
            progress: 0,
            last_error: String::new(),
            world_error: String::new(),
            tick: (0, Instant::now()),
            failed: None,
            config,
        };
        if !context.config.mission.folder.is_empty() {
            core.open_folder(&context.config.mission.folder);
        }
        Ok(Self { source, core, stopping: false })
    }

    fn flush(&mut self, now_ns: u64) -> Result<(), ServiceError> {
        for id in self.core.to_cancel.drain(..) {
            self.source.cancel(id);
        }
        while let Some(request) = self.core.to_request.pop_front() {
            match self.source.request(now_ns, &request) {
                Ok(()) => {}
                // The client keeps the request and sends it again.
                Err(SourceError::Bus(error)) => tracing::debug!(%error, "a request for an image waits"),
            }
        }
        Ok(())
    }
}

impl Service for CameraService {
    fn step(&mut self, now_ns: u64) -> Result<Step, ServiceError> {
        if self.core.tick.0 != now_ns {
            self.core.tick = (now_ns, Instant::now());
        }
        let locked = self.core.exposure_locked;
        self.core.take_mission(now_ns)?;
        if self.core.exposure_locked != locked {
            self.source.lock_exposure(self.core.exposure_locked);
        }
        self.core.take_requests(now_ns)?;
        self.core.take_states(now_ns)?;
        self.core.consider_instants();
        self.core.on(now_ns, Event::Time(now_ns))?;
        self.core.schedule(now_ns);
        self.flush(now_ns)?;
        let core = &mut self.core;
        self.source
            .poll(now_ns, &mut |delivery| core.deliver(now_ns, delivery))
            .map_err(|SourceError::Bus(error)| ServiceError::Bus(error))?;
        if let Some(error) = self.core.failed.take() {
            return Err(error);
        }
        self.core.take_written(now_ns)?;
        self.flush(now_ns)?;
        if self.stopping && !self.core.writing {
            return Ok(Step::Leave);
        }
        Ok(if self.core.holds() { Step::Waiting } else { Step::Done })
    }

    fn work(&self) -> u64 {
        self.core.progress
    }

    fn period(&self) -> Duration {
        Duration::from_millis(10)
    }

    fn rejoin(&mut self, _now_ns: u64) {
        self.core.captures.forget();
        self.core.poses.clear();
        self.core.instants.clear();
        for in_flight in
            [self.core.capture.take(), self.core.depth.take(), self.core.stream.take()].into_iter().flatten()
        {
            self.source.cancel(in_flight.id);
        }
        self.core.to_request.clear();
    }

    fn health(&self) -> HealthReport {
        let errors = [&self.core.last_error, &self.core.world_error];
        let error = errors.into_iter().find(|error| !error.is_empty());
        HealthReport {
            state: if error.is_some() { ServiceState::Degraded } else { ServiceState::Running },
            last_error: error.cloned().unwrap_or_default(),
            received: self.core.ports.received(),
            sent: self.core.ports.sent(),
            dropped: self.core.ports.dropped(),
        }
    }

    fn stop(&mut self, _now_ns: u64) -> StopAnswer {
        self.stopping = true;
        if self.core.writing { StopAnswer::Later } else { StopAnswer::Now }
    }
}

impl Core {
    fn take_mission(&mut self, now_ns: u64) -> Result<(), ServiceError> {
        let Some(mission) = self.ports.mission(now_ns)? else { return Ok(()) };
        self.exposure_locked = mission.exposure_locked == 1;
        let path = unpack_text(&mission.folder);
        let held = self.folder.as_ref().is_some_and(|folder| folder.root() == std::path::Path::new(&path));
        if !path.is_empty() && !held {
            self.open_folder(&path);
        }
        Ok(())
    }

    fn open_folder(&mut self, path: &str) {
        match MissionFolder::open(path) {
            Ok(folder) => {
                self.folder = Some(folder);
                self.published.clear();
            }
            Err(error) => {
                tracing::warn!(%error, "no mission folder");
                self.last_error = error.to_string();
            }
        }
    }

    fn take_requests(&mut self, now_ns: u64) -> Result<(), ServiceError> {
        // After a rejoin the writer may still have a keyframe whose job was forgotten: whether it exists is known after.
        if self.writing && !matches!(self.captures.state(), Capture::Storing { .. }) {
            return Ok(());
        }
        while let Some((request, from)) = self.ports.next_request(now_ns)? {
            self.asked(now_ns, request, from)?;
        }
        Ok(())
    }

    fn asked(&mut self, now_ns: u64, request: CaptureRequest, from: ReplyAddress) -> Result<(), ServiceError> {
        let Some(folder) = &self.folder else {
            let reason = "no mission folder: start the mission, or set mission.folder".to_owned();
            return self.on(now_ns, Event::Unanswerable { request, from, reason });
        };
        let stored = match KeyframeReason::from_code(request.reason) {
            None | Some(KeyframeReason::Stream) => None,
            Some(reason) => match folder.read_frame(reason, request.keyframe_id) {
                // An earlier view of the prior is replaced, not repeated.
                Ok(frame) => frame.filter(|frame| frame.id == request.keyframe_id),
                Err(error) => {
                    let reason = error.to_string();
                    return self.on(now_ns, Event::Unanswerable { request, from, reason });
                }
            },
        };
        self.on(now_ns, Event::Asked { request, from, stored: stored.as_ref() })
    }

    fn take_states(&mut self, now_ns: u64) -> Result<(), ServiceError> {
        while let Some(state) = self.ports.next_state(now_ns)? {
            self.poses.push(&state);
            self.landed = state.landed == 1;
            let stamp_ns = state.position_stamp_ns;
            let Some(target_id) = self.at_view(&state) else { continue };
            self.on(now_ns, Event::Arrived { target_id, stamp_ns })?;
            if self.instants.back().is_none_or(|last| *last < stamp_ns) {
                self.instants.push_back(stamp_ns);
                if self.instants.len() > MAX_INSTANTS {
                    self.instants.pop_front();
                }
            }
        }
        Ok(())
    }

    /// The target whose end the vehicle is at, when that is the view that is wanted.
    fn at_view(&self, state: &VehicleState) -> Option<u64> {
        let (Capture::WaitingForArrival { job } | Capture::Gating { job, .. }) = self.captures.state() else {
            return None;
        };
        let wanted = job.request.target_id;
        let arrived = state.target_status == TargetStatus::Arrived.code() && state.target_id == wanted;
        (wanted == 0 || arrived).then_some(wanted)
    }

    /// Offers every instant to the gate for which the pose is known by now, without extrapolation.
    fn consider_instants(&mut self) {
        let Capture::Gating { job, .. } = self.captures.state() else {
            self.instants.clear();
            return;
        };
        let look_at_m = DVec3::from_array(job.request.look_at_m);
        while let Some(&stamp_ns) = self.instants.front() {
            match self.poses.motion_at(stamp_ns, 0) {
                Ok(vehicle) => {
                    let motion = camera_motion(&self.config, &vehicle);
                    let distance_m = motion.world_from_camera.position_m.distance(look_at_m);
                    let still = Stillness::of(&self.config, &motion, distance_m, self.poses.time_uncertainty_s());
                    self.captures.on(Event::Instant(Shot { stamp_ns, motion, still, gate_missed: false }));
                }
                // The states on its other side are still to come.
                Err(PoseError::TooNew { .. } | PoseError::Nothing(_)) => return,
                Err(error @ (PoseError::TooOld(_) | PoseError::Gap(_))) => {
                    tracing::debug!(%error, stamp_ns, "an instant without a pose is passed over");
                }
            }
            self.instants.pop_front();
        }
    }

    fn on(&mut self, now_ns: u64, event: Event<'_>) -> Result<(), ServiceError> {
        for effect in self.captures.on(event) {
            match effect {
                Effect::Render(shot) => {
                    let request = self.request(RenderPurpose::Capture, shot.stamp_ns);
                    self.capture = Some(in_flight(&request, shot.motion));
                }
                Effect::CancelRender => self.to_cancel.extend(self.capture.take().map(|in_flight| in_flight.id)),
                Effect::Store => self.store(now_ns)?,
                Effect::Publish => {
                    if let Some(keyframe) = self.built.take() {
                        self.publish(now_ns, &keyframe)?;
                    }
                }
                Effect::Republish(request) => self.republish(now_ns, &request)?,
                Effect::Reply(to, reply) => self.ports.reply(now_ns, &to, &reply)?,
            }
        }
        Ok(())
    }

    fn request(&mut self, purpose: RenderPurpose, stamp_ns: u64) -> ImageRequest {
        let intrinsics = match purpose {
            RenderPurpose::Capture => self.config.intrinsics(),
            RenderPurpose::Stream => self.config.stream_intrinsics(),
            RenderPurpose::Depth => self.config.depth_intrinsics(),
        };
        self.next_id += 1;
        let request = ImageRequest { id: self.next_id, purpose, stamp_ns, intrinsics };
        self.to_request.push_back(request);
        request
    }

    /// Asks for a small depth image and for an image of the stream when they are due. A capture goes first: at most one
    /// image of each kind is under way, so it waits for no more than those.
    fn schedule(&mut self, now_ns: u64) {
        if self.capture.is_some() || self.landed {
            return;
        }
        let Some(stamp_ns) = self.poses.newest_ns().filter(|stamp| stamp + STALE_NS > now_ns) else { return };
        let Ok(vehicle) = self.poses.motion_at(stamp_ns, 0) else { return };
        let motion = camera_motion(&self.config, &vehicle);
        if self.depth.is_none() && self.depth_schedule.due(now_ns) {
            let request = self.request(RenderPurpose::Depth, stamp_ns);
            self.depth = Some(in_flight(&request, motion));
        }
        // Simulated time may run many times faster than the machine can render: the stream, which decides nothing, keeps
        // to its rate on the wall's clock too.
        let rested = self.stream_sent_at.is_none_or(|at| at.elapsed().as_secs_f64() * self.config.stream_hz >= 1.0);
        if self.stream.is_none() && rested && self.ports.stream_wanted() && self.stream_schedule.due(now_ns) {
            let request = self.request(RenderPurpose::Stream, stamp_ns);
            self.stream = Some(in_flight(&request, motion));
            self.stream_sent_at = Some(Instant::now());
        }
    }

    fn deliver(&mut self, now_ns: u64, delivery: Delivery<'_>) {
        self.progress += 1;
        self.world_error.clear();
        if self.failed.is_some() {
            return;
        }
        let id = delivery.id();
        let taken = |slot: &mut Option<InFlight>| slot.take_if(|in_flight| in_flight.id == id);
        let result = if taken(&mut self.capture).is_some() {
            self.captured(now_ns, delivery)
        } else if let Some(asked) = taken(&mut self.depth) {
            self.send_stream(now_ns, &asked, RenderPurpose::Depth, &delivery)
        } else if let Some(asked) = taken(&mut self.stream) {
            self.send_stream(now_ns, &asked, RenderPurpose::Stream, &delivery)
        } else {
            Ok(())
        };
        self.failed = result.err();
    }

    fn captured(&mut self, now_ns: u64, delivery: Delivery<'_>) -> Result<(), ServiceError> {
        let image = match delivery {
            Delivery::Image(image) => image,
            Delivery::Gone { .. } => return self.on(now_ns, Event::ImageGone { now_ns }),
            Delivery::Refused { reason, .. } => {
                self.last_error.clone_from(&reason);
                return self.on(now_ns, Event::ImageRefused(reason));
            }
        };
        let Capture::Rendering { job, shot } = self.captures.state() else { return Ok(()) };
        // A source with frames of its own delivers the one nearest to the wanted instant: the pose is that of its stamp.
        let shot = match self.shot_of(&image, shot) {
            Ok(shot) => shot,
            Err(error) => {
                tracing::debug!(%error, "an image without a pose; another instant is chosen");
                return self.on(now_ns, Event::ImageGone { now_ns });
            }
        };
        match keyframe(&self.config, &job.request, &shot, self.exposure_locked, &image) {
            Ok(keyframe) => {
                self.last_error.clear();
                self.built = Some(keyframe);
                self.on(now_ns, Event::Image(shot))
            }
            Err(reason) => self.on(now_ns, Event::ImageRefused(reason)),
        }
    }

    fn shot_of(&self, image: &Image<'_>, wanted: &Shot) -> Result<Shot, PoseError> {
        if image.stamp_ns == wanted.stamp_ns {
            return Ok(*wanted);
        }
        let vehicle = self.poses.motion_at(image.stamp_ns, TICK_NS)?;
        Ok(Shot { stamp_ns: image.stamp_ns, motion: camera_motion(&self.config, &vehicle), ..*wanted })
    }

    fn send_stream(
        &mut self,
        now_ns: u64,
        asked: &InFlight,
        purpose: RenderPurpose,
        delivery: &Delivery<'_>,
    ) -> Result<(), ServiceError> {
        match delivery {
            Delivery::Image(image) => {
                let motion = if image.stamp_ns == asked.stamp_ns {
                    asked.motion
                } else {
                    match self.poses.motion_at(image.stamp_ns, TICK_NS) {
                        Ok(vehicle) => camera_motion(&self.config, &vehicle),
                        Err(_) => return Ok(()),
                    }
                };
                self.frames += 1;
                let header = stream_header(self.frames, image, &motion, self.poses.time_uncertainty_s());
                match purpose {
                    RenderPurpose::Depth => self.ports.send_depth(now_ns, image.stamp_ns, &header, image.items)?,
                    _ => self.ports.send_frame(now_ns, image.stamp_ns, &header, image.items)?,
                }
            }
            Delivery::Gone { .. } => {}
            Delivery::Refused { reason, .. } => {
                tracing::warn!(%purpose, %reason, "an image of the stream was refused");
                self.last_error.clone_from(reason);
            }
        }
        Ok(())
    }

    /// Whether the present tick must not end yet. Tells it when the world keeps everybody waiting.
    fn holds(&mut self) -> bool {
        for in_flight in [&mut self.capture, &mut self.depth].into_iter().flatten() {
            if !in_flight.holds() && !in_flight.told {
                in_flight.told = true;
                self.world_error = format!("the world has not answered for {:.1} s", HOLD.as_secs_f64());
                tracing::warn!(stamp_ns = in_flight.stamp_ns, "the world does not answer; waiting at the view");
            }
        }
        // A world that has let one tick pass is not waited for inside another until it answers; time only keeps to the
        // wall's meanwhile.
        let mut awaited = [&self.capture, &self.depth].into_iter().flatten();
        let holds = if self.world_error.is_empty() {
            awaited.any(InFlight::holds)
        } else {
            awaited.next().is_some() && self.tick.1.elapsed() < Duration::from_nanos(TICK_NS)
        };
        self.lockstep && (holds || self.writing)
    }
}

fn in_flight(request: &ImageRequest, motion: CameraMotion) -> InFlight {
    let _stage = match request.purpose {
        RenderPurpose::Capture => stage!("image of a keyframe", track = "keyframes"),
        RenderPurpose::Depth => stage!("depth image", track = "depth"),
        RenderPurpose::Stream => stage!("image of the stream", track = "stream"),
    };
    InFlight { id: request.id, stamp_ns: request.stamp_ns, motion, since: Instant::now(), told: false, _stage }
}
