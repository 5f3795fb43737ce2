//! Every channel of the planner, and the translation between messages and the mission's plain data.

use std::collections::BTreeMap;

use shared_types::bus::{Bus, BusError, Client, Publisher, ReplyAddress, Server, Subscriber};
use shared_types::channel::{
    AliveChannel, CaptureChannel, DepthChannel, MissionCommandChannel, MissionStateChannel, RoundChannel, ScoreChannel,
    VehicleCommandChannel, VehicleStateChannel, VehicleTargetChannel,
};
use shared_types::folder::MissionFolder;
use shared_types::messages::{Alive, FrameView, KeyframeReason, MissionCommand, MissionReply};
use shared_types::payload::pack_text;

use crate::io::{Effect, Inputs, Views};
use crate::logic::depth::DepthView;

/// Commands whose answers are remembered: the same request may come again.
const REMEMBERED: usize = 64;

/// The planner's ends of its channels.
#[derive(Debug)]
pub struct Ports {
    states: Subscriber<VehicleStateChannel>,
    depths: Subscriber<DepthChannel>,
    targets: Publisher<VehicleTargetChannel>,
    alive: Publisher<AliveChannel>,
    missions: Publisher<MissionStateChannel>,
    orders: Server<MissionCommandChannel>,
    vehicle: Client<VehicleCommandChannel>,
    captures: Client<CaptureChannel>,
    rounds: Client<RoundChannel>,
    scores: Client<ScoreChannel>,
    /// Who waits for the answer to a command, by its number.
    asking: BTreeMap<usize, ReplyAddress>,
    commands: usize,
    answered: Vec<((u32, u64, u64), MissionReply)>,
    /// Messages received.
    pub received: u64,
    /// Messages sent.
    pub sent: u64,
    /// Messages that found no room.
    pub dropped: u64,
}

impl Ports {
    /// Opens every channel.
    ///
    /// # Errors
    /// When a channel cannot be opened.
    pub fn open(bus: &Bus) -> Result<Self, BusError> {
        Ok(Self {
            states: bus.subscriber()?,
            depths: bus.subscriber()?,
            targets: bus.publisher()?,
            alive: bus.publisher()?,
            missions: bus.publisher()?,
            orders: bus.server()?,
            vehicle: bus.client()?,
            captures: bus.client()?,
            rounds: bus.client()?,
            scores: bus.client()?,
            asking: BTreeMap::new(),
            commands: 0,
            answered: Vec::new(),
            received: 0,
            sent: 0,
            dropped: 0,
        })
    }

    /// Says which mission the ids of requests count in.
    pub fn count_within(&mut self, mission: u64) {
        self.vehicle.count_within(mission);
        self.captures.count_within(mission);
        self.rounds.count_within(mission);
        self.scores.count_within(mission);
    }

    /// Everything that was sent before now.
    ///
    /// # Errors
    /// When a channel is broken.
    pub fn receive(&mut self, now_ns: u64) -> Result<Inputs, BusError> {
        let mut inputs = Inputs::default();
        while let Some(message) = self.states.receive(now_ns)? {
            inputs.vehicle = Some(*message.header());
            self.received += 1;
        }
        while let Some(message) = self.depths.receive(now_ns)? {
            self.received += 1;
            // The writer is another process and may be wild: what does not fit is no image.
            if let Some(view) = FrameView::new(message.header(), message.items()) {
                inputs.depths.push(DepthView {
                    stamp_ns: message.stamp_ns(),
                    world_from_camera: view.header.world_from_camera(),
                    intrinsics: view.header.intrinsics(),
                    depth_m: view.depth_m_vec(),
                });
            }
        }
        while let Some(message) = self.orders.receive(now_ns)? {
            self.received += 1;
            let address = message.address();
            if let Some((_, reply)) = self.answered.iter().find(|(key, _)| *key == address.key()) {
                let reply = *reply;
                self.orders.reply(now_ns, &address, &reply, &[])?;
            } else if self.asking.values().any(|asker| asker.key() == address.key()) {
                // Sent again: its answer waits for the disk.
            } else if let Some(command) = MissionCommand::from_code(message.header().command) {
                inputs.commands.push((self.commands, command));
                self.asking.insert(self.commands, address);
                self.commands += 1;
            } else {
                let why = format!("no mission command has the code {}", message.header().command);
                self.answer(now_ns, &address, Err(why))?;
            }
        }
        while let Some(message) = self.vehicle.receive(now_ns)? {
            inputs.command_replies.push((message.request_id(), *message.header()));
            self.received += 1;
        }
        while let Some(message) = self.captures.receive(now_ns)? {
            inputs.capture_replies.push((message.request_id(), *message.header()));
            self.received += 1;
        }
        while let Some(message) = self.rounds.receive(now_ns)? {
            inputs.round_replies.push((message.request_id(), *message.header()));
            self.received += 1;
        }
        while let Some(message) = self.scores.receive(now_ns)? {
            inputs.score_replies.push((message.request_id(), *message.header(), message.items().to_vec()));
            self.received += 1;
        }
        Ok(inputs)
    }

