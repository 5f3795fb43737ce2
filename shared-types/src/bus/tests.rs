//! The wrapper over a real domain of its own.

use std::rc::Rc;

use super::*;
use crate::channel::{
    AliveChannel, FrameChannel, GrantChannel, MissionStateChannel, RoundChannel, SnapshotChannel, VehicleTargetChannel,
};
use crate::messages::{
    Alive, ClockGrant, FrameHeader, MissionState, RoundReply, RoundRequest, RoundStatus, SnapshotHeader, VehicleTarget,
    Waypoint,
};

struct Domain {
    system: System,
    _base: tempfile::TempDir,
}

impl Domain {
    fn new() -> Self {
        let base = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
        Self { system: System::create(base.path(), "t", 0).expect("system"), _base: base }
    }

    fn join(&self, name: ServiceName, by_tick: bool) -> Bus {
        let limits = Limits { image_bytes: 64 * 48 * 5, small_depth_bytes: 16 * 12 * 2, gaussians: 100 };
        Bus::open(&self.system, limits, name, 7, by_tick).expect("joined")
    }
}

impl Drop for Domain {
    fn drop(&mut self) {
        drop(self.system.remove());
    }
}

#[test]
fn what_is_sent_arrives_with_its_envelope() {
    let domain = Domain::new();
    let (planner, link) = (domain.join(ServiceName::Planner, false), domain.join(ServiceName::Px4Link, false));
    let mut publisher = planner.publisher::<AliveChannel>().expect("publisher");
    let mut subscriber = link.subscriber::<AliveChannel>().expect("subscriber");
    publisher.send(30, 20, &Alive { sequence: 9 }).expect("sent");
    let message = subscriber.receive(30).expect("received").expect("a message");
    assert_eq!((message.header().sequence, message.stamp_ns(), message.sent_ns()), (9, 20, 30));
    assert_eq!(message.envelope().sender, ServiceName::Planner.code());
    assert!(subscriber.receive(30).expect("received").is_none());
}

#[test]
fn a_member_sees_only_what_was_sent_before_its_tick_in_order() {
    let domain = Domain::new();
    let (a, b) = (domain.join(ServiceName::Trainer, true), domain.join(ServiceName::Camera, true));
    let (mut late, mut early) = (a.publisher::<AliveChannel>().expect("a"), b.publisher::<AliveChannel>().expect("b"));
    let mut reader = domain.join(ServiceName::Planner, true).subscriber::<AliveChannel>().expect("reader");
    assert!(reader.receive(10).expect("connected").is_none());
    late.send(20, 20, &Alive { sequence: 3 }).expect("sent");
    late.send(20, 20, &Alive { sequence: 4 }).expect("sent");
    early.send(10, 10, &Alive { sequence: 1 }).expect("sent");
    early.send(20, 20, &Alive { sequence: 2 }).expect("sent");
    assert!(reader.receive(10).expect("received").is_none(), "sent at 10 is not before 10");
    let mut seen = |now| {
        let mut all = Vec::new();
        while let Some(message) = reader.receive(now).expect("received") {
            all.push(message.header().sequence);
        }
        all
    };
    assert_eq!(seen(20), [1]);
    // Camera's code is below trainer's: the order does not depend on who was faster.
    assert_eq!(seen(30), [2, 3, 4]);
}

#[test]
fn a_late_joiner_gets_the_state_but_never_a_path() {
    let domain = Domain::new();
    let bus = domain.join(ServiceName::Planner, false);
    let mut state = bus.publisher::<MissionStateChannel>().expect("state");
    let mut target = bus.publisher::<VehicleTargetChannel>().expect("target");
    state.send(1, 1, &MissionState { round: 5, ..MissionState::default() }).expect("sent");
    target.send(1, 1, &VehicleTarget { id: 5, ..VehicleTarget::default() }).expect("sent");
    let late = domain.join(ServiceName::Command, false);
    let mut states = late.subscriber::<MissionStateChannel>().expect("states");
    let mut targets = late.subscriber::<VehicleTargetChannel>().expect("targets");
    bus.serve_late_joiners();
    assert_eq!(states.latest(2).expect("received").expect("history").header().round, 5);
    assert!(targets.latest(2).expect("received").is_none());
}

