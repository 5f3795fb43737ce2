//! PING: deprecated in the dialect, still sent by PX4 and answered by its clients.
#![expect(deprecated, reason = "PX4 still speaks it")]

use mavlink::dialects::common::{MavMessage, PING_DATA};

/// A PING to a system and component; (0, 0) asks everyone.
#[must_use]
pub fn message(time_usec: u64, seq: u32, target: (u8, u8)) -> MavMessage {
    MavMessage::PING(PING_DATA { time_usec, seq, target_system: target.0, target_component: target.1 })
}

/// Time and sequence of a PING that asks everyone.
#[must_use]
pub fn asked(message: &MavMessage) -> Option<(u64, u32)> {
    match message {
        MavMessage::PING(m) if m.target_system == 0 && m.target_component == 0 => Some((m.time_usec, m.seq)),
        _ => None,
    }
}
