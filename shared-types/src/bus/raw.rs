//! Messages as bytes, for recordings: the envelope, the header, the items, as they lie in shared memory.

use bytemuck::allocation::pod_collect_to_vec;
use bytemuck::{bytes_of, cast_slice, try_pod_read_unaligned};

use super::error::BusError;
use super::message::{Envelope, Message, seal};
use super::publisher::Publisher;
use crate::channel::Channel;

/// A message outside of shared memory.
pub struct RawMessage<C: Channel> {
    /// What it says of itself.
    pub envelope: Envelope,
    /// The part of fixed size.
    pub header: C::Header,
    /// The slice.
    pub items: Vec<C::Item>,
}

impl<C: Channel> core::fmt::Debug for RawMessage<C> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("RawMessage")
            .field("channel", &C::NAME)
            .field("envelope", &self.envelope)
            .finish_non_exhaustive()
    }
}

impl<C: Channel> RawMessage<C> {
    /// A message of somebody's own making.
    #[must_use]
    pub fn sealed(envelope: Envelope, header: C::Header, items: Vec<C::Item>) -> Self {
        let seal = seal::<C>(&envelope, &header, &items);
        Self { envelope: Envelope { seal, ..envelope }, header, items }
    }

    /// The message as bytes.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        [bytes_of(&self.envelope), bytes_of(&self.header), cast_slice(&self.items)].concat()
    }

    /// The envelope alone of a message's bytes.
    #[must_use]
    pub fn envelope_of(bytes: &[u8]) -> Option<Envelope> {
        try_pod_read_unaligned(bytes.get(..size_of::<Envelope>())?).ok()
    }

    /// Reads what [`Message::append_to`] wrote. `None` where the number of bytes does not fit the channel, or the seal not the
    /// bytes.
    #[must_use]
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let (envelope, rest) = bytes.split_at_checked(size_of::<Envelope>())?;
        let (header, items) = rest.split_at_checked(size_of::<C::Header>())?;
        if !items.len().is_multiple_of(size_of::<C::Item>()) {
            return None;
        }
        let (envelope, header) = (try_pod_read_unaligned(envelope).ok()?, try_pod_read_unaligned(header).ok()?);
        let message = Self { envelope, header, items: pod_collect_to_vec(items) };
        (seal::<C>(&message.envelope, &message.header, &message.items) == message.envelope.seal).then_some(message)
    }
}

impl<C: Channel> Message<C> {
    /// Appends the message's bytes.
    pub fn append_to(&self, bytes: &mut Vec<u8>) {
        bytes.extend_from_slice(bytes_of(self.envelope()));
        bytes.extend_from_slice(bytes_of(self.header()));
        bytes.extend_from_slice(cast_slice(self.items()));
    }
}

impl<C: Channel> Publisher<C> {
    /// Sends a message again as it was sent once: sender, times and counts are those of then.
    ///
    /// # Errors
    /// As [`Self::send_with`].
    pub fn send_again(&mut self, message: &RawMessage<C>) -> Result<(), BusError> {
        self.send_framed(message.envelope, &message.header, &message.items)
    }
}
