//! Images in PNG: 8-bit RGB and 16-bit grey, strict about files that are cut or of another kind.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use png::{BitDepth, ColorType};

use super::{FolderError, write_atomic};
use crate::messages::FrameView;

/// The last chunk of every PNG. Decoders give the pixels without it; a cut file must not pass for a whole one.
const END: [u8; 12] = [0, 0, 0, 0, b'I', b'E', b'N', b'D', 0xAE, 0x42, 0x60, 0x82];

/// What an image file holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    /// 8 bits of red, green and blue.
    Rgb8,
    /// 16 bits of grey, big-endian.
    Grey16,
}

impl Kind {
    fn png(self) -> (ColorType, BitDepth) {
        match self {
            Self::Rgb8 => (ColorType::Rgb, BitDepth::Eight),
            Self::Grey16 => (ColorType::Grayscale, BitDepth::Sixteen),
        }
    }

    fn bytes_per_pixel(self) -> usize {
        match self {
            Self::Rgb8 => 3,
            Self::Grey16 => 2,
        }
    }
}

/// Encodes `width * height` pixels, row by row.
pub(super) fn encode(path: &Path, kind: Kind, width: u32, height: u32, pixels: &[u8]) -> Result<Vec<u8>, FolderError> {
    let (color, depth) = kind.png();
    let mut bytes = Vec::with_capacity(pixels.len() / 2 + 1024);
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder.set_compression(png::Compression::Fast);
    encoder
        .write_header()
        .and_then(|mut writer| {
            writer.write_image_data(pixels)?;
            writer.finish()
        })
        .map_err(|error| damaged(path, "pixels", &error.to_string(), &format!("{width} x {height} of {kind:?}")))?;
    Ok(bytes)
}

/// Decodes an image of known kind and size.
pub(super) fn decode(path: &Path, kind: Kind, width: u32, height: u32, bytes: &[u8]) -> Result<Vec<u8>, FolderError> {
    if !bytes.ends_with(&END) {
        return Err(damaged(path, "end", &format!("cut after {} bytes", bytes.len()), "an IEND chunk"));
    }
    let mut decoder = png::Decoder::new(Cursor::new(bytes));
    decoder.set_transformations(png::Transformations::IDENTITY);
    let broken = |error: png::DecodingError| damaged(path, "image", &error.to_string(), "a readable PNG");
    let mut reader = decoder.read_info().map_err(broken)?;
    let info = reader.info();
    let (color, depth) = kind.png();
    if (info.color_type, info.bit_depth) != (color, depth) {
        let found = format!("{:?} of {:?} bits", info.color_type, info.bit_depth);
        return Err(damaged(path, "pixel format", &found, &format!("{color:?} of {depth:?} bits")));
    }
    if (info.width, info.height) != (width, height) {
        let found = format!("{} x {}", info.width, info.height);
        return Err(damaged(path, "size", &found, &format!("{width} x {height} as in frame.json")));
    }
    let mut pixels = vec![0; width as usize * height as usize * kind.bytes_per_pixel()];
    if reader.output_buffer_size() != Some(pixels.len()) {
        return Err(damaged(
            path,
            "size",
            &format!("{:?} bytes", reader.output_buffer_size()),
            &pixels.len().to_string(),
        ));
    }
    reader.next_frame(&mut pixels).map_err(broken)?;
    reader.finish().map_err(broken)?;
    Ok(pixels)
}

/// Writes the images of a frame, for people: `<stem>-rgb.png` where it has colour, and `<stem>-depth.png`, 16 bits in units of
/// the header's `depth_unit_m`.
///
/// # Errors
/// When a file cannot be written.
pub fn write_frame(stem: &Path, view: &FrameView<'_>) -> Result<(), FolderError> {
    let (width, height) = (view.header.width, view.header.height);
    let file = |kind: &str| PathBuf::from(format!("{}-{kind}.png", stem.display()));
    if !view.rgb.is_empty() {
        let path = file("rgb");
        write_atomic(&path, &encode(&path, Kind::Rgb8, width, height, view.rgb)?)?;
    }
    let path = file("depth");
    let depth: Vec<u8> = view.depth_units_vec().into_iter().flat_map(u16::to_be_bytes).collect();
    write_atomic(&path, &encode(&path, Kind::Grey16, width, height, &depth)?)
}

pub(super) fn damaged(path: &Path, field: &str, found: &str, expected: &str) -> FolderError {
    FolderError::Damaged {
        path: path.to_owned(),
        field: field.to_owned(),
        found: found.to_owned(),
        expected: expected.to_owned(),
    }
}
