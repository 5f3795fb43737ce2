//! Between sRGB bytes and linear light. Light is summed and averaged in linear space, as a sensor does, and stored as
//! sRGB, as a camera does. Both directions are tables: they run once per sample.

use std::sync::LazyLock;

use glam::Vec3;

const ENCODE_STEPS: usize = 1 << 14;

static DECODE: LazyLock<[f32; 256]> = LazyLock::new(|| std::array::from_fn(|code| decode(code as f32 / 255.0)));
static ENCODE: LazyLock<Vec<u8>> = LazyLock::new(|| {
    (0..=ENCODE_STEPS).map(|i| (encode(i as f32 / ENCODE_STEPS as f32) * 255.0).round() as u8).collect()
});

/// The sRGB transfer function of IEC 61966-2-1, from code value (0..1) to linear light (0..1).
fn decode(code: f32) -> f32 {
    if code <= 0.040_45 { code / 12.92 } else { ((code + 0.055) / 1.055).powf(2.4) }
}

/// Its inverse.
fn encode(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { linear * 12.92 } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// The decoding table, for loops that fetch many texels.
pub(crate) fn decode_table() -> &'static [f32; 256] {
    &DECODE
}

/// Linear light of one sRGB byte.
#[must_use]
pub fn linear_from_srgb(code: u8) -> f32 {
    DECODE[usize::from(code)]
}

/// Linear light of three sRGB bytes.
#[must_use]
pub fn linear_rgb_from_srgb(codes: [u8; 3]) -> Vec3 {
    Vec3::new(linear_from_srgb(codes[0]), linear_from_srgb(codes[1]), linear_from_srgb(codes[2]))
}

/// The nearest sRGB byte of a linear value; clipped to 0..1, NaN becomes 0.
#[must_use]
pub fn srgb_from_linear(linear: f32) -> u8 {
    ENCODE[(linear.clamp(0.0, 1.0) * ENCODE_STEPS as f32 + 0.5) as usize]
}

/// Three sRGB bytes of linear light.
#[must_use]
pub fn srgb_from_linear_rgb(linear: Vec3) -> [u8; 3] {
    [srgb_from_linear(linear.x), srgb_from_linear(linear.y), srgb_from_linear(linear.z)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_byte_survives_the_round_trip() {
        for code in 0..=255_u8 {
            assert_eq!(srgb_from_linear(linear_from_srgb(code)), code);
        }
        assert!((linear_from_srgb(188) - 0.5029).abs() < 1e-3, "half of the light is code 188");
        assert_eq!(srgb_from_linear(f32::NAN), 0);
        assert_eq!(srgb_from_linear(7.0), 255);
    }
}
