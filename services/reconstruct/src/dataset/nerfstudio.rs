//! nerfstudio's `transforms.json`, and NeRF-synthetic's `transforms_train.json` with `transforms_test.json`.
//!
//! Matrices are camera-to-world with OpenGL's axes (x right, y up, z backwards), the world's z is up, principal points count
//! from the image's corner as ours do. Convention: <https://docs.nerf.studio/quickstart/data_conventions.html>.

use std::path::{Component, Path, PathBuf};

use glam::{DMat3, DQuat, DVec3, Vec3};
use serde_json::{Map, Value};
use shared_types::frames::{Intrinsics, Pose};

use super::{DepthFile, Entry, Format, Listing, check_intrinsics, image::dimensions, point_cloud};
use crate::error::DatasetError;

/// Metres a unit of depth where the file does not say, as nerfstudio's parser has it.
const DEPTH_UNIT_M: f64 = 1e-3;
/// How far a transform's axes may be from unit length and right angles.
const RIGID_TOLERANCE: f64 = 1e-3;
/// NeRF-synthetic's files and whether their images are held out. Its `val` views are for choosing parameters: left out.
const SYNTHETIC: [(&str, bool); 2] = [("transforms_train.json", false), ("transforms_test.json", true)];

/// Whether a folder holds such a dataset.
#[must_use]
pub fn is_dataset(root: &Path) -> bool {
    root.join("transforms.json").is_file() || root.join(SYNTHETIC[0].0).is_file()
}

/// Lists the dataset in a folder.
///
/// # Errors
/// [`DatasetError`] naming file and field.
pub fn list(root: &Path) -> Result<Listing, DatasetError> {
    let mut entries = Vec::new();
    let mut points = Vec::new();
    let whole = root.join("transforms.json");
    if whole.is_file() {
        let document = read(&whole)?;
        list_frames(root, &whole, &document, None, &mut entries)?;
        if let Some(file) = document.get("ply_file_path") {
            let path = within(root, &whole, "ply_file_path", file)?;
            points = point_cloud::read(&path)?;
        }
    } else {
        for (name, held_out) in SYNTHETIC {
            let path = root.join(name);
            // Without test views every 8th image is held out, as in any other dataset.
            if path.is_file() {
                let held_out = root.join(SYNTHETIC[1].0).is_file().then_some(held_out);
                list_frames(root, &path, &read(&path)?, held_out, &mut entries)?;
            }
        }
    }
    let downscale = super::default_downscale(&entries);
    let root = root.to_owned();
    Ok(Listing { root, format: Format::Nerfstudio, entries, points, up: Vec3::Z, stage: None, downscale })
}

fn read(path: &Path) -> Result<Map<String, Value>, DatasetError> {
    let bytes = std::fs::read(path).map_err(|source| DatasetError::read(path, source, "it lists the images"))?;
    match serde_json::from_slice(&bytes) {
        Ok(Value::Object(document)) => Ok(document),
        Ok(_) => Err(DatasetError::damaged(path, "the document", "no object", "an object with \"frames\"")),
        Err(error) => {
            let found = format!("broken ({error})");
            Err(DatasetError::damaged(path, "JSON", found, "a whole file").at_line(error.line()))
        }
    }
}

/// A frame, and the document behind it: what the frame does not say, the document says for all.
struct Frame<'a> {
    path: &'a Path,
    index: usize,
    frame: &'a Map<String, Value>,
    document: &'a Map<String, Value>,
}

impl Frame<'_> {
    fn get(&self, key: &str) -> Option<&Value> {
        self.frame.get(key).or_else(|| self.document.get(key))
    }

    fn number(&self, key: &str) -> Result<Option<f64>, DatasetError> {
        match self.get(key) {
            None | Some(Value::Null) => Ok(None),
            Some(value) => match value.as_f64().filter(|number| number.is_finite()) {
                Some(number) => Ok(Some(number)),
                None => Err(self.wrong(key, value.to_string(), "a number")),
            },
        }
    }

    fn wrong(&self, key: &str, found: impl Into<String>, expected: impl Into<String>) -> DatasetError {
        DatasetError::damaged(self.path, format!("frames[{}].{key}", self.index), found, expected)
    }

    fn file(&self, root: &Path, key: &str) -> Result<Option<PathBuf>, DatasetError> {
        match self.frame.get(key) {
            None | Some(Value::Null) => Ok(None),
            Some(value) => within(root, self.path, &format!("frames[{}].{key}", self.index), value).map(Some),
        }
    }
}

