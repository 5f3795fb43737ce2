//! Datasets: posed images, and what else is known of the scene, whatever format they come in.
//!
//! Reading goes in two steps. A format's module makes a [`Listing`]: names, cameras, files, sparse points; cheap, and wrong
//! input is found here. [`load`] then decodes the images at training size into compact [`Image`]s.
//!
//! Cameras are the library's: optical axes (x right, y down, z forward), the centre of pixel (0, 0) at (0.5, 0.5).

pub mod colmap;
pub mod image;
pub mod mission;
pub mod nerfstudio;
pub mod point_cloud;

use std::path::{Path, PathBuf};

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use shared_types::config::TrainerConfig;
use shared_types::frames::{Intrinsics, Pose};
use splatting::bytes::checksum;
use splatting::rgbd::clip_box::ClipBox;
use splatting::{Camera, PixelClass};

use crate::error::DatasetError;
pub use image::{Colors, Image, MaskUse};

/// Longest side of an image that is read, pixels.
pub const MAX_SIDE_PX: u32 = 16_384;
/// Images are shrunk by default until none is wider than this, as 3DGS does.
pub const DEFAULT_WIDTH_PX: u32 = 1_600;

/// Where a dataset comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// A mission folder of Vantage.
    Mission,
    /// A COLMAP sparse model with its images.
    Colmap,
    /// A `transforms.json`, or NeRF-synthetic's `transforms_train.json` and `transforms_test.json`.
    Nerfstudio,
}

impl Format {
    /// Its name in messages.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Mission => "mission",
            Self::Colmap => "COLMAP",
            Self::Nerfstudio => "nerfstudio",
        }
    }
}

/// A coloured point of the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Position in the world.
    pub position: DVec3,
    /// sRGB.
    pub rgb: [u8; 3],
}

/// A depth image.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthFile {
    /// 16-bit grey PNG of centre z; 0 = no measurement.
    pub path: PathBuf,
    /// Metres a unit.
    pub unit_m: f64,
}

/// An image as listed, not yet decoded.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// Name within the dataset; images are ordered by it.
    pub name: String,
    /// The image.
    pub path: PathBuf,
    /// Pose of the camera.
    pub world_from_camera: Pose,
    /// The camera, at the file's size.
    pub intrinsics: Intrinsics,
    /// Depth, where there is one.
    pub depth: Option<DepthFile>,
    /// Mask, where there is one: black pixels do not count.
    pub mask: Option<PathBuf>,
    /// Whether the dataset itself holds the image out (NeRF-synthetic's test views); `None`: it does not say.
    pub held_out: Option<bool>,
}

/// What is known of the part of the world that the model may fill, of a mission.
#[derive(Debug, Clone, PartialEq)]
pub struct Stage {
    /// The clip box.
    pub clip: ClipBox,
    /// Edge of the prior's cube (B), metres.
    pub box_size_m: f64,
    /// Radius of the candidate sphere (R), metres.
    pub radius_m: f64,
    /// How it was trained on in flight.
    pub trainer: TrainerConfig,
}

/// A dataset as listed: everything but pixels.
#[derive(Debug, Clone)]
pub struct Listing {
    /// Its folder.
    pub root: PathBuf,
    /// Its format.
    pub format: Format,
    /// Images, in the order of their names.
    pub entries: Vec<Entry>,
    /// Sparse points; may be empty.
    pub points: Vec<Point>,
    /// Up in the world, unit length.
    pub up: Vec3,
    /// What a mission knows of its object.
    pub stage: Option<Stage>,
    /// Factor by which images are shrunk unless the user says otherwise.
    pub downscale: u32,
}

/// A dataset in memory.
#[derive(Debug)]
pub struct Dataset {
    /// Its format.
    pub format: Format,
    /// Images, in the order of their names.
    pub images: Vec<Image>,
    /// Sparse points; may be empty.
    pub points: Vec<Point>,
    /// Up in the world, unit length.
    pub up: Vec3,
    /// What a mission knows of its object.
    pub stage: Option<Stage>,
    /// Factor by which the images were shrunk.
    pub downscale: u32,
}

impl Dataset {
    /// Bytes that the images take.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.images.iter().map(Image::bytes).sum()
    }

    /// Checksum of everything that training reads: names, cameras, pixels, depth, classes, points.
    #[must_use]
    pub fn fingerprint(&self) -> u64 {
        let images: Vec<u64> = self.images.par_iter().map(Image::fingerprint).collect();
        let mut bytes: Vec<u8> = images.iter().flat_map(|sum| sum.to_le_bytes()).collect();
        for point in &self.points {
            bytes.extend(point.position.to_array().iter().flat_map(|value| value.to_le_bytes()));
            bytes.extend(point.rgb);
        }
        if let Some(stage) = &self.stage {
            bytes.extend(format!("{stage:?}").bytes());
        }
        checksum(&bytes)
    }

    /// Whether any image has depth.
    #[must_use]
    pub fn has_depth(&self) -> bool {
        self.images.iter().any(|image| image.depth_m.is_some())
    }
}

