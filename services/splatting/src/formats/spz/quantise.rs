//! Parameters as the bytes of SPZ, and back.

use glam::{DQuat, Quat};

use crate::formats::to_byte;

/// Fractional bits of means where nothing asks for fewer.
pub const FRACTION_BITS: u8 = 12;
/// Fractional bits that 24 bits with sign can have.
pub const FRACTION_BITS_MAX: u8 = 23;
/// Largest magnitude of a 24-bit number with sign.
const FIXED_MAX: f64 = 8_388_607.0;
/// Colours are coefficients of degree 0 times this, plus a half: a wider range than that of the colours themselves.
const COLOR_SCALE: f64 = 0.15;
/// Magnitudes of a quaternion's components have 9 bits.
const MAGNITUDE_MAX: f64 = 511.0;

/// Fixed point of 24 bits with sign.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fraction(u8);

impl Fraction {
    /// With `bits` of them after the point, [`FRACTION_BITS_MAX`] at most.
    pub fn new(bits: u8) -> Self {
        Self(bits.min(FRACTION_BITS_MAX))
    }

    /// Bits after the point.
    pub fn bits(self) -> u8 {
        self.0
    }

    fn one(self) -> f64 {
        f64::from(1_u32 << self.0)
    }

    /// Largest magnitude.
    pub fn limit(self) -> f64 {
        FIXED_MAX / self.one()
    }

    /// Whether a value fits.
    pub fn holds(self, value: f32) -> bool {
        (f64::from(value) * self.one()).round().abs() <= FIXED_MAX
    }

    /// The nearest fixed-point number.
    pub fn to_bytes(self, value: f32) -> [u8; 3] {
        let fixed = (f64::from(value) * self.one()).round().clamp(-FIXED_MAX, FIXED_MAX) as i32;
        let [a, b, c, _sign] = fixed.to_le_bytes();
        [a, b, c]
    }

    /// The value of a fixed-point number.
    pub fn value(self, [a, b, c]: [u8; 3]) -> f32 {
        // The sign is spread by shifting back.
        let fixed = i32::from_le_bytes([0, a, b, c]) >> 8;
        (f64::from(fixed) / self.one()) as f32
    }
}

pub fn color_to_byte(sh: f32) -> u8 {
    to_byte(255.0 * (COLOR_SCALE * f64::from(sh) + 0.5))
}

pub fn color_from_byte(byte: u8) -> f32 {
    ((f64::from(byte) / 255.0 - 0.5) / COLOR_SCALE) as f32
}

pub fn log_scale_to_byte(log_scale: f32) -> u8 {
    to_byte(16.0 * (f64::from(log_scale) + 10.0))
}

pub fn log_scale_from_byte(byte: u8) -> f32 {
    f32::from(byte) / 16.0 - 10.0
}

/// Step of coefficient `k` above degree 0, in 128ths: 5 bits in degree 1, 4 above.
pub fn bucket(k: usize) -> i32 {
    if k < 3 { 1 << (8 - 5) } else { 1 << (8 - 4) }
}

/// Rounds to 128ths, and these to the nearest multiple of the bucket: 0 stays 0, and the bytes compress.
pub fn sh_to_byte(coefficient: f32, bucket: i32) -> u8 {
    let fine = (128.0 * f64::from(coefficient)).round().clamp(-128.0, 128.0) as i32 + 128;
    // 256 and more have no byte.
    ((fine + bucket / 2) / bucket * bucket).min(255) as u8
}

pub fn sh_from_byte(byte: u8) -> f32 {
    (f32::from(byte) - 128.0) / 128.0
}

/// Smallest three: of the top two bits the index (x, y, z, w) of the component that is left out, then sign and
/// magnitude of the others in order, the magnitudes in units of sqrt(1/2) / 511. Little-endian.
pub fn rotation_to_bytes(rotation: Quat) -> [u8; 4] {
    let components = rotation.as_dquat().normalize().to_array();
    let largest = (1..4).fold(0, |best, i| if components[i].abs() > components[best].abs() { i } else { best });
    let flip = components[largest] < 0.0;
    let mut packed = largest as u32;
    for (_, component) in components.iter().enumerate().filter(|(i, _)| *i != largest) {
        let magnitude = (MAGNITUDE_MAX * component.abs() * std::f64::consts::SQRT_2).round().min(MAGNITUDE_MAX);
        packed = packed << 10 | u32::from((*component < 0.0) != flip) << 9 | magnitude as u32;
    }
    packed.to_le_bytes()
}

/// What [`rotation_to_bytes`] packed; of unit length whatever the bytes are.
pub fn rotation_from_bytes(bytes: [u8; 4]) -> Quat {
    let mut packed = u32::from_le_bytes(bytes);
    let largest = (packed >> 30) as usize;
    let mut components = [0.0; 4];
    for i in (0..4).rev().filter(|i| *i != largest) {
        let magnitude = f64::from(packed & 0x1ff) * std::f64::consts::FRAC_1_SQRT_2 / MAGNITUDE_MAX;
        components[i] = if packed >> 9 & 1 == 1 { -magnitude } else { magnitude };
        packed >>= 10;
    }
    complete(components, largest)
}

/// Version 2: x, y, z as bytes over [-1, 1], w positive; of unit length whatever the bytes are.
pub fn rotation_from_v2_bytes(bytes: [u8; 3]) -> Quat {
    let [x, y, z] = bytes.map(|byte| f64::from(byte) / 127.5 - 1.0);
    complete([x, y, z, 0.0], 3)
}

/// The quaternion of three components and the positive fourth, which is 0 where they are already too long.
fn complete(mut components: [f64; 4], missing: usize) -> Quat {
    let squares: f64 = components.iter().map(|c| c * c).sum();
    components[missing] = (1.0 - squares).max(0.0).sqrt();
    DQuat::from_array(components).normalize().as_quat()
}
