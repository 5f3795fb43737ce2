//! SPZ, Niantic's compressed format: version 3 is written, versions 2 and 3 are read.
//!
//! One gzip stream of a header of 16 bytes and then, each for all Gaussians:
//!
//! | what | bytes | quantisation |
//! |---|---|---|
//! | means | 9 | fixed point with sign, 24 bits, of which the header says how many are fractional: 12 (0.24 mm, up to 2 km from the origin), fewer only for larger models |
//! | opacities | 1 | times 255 |
//! | degree 0 | 3 | coefficient times 0.15 plus 0.5, times 255: colours from -0.44 to 1.44 |
//! | log scales | 3 | plus 10, times 16: from -10 to 5.94 in steps of 6 % |
//! | rotations | 4 | the three components smallest in magnitude, 10 bits each, and which one is left out |
//! | higher bands | 0, 9, 24, 45 | coefficient times 128 plus 128: from -1 to 0.99; degree 1 rounded to 5 bits, above to 4 |
//!
//! Version 2 has rotations of 3 bytes: x, y, z of the quaternion whose w is positive. What is outside of a range is
//! clamped, but for means, which are refused. Frame: Y up ([`frames`](super::frames)).
//!
//! The format as published: <https://github.com/nianticlabs/spz>. Version 1 was never used in the open; version 4 (zstd)
//! is not read.

mod quantise;
#[cfg(test)]
mod tests;

use std::io::{self, Read as _, Write};

use flate2::bufread::GzDecoder;
use flate2::write::GzEncoder;
use glam::Vec3;
use thiserror::Error;

use self::quantise::{
    FRACTION_BITS, FRACTION_BITS_MAX, Fraction, bucket, color_from_byte, color_to_byte, log_scale_from_byte,
    log_scale_to_byte, rotation_from_bytes, rotation_from_v2_bytes, rotation_to_bytes, sh_from_byte, sh_to_byte,
};
use super::frames::Turn;
use super::{WriteError, check_finite, logit_of_byte, opacity, to_byte, unit_rotation};
use crate::model::{Gaussian, Gaussians, SH_DEGREE_MAX, SH_REST_MAX, sh_rest_coefficients};

const MAGIC: [u8; 4] = *b"NGSP";
const GZIP_MAGIC: [u8; 2] = [0x1f, 0x8b];
const VERSION: u32 = 3;
const HEADER: usize = 16;
/// Flag: trained with opacity compensation.
const ANTIALIASED: u8 = 1;
/// Flag: records of vendors follow the data.
const EXTENSIONS: u8 = 2;
/// The one record that changes what the data mean.
const COORDINATE_SYSTEM: u32 = 0xadbe_0003;
/// Bytes of such records that are read at most.
const EXTENSIONS_MAX: u64 = 1 << 20;

/// Why an SPZ was refused.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum SpzError {
    /// Not what an SPZ begins with.
    #[error("not an SPZ file: it begins with {found:02x?} instead of a gzip stream of \"NGSP\"")]
    Magic {
        /// The first bytes, of the file or of what the gzip stream holds.
        found: Vec<u8>,
    },
    /// Another version.
    #[error("SPZ of version {found}, but versions 2 and 3 are read: save it as version 3")]
    Version {
        /// The version in the file.
        found: u32,
    },
    /// The gzip stream is damaged.
    #[error("the gzip stream of the SPZ is truncated or damaged: {reason}")]
    Gzip {
        /// As the decoder says it.
        reason: String,
    },
    /// A degree above 3.
    #[error("SPZ with SH degree {found}, expected {SH_DEGREE_MAX} at most: save it with a lower degree")]
    ShDegree {
        /// The degree in the file.
        found: u8,
    },
    /// More fractional bits than there are.
    #[error("SPZ with {found} fractional bits of means, expected {FRACTION_BITS_MAX} at most: damaged")]
    FractionBits {
        /// Bits in the file.
        found: u8,
    },
    /// The data does not have the length that the header gives.
    #[error("the SPZ announces {count} Gaussians of SH degree {degree}, {expected} bytes, but holds {}", if found < expected { format!("{found}: it is truncated") } else { "more: something else follows".to_owned() })]
    Length {
        /// Gaussians of the header.
        count: u32,
        /// Degree of the header.
        degree: u8,
        /// Bytes expected after decompression.
        expected: u64,
        /// Bytes found; one more than expected where there are more.
        found: u64,
    },
    /// Vendors' records do not end where the file does.
    #[error("the extension records at the end of the SPZ are truncated, or longer than {EXTENSIONS_MAX} bytes")]
    Extension,
    /// Data in a frame that a vendor's record defines.
    #[error(
        "the SPZ has a coordinate system of its own (extension SPZ_ADOBE_coordinate_system), expected the format's (right, up, back): save it without this extension"
    )]
    CoordinateSystem,
}

