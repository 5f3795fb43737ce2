//! Model and optimiser as bytes, for the trainer's checkpoints: complete, or refused with the reason.
//!
//! Layout, little-endian: magic (8 bytes), version u32, SH degree u32, number of Gaussians u64, number of Gaussians with
//! optimiser state u64; ids u64, birth rounds u32, step counts u32; then blocks of 16 Gaussians by 14 parameters f32:
//! parameters, first moments, second moments; last a CRC-32 (IEEE 802.3) of everything before it.

use thiserror::Error;

use crate::model::{Block, Gaussians, LANES, ROWS};
use crate::optimiser::Optimiser;

const MAGIC: [u8; 8] = *b"VNTGMODL";
const VERSION: u32 = 1;
const HEADER: usize = 32;
const BLOCK_BYTES: u64 = (ROWS * LANES * 4) as u64;

/// Why bytes are not a checkpoint.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum CheckpointError {
    /// The file does not begin as a checkpoint does.
    #[error("not a model checkpoint: it begins with {found:02x?} instead of \"VNTGMODL\"")]
    Magic {
        /// The first bytes.
        found: Vec<u8>,
    },
    /// Written by another version.
    #[error(
        "model checkpoint of version {found}, but this program reads version {VERSION}: use the program that wrote it, or retrain"
    )]
    Version {
        /// The version in the file.
        found: u32,
    },
    /// Colours of a degree that this program does not train.
    #[error("model checkpoint with SH degree {found}, but only degree 0 is supported")]
    ShDegree {
        /// The degree in the file.
        found: u32,
    },
    /// The file ends too early, or goes on.
    #[error("model checkpoint of {found} bytes where its header asks for {expected}: it is {}; use the checkpoint before it", if found < expected { "truncated" } else { "followed by something else" })]
    Length {
        /// Bytes found.
        found: u64,
        /// Bytes expected.
        expected: u64,
    },
    /// The optimiser holds more Gaussians than the model.
    #[error("model checkpoint with optimiser state for {states} Gaussians, but only {count} Gaussians")]
    Counts {
        /// Gaussians of the model.
        count: u64,
        /// Gaussians with state.
        states: u64,
    },
    /// Bytes were changed.
    #[error(
        "model checkpoint is damaged: checksum {found:08x} instead of {expected:08x}; use the checkpoint before it"
    )]
    Checksum {
        /// Of the bytes as they are.
        found: u32,
        /// As written.
        expected: u32,
    },
}

/// The bytes of a model and its optimiser.
pub fn encode(gaussians: &Gaussians, optimiser: &Optimiser) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(expected_length(gaussians.len() as u64, optimiser.len() as u64) as usize);
    bytes.extend(MAGIC);
    bytes.extend(VERSION.to_le_bytes());
    bytes.extend(u32::from(gaussians.sh_degree()).to_le_bytes());
    bytes.extend((gaussians.len() as u64).to_le_bytes());
    bytes.extend((optimiser.len() as u64).to_le_bytes());
    for gaussian in gaussians.iter() {
        bytes.extend(gaussian.id.to_le_bytes());
    }
    for gaussian in gaussians.iter() {
        bytes.extend(gaussian.birth_round.to_le_bytes());
    }
    for steps in &optimiser.steps {
        bytes.extend(steps.to_le_bytes());
    }
    for blocks in [gaussians.blocks(), &optimiser.first, &optimiser.second] {
        for row in blocks.iter().flat_map(|block| &block.0) {
            bytes.extend(row.0.iter().flat_map(|value| value.to_le_bytes()));
        }
    }
    let checksum = crc32(&bytes);
    bytes.extend(checksum.to_le_bytes());
    bytes
}

/// The model and optimiser that [`encode`] wrote.
///
/// # Errors
/// Where the bytes are not exactly what was written, saying how they differ.
pub fn decode(bytes: &[u8]) -> Result<(Gaussians, Optimiser), CheckpointError> {
    if bytes.len() < MAGIC.len() || !bytes.starts_with(&MAGIC) {
        return Err(CheckpointError::Magic { found: bytes[..bytes.len().min(MAGIC.len())].to_vec() });
    }
    let found = bytes.len() as u64;
    let mut reader = Reader { bytes, at: MAGIC.len() };
    let short = CheckpointError::Length { found, expected: (HEADER + 4) as u64 };
    let header = (|| Some((reader.u32()?, reader.u32()?, reader.u64()?, reader.u64()?)))();
    let (version, degree, count, states) = header.ok_or(short)?;
    if version != VERSION {
        return Err(CheckpointError::Version { found: version });
    }
    let expected = expected_length(count, states);
    if found != expected {
        return Err(CheckpointError::Length { found, expected });
    }
    let (content, checksum) = bytes.split_at(bytes.len() - 4);
    let (stored, found_checksum) = (Reader { bytes: checksum, at: 0 }.u32().unwrap_or(0), crc32(content));
    if stored != found_checksum {
        return Err(CheckpointError::Checksum { found: found_checksum, expected: stored });
    }
    if degree != 0 {
        return Err(CheckpointError::ShDegree { found: degree });
    }
    if states > count {
        return Err(CheckpointError::Counts { count, states });
    }
    read_content(&mut reader, count as usize, states as usize).ok_or(CheckpointError::Length { found, expected })
}

