//! Images in memory: compact, at training size, with what masks, alpha channels and depth say of their pixels.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use image::{DynamicImage, ImageDecoder as _, ImageReader, Limits};
use splatting::bytes::checksum;
use splatting::rgbd::clip_box::ClipBox;
use splatting::rgbd::{downsample, masks};
use splatting::{Camera, PixelClass, TrainingView, ViewError};

use super::{DepthFile, Entry, MAX_SIDE_PX, camera_of};
use crate::error::DatasetError;

/// Bytes that decoding one image may take.
const DECODE_BYTES: u64 = 4 << 30;

/// What pixels that a mask or an alpha channel leaves out are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MaskUse {
    /// Nothing is known of pixels outside of a mask file; nothing is there where an alpha channel is transparent.
    Auto,
    /// Nothing is known of them: they have no part in the loss.
    Ignore,
    /// Nothing is there: the model must be transparent.
    Empty,
    /// Masks, alpha channels and a mission's box are left unused: every pixel counts.
    Off,
}

/// Colours, row by row, sRGB.
#[derive(Debug, Clone, PartialEq)]
pub enum Colors {
    /// As in the file.
    Bytes(Vec<[u8; 3]>),
    /// Means of several pixels, of which 65535 is 1.
    Words(Vec<[u16; 3]>),
}

impl Colors {
    /// Number of pixels.
    #[must_use]
    pub fn len(&self) -> usize {
        match self {
            Self::Bytes(pixels) => pixels.len(),
            Self::Words(pixels) => pixels.len(),
        }
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The colours in [0, 1].
    #[must_use]
    pub fn to_f32(&self) -> Vec<[f32; 3]> {
        match self {
            Self::Bytes(pixels) => pixels.iter().map(|p| p.map(|v| f32::from(v) / 255.0)).collect(),
            Self::Words(pixels) => pixels.iter().map(|p| p.map(|v| f32::from(v) / 65535.0)).collect(),
        }
    }
}

/// An image of a dataset, at training size.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    /// Its name.
    pub name: String,
    /// Its camera, at this size.
    pub camera: Camera,
    /// Its colours.
    pub colors: Colors,
    /// Centre z of each pixel, metres; 0 = no measurement.
    pub depth_m: Option<Vec<f32>>,
    /// What each pixel shows; without them, every pixel counts.
    pub classes: Option<Vec<PixelClass>>,
    /// Whether the dataset itself holds it out.
    pub held_out: Option<bool>,
}

impl Image {
    /// Bytes that it takes.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        let colors = match &self.colors {
            Colors::Bytes(pixels) => size_of_val(&pixels[..]),
            Colors::Words(pixels) => size_of_val(&pixels[..]),
        };
        let depth = self.depth_m.as_ref().map_or(0, |depth| size_of_val(&depth[..]));
        (colors + depth + self.classes.as_ref().map_or(0, Vec::len)) as u64
    }

    /// Checksum of everything in it.
    pub(crate) fn fingerprint(&self) -> u64 {
        let mut bytes = Vec::with_capacity(self.colors.len() * 8);
        match &self.colors {
            Colors::Bytes(pixels) => bytes.extend(pixels.iter().flatten()),
            Colors::Words(pixels) => bytes.extend(pixels.iter().flatten().flat_map(|value| value.to_le_bytes())),
        }
        bytes.extend(self.depth_m.iter().flatten().flat_map(|depth| depth.to_le_bytes()));
        bytes.extend(self.classes.iter().flatten().map(|class| *class as u8));
        bytes.extend(format!("{:?} {:?} {:?}", self.name, self.camera, self.held_out).bytes());
        checksum(&bytes)
    }

    /// The image as the loss wants it.
    ///
    /// # Errors
    /// Where the renderer refuses the camera.
    pub fn training_view(&self) -> Result<TrainingView, ViewError> {
        let colors = self.colors.to_f32();
        let no_depth;
        let depth = match &self.depth_m {
            Some(depth) => depth,
            None => {
                no_depth = vec![0.0; colors.len()];
                &no_depth
            }
        };
        match &self.classes {
            Some(classes) => TrainingView::new(self.camera, &colors, depth, classes),
            None => TrainingView::full_image(self.camera, &colors, depth),
        }
    }

    /// The image with depth, as insertion wants it; `None` without depth.
    #[must_use]
    pub fn with_depth(&self) -> Option<downsample::SmallImage> {
        Some(downsample::SmallImage {
            width: self.camera.width,
            height: self.camera.height,
            rgb: self.colors.to_f32(),
            depth_m: self.depth_m.clone()?,
        })
    }

    /// Which pixels count; `None`: all.
    #[must_use]
    pub fn foreground(&self) -> Option<Vec<bool>> {
        Some(self.classes.as_ref()?.iter().map(|class| *class == PixelClass::Foreground).collect())
    }
}