fn frame(width: u32, height: u32) -> FrameHeader {
    FrameHeader {
        width,
        height,
        has_color: 1,
        depth_unit_m: 0.001,
        focal_px: [50.0; 2],
        principal_px: [1.0; 2],
        world_from_camera_xyzw: [0.0, 0.0, 0.0, 1.0],
        ..FrameHeader::default()
    }
}

#[test]
fn a_frame_is_filled_in_place_and_a_wild_size_is_refused() {
    let domain = Domain::new();
    let bus = domain.join(ServiceName::Camera, false);
    let mut frames = bus.publisher::<FrameChannel>().expect("frames");
    let mut reader = domain.join(ServiceName::Command, false).subscriber::<FrameChannel>().expect("reader");
    let header = frame(64, 48);
    let len = header.items_len();
    frames.send_with(1, 1, &header, len, |bytes| bytes[len - 1] = 77).expect("sent");
    let frame = reader.latest(2).expect("received").expect("a frame");
    assert_eq!((frame.items().len(), frame.items()[len - 1], frame.items()[0]), (len, 77, 0));
    let error = frames.send_with(1, 1, &header, len * 2, |_| ()).expect_err("too large");
    assert!(matches!(error, BusError::TooManyItems { .. }), "{error}");
}

#[test]
fn without_a_free_chunk_a_snapshot_is_refused_and_later_ones_go_through() {
    let domain = Domain::new();
    let mut snapshots = domain.join(ServiceName::Trainer, false).publisher::<SnapshotChannel>().expect("snapshots");
    let mut readers: Vec<_> = (0..4)
        .map(|_| domain.join(ServiceName::Command, false).subscriber::<SnapshotChannel>().expect("reader"))
        .collect();
    for reader in &mut readers {
        assert!(reader.receive(0).expect("connected").is_none());
    }
    let mut held = Vec::new();
    let mut refused = false;
    for generation in 0..12 {
        let header = SnapshotHeader { generation, ..SnapshotHeader::default() };
        match snapshots.send_with(1, 1, &header, 3, |_| ()) {
            Ok(()) => {
                // Each reader keeps three snapshots of its own: they cannot all have a chunk.
                for reader in readers.iter_mut().skip(generation as usize / 3).take(1) {
                    held.extend(reader.receive(2).expect("received"));
                }
            }
            Err(error) => {
                assert!(matches!(error, BusError::NoChunk { .. }), "{error}");
                refused = true;
                held.clear();
            }
        }
    }
    assert!(refused, "six chunks cannot serve readers that keep everything");
    snapshots.send_with(1, 1, &SnapshotHeader::default(), 3, |_| ()).expect("chunks came back");
}

#[test]
fn a_request_survives_a_server_that_comes_late_and_gets_its_own_replies() {
    let domain = Domain::new();
    let mut client = domain.join(ServiceName::Planner, false).client::<RoundChannel>().expect("client");
    let mut stranger = domain.join(ServiceName::Command, false).client::<RoundChannel>().expect("client");
    client.send(10, 42, &RoundRequest { round: 3, ..RoundRequest::default() }, &[1, 2, 3]).expect("sent");
    let mut server = domain.join(ServiceName::Trainer, false).server::<RoundChannel>().expect("server");
    assert!(client.receive(20).expect("nothing yet").is_none());
    std::thread::sleep(std::time::Duration::from_millis(600));
    assert!(client.receive(20).expect("sent again").is_none());
    let request = server.receive(30).expect("received").expect("sent again");
    assert_eq!((request.header().round, request.items()), (3, &[1, 2, 3][..]));
    assert_eq!(request.stamp_ns(), 10, "the first sending's time");
    let to = request.address();
    let progress = RoundReply { status: RoundStatus::Progress.code(), ..RoundReply::default() };
    server.reply(30, &to, &RoundReply { iterations: 8, ..progress }, &[]).expect("replied");
    assert!(stranger.receive(40).expect("received").is_none(), "not the stranger's");
    let reply = client.receive(40).expect("received").expect("a reply");
    assert_eq!((reply.request_id(), reply.header().iterations), (42, 8));
    client.finish(42);
    server.reply(50, &to, &progress, &[]).expect("replied");
    assert!(client.receive(60).expect("received").is_none(), "finished requests get nothing");
}

