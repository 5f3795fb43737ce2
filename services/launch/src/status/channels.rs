//! What goes on on each channel, seen by listening for a while.

use std::time::{Duration, Instant};

use serde::Serialize;
use shared_types::bus::{Bus, BusError, Census, Subscriber};
use shared_types::channel::{Channel, ChannelVisitor, FrameChannel, visit_all};

/// What is known of a channel.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChannelRow {
    /// Who is on it, and its memory.
    #[serde(flatten)]
    pub census: Census,
    /// Messages per second of wall time, those included that came too fast to be looked at; absent where nobody listened.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate_hz: Option<f64>,
    /// Wall time since the last message, seconds; absent when none came while listening.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub heard_s: Option<f64>,
}

/// A channel that is listened to.
trait Listened {
    /// Takes what has come.
    fn listen(&mut self) -> Result<(), BusError>;
    fn row(&self, bus: &Bus, listened: Duration) -> Result<ChannelRow, BusError>;
}

struct Ear<C: Channel> {
    /// None on the stream of images, which the camera makes for its readers only: looking would make it.
    subscriber: Option<Subscriber<C>>,
    last: Option<Instant>,
}

impl<C: Channel> Listened for Ear<C> {
    fn listen(&mut self) -> Result<(), BusError> {
        if let Some(subscriber) = &mut self.subscriber
            && subscriber.latest(u64::MAX)?.is_some()
        {
            self.last = Some(Instant::now());
        }
        Ok(())
    }

    fn row(&self, bus: &Bus, listened: Duration) -> Result<ChannelRow, BusError> {
        let mut census = bus.census::<C>()?;
        // This command's own reader does not count.
        census.subscribers = census.subscribers.saturating_sub(usize::from(self.subscriber.is_some()));
        #[expect(clippy::cast_precision_loss, reason = "a figure for people")]
        let per_s = |messages: u64| messages as f64 / listened.as_secs_f64();
        Ok(ChannelRow {
            census,
            rate_hz: self.subscriber.as_ref().map(|heard| per_s(heard.received() + heard.lost())),
            heard_s: self.last.map(|last| last.elapsed().as_secs_f64()),
        })
    }
}

/// Listens to all channels of a system.
pub struct Channels {
    ears: Vec<Box<dyn Listened>>,
    began: Instant,
}

struct Opening<'a> {
    bus: &'a Bus,
    ears: Vec<Box<dyn Listened>>,
    failed: Option<BusError>,
}

impl ChannelVisitor for Opening<'_> {
    fn visit<C: Channel>(&mut self) {
        let stream = C::NAME == FrameChannel::NAME;
        match if stream { Ok(None) } else { self.bus.subscriber::<C>().map(Some) } {
            Ok(subscriber) => self.ears.push(Box::new(Ear { subscriber, last: None })),
            Err(error) => self.failed = Some(error),
        }
    }
}

impl Channels {
    /// Begins to listen.
    ///
    /// # Errors
    /// When a channel belongs to another version or has too many readers.
    pub fn open(bus: &Bus) -> Result<Self, BusError> {
        let mut opening = Opening { bus, ears: Vec::new(), failed: None };
        visit_all(&mut opening);
        match opening.failed {
            Some(error) => Err(error),
            None => Ok(Self { ears: opening.ears, began: Instant::now() }),
        }
    }

    /// Takes what has come.
    ///
    /// # Errors
    /// When a channel is broken.
    pub fn listen(&mut self) -> Result<(), BusError> {
        self.ears.iter_mut().try_for_each(|ear| ear.listen())
    }

    /// What was heard.
    ///
    /// # Errors
    /// When a channel is broken.
    pub fn rows(&self, bus: &Bus) -> Result<Vec<ChannelRow>, BusError> {
        let listened = self.began.elapsed();
        self.ears.iter().map(|ear| ear.row(bus, listened)).collect()
    }
}
