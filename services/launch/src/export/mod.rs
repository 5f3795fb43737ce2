//! A mission folder for other people's tools: COLMAP, nerfstudio, and the model in every format of
//! [`splatting::formats`].
//!
//! [`export`] does it for a mission, [`export_model`] for a model file of any of these formats. What is written is a folder
//! for COLMAP and nerfstudio, a file for models. Every file appears whole; the images are the keyframes' own files, copied.

use std::path::{Path, PathBuf};

use glam::DVec3;
use shared_types::folder::{FolderError, Keyframe, MissionFolder, write_atomic};
use shared_types::frames::Intrinsics;
use splatting::rgbd::{clip_box::ClipBox, masks};
use splatting::{PixelClass, RenderSettings, formats};

use crate::evaluate::views::camera_of;

pub mod colmap;
pub mod nerfstudio;

/// Points taken from the depth of each keyframe, about.
const POINTS_PER_VIEW: f64 = 2_000.0;

/// What a mission can be exported as.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// `images/`, `masks/` and `sparse/0/` with cameras, images and points3D, as text and as binary.
    Colmap,
    /// `images/`, `masks/`, `depth/`, `points.ply` and `transforms.json`.
    Nerfstudio,
    /// The final model as one file.
    Model(formats::Format),
}

/// What was written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Summary {
    /// Keyframes exported.
    pub views: usize,
    /// Points exported.
    pub points: usize,
    /// Masks of the object exported.
    pub masks: usize,
    /// Gaussians exported.
    pub gaussians: usize,
    /// Degree of the model's spherical harmonics, where the format has none above 0 and they were lost.
    pub lost_sh_degree: Option<u8>,
}

/// Why an export failed.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The mission folder could not be read, or the result not be written.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// A file could not be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file is no whole model.
    #[error("{path}: {source}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: formats::ReadError,
    },
    /// The model does not fit in the format.
    #[error("cannot write {path}: {source}")]
    Unfit {
        /// The file that was to be written.
        path: PathBuf,
        /// What does not fit.
        source: formats::WriteError,
    },
    /// The box around the object could not be read.
    #[error(transparent)]
    Prior(#[from] reconstruct::error::DatasetError),
    /// A mask cannot be encoded.
    #[error("the mask of keyframe {id} cannot be encoded: {source}")]
    Picture {
        /// The keyframe.
        id: u64,
        /// The encoder's reason.
        source: png::EncodingError,
    },
    /// A file whose name is that of no model.
    #[error(
        "{path} is no model file by its name: expected one that ends with .ply, .splat, .spz or .glb, or a mission folder"
    )]
    NotAModel {
        /// The file.
        path: PathBuf,
    },
    /// The export would replace what it is made from.
    #[error("{path} is the model itself: give another file with --output, or another --format")]
    Itself {
        /// The file.
        path: PathBuf,
    },
    /// There is nothing to export.
    #[error("{path} does not exist: {way_out}")]
    Missing {
        /// What is missing.
        path: PathBuf,
        /// What to do.
        way_out: &'static str,
    },
}

/// A coloured point in the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Position, metres.
    pub position_m: DVec3,
    /// sRGB.
    pub rgb: [u8; 3],
}

/// Exports a mission.
///
/// # Errors
/// When the mission holds nothing of the kind, a file is damaged, or the result cannot be written.
pub fn export(folder: &MissionFolder, format: Format, out: &Path) -> Result<Summary, ExportError> {
    if let Format::Model(format) = format {
        let path = folder.model_path().join("model.ply");
        if !path.is_file() {
            let way_out = "finish the mission first with `vantage resume`";
            return Err(ExportError::Missing { path, way_out });
        }
        return export_model(&path, format, out);
    }
    let mut views = Vec::new();
    let mut points = Vec::new();
    let clip = reconstruct::dataset::mission::clip_box(folder)?;
    for id in folder.list_keyframes()? {
        let Some(keyframe) = folder.read_keyframe(id)? else { continue };
        points.extend(points_of(&keyframe));
        let source = folder.keyframe_path(id);
        let name = format!("{id:06}.png");
        write_atomic(&out.join("images").join(&name), &read(&source.join("rgb.png"))?)?;
        if format == Format::Nerfstudio {
            write_atomic(&out.join("depth").join(&name), &read(&source.join("depth.png"))?)?;
        }
        if let Some(clip) = &clip {
            let size = (keyframe.frame.intrinsics.width, keyframe.frame.intrinsics.height);
            let png =
                gray_png(&mask_of(&keyframe, clip), size).map_err(|source| ExportError::Picture { id, source })?;
            // COLMAP's name for the mask of an image, which nerfstudio is told.
            write_atomic(&out.join("masks").join(format!("{name}.png")), &png)?;
        }
        views.push(keyframe.frame);
    }
    if views.is_empty() {
        let way_out = "the mission took no keyframes; fly it on with `vantage resume`";
        return Err(ExportError::Missing { path: folder.keyframes_path(), way_out });
    }
    match format {
        Format::Colmap => colmap::write(out, &views, &points)?,
        Format::Nerfstudio => nerfstudio::write(out, &views, &points, clip.is_some())?,
        Format::Model(_) => {}
    }
    let masks = if clip.is_some() { views.len() } else { 0 };
    Ok(Summary { views: views.len(), points: points.len(), masks, ..Summary::default() })
}