/// Writes a model as version 3. `antialiased` sets the flag of models trained with opacity compensation.
///
/// # Errors
/// Those of the writer; [`WriteError::NotFinite`]; [`WriteError::Range`] for means further than 8,388 km from the origin
/// along an axis; [`WriteError::Count`].
pub fn write(gaussians: &Gaussians, antialiased: bool, to: &mut impl Write) -> Result<(), WriteError> {
    check_finite(gaussians)?;
    let most = u64::from(u32::MAX);
    let count = u32::try_from(gaussians.len());
    let too_many = |_| WriteError::Count { count: gaussians.len(), format: "SPZ", least: 0, most };
    let count = count.map_err(too_many)?;
    let fraction = fraction_of(gaussians)?;
    let coefficients = sh_rest_coefficients(gaussians.sh_degree());
    let turn = Turn::world_to_y_up();

    let mut gzip = GzEncoder::new(to, flate2::Compression::default());
    let mut header = [0; HEADER];
    header[..4].copy_from_slice(&MAGIC);
    header[4..8].copy_from_slice(&VERSION.to_le_bytes());
    header[8..12].copy_from_slice(&count.to_le_bytes());
    header[12..].copy_from_slice(&[gaussians.sh_degree(), fraction.bits(), u8::from(antialiased) * ANTIALIASED, 0]);
    gzip.write_all(&header)?;
    for g in gaussians.iter() {
        gzip.write_all(turn.mean(g.mean).to_array().map(|c| fraction.to_bytes(c)).as_flattened())?;
    }
    for g in gaussians.iter() {
        gzip.write_all(&[to_byte(255.0 * opacity(g.opacity_logit))])?;
    }
    for g in gaussians.iter() {
        gzip.write_all(&g.sh.map(color_to_byte))?;
    }
    for g in gaussians.iter() {
        gzip.write_all(&g.log_scales.to_array().map(log_scale_to_byte))?;
    }
    for g in gaussians.iter() {
        gzip.write_all(&rotation_to_bytes(turn.rotation(unit_rotation(&g).as_quat())))?;
    }
    if coefficients > 0 {
        for index in 0..gaussians.len() {
            let bands = turn.bands(&gaussians.sh_rest(index));
            let bytes: [[u8; 3]; SH_REST_MAX] = std::array::from_fn(|k| bands[k].map(|c| sh_to_byte(c, bucket(k))));
            gzip.write_all(bytes[..coefficients].as_flattened())?;
        }
    }
    gzip.finish()?.flush()?;
    Ok(())
}

/// The finest fixed point, up to the usual one, that holds all means.
fn fraction_of(gaussians: &Gaussians) -> Result<Fraction, WriteError> {
    let mut bits = FRACTION_BITS;
    for (index, g) in gaussians.iter().enumerate() {
        let farthest = g.mean.abs().max_element();
        while !Fraction::new(bits).holds(farthest) {
            bits = bits.checked_sub(1).ok_or(WriteError::Range {
                index,
                field: "mean",
                value: farthest,
                format: "SPZ",
                limit: Fraction::new(0).limit(),
            })?;
        }
    }
    Ok(Fraction::new(bits))
}

/// Reads a model from the bytes of a file.
///
/// # Errors
/// Where the bytes are no whole SPZ of version 2 or 3 in its own frame.
pub fn read(bytes: &[u8]) -> Result<Gaussians, SpzError> {
    if bytes.starts_with(&MAGIC) {
        // Version 4 and later have their header before the compressed data.
        let version = bytes.get(4..8).and_then(|v| v.first_chunk()).map_or(0, |v| u32::from_le_bytes(*v));
        return Err(SpzError::Version { found: version });
    }
    if !bytes.starts_with(&GZIP_MAGIC) {
        return Err(SpzError::Magic { found: bytes[..bytes.len().min(8)].to_vec() });
    }
    let mut decoder = GzDecoder::new(bytes);
    let damaged = |error: io::Error| SpzError::Gzip { reason: error.to_string() };
    let mut start = Vec::with_capacity(HEADER);
    decoder.by_ref().take(HEADER as u64).read_to_end(&mut start).map_err(damaged)?;
    let header = Header::parse(&start)?;
    let expected = header.data_bytes();
    // One byte more, so that the decoder comes to the end and its checksum, or shows that there is something else. The
    // buffer grows with what there is, not with what the header promises.
    let extensions = if header.flags & EXTENSIONS == 0 { 0 } else { EXTENSIONS_MAX };
    let mut data = Vec::new();
    decoder.by_ref().take(expected + extensions + 1).read_to_end(&mut data).map_err(damaged)?;
    let found = data.len() as u64;
    let wrong_length = |found| SpzError::Length { count: header.count, degree: header.degree, expected, found };
    if found < expected || found > expected + extensions {
        return Err(wrong_length(found));
    }
    if !decoder.into_inner().is_empty() {
        return Err(wrong_length(expected + 1));
    }
    // In range: not above the length of the data.
    let (data, records) = data.split_at(expected as usize);
    check_extensions(records)?;
    Ok(header.model(data))
}

