//! Binary glTF 2.0 with the extension `KHR_gaussian_splatting` (Khronos): splats in the format of 3D scenes.
//!
//! One mesh primitive of points, attribute by attribute in one buffer, little-endian f32 unless said otherwise:
//!
//! | attribute | what |
//! |---|---|
//! | `POSITION` | mean, metres |
//! | `COLOR_0` | linear colour of degree 0, opacity; u16 over [0, 1]; what viewers without the extension draw |
//! | `KHR_gaussian_splatting:ROTATION` | unit quaternion (x, y, z, w) |
//! | `KHR_gaussian_splatting:SCALE` | standard deviations along the axes, metres |
//! | `KHR_gaussian_splatting:OPACITY` | in [0, 1] |
//! | `KHR_gaussian_splatting:SH_DEGREE_l_COEF_n` | red, green, blue of order m = n - l |
//!
//! The extension's basis functions, signs and order are ours ([`sh_rest`](crate::Gaussians::sh_rest)). Colours are
//! trained on sRGB images: `srgb_rec709_display`. Logits beyond ±16 come back as these, log scales below -20 as that where
//! their exponential is 0. Frame: Y up ([`frames`](super::frames)).
//!
//! Reading takes all primitives of the scene with the extension, wherever their nodes are turned, moved or evenly scaled
//! to, with strides, and with integers where the extension allows them. What would change the picture and is not known
//! (other kernels, colour spaces, compressions) is refused.
//!
//! <https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting>

mod accessor;
mod json;
mod read;
#[cfg(test)]
mod tests;
mod write;

use thiserror::Error;

pub use read::read;
pub use write::write;

const EXTENSION: &str = "KHR_gaussian_splatting";
const MAGIC: [u8; 4] = *b"glTF";
const VERSION: u32 = 2;
/// Bytes of the file's header, and of a chunk's.
const HEADER: usize = 12;
const CHUNK_HEADER: usize = 8;
const JSON: [u8; 4] = *b"JSON";
const BIN: [u8; 4] = *b"BIN\0";

/// Component types of accessors.
const U16: u32 = 5123;
const F32: u32 = 5126;

/// The one color space whose values are those of a model.
const COLOR_SPACE: &str = "srgb_rec709_display";
const KERNEL: &str = "ellipse";
const PROJECTION: &str = "perspective";
const SORTING: &str = "cameraDistance";

/// The attributes but for `POSITION`, `COLOR_0` and the harmonics.
const POSITION: &str = "POSITION";
const ROTATION: &str = "KHR_gaussian_splatting:ROTATION";
const SCALE: &str = "KHR_gaussian_splatting:SCALE";
const OPACITY: &str = "KHR_gaussian_splatting:OPACITY";
const SH_PREFIX: &str = "KHR_gaussian_splatting:SH_DEGREE_";

/// Name of the attribute of a coefficient: of degree `l`, its `n`-th.
fn sh_attribute(l: usize, n: usize) -> String {
    format!("{SH_PREFIX}{l}_COEF_{n}")
}

/// Names of the attributes of all coefficients above degree 0, in the model's order.
fn rest_attributes(degree: u8) -> Vec<String> {
    (1..=usize::from(degree)).flat_map(|l| (0..=2 * l).map(move |n| sh_attribute(l, n))).collect()
}

/// Why a glTF was refused.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum GlbError {
    /// Not what a `.glb` begins with.
    #[error("not a .glb file: it begins with {found:02x?} instead of \"glTF\"")]
    Magic {
        /// The first bytes.
        found: Vec<u8>,
    },
    /// Another version.
    #[error("glTF of version {found}, but version {VERSION} is read")]
    Version {
        /// The version in the file.
        found: u32,
    },
    /// Something ends too early, or goes on.
    #[error("{what} of the .glb has {found} bytes, expected {expected}: {}", if found < expected { "it is truncated" } else { "something else follows" })]
    Length {
        /// The file, a chunk, or a part of the document.
        what: String,
        /// Bytes expected.
        expected: u64,
        /// Bytes found.
        found: u64,
    },
    /// The JSON is none, or lacks what glTF demands.
    #[error("the JSON of the .glb: {reason}")]
    Json {
        /// As the parser says it, with line and column.
        reason: String,
    },
    /// Something in the document that is not there, not valid, or not supported.
    #[error("{field} of the glTF is {found}, expected {expected}")]
    Document {
        /// Where, as a path in the JSON.
        field: String,
        /// What is there.
        found: String,
        /// What should be.
        expected: String,
    },
    /// No Gaussians.
    #[error("no mesh primitive with the extension {EXTENSION} in the glTF's scene: it holds no Gaussian splats")]
    NoSplats,
    /// A value that no model may hold.
    #[error("Gaussian {index} of {primitive}: {attribute} is {value}, expected {expected}")]
    Value {
        /// Index from 0 within its primitive.
        index: usize,
        /// The primitive, as a path in the JSON.
        primitive: String,
        /// The attribute.
        attribute: String,
        /// Its value, as text.
        value: String,
        /// What it should be.
        expected: &'static str,
    },
}