/// White where a keyframe measured something inside of the object's box, as in training (A31).
fn mask_of(keyframe: &Keyframe, clip: &ClipBox) -> Vec<u8> {
    let camera = camera_of(&keyframe.frame.world_from_camera(), &keyframe.frame.intrinsics);
    #[expect(clippy::cast_possible_truncation, reason = "metres fit f32 to a fraction of a millimetre")]
    let depth_m: Vec<f32> =
        keyframe.depth_units.iter().map(|&units| (f64::from(units) * keyframe.frame.depth_unit_m) as f32).collect();
    let classes = masks::classify(&camera, &depth_m, clip);
    classes.into_iter().map(|class| if class == PixelClass::Foreground { u8::MAX } else { 0 }).collect()
}

fn gray_png(pixels: &[u8], (width, height): (u32, u32)) -> Result<Vec<u8>, png::EncodingError> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.write_header()?.write_image_data(pixels)?;
    Ok(bytes)
}

/// Writes a model file in another format; in its own format it is copied, once it has been read as whole.
///
/// # Errors
/// When the file is no whole model, the model does not fit in the format, or the result cannot be written.
pub fn export_model(source: &Path, format: formats::Format, out: &Path) -> Result<Summary, ExportError> {
    let from = formats::Format::of_path(source).ok_or_else(|| ExportError::NotAModel { path: source.to_owned() })?;
    let same = |a: &Path, b: &Path| a.canonicalize().ok().is_some_and(|a| b.canonicalize().is_ok_and(|b| a == b));
    if same(source, out) {
        return Err(ExportError::Itself { path: source.to_owned() });
    }
    let bytes = read(source)?;
    let model =
        formats::read(from, &bytes).map_err(|error| ExportError::Damaged { path: source.to_owned(), source: error })?;
    let lost = format == formats::Format::Splat && model.sh_degree() > 0;
    let summary =
        Summary { gaussians: model.len(), lost_sh_degree: lost.then_some(model.sh_degree()), ..Summary::default() };
    if from == format {
        write_atomic(out, &bytes)?;
        return Ok(summary);
    }
    // Ours are trained so; of others' it is not known, and the original code does not.
    let antialiased = is_ours(&bytes) && RenderSettings::default().opacity_compensation;
    let mut written = Vec::new();
    formats::write(format, &model, antialiased, &mut written)
        .map_err(|error| ExportError::Unfit { path: out.to_owned(), source: error })?;
    write_atomic(out, &written)?;
    Ok(summary)
}

/// Whether a PLY's header says that Vantage wrote it.
fn is_ours(bytes: &[u8]) -> bool {
    const MARK: &[u8] = b"\ncomment Vantage";
    bytes.starts_with(b"ply\n") && bytes[..bytes.len().min(200)].windows(MARK.len()).any(|window| window == MARK)
}

/// Points of a keyframe's depth in the world, on a regular grid of pixels.
fn points_of(keyframe: &Keyframe) -> Vec<Point> {
    let (camera, pose) = (keyframe.frame.intrinsics, keyframe.frame.world_from_camera());
    let pixels = f64::from(camera.width) * f64::from(camera.height);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "at least 1 and at most a side")]
    let stride = (pixels / POINTS_PER_VIEW).sqrt().ceil().max(1.0) as usize;
    let mut points = Vec::new();
    for row in (0..camera.height).step_by(stride) {
        for column in (0..camera.width).step_by(stride) {
            let index = (row * camera.width + column) as usize;
            let units = keyframe.depth_units.get(index).copied().unwrap_or(0);
            let rgb = keyframe.rgb.get(index * 3..index * 3 + 3).and_then(|rgb| rgb.try_into().ok());
            if let (1.., Some(rgb)) = (units, rgb) {
                let depth_m = f64::from(units) * keyframe.frame.depth_unit_m;
                let position_m =
                    pose.transform_point(camera.backproject(Intrinsics::pixel_center(column, row), depth_m));
                points.push(Point { position_m, rgb });
            }
        }
    }
    points
}

fn read(path: &Path) -> Result<Vec<u8>, ExportError> {
    std::fs::read(path).map_err(|source| ExportError::Read { path: path.to_owned(), source })
}

#[cfg(test)]
mod tests;