#[test]
fn waiting_ends_with_a_message_and_not_before() {
    let domain = Domain::new();
    let mut frames = domain.join(ServiceName::Camera, false).publisher::<FrameChannel>().expect("frames");
    let listener = domain.join(ServiceName::Command, false).listener::<FrameChannel>().expect("listener");
    let header = frame(2, 2);
    frames.send_with(1, 1, &header, header.items_len(), |_| ()).expect("sent");
    let before = std::time::Instant::now();
    wait(&[&listener], &[], std::time::Duration::from_secs(20)).expect("woken");
    assert!(before.elapsed() < std::time::Duration::from_secs(10), "woken by the message");
    wait(&[&listener], &[], std::time::Duration::from_millis(1)).expect("over");
    assert_eq!(Rc::strong_count(&domain.join(ServiceName::Command, false).0), 1);
}

/// Opens a sender of every channel, and adds up what the table says and what lies in shared memory.
struct SendAll<'a> {
    bus: &'a Bus,
    limits: Limits,
    prefix: &'a str,
    worst: f64,
    ports: Vec<Box<dyn core::any::Any>>,
}

impl crate::channel::ChannelVisitor for SendAll<'_> {
    fn visit<C: Channel>(&mut self) {
        let before = data_bytes(self.prefix);
        self.ports.push(Box::new(self.bus.publisher::<C>().expect("publisher")));
        let taken = (data_bytes(self.prefix) - before) * C::SETTINGS.senders as u64;
        let told = self.limits.reserved_bytes::<C>();
        println!("{}: {taken} taken, {told} told", C::NAME);
        self.worst = self.worst.max((taken as f64 / told as f64).max(told as f64 / taken as f64));
    }
}

fn data_bytes(prefix: &str) -> u64 {
    std::fs::read_dir("/dev/shm")
        .expect("shm")
        .flatten()
        .filter(|entry| {
            let name = entry.file_name().to_string_lossy().into_owned();
            name.starts_with(prefix) && name.ends_with(".data")
        })
        .map(|entry| entry.metadata().map_or(0, |data| data.len()))
        .sum()
}

#[test]
fn what_the_channels_reserve_is_known_before_they_are_opened() {
    let domain = Domain::new();
    let limits = Limits::of(&crate::config::preset("tiny").expect("preset"));
    let bus = Bus::open(&domain.system, limits, ServiceName::Command, 1, false).expect("bus");
    let mut all = SendAll { bus: &bus, limits, prefix: &domain.system.prefix, worst: 1.0, ports: Vec::new() };
    crate::channel::visit_all(&mut all);
    assert!(all.worst < 1.3, "{}", all.worst);
}

