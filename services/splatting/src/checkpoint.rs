//! Model and optimiser as bytes, for the trainer's checkpoints: complete, or refused with the reason.
//!
//! Layout, little-endian: magic (8 bytes), version u32, SH degrees of the model and of the optimiser's state u16 each,
//! number of Gaussians u64, number of Gaussians with optimiser state u64; ids u64, birth rounds u32, step counts u32; then
//! blocks of 16 Gaussians by 14 parameters f32: parameters, first moments, second moments; then the rows of 16 of the
//! higher SH bands f32, red, green, blue of each coefficient in turn, block by block: coefficients, first moments, second
//! moments; last a CRC-32 (IEEE 802.3) of everything before it.
//!
//! Version 1 has degree 0 and is read too.

use thiserror::Error;

use crate::model::{Block, Gaussians, LANES, Lanes, ROWS, SH_DEGREE_MAX, sh_rest_rows};
use crate::optimiser::Optimiser;

const MAGIC: [u8; 8] = *b"VNTGMODL";
const VERSION: u32 = 2;
const HEADER: usize = 32;
const ROW_BYTES: u64 = (LANES * 4) as u64;

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
        "model checkpoint of version {found}, but this program reads versions 1 and {VERSION}: use the program that wrote it, or \
         retrain"
    )]
    Version {
        /// The version in the file.
        found: u32,
    },
    /// Colours of a degree that this program does not train.
    #[error("model checkpoint with SH degree {found}, expected 0 to {SH_DEGREE_MAX}, and 0 in version 1: damaged")]
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
    let shape = Shape {
        count: gaussians.len() as u64,
        states: optimiser.len() as u64,
        degree: gaussians.sh_degree(),
        state_degree: optimiser.sh_degree,
    };
    let mut bytes = Vec::with_capacity(shape.bytes() as usize);
    bytes.extend(MAGIC);
    bytes.extend(VERSION.to_le_bytes());
    bytes.extend(u16::from(shape.degree).to_le_bytes());
    bytes.extend(u16::from(shape.state_degree).to_le_bytes());
    bytes.extend(shape.count.to_le_bytes());
    bytes.extend(shape.states.to_le_bytes());
    for gaussian in gaussians.iter() {
        bytes.extend(gaussian.id.to_le_bytes());
    }
    for gaussian in gaussians.iter() {
        bytes.extend(gaussian.birth_round.to_le_bytes());
    }
    for steps in &optimiser.steps {
        bytes.extend(steps.to_le_bytes());
    }
    let blocks = [gaussians.blocks(), &optimiser.first, &optimiser.second];
    let rest = [gaussians.rest(), &optimiser.first_rest, &optimiser.second_rest];
    let rows = blocks.into_iter().flatten().flat_map(|block| &block.0).chain(rest.into_iter().flatten());
    for row in rows {
        bytes.extend(row.0.iter().flat_map(|value| value.to_le_bytes()));
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
    let (version, degrees, count, states) = header.ok_or(short)?;
    if !(1..=VERSION).contains(&version) {
        return Err(CheckpointError::Version { found: version });
    }
    let shape = Shape { count, states, ..Shape::degrees(version, degrees)? };
    let expected = shape.bytes();
    if found != expected {
        return Err(CheckpointError::Length { found, expected });
    }
    let (content, checksum) = bytes.split_at(bytes.len() - 4);
    let (stored, found_checksum) = (Reader { bytes: checksum, at: 0 }.u32().unwrap_or(0), crc32(content));
    if stored != found_checksum {
        return Err(CheckpointError::Checksum { found: found_checksum, expected: stored });
    }
    if states > count {
        return Err(CheckpointError::Counts { count, states });
    }
    read_content(&mut reader, &shape).ok_or(CheckpointError::Length { found, expected })
}