/// Lists the dataset in a folder, whatever format it has. `images` names the folder of a COLMAP dataset's images.
///
/// # Errors
/// [`DatasetError`]: the folder is no dataset, or what is wrong with it.
pub fn list(root: &Path, images: Option<&str>) -> Result<Listing, DatasetError> {
    let mut listing = if root.join("mission.toml").is_file() || root.join("keyframes").is_dir() {
        mission::list(root)?
    } else if nerfstudio::is_dataset(root) {
        nerfstudio::list(root)?
    } else if let Some(sparse) = colmap::sparse_folder(root) {
        colmap::list(root, &sparse, images)?
    } else {
        return Err(DatasetError::Unknown { root: root.to_owned() });
    };
    if images.is_some() && listing.format != Format::Colmap {
        let expected = format!("no --images: a {} dataset names its images itself", listing.format.name());
        return Err(DatasetError::damaged(root, "--images", images.unwrap_or_default(), expected));
    }
    listing.entries.sort_by(|a, b| a.name.cmp(&b.name));
    if let Some(pair) = listing.entries.windows(2).find(|pair| pair[0].name == pair[1].name) {
        let expected = "every image once: remove one of the two entries";
        return Err(DatasetError::damaged(root, "an image's name", format!("twice {:?}", pair[0].name), expected));
    }
    if listing.entries.is_empty() {
        return Err(DatasetError::TooFew { root: root.to_owned(), images: 0, training: 0, hold_out: 0 });
    }
    Ok(listing)
}

/// How images are brought into memory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoadOptions {
    /// Factor by which images are shrunk; `None`: the dataset's default.
    pub downscale: Option<u32>,
    /// What masks and alpha channels mean.
    pub mask: MaskUse,
    /// Bytes that the images may take.
    pub memory_bytes: u64,
}

/// Decodes all images of a listing, in parallel.
///
/// # Errors
/// [`DatasetError`] naming the image and what is wrong with it, or that the images do not fit the memory.
pub fn load(listing: &Listing, options: &LoadOptions) -> Result<Dataset, DatasetError> {
    let downscale = options.downscale.unwrap_or(listing.downscale).max(1);
    check_memory(listing, downscale, options.memory_bytes)?;
    let clip = listing.stage.as_ref().map(|stage| stage.clip);
    // Decoders hold a whole image each: a bounded number at a time is what the pool's threads give.
    let images = listing
        .entries
        .par_iter()
        .map(|entry| image::load(entry, downscale, options.mask, clip.as_ref()))
        .collect::<Result<Vec<_>, _>>()?;
    Ok(Dataset {
        format: listing.format,
        images,
        points: listing.points.clone(),
        up: listing.up,
        stage: listing.stage.clone(),
        downscale,
    })
}

/// Refuses images to train on of which no pixel counts: the model would learn nothing, and no figure would say so.
///
/// # Errors
/// [`DatasetError::NothingCounts`].
pub fn check_counts(listing: &Listing, dataset: &Dataset, training: &[usize]) -> Result<(), DatasetError> {
    let counts = |image: &Image| image.classes.as_ref().is_none_or(|classes| classes.contains(&PixelClass::Foreground));
    let mut images = training.iter().filter_map(|&index| dataset.images.get(index));
    let Some(entry) = training.first().and_then(|&index| listing.entries.get(index)) else { return Ok(()) };
    if images.any(counts) {
        return Ok(());
    }
    let (path, what) = match (&entry.mask, &entry.depth) {
        (Some(mask), _) => (mask, "a mask"),
        (None, Some(depth)) if dataset.stage.is_some() => (&depth.path, "a depth image"),
        (None, _) => (&entry.path, "an image"),
    };
    Err(DatasetError::NothingCounts { path: path.clone(), what, images: training.len() })
}

/// Bytes that the images of a listing take at most, shrunk by `downscale`.
#[must_use]
pub fn estimate_bytes(listing: &Listing, downscale: u32) -> u64 {
    let color = if downscale > 1 { 6 } else { 3 };
    listing
        .entries
        .iter()
        .map(|entry| {
            let small = entry.intrinsics.downsampled(downscale);
            let depth = if entry.depth.is_some() { 4 } else { 0 };
            u64::from(small.width) * u64::from(small.height) * (color + depth + 1)
        })
        .sum()
}

