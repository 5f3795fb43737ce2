//! Frames in datagrams. Frames are checked here and their payload is left as bytes: the dialect's enums are strict, and
//! a command that the dialect does not know must still be answered.

use mavlink::calculate_crc;
use mavlink::dialects::common::MavMessage;
use mavlink::{MAVLinkV2MessageRaw, MavHeader, MavlinkVersion, Message, MessageData, error::ParserError};

const STX_V1: u8 = 0xFE;
const STX_V2: u8 = 0xFD;
const SIGNED: u8 = 1;
/// Datagrams are filled up to this many bytes: what fits an Ethernet frame.
const DATAGRAM_MAX: usize = 1400;

/// A frame whose checksum holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Frame<'a> {
    /// Sender's system.
    pub system_id: u8,
    /// Sender's component.
    pub component_id: u8,
    /// Message id.
    pub message_id: u32,
    /// Payload, without the zeros that the sender cut off.
    pub payload: &'a [u8],
    /// All of it, as it came.
    pub bytes: &'a [u8],
}

impl Frame<'_> {
    /// The payload with its cut-off zeros, as long as the message's fields need.
    #[must_use]
    pub fn padded<const N: usize>(&self) -> [u8; N] {
        let mut bytes = [0; N];
        for (to, from) in bytes.iter_mut().zip(self.payload) {
            *to = *from;
        }
        bytes
    }

    /// The message, where the dialect knows it and all of its enums.
    #[must_use]
    pub fn message(&self) -> Option<MavMessage> {
        MavMessage::parse(MavlinkVersion::V2, self.message_id, self.payload).ok()
    }
}

/// The frames of a datagram, in order; bytes that are no frame are skipped.
#[derive(Debug, Clone)]
pub struct Frames<'a> {
    rest: &'a [u8],
}

/// Reads a datagram.
#[must_use]
pub fn frames(datagram: &[u8]) -> Frames<'_> {
    Frames { rest: datagram }
}

impl<'a> Iterator for Frames<'a> {
    type Item = Frame<'a>;

    fn next(&mut self) -> Option<Frame<'a>> {
        while let Some(&first) = self.rest.first() {
            let parsed = match first {
                STX_V2 => v2(self.rest),
                STX_V1 => v1(self.rest),
                _ => None,
            };
            if let Some((frame, length)) = parsed {
                self.rest = self.rest.get(length..).unwrap_or(&[]);
                return Some(frame);
            }
            self.rest = self.rest.get(1..).unwrap_or(&[]);
        }
        None
    }
}

fn checked(covered: &[u8], crc: &[u8], message_id: u32) -> bool {
    let expected = calculate_crc(covered, MavMessage::extra_crc(message_id)).to_le_bytes();
    crc == expected.as_slice()
}

fn v2(bytes: &[u8]) -> Option<(Frame<'_>, usize)> {
    let &[_, length, incompatible, _, _, system_id, component_id, id0, id1, id2] = bytes.first_chunk::<10>()?;
    if incompatible & !SIGNED != 0 {
        return None;
    }
    let end = 10 + usize::from(length);
    let message_id = u32::from_le_bytes([id0, id1, id2, 0]);
    if !checked(bytes.get(1..end)?, bytes.get(end..end + 2)?, message_id) {
        return None;
    }
    let total = end + 2 + if incompatible & SIGNED == 0 { 0 } else { 13 };
    let (payload, bytes) = (bytes.get(10..end)?, bytes.get(..total)?);
    Some((Frame { system_id, component_id, message_id, payload, bytes }, total))
}

fn v1(bytes: &[u8]) -> Option<(Frame<'_>, usize)> {
    let &[_, length, _, system_id, component_id, id] = bytes.first_chunk::<6>()?;
    let end = 6 + usize::from(length);
    let message_id = u32::from(id);
    if !checked(bytes.get(1..end)?, bytes.get(end..end + 2)?, message_id) {
        return None;
    }
    let (payload, bytes) = (bytes.get(6..end)?, bytes.get(..end + 2)?);
    Some((Frame { system_id, component_id, message_id, payload, bytes }, end + 2))
}

/// COMMAND_ACK with the command as a number, so that unknown ones can be answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RawAck {
    /// The command.
    pub command: u16,
    /// MAV_RESULT.
    pub result: u8,
    /// Whom it answers: system.
    pub target_system: u8,
    /// Whom it answers: component.
    pub target_component: u8,
}

impl MessageData for RawAck {
    type Message = MavMessage;
    const ID: u32 = 77;
    const NAME: &'static str = "COMMAND_ACK";
    const EXTRA_CRC: u8 = 143;
    const ENCODED_LEN: usize = 10;

    fn ser(&self, _version: MavlinkVersion, payload: &mut [u8]) -> usize {
        let [low, high] = self.command.to_le_bytes();
        // Command, result, progress, result_param2 (4 bytes), target system and component.
        let bytes = [low, high, self.result, 0, 0, 0, 0, 0, self.target_system, self.target_component];
        let used = bytes.iter().rposition(|&b| b != 0).map_or(1, |last| last + 1);
        for (to, from) in payload.iter_mut().zip(bytes.iter().take(used)) {
            *to = *from;
        }
        used
    }

