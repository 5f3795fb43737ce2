//! Listens to a mission's channels beside it: when services do useful work again after a fault, and what the setpoints did.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use shared_types::ServiceName;
use shared_types::bus::{Bus, BusError, Limits};
use shared_types::channel::{HealthChannel, VehicleStateChannel};
use shared_types::config::{Layer, load};
use shared_types::messages::{Commander, FlightMode, ServiceState, VehicleState};
use shared_types::system::System;

/// A service at work: when, and which life of it (its start on the monotonic clock, nanoseconds).
#[derive(Debug, Clone, Copy)]
pub struct AtWork {
    pub service: ServiceName,
    pub incarnation: u64,
    pub at: Instant,
}

/// What was heard.
#[derive(Debug, Default)]
pub struct Heard {
    /// The first time that each life of a service said that it works; for px4-link, that it knows where the vehicle is.
    pub at_work: Vec<AtWork>,
    /// When each life of px4-link (its incarnation) was first seen to fly the vehicle by setpoints.
    pub offboard: Vec<(u64, Instant)>,
    /// Longest way between two setpoints of a stream, and between the vehicle and the first one, metres.
    pub largest_step_m: f64,
}

/// The moment of a fault, on the clock of this program and on that of incarnations.
#[derive(Debug, Clone, Copy)]
pub struct Moment {
    pub at: Instant,
    monotonic_ns: u64,
}

impl Moment {
    pub fn now() -> Self {
        let time = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
        let monotonic_ns = time.tv_sec.unsigned_abs() * 1_000_000_000 + time.tv_nsec.unsigned_abs();
        Self { at: Instant::now(), monotonic_ns }
    }
}

/// A thread that listens until it is dropped.
pub struct Watch {
    heard: Arc<Mutex<Heard>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Watch {
    /// Listens to the system that process `launch` supervises, once there is one.
    pub fn begin(launch: u32) -> Self {
        // What is listened to may vanish at any moment; the bus would print every file of it.
        shared_types::logging::init(shared_types::logging::LevelFilter::OFF);
        let (heard, stop) = (Arc::new(Mutex::new(Heard::default())), Arc::new(AtomicBool::new(false)));
        let (notes, end) = (Arc::clone(&heard), Arc::clone(&stop));
        let thread = std::thread::spawn(move || {
            while !end.load(Ordering::Relaxed) {
                let found = System::list(&System::base_dir()).into_iter().find(|s| s.supervisor_pid == launch);
                if let Some(system) = found.filter(|system| system.config_path().exists()) {
                    // The system may end under our feet: then there is nothing more to hear.
                    drop(listen(&system, &notes, &end));
                    return;
                }
                std::thread::sleep(Duration::from_millis(5));
            }
        });
        Self { heard, stop, thread: Some(thread) }
    }

    /// What was heard so far.
    pub fn look<T>(&self, at: impl FnOnce(&Heard) -> T) -> T {
        at(&self.heard.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// How long after a fault a later life of the service was at work; `None` while none is.
    pub fn back_after(&self, service: &str, fault: Moment) -> Option<Duration> {
        self.look(|heard| {
            let back = |work: &&AtWork| work.service.name() == service && work.incarnation > fault.monotonic_ns;
            heard.at_work.iter().find(back).map(|work| work.at - fault.at)
        })
    }

    /// How long after a fault a later life of px4-link flew the vehicle by setpoints.
    pub fn offboard_after(&self, fault: Moment) -> Option<Duration> {
        self.look(|heard| {
            let back = heard.offboard.iter().find(|(incarnation, _)| *incarnation > fault.monotonic_ns);
            back.map(|(_, at)| *at - fault.at)
        })
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            drop(thread.join());
        }
    }
}

fn listen(system: &System, notes: &Mutex<Heard>, end: &AtomicBool) -> Result<(), BusError> {
    let config = load(&[Layer::of_file(&system.config_path()).expect("a configuration")]).expect("a configuration");
    let bus = Bus::open(system, Limits::of(&config), ServiceName::Command, 0, false)?;
    let mut health = bus.subscriber::<HealthChannel>()?;
    let mut vehicles = bus.subscriber::<VehicleStateChannel>()?;
    let mut last: Option<VehicleState> = None;
    while !end.load(Ordering::Relaxed) {
        while let Some(message) = health.receive(u64::MAX)? {
            let (health, at) = (*message.header(), Instant::now());
            let ready = health.state == ServiceState::Running.code() && health.service != ServiceName::Px4Link.code();
            if let (Some(service), true) = (ServiceName::from_code(health.service), ready) {
                note(notes, service, health.incarnation, at);
            }
        }
        while let Some(message) = vehicles.receive(u64::MAX)? {
            let (state, at) = (*message.header(), Instant::now());
            see(notes, last.as_ref(), &state, at);
            last = Some(state);
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    Ok(())
}

fn note(notes: &Mutex<Heard>, service: ServiceName, incarnation: u64, at: Instant) {
    let mut heard = notes.lock().unwrap_or_else(PoisonError::into_inner);
    if !heard.at_work.iter().any(|work| work.service == service && work.incarnation == incarnation) {
        heard.at_work.push(AtWork { service, incarnation, at });
    }
}

fn see(notes: &Mutex<Heard>, last: Option<&VehicleState>, state: &VehicleState, at: Instant) {
    if state.ready == 1 {
        note(notes, ServiceName::Px4Link, state.incarnation, at);
    }
    let flies = |state: &VehicleState| {
        state.streaming == 1
            && state.mode == FlightMode::Offboard.code()
            && state.commander == Commander::Vantage.code()
    };
    if !flies(state) {
        return;
    }
    let mut heard = notes.lock().unwrap_or_else(PoisonError::into_inner);
    if !heard.offboard.iter().any(|(incarnation, _)| *incarnation == state.incarnation) {
        heard.offboard.push((state.incarnation, at));
    }
    // Within a stream from setpoint to setpoint (50 states a second, a few may be lost to a slow listener), at its beginning
    // from the vehicle itself.
    let from_m = match last {
        Some(last) if flies(last) && last.incarnation == state.incarnation => last.setpoint_position_m,
        _ => state.position_m,
    };
    let step_m = glam::DVec3::from_array(from_m).distance(glam::DVec3::from_array(state.setpoint_position_m));
    heard.largest_step_m = heard.largest_step_m.max(step_m);
}
