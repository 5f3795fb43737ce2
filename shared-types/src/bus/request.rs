//! Requests with replies, over a pair of channels.
//!
//! A request is kept by its client and sent again every half second of wall time until the client is done with it, so a
//! server that was restarted gets it again; the server tells repeated requests by (client, id) and joins or answers the
//! same. Giving up is the client's decision, on the mission clock.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::error::BusError;
use super::message::{Envelope, Message};
use super::{Publisher, Subscriber};
use crate::channel::{Channel, RequestChannel};
use crate::service::ServiceName;

const RESEND_AFTER: Duration = Duration::from_millis(500);

/// Whom a reply goes to, and to which request. Equal for the same request sent again.
#[derive(Debug, Clone, Copy)]
pub struct ReplyAddress {
    /// [`ServiceName`] code of the client.
    pub client: u32,
    /// Which life of the client asked, or which mission: ids of the planner count within a mission. 0 for other services,
    /// whose ids are unique over restarts.
    pub client_incarnation: u64,
    /// The request's id.
    pub request_id: u64,
    /// Mission time when the request was first sent.
    pub sent_ns: u64,
}

impl ReplyAddress {
    /// What makes a request the same: the client and its id.
    #[must_use]
    pub fn key(&self) -> (u32, u64, u64) {
        (self.client, self.client_incarnation, self.request_id)
    }
}

impl PartialEq for ReplyAddress {
    fn eq(&self, other: &Self) -> bool {
        self.key() == other.key()
    }
}

impl Eq for ReplyAddress {}

type ItemOf<C> = <C as Channel>::Item;
type HeaderOf<C> = <C as Channel>::Header;

struct Kept<C: Channel> {
    envelope: Envelope,
    header: HeaderOf<C>,
    items: Vec<ItemOf<C>>,
    sent_at: Instant,
}

/// Asks.
pub struct Client<R: RequestChannel> {
    requests: Publisher<R::Request>,
    replies: Subscriber<R::Reply>,
    sender: ServiceName,
    incarnation: u64,
    kept: BTreeMap<u64, Kept<R::Request>>,
}

impl<R: RequestChannel> core::fmt::Debug for Client<R> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Client")
            .field("channel", &R::Request::NAME)
            .field("pending", &self.kept.len())
            .finish_non_exhaustive()
    }
}

impl<R: RequestChannel> Client<R> {
    pub(super) fn new(requests: Publisher<R::Request>, replies: Subscriber<R::Reply>, sender: ServiceName) -> Self {
        // Ids of services come from journals and are unique over restarts; those of commands are not.
        let incarnation = if sender == ServiceName::Command { u64::from(std::process::id()) } else { 0 };
        Self { requests, replies, sender, incarnation, kept: BTreeMap::new() }
    }

    /// Says which mission the ids count in: those of a journal begin anew with every mission, in a system that stays up.
    pub fn count_within(&mut self, mission: u64) {
        self.incarnation = mission;
    }

    /// Sends a request and keeps it until [`Self::finish`]. The id is unique over the client's restarts.
    ///
    /// # Errors
    /// As [`Publisher::send_with`]; the request is kept and sent again all the same.
    pub fn send(
        &mut self,
        now_ns: u64,
        request_id: u64,
        header: &HeaderOf<R::Request>,
        items: &[ItemOf<R::Request>],
    ) -> Result<(), BusError> {
        let envelope = Envelope {
            stamp_ns: now_ns,
            sent_ns: now_ns,
            request_id,
            client: self.sender.code(),
            client_incarnation: self.incarnation,
            ..Envelope::default()
        };
        let kept = Kept { envelope, header: *header, items: items.to_vec(), sent_at: Instant::now() };
        let result = self.requests.send_enveloped(envelope, header, items.len(), |loan| loan.copy_from_slice(items));
        self.kept.insert(request_id, kept);
        result
    }

    /// The next reply to a request of this client that is still kept. Sends again what has waited too long.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn receive(&mut self, now_ns: u64) -> Result<Option<Message<R::Reply>>, BusError> {
        self.resend(now_ns);
        while let Some(reply) = self.replies.receive(now_ns)? {
            let envelope = reply.envelope();
            let ours = envelope.client == self.sender.code() && envelope.client_incarnation == self.incarnation;
            if ours && let Some(kept) = self.kept.get_mut(&envelope.request_id) {
                // A server that answers is alive: no need to ask it again yet.
                kept.sent_at = Instant::now();
                return Ok(Some(reply));
            }
        }
        Ok(None)
    }

    /// Forgets a request: its answer has come, or nobody waits for it any more.
    pub fn finish(&mut self, request_id: u64) {
        self.kept.remove(&request_id);
    }

    /// Ids of the requests being waited for.
    pub fn pending(&self) -> impl Iterator<Item = u64> + '_ {
        self.kept.keys().copied()
    }

    fn resend(&mut self, now_ns: u64) {
        for kept in self.kept.values_mut().filter(|kept| kept.sent_at.elapsed() > RESEND_AFTER) {
            kept.sent_at = Instant::now();
            // `sent_ns` orders messages of a tick and is the present; `stamp_ns` stays the time of the first sending.
            let envelope = Envelope { sent_ns: now_ns.max(kept.envelope.sent_ns), ..kept.envelope };
            let Kept { header, items, .. } = kept;
            if let Err(error) =
                self.requests.send_enveloped(envelope, header, items.len(), |loan| loan.copy_from_slice(items))
            {
                tracing::debug!(%error, "could not send a request again");
            }
        }
    }
}

/// Answers.
pub struct Server<R: RequestChannel> {
    requests: Subscriber<R::Request>,
    replies: Publisher<R::Reply>,
}

impl<R: RequestChannel> core::fmt::Debug for Server<R> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Server").field("channel", &R::Request::NAME).finish_non_exhaustive()
    }
}

impl<R: RequestChannel> Server<R> {
    pub(super) fn new(requests: Subscriber<R::Request>, replies: Publisher<R::Reply>) -> Self {
        Self { requests, replies }
    }

    /// The next request. The same one may come several times.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn receive(&mut self, now_ns: u64) -> Result<Option<Message<R::Request>>, BusError> {
        self.requests.receive(now_ns)
    }

    /// Answers a request; several answers to one request are allowed.
    ///
    /// # Errors
    /// As [`Publisher::send_with`].
    pub fn reply(
        &mut self,
        now_ns: u64,
        to: &ReplyAddress,
        header: &HeaderOf<R::Reply>,
        items: &[ItemOf<R::Reply>],
    ) -> Result<(), BusError> {
        self.reply_with(now_ns, to, header, items.len(), |loan| loan.copy_from_slice(items))
    }

    /// Answers a request with `len` items written in place.
    ///
    /// # Errors
    /// As [`Publisher::send_with`].
    pub fn reply_with(
        &mut self,
        now_ns: u64,
        to: &ReplyAddress,
        header: &HeaderOf<R::Reply>,
        len: usize,
        fill: impl FnOnce(&mut [ItemOf<R::Reply>]),
    ) -> Result<(), BusError> {
        crate::fault_point::reach("reply", R::Reply::NAME);
        let envelope = Envelope {
            stamp_ns: now_ns,
            sent_ns: now_ns,
            request_id: to.request_id,
            client: to.client,
            client_incarnation: to.client_incarnation,
            ..Envelope::default()
        };
        self.replies.send_enveloped(envelope, header, len, fill)
    }
}
