//! antimatter15's `.splat`: 32 bytes per Gaussian and nothing else, in the order in which a viewer should load them.
//!
//! | bytes | what |
//! |---|---|
//! | 0-11 | mean, f32 |
//! | 12-23 | standard deviations along the axes, f32 |
//! | 24-27 | red, green, blue of degree 0 in [0, 1], opacity, each times 255 |
//! | 28-31 | rotation as (w, x, y, z) of unit length, each times 128 plus 128 |
//!
//! Little-endian. The higher SH bands are lost, colours are clamped to [0, 1]. Gaussians are written by falling
//! importance (volume times opacity), so that a partly loaded file already shows the most.
//!
//! Layout and order: <https://github.com/antimatter15/splat>, `convert.py`.

use std::io::Write;

use glam::{Quat, Vec3};
use thiserror::Error;

use super::{FLAT_LOG_SCALE, WriteError, check_finite, linear_scales, logit_of_byte, opacity, to_byte, unit_rotation};
use crate::model::{Gaussian, Gaussians};

/// Bytes per Gaussian.
const ROW: usize = 32;

/// Why a `.splat` was refused.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum SplatError {
    /// The length is no multiple of a Gaussian's.
    #[error("the .splat has {found} bytes, expected a multiple of {ROW}: it is truncated, or no .splat file")]
    Length {
        /// Bytes found.
        found: usize,
    },
    /// A value that no model may hold.
    #[error("Gaussian {index} of the .splat: {field} is {value}, expected {expected}: damaged, or no .splat file")]
    Value {
        /// Index from 0.
        index: usize,
        /// What the value is of.
        field: &'static str,
        /// The value, as text.
        value: String,
        /// What it should be.
        expected: &'static str,
    },
}

/// Writes a model without its higher SH bands.
///
/// # Errors
/// Those of the writer; [`WriteError::NotFinite`] and, for scales, [`WriteError::Range`].
pub fn write(gaussians: &Gaussians, to: &mut impl Write) -> Result<(), WriteError> {
    check_finite(gaussians)?;
    for index in importance_order(gaussians) {
        let g = gaussians.get(index);
        let scales = linear_scales(index, &g, ".splat")?;
        let q = unit_rotation(&g);
        let [red, green, blue] = g.color().map(|c| to_byte(255.0 * f64::from(c)));
        let rotation = [q.w, q.x, q.y, q.z].map(|c| to_byte(128.0 * c + 128.0));
        let mut row = [0; ROW];
        for (to, value) in row.chunks_exact_mut(4).zip(g.mean.to_array().into_iter().chain(scales)) {
            to.copy_from_slice(&value.to_le_bytes());
        }
        row[24..28].copy_from_slice(&[red, green, blue, to_byte(255.0 * opacity(g.opacity_logit))]);
        row[28..].copy_from_slice(&rotation);
        to.write_all(&row)?;
    }
    Ok(())
}

/// Indices by falling volume times opacity; equals stay in order.
fn importance_order(gaussians: &Gaussians) -> Vec<usize> {
    // Logarithms: the volume of a large Gaussian has no finite value.
    let importance = |g: Gaussian| g.log_scales.as_dvec3().element_sum() + opacity(g.opacity_logit).ln();
    let mut keyed: Vec<(f64, usize)> = gaussians.iter().map(importance).zip(0..).collect();
    keyed.sort_by(|a, b| b.0.total_cmp(&a.0));
    keyed.into_iter().map(|(_, index)| index).collect()
}