    fn deser(_version: MavlinkVersion, payload: &[u8]) -> Result<Self, ParserError> {
        let mut bytes = [0u8; 10];
        for (to, from) in bytes.iter_mut().zip(payload) {
            *to = *from;
        }
        let [low, high, result, _, _, _, _, _, target_system, target_component] = bytes;
        Ok(Self { command: u16::from_le_bytes([low, high]), result, target_system, target_component })
    }
}

/// Frames on their way out, several to a datagram.
#[derive(Debug, Clone)]
pub struct Outbox {
    header: MavHeader,
    full: Vec<Vec<u8>>,
    open: Vec<u8>,
}

impl Outbox {
    /// An outbox of a sender.
    #[must_use]
    pub fn new(system_id: u8, component_id: u8) -> Self {
        let header = MavHeader { system_id: u32::from(system_id), component_id, sequence: 0 };
        Self { header, full: Vec::new(), open: Vec::new() }
    }

    /// Adds a message.
    pub fn push(&mut self, message: &MavMessage) {
        let mut raw = MAVLinkV2MessageRaw::new();
        raw.serialize_message(self.header, message);
        self.append(raw.raw_bytes());
    }

    /// Adds an acknowledgement.
    pub fn push_ack(&mut self, ack: &RawAck) {
        let mut raw = MAVLinkV2MessageRaw::new();
        raw.serialize_message_data(self.header, ack);
        self.append(raw.raw_bytes());
    }

    /// Adds a frame of somebody else, as it is.
    pub fn pass_on(&mut self, frame: &[u8]) {
        self.put(frame);
    }

    fn append(&mut self, frame: &[u8]) {
        self.header.sequence = self.header.sequence.wrapping_add(1);
        self.put(frame);
    }

    fn put(&mut self, frame: &[u8]) {
        if self.open.len() + frame.len() > DATAGRAM_MAX {
            self.full.push(core::mem::take(&mut self.open));
        }
        self.open.extend_from_slice(frame);
    }

    /// The datagrams to send now.
    pub fn take(&mut self) -> Vec<Vec<u8>> {
        let mut datagrams = core::mem::take(&mut self.full);
        if !self.open.is_empty() {
            datagrams.push(core::mem::take(&mut self.open));
        }
        datagrams
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use mavlink::dialects::common::{ATTITUDE_DATA, COMMAND_ACK_DATA, MavCmd, MavResult};

    #[test]
    fn several_frames_share_a_datagram_and_come_back_in_order() {
        let mut outbox = Outbox::new(1, 1);
        for i in 0..100u32 {
            outbox.push(&MavMessage::ATTITUDE(ATTITUDE_DATA { time_boot_ms: i, roll: 0.5, ..Default::default() }));
        }
        let datagrams = outbox.take();
        assert!(datagrams.len() < 5 && datagrams.iter().all(|d| d.len() <= DATAGRAM_MAX));
        let times: Vec<u32> = datagrams
            .iter()
            .flat_map(|d| frames(d))
            .filter_map(|f| match f.message() {
                Some(MavMessage::ATTITUDE(a)) => Some(a.time_boot_ms),
                _ => None,
            })
            .collect();
        assert_eq!(times, (0..100).collect::<Vec<_>>());
        assert!(outbox.take().is_empty());
    }

    #[test]
    fn an_acknowledgement_of_a_known_command_is_the_dialects_own() {
        let mut outbox = Outbox::new(1, 1);
        outbox.push_ack(&RawAck { command: 400, result: 1, target_system: 245, target_component: 190 });
        let datagrams = outbox.take();
        let acks: Vec<_> = datagrams.iter().flat_map(|d| frames(d)).filter_map(|f| f.message()).collect();
        assert_eq!(
            acks,
            [MavMessage::COMMAND_ACK(COMMAND_ACK_DATA {
                command: MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
                result: MavResult::MAV_RESULT_TEMPORARILY_REJECTED,
                progress: 0,
                result_param2: 0,
                target_system: 245,
                target_component: 190,
            })]
        );
    }

    proptest::proptest! {
        #[test]
        fn any_bytes_are_survived_and_a_frame_among_them_is_found(
            before in proptest::collection::vec(0u8..0xFD, 0..40),
            after in proptest::collection::vec(proptest::num::u8::ANY, 0..300),
            roll in proptest::num::f32::NORMAL,
        ) {
            let mut outbox = Outbox::new(7, 9);
            let sent = MavMessage::ATTITUDE(ATTITUDE_DATA { roll, time_boot_ms: 5, ..Default::default() });
            outbox.push(&sent);
            let mut bytes = before;
            bytes.extend(outbox.take().concat());
            bytes.extend(after);
            let found = frames(&bytes).any(|f| f.system_id == 7 && f.component_id == 9 && f.message().as_ref() == Some(&sent));
            proptest::prop_assert!(found);
        }

        #[test]
        fn acknowledgements_come_back(command in 0u16.., result in 0u8..11, system in 0u8.., component in 0u8..) {
            let ack = RawAck { command, result, target_system: system, target_component: component };
            let mut outbox = Outbox::new(1, 1);
            outbox.push_ack(&ack);
            let bytes = outbox.take().concat();
            let back: Vec<RawAck> =
                frames(&bytes).filter_map(|f| RawAck::deser(MavlinkVersion::V2, f.payload).ok()).collect();
            proptest::prop_assert_eq!(back, vec![ack]);
        }
    }
}