    /// Tells px4-link that the planner's loop turns.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn alive(&mut self, now_ns: u64, sequence: u64) -> Result<(), BusError> {
        let sent = self.alive.send(now_ns, now_ns, &Alive { sequence });
        self.count(sent)
    }

    /// Does what a turn came to. Its entries are on disk.
    ///
    /// # Errors
    /// When a channel is broken.
    pub fn carry_out(&mut self, now_ns: u64, effect: &Effect) -> Result<(), BusError> {
        match effect {
            Effect::Target(target, waypoints) => {
                let sent = self.targets.send_items(now_ns, now_ns, target, waypoints);
                self.count(sent)
            }
            // Requests are kept and sent again until they are finished: one without room now goes out later.
            Effect::Command(id, request) => {
                let sent = self.vehicle.send(now_ns, *id, request, &[]);
                self.count(sent)
            }
            Effect::Capture(id, request) => {
                let sent = self.captures.send(now_ns, *id, request, &[]);
                self.count(sent)
            }
            Effect::Round(id, request, keyframes) => {
                let sent = self.rounds.send(now_ns, *id, request, keyframes);
                self.count(sent)
            }
            Effect::Score(id, request, views) => {
                let sent = self.scores.send(now_ns, *id, request, views);
                self.count(sent)
            }
            Effect::State(state, candidates) => {
                let sent = self.missions.send_items(now_ns, now_ns, state, candidates);
                self.count(sent)
            }
            Effect::CommandOver(id) => {
                self.vehicle.finish(*id);
                Ok(())
            }
            Effect::CaptureOver(id) => {
                self.captures.finish(*id);
                Ok(())
            }
            Effect::RoundOver(id) => {
                self.rounds.finish(*id);
                Ok(())
            }
            Effect::ScoreOver(id) => {
                self.scores.finish(*id);
                Ok(())
            }
            Effect::Answer(number, answer) => match self.asking.remove(number) {
                Some(address) => self.answer(now_ns, &address, answer.clone()),
                None => Ok(()),
            },
        }
    }

    /// Forgets what lies in the queues, and the requests in flight.
    ///
    /// # Errors
    /// When a channel is broken.
    pub fn forget(&mut self) -> Result<(), BusError> {
        self.states.clear()?;
        self.depths.clear()?;
        let pending: Vec<u64> = self.vehicle.pending().collect();
        pending.into_iter().for_each(|id| self.vehicle.finish(id));
        let pending: Vec<u64> = self.captures.pending().collect();
        pending.into_iter().for_each(|id| self.captures.finish(id));
        Ok(())
    }

    fn answer(&mut self, now_ns: u64, to: &ReplyAddress, answer: Result<(), String>) -> Result<(), BusError> {
        let reply = MissionReply {
            accepted: u32::from(answer.is_ok()),
            reserved: 0,
            reason: answer.err().map_or([0; 120], |why| pack_text(&why)),
        };
        if self.answered.len() >= REMEMBERED {
            self.answered.remove(0);
        }
        self.answered.push((to.key(), reply));
        let sent = self.orders.reply(now_ns, to, &reply, &[]);
        self.count(sent)
    }

    fn count(&mut self, sent: Result<(), BusError>) -> Result<(), BusError> {
        match sent {
            Ok(()) => self.sent += 1,
            Err(BusError::NoChunk { .. }) => self.dropped += 1,
            Err(error) => return Err(error),
        }
        Ok(())
    }
}

/// Stored views, read from the mission folder: it decides, whatever was published.
#[derive(Debug)]
pub struct FolderViews(pub MissionFolder);

impl Views for FolderViews {
    fn read(&mut self, reason: KeyframeReason, keyframe_id: u64) -> Option<(DepthView, bool)> {
        let keyframe = match self.0.read_view(reason, keyframe_id) {
            Ok(found) => found?,
            Err(error) => {
                tracing::warn!(%error, "a stored view cannot be read");
                return None;
            }
        };
        // Under prior/ an earlier survey's view may lie.
        if keyframe.frame.id != keyframe_id {
            return None;
        }
        let header = keyframe.frame.header();
        let view = DepthView {
            stamp_ns: keyframe.frame.stamp_ns,
            world_from_camera: keyframe.frame.world_from_camera(),
            intrinsics: keyframe.frame.intrinsics,
            depth_m: keyframe.depth_m(),
        };
        Some((view, header.gate_missed == 1))
    }
}