/// Size of an image, from its header.
///
/// # Errors
/// Where the file is missing, is no image, or is too large.
pub(crate) fn dimensions(path: &Path, way_out: &str) -> Result<(u32, u32), DatasetError> {
    let reader = open(path, way_out)?;
    let (width, height) = reader.into_dimensions().map_err(|error| unreadable(path, &error))?;
    if width == 0 || height == 0 || width > MAX_SIDE_PX || height > MAX_SIDE_PX {
        let expected = format!("1 to {MAX_SIDE_PX} pixels a side");
        return Err(DatasetError::damaged(path, "size", format!("{width} x {height}"), expected));
    }
    Ok((width, height))
}

fn open(path: &Path, way_out: &str) -> Result<ImageReader<BufReader<File>>, DatasetError> {
    let read = |source| DatasetError::read(path, source, way_out);
    let file = File::open(path).map_err(read)?;
    if file.metadata().map_err(read)?.is_dir() {
        return Err(DatasetError::damaged(path, "the image", "a folder", "a PNG or JPEG file"));
    }
    ImageReader::new(BufReader::new(file)).with_guessed_format().map_err(read)
}

fn unreadable(path: &Path, error: &image::ImageError) -> DatasetError {
    DatasetError::damaged(path, "the image", format!("not readable ({error})"), "a whole PNG or JPEG file")
}

fn decode(path: &Path) -> Result<DynamicImage, DatasetError> {
    let mut decoder = open(path, "the dataset names it")?.into_decoder().map_err(|error| unreadable(path, &error))?;
    let mut limits = Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(MAX_SIDE_PX), Some(MAX_SIDE_PX));
    limits.max_alloc = Some(DECODE_BYTES);
    decoder.set_limits(limits).map_err(|error| unreadable(path, &error))?;
    DynamicImage::from_decoder(decoder).map_err(|error| unreadable(path, &error))
}

fn check_size(path: &Path, found: (u32, u32), entry: &Entry) -> Result<(), DatasetError> {
    let (width, height) = (entry.intrinsics.width, entry.intrinsics.height);
    if found == (width, height) {
        return Ok(());
    }
    let expected = format!("{width} x {height} as its camera says");
    Err(DatasetError::damaged(path, "size", format!("{} x {}", found.0, found.1), expected))
}

/// Brings an image into memory. `clip` is a mission's box, against which its pixels are told apart by their depth.
///
/// # Errors
/// [`DatasetError`] naming the file.
pub(crate) fn load(
    entry: &Entry,
    downscale: u32,
    mask: MaskUse,
    clip: Option<&ClipBox>,
) -> Result<Image, DatasetError> {
    let decoded = decode(&entry.path)?;
    check_size(&entry.path, (decoded.width(), decoded.height()), entry)?;
    let (width, height) = (decoded.width(), decoded.height());
    let camera = camera_of(&entry.world_from_camera, &entry.intrinsics, downscale);
    if !camera.is_valid() {
        let found = format!("{}x{} pixels", camera.width, camera.height);
        return Err(DatasetError::damaged(&entry.path, format!("size at 1/{downscale}"), found, "at least one pixel"));
    }
    let (rgb, alpha) = split_alpha(decoded);
    let depth = match &entry.depth {
        Some(file) => load_depth(file, entry)?,
        None => vec![0.0; width as usize * height as usize],
    };
    let small = downsample::downsample(width, height, &rgb, &depth, downscale)
        .map_err(|error| DatasetError::damaged(&entry.path, "pixels", error.to_string(), "as many as its size says"))?;
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "in range: means of bytes over 255")]
    let colors = if downscale > 1 {
        Colors::Words(small.rgb.iter().map(|p| p.map(|v| (v * 65535.0 + 0.5) as u16)).collect())
    } else {
        Colors::Bytes(small.rgb.iter().map(|p| p.map(|v| (v * 255.0 + 0.5) as u8)).collect())
    };
    let classes = match (mask, clip) {
        (MaskUse::Off, _) => None,
        (_, Some(clip)) => Some(masks::classify(&camera, &small.depth_m, clip)),
        (_, None) => classes_of(entry, alpha.as_deref(), downscale, mask)?,
    };
    let depth_m = entry.depth.is_some().then_some(small.depth_m);
    Ok(Image { name: entry.name.clone(), camera, colors, depth_m, classes, held_out: entry.held_out })
}

/// Colours, and the alpha channel where it is not opaque all over.
fn split_alpha(decoded: DynamicImage) -> (Vec<u8>, Option<Vec<u8>>) {
    if !decoded.color().has_alpha() {
        return (decoded.into_rgb8().into_raw(), None);
    }
    let rgba = decoded.into_rgba8().into_raw();
    let alpha: Vec<u8> = rgba.chunks_exact(4).map(|pixel| pixel[3]).collect();
    let rgb = rgba.chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
    (rgb, alpha.iter().any(|&a| a < 255).then_some(alpha))
}

