//! The PLY of the original 3D Gaussian Splatting code, which every viewer reads: binary little-endian, one vertex per
//! Gaussian, means, normals (0), SH coefficients, opacity logits, log scales, quaternions as (w, x, y, z).
//!
//! The higher SH bands are `f_rest_0` and so on, one channel after the other: for K coefficients above degree 0,
//! `f_rest_(c K + k)` is coefficient k of channel c, while [`Gaussians::sh_rest`] has the channels innermost. Their
//! number (0, 9, 24 or 45) is the degree of the model.
//!
//! Reading takes the properties in any order and of any scalar type, and skips those it does not know as well as other
//! elements. For the frame see [`frames`](super::frames).

mod header;
#[cfg(test)]
mod tests;

use std::io::{self, Write};

use glam::{Quat, Vec3};
use thiserror::Error;

pub use self::header::Scalar;
use self::header::{HEADER_MAX, Property};
use super::{check_finite, degree_of_rest};
use crate::model::{Gaussian, Gaussians, SH_REST_MAX, sh_rest_coefficients};

/// Properties that must be there when read.
const PROPERTIES: [&str; 14] = [
    "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2",
    "rot_3",
];
/// Written after the means, as the original code does.
const NORMALS: [&str; 3] = ["nx", "ny", "nz"];
/// Coefficients of SH degrees 1 to 3.
const REST: &str = "f_rest_";

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
        name: String,
    },
    /// Rows of no fixed length.
    #[error(
        "the PLY has a list property \"{name}\" in its element \"{element}\", expected numbers only: remove it from the file"
    )]
    List {
        /// The property.
        name: String,
        /// Its element.
        element: String,
    },
    /// A number of coefficients that is no degree.
    #[error(
        "the PLY has {found} properties \"f_rest_*\", expected 0, 9, 24 or 45 (SH degree 0 to 3): export the model with one of \
         these degrees"
    )]
    Rest {
        /// Properties found.
        found: usize,
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
        name: String,
        /// The value, as text.
        value: String,
    },
}

/// Writes a model with all bands that it has.
///
/// # Errors
/// Those of the writer; [`io::ErrorKind::InvalidData`] around [`WriteError::NotFinite`](super::WriteError).
pub fn write(gaussians: &Gaussians, to: &mut impl Write) -> io::Result<()> {
    check_finite(gaussians).map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))?;
    write_checked(gaussians, to)
}

/// Writes a model that is finite.
pub(super) fn write_checked(gaussians: &Gaussians, to: &mut impl Write) -> io::Result<()> {
    let coefficients = sh_rest_coefficients(gaussians.sh_degree());
    let rest: Vec<String> = (0..3 * coefficients).map(|k| format!("{REST}{k}")).collect();
    let names = PROPERTIES[..3].iter().chain(&NORMALS).chain(&PROPERTIES[3..6]).copied();
    let names = names.chain(rest.iter().map(String::as_str)).chain(PROPERTIES[6..].iter().copied());
    let mut header = format!(
        "ply\nformat binary_little_endian 1.0\ncomment Vantage; world frame: metres, x east, y north, z up\n\
         element vertex {}\n",
        gaussians.len()
    );
    names.for_each(|name| header += &format!("property float {name}\n"));
    to.write_all((header + "end_header\n").as_bytes())?;
    let mut row = Vec::with_capacity(4 * (PROPERTIES.len() + NORMALS.len() + 3 * coefficients));
    for (index, g) in gaussians.iter().enumerate() {
        let (m, s, q) = (g.mean, g.log_scales, g.rotation);
        let bands = gaussians.sh_rest(index);
        let by_channel = (0..3).flat_map(|channel| bands[..coefficients].iter().map(move |c| c[channel]));
        let head = [m.x, m.y, m.z, 0.0, 0.0, 0.0].into_iter().chain(g.sh);
        let tail = [g.opacity_logit, s.x, s.y, s.z, q.w, q.x, q.y, q.z];
        row.clear();
        row.extend(head.chain(by_channel).chain(tail).flat_map(f32::to_le_bytes));
        to.write_all(&row)?;
    }
    Ok(())
}

/// Reads a model from the bytes of a file.
///
/// # Errors
/// Where the file is not such a PLY, is truncated, or holds values that are not finite.
pub fn read(bytes: &[u8]) -> Result<Gaussians, PlyError> {
    let header = header::parse(bytes)?;
    let find = |name: &str| {
        let found = header.properties.iter().find(|property| property.name == name);
        found.ok_or_else(|| PlyError::Missing { name: name.to_owned() })
    };
    let mut columns: Vec<&Property> = PROPERTIES.iter().map(|name| find(name)).collect::<Result<_, _>>()?;
    let found = header.properties.iter().filter(|property| property.name.starts_with(REST)).count();
    let degree = (found % 3 == 0).then(|| degree_of_rest(found / 3)).flatten().ok_or(PlyError::Rest { found })?;
    for k in 0..found {
        columns.push(find(&format!("{REST}{k}"))?);
    }
    let coefficients = sh_rest_coefficients(degree);
    let mut model = Gaussians::with_sh_degree(degree);
    let mut values = vec![0.0; columns.len()];
    // No stride of 0: there are columns.
    let rows = header.data.chunks_exact(header.stride);
    for (index, row) in rows.take(usize::try_from(header.count).unwrap_or(usize::MAX)).enumerate() {
        for (value, column) in values.iter_mut().zip(&columns) {
            *value = column.value(row);
        }
        let (v, rest) = values.split_at(PROPERTIES.len());
        let gaussian = Gaussian {
            mean: Vec3::new(v[0], v[1], v[2]),
            sh: [v[3], v[4], v[5]],
            opacity_logit: v[6],
            log_scales: Vec3::new(v[7], v[8], v[9]),
            rotation: Quat::from_xyzw(v[11], v[12], v[13], v[10]),
            id: index as u64,
            birth_round: 0,
        };
        if !gaussian.is_finite() || !rest.iter().all(|c| c.is_finite()) {
            let bad = values.iter().position(|v| !v.is_finite()).unwrap_or(PROPERTIES.len() - 1);
            let (name, value) = (columns[bad].name.clone(), values[bad].to_string());
            return Err(PlyError::NotFinite { index, name, value });
        }
        model.push(&gaussian);
        if degree > 0 {
            let mut bands = [[0.0; 3]; SH_REST_MAX];
            for (k, value) in rest.iter().enumerate() {
                bands[k % coefficients][k / coefficients] = *value;
            }
            model.set_sh_rest(index, &bands);
        }
    }
    Ok(model)
}