fn check_memory(listing: &Listing, downscale: u32, limit: u64) -> Result<(), DatasetError> {
    let need = estimate_bytes(listing, downscale);
    if need <= limit {
        return Ok(());
    }
    let fits = (downscale + 1..64).find(|factor| estimate_bytes(listing, *factor) <= limit);
    Err(DatasetError::Memory {
        root: listing.root.clone(),
        images: listing.entries.len(),
        need_mb: need.div_ceil(1_000_000),
        limit_mb: limit / 1_000_000,
        downscale: fits.unwrap_or(64),
    })
}

/// The factor at which no image is wider than [`DEFAULT_WIDTH_PX`].
pub(crate) fn default_downscale(entries: &[Entry]) -> u32 {
    entries.iter().map(|entry| entry.intrinsics.width).max().unwrap_or(1).div_ceil(DEFAULT_WIDTH_PX).max(1)
}

/// The library's camera for a pose and a pinhole camera, shrunk by `downscale`.
#[must_use]
pub fn camera_of(world_from_camera: &Pose, intrinsics: &Intrinsics, downscale: u32) -> Camera {
    let small = intrinsics.downsampled(downscale);
    #[expect(clippy::cast_possible_truncation, reason = "the renderer works in f32")]
    let [fx, fy, cx, cy] = [small.fx, small.fy, small.cx, small.cy].map(|value| value as f32);
    Camera {
        world_from_camera: splatting::Pose {
            rotation: world_from_camera.rotation.as_quat().normalize(),
            translation: world_from_camera.position_m.as_vec3(),
        },
        fx,
        fy,
        cx,
        cy,
        width: small.width,
        height: small.height,
    }
}

/// Up, where a dataset does not say: against the mean of the images' down axes.
pub(crate) fn up_of(entries: &[Entry]) -> Vec3 {
    let down: DVec3 = entries.iter().map(|entry| entry.world_from_camera.rotation * DVec3::Y).sum();
    (-down).try_normalize().unwrap_or(DVec3::Z).as_vec3()
}

/// Farthest that a camera may be from the origin along an axis: the renderer's f32 is then worth 6 cm.
pub(crate) const MAX_POSITION: f64 = 1e6;
/// Metres a unit of depth that make sense: from micrometres to metres.
const DEPTH_UNITS_M: std::ops::RangeInclusive<f64> = 1e-6..=1.0;

/// Checks a position; the error says what is expected.
pub(crate) fn check_position(position: DVec3) -> Result<(), String> {
    let is_near = position.is_finite() && position.abs().max_element() <= MAX_POSITION;
    if is_near { Ok(()) } else { Err(format!("finite numbers from -{MAX_POSITION} to {MAX_POSITION}")) }
}

/// Checks metres a unit of depth; the error says what is expected.
pub(crate) fn check_depth_unit(unit_m: f64) -> Result<(), String> {
    let (least, most) = (DEPTH_UNITS_M.start(), DEPTH_UNITS_M.end());
    let expected = || format!("metres a unit of depth, {least:e} to {most}");
    if DEPTH_UNITS_M.contains(&unit_m) { Ok(()) } else { Err(expected()) }
}

/// Checks a pinhole camera; the error says which part of it is wrong. What is far out of an image's scale would overflow the
/// renderer's f32, and is a mistake long before.
pub(crate) fn check_intrinsics(camera: &Intrinsics) -> Result<(), (&'static str, String, String)> {
    let sides = 1..=MAX_SIDE_PX;
    if !sides.contains(&camera.width) || !sides.contains(&camera.height) {
        return Err(("size", format!("{} x {}", camera.width, camera.height), "1 to 16384 pixels a side".to_owned()));
    }
    let width = f64::from(camera.width);
    let focal = 1e-3 * width..=1e3 * width;
    if ![camera.fx, camera.fy].iter().all(|f| focal.contains(f)) {
        let expected = format!("{} to {} pixels (0.001 to 1000 times the width)", focal.start(), focal.end());
        return Err(("focal length", format!("{} and {}", camera.fx, camera.fy), expected));
    }
    for (center, side) in [(camera.cx, camera.width), (camera.cy, camera.height)] {
        let inside = -10.0 * width..=f64::from(side) + 10.0 * width;
        if !inside.contains(&center) {
            let expected = format!("{} to {} pixels (10 widths outside of the image)", inside.start(), inside.end());
            return Err(("principal point", format!("{} and {}", camera.cx, camera.cy), expected));
        }
    }
    Ok(())
}
