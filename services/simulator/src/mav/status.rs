//! STATUSTEXT: texts cut into chunks of 50 bytes.

use mavlink::dialects::common::{MavMessage, MavSeverity, STATUSTEXT_DATA};
use mavlink::types::CharArray;

use crate::autopilot::Notice;

/// Bytes of text in one message.
const CHUNK: usize = 50;

/// The messages of a text; a text of more than one chunk carries an id (from 1), others 0.
#[must_use]
pub fn messages(notice: &Notice, id: u16) -> Vec<MavMessage> {
    let bytes = notice.text.as_bytes();
    let several = bytes.len() > CHUNK;
    bytes
        .chunks(CHUNK)
        .enumerate()
        .map(|(chunk, part)| {
            let mut text = [0u8; CHUNK];
            for (to, from) in text.iter_mut().zip(part) {
                *to = *from;
            }
            MavMessage::STATUSTEXT(STATUSTEXT_DATA {
                severity: severity(notice.severity),
                text: CharArray::new(text),
                id: if several { id } else { 0 },
                chunk_seq: u8::try_from(chunk).unwrap_or(u8::MAX),
            })
        })
        .collect()
}

fn severity(code: u8) -> MavSeverity {
    match code {
        0 => MavSeverity::MAV_SEVERITY_EMERGENCY,
        1 => MavSeverity::MAV_SEVERITY_ALERT,
        2 => MavSeverity::MAV_SEVERITY_CRITICAL,
        3 => MavSeverity::MAV_SEVERITY_ERROR,
        4 => MavSeverity::MAV_SEVERITY_WARNING,
        5 => MavSeverity::MAV_SEVERITY_NOTICE,
        _ => MavSeverity::MAV_SEVERITY_INFO,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_texts_are_chunked() {
        let notice = Notice { severity: 2, text: "Arming denied: Resolve system health failures first".to_owned() };
        let chunks = messages(&notice, 3);
        assert_eq!(chunks.len(), 2);
        let MavMessage::STATUSTEXT(second) = &chunks[1] else { return assert_eq!(chunks.len(), 0) };
        assert_eq!((second.id, second.chunk_seq), (3, 1));
        assert_eq!(second.text.to_str().map(|t| t.trim_end_matches('\0')), Ok("t"));
    }
}