fn list_frames(
    root: &Path,
    path: &Path,
    document: &Map<String, Value>,
    held_out: Option<bool>,
    entries: &mut Vec<Entry>,
) -> Result<(), DatasetError> {
    let frames = match document.get("frames") {
        Some(Value::Array(frames)) => frames,
        Some(other) => return Err(DatasetError::damaged(path, "frames", other.to_string(), "a list of frames")),
        None => return Err(DatasetError::damaged(path, "frames", "missing", "a list of frames")),
    };
    for (index, frame) in frames.iter().enumerate() {
        let Value::Object(frame) = frame else {
            return Err(DatasetError::damaged(path, format!("frames[{index}]"), frame.to_string(), "an object"));
        };
        let frame = Frame { path, index, frame, document };
        check_model(&frame)?;
        let mut file = frame.file(root, "file_path")?.ok_or_else(|| frame.wrong("file_path", "missing", "a path"))?;
        // NeRF-synthetic names its images without the ending.
        if file.extension().is_none() {
            file.set_extension("png");
        }
        let (width, height) = dimensions(&file, "the dataset names it; add it, or take its frame out")?;
        let depth = frame.file(root, "depth_file_path")?;
        let mask = frame.file(root, "mask_path")?;
        for (key, beside) in [("depth_file_path", &depth), ("mask_path", &mask)] {
            let Some(beside) = beside else { continue };
            let found = dimensions(beside, &format!("its frame names it as {key}; add it, or take the key out"))?;
            if found != (width, height) {
                let expected = format!("{width} x {height} as its image has");
                return Err(DatasetError::damaged(beside, "size", format!("{} x {}", found.0, found.1), expected));
            }
        }
        let unit_m = depth_unit(&frame)?;
        entries.push(Entry {
            name: name_of(root, &file),
            world_from_camera: pose_of(&frame)?,
            intrinsics: intrinsics_of(&frame, width, height)?,
            path: file,
            depth: depth.map(|path| DepthFile { path, unit_m }),
            mask,
            held_out,
        });
    }
    Ok(())
}

fn name_of(root: &Path, file: &Path) -> String {
    file.strip_prefix(root).unwrap_or(file).to_string_lossy().into_owned()
}

/// A path that a document names, relative to the dataset's folder.
fn within(root: &Path, path: &Path, field: &str, value: &Value) -> Result<PathBuf, DatasetError> {
    let Some(text) = value.as_str().filter(|text| !text.is_empty()) else {
        return Err(DatasetError::damaged(path, field, value.to_string(), "a path"));
    };
    let named: PathBuf = Path::new(text).components().filter(|part| *part != Component::CurDir).collect();
    Ok(root.join(named))
}

fn check_model(frame: &Frame<'_>) -> Result<(), DatasetError> {
    if let Some(model) = frame.get("camera_model") {
        let known = ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE"];
        if !model.as_str().is_some_and(|model| known.contains(&model)) {
            let expected = "OPENCV, PINHOLE or SIMPLE_PINHOLE without distortion: undistort the images first";
            return Err(frame.wrong("camera_model", model.to_string(), expected));
        }
    }
    for key in ["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"] {
        if let Some(value) = frame.number(key)?
            && value != 0.0
        {
            return Err(frame.wrong(key, value.to_string(), "0: undistort the images first"));
        }
    }
    Ok(())
}

fn depth_unit(frame: &Frame<'_>) -> Result<f64, DatasetError> {
    for key in ["depth_unit_m", "depth_unit_scale_factor"] {
        if let Some(unit) = frame.number(key)? {
            super::check_depth_unit(unit).map_err(|expected| frame.wrong(key, unit.to_string(), expected))?;
            return Ok(unit);
        }
    }
    Ok(DEPTH_UNIT_M)
}

