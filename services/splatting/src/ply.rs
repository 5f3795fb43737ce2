//! The PLY of the original 3D Gaussian Splatting code, which every viewer reads: binary little-endian, one vertex per
//! Gaussian, means, normals (0), SH coefficients, opacity logits, log scales, quaternions as (w, x, y, z).
//!
//! Identity and birth round have no place in that format: a model read from it numbers its Gaussians from 0.

use std::io::{self, Write};

use glam::{Quat, Vec3};
use thiserror::Error;

use crate::model::{Gaussian, Gaussians};

/// Properties in the order written; all must be there when read, in any order.
const PROPERTIES: [&str; 14] = [
    "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2",
    "rot_3",
];
/// Properties that are skipped.
const NORMALS: [&str; 3] = ["nx", "ny", "nz"];
/// Coefficients of SH degrees 1 to 3.
const REST: &str = "f_rest_";
/// A header longer than this is not one.
const HEADER_MAX: usize = 16 << 10;

/// Why a PLY was refused.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum PlyError {
    /// Not a PLY, or one whose header is malformed.
    #[error("line {line} of the PLY header: found {found:?}, expected {expected}")]
    Header {
        /// Line number from 1.
        line: usize,
        /// What stands there.
        found: String,
        /// What should.
        expected: &'static str,
    },
    /// No end of the header.
    #[error("no \"end_header\" in the first {HEADER_MAX} bytes: not a PLY file, or a truncated one")]
    NoEnd,
    /// A needed property is missing.
    #[error("the PLY has no property \"{name}\": it is not a Gaussian splatting model as the original code writes it")]
    Missing {
        /// The property.
        name: &'static str,
    },
    /// A property that cannot be kept.
    #[error("the PLY has a property \"{name}\" that would be lost: remove it from the file")]
    Extra {
        /// The property.
        name: String,
    },
    /// View-dependent colour, which a model here has not.
    #[error(
        "Gaussian {index} of the PLY has view-dependent colour (\"{name}\" is {value}; expected 0): train or export the model \
         with SH degree 0"
    )]
    ViewDependent {
        /// Index from 0.
        index: usize,
        /// The property.
        name: String,
        /// The value, as text.
        value: String,
    },
    /// The data does not have the length that the header gives.
    #[error("the PLY announces {count} Gaussians, {expected} bytes after its header, but {found} bytes follow: {}", if found < expected { "it is truncated" } else { "something else follows" })]
    Length {
        /// Vertices of the header.
        count: u64,
        /// Bytes expected.
        expected: u64,
        /// Bytes found.
        found: u64,
    },
    /// A value that no model may hold.
    #[error("Gaussian {index} of the PLY is not finite, or its rotation is 0: property \"{name}\" is {value}")]
    NotFinite {
        /// Index from 0.
        index: usize,
        /// The property.
        name: &'static str,
        /// The value, as text.
        value: String,
    },
}

/// Writes a model.
///
/// # Errors
/// Those of the writer.
pub fn write(gaussians: &Gaussians, to: &mut impl Write) -> io::Result<()> {
    let mut header = format!(
        "ply\nformat binary_little_endian 1.0\ncomment Vantage; world frame: metres, x east, y north, z up\n\
         element vertex {}\n",
        gaussians.len()
    );
    let order = PROPERTIES[..3].iter().chain(&NORMALS).chain(&PROPERTIES[3..]);
    for name in order {
        header += &format!("property float {name}\n");
    }
    to.write_all((header + "end_header\n").as_bytes())?;
    for g in gaussians.iter() {
        let (m, s, q) = (g.mean, g.log_scales, g.rotation);
        let [r, gr, b] = g.sh;
        let row = [m.x, m.y, m.z, 0.0, 0.0, 0.0, r, gr, b, g.opacity_logit, s.x, s.y, s.z, q.w, q.x, q.y, q.z];
        let mut bytes = [0; 4 * 17];
        for (to, value) in bytes.chunks_exact_mut(4).zip(row) {
            to.copy_from_slice(&value.to_le_bytes());
        }
        to.write_all(&bytes)?;
    }
    Ok(())
}

