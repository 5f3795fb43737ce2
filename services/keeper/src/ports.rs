//! All of the keeper's IPC: every channel held open, health in, the last health of everybody out.

use std::any::Any;

use shared_types::bus::{Bus, BusError, Publisher, Subscriber};
use shared_types::channel::{Channel, ChannelVisitor, HealthChannel, HealthLastChannel, visit_all};
use shared_types::fault_point;
use shared_types::messages::Health;

/// About half of the channels.
const HALF: usize = 14;

pub(crate) struct Ports {
    health: Subscriber<HealthChannel>,
    last: Publisher<HealthLastChannel>,
    /// Held, never read: a channel exists while somebody has it open.
    _held: Vec<Box<dyn Any>>,
}

struct HoldAll<'a> {
    bus: &'a Bus,
    held: Result<Vec<Box<dyn Any>>, BusError>,
}

impl ChannelVisitor for HoldAll<'_> {
    fn visit<C: Channel>(&mut self) {
        if let Ok(held) = &mut self.held {
            match self.bus.hold::<C>() {
                Ok(channel) => {
                    held.push(channel);
                    if held.len() == HALF {
                        fault_point::reach("channels", "half-open");
                    }
                }
                Err(error) => self.held = Err(error),
            }
        }
    }
}

impl Ports {
    pub(crate) fn open(bus: &Bus) -> Result<Self, BusError> {
        let mut all = HoldAll { bus, held: Ok(Vec::new()) };
        visit_all(&mut all);
        Ok(Self { health: bus.subscriber()?, last: bus.publisher()?, _held: all.held? })
    }

    pub(crate) fn receive_health(&mut self, now_ns: u64) -> Result<Option<Health>, BusError> {
        Ok(self.health.receive(now_ns)?.map(|message| *message.header()))
    }

    pub(crate) fn publish_last(&mut self, now_ns: u64, last: &[Health]) -> Result<(), BusError> {
        match self.last.send_items(now_ns, now_ns, &Health::default(), last) {
            // Readers get the next one.
            Ok(()) | Err(BusError::NoChunk { .. }) => Ok(()),
            Err(error) => Err(error),
        }
    }
}
