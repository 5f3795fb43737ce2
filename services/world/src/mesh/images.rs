//! Textures of meshes. One that is missing or broken costs a warning, not the mission.

use std::path::Path;

use image::ImageReader;

use super::Material;
use crate::texture::Texture;

/// Larger images are refused: the decoded image and its mip chain would not fit beside the other processes.
const MAX_SIDE_PX: u32 = 8192;

/// Larger files beside a mesh are refused.
const MAX_FILE_BYTES: u64 = 1 << 30;

/// Whether a file that a mesh names may be read: a mesh of somebody else may name a device or a pipe, which has no end.
pub(super) fn check_beside(file: &Path) -> std::io::Result<()> {
    let known = std::fs::metadata(file)?;
    if known.is_file() && known.len() <= MAX_FILE_BYTES {
        return Ok(());
    }
    let found = format!("a file of 1 GiB at most was expected, not a folder, a device or {} bytes", known.len());
    Err(std::io::Error::new(std::io::ErrorKind::InvalidInput, found))
}

/// The texture in a file, or the procedural albedo with a warning.
pub(super) fn from_file(mesh: &Path, file: &Path) -> Material {
    match check_beside(file).and_then(|()| std::fs::read(file)) {
        Ok(bytes) => from_bytes(mesh, &file.display().to_string(), &bytes),
        Err(error) => {
            tracing::warn!(mesh = %mesh.display(), texture = %file.display(), %error, "texture cannot be read; the object gets a procedural albedo");
            Material::Procedural
        }
    }
}

/// The texture in encoded bytes (PNG or JPEG), or the procedural albedo with a warning.
pub(super) fn from_bytes(mesh: &Path, name: &str, bytes: &[u8]) -> Material {
    match decode(bytes) {
        Ok(texture) => Material::Texture(texture),
        Err(error) => {
            tracing::warn!(mesh = %mesh.display(), texture = name, error, "texture cannot be decoded (PNG or JPEG expected); the object gets a procedural albedo");
            Material::Procedural
        }
    }
}

fn decode(bytes: &[u8]) -> Result<Texture, String> {
    let mut reader =
        ImageReader::new(std::io::Cursor::new(bytes)).with_guessed_format().map_err(|error| error.to_string())?;
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(MAX_SIDE_PX);
    limits.max_image_height = Some(MAX_SIDE_PX);
    reader.limits(limits);
    let image = reader.decode().map_err(|error| error.to_string())?.into_rgb8();
    let (width, height) = (image.width() as usize, image.height() as usize);
    Texture::new(width, height, image.as_raw()).ok_or_else(|| format!("an image of {width}x{height} pixels"))
}