/// Reads a model from the bytes of a file.
///
/// # Errors
/// Where the file is not such a PLY, is truncated, or holds values that are not finite; nothing is skipped silently
/// but normals, comments and coefficients of higher SH degrees that are 0 (the original code always writes them).
pub fn read(bytes: &[u8]) -> Result<Gaussians, PlyError> {
    let Header { count, properties, data } = parse_header(bytes)?;
    let mut columns = [0; PROPERTIES.len()];
    for (column, name) in columns.iter_mut().zip(PROPERTIES) {
        *column = properties.iter().position(|p| p == name).ok_or(PlyError::Missing { name })?;
    }
    let stride = 4 * properties.len();
    let expected = count.saturating_mul(stride as u64);
    if expected != data.len() as u64 {
        return Err(PlyError::Length { count, expected, found: data.len() as u64 });
    }
    let rest: Vec<usize> = (0..properties.len()).filter(|&at| properties[at].starts_with(REST)).collect();
    let mut model = Gaussians::new();
    for (index, row) in data.chunks_exact(stride).enumerate() {
        let value = |column: usize| {
            row.get(4 * column..).and_then(|b| b.first_chunk()).map_or(f32::NAN, |b| f32::from_le_bytes(*b))
        };
        if let Some(&lost) = rest.iter().find(|&&column| value(column) != 0.0) {
            let name = properties[lost].clone();
            return Err(PlyError::ViewDependent { index, name, value: value(lost).to_string() });
        }
        let v: [f32; PROPERTIES.len()] = std::array::from_fn(|property| value(columns[property]));
        let gaussian = Gaussian {
            mean: Vec3::new(v[0], v[1], v[2]),
            sh: [v[3], v[4], v[5]],
            opacity_logit: v[6],
            log_scales: Vec3::new(v[7], v[8], v[9]),
            rotation: Quat::from_xyzw(v[11], v[12], v[13], v[10]),
            id: index as u64,
            birth_round: 0,
        };
        if !gaussian.is_finite() {
            let bad = v.iter().position(|v| !v.is_finite()).unwrap_or(PROPERTIES.len() - 1);
            return Err(PlyError::NotFinite { index, name: PROPERTIES[bad], value: v[bad].to_string() });
        }
        model.push(&gaussian);
    }
    Ok(model)
}

struct Header<'a> {
    count: u64,
    properties: Vec<String>,
    data: &'a [u8],
}

