//! All IPC of the trainer: rounds come in, progress and snapshots go out.

use shared_types::bus::{Bus, BusError, Publisher, ReplyAddress, Server};
use shared_types::channel::{RoundChannel, SnapshotChannel};
use shared_types::messages::{RoundReply, RoundStatus, SnapshotHeader};
use shared_types::payload::pack_text;

use crate::round::{Progress, RoundSpec};
use crate::session::Snapshot;

/// A request for a round, as it came.
#[derive(Debug)]
pub struct Asked {
    /// Number of the round.
    pub round: u32,
    /// What is asked, or what makes no sense in it.
    pub spec: Result<RoundSpec, String>,
    /// Whom to answer.
    pub address: ReplyAddress,
}

/// The channels of the trainer.
#[derive(Debug)]
pub struct Ports {
    rounds: Server<RoundChannel>,
    snapshots: Publisher<SnapshotChannel>,
    /// Requests received.
    pub received: u64,
    /// Replies and snapshots sent.
    pub sent: u64,
    /// Replies and snapshots for which there was no free chunk.
    pub dropped: u64,
}

impl Ports {
    /// Opens the channels.
    ///
    /// # Errors
    /// When the bus refuses.
    pub fn open(bus: &Bus) -> Result<Self, BusError> {
        Ok(Self { rounds: bus.server()?, snapshots: bus.publisher()?, received: 0, sent: 0, dropped: 0 })
    }

    /// The next request.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn receive(&mut self, now_ns: u64) -> Result<Option<Asked>, BusError> {
        let Some(message) = self.rounds.receive(now_ns)? else { return Ok(None) };
        self.received += 1;
        Ok(Some(Asked {
            round: message.header().round,
            spec: RoundSpec::from_request(message.header(), message.items()),
            address: message.address(),
        }))
    }

    /// Answers a request. A reply without a free chunk is dropped: its client asks again.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn reply(
        &mut self,
        now_ns: u64,
        to: &ReplyAddress,
        round: u32,
        progress: &Progress,
        outcome: &Outcome<'_>,
    ) -> Result<(), BusError> {
        let (status, generation, reason) = match outcome {
            Outcome::Progress => (RoundStatus::Progress, 0, ""),
            Outcome::Done { generation } => (RoundStatus::Done, *generation, ""),
            Outcome::Failed { reason } => (RoundStatus::Failed, 0, *reason),
        };
        let reply = RoundReply {
            generation,
            gaussians: progress.gaussians,
            round,
            status: status.code(),
            iterations: progress.iterations,
            total_iterations: u32::try_from(progress.total_iterations).unwrap_or(u32::MAX),
            loss: progress.loss,
            psnr_train_db: progress.psnr_train_db,
            reason: pack_text(reason),
        };
        let sent = self.rounds.reply(now_ns, to, &reply, &[]);
        self.count(sent).map(|_| ())
    }

    /// Publishes a snapshot; false when there was no free chunk for it.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn publish(&mut self, now_ns: u64, snapshot: &Snapshot) -> Result<bool, BusError> {
        let header = SnapshotHeader {
            generation: snapshot.generation,
            iterations: snapshot.total_iterations,
            box_center_m: snapshot.spec.box_center_m.to_array(),
            box_size_m: snapshot.spec.box_size_m,
            round: snapshot.spec.round,
            is_final: u32::from(snapshot.is_final),
            sh_degree: 0,
            reserved: 0,
        };
        let sent = self.snapshots.send_items(now_ns, now_ns, &header, &snapshot.rows);
        self.count(sent)
    }

    fn count(&mut self, sent: Result<(), BusError>) -> Result<bool, BusError> {
        match sent {
            Ok(()) => {
                self.sent += 1;
                Ok(true)
            }
            Err(BusError::NoChunk { .. }) => {
                self.dropped += 1;
                Ok(false)
            }
            Err(error) => Err(error),
        }
    }
}

/// What a reply says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome<'a> {
    /// The round goes on.
    Progress,
    /// The round is over.
    Done {
        /// Its final snapshot.
        generation: u64,
    },
    /// The round cannot be run.
    Failed {
        /// Why.
        reason: &'a str,
    },
}