fn read_content(reader: &mut Reader<'_>, shape: &Shape) -> Option<(Gaussians, Optimiser)> {
    let (count, states) = (shape.count as usize, shape.states as usize);
    let ids = (0..count).map(|_| reader.u64()).collect::<Option<Vec<_>>>()?;
    let birth_rounds = (0..count).map(|_| reader.u32()).collect::<Option<Vec<_>>>()?;
    let steps = (0..states).map(|_| reader.u32()).collect::<Option<Vec<_>>>()?;
    let blocks = reader.blocks(count)?;
    let (first, second) = (reader.blocks(states)?, reader.blocks(states)?);
    let rest = reader.rest(count, shape.degree)?;
    let sh_degree = shape.state_degree;
    let (first_rest, second_rest) = (reader.rest(states, sh_degree)?, reader.rest(states, sh_degree)?);
    let gaussians = Gaussians::from_parts(blocks, (shape.degree, rest), ids, birth_rounds);
    Some((gaussians, Optimiser { first, second, first_rest, second_rest, sh_degree, steps }))
}

/// What decides the length of a checkpoint.
#[derive(Default)]
struct Shape {
    count: u64,
    states: u64,
    degree: u8,
    state_degree: u8,
}

impl Shape {
    /// The degrees in a header of a version.
    fn degrees(version: u32, stored: u32) -> Result<Self, CheckpointError> {
        let (low, high) = (stored & 0xffff, stored >> 16);
        let highest = if version == 1 { 0 } else { u32::from(SH_DEGREE_MAX) };
        let degree = |found: u32| match u8::try_from(found) {
            Ok(degree) if found <= highest => Ok(degree),
            _ => Err(CheckpointError::ShDegree { found }),
        };
        Ok(Self { degree: degree(low)?, state_degree: degree(high)?, ..Self::default() })
    }

