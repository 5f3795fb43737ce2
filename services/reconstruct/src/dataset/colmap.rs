//! COLMAP's sparse model: cameras, images and points3D, as binary or as text, and the images beside it.
//!
//! COLMAP's camera is ours (x right, y down, z forward; the centre of the first pixel is (0.5, 0.5)). Its images carry
//! `camera_from_world` with the quaternion as w, x, y, z. Formats as in <https://colmap.github.io/format.html>.

mod binary;
mod text;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::{DQuat, DVec3};
use shared_types::frames::{Intrinsics, Pose};

use super::{Entry, Format, Listing, Point, check_intrinsics, image::dimensions};
use crate::error::DatasetError;

/// A camera as COLMAP writes it.
#[derive(Debug, Clone, PartialEq)]
struct RawCamera {
    id: u32,
    model: String,
    width: u64,
    height: u64,
    params: Vec<f64>,
}

/// An image as COLMAP writes it.
#[derive(Debug, Clone, PartialEq)]
struct RawImage {
    /// w, x, y, z.
    rotation: [f64; 4],
    translation: [f64; 3],
    camera: u32,
    name: String,
}

/// Names, numbers and parameter counts of COLMAP's camera models.
const MODELS: [(&str, usize); 11] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
];

/// The folder of a COLMAP model: `sparse/0`, `sparse`, or the dataset's own. `None` where there is none.
#[must_use]
pub fn sparse_folder(root: &Path) -> Option<PathBuf> {
    [root.join("sparse").join("0"), root.join("sparse"), root.to_owned()]
        .into_iter()
        .find(|folder| folder.join("cameras.bin").is_file() || folder.join("cameras.txt").is_file())
}

/// Lists a COLMAP dataset: the model in `sparse`, the images in `images` under `root` (default `images`). With another
/// folder (`images_2`), cameras are scaled to the images' own size.
///
/// # Errors
/// [`DatasetError`] naming file, line and field.
pub fn list(root: &Path, sparse: &Path, images: Option<&str>) -> Result<Listing, DatasetError> {
    let binary = sparse.join("cameras.bin").is_file();
    let file = |stem: &str| sparse.join(format!("{stem}.{}", if binary { "bin" } else { "txt" }));
    let (raw_cameras, raw_images, points) = if binary {
        (binary::cameras(&file("cameras"))?, binary::images(&file("images"))?, binary::points(&file("points3D"))?)
    } else {
        (text::cameras(&file("cameras"))?, text::images(&file("images"))?, text::points(&file("points3D"))?)
    };
    let mut cameras: BTreeMap<u32, Intrinsics> = BTreeMap::new();
    for (line, camera) in raw_cameras {
        let known = pinhole(&file("cameras"), &camera).map_err(|error| match line {
            Some(line) => error.at_line(line),
            None => error,
        })?;
        cameras.insert(camera.id, known);
    }
    let folder = root.join(images.unwrap_or("images"));
    if !folder.is_dir() {
        let way_out = "it is the folder of the dataset's images; name another with --images".to_owned();
        return Err(DatasetError::Missing { path: folder, way_out });
    }
    let mut entries = Vec::with_capacity(raw_images.len());
    for (line, image) in raw_images {
        let entry = entry_of(root, &file("images"), &folder, &image, &cameras, images.is_some());
        entries.push(entry.map_err(|error| match line {
            Some(line) => error.at_line(line),
            None => error,
        })?);
    }
    let downscale = super::default_downscale(&entries);
    let up = super::up_of(&entries);
    Ok(Listing { root: root.to_owned(), format: Format::Colmap, entries, points, up, stage: None, downscale })
}

/// The pinhole camera of a COLMAP camera without distortion.
fn pinhole(path: &Path, camera: &RawCamera) -> Result<Intrinsics, DatasetError> {
    let field = |name: &str| format!("camera {}: {name}", camera.id);
    let Some((_, count)) = MODELS.iter().find(|(name, _)| *name == camera.model) else {
        let expected = "PINHOLE or SIMPLE_PINHOLE, or a radial or OPENCV model without distortion";
        return Err(DatasetError::damaged(path, field("model"), &camera.model, expected));
    };
    if camera.params.len() != *count {
        let found = format!("{} of {}", camera.params.len(), camera.model);
        return Err(DatasetError::damaged(path, field("number of parameters"), found, count.to_string()));
    }
    let p = &camera.params;
    let (focal, center, distortion) = match camera.model.as_str() {
        "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" => ([p[0], p[0]], [p[1], p[2]], &p[3..]),
        "PINHOLE" | "OPENCV" | "FULL_OPENCV" => ([p[0], p[1]], [p[2], p[3]], &p[4..]),
        _ => {
            let expected = "a pinhole model: undistort the images first (`colmap image_undistorter`)";
            return Err(DatasetError::damaged(path, field("model"), &camera.model, expected));
        }
    };
    if distortion.iter().any(|k| *k != 0.0) {
        let expected = "no distortion: undistort the images first (`colmap image_undistorter`)";
        return Err(DatasetError::damaged(path, field("distortion"), format!("{distortion:?}"), expected));
    }
    let side = |side: u64| u32::try_from(side).unwrap_or(u32::MAX);
    let intrinsics = Intrinsics {
        fx: focal[0],
        fy: focal[1],
        cx: center[0],
        cy: center[1],
        width: side(camera.width),
        height: side(camera.height),
    };
    check_intrinsics(&intrinsics)
        .map_err(|(what, found, expected)| DatasetError::damaged(path, field(what), found, expected))?;
    Ok(intrinsics)
}

