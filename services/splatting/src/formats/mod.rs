//! Files of models: what the field's tools read and write.
//!
//! | format | keeps | bytes per Gaussian at SH degree 0 / 3 |
//! |---|---|---|
//! | [`ply`] | all parameters as they are | 68 / 248 |
//! | [`glb`] | all parameters in f32, opacities and scales after their activations | 64 / 244 |
//! | [`spz`] | 8 to 24 bits per parameter | 20 / 65 before gzip |
//! | [`splat`] | means and scales in f32; colours, opacities and rotations in 8 bits; no higher SH bands | 32 / - |
//!
//! Identity and birth round have no place in any of them: a model that is read numbers its Gaussians from 0. Frames are
//! in [`frames`]: a model in memory is always in the world frame, whatever its file uses.

pub mod frames;
pub mod glb;
pub mod ply;
pub(crate) mod sh_rotation;
pub mod splat;
pub mod spz;

use std::io::{self, Write};
use std::path::Path;

use thiserror::Error;

use crate::model::{Gaussian, Gaussians, SH_REST_MAX, sh_rest_coefficients};

/// The formats of model files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// PLY as the original 3D Gaussian Splatting code writes it.
    Ply,
    /// antimatter15's `.splat`.
    Splat,
    /// Niantic's SPZ, version 3.
    Spz,
    /// Binary glTF with `KHR_gaussian_splatting`.
    Glb,
}

impl Format {
    /// All formats.
    pub const ALL: [Self; 4] = [Self::Ply, Self::Splat, Self::Spz, Self::Glb];

    /// Ending of its files' names, without the dot.
    pub const fn extension(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::Splat => "splat",
            Self::Spz => "spz",
            Self::Glb => "glb",
        }
    }

    /// The format that a file's name ends with, in any case of letters.
    pub fn of_path(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?;
        Self::ALL.into_iter().find(|format| extension.eq_ignore_ascii_case(format.extension()))
    }
}

/// Why a model could not be written.
#[derive(Debug, Error)]
pub enum WriteError {
    /// The writer refused.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// A parameter that no file should hold.
    #[error(
        "Gaussian {index} of the model has {field} {value}, expected a finite number: train or repair the model first"
    )]
    NotFinite {
        /// Index from 0.
        index: usize,
        /// The parameter.
        field: String,
        /// Its value, as text.
        value: String,
    },
    /// A parameter that the format cannot hold.
    #[error(
        "Gaussian {index} of the model has {field} {value}, but {format} holds {limit} at most: write a PLY, or remove the Gaussian"
    )]
    Range {
        /// Index from 0.
        index: usize,
        /// The parameter.
        field: &'static str,
        /// Its value.
        value: f32,
        /// The format.
        format: &'static str,
        /// The largest magnitude that the format holds.
        limit: f64,
    },
    /// A number of Gaussians that the format cannot hold.
    #[error("a model of {count} Gaussians, but {format} holds {least} to {most} of this SH degree: write a PLY")]
    Count {
        /// Gaussians of the model.
        count: usize,
        /// The format.
        format: &'static str,
        /// The fewest.
        least: u64,
        /// The most.
        most: u64,
    },
}