/// Refuses records of vendors that are cut off or that change what the data mean; the others may be skipped.
fn check_extensions(mut records: &[u8]) -> Result<(), SpzError> {
    while !records.is_empty() {
        let (Some(kind), Some(length)) = (u32_at(records, 0), u32_at(records, 4)) else {
            return Err(SpzError::Extension);
        };
        if kind == COORDINATE_SYSTEM {
            return Err(SpzError::CoordinateSystem);
        }
        records = records.get(8 + length as usize..).ok_or(SpzError::Extension)?;
    }
    Ok(())
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(*bytes.get(at..)?.first_chunk()?))
}

struct Header {
    version: u32,
    count: u32,
    degree: u8,
    fraction: Fraction,
    flags: u8,
}

impl Header {
    fn parse(bytes: &[u8]) -> Result<Self, SpzError> {
        if !bytes.starts_with(&MAGIC) {
            return Err(SpzError::Magic { found: bytes[..bytes.len().min(4)].to_vec() });
        }
        let (Some(version), Some(count), &[.., degree, bits, flags, _reserved]) =
            (u32_at(bytes, 4), u32_at(bytes, 8), bytes)
        else {
            return Err(SpzError::Gzip { reason: format!("{} bytes of the header's {HEADER}", bytes.len()) });
        };
        if bytes.len() < HEADER {
            return Err(SpzError::Gzip { reason: format!("{} bytes of the header's {HEADER}", bytes.len()) });
        }
        if !(2..=VERSION).contains(&version) {
            return Err(SpzError::Version { found: version });
        }
        if degree > SH_DEGREE_MAX {
            return Err(SpzError::ShDegree { found: degree });
        }
        if bits > FRACTION_BITS_MAX {
            return Err(SpzError::FractionBits { found: bits });
        }
        Ok(Self { version, count, degree, fraction: Fraction::new(bits), flags })
    }

    const fn rotation_bytes(&self) -> usize {
        if self.version >= 3 { 4 } else { 3 }
    }

    /// Bytes after the header, without extensions.
    fn data_bytes(&self) -> u64 {
        let each = 9 + 1 + 3 + 3 + self.rotation_bytes() + 3 * sh_rest_coefficients(self.degree);
        u64::from(self.count) * each as u64
    }

    /// The model in exactly [`Header::data_bytes`] bytes of data.
    fn model(&self, mut data: &[u8]) -> Gaussians {
        let count = self.count as usize;
        let rest = 3 * sh_rest_coefficients(self.degree);
        let mut column = |bytes: usize| {
            let (column, others) = data.split_at(count * bytes);
            data = others;
            column
        };
        let (means, opacities, colors) = (column(9), column(1), column(3));
        let (scales, rotations, bands) = (column(3), column(self.rotation_bytes()), column(rest));
        let turn = Turn::y_up_to_world();
        let mut model = Gaussians::with_sh_degree(self.degree);
        for index in 0..count {
            let mean: [f32; 3] = std::array::from_fn(|axis| {
                let at = 9 * index + 3 * axis;
                self.fraction.value([means[at], means[at + 1], means[at + 2]])
            });
            let three = |column: &[u8]| [column[3 * index], column[3 * index + 1], column[3 * index + 2]];
            let rotation = match rotations.get(4 * index..4 * index + 4) {
                Some(&[a, b, c, d]) if self.version >= 3 => rotation_from_bytes([a, b, c, d]),
                _ => rotation_from_v2_bytes(three(rotations)),
            };
            model.push(&Gaussian {
                mean: turn.mean(Vec3::from_array(mean)),
                log_scales: Vec3::from_array(three(scales).map(log_scale_from_byte)),
                rotation: turn.rotation(rotation),
                opacity_logit: logit_of_byte(opacities[index]),
                sh: three(colors).map(color_from_byte),
                id: index as u64,
                birth_round: 0,
            });
            if rest > 0 {
                let mut coefficients = [[0.0; 3]; SH_REST_MAX];
                for (k, byte) in bands[rest * index..rest * (index + 1)].iter().enumerate() {
                    coefficients[k / 3][k % 3] = sh_from_byte(*byte);
                }
                model.set_sh_rest(index, &turn.bands(&coefficients));
            }
        }
        model
    }
}