/// Reads a model of degree 0 from the bytes of a file.
///
/// # Errors
/// Where the length is not that of whole Gaussians, a number is not finite, a scale negative, or a rotation 0.
pub fn read(bytes: &[u8]) -> Result<Gaussians, SplatError> {
    let (rows, []) = bytes.as_chunks::<ROW>() else { return Err(SplatError::Length { found: bytes.len() }) };
    let mut model = Gaussians::new();
    for (index, row) in rows.iter().enumerate() {
        let float = |k: usize| f32::from_le_bytes([row[4 * k], row[4 * k + 1], row[4 * k + 2], row[4 * k + 3]]);
        let wrong = |field, value: String, expected| SplatError::Value { index, field, value, expected };
        let (mean, scales) = (Vec3::from_array([0, 1, 2].map(float)), [3, 4, 5].map(float));
        if let Some(bad) = mean.to_array().into_iter().find(|v| !v.is_finite()) {
            return Err(wrong("position", bad.to_string(), "a finite number"));
        }
        if let Some(bad) = scales.into_iter().find(|s| !(s.is_finite() && *s >= 0.0)) {
            return Err(wrong("scale", bad.to_string(), "0 or a positive finite number"));
        }
        let [w, x, y, z] = [28, 29, 30, 31].map(|k| (f32::from(row[k]) - 128.0) / 128.0);
        if [x, y, z, w] == [0.0; 4] {
            return Err(wrong("rotation", "0".to_owned(), "a quaternion other than 0"));
        }
        model.push(&Gaussian {
            mean,
            log_scales: Vec3::from_array(scales.map(|s| s.ln().max(FLAT_LOG_SCALE))),
            rotation: Quat::from_xyzw(x, y, z, w).normalize(),
            opacity_logit: logit_of_byte(row[27]),
            sh: Gaussian::sh_from_color([24, 25, 26].map(|k| f32::from(row[k]) / 255.0)),
            id: index as u64,
            birth_round: 0,
        });
    }
    Ok(model)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::formats::Format;
    use crate::formats::tests::{angle_between, bare, bytes, model};

    proptest! {
        #[test]
        fn a_model_comes_back_within_the_quantisation_by_falling_importance(count in 0_usize..40, seed: u64) {
            let model = model(count, 2, seed);
            let file = bytes(Format::Splat, &model);
            prop_assert_eq!(file.len(), 32 * count);
            let back = read(&file).unwrap();
            prop_assert_eq!(back.sh_degree(), 0);
            let order = importance_order(&model);
            let volume = |g: &Gaussian| g.log_scales.element_sum().exp() * g.opacity();
            for (i, &from) in order.iter().enumerate() {
                let (g, original) = (back.get(i), model.get(from));
                prop_assert_eq!(g.id, i as u64);
                prop_assert_eq!(g.mean, original.mean);
                prop_assert!((g.log_scales - original.log_scales).abs().max_element() < 1e-5);
                prop_assert!((g.opacity() - original.opacity()).abs() <= 0.5001 / 255.0);
                for (a, b) in g.color().into_iter().zip(original.color()) {
                    prop_assert!((a - b.clamp(0.0, 1.0)).abs() <= 0.5001 / 255.0);
                }
                // Half a step in each of four components; 1 becomes 127/128.
                prop_assert!(angle_between(g.rotation, original.rotation) < 0.025);
                if i > 0 {
                    prop_assert!(volume(&original) <= volume(&model.get(order[i - 1])) * 1.00001);
                }
            }
            // What was read is written to the same bytes, but for the order of near equals.
            let mut rows: Vec<_> = file.as_chunks::<ROW>().0.to_vec();
            let again = bytes(Format::Splat, &back);
            let mut rows_again: Vec<_> = again.as_chunks::<ROW>().0.to_vec();
            rows.sort_unstable();
            rows_again.sort_unstable();
            for (a, b) in rows.iter().zip(&rows_again) {
                prop_assert_eq!(&a[..12], &b[..12]);
                prop_assert_eq!(&a[24..28], &b[24..28]);
            }
        }

        #[test]
        fn any_bytes_are_read_or_refused(file in prop::collection::vec(any::<[u8; 32]>(), 0..20)) {
            if let Ok(model) = read(file.as_flattened()) {
                prop_assert!(model.is_finite());
            }
        }
    }

    #[test]
    fn a_row_is_the_one_of_the_definition() {
        let g = Gaussian {
            mean: Vec3::new(1.0, -2.0, 0.5),
            log_scales: Vec3::new(0.25_f32.ln(), 0.5_f32.ln(), 0.0),
            rotation: Quat::from_xyzw(0.0, 0.0, -3.0, 0.0),
            opacity_logit: 0.0,
            sh: Gaussian::sh_from_color([0.0, 1.0, 0.4]),
            id: 9,
            birth_round: 4,
        };
        let file = bytes(Format::Splat, &[g].into_iter().collect());
        let floats: Vec<f32> = file[..24].as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        assert_eq!(floats, [1.0, -2.0, 0.5, 0.25, 0.5, 1.0]);
        assert_eq!(file[24..], [0, 255, 102, 128, 128, 128, 128, 0]);
    }

    #[test]
    fn every_truncation_is_refused_but_between_gaussians() {
        let file = bytes(Format::Splat, &bare(3));
        for length in 0..file.len() {
            match read(&file[..length]) {
                // The format has no count: what ends between two Gaussians is a shorter file.
                Ok(model) => assert_eq!(32 * model.len(), length),
                Err(error) => assert_eq!(error, SplatError::Length { found: length }),
            }
        }
    }

    #[test]
    fn what_no_model_may_hold_is_named() {
        let file = bytes(Format::Splat, &bare(4));
        let broken = |at: usize, value: &[u8]| {
            let mut file = file.clone();
            file[2 * 32 + at..][..value.len()].copy_from_slice(value);
            read(&file).unwrap_err().to_string()
        };
        for (at, value, field) in [
            (4, f32::NAN, "position is NaN"),
            (8, f32::INFINITY, "position is inf"),
            (12, f32::NAN, "scale is NaN"),
            (16, -0.5, "scale is -0.5"),
            (20, f32::INFINITY, "scale is inf"),
        ] {
            let message = broken(at, &value.to_le_bytes());
            assert!(message.contains("Gaussian 2") && message.contains(field), "{message}");
        }
        assert!(broken(28, &[128; 4]).contains("rotation is 0"));
        let mut flat = file.clone();
        flat[12..16].fill(0);
        assert_eq!(read(&flat).unwrap().get(0).log_scales.x, FLAT_LOG_SCALE);
    }
}
