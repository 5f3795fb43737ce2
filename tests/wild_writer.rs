//! A process that writes what it should not on every channel of a mission in flight: no service dies of it, nothing of it
//! is flown, trained or believed, and the mission completes.
//!
//! It writes random bytes of the right size, copies of real messages with some bits flipped, and messages that are formed
//! and sealed as the bus does it but whose content makes no sense. What is not defended: a message that is right in form
//! and content is believed, whoever wrote it; there is no secret on the bus.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bytemuck::{Zeroable as _, bytes_of_mut, cast_slice_mut};
use common::{Flight, keyframes, metrics, system_of};
use shared_types::ServiceName;
use shared_types::bus::{Bus, Envelope, Limits, Publisher, Subscriber};
use shared_types::channel::{
    CaptureRequests, Channel, ChannelVisitor, ControlRequests, MissionCommandRequests, RenderRequests, RoundRequests,
    ScoreRequests, VehicleCommandRequests, visit_all,
};
use shared_types::messages::{
    CaptureRequest, Check as _, CommandRequest, ControlRequest, MissionRequest, RenderRequest, RoundRequest,
    ScoreRequest,
};
use shared_types::system::System;

/// SplitMix64: the same bytes on every run.
struct Random(u64);

impl Random {
    fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, end: usize) -> usize {
        usize::try_from(self.bits() % end.max(1) as u64).expect("small")
    }

    fn fill(&mut self, bytes: &mut [u8]) {
        bytes.iter_mut().for_each(|byte| *byte = self.bits().to_le_bytes()[0]);
    }
}

/// Numbers that readers should stumble over.
const WILD: [u64; 7] = [
    0x7ff8_0000_0000_0000, // NaN
    0x7ff0_0000_0000_0000, // infinity
    0x7fef_ffff_ffff_ffff, // the largest f64
    0xffc0_0000_7fc0_0000, // NaN in f64, and twice in f32
    u64::MAX,
    0x8000_0000_8000_0000,
    0x0000_0001_ffff_ffff,
];

/// Most items of a wild message: its length is as wild as its content, and a megabyte says no more than some thousands.
const MOST_ITEMS: usize = 4000;

/// What was written so far, by kind.
#[derive(Debug, Default)]
struct Written {
    random: u64,
    flipped: u64,
    senseless: u64,
}

/// One channel, and the last real message on it.
struct Port<C: Channel> {
    publisher: Publisher<C>,
    subscriber: Subscriber<C>,
    last: Option<(Envelope, C::Header, Vec<C::Item>)>,
}

trait Scribble {
    fn scribble(&mut self, random: &mut Random, written: &mut Written);
}

impl<C: Channel> Scribble for Port<C> {
    fn scribble(&mut self, random: &mut Random, written: &mut Written) {
        if let Ok(Some(message)) = self.subscriber.latest(0) {
            let items = message.items();
            let kept = items[..items.len().min(MOST_ITEMS)].to_vec();
            // A part of an image is no message, but a start for one.
            self.last = Some((*message.envelope(), *message.header(), kept));
        }
        // A full queue, or a channel whose chunks are all in use, is no failure of this test.
        match random.below(3) {
            0 => written.random += u64::from(self.random(random).is_some()),
            1 => written.flipped += u64::from(self.flipped(random).is_some()),
            _ => written.senseless += u64::from(self.senseless(random).is_some()),
        }
    }
}

impl<C: Channel> Port<C> {
    fn random(&mut self, random: &mut Random) -> Option<()> {
        let (mut envelope, mut header) = (Envelope::zeroed(), C::Header::zeroed());
        random.fill(bytes_of_mut(&mut envelope));
        random.fill(bytes_of_mut(&mut header));
        let mut items = vec![C::Item::zeroed(); random.below(64)];
        random.fill(cast_slice_mut(&mut items));
        self.publisher.send_wild(envelope, &header, &items).ok()
    }

    /// A real message with one to eight of its bits flipped.
    fn flipped(&mut self, random: &mut Random) -> Option<()> {
        let (mut envelope, mut header, mut items) = self.last.clone()?;
        for _ in 0..1 + random.below(8) {
            let bit = 1 << random.below(8);
            let items: &mut [u8] = cast_slice_mut(&mut items);
            let parts = [bytes_of_mut(&mut envelope), bytes_of_mut(&mut header), items];
            let part = parts.into_iter().nth(random.below(3))?;
            let at = random.below(part.len());
            if let Some(byte) = part.get_mut(at) {
                *byte ^= bit;
            }
        }
        self.publisher.send_wild(envelope, &header, &items).ok()
    }

    /// A message that its sender sealed, with numbers that make no sense to whoever checks it.
    fn senseless(&mut self, random: &mut Random) -> Option<()> {
        let (mut header, mut items) =
            self.last.as_ref().map_or_else(Default::default, |(_, header, items)| (*header, items.clone()));
        for _ in 0..1 + random.below(3) {
            let items: &mut [u8] = cast_slice_mut(&mut items);
            let part = if random.below(3) == 0 && !items.is_empty() { items } else { bytes_of_mut(&mut header) };
            let wild = WILD[random.below(WILD.len())].to_le_bytes();
            let at = random.below(part.len()) / 4 * 4;
            let width = [4, 8][random.below(2)].min(part.len() - at);
            part[at..at + width].copy_from_slice(&wild[..width]);
        }
        items.truncate(if random.below(4) == 0 { random.below(items.len()) } else { items.len() });
        // What happens to make sense is not what this test is about.
        header.check(&items).err()?;
        self.publisher.send_items(1, 1, &header, &items).ok()
    }
}

