//! What a mission is worth: the figures of `report/metrics.json`, from the mission folder and the ground truth.
//!
//! [`metrics`] are the keys, [`flight`] is what the supervisor saw, [`journal`] what the planner wrote down, [`truth`] the
//! world that was flown in, [`views`] the held-out views, [`pictures`] the renders for people.

pub mod flight;
pub mod journal;
pub mod metrics;
pub mod pictures;
pub mod truth;
pub mod views;

#[cfg(test)]
mod power_cuts;

use std::path::Path;

use anyhow::Context as _;
use shared_types::config::{Config, load_mission};
use shared_types::folder::{FolderError, MissionFolder, write_atomic};
use shared_types::frames::Pose;
use splatting::Gaussians;
use splatting::formats::Format;
use trainer::backend::Record;

use crate::cli::Evaluate;
use crate::exit::{Exit, Refusal};
use crate::supervise::track;
use crate::{print, summary};
pub use metrics::Metrics;
use truth::Truth;

/// What is measured, and how finely.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Effort {
    /// Held-out views, both radii together.
    pub views: usize,
    /// Width of the held-out views, pixels.
    pub width: u32,
    /// Height of the held-out views, pixels.
    pub height: u32,
}

impl Effort {
    /// The effort of a configuration: its number of views, at the size that the model was trained at.
    #[must_use]
    pub fn of(config: &Config) -> Self {
        Self { views: config.launch.evaluate_views as usize, width: config.model.width, height: config.model.height }
    }
}

/// `vantage evaluate`.
///
/// # Errors
/// When the folder holds no mission or no model, or the object of the mission cannot be read.
pub fn run(arguments: &Evaluate) -> anyhow::Result<Exit> {
    let folder = MissionFolder::open(&arguments.folder)?;
    let config = load_mission(&folder.config_path())?;
    let official = Effort::of(&config);
    let mut effort = official;
    if let Some(views) = arguments.views {
        effort.views = views as usize;
    }
    if let Some(width) = arguments.width {
        effort.width = width;
        effort.height = (effort.width * config.camera.height_px).div_ceil(config.camera.width_px.max(1)).max(1);
    }
    let mut metrics = measure(&folder, &config, effort, arguments.model.as_deref())?;
    // What `vantage reconstruct` noted there is not measured here, and stays.
    if let Some(before) = read_metrics(&folder)? {
        metrics.offline = before.offline;
    }
    // Figures of another model, or of other views than every mission is measured on, are not the mission's.
    if arguments.model.is_none() && effort == official {
        write_metrics(&folder, &metrics)?;
    }
    print(&if arguments.json { to_json(&metrics)? } else { summary::table(&metrics, folder.root()) })
}

/// Measures a mission: everything that its folder and the ground truth tell. Also renders the pictures of the report.
///
/// # Errors
/// When there is no model, or the object of the mission cannot be read.
pub fn measure(
    folder: &MissionFolder,
    config: &Config,
    effort: Effort,
    model: Option<&Path>,
) -> anyhow::Result<Metrics> {
    let own = folder.model_path().join("model.ply");
    if let Some(model) = model
        && !model.exists()
    {
        let message = format!("{} does not exist; give a model file with --model", model.display());
        return Err(Refusal::missing(message));
    }
    let gaussians = read_model(model.unwrap_or(&own))?;
    let mut metrics = Metrics::of_folder(config, &flight::read(folder)?, &journal::read(&folder.journal_path())?);
    let record = Record::read(&folder.model_path());
    metrics.memory.extend(record.gpu_mb().map(|megabytes| ("gpu_mb".to_owned(), megabytes)));
    metrics.mission.backend = Some(record.backend).filter(|name| !name.is_empty());
    metrics.live.gaussians = Some(gaussians.len());
    metrics.memory.insert("model_mb".to_owned(), model_mb(&gaussians));
    let poses = keyframe_poses(folder)?;
    metrics.mission.keyframes.get_or_insert(poses.len());
    if !config.link.is_local() {
        // A real world has no ground truth.
        return Ok(metrics);
    }
    let truth = Truth::build(config)?;
    let views = views::held_out(&truth, effort)?;
    let quality = views::appearance(&truth, &gaussians, &views, effort)?;
    metrics.live.take(&quality);
    if let Some(untrained) = trainer::untrained::untrained(folder, config)? {
        metrics.live.psnr_init_db = views::appearance(&truth, &untrained, &views, effort)?.object_db;
    }
    let flown_m = track::read(&folder.report_path());
    if let Some((least_m, collisions)) = truth.clearance(&flown_m) {
        metrics.mission.min_clearance_m = Some(least_m);
        metrics.mission.collisions = Some(collisions);
        metrics.mission.path_m = Some(track::length_m(&flown_m));
    }
    let (coverage, geometry) = truth.surface(&poses, &gaussians);
    metrics.coverage.take(&coverage);
    if let Some(geometry) = geometry {
        metrics.geometry.take(&geometry);
    }
    if model.is_none() {
        pictures::write(folder, &truth, &gaussians)?;
    }
    Ok(metrics)
}

