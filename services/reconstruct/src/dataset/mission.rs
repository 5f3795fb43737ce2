//! A mission folder as a dataset: its keyframes with the poses as measured, their depth, and the prior's box.

use std::path::Path;

use glam::{DVec3, Vec3};
use serde_json::Value;
use shared_types::config::planner::RadiusRule;
use shared_types::config::{Config, load_mission};
use shared_types::folder::{Frame, MissionFolder};
use shared_types::messages::KeyframeReason;
use splatting::rgbd::clip_box::ClipBox;

use super::{DepthFile, Entry, Format, Listing, Stage};
use crate::error::DatasetError;

/// The box that a mission found around its object; `None` where it has found none yet.
///
/// # Errors
/// [`DatasetError`]: the configuration or the journal's prior is damaged.
pub fn clip_box(folder: &MissionFolder) -> Result<Option<ClipBox>, DatasetError> {
    let path = folder.journal_path();
    if !path.is_file() || prior_of(&path)?.is_none() {
        return Ok(None);
    }
    Ok(Some(stage_of(&path, &load_mission(&folder.config_path())?)?.clip))
}

/// Lists the keyframes of a mission.
///
/// # Errors
/// [`DatasetError`]: a file of the folder is damaged, or the mission never found its object.
pub fn list(root: &Path) -> Result<Listing, DatasetError> {
    let folder = MissionFolder::open(root)?;
    let config = load_mission(&folder.config_path())?;
    let mut entries = Vec::new();
    for id in folder.list_keyframes()? {
        let Some(frame) = folder.read_frame(KeyframeReason::Selected, id)? else { continue };
        let path = folder.keyframe_path(id);
        check_frame(&path.join("frame.json"), &frame)?;
        entries.push(Entry {
            name: format!("{id:06}.png"),
            path: path.join("rgb.png"),
            world_from_camera: frame.world_from_camera(),
            intrinsics: frame.intrinsics,
            depth: Some(DepthFile { path: path.join("depth.png"), unit_m: frame.depth_unit_m }),
            mask: None,
            held_out: None,
        });
    }
    // At the size that it was trained at in flight, where that divides.
    let downscale = entries.first().map_or(1, |entry| {
        let factor = entry.intrinsics.width / config.model.width.max(1);
        let divides = factor * config.model.width == entry.intrinsics.width
            && factor * config.model.height == entry.intrinsics.height;
        if factor >= 1 && divides { factor } else { super::default_downscale(&entries) }
    });
    let stage = stage_of(&folder.journal_path(), &config)?;
    Ok(Listing {
        root: root.to_owned(),
        format: Format::Mission,
        entries,
        points: Vec::new(),
        up: Vec3::Z,
        stage: Some(stage),
        downscale,
    })
}

/// What the folder's own reader leaves open.
fn check_frame(path: &Path, frame: &Frame) -> Result<(), DatasetError> {
    super::check_intrinsics(&frame.intrinsics).map_err(|(what, found, expected)| {
        DatasetError::damaged(path, format!("intrinsics: {what}"), found, expected)
    })?;
    let position = frame.world_from_camera_position_m;
    super::check_position(DVec3::from_array(position)).map_err(|expected| {
        DatasetError::damaged(path, "world_from_camera_position_m", format!("{position:?}"), expected)
    })?;
    let unit = frame.depth_unit_m;
    super::check_depth_unit(unit)
        .map_err(|expected| DatasetError::damaged(path, "depth_unit_m", unit.to_string(), expected))
}

/// Line and entry of the prior in a journal. A mission may look for its object again; the last word counts.
fn prior_of(path: &Path) -> Result<Option<(usize, Value)>, DatasetError> {
    let bytes = std::fs::read(path)
        .map_err(|source| DatasetError::read(path, source, "it holds the box that the mission found"))?;
    let mut found = None;
    for (index, line) in bytes.split(|byte| *byte == b'\n').enumerate() {
        // A torn last line is what a kill leaves.
        let Ok(entry) = serde_json::from_slice::<Value>(line) else { continue };
        if entry["event"] == "prior" {
            found = Some((index + 1, entry));
        }
    }
    Ok(found)
}

fn stage_of(path: &Path, config: &Config) -> Result<Stage, DatasetError> {
    let Some((line, entry)) = prior_of(path)? else {
        let expected = "a line with the event \"prior\": the mission never found its object; resume it first";
        return Err(DatasetError::damaged(path, "the journal", "without a prior", expected));
    };
    let prior = &entry["prior"];
    let wrong = |field: &str, value: &Value| {
        DatasetError::damaged(path, format!("prior.{field}"), value.to_string(), "finite numbers").at_line(line)
    };
    let number =
        |field: &str, value: &Value| value.as_f64().filter(|v| v.is_finite()).ok_or_else(|| wrong(field, value));
    let mut center = DVec3::ZERO;
    for axis in 0..3 {
        center[axis] = number("center_m", &prior["center_m"][axis])?;
    }
    let box_size_m = number("size_m", &prior["size_m"])?;
    if !(0.01..=100.0).contains(&box_size_m) {
        return Err(wrong("size_m", &prior["size_m"]));
    }
    let ground = &prior["ground"];
    let ground_z_m = number("ground.slope", &ground["slope"][0])? * center.x
        + number("ground.slope", &ground["slope"][1])? * center.y
        + number("ground.offset_m", &ground["offset_m"])?;
    Ok(Stage {
        clip: ClipBox::new(center, box_size_m, ground_z_m, config.trainer.ground_margin_m),
        box_size_m,
        trainer: config.trainer.clone(),
        radius_m: match config.planner.radius {
            RadiusRule::Paper => box_size_m + 0.5,
            RadiusRule::Clear => (box_size_m + 0.5).max(0.87 * box_size_m + config.planner.clearance_m),
        },
    })
}
