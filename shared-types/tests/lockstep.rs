//! The member's loop against a clock made here: ticks are granted in order, messages take one tick, waiting does not grant.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use shared_types::bus::{Bus, Limits, Publisher, Subscriber, wait};
use shared_types::channel::{AliveChannel, ClockChannel, ControlChannel, GrantChannel};
use shared_types::config::Config;
use shared_types::messages::{Alive, ClockGrant, ClockTick, ControlCommand, ControlRequest};
use shared_types::service::{Context, HealthReport, Service, ServiceError, Step, StopAnswer};
use shared_types::system::System;
use shared_types::{ServiceName, TICK_NS};

/// Sends its tick, and writes down what it hears and when.
struct Talker {
    publisher: Publisher<AliveChannel>,
    subscriber: Subscriber<AliveChannel>,
    heard: Arc<Mutex<Vec<(u64, u64)>>>,
    last: u64,
    waits: u32,
    rejoined: Arc<Mutex<u32>>,
}

impl Service for Talker {
    fn step(&mut self, now_ns: u64) -> Result<Step, ServiceError> {
        // Every seventh tick something takes three more calls.
        if now_ns.is_multiple_of(7 * TICK_NS) && self.waits < 3 {
            self.waits += 1;
            return Ok(Step::Waiting);
        }
        self.waits = 0;
        while let Some(message) = self.subscriber.receive(now_ns)? {
            let mut heard = self.heard.lock().expect("heard");
            heard.push((now_ns / TICK_NS, message.header().sequence));
        }
        self.publisher.send(now_ns, now_ns, &Alive { sequence: now_ns / TICK_NS })?;
        if now_ns >= self.last {
            return Ok(Step::Leave);
        }
        Ok(Step::Done)
    }

    fn rejoin(&mut self, _now_ns: u64) {
        *self.rejoined.lock().expect("rejoined") += 1;
    }

    fn health(&self) -> HealthReport {
        HealthReport::running()
    }
}

struct Clock {
    ticks: Publisher<ClockChannel>,
    grants: Subscriber<GrantChannel>,
    listener: shared_types::bus::Listener,
    present: ClockTick,
}

impl Clock {
    fn open(system: &System) -> Self {
        let bus = Bus::open(system, Limits::of(&Config::default()), ServiceName::Simulator, 1, false).expect("bus");
        Self {
            ticks: bus.publisher().expect("ticks"),
            grants: bus.subscriber().expect("grants"),
            listener: bus.listener::<GrantChannel>().expect("listener"),
            present: ClockTick { incarnation: 5, ..ClockTick::default() },
        }
    }

    /// Publishes tick `k` until all of `members` have granted it; true for those that leave.
    fn tick(&mut self, k: u64, members: &[ServiceName]) -> Vec<ClockGrant> {
        self.present.tick = k;
        self.present.now_ns = k * TICK_NS;
        let deadline = Instant::now() + Duration::from_secs(20);
        let mut granted: Vec<ClockGrant> = Vec::new();
        while granted.len() < members.len() {
            self.ticks.send(self.present.now_ns, self.present.now_ns, &self.present).expect("tick");
            wait(&[&self.listener], &[], Duration::from_millis(20)).expect("wait");
            while let Some(message) = self.grants.receive(0).expect("grants") {
                let grant = *message.header();
                let known = granted.iter().any(|g| g.service == grant.service);
                if grant.clock_incarnation == 5 && grant.tick == k && !known {
                    granted.push(grant);
                }
            }
            assert!(Instant::now() < deadline, "tick {k} granted by {granted:?} only");
        }
        granted
    }
}

#[test]
fn members_march_in_step_and_hear_each_other_one_tick_later() {
    let base = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
    let system = System::create(base.path(), "l", 0).expect("system");
    const LAST: u64 = 40;
    let members = [ServiceName::Camera, ServiceName::Planner];
    let heard: Vec<_> = members.iter().map(|_| Arc::new(Mutex::new(Vec::new()))).collect();
    let rejoined = Arc::new(Mutex::new(0));
    let threads: Vec<_> = members
        .iter()
        .zip(&heard)
        .map(|(&name, heard)| {
            let (system, heard, rejoined) = (system.clone(), Arc::clone(heard), Arc::clone(&rejoined));
            std::thread::spawn(move || {
                let mut context = Context::open(name, Config::default(), system, false).expect("context");
                let (publisher, subscriber) =
                    (context.bus.publisher().expect("out"), context.bus.subscriber().expect("in"));
                let mut talker = Talker { publisher, subscriber, heard, last: LAST * TICK_NS, waits: 0, rejoined };
                context.run(&mut talker).expect("ran");
            })
        })
        .collect();
    let mut clock = Clock::open(&system);
    for k in 0..=LAST {
        if k == 20 {
            clock.present.outs[ServiceName::Planner.code() as usize] += 1;
        }
        let grants = clock.tick(k, &members);
        assert!(grants.iter().all(|grant| grant.leaving == u32::from(k == LAST)), "tick {k}: {grants:?}");
    }
    for thread in threads {
        thread.join().expect("joined");
    }
    assert_eq!(*rejoined.lock().expect("rejoined"), 1, "only the planner was out");
    for heard in heard {
        // Both talkers are heard by both, each message exactly one tick after it was sent, nothing lost.
        let expected: Vec<_> = (2..=LAST).flat_map(|k| [(k, k - 1), (k, k - 1)]).collect();
        assert_eq!(*heard.lock().expect("heard"), expected);
    }
    drop(clock);
    system.remove().expect("removed");
}

