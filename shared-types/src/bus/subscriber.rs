//! The receiving end of a channel.

use std::collections::VecDeque;

use iceoryx2::port::ReceiveError;

use super::Ipc;
use super::error::BusError;
use super::message::{Framed, Message};
use crate::channel::Channel;

type RawSubscriber<C> =
    iceoryx2::port::subscriber::Subscriber<Ipc, [<C as Channel>::Item], Framed<<C as Channel>::Header>>;

/// Receives from a channel.
///
/// A member of a lockstep clock sees only messages sent before its present tick, in the order (sent, sender, sequence), and
/// keeps the rest: what another member sends in the same tick may or may not have arrived, and must not matter.
pub struct Subscriber<C: Channel> {
    raw: RawSubscriber<C>,
    kept: VecDeque<Message<C>>,
    by_tick: bool,
    received: u64,
    expected: std::collections::BTreeMap<(u32, u64), u64>,
    lost: u64,
}

impl<C: Channel> core::fmt::Debug for Subscriber<C> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Subscriber")
            .field("channel", &C::NAME)
            .field("received", &self.received)
            .finish_non_exhaustive()
    }
}

impl<C: Channel> Subscriber<C> {
    pub(super) fn new(raw: RawSubscriber<C>, by_tick: bool) -> Self {
        Self { raw, kept: VecDeque::new(), by_tick, received: 0, expected: Default::default(), lost: 0 }
    }

    /// The next message, if there is one.
    ///
    /// # Errors
    /// When the channel is broken; a sender's death alone is no error.
    pub fn receive(&mut self, now_ns: u64) -> Result<Option<Message<C>>, BusError> {
        if !self.by_tick {
            if let Some(message) = self.kept.pop_front() {
                return Ok(Some(message));
            }
            return self.next();
        }
        self.drain()?;
        let due = self.kept.front().is_some_and(|message| message.sent_ns() < now_ns);
        Ok(if due { self.kept.pop_front() } else { None })
    }

    /// The newest message, if there is one; older ones are dropped.
    ///
    /// # Errors
    /// As [`Self::receive`].
    pub fn latest(&mut self, now_ns: u64) -> Result<Option<Message<C>>, BusError> {
        let mut newest = None;
        loop {
            match self.receive(now_ns)? {
                // The older one is dropped before the next is received: readers may hold only a few.
                Some(message) => newest = Some(message),
                None => return Ok(newest),
            }
        }
    }

    /// Drops everything that has arrived.
    ///
    /// # Errors
    /// As [`Self::receive`].
    pub fn clear(&mut self) -> Result<(), BusError> {
        self.kept.clear();
        while self.next()?.is_some() {}
        Ok(())
    }

    /// Messages received so far.
    #[must_use]
    pub fn received(&self) -> u64 {
        self.received
    }

    /// Messages lost by overflow so far, by gaps in the senders' counts.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.lost
    }

    fn drain(&mut self) -> Result<(), BusError> {
        let before = self.kept.len();
        while self.kept.len() < C::SETTINGS.queue + 1 {
            match self.next()? {
                Some(message) => self.kept.push_back(message),
                None => break,
            }
        }
        if self.kept.len() > before {
            self.kept.make_contiguous().sort_by_key(|message| {
                let envelope = message.envelope();
                (envelope.sent_ns, envelope.sender, envelope.incarnation, envelope.sequence)
            });
        }
        Ok(())
    }

    fn next(&mut self) -> Result<Option<Message<C>>, BusError> {
        match self.raw.receive() {
            Ok(None) => Ok(None),
            Ok(Some(raw)) => {
                self.received += 1;
                let message = Message::new(raw);
                let envelope = *message.envelope();
                let next = self.expected.entry((envelope.sender, envelope.incarnation)).or_insert(envelope.sequence);
                self.lost += envelope.sequence.saturating_sub(*next);
                *next = envelope.sequence + 1;
                Ok(Some(message))
            }
            Err(ReceiveError::ExceedsMaxBorrows) => Ok(None),
            Err(cause) => Err(BusError::Receive { channel: C::NAME, cause: format!("{cause:?}") }),
        }
    }
}