fn entry_of(
    root: &Path,
    images_file: &Path,
    folder: &Path,
    image: &RawImage,
    cameras: &BTreeMap<u32, Intrinsics>,
    scale_to_image: bool,
) -> Result<Entry, DatasetError> {
    let field = |name: &str| format!("image {:?}: {name}", image.name);
    let [w, x, y, z] = image.rotation;
    let camera_from_world =
        Pose { position_m: DVec3::from_array(image.translation), rotation: DQuat::from_xyzw(x, y, z, w) };
    super::check_position(camera_from_world.position_m).map_err(|expected| {
        DatasetError::damaged(images_file, field("TX TY TZ"), format!("{:?}", image.translation), expected)
    })?;
    if !camera_from_world.is_sane() {
        let found = format!("{:?}", image.rotation);
        return Err(DatasetError::damaged(images_file, field("QW QX QY QZ"), found, "a quaternion of length 1"));
    }
    let world_from_camera = Pose { rotation: camera_from_world.rotation.normalize(), ..camera_from_world }.inverse();
    let Some(camera) = cameras.get(&image.camera) else {
        let expected = "the id of a camera of the model";
        return Err(DatasetError::damaged(images_file, field("CAMERA_ID"), image.camera.to_string(), expected));
    };
    // A name that leads out of the folder is no name of an image of it.
    let relative = Path::new(&image.name);
    if image.name.is_empty() || relative.components().any(|part| !matches!(part, std::path::Component::Normal(_))) {
        let expected = "a path within the folder of images";
        return Err(DatasetError::damaged(images_file, field("NAME"), format!("{:?}", image.name), expected));
    }
    let path = folder.join(relative);
    let (width, height) = dimensions(&path, "the model names it; add it, or take it out of the model")?;
    let intrinsics = fit(camera, width, height, scale_to_image).ok_or_else(|| {
        let expected = format!(
            "{} x {} as its camera {} says (with a folder of smaller images, name it by --images)",
            camera.width, camera.height, image.camera
        );
        DatasetError::damaged(&path, "size", format!("{width} x {height}"), expected)
    })?;
    let mask = root.join("masks").join(format!("{}.png", image.name));
    Ok(Entry {
        name: image.name.clone(),
        mask: mask.is_file().then_some(mask),
        path,
        world_from_camera,
        intrinsics,
        depth: None,
        held_out: None,
    })
}

/// The camera at an image's size: its own, or, where that is allowed, scaled by a factor that both sides share up to the
/// rounding of a pixel.
fn fit(camera: &Intrinsics, width: u32, height: u32, scale: bool) -> Option<Intrinsics> {
    if (camera.width, camera.height) == (width, height) {
        return Some(*camera);
    }
    let (sx, sy) = (f64::from(width) / f64::from(camera.width), f64::from(height) / f64::from(camera.height));
    let alike = (sx * f64::from(camera.height) - f64::from(height)).abs() <= 1.0
        || (sy * f64::from(camera.width) - f64::from(width)).abs() <= 1.0;
    (scale && alike).then_some(Intrinsics {
        fx: camera.fx * sx,
        fy: camera.fy * sy,
        cx: camera.cx * sx,
        cy: camera.cy * sy,
        width,
        height,
    })
}

fn check_point(position: DVec3) -> Result<DVec3, String> {
    if position.is_finite() { Ok(position) } else { Err(format!("{position}")) }
}

/// A point, or the reason why it is none.
fn point_of(path: &Path, id: u64, position: [f64; 3], rgb: [u8; 3]) -> Result<Point, DatasetError> {
    let position = check_point(DVec3::from_array(position))
        .map_err(|found| DatasetError::damaged(path, format!("point {id}: X Y Z"), found, "finite numbers"))?;
    Ok(Point { position, rgb })
}

#[cfg(test)]
mod tests;
