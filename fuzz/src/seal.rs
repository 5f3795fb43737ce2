//! Checksums made right again after a mutation, and inputs of several files.

use mavlink::Message as _;
use mavlink::dialects::common::MavMessage;

/// Makes the checksums of all MAVLink 2 frames right, wherever their start and length say that they lie.
#[must_use]
pub fn mavlink(data: &[u8]) -> Vec<u8> {
    let mut bytes = data.to_vec();
    let mut at = 0;
    while at + 12 <= bytes.len() {
        let end = at + 10 + usize::from(bytes[at + 1]);
        if bytes[at] != mavlink::MAV_STX_V2 || end + 2 > bytes.len() {
            at += 1;
            continue;
        }
        let id = u32::from_le_bytes([bytes[at + 7], bytes[at + 8], bytes[at + 9], 0]);
        let sum = mavlink::calculate_crc(&bytes[at + 1..end], MavMessage::extra_crc(id));
        bytes[end..end + 2].copy_from_slice(&sum.to_le_bytes());
        at = end + 2;
    }
    bytes
}

/// Makes the checksums of all chunks of a PNG right.
#[must_use]
pub fn png(data: &[u8]) -> Vec<u8> {
    let mut bytes = data.to_vec();
    let mut at = 8;
    while let Some(length) = bytes.get(at..at + 4).and_then(|b| b.try_into().ok()).map(u32::from_be_bytes) {
        let end = at.saturating_add(8).saturating_add(length as usize);
        if end.saturating_add(4) > bytes.len() {
            break;
        }
        let sum = crc32fast::hash(&bytes[at + 4..end]);
        bytes[end..end + 4].copy_from_slice(&sum.to_be_bytes());
        at = end + 4;
    }
    bytes
}

/// Makes the checksum at the end of a model's checkpoint right.
#[must_use]
pub fn model(data: &[u8]) -> Vec<u8> {
    let mut bytes = data.to_vec();
    if let Some((content, sum)) = bytes.split_last_chunk_mut::<4>() {
        *sum = crc32fast::hash(content).to_le_bytes();
    }
    bytes
}

/// Makes the checksums of a checkpoint right: that of the model in it, which comes last, and its own behind that.
#[must_use]
pub fn checkpoint(data: &[u8]) -> Vec<u8> {
    const MODEL: &[u8] = b"VNTGMODL";
    let mut bytes = data.to_vec();
    if let Some((content, _)) = bytes.split_last_chunk_mut::<8>()
        && let Some(start) = content.windows(MODEL.len()).rposition(|window| window == MODEL)
    {
        let sealed = model(&content[start..]);
        content[start..].copy_from_slice(&sealed);
    }
    if let Some((content, sum)) = bytes.split_last_chunk_mut::<8>() {
        *sum = splatting::bytes::checksum(content).to_le_bytes();
    }
    bytes
}

/// Splits an input into `N` files: two bytes of length before each but the last.
#[must_use]
pub fn split<const N: usize>(mut data: &[u8]) -> [&[u8]; N] {
    let mut files = [&[][..]; N];
    for (index, file) in files.iter_mut().enumerate() {
        if index + 1 == N {
            *file = data;
        } else if let Some((length, rest)) = data.split_first_chunk::<2>() {
            let (taken, left) = rest.split_at(usize::from(u16::from_le_bytes(*length)).min(rest.len()));
            (*file, data) = (taken, left);
        }
    }
    files
}

/// Joins files to an input that [`split`] splits again. Each but the last must be shorter than 64 KiB.
#[must_use]
pub fn join<const N: usize>(files: [&[u8]; N]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for (index, file) in files.iter().enumerate() {
        if index + 1 < N {
            bytes.extend(u16::try_from(file.len()).unwrap_or(u16::MAX).to_le_bytes());
        }
        bytes.extend_from_slice(file);
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_come_apart_as_they_were_joined() {
        let joined = join([b"one", b"", b"three"]);
        assert_eq!(split::<3>(&joined), [&b"one"[..], b"", b"three"]);
        // A length beyond the bytes takes what there is.
        assert_eq!(split::<2>(&[9, 0, 7]), [&[7][..], &[]]);
        assert_eq!(split::<3>(&[1]), [&[][..], &[], &[1]]);
    }

    #[test]
    fn broken_checksums_are_made_right() {
        use px4_link::mavlink_io::{decode, encode};
        let mut frame = encode(1, 3, &MavMessage::HEARTBEAT(Default::default()));
        frame[10] ^= 1;
        assert!(decode(&frame).is_empty());
        assert_eq!(decode(&mavlink(&frame)).len(), 1);
        let mut bytes = splatting::checkpoint::encode(&splatting::Gaussians::new(), &splatting::Optimiser::new());
        let whole = bytes.clone();
        bytes[30] ^= 1;
        assert!(splatting::checkpoint::decode(&bytes).is_err());
        bytes[30] ^= 1;
        assert_eq!(model(&bytes), whole);
    }
}