    /// Bytes of the checkpoint; saturates, so that no count in a damaged header overflows.
    fn bytes(&self) -> u64 {
        let rows = |gaussians: u64, degree: u8| {
            gaussians.div_ceil(LANES as u64).saturating_mul((ROWS + sh_rest_rows(degree)) as u64)
        };
        let rows = rows(self.count, self.degree).saturating_add(rows(self.states, self.state_degree).saturating_mul(2));
        (HEADER as u64 + 4)
            .saturating_add(self.count.saturating_mul(12))
            .saturating_add(self.states.saturating_mul(4))
            .saturating_add(rows.saturating_mul(ROW_BYTES))
    }
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
        self.rows(blocks.iter_mut().flat_map(|block| &mut block.0))?;
        Some(blocks)
    }

    /// Rows of the higher bands.
    fn rest(&mut self, gaussians: usize, degree: u8) -> Option<Vec<Lanes>> {
        let mut rows = vec![Lanes([0.0; LANES]); gaussians.div_ceil(LANES) * sh_rest_rows(degree)];
        self.rows(rows.iter_mut())?;
        Some(rows)
    }

    fn rows<'a>(&mut self, rows: impl Iterator<Item = &'a mut Lanes>) -> Option<()> {
        for value in rows.flat_map(|row| &mut row.0) {
            *value = f32::from_le_bytes(self.take()?);
        }
        Some(())
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

    /// A model and state after some steps, and a Gaussian that has no state yet.
    fn trained(degree: u8) -> (Gaussians, Optimiser) {
        let mut model = scene(37, 1);
        model.set_sh_degree(degree);
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
        for degree in 0..=SH_DEGREE_MAX {
            let (mut model, mut optimiser) = trained(degree);
            let moved = model.sh_rest(3).iter().flatten().any(|c| *c != 0.0);
            assert_eq!(moved, degree > 0, "training moves the bands there are");
            let (mut model2, mut optimiser2) = decode(&encode(&model, &optimiser)).unwrap();
            assert_eq!((&model, &optimiser), (&model2, &optimiser2));
            let view = random_view(camera(40, 30), 3);
            let mut engine = Engine::new(1).unwrap();
            engine.train_step(&mut model, &mut optimiser, &view, &TrainingSettings::default());
            engine.train_step(&mut model2, &mut optimiser2, &view, &TrainingSettings::default());
            assert_eq!((model, optimiser), (model2, optimiser2));
        }
        let empty = (Gaussians::new(), Optimiser::new());
        assert_eq!(decode(&encode(&empty.0, &empty.1)).unwrap(), empty);
    }

    #[test]
    fn a_degree_that_the_state_has_not_followed_yet_is_kept() {
        let (mut model, optimiser) = trained(1);
        model.set_sh_degree(3);
        let written = (model, optimiser);
        let read = decode(&encode(&written.0, &written.1)).unwrap();
        assert_eq!(read, written);
        assert_eq!((read.0.sh_degree(), read.1.sh_degree), (3, 1));
    }

    #[test]
    fn version_1_is_read() {
        // Two Gaussians, the first with state; every row of 16 by hand.
        let row = |first: f32, second: f32| {
            let mut row = [0.0; LANES];
            (row[0], row[1]) = (first, second);
            row.map(f32::to_le_bytes).concat()
        };
        let parameter = |k: usize| k as f32 + 0.25;
        let mut bytes = b"VNTGMODL".to_vec();
        [1_u32, 0].into_iter().for_each(|word| bytes.extend(word.to_le_bytes()));
        [2_u64, 1, 70, 71].into_iter().for_each(|word| bytes.extend(word.to_le_bytes()));
        [3_u32, 4, 9].into_iter().for_each(|word| bytes.extend(word.to_le_bytes()));
        (0..ROWS).for_each(|k| bytes.extend(row(parameter(k), -parameter(k))));
        (0..2 * ROWS).for_each(|k| bytes.extend(row(0.5 * k as f32, 0.0)));
        bytes.extend([0; 4]);
        seal(&mut bytes);
        let (model, optimiser) = decode(&bytes).unwrap();
        let second = crate::Gaussian {
            mean: glam::Vec3::new(-0.25, -1.25, -2.25),
            log_scales: glam::Vec3::new(-3.25, -4.25, -5.25),
            rotation: glam::Quat::from_xyzw(-6.25, -7.25, -8.25, -9.25),
            opacity_logit: -10.25,
            sh: [-11.25, -12.25, -13.25],
            id: 71,
            birth_round: 4,
        };
        assert_eq!((model.len(), model.sh_degree(), model.get(1)), (2, 0, second));
        assert_eq!((optimiser.len(), optimiser.steps(0), optimiser.steps(1)), (1, 9, 0));
        assert_eq!((optimiser.first[0].0[13].0[0], optimiser.second[0].0[13].0[0]), (6.5, 13.5));
        // What it says of bands is not believed.
        bytes[12] = 1;
        seal(&mut bytes);
        assert_eq!(decode(&bytes), Err(CheckpointError::ShDegree { found: 1 }));
    }

    /// Makes the checksum that of the bytes.
    fn seal(bytes: &mut [u8]) {
        let (content, checksum) = bytes.split_at_mut(bytes.len() - 4);
        checksum.copy_from_slice(&crc32(content).to_le_bytes());
    }

    #[test]
    fn headers_that_lie_are_refused() {
        let (model, optimiser) = trained(2);
        let with = |at: usize, value: &[u8]| {
            let mut bytes = encode(&model, &optimiser);
            bytes[at..at + value.len()].copy_from_slice(value);
            seal(&mut bytes);
            decode(&bytes).unwrap_err()
        };
        assert_eq!(with(8, &[3]), CheckpointError::Version { found: 3 });
        assert_eq!(with(12, &[4]), CheckpointError::ShDegree { found: 4 });
        assert_eq!(with(14, &[0, 1]), CheckpointError::ShDegree { found: 256 });
        assert!(matches!(with(12, &[1]), CheckpointError::Length { .. }));
        assert!(matches!(with(14, &[3]), CheckpointError::Length { .. }));
        for at in [16, 24] {
            assert!(matches!(with(at, &u64::MAX.to_le_bytes()), CheckpointError::Length { expected: u64::MAX, .. }));
        }
    }

    #[test]
    fn every_truncation_is_refused() {
        for degree in [0, 2] {
            let (model, optimiser) = trained(degree);
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
    }

    #[test]
    fn every_changed_byte_is_noticed() {
        let (model, optimiser) = trained(1);
        let bytes = encode(&model, &optimiser);
        for at in (0..bytes.len()).step_by(7).chain(0..HEADER).chain(bytes.len() - 4..bytes.len()) {
            let mut damaged = bytes.clone();
            damaged[at] ^= 0x10;
            assert!(decode(&damaged).is_err(), "byte {at}");
        }
    }
}
