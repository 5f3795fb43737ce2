//! The receiving end of a channel.

use std::cell::Cell;
use std::collections::{BTreeSet, VecDeque};
use std::rc::Rc;

use iceoryx2::port::ReceiveError;

use super::Ipc;
use super::error::BusError;
use super::message::{Framed, Message};
use crate::channel::Channel;
use crate::messages::Fault;
use crate::post_mortem::heard;

type RawSubscriber<C> =
    iceoryx2::port::subscriber::Subscriber<Ipc, [<C as Channel>::Item], Framed<<C as Channel>::Header>>;

/// Receives from a channel.
///
/// A member of a lockstep clock sees only messages sent before its present tick, in the order (sent, sender, sequence), and
/// keeps the rest: what another member sends in the same tick may or may not have arrived, and must not matter.
///
/// A message that cannot be what the channel carries ([`crate::messages::check`]) is never given out: it is counted, and
/// told once for each field that was wrong.
pub struct Subscriber<C: Channel> {
    raw: RawSubscriber<C>,
    kept: VecDeque<Message<C>>,
    by_tick: bool,
    received: u64,
    expected: std::collections::BTreeMap<(u32, u64), u64>,
    lost: u64,
    /// Refused so far, by all subscribers of the process.
    refused: Rc<Cell<u64>>,
    /// Fields for which a refusal was told.
    told: BTreeSet<&'static str>,
}

/// Senders whose counts are remembered; lives of processes beyond these are forgotten, and with them only what they lost.
const MOST_SENDERS: usize = 64;
/// Messages refused in a row before the reader gets its turn back: who floods a channel must not stop its readers.
const MOST_REFUSED: usize = 256;
/// A member of a lockstep clock is at most a tick ahead of another; a message from farther ahead gives way to others.
const AHEAD_NS: u64 = 2 * crate::TICK_NS;

impl<C: Channel> core::fmt::Debug for Subscriber<C> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Subscriber")
            .field("channel", &C::NAME)
            .field("received", &self.received)
            .finish_non_exhaustive()
    }
}

impl<C: Channel> Subscriber<C> {
    pub(super) fn new(raw: RawSubscriber<C>, by_tick: bool, refused: Rc<Cell<u64>>) -> Self {
        Self {
            raw,
            kept: VecDeque::new(),
            by_tick,
            received: 0,
            expected: Default::default(),
            lost: 0,
            refused,
            told: BTreeSet::new(),
        }
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
        self.drain(now_ns)?;
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

    fn drain(&mut self, now_ns: u64) -> Result<(), BusError> {
        let room = C::SETTINGS.queue + 1;
        loop {
            let before = self.kept.len();
            while self.kept.len() < room {
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
            // What claims to come from the future waits for its time; it must not keep out what is of now.
            let ahead = |message: &Message<C>| message.sent_ns() > now_ns.saturating_add(AHEAD_NS);
            if self.kept.len() < room || !self.kept.back().is_some_and(ahead) {
                return Ok(());
            }
            if let Some(message) = self.kept.pop_back() {
                let found = message.sent_ns().to_string();
                self.refuse(
                    message.envelope().sender,
                    &Fault { field: "sent_ns", found, expected: "a time that has come" },
                );
            }
        }
    }

    fn next(&mut self) -> Result<Option<Message<C>>, BusError> {
        for _ in 0..MOST_REFUSED {
            let message = match self.raw.receive() {
                Ok(Some(raw)) => Message::new(raw),
                Ok(None) | Err(ReceiveError::ExceedsMaxBorrows) => return Ok(None),
                Err(cause) => return Err(BusError::Receive { channel: C::NAME, cause: format!("{cause:?}") }),
            };
            self.received += 1;
            let envelope = *message.envelope();
            if let Err(fault) = message.check() {
                drop(message);
                self.refuse(envelope.sender, &fault);
                continue;
            }
            let sender = (envelope.sender, envelope.incarnation);
            if self.expected.len() >= MOST_SENDERS && !self.expected.contains_key(&sender) {
                self.expected.clear();
            }
            let next = self.expected.entry(sender).or_insert(envelope.sequence);
            self.lost = self.lost.saturating_add(envelope.sequence.saturating_sub(*next));
            *next = envelope.sequence.saturating_add(1);
            heard::note(C::NAME, envelope.sender, envelope.sequence, envelope.sent_ns);
            return Ok(Some(message));
        }
        Ok(None)
    }

    fn refuse(&mut self, sender: u32, fault: &Fault) {
        self.refused.set(self.refused.get().saturating_add(1));
        if self.told.insert(fault.field) {
            tracing::warn!(channel = C::NAME, sender, %fault, "a message is refused; another process writes what it should not");
        }
    }
}
