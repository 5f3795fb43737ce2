//! All of px4-link's channels.

use shared_types::bus::{Bus, BusError, Client, Publisher, ReplyAddress, Server, Subscriber};
use shared_types::channel::{
    AliveChannel, MissionCommandChannel, MissionStateChannel, VehicleCommandChannel, VehicleStateChannel,
    VehicleTargetChannel,
};
use shared_types::messages::{CommandReply, MissionRequest, VehicleState};
use shared_types::payload::unpack_text;

use crate::ground::{Ground, Passed};
use crate::logic::Core;

/// The channels.
pub struct Ports {
    state: Publisher<VehicleStateChannel>,
    targets: Subscriber<VehicleTargetChannel>,
    alive: Subscriber<AliveChannel>,
    commands: Server<VehicleCommandChannel>,
    mission: Subscriber<MissionStateChannel>,
    orders: Client<MissionCommandChannel>,
    sent: u64,
    received: u64,
    dropped: u64,
}

impl core::fmt::Debug for Ports {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Ports").field("sent", &self.sent).field("received", &self.received).finish_non_exhaustive()
    }
}

impl Ports {
    /// Opens all channels.
    ///
    /// # Errors
    /// When one cannot be opened.
    pub fn open(bus: &Bus) -> Result<Self, BusError> {
        Ok(Self {
            state: bus.publisher()?,
            targets: bus.subscriber()?,
            alive: bus.subscriber()?,
            commands: bus.server()?,
            mission: bus.subscriber()?,
            orders: bus.client()?,
            sent: 0,
            received: 0,
            dropped: 0,
        })
    }

    /// Gives everything that has come to the link.
    ///
    /// # Errors
    /// When a channel is broken.
    pub fn receive(&mut self, now_ns: u64, core: &mut Core) -> Result<(), BusError> {
        while let Some(alive) = self.alive.receive(now_ns)? {
            self.received += 1;
            // A time that has not come would keep the planner alive for ever.
            core.on_alive(alive.sent_ns().min(now_ns));
        }
        while let Some(request) = self.commands.receive(now_ns)? {
            self.received += 1;
            core.on_command(now_ns, request.address(), request.header());
        }
        while let Some(target) = self.targets.receive(now_ns)? {
            self.received += 1;
            core.on_target(target.header(), target.items());
        }
        Ok(())
    }

    /// Gives ground stations what the planner says: of the mission, and to their orders.
    ///
    /// # Errors
    /// When a channel is broken.
    pub fn receive_for_ground(&mut self, now_ns: u64, ground: &mut Ground) -> Result<(), BusError> {
        while let Some(reply) = self.orders.receive(now_ns)? {
            self.received += 1;
            let header = reply.header();
            let answer = if header.accepted == 1 { Ok(()) } else { Err(unpack_text(&header.reason)) };
            let id = reply.envelope().request_id;
            // Else it would be asked again, and a planner that was started anew would carry it out once more.
            self.orders.finish(id);
            ground.on_answer(id, answer);
        }
        if let Some(id) = ground.overdue(now_ns) {
            self.orders.finish(id);
        }
        while let Some(state) = self.mission.receive(now_ns)? {
            self.received += 1;
            ground.on_mission(now_ns, state.header());
        }
        Ok(())
    }

    /// Passes an order on to the planner.
    ///
    /// # Errors
    /// When the channel is broken; a missing chunk is counted, and it is asked again.
    pub fn order(&mut self, now_ns: u64, passed: Passed) -> Result<(), BusError> {
        if let Some(id) = passed.given_up {
            self.orders.finish(id);
        }
        let request = MissionRequest { command: passed.order.code(), reserved: 0 };
        let result = self.orders.send(now_ns, passed.id, &request, &[]);
        self.count(result)
    }

    /// Drops what has come: it was meant for an earlier life.
    ///
    /// # Errors
    /// When a channel is broken.
    pub fn forget(&mut self) -> Result<(), BusError> {
        self.alive.clear()?;
        self.targets.clear()
    }

    /// Publishes the vehicle's state.
    ///
    /// # Errors
    /// When the channel is broken; a missing chunk is counted and survived.
    pub fn publish(&mut self, now_ns: u64, state: &VehicleState) -> Result<(), BusError> {
        let result = self.state.send(now_ns, state.position_stamp_ns, state);
        self.count(result)
    }

    /// Replies to a request.
    ///
    /// # Errors
    /// When the channel is broken; a missing chunk is counted, and the client asks again.
    pub fn reply(&mut self, now_ns: u64, to: &ReplyAddress, reply: &CommandReply) -> Result<(), BusError> {
        let result = self.commands.reply(now_ns, to, reply, &[]);
        self.count(result)
    }

    fn count(&mut self, result: Result<(), BusError>) -> Result<(), BusError> {
        match result {
            Ok(()) => self.sent += 1,
            Err(BusError::NoChunk { .. }) => self.dropped += 1,
            Err(error) => return Err(error),
        }
        Ok(())
    }

    /// Messages received, sent, dropped.
    #[must_use]
    pub fn counts(&self) -> (u64, u64, u64) {
        (self.received, self.sent, self.dropped + self.targets.lost() + self.alive.lost())
    }
}