/// Has something to finish that takes more mission time than there will be, unless it is asked to stop.
struct Stubborn {
    stops: Arc<Mutex<u32>>,
}

impl Service for Stubborn {
    fn step(&mut self, _now_ns: u64) -> Result<Step, ServiceError> {
        Ok(Step::Done)
    }

    fn health(&self) -> HealthReport {
        HealthReport::running()
    }

    fn stop(&mut self, _now_ns: u64) -> StopAnswer {
        *self.stops.lock().expect("stops") += 1;
        StopAnswer::Now
    }

    fn orphaned(&mut self, _now_ns: u64) -> StopAnswer {
        StopAnswer::Later
    }
}

/// A stubborn member whose supervisor was gone before it began, after three ticks; then no clock any more.
fn orphan(base: &std::path::Path) -> (System, Arc<Mutex<u32>>, std::thread::JoinHandle<()>, Clock) {
    let system = System::create(base, "o", u32::MAX).expect("system");
    let stops = Arc::new(Mutex::new(0));
    let (of_thread, counted) = (system.clone(), Arc::clone(&stops));
    let thread = std::thread::spawn(move || {
        let mut context = Context::open(ServiceName::Planner, Config::default(), of_thread, true).expect("context");
        context.run(&mut Stubborn { stops: counted }).expect("ran");
    });
    let mut clock = Clock::open(&system);
    for k in 0..3 {
        clock.tick(k, &[ServiceName::Planner]);
    }
    (system, stops, thread, clock)
}

fn ends_within(thread: &std::thread::JoinHandle<()>, limit: Duration) -> bool {
    let deadline = Instant::now() + limit;
    while !thread.is_finished() && Instant::now() < deadline {
        std::thread::sleep(Duration::from_millis(20));
    }
    thread.is_finished()
}

#[test]
fn an_orphan_that_wants_to_finish_something_leaves_when_the_clock_is_gone() {
    let base = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
    let (system, stops, thread, _clock) = orphan(base.path());
    assert!(!ends_within(&thread, Duration::from_millis(1000)), "what is not finished is not left at once");
    assert!(ends_within(&thread, Duration::from_secs(10)), "without a clock it would never be finished");
    thread.join().expect("joined");
    assert_eq!(*stops.lock().expect("stops"), 0);
    system.remove().expect("removed");
}

#[test]
fn an_orphan_that_finishes_something_can_still_be_asked_to_stop() {
    let base = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
    let (system, stops, thread, mut clock) = orphan(base.path());
    let bus = Bus::open(&system, Limits::of(&Config::default()), ServiceName::Command, 2, false).expect("bus");
    let mut client = bus.client::<ControlChannel>().expect("client");
    // By now it has noticed that it is an orphan.
    std::thread::sleep(Duration::from_millis(500));
    let request = ControlRequest {
        service: ServiceName::Planner.code(),
        command: ControlCommand::Stop.code(),
        ..ControlRequest::default()
    };
    client.send(0, 1, &request, &[]).expect("sent");
    let deadline = Instant::now() + Duration::from_secs(10);
    let mut k = 3;
    while !thread.is_finished() {
        assert!(Instant::now() < deadline, "it never stopped");
        // Time goes on: it is the request that ends it.
        clock.present.tick = k;
        clock.ticks.send(k, k, &clock.present).expect("tick");
        k += 1;
        std::thread::sleep(Duration::from_millis(20));
        client.receive(0).expect("reply");
    }
    thread.join().expect("joined");
    assert_eq!(*stops.lock().expect("stops"), 1);
    drop((clock, client, bus));
    system.remove().expect("removed");
}