/// Why a file is no model.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum ReadError {
    /// PLY.
    #[error(transparent)]
    Ply(#[from] ply::PlyError),
    /// `.splat`.
    #[error(transparent)]
    Splat(#[from] splat::SplatError),
    /// SPZ.
    #[error(transparent)]
    Spz(#[from] spz::SpzError),
    /// glTF.
    #[error(transparent)]
    Glb(#[from] glb::GlbError),
}

/// Writes a model. `antialiased` says that it was trained with opacity compensation
/// ([`RenderSettings::opacity_compensation`](crate::RenderSettings)), which only SPZ records.
///
/// # Errors
/// Those of the writer; a model that is not finite, or beyond what the format holds.
pub fn write(format: Format, gaussians: &Gaussians, antialiased: bool, to: &mut impl Write) -> Result<(), WriteError> {
    match format {
        Format::Ply => {
            check_finite(gaussians)?;
            Ok(ply::write_checked(gaussians, to)?)
        }
        Format::Splat => splat::write(gaussians, to),
        Format::Spz => spz::write(gaussians, antialiased, to),
        Format::Glb => glb::write(gaussians, to),
    }
}

/// Reads a model from the bytes of a file.
///
/// # Errors
/// Where the bytes are no whole file of that format, or hold values that no model may hold.
pub fn read(format: Format, bytes: &[u8]) -> Result<Gaussians, ReadError> {
    Ok(match format {
        Format::Ply => ply::read(bytes)?,
        Format::Splat => splat::read(bytes)?,
        Format::Spz => spz::read(bytes)?,
        Format::Glb => glb::read(bytes)?,
    })
}

/// Refuses a model with parameters that are not finite, and rotations that are 0.
fn check_finite(gaussians: &Gaussians) -> Result<(), WriteError> {
    let rest = sh_rest_coefficients(gaussians.sh_degree());
    for (index, g) in gaussians.iter().enumerate() {
        let bands = gaussians.sh_rest(index);
        if let Some((field, value)) = not_finite(&g, &bands[..rest]) {
            return Err(WriteError::NotFinite { index, field, value: value.to_string() });
        }
    }
    Ok(())
}

/// The first parameter that is not finite, by the model's names; a rotation of length 0 counts as one.
fn not_finite(g: &Gaussian, rest: &[[f32; 3]]) -> Option<(String, f32)> {
    if g.is_finite() && rest.iter().flatten().all(|c| c.is_finite()) {
        return None;
    }
    let groups: [(&str, &[f32]); 5] = [
        ("mean", &g.mean.to_array()),
        ("log_scales", &g.log_scales.to_array()),
        ("rotation", &g.rotation.to_array()),
        ("opacity_logit", &[g.opacity_logit]),
        ("sh", &g.sh),
    ];
    let named = groups.iter().flat_map(|(name, values)| values.iter().enumerate().map(move |(k, v)| (*name, k, *v)));
    let bands = rest.iter().flatten().enumerate().map(|(k, v)| ("sh_rest", k, *v));
    let bad = named.chain(bands).find(|(_, _, value)| !value.is_finite());
    Some(bad.map_or_else(|| ("rotation".to_owned(), 0.0), |(name, k, value)| (format!("{name}[{k}]"), value)))
}

/// Standard deviations of scales that are 0 in a file: as flat as the optimiser lets a Gaussian become.
const FLAT_LOG_SCALE: f32 = -20.0;
/// Magnitude of the logits of opacities 0 and 1 in a file: f32 has no opacity nearer to 1.
const LOGIT_MAX: f64 = 16.0;

/// The logit of an opacity in [0, 1], at most [`LOGIT_MAX`] in magnitude.
fn logit(opacity: f64) -> f32 {
    (opacity.ln() - (-opacity).ln_1p()).clamp(-LOGIT_MAX, LOGIT_MAX) as f32
}

/// The opacity of a logit.
fn opacity(logit: f32) -> f64 {
    1.0 / (1.0 + (-f64::from(logit)).exp())
}

/// The logit of an opacity in 8 bits: of the byte's own value, or where that is 0 or 1 the middle of the opacities that
/// are rounded to it.
fn logit_of_byte(byte: u8) -> f32 {
    logit(f64::from(byte).clamp(0.25, 254.75) / 255.0)
}

/// Rounds to a byte, and to its nearest end what is outside.
fn to_byte(value: f64) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

/// Standard deviations along the axes, metres.
///
/// # Errors
/// Where one has no finite value in f32.
fn linear_scales(index: usize, g: &Gaussian, format: &'static str) -> Result<[f32; 3], WriteError> {
    let scales = g.log_scales.to_array().map(|log| f64::from(log).exp() as f32);
    if scales.iter().all(|scale| scale.is_finite()) {
        return Ok(scales);
    }
    let limit = f64::from(f32::MAX).ln();
    Err(WriteError::Range { index, field: "log scale", value: g.log_scales.max_element(), format, limit })
}

/// Rotation of unit length; it must be finite and not 0.
fn unit_rotation(g: &Gaussian) -> glam::DQuat {
    g.rotation.as_dquat().normalize()
}

/// Degree whose coefficients above degree 0 are so many, [`SH_REST_MAX`] at most.
fn degree_of_rest(coefficients: usize) -> Option<u8> {
    debug_assert!(sh_rest_coefficients(3) == SH_REST_MAX);
    (0..=3).find(|&degree| sh_rest_coefficients(degree) == coefficients)
}

#[cfg(test)]
mod tests;
