//! A received message, and the envelope around every header.

use iceoryx2::prelude::ZeroCopySend;

use super::Ipc;
use crate::Payload;
use crate::channel::Channel;
use crate::messages::check::LATEST;
use crate::messages::{Check as _, Fault};
use crate::payload;

payload! {
    /// What every message says of itself.
    pub struct Envelope [64] {
        /// Mission time of what it describes.
        pub stamp_ns: u64,
        /// Mission time when it was sent; 0 from commands outside the mission's clock.
        pub sent_ns: u64,
        /// Counts the messages of its sender on this channel.
        pub sequence: u64,
        /// Which life of the sender sent it.
        pub incarnation: u64,
        /// Of requests and replies: the request's id.
        pub request_id: u64,
        /// Of requests and replies: which life of the client asked, or which mission (ids of short-lived commands and of
        /// missions may repeat).
        pub client_incarnation: u64,
        /// [`crate::ServiceName`] code of the sender.
        pub sender: u32,
        /// Of requests and replies: [`crate::ServiceName`] code of the client.
        pub client: u32,
        /// Checksum over the rest of the message, set by the sender: what strays into a channel has none that fits.
        pub seal: u64,
    }
}

/// Items of this many bytes or fewer are under the seal; images and models, which are more, are not: their sizes are in the
/// header, and hashing them would cost as much as copying them.
const SEALED_BYTES: usize = 256 << 10;

/// A message describes what was, give or take the error of a clock that is not synchronised yet.
const AHEAD_NS: u64 = 10_000_000_000;

/// The checksum of a message (FNV-1a over 8-byte words), with the seal itself taken as zero.
pub(super) fn seal<C: Channel>(envelope: &Envelope, header: &C::Header, items: &[C::Item]) -> u64 {
    let unsealed = Envelope { seal: 0, ..*envelope };
    let items_bytes: &[u8] = bytemuck::cast_slice(items);
    let mut hash = C::SCHEMA ^ (items.len() as u64).rotate_left(32);
    let small = if items_bytes.len() <= SEALED_BYTES { items_bytes } else { &[] };
    for bytes in [bytemuck::bytes_of(&unsealed), bytemuck::bytes_of(header), small] {
        let (words, rest) = bytes.as_chunks::<8>();
        for word in words {
            hash = crate::payload::fold(hash, u64::from_le_bytes(*word));
        }
        for byte in rest {
            hash = crate::payload::fold(hash, u64::from(*byte));
        }
    }
    hash
}

/// Envelope and header, as they lie in shared memory.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
pub struct Framed<H> {
    pub(crate) envelope: Envelope,
    pub(crate) header: H,
}

#[expect(unsafe_code, reason = "shared memory needs the promise that the type holds no pointer")]
// SAFETY: `repr(C)` of two types that are `Pod`: no pointers, no drop glue.
unsafe impl<H: Payload> ZeroCopySend for Framed<H> {}

type RawSample<C> = iceoryx2::sample::Sample<Ipc, [<C as Channel>::Item], Framed<<C as Channel>::Header>>;

/// A message, read where it lies. Dropping it gives its chunk back to the sender: do not keep more than a few.
pub struct Message<C: Channel>(RawSample<C>);

impl<C: Channel> core::fmt::Debug for Message<C> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Message").field("channel", &C::NAME).field("envelope", self.envelope()).finish_non_exhaustive()
    }
}

impl<C: Channel> Message<C> {
    pub(super) fn new(raw: RawSample<C>) -> Self {
        Self(raw)
    }

    /// Whether the message can be what its channel carries: the seal fits, its sender is known, its times are of this world,
    /// and [`Check`] agrees.
    pub(super) fn check(&self) -> Result<(), Fault> {
        let envelope = self.envelope();
        if envelope.seal != seal::<C>(envelope, self.header(), self.items()) {
            let found = format!("{:#018x}", envelope.seal);
            return Err(Fault { field: "seal", found, expected: "the checksum of the message" });
        }
        let late = [envelope.stamp_ns, envelope.sent_ns, envelope.sequence].into_iter().find(|&value| value > LATEST);
        if let Some(late) = late {
            return Err(Fault {
                field: "stamp_ns, sent_ns, sequence",
                found: late.to_string(),
                expected: "at most 2^62",
            });
        }
        if envelope.stamp_ns > envelope.sent_ns.saturating_add(AHEAD_NS) {
            let found = format!("{} ns at {} ns", envelope.stamp_ns, envelope.sent_ns);
            return Err(Fault { field: "stamp_ns", found, expected: "nothing of the future" });
        }
        for (field, code) in [("sender", envelope.sender), ("client", envelope.client)] {
            if crate::ServiceName::from_code(code).is_none() {
                return Err(Fault { field, found: code.to_string(), expected: "a service's code" });
            }
        }
        self.header().check(self.items())
    }

    /// What the message says of itself.
    #[must_use]
    pub fn envelope(&self) -> &Envelope {
        &self.0.user_header().envelope
    }

    /// The part of fixed size.
    #[must_use]
    pub fn header(&self) -> &C::Header {
        &self.0.user_header().header
    }

    /// The slice, in shared memory.
    #[must_use]
    pub fn items(&self) -> &[C::Item] {
        self.0.payload()
    }

    /// Mission time of what it describes.
    #[must_use]
    pub fn stamp_ns(&self) -> u64 {
        self.envelope().stamp_ns
    }

    /// Mission time when it was sent.
    #[must_use]
    pub fn sent_ns(&self) -> u64 {
        self.envelope().sent_ns
    }

    /// Of requests and replies: the request's id.
    #[must_use]
    pub fn request_id(&self) -> u64 {
        self.envelope().request_id
    }

    /// Of requests: where the reply goes.
    #[must_use]
    pub fn address(&self) -> super::ReplyAddress {
        let envelope = self.envelope();
        super::ReplyAddress {
            client: envelope.client,
            client_incarnation: envelope.client_incarnation,
            request_id: envelope.request_id,
            sent_ns: envelope.sent_ns,
        }
    }
}