fn intrinsics_of(frame: &Frame<'_>, width: u32, height: u32) -> Result<Intrinsics, DatasetError> {
    for (key, found) in [("w", width), ("h", height)] {
        if let Some(side) = frame.number(key)?
            && side != f64::from(found)
        {
            return Err(frame.wrong(key, side.to_string(), format!("{found} as its image has")));
        }
    }
    let from_angle = |angle: f64, side: u32| f64::from(side) / 2.0 / (angle / 2.0).tan();
    let fx = match (frame.number("fl_x")?, frame.number("camera_angle_x")?) {
        (Some(focal), _) => focal,
        (None, Some(angle)) => from_angle(angle, width),
        (None, None) => return Err(frame.wrong("fl_x", "missing", "fl_x or camera_angle_x")),
    };
    let fy = match (frame.number("fl_y")?, frame.number("camera_angle_y")?) {
        (Some(focal), _) => focal,
        (None, Some(angle)) => from_angle(angle, height),
        (None, None) => fx,
    };
    let center = |value: Option<f64>, side: u32| value.unwrap_or(f64::from(side) / 2.0);
    let (cx, cy) = (center(frame.number("cx")?, width), center(frame.number("cy")?, height));
    let intrinsics = Intrinsics { fx, fy, cx, cy, width, height };
    check_intrinsics(&intrinsics).map_err(|(what, found, expected)| frame.wrong(what, found, expected))?;
    Ok(intrinsics)
}

/// The pose of a camera-to-world matrix with OpenGL's axes. It must be rigid: a scaled or mirrored one would bend the scene.
fn pose_of(frame: &Frame<'_>) -> Result<Pose, DatasetError> {
    const KEY: &str = "transform_matrix";
    let Some(value) = frame.frame.get(KEY) else {
        return Err(frame.wrong(KEY, "missing", "four rows of four numbers"));
    };
    let rows: Vec<Vec<f64>> = serde_json::from_value(value.clone())
        .map_err(|_not_numbers| frame.wrong(KEY, value.to_string(), "four rows of four numbers"))?;
    if !(3..=4).contains(&rows.len()) || rows.iter().any(|row| row.len() != 4) {
        return Err(frame.wrong(KEY, format!("of {} rows", rows.len()), "four rows of four numbers"));
    }
    if rows.iter().flatten().any(|number| !number.is_finite()) {
        return Err(frame.wrong(KEY, value.to_string(), "finite numbers"));
    }
    if rows.get(3).is_some_and(|last| last.iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(a, b)| (a - b).abs() > 1e-6)) {
        return Err(frame.wrong(KEY, format!("with the last row {:?}", rows[3]), "the last row 0 0 0 1"));
    }
    super::check_position(DVec3::new(rows[0][3], rows[1][3], rows[2][3])).map_err(|expected| {
        frame.wrong(KEY, format!("with the position {:?}", [rows[0][3], rows[1][3], rows[2][3]]), expected)
    })?;
    let column = |k: usize| DVec3::new(rows[0][k], rows[1][k], rows[2][k]);
    let axes = [column(0), column(1), column(2)];
    let rotation = DMat3::from_cols(axes[0], axes[1], axes[2]);
    let off = (rotation.transpose() * rotation - DMat3::IDENTITY).to_cols_array();
    if off.iter().any(|value| value.abs() > RIGID_TOLERANCE) || rotation.determinant() < 0.0 {
        let found = format!("with the axes {} {} {}", axes[0], axes[1], axes[2]);
        return Err(frame.wrong(KEY, found, "a rotation: right-handed axes of length 1 at right angles"));
    }
    // OpenGL's y and z, turned round.
    let optical = DMat3::from_cols(axes[0], -axes[1], -axes[2]);
    Ok(Pose { position_m: column(3), rotation: DQuat::from_mat3(&optical).normalize() })
}

#[cfg(test)]
mod tests;
