//! The clock with real members over real shared memory and sockets: px4-link's place is taken by a small client, the
//! planner's by a member that only grants.
#![expect(clippy::expect_used, clippy::panic, reason = "test code: a failure is a panic")]

use std::net::UdpSocket;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use shared_types::channel::TruthChannel;
use shared_types::config::{ClockMode, Config};
use shared_types::messages::ClockTick;
use shared_types::service::{Context, HealthReport, Service, ServiceError, ServiceName, Step};
use shared_types::system::System;
use simulator::mav::codec::frames;
use simulator::service::SimulatorService;
use simulator::udp::UdpLinks;

struct Domain {
    system: System,
    _base: tempfile::TempDir,
}

impl Domain {
    fn new() -> Self {
        let base = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
        Self { system: System::create(base.path(), "s", 0).expect("system"), _base: base }
    }
}

impl Drop for Domain {
    fn drop(&mut self) {
        drop(self.system.remove());
    }
}

/// The first instance whose client's port is free, with the links and the client's socket.
fn ports() -> (UdpLinks, UdpSocket) {
    for instance in 0..10u8 {
        let Ok(socket) = UdpSocket::bind(("127.0.0.1", 14_540 + u16::from(instance))) else { continue };
        if let Ok(links) = UdpLinks::bind(Some(instance)) {
            socket.set_nonblocking(true).expect("nonblocking");
            return (links, socket);
        }
    }
    panic!("no free instance");
}

/// A member that grants; with a socket it reads the vehicle's datagrams up to the clock's count and answers each tick.
struct Member {
    socket: Option<UdpSocket>,
    simulator_port: u16,
    expected: u64,
    read: u64,
    sent: u64,
    digest: u64,
    ticks: Arc<AtomicU64>,
    last_tick: u64,
    tick: u64,
    /// Stands still at this tick, once.
    stall_at: Option<u64>,
    rejoined: Arc<AtomicU64>,
}

impl Member {
    fn new(last_tick: u64, ticks: &Arc<AtomicU64>) -> Self {
        Self {
            socket: None,
            simulator_port: 0,
            expected: 0,
            read: 0,
            sent: 0,
            digest: 0,
            ticks: Arc::clone(ticks),
            last_tick,
            tick: 0,
            stall_at: None,
            rejoined: Arc::default(),
        }
    }
}

impl Service for Member {
    fn begin_tick(&mut self, tick: &ClockTick) {
        self.tick = tick.tick;
        self.expected = tick.datagrams;
    }

