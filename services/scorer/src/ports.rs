//! All IPC of the scorer: snapshots and requests come in, scores go out.

use shared_types::bus::{Bus, BusError, ReplyAddress, Server, Subscriber};
use shared_types::channel::{ScoreChannel, SnapshotChannel};
use shared_types::messages::{CandidateScore, CandidateView, ScoreReply, ScoreRequest};

use crate::holdings::Holdings;
use crate::job::Held;

/// A request, as it came.
#[derive(Debug, Clone)]
pub struct Asked {
    /// What is asked.
    pub request: ScoreRequest,
    /// Candidates and visited views.
    pub views: Vec<CandidateView>,
    /// Whom to answer.
    pub address: ReplyAddress,
}

/// The channels of the scorer.
#[derive(Debug)]
pub struct Ports {
    snapshots: Subscriber<SnapshotChannel>,
    requests: Server<ScoreChannel>,
    /// Messages received.
    pub received: u64,
    /// Replies sent.
    pub sent: u64,
    /// Replies for which there was no free chunk.
    pub dropped: u64,
}

impl Ports {
    /// Opens the channels.
    ///
    /// # Errors
    /// When the bus refuses.
    pub fn open(bus: &Bus) -> Result<Self, BusError> {
        Ok(Self { snapshots: bus.subscriber()?, requests: bus.server()?, received: 0, sent: 0, dropped: 0 })
    }

    /// Takes every snapshot that has come into the holdings; its chunk is given back at once.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn receive_snapshots(&mut self, now_ns: u64, holdings: &mut Holdings) -> Result<(), BusError> {
        while let Some(message) = self.snapshots.receive(now_ns)? {
            self.received += 1;
            let header = message.header();
            let is_final = header.is_final == 1;
            if header.sh_degree == 0 && holdings.wants(header.generation, is_final) {
                holdings.take(Held::new(header.generation, is_final, message.items()));
            }
        }
        Ok(())
    }

    /// The next request.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn receive_request(&mut self, now_ns: u64) -> Result<Option<Asked>, BusError> {
        let Some(message) = self.requests.receive(now_ns)? else { return Ok(None) };
        self.received += 1;
        Ok(Some(Asked { request: *message.header(), views: message.items().to_vec(), address: message.address() }))
    }

    /// Answers a request. A reply without a free chunk is dropped: its client asks again.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn reply(
        &mut self,
        now_ns: u64,
        to: &ReplyAddress,
        reply: &ScoreReply,
        scores: &[CandidateScore],
    ) -> Result<(), BusError> {
        match self.requests.reply(now_ns, to, reply, scores) {
            Ok(()) => self.sent += 1,
            Err(BusError::NoChunk { .. }) => self.dropped += 1,
            Err(error) => return Err(error),
        }
        Ok(())
    }
}
