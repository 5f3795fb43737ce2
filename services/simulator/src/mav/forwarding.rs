//! What passes from one link to the other, as PX4's links in simulation do it (`mavlink start -f`): a message goes to the link
//! on which its target was heard; one that is for this autopilot alone, and every heartbeat, goes nowhere.
//!
//! Only commands, their answers and texts are passed on: what ground stations and companions say to each other. PX4 passes all
//! messages.

use std::collections::BTreeSet;

use super::codec::Frame;

const COMMAND_INT: u32 = 75;
const COMMAND_LONG: u32 = 76;
const COMMAND_ACK: u32 = 77;
const STATUSTEXT: u32 = 253;

/// Components that a link remembers; strangers beyond these are not answered.
const SEEN_MAX: usize = 32;

/// Whom a frame is for, system and component, where 0 is everybody; `None` where it is not passed on.
fn target(frame: &Frame<'_>) -> Option<(u8, u8)> {
    match frame.message_id {
        COMMAND_INT | COMMAND_LONG => {
            let bytes = frame.padded::<33>();
            Some((bytes[30], bytes[31]))
        }
        COMMAND_ACK => {
            let bytes = frame.padded::<10>();
            Some((bytes[8], bytes[9]))
        }
        STATUSTEXT => Some((0, 0)),
        _ => None,
    }
}

/// Who was heard on a link.
#[derive(Debug, Clone, Default)]
pub struct Seen(BTreeSet<(u8, u8)>);

impl Seen {
    /// Notes who sent a frame.
    pub fn note(&mut self, frame: &Frame<'_>) {
        if self.0.len() < SEEN_MAX {
            self.0.insert((frame.system_id, frame.component_id));
        }
    }

    /// Whether a frame of another link is for somebody here; `own` is the autopilot itself.
    #[must_use]
    pub fn wants(&self, frame: &Frame<'_>, own: (u8, u8)) -> bool {
        let Some(to) = target(frame) else { return false };
        to != own
            && self
                .0
                .iter()
                .any(|&(system, component)| (to.0 == 0 || to.0 == system) && (to.1 == 0 || to.1 == component))
    }
}

#[cfg(test)]
mod tests {
    use mavlink::MAVLinkV2MessageRaw;
    use mavlink::MavHeader;
    use mavlink::dialects::common::{
        COMMAND_ACK_DATA, COMMAND_LONG_DATA, HEARTBEAT_DATA, MavCmd, MavMessage, STATUSTEXT_DATA,
    };

    use super::*;
    use crate::mav::codec::frames;

    fn bytes(from: (u8, u8), message: &MavMessage) -> Vec<u8> {
        let mut raw = MAVLinkV2MessageRaw::new();
        raw.serialize_message(MavHeader { system_id: from.0.into(), component_id: from.1, sequence: 3 }, message);
        raw.raw_bytes().to_vec()
    }

    fn order(to: (u8, u8)) -> MavMessage {
        MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
            command: MavCmd::MAV_CMD_USER_1,
            target_system: to.0,
            target_component: to.1,
            ..COMMAND_LONG_DATA::default()
        })
    }

    fn passes(seen: &Seen, message: &MavMessage) -> bool {
        let bytes = bytes((255, 190), message);
        let frame = frames(&bytes).next().unwrap();
        assert_eq!(frame.bytes, bytes);
        seen.wants(&frame, (1, 1))
    }

    #[test]
    fn messages_go_where_their_target_was_heard() {
        let mut seen = Seen::default();
        let text = MavMessage::STATUSTEXT(STATUSTEXT_DATA::default());
        assert!(!passes(&seen, &order((1, 191))) && !passes(&seen, &text), "nobody is there");
        seen.note(&frames(&bytes((1, 191), &MavMessage::HEARTBEAT(HEARTBEAT_DATA::default()))).next().unwrap());
        for (to, expected) in
            [((1, 191), true), ((1, 1), false), ((0, 0), true), ((1, 0), true), ((1, 154), false), ((2, 191), false)]
        {
            assert_eq!(passes(&seen, &order(to)), expected, "{to:?}");
            let ack = COMMAND_ACK_DATA { target_system: to.0, target_component: to.1, ..COMMAND_ACK_DATA::default() };
            assert_eq!(passes(&seen, &MavMessage::COMMAND_ACK(ack)), expected, "{to:?}");
        }
        assert!(passes(&seen, &text) && !passes(&seen, &MavMessage::HEARTBEAT(HEARTBEAT_DATA::default())));
    }
}