/// Memory of a model's parameters, megabytes: 14 numbers of 4 bytes, an id and the round of its birth each. Training holds
/// two moments of each number besides.
fn model_mb(gaussians: &Gaussians) -> f64 {
    #[expect(clippy::cast_precision_loss, reason = "far below 2^53")]
    let bytes = (gaussians.len() * (14 * 4 + 8 + 4)) as f64;
    (bytes / 1e5).round() / 10.0
}

/// Measured poses of the keyframes, in the order of their capture: ids follow the order of choice, and a batch is flown in
/// another.
fn keyframe_poses(folder: &MissionFolder) -> Result<Vec<Pose>, FolderError> {
    let mut frames = Vec::new();
    for id in folder.list_keyframes()? {
        frames.extend(folder.read_frame(shared_types::messages::KeyframeReason::Selected, id)?);
    }
    frames.sort_by_key(|frame| frame.stamp_ns);
    Ok(frames.iter().map(|frame| frame.world_from_camera()).collect())
}

/// Reads a model.
///
/// # Errors
/// Exit 1 when there is none, or it is truncated or no model of a known format.
pub fn read_model(path: &Path) -> anyhow::Result<Gaussians> {
    let bytes = std::fs::read(path).map_err(|error| {
        let way_out = "expected the model of a finished mission; `vantage resume` finishes one that was cut off";
        Refusal::failed(format!("{}: {error}; {way_out}", path.display()))
    })?;
    let format = Format::of_path(path).unwrap_or(Format::Ply);
    let refused = |why: &str| {
        Refusal::failed(format!("{}: {why}; expected a whole model, such as model/rounds/*.ply", path.display()))
    };
    match splatting::formats::read(format, &bytes) {
        Ok(model) if model.is_empty() => Err(refused("it holds no Gaussians")),
        Ok(model) => Ok(model),
        Err(error) => Err(refused(&error.to_string())),
    }
}

/// `report/metrics.json` as text.
///
/// # Errors
/// Never in practice: every key is text and every number finite.
pub fn to_json(metrics: &Metrics) -> anyhow::Result<String> {
    Ok(serde_json::to_string_pretty(metrics).context("metrics")? + "\n")
}

/// Reads `report/metrics.json`; `None` when there is none that can be read.
///
/// # Errors
/// When the file is there and the disk refuses it.
pub fn read_metrics(folder: &MissionFolder) -> anyhow::Result<Option<Metrics>> {
    match std::fs::read(folder.report_path().join("metrics.json")) {
        Ok(bytes) => Ok(serde_json::from_slice(&bytes).ok()),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error).context("report/metrics.json"),
    }
}

/// Writes `report/metrics.json`.
///
/// # Errors
/// When the file cannot be written.
pub fn write_metrics(folder: &MissionFolder, metrics: &Metrics) -> anyhow::Result<()> {
    write_atomic(&folder.report_path().join("metrics.json"), to_json(metrics)?.as_bytes())?;
    Ok(())
}
