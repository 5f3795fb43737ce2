//! `vantage tap`: the messages of one channel, as they come. One more reader in shared memory: senders and other readers do
//! not notice.

use core::any::Any;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde_json::Value;
use shared_types::bus::{Bus, BusError, Limits, Message, Subscriber};
use shared_types::channel::{Channel, ChannelVisitor, NAMES, visit_all};
use shared_types::config::{Layer, load};
use shared_types::describe::message_json;
use shared_types::folder::write_frame;
use shared_types::messages::{FrameHeader, FrameView};
use shared_types::system::System;
use shared_types::{ServiceName, s_from_ns};

use crate::cli::Tap;
use crate::clock::monotonic_ns;
use crate::exit::{Exit, Refusal};
use crate::print_on;

const TURN: Duration = Duration::from_millis(5);
/// Between two looks whether the system still runs.
const LOOK: Duration = Duration::from_secs(1);

/// Prints or writes messages until there are enough, the system ends, or Ctrl-C.
///
/// # Errors
/// When there is no such system or channel, or an image cannot be written.
pub fn run(arguments: &Tap) -> anyhow::Result<Exit> {
    let pair = format!("{}/", arguments.channel);
    if !NAMES.iter().any(|name| *name == arguments.channel || is_half(name, &pair)) {
        let (asked, known) = (&arguments.channel, NAMES.join(", "));
        return Err(Refusal::usage(format!("{asked:?} is no channel; expected one of: {known}")));
    }
    let system = System::find(&System::base_dir(), arguments.system.as_deref())?;
    if !system.is_alive() {
        return Err(Refusal::missing(format!("system {} is dead: no messages are sent there", system.name)));
    }
    if let Some(folder) = &arguments.png {
        std::fs::create_dir_all(folder)
            .map_err(|error| Refusal::missing(format!("cannot make the folder {}: {error}", folder.display())))?;
    }
    let config = load(&[Layer::of_file(&system.config_path())?])?;
    let bus = Bus::open(&system, Limits::of(&config), ServiceName::Command, monotonic_ns(), false)?;
    let mut opening = Opening { bus: &bus, name: &arguments.channel, pair, taps: Vec::new(), failed: None };
    visit_all(&mut opening);
    if let Some(error) = opening.failed {
        return Err(error.into());
    }
    let mut taps = opening.taps;
    let mut sink = Sink { arguments, told: 0, closed: false, last: None };
    let mut looked = Instant::now();
    loop {
        for tap in &mut taps {
            while !sink.is_full() && tap.take(&mut sink)? {}
        }
        if sink.is_full() || (looked.elapsed() > LOOK && !system.is_alive()) {
            return Ok(Exit::Ok);
        }
        if looked.elapsed() > LOOK {
            looked = Instant::now();
        }
        std::thread::sleep(TURN);
    }
}

/// Whether a channel is the half of a pair of requests and replies.
fn is_half(name: &str, pair: &str) -> bool {
    name.strip_prefix(pair).is_some_and(|half| ["request", "reply"].contains(&half))
}

/// A channel that is read.
trait Tapped {
    /// Takes one message; false where none has come.
    fn take(&mut self, sink: &mut Sink<'_>) -> anyhow::Result<bool>;
}

struct Reader<C: Channel>(Subscriber<C>);

impl<C: Channel> Tapped for Reader<C> {
    fn take(&mut self, sink: &mut Sink<'_>) -> anyhow::Result<bool> {
        let Some(message) = self.0.receive(u64::MAX)? else { return Ok(false) };
        if sink.wants_one() {
            sink.tell(&message)?;
        }
        Ok(true)
    }
}

struct Opening<'a> {
    bus: &'a Bus,
    name: &'a str,
    pair: String,
    taps: Vec<Box<dyn Tapped>>,
    failed: Option<BusError>,
}

impl ChannelVisitor for Opening<'_> {
    fn visit<C: Channel>(&mut self) {
        if C::NAME != self.name && !is_half(C::NAME, &self.pair) {
            return;
        }
        match self.bus.subscriber::<C>() {
            Ok(subscriber) => self.taps.push(Box::new(Reader(subscriber))),
            Err(error) => self.failed = Some(error),
        }
    }
}