struct OpenAll<'a> {
    bus: &'a Bus,
    ports: BTreeMap<&'static str, Box<dyn Scribble>>,
}

impl ChannelVisitor for OpenAll<'_> {
    fn visit<C: Channel>(&mut self) {
        let publisher = self.bus.publisher::<C>().expect("a publisher of every channel");
        let subscriber = self.bus.subscriber::<C>().expect("a subscriber of every channel");
        self.ports.insert(C::NAME, Box::new(Port { publisher, subscriber, last: None }));
    }
}

/// Requests that are well formed and make no sense to their servers.
struct Nonsense {
    command: Publisher<VehicleCommandRequests>,
    mission: Publisher<MissionCommandRequests>,
    capture: Publisher<CaptureRequests>,
    round: Publisher<RoundRequests>,
    score: Publisher<ScoreRequests>,
    render: Publisher<RenderRequests>,
    control: Publisher<ControlRequests>,
}

impl Nonsense {
    fn open(bus: &Bus) -> Self {
        Self {
            command: bus.publisher().expect("publisher"),
            mission: bus.publisher().expect("publisher"),
            capture: bus.publisher().expect("publisher"),
            round: bus.publisher().expect("publisher"),
            score: bus.publisher().expect("publisher"),
            render: bus.publisher().expect("publisher"),
            control: bus.publisher().expect("publisher"),
        }
    }

    fn send(&mut self, random: &mut Random) {
        let wild = f64::from_bits(WILD[random.below(4)]);
        let code = 100 + (random.bits() >> 40) as u32;
        let _sent = [
            self.command.send(1, 1, &CommandRequest { command: code, ..CommandRequest::default() }),
            self.mission.send(1, 1, &MissionRequest { command: code, ..MissionRequest::default() }),
            self.capture.send(1, 1, &CaptureRequest { reason: code, keyframe_id: 3, ..CaptureRequest::default() }),
            self.round.send_items(
                1,
                1,
                &RoundRequest { box_size_m: wild, radius_m: wild, ..Default::default() },
                &[0, 1],
            ),
            self.score.send(1, 1, &ScoreRequest { width: code, height: u32::MAX, ..ScoreRequest::default() }),
            self.render.send(1, 1, &RenderRequest { width: u32::MAX, height: code, purpose: 1, ..Default::default() }),
            self.control.send(1, 1, &ControlRequest { command: code, service: 8, ..ControlRequest::default() }),
        ];
    }
}

/// Writes on every channel until told to stop.
fn write_wildly(system: &System, stop: &AtomicBool) -> Written {
    let config = shared_types::config::preset("tiny").expect("the preset");
    let bus = Bus::open(system, Limits::of(&config), ServiceName::Command, 1, false).expect("the mission's bus");
    let mut all = OpenAll { bus: &bus, ports: BTreeMap::new() };
    visit_all(&mut all);
    let mut nonsense = Nonsense::open(&bus);
    let (mut random, mut written) = (Random(0x11d), Written::default());
    while !stop.load(Ordering::Relaxed) {
        for port in all.ports.values_mut() {
            port.scribble(&mut random, &mut written);
        }
        nonsense.send(&mut random);
        // Often enough that every turn of every service meets some; a flood would only show how fast the machine is.
        std::thread::sleep(Duration::from_millis(5));
    }
    written
}

/// Tells when the flight is over, whatever ends the test.
struct StopAtEnd<'a>(&'a AtomicBool);

impl Drop for StopAtEnd<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

#[test]
fn a_wild_writer_on_every_channel_neither_kills_nor_misleads_anybody() {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let mut flight = Flight::start(&folder, &["--preset", "tiny", "--seed", "21"]);
    flight.wait_until("all services", |flight| flight.services().len() >= 8);
    let system = system_of(flight.pid());
    let stop = AtomicBool::new(false);
    let written = std::thread::scope(|scope| {
        let writer = scope.spawn(|| write_wildly(&system, &stop));
        let over = StopAtEnd(&stop);
        flight.finish_well();
        drop(over);
        writer.join().expect("the writer")
    });
    println!("{written:?}");
    assert!(written.random > 100 && written.flipped > 100 && written.senseless > 100, "{written:?}");

    let metrics = metrics(&folder);
    let mission = &metrics["mission"];
    assert_eq!(keyframes(&folder), (0..6).collect::<Vec<u64>>(), "{metrics:#}");
    assert_eq!(mission["end_reason"], "complete", "{metrics:#}");
    assert_eq!(mission["collisions"], 0, "{metrics:#}");
    let clearance_m = mission["min_clearance_m"].as_f64().expect("a clearance");
    assert!(clearance_m > 0.7, "{clearance_m} m from the object");
    let restarts = mission["restarts"].as_object().expect("restarts by service");
    assert!(restarts.values().all(|count| count.as_u64() == Some(0)), "{restarts:?}");
    for entry in std::fs::read_dir(folder.join("logs")).expect("logs").flatten() {
        let text = std::fs::read_to_string(entry.path()).expect("a log");
        assert!(!text.contains("panicked"), "{}: {text}", entry.path().display());
        // launch and keeper log on the terminal and read few channels; the others have all been written to.
        let service = entry.file_name().into_string().expect("a name");
        if ["px4-link", "planner", "camera", "trainer", "scorer", "world", "simulator"]
            .iter()
            .any(|name| service.starts_with(name))
        {
            assert!(text.contains("a message is refused"), "{service} refused nothing: {text}");
        }
    }
}