#[test]
fn a_swallowed_wake_up_costs_one_period_and_not_all_that_follow() {
    let domain = Domain::new();
    let listener = domain.join(ServiceName::Simulator, false).listener::<GrantChannel>().expect("listener");
    let sending = std::sync::atomic::AtomicUsize::new(4);
    let senders = [ServiceName::Planner, ServiceName::Camera, ServiceName::Trainer, ServiceName::Scorer];
    std::thread::scope(|scope| {
        for sender in senders {
            let (domain, sending) = (&domain, &sending);
            scope.spawn(move || {
                let mut grants = domain.join(sender, false).publisher::<GrantChannel>().expect("publisher");
                let grant = ClockGrant { service: sender.code(), pid: 1, ..ClockGrant::default() };
                // Apart, so that nearly every one finds the listener drained and about to sleep.
                for _ in 0..10_000 {
                    grants.send(1, 1, &grant).expect("sent");
                    std::thread::sleep(std::time::Duration::from_micros(20));
                }
                sending.fetch_sub(1, std::sync::atomic::Ordering::SeqCst);
            });
        }
        while sending.load(std::sync::atomic::Ordering::SeqCst) > 0 {
            wait(&[&listener], &[], std::time::Duration::from_millis(1)).expect("woken");
        }
    });
    let mut grants = domain.join(ServiceName::Px4Link, false).publisher::<GrantChannel>().expect("publisher");
    let grant = ClockGrant { service: ServiceName::Px4Link.code(), pid: 1, ..ClockGrant::default() };
    // What has come is taken, and a time that is over clears a mark that was left behind.
    (0..3).for_each(|_| wait(&[&listener], &[], std::time::Duration::from_millis(5)).expect("over"));
    for _ in 0..20 {
        grants.send(1, 1, &grant).expect("sent");
        let before = std::time::Instant::now();
        wait(&[&listener], &[], std::time::Duration::from_secs(5)).expect("woken");
        assert!(before.elapsed() < std::time::Duration::from_secs(4), "woken by the message");
    }
}

#[test]
fn what_a_channel_cannot_carry_is_never_given_out_and_does_not_stop_what_it_can() {
    let domain = Domain::new();
    let bus = domain.join(ServiceName::Planner, true);
    let mut targets = domain.join(ServiceName::Planner, false).publisher::<VehicleTargetChannel>().expect("targets");
    let mut reader = bus.subscriber::<VehicleTargetChannel>().expect("reader");
    let waypoint = Waypoint { speed_mps: 1.0, ..Waypoint::default() };
    let good = VehicleTarget { id: 7, path_len: 1, ..VehicleTarget::default() };
    targets.send_items(1, 1, &VehicleTarget { path_len: 9, ..good }, &[waypoint]).expect("a length that lies");
    targets.send_items(1, 1, &good, &[Waypoint { yaw_rad: f64::NAN, ..waypoint }]).expect("no number");
    targets.send_items(1, 99_000_000_000, &good, &[waypoint]).expect("from the future");
    targets.send_wild(Envelope { sent_ns: 1, sender: 8, ..Envelope::default() }, &good, &[waypoint]).expect("no seal");
    targets.send_items(1, 1, &good, &[waypoint]).expect("sent");
    let message = reader.receive(2).expect("received").expect("the one that is right");
    assert_eq!((message.header().id, message.items().len()), (7, 1));
    assert!(reader.receive(2).expect("received").is_none());
    assert_eq!(bus.refused(), 4);
}

#[test]
fn messages_that_claim_to_come_from_the_future_do_not_keep_out_those_of_now() {
    let domain = Domain::new();
    let bus = domain.join(ServiceName::Px4Link, true);
    let mut wild = domain.join(ServiceName::Command, false).publisher::<AliveChannel>().expect("wild");
    let mut planner = domain.join(ServiceName::Planner, false).publisher::<AliveChannel>().expect("planner");
    let mut reader = bus.subscriber::<AliveChannel>().expect("reader");
    for turn in 0..100u64 {
        for ahead in 0..3 {
            wild.send((1000 + ahead + turn) * crate::NS_PER_S, 0, &Alive { sequence: 1 }).expect("sent");
        }
        let now_ns = turn * crate::TICK_NS;
        planner.send(now_ns, now_ns, &Alive { sequence: 5 }).expect("sent");
        let got = reader.receive(now_ns + 1).expect("received").map(|message| message.header().sequence);
        assert_eq!(got, Some(5), "turn {turn}");
    }
}