/// Depth in metres at the file's size.
fn load_depth(file: &DepthFile, entry: &Entry) -> Result<Vec<f32>, DatasetError> {
    let decoded = decode(&file.path)?;
    check_size(&file.path, (decoded.width(), decoded.height()), entry)?;
    let DynamicImage::ImageLuma16(image) = decoded else {
        let found = format!("{:?}", decoded.color());
        return Err(DatasetError::damaged(&file.path, "pixel format", found, "16-bit grey"));
    };
    #[expect(clippy::cast_possible_truncation, reason = "depth is kept as f32 metres inside programs")]
    let unit = file.unit_m as f32;
    Ok(image.into_raw().into_iter().map(|units| f32::from(units) * unit).collect())
}

/// Classes by a mask file and an alpha channel; `None` where neither says anything.
fn classes_of(
    entry: &Entry,
    alpha: Option<&[u8]>,
    downscale: u32,
    mask: MaskUse,
) -> Result<Option<Vec<PixelClass>>, DatasetError> {
    let outside_alpha = if mask == MaskUse::Ignore { PixelClass::Ignored } else { PixelClass::Free };
    let outside_mask = if mask == MaskUse::Empty { PixelClass::Free } else { PixelClass::Ignored };
    let (width, height) = (entry.intrinsics.width, entry.intrinsics.height);
    let mut classes: Option<Vec<PixelClass>> = None;
    if let Some(alpha) = alpha {
        let inside = mostly_white(alpha, width, height, downscale);
        let class = |inside: bool| if inside { PixelClass::Foreground } else { outside_alpha };
        classes = Some(inside.into_iter().map(class).collect());
    }
    if let Some(path) = &entry.mask {
        let decoded = decode(path)?;
        let found = (decoded.width(), decoded.height());
        if !is_enlarged(found, (width, height)) {
            let expected = format!(
                "{width} x {height} as its image has, or that enlarged with the same ratio of the sides: make the mask \
                 anew at that size, or give --mask off"
            );
            return Err(DatasetError::damaged(path, "size", format!("{} x {}", found.0, found.1), expected));
        }
        let values = box_mean(&decoded.into_luma8().into_raw(), found, (width, height));
        let inside = mostly_white(&values, width, height, downscale);
        let classes = classes.get_or_insert_with(|| vec![PixelClass::Foreground; inside.len()]);
        for (class, inside) in classes.iter_mut().zip(inside) {
            if !inside {
                *class = outside_mask;
            }
        }
    }
    Ok(classes)
}

/// Whether a mask shows what an image of a size shows, at that size or a larger one, up to the rounding of a pixel: masks are
/// often kept beside the original images only, of which `images_2` holds the halves.
fn is_enlarged(mask: (u32, u32), image: (u32, u32)) -> bool {
    let [x, y] = [(mask.0, image.0), (mask.1, image.1)].map(|(from, to)| f64::from(from) / f64::from(to));
    let off_px = ((x / y - 1.0) * f64::from(image.0)).abs().min(((y / x - 1.0) * f64::from(image.1)).abs());
    // A mask that is a pixel larger belongs to another image.
    mask == image || (x.min(y) >= 1.25 && off_px <= 1.0)
}

/// Values shrunk to a size: means over the pixels that lie in each of its own.
fn box_mean(values: &[u8], (from_w, from_h): (u32, u32), (width, height): (u32, u32)) -> Vec<u8> {
    if (from_w, from_h) == (width, height) {
        return values.to_vec();
    }
    // Whole pixels, at least one, beginning where the small pixel begins.
    let span = |at: u32, from: u32, to: u32| {
        let edge = |at: u32| (u64::from(at) * u64::from(from) / u64::from(to)) as usize;
        edge(at)..edge(at + 1).max(edge(at) + 1)
    };
    let mut small = Vec::with_capacity(width as usize * height as usize);
    for row in 0..height {
        let rows = span(row, from_h, height);
        for column in 0..width {
            let columns = span(column, from_w, width);
            let pixels = rows.clone().flat_map(|y| &values[y * from_w as usize..][columns.clone()]);
            let sum: u64 = pixels.map(|&value| u64::from(value)).sum();
            let count = (rows.len() * columns.len()) as u64;
            small.push(u8::try_from((sum + count / 2) / count).unwrap_or(u8::MAX));
        }
    }
    small
}

/// Whether the mean of each box of pixels is at least half of white.
fn mostly_white(values: &[u8], width: u32, height: u32, downscale: u32) -> Vec<bool> {
    let (w, k) = (width as usize, downscale.max(1) as usize);
    let (small_w, small_h) = (w / k, height as usize / k);
    let mut inside = Vec::with_capacity(small_w * small_h);
    for row in 0..small_h {
        for column in 0..small_w {
            let rows = (row * k..(row + 1) * k).flat_map(|y| &values[y * w + column * k..y * w + (column + 1) * k]);
            inside.push(rows.map(|&v| u64::from(v)).sum::<u64>() * 2 >= 255 * (k * k) as u64);
        }
    }
    inside
}