fn parse_header(bytes: &[u8]) -> Result<Header<'_>, PlyError> {
    const END: &[u8] = b"end_header\n";
    let searched = &bytes[..bytes.len().min(HEADER_MAX)];
    let end = searched.windows(END.len()).position(|w| w == END).ok_or(PlyError::NoEnd)?;
    let text = String::from_utf8_lossy(&bytes[..end]);
    let mut count = None;
    let mut properties = Vec::new();
    for (i, line) in text.lines().enumerate() {
        let wrong = |expected| PlyError::Header { line: i + 1, found: line.to_owned(), expected };
        let words: Vec<&str> = line.split_whitespace().collect();
        match (i, words.as_slice()) {
            (0, ["ply"]) | (2.., ["comment" | "obj_info", ..]) => {}
            (0, _) => return Err(wrong("\"ply\"")),
            (1, ["format", "binary_little_endian", "1.0"]) => {}
            (1, _) => return Err(wrong("\"format binary_little_endian 1.0\"")),
            (_, ["element", "vertex", n]) if count.is_none() => {
                count = Some(n.parse().map_err(|_not_a_number| wrong("a number of vertices"))?);
            }
            (_, ["property", "float" | "float32", name]) if count.is_some() => {
                if !(PROPERTIES.contains(name) || NORMALS.contains(name) || name.starts_with(REST)) {
                    return Err(PlyError::Extra { name: (*name).to_owned() });
                }
                if properties.iter().any(|p| p == name) {
                    return Err(wrong("each property once"));
                }
                properties.push((*name).to_owned());
            }
            (_, ["property", ..]) if count.is_some() => return Err(wrong("properties of type float")),
            _ => return Err(wrong("one element, \"vertex\", and its properties")),
        }
    }
    let line = text.lines().count() + 1;
    let expected = "\"element vertex N\" before it";
    let count = count.ok_or(PlyError::Header { line, found: "end_header".to_owned(), expected })?;
    Ok(Header { count, properties, data: &bytes[end + END.len()..] })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::scene;

    fn bytes(model: &Gaussians) -> Vec<u8> {
        let mut bytes = Vec::new();
        write(model, &mut bytes).unwrap();
        bytes
    }

    /// The same file with one piece of its header replaced.
    fn with_header(from: &str, to: &str) -> Vec<u8> {
        let original = bytes(&scene(5, 1));
        let at = original.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
        [&original[..at], to.as_bytes(), &original[at + from.len()..]].concat()
    }

    #[test]
    fn a_model_comes_back() {
        for count in [0, 1, 37] {
            let model = scene(count, 4);
            assert_eq!(read(&bytes(&model)).unwrap(), model);
        }
    }

    #[test]
    fn the_header_is_the_one_that_viewers_expect() {
        let bytes = bytes(&scene(3, 1));
        let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap();
        let names: Vec<String> = String::from_utf8_lossy(&bytes[..end])
            .lines()
            .filter_map(|l| l.strip_prefix("property float ").map(str::to_owned))
            .collect();
        let expected = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
        assert_eq!(names.join(" "), expected);
        assert_eq!(bytes.len(), end + 11 + 3 * 17 * 4);
    }

    #[test]
    fn higher_sh_degrees_are_read_where_they_are_zero_and_refused_where_they_would_be_lost() {
        let model = scene(4, 1);
        let plain = bytes(&model);
        let end = plain.windows(11).position(|w| w == b"end_header\n").unwrap();
        let padded = |last: f32| {
            let mut file = plain[..end].to_vec();
            (0..45).for_each(|k| file.extend(format!("property float f_rest_{k}\n").bytes()));
            file.extend(b"end_header\n");
            for row in plain[end + 11..].chunks_exact(17 * 4) {
                file.extend(row);
                (0..45).for_each(|k| file.extend((if k == 44 { last } else { 0.0 }).to_le_bytes()));
            }
            file
        };
        assert_eq!(read(&padded(0.0)).unwrap(), model);
        let message = read(&padded(0.25)).unwrap_err().to_string();
        assert!(
            message.contains("f_rest_44") && message.contains("0.25") && message.contains("SH degree 0"),
            "{message}"
        );
    }

    #[test]
    fn every_truncation_is_refused() {
        let bytes = bytes(&scene(4, 1));
        for length in 0..bytes.len() {
            assert!(read(&bytes[..length]).is_err(), "{length} bytes");
        }
        assert!(matches!(read(&[bytes.as_slice(), b"x"].concat()), Err(PlyError::Length { .. })));
    }

    #[test]
    fn errors_name_what_is_wrong() {
        let message = |bytes: &[u8]| read(bytes).unwrap_err().to_string();
        assert!(message(&with_header("property float opacity\n", "")).contains("\"opacity\""));
        assert!(message(&with_header("float nx", "float density")).contains("\"density\""));
        assert!(message(&with_header("float nx", "uchar nx")).contains("type float"));
        assert!(message(&with_header("float ny", "float nx")).contains("once"));
        assert!(message(&with_header("binary_little_endian", "ascii")).contains("binary_little_endian"));
        assert!(message(&with_header("vertex 5", "vertex many")).contains("number"));
        assert!(message(&with_header("vertex 5", "vertex 99999999999999")).contains("truncated"));
        assert!(message(b"solid cube").contains("end_header"));
        let mut broken = bytes(&scene(5, 1));
        let at = broken.len() - 17 * 4 * 2;
        broken[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(message(&broken).contains("Gaussian 3") && message(&broken).contains("\"x\""));
    }
}