/// Where messages go.
struct Sink<'a> {
    arguments: &'a Tap,
    told: u64,
    /// Whoever reads has seen enough.
    closed: bool,
    last: Option<Instant>,
}

impl Sink<'_> {
    fn is_full(&self) -> bool {
        self.closed || self.arguments.count.is_some_and(|count| self.told >= count)
    }

    /// Whether it is time for another one.
    fn wants_one(&mut self) -> bool {
        let period = self.arguments.rate.map_or(Duration::ZERO, |hertz| Duration::from_secs_f64(1.0 / hertz));
        let due = self.last.is_none_or(|last| last.elapsed() >= period);
        if due {
            self.last = Some(Instant::now());
        }
        due
    }

    fn tell<C: Channel>(&mut self, message: &Message<C>) -> anyhow::Result<()> {
        self.told += 1;
        let items: &[C::Item] = if self.arguments.json { message.items() } else { &[] };
        let told = message_json::<C>(message.envelope(), message.header(), items);
        if let Some(folder) = &self.arguments.png {
            write_images(folder, message)?;
        }
        let text = if self.arguments.json { told.to_string() } else { line(C::NAME, &told, message.items().len()) };
        self.closed = !print_on(&(text + "\n"))?;
        Ok(())
    }
}

/// The images of a message that has some.
fn write_images<C: Channel>(folder: &Path, message: &Message<C>) -> anyhow::Result<()> {
    let header = (message.header() as &dyn Any).downcast_ref::<FrameHeader>();
    let items = (size_of::<C::Item>() == 1).then(|| bytemuck::cast_slice::<C::Item, u8>(message.items()));
    let Some(view) = header.zip(items).and_then(|(header, items)| FrameView::new(header, items)) else {
        return Err(Refusal::usage(format!(
            "{} has no images; expected camera/frame, camera/depth or camera/keyframe with --png",
            C::NAME
        )));
    };
    let stem: PathBuf = folder.join(format!("{:012}", message.stamp_ns() / 1_000_000));
    Ok(write_frame(&stem, &view)?)
}

/// A message in one line.
fn line(channel: &str, told: &Value, items: usize) -> String {
    let number = |name: &str| told[name].as_u64().unwrap_or_default();
    let mut text =
        format!("{:>10.3} s  {channel} {}", s_from_ns(number("stamp_ns")), told["sender"].as_str().unwrap_or(""));
    for (name, value) in told.as_object().into_iter().flatten() {
        if !["stamp_ns", "sent_ns", "sequence", "sender", "items"].contains(&name.as_str()) {
            text += &format!(" {name}={}", short(value));
        }
    }
    if items > 0 {
        text += &format!(" ({items} items)");
    }
    text
}

/// A value as people read it: numbers of a length that fits, text without its quotes.
fn short(value: &Value) -> String {
    match value {
        Value::Array(values) => format!("[{}]", values.iter().map(short).collect::<Vec<_>>().join(" ")),
        Value::Number(number) if number.is_f64() => {
            let text = format!("{:.4}", number.as_f64().unwrap_or_default());
            text.trim_end_matches('0').trim_end_matches('.').to_owned()
        }
        Value::String(text) if text.contains(' ') || text.is_empty() => format!("{text:?}"),
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_short_and_leaves_nothing_out() {
        let told = serde_json::json!({
            "stamp_ns": 12_340_000_000_u64, "sent_ns": 1, "sequence": 3, "sender": "planner",
            "altitude_m": 1.5, "place_m": [0.12345678, -2.0, null], "reason": "no room", "empty": "", "mode": 4,
        });
        let text = line("vehicle/command/request", &told, 0);
        assert!(text.starts_with("    12.340 s  vehicle/command/request planner "), "{text}");
        for part in ["altitude_m=1.5", "place_m=[0.1235 -2 null]", "reason=\"no room\"", "empty=\"\"", "mode=4"] {
            assert!(text.contains(part), "{part}: {text}");
        }
    }

    #[test]
    fn a_pair_has_two_halves_and_a_prefix_is_none() {
        assert!(is_half("scorer/score/reply", "scorer/score/") && !is_half("health/last", "health/"));
    }
}
