//! All of the recorder's IPC: every channel, read only.

use shared_types::bus::{Bus, BusError, Subscriber};
use shared_types::channel::{
    Channel, ChannelVisitor, ClockChannel, FrameChannel, RenderReplies, TruthChannel, visit_all,
};

use crate::queue::{Queue, Sample};
use crate::topics::priority_of;

/// Whether the times of a channel's messages are the mission's. Keeper, world and commands know the machine's clock only, or
/// none: what they send is recorded at the newest mission time that was heard of.
fn is_mission_time<C: Channel>() -> bool {
    C::SETTINGS.by_tick || [ClockChannel::NAME, TruthChannel::NAME].contains(&C::NAME)
}

/// A channel that is recorded.
trait Source {
    /// Takes what has come into the queue. False where the queue has no room and `wait` says that nothing may be dropped.
    /// `newest_ns`: the newest mission time of any message.
    fn drain(&mut self, now_ns: u64, newest_ns: &mut u64, queue: &Queue, wait: bool) -> Result<bool, BusError>;
    fn received(&self) -> u64;
    fn lost(&self) -> u64;
}

struct Ear<C: Channel> {
    index: usize,
    subscriber: Subscriber<C>,
}

impl<C: Channel> Source for Ear<C> {
    fn drain(&mut self, now_ns: u64, newest_ns: &mut u64, queue: &Queue, wait: bool) -> Result<bool, BusError> {
        let priority = priority_of::<C>();
        loop {
            if wait && !queue.has_room(priority) {
                return Ok(false);
            }
            let Some(message) = self.subscriber.receive(now_ns)? else { return Ok(true) };
            let envelope = *message.envelope();
            let mut bytes = queue.buffer();
            message.append_to(&mut bytes);
            let timed = is_mission_time::<C>() && envelope.sent_ns > 0;
            if timed {
                *newest_ns = envelope.sent_ns.max(*newest_ns);
            }
            // Its chunk goes back to the sender before anything else is done.
            drop(message);
            queue.offer(Sample {
                channel: self.index,
                priority,
                sent_ns: if timed { envelope.sent_ns } else { *newest_ns },
                stamp_ns: envelope.stamp_ns,
                sequence: envelope.sequence,
                bytes,
            });
        }
    }

    fn received(&self) -> u64 {
        self.subscriber.received()
    }

    fn lost(&self) -> u64 {
        self.subscriber.lost()
    }
}

/// The channels.
pub(crate) struct Ports {
    sources: Vec<Box<dyn Source>>,
    newest_ns: u64,
}

struct Opening<'a> {
    bus: &'a Bus,
    frames: bool,
    next: usize,
    sources: Result<Vec<Box<dyn Source>>, BusError>,
}

impl ChannelVisitor for Opening<'_> {
    fn visit<C: Channel>(&mut self) {
        let index = self.next;
        self.next += 1;
        // A reader of the stream makes the camera render it.
        let stream = [FrameChannel::NAME, RenderReplies::NAME].contains(&C::NAME);
        if stream && !self.frames {
            return;
        }
        if let Ok(sources) = &mut self.sources {
            match self.bus.subscriber::<C>() {
                Ok(subscriber) => sources.push(Box::new(Ear { index, subscriber })),
                Err(error) => self.sources = Err(error),
            }
        }
    }
}

impl Ports {
    /// Opens every channel; without `frames`, all but the stream of images.
    pub(crate) fn open(bus: &Bus, frames: bool) -> Result<Self, BusError> {
        let mut opening = Opening { bus, frames, next: 0, sources: Ok(Vec::new()) };
        visit_all(&mut opening);
        Ok(Self { sources: opening.sources?, newest_ns: 0 })
    }

    /// Takes what has come into the queue. False where that must be tried again.
    pub(crate) fn drain(&mut self, now_ns: u64, queue: &Queue, wait: bool) -> Result<bool, BusError> {
        for source in &mut self.sources {
            if !source.drain(now_ns, &mut self.newest_ns, queue, wait)? {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Messages received, and lost by overflow before they could be.
    pub(crate) fn counts(&self) -> (u64, u64) {
        self.sources.iter().fold((0, 0), |(received, lost), s| (received + s.received(), lost + s.lost()))
    }
}