fn read_content(reader: &mut Reader<'_>, count: usize, states: usize) -> Option<(Gaussians, Optimiser)> {
    let ids = (0..count).map(|_| reader.u64()).collect::<Option<Vec<_>>>()?;
    let birth_rounds = (0..count).map(|_| reader.u32()).collect::<Option<Vec<_>>>()?;
    let steps = (0..states).map(|_| reader.u32()).collect::<Option<Vec<_>>>()?;
    let blocks = reader.blocks(count)?;
    let first = reader.blocks(states)?;
    let second = reader.blocks(states)?;
    let gaussians = Gaussians::from_parts(blocks, (0, Vec::new()), ids, birth_rounds);
    Some((gaussians, Optimiser { first, second, steps, ..Optimiser::new() }))
}

/// Bytes of a checkpoint; saturates, so that no count in a damaged header overflows.
fn expected_length(count: u64, states: u64) -> u64 {
    let blocks = count.div_ceil(LANES as u64).saturating_add(states.div_ceil(LANES as u64).saturating_mul(2));
    (HEADER as u64 + 4)
        .saturating_add(count.saturating_mul(12))
        .saturating_add(states.saturating_mul(4))
        .saturating_add(blocks.saturating_mul(BLOCK_BYTES))
}

struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let taken = *self.bytes.get(self.at..)?.first_chunk::<N>()?;
        self.at += N;
        Some(taken)
    }

    fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.take().map(u64::from_le_bytes)
    }

    fn blocks(&mut self, gaussians: usize) -> Option<Vec<Block>> {
        let mut blocks = vec![Block::ZERO; gaussians.div_ceil(LANES)];
        for value in blocks.iter_mut().flat_map(|block| &mut block.0).flat_map(|row| &mut row.0) {
            *value = f32::from_le_bytes(self.take()?);
        }
        Some(blocks)
    }
}

/// CRC-32 as in IEEE 802.3, zip and PNG.
fn crc32(bytes: &[u8]) -> u32 {
    const TABLE: [u32; 256] = {
        let mut table = [0; 256];
        let mut i = 0;
        while i < 256 {
            let mut value = i as u32;
            let mut bit = 0;
            while bit < 8 {
                value = if value & 1 == 1 { value >> 1 ^ 0xedb8_8320 } else { value >> 1 };
                bit += 1;
            }
            table[i] = value;
            i += 1;
        }
        table
    };
    !bytes.iter().fold(!0, |crc, &byte| crc >> 8 ^ TABLE[usize::from(crc as u8 ^ byte)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::{camera, random_view, scene};
    use crate::{Engine, TrainingSettings};

    fn trained() -> (Gaussians, Optimiser) {
        let mut model = scene(37, 1);
        let mut optimiser = Optimiser::new();
        let view = random_view(camera(40, 30), 2);
        let mut engine = Engine::new(1).unwrap();
        for _ in 0..3 {
            engine.train_step(&mut model, &mut optimiser, &view, &TrainingSettings::default());
        }
        model.push(&scene(1, 9).get(0));
        (model, optimiser)
    }

    #[test]
    fn the_checksum_is_the_standard_one() {
        assert_eq!(crc32(b"123456789"), 0xcbf4_3926);
    }

    #[test]
    fn what_was_written_is_read_and_training_goes_on_as_if_nothing_had_happened() {
        let (mut model, mut optimiser) = trained();
        let (mut model2, mut optimiser2) = decode(&encode(&model, &optimiser)).unwrap();
        assert_eq!((&model, &optimiser), (&model2, &optimiser2));
        let view = random_view(camera(40, 30), 3);
        let mut engine = Engine::new(1).unwrap();
        engine.train_step(&mut model, &mut optimiser, &view, &TrainingSettings::default());
        engine.train_step(&mut model2, &mut optimiser2, &view, &TrainingSettings::default());
        assert_eq!((model, optimiser), (model2, optimiser2));
        let empty = (Gaussians::new(), Optimiser::new());
        assert_eq!(decode(&encode(&empty.0, &empty.1)).unwrap(), empty);
    }

    #[test]
    fn every_truncation_is_refused() {
        let (model, optimiser) = trained();
        let bytes = encode(&model, &optimiser);
        for length in 0..bytes.len() {
            let error = decode(&bytes[..length]).unwrap_err();
            let right = match length {
                0..8 => matches!(error, CheckpointError::Magic { .. }),
                _ => matches!(error, CheckpointError::Length { found, .. } if found == length as u64),
            };
            assert!(right, "{length} bytes: {error}");
        }
        let longer = [bytes.as_slice(), &[0]].concat();
        assert!(decode(&longer).unwrap_err().to_string().contains("followed by something else"));
    }

    #[test]
    fn every_changed_byte_is_noticed() {
        let (model, optimiser) = trained();
        let bytes = encode(&model, &optimiser);
        for at in (0..bytes.len()).step_by(7).chain(0..HEADER).chain(bytes.len() - 4..bytes.len()) {
            let mut damaged = bytes.clone();
            damaged[at] ^= 0x10;
            assert!(decode(&damaged).is_err(), "byte {at}");
        }
    }
}