    fn step(&mut self, _now_ns: u64) -> Result<Step, ServiceError> {
        if self.stall_at.is_some_and(|at| self.tick >= at) {
            self.stall_at = None;
            thread::sleep(Duration::from_millis(2600));
        }
        if let Some(socket) = &self.socket {
            let mut buffer = [0u8; 2048];
            while self.read < self.expected {
                match socket.recv_from(&mut buffer) {
                    Ok((length, _)) => {
                        self.read += 1;
                        for frame in frames(&buffer[..length]) {
                            for &byte in frame.payload {
                                self.digest = (self.digest ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
                            }
                        }
                    }
                    Err(_) => return Ok(Step::Waiting),
                }
            }
            // PING to everyone, every tenth tick.
            if self.tick % 10 == 1 {
                let ping = ping(self.tick as u32);
                socket.send_to(&ping, ("127.0.0.1", self.simulator_port)).expect("sent");
                self.sent += 1;
            }
        }
        self.ticks.store(self.tick, Ordering::Relaxed);
        Ok(if self.tick >= self.last_tick { Step::Leave } else { Step::Done })
    }

    fn datagrams_sent(&self) -> u64 {
        self.sent
    }

    fn rejoin(&mut self, _now_ns: u64) {
        self.rejoined.fetch_add(1, Ordering::Relaxed);
    }

    fn health(&self) -> HealthReport {
        HealthReport::running()
    }
}

fn ping(sequence: u32) -> Vec<u8> {
    let mut outbox = simulator::mav::codec::Outbox::new(245, 190);
    outbox.push(&simulator::mav::ping::message(1, sequence, (0, 0)));
    outbox.take().concat()
}

struct Outcome {
    digest: u64,
    deterministic: bool,
    seconds: f64,
    rejoined: u64,
    truths: u64,
}

/// Runs the simulator with both members for some ticks.
fn run(last_tick: u64, stall_at: Option<u64>) -> Outcome {
    let domain = Domain::new();
    let (links, socket) = ports();
    let port = links.onboard_peer().port() + 40;
    let mut config = Config::default();
    config.clock.mode = ClockMode::Lockstep;
    let stop = Arc::new(AtomicBool::new(false));
    let system = domain.system.clone();
    let (simulator_config, simulator_stop) = (config.clone(), Arc::clone(&stop));
    let simulator = thread::spawn(move || {
        let context = Context::open(ServiceName::Simulator, simulator_config, system, false).expect("joined");
        let members = [ServiceName::Px4Link, ServiceName::Planner];
        let mut service = SimulatorService::open(&context, links, &members).expect("opened");
        let mut truth = context.bus.subscriber::<TruthChannel>().expect("subscriber");
        let (mut truths, mut deterministic) = (0, true);
        while !simulator_stop.load(Ordering::Relaxed) {
            service.step(0).expect("stepped");
            deterministic = service.deterministic();
            context.bus.serve_late_joiners();
            while truth.receive(0).expect("received").is_some() {
                truths += 1;
            }
        }
        (truths, deterministic)
    });
    let started = Instant::now();
    let member = |name: ServiceName, mut member: Member| {
        let (config, system) = (config.clone(), domain.system.clone());
        thread::spawn(move || {
            let mut context = Context::open(name, config, system, false).expect("joined");
            context.run(&mut member).expect("ran");
            member
        })
    };
    let ticks = Arc::default();
    let link = Member { socket: Some(socket), simulator_port: port, ..Member::new(last_tick, &ticks) };
    let planner = Member { stall_at, ..Member::new(last_tick, &ticks) };
    let rejoined = Arc::clone(&planner.rejoined);
    let link = member(ServiceName::Px4Link, link);
    let planner = member(ServiceName::Planner, planner);
    let link = link.join().expect("link");
    planner.join().expect("planner");
    let seconds = started.elapsed().as_secs_f64();
    stop.store(true, Ordering::Relaxed);
    let (truths, deterministic) = simulator.join().expect("simulator");
    Outcome { digest: link.digest, deterministic, seconds, rejoined: rejoined.load(Ordering::Relaxed), truths }
}

#[test]
fn members_set_the_pace_and_the_same_run_gives_the_same_bytes() {
    let first = run(1000, None);
    assert!(first.deterministic);
    assert!(first.digest != 0 && first.truths > 50);
    assert!(first.seconds < 8.0, "10 s of simulated time took {:.2} s", first.seconds);
    println!("1000 ticks in {:.3} s", first.seconds);
    let second = run(1000, None);
    assert_eq!(first.digest, second.digest, "telemetry repeats byte for byte");
}

#[test]
fn a_member_that_stands_still_is_out_and_comes_back() {
    let outcome = run(400, Some(100));
    assert_eq!(outcome.rejoined, 1);
    assert!(!outcome.deterministic);
}

#[test]
fn without_members_the_vehicle_keeps_the_walls_time() {
    let domain = Domain::new();
    let (links, socket) = ports();
    let mut config = Config::default();
    config.clock.mode = ClockMode::Wall;
    let context = Context::open(ServiceName::Simulator, config, domain.system.clone(), false).expect("joined");
    let mut service = SimulatorService::open(&context, links, &[]).expect("opened");
    let mut truth = context.bus.subscriber::<TruthChannel>().expect("subscriber");
    let started = Instant::now();
    let begun_ns = context.wall_now_ns();
    let (mut truths, mut last_ns) = (0u32, 0);
    while started.elapsed() < Duration::from_millis(600) {
        service.step(context.wall_now_ns()).expect("stepped");
        while let Some(message) = truth.receive(0).expect("received") {
            truths += 1;
            last_ns = message.header().now_ns;
        }
        thread::sleep(Duration::from_millis(5));
    }
    let elapsed_ns = last_ns - begun_ns;
    assert!((40..=65).contains(&truths), "{truths} ticks in 0.6 s");
    assert!(elapsed_ns.abs_diff(u64::from(truths) * 10_000_000) < 10_000_000, "{elapsed_ns}");
    let mut buffer = [0u8; 2048];
    assert!(socket.recv_from(&mut buffer).is_ok(), "telemetry goes out");
}
