//! Checkpoints: everything that a run needs to go on with the same bits, in one file that is whole or not there.
//!
//! `checkpoint-000004200.ckpt` by iteration; the newest two are kept. The newest that is whole wins: a truncated or rotten
//! one, or one of another run, is skipped with a warning.

use std::collections::VecDeque;
use std::fs;
use std::path::{Path, PathBuf};

use shared_types::folder::{FolderError, write_atomic};
use shared_types::storage;
use splatting::bytes::{Reader, Truncated, Writer, checksum};
use splatting::order::ViewOrder;
use splatting::{DensifierState, Gaussians, Optimiser, ScreenStatistics, Training};

use crate::report::Row;

const MAGIC: u64 = u64::from_le_bytes(*b"VNTGRECO");
const VERSION: u32 = 2;
/// Checkpoints kept.
const KEPT: usize = 2;

/// Why a checkpoint cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The bytes end too early, or lengths in them make no sense.
    #[error(transparent)]
    Truncated(#[from] Truncated),
    /// Not a checkpoint of a reconstruction, or of another version.
    #[error("it begins with {found}; expected a checkpoint of version {VERSION}")]
    Foreign {
        /// What it begins with.
        found: String,
    },
    /// The checksum does not fit.
    #[error("its checksum does not fit its content: the file is damaged")]
    Damaged,
    /// It belongs to another run.
    #[error("it belongs to another run")]
    OtherRun,
    /// The model or the statistics in it cannot be read.
    #[error("its model cannot be read: {0}")]
    Model(String),
}

/// Where a run stands.
#[derive(Debug, Clone, PartialEq)]
pub struct Progression {
    /// Iterations run.
    pub iteration: u32,
    /// The order of views.
    pub order: ViewOrder,
    /// PSNR of the last training images, oldest first, dB.
    pub recent_psnr_db: VecDeque<f64>,
    /// Evaluations so far.
    pub rows: Vec<Row>,
    /// Processor seconds of training.
    pub cpu_s: f64,
    /// Wall seconds of training.
    pub wall_s: f64,
    /// The densifier.
    pub densifier: DensifierState,
    /// What trained so far, one after the other.
    pub backends: Vec<String>,
}

/// All of a run's state.
#[derive(Debug, Clone)]
pub struct State {
    /// The model.
    pub model: Gaussians,
    /// The state of Adam.
    pub optimiser: Optimiser,
    /// What the screen showed since the last densification.
    pub statistics: ScreenStatistics,
    /// Everything else.
    pub progression: Progression,
}

/// The bytes of a model under training, as of its last [`Training::sync`], and of how far it is; `run` is the checksum of
/// the run's identity.
#[must_use]
pub fn to_bytes(training: &Training, p: &Progression, run: u64) -> Vec<u8> {
    let mut w = Writer::default();
    w.u64(MAGIC);
    w.u32(VERSION);
    w.u64(run);
    w.u32(p.iteration);
    let (random, views, left) = p.order.parts();
    w.u64(random);
    w.u32(views);
    w.list(left.iter(), |w, &view| w.u32(view));
    w.list(p.recent_psnr_db.iter(), |w, &db| w.f64(db));
    w.list(p.rows.iter(), |w, row| row.write(w));
    w.f64(p.cpu_s);
    w.f64(p.wall_s);
    w.blob(&p.densifier.to_bytes());
    w.list(p.backends.iter(), |w, name| w.blob(name.as_bytes()));
    w.blob(&training.statistics().encode());
    w.blob(&splatting::checkpoint::encode(training.model(), training.optimiser()));
    let mut bytes = w.into_bytes();
    let sum = checksum(&bytes);
    bytes.extend_from_slice(&sum.to_le_bytes());
    bytes
}

/// Reads a checkpoint of the run `run`.
///
/// # Errors
/// [`CheckpointError`]: never a part of a checkpoint.
pub fn from_bytes(bytes: &[u8], run: u64) -> Result<State, CheckpointError> {
    let mut header = Reader::new(bytes);
    let (magic, version) = (header.u64("the magic number")?, header.u32("the version")?);
    if magic != MAGIC || version != VERSION {
        return Err(CheckpointError::Foreign { found: format!("{magic:#018x}, version {version}") });
    }
    header.u64("the run")?;
    let Some((body, sum)) = bytes.split_last_chunk::<8>() else { return Err(CheckpointError::Damaged) };
    if checksum(body).to_le_bytes() != *sum || body.len() < 12 {
        return Err(CheckpointError::Damaged);
    }
    let mut r = Reader::new(&body[12..]);
    if r.u64("the run")? != run {
        return Err(CheckpointError::OtherRun);
    }
    let iteration = r.u32("iterations")?;
    let (random, views) = (r.u64("random state")?, r.u32("views")?);
    let left = r.list("view order", 4, |r| r.u32("a view"))?;
    let order = ViewOrder::resume(random, views, left).ok_or(CheckpointError::Damaged)?;
    let recent_psnr_db = r.list("PSNRs", 8, |r| r.f64("a PSNR"))?.into();
    let rows = r.list("evaluations", Row::LEAST_BYTES, Row::read)?;
    let (cpu_s, wall_s) = (r.f64("processor time")?, r.f64("wall time")?);
    let densifier = r.blob("the densifier")?;
    let densifier = densifier.try_into().map_err(|_length| Truncated { at: bytes.len(), what: "the densifier" })?;
    let backends = r.list("back ends", 8, |r| Ok(String::from_utf8_lossy(r.blob("a back end")?).into_owned()))?;
    let statistics = r.blob("statistics")?;
    let blob = r.blob("the model")?;
    let (model, optimiser) =
        splatting::checkpoint::decode(blob).map_err(|error| CheckpointError::Model(error.to_string()))?;
    let known = statistics.len() / 12;
    let statistics = ScreenStatistics::decode(statistics, known.min(model.len()))
        .map_err(|error| CheckpointError::Model(error.to_string()))?;
    Ok(State {
        model,
        optimiser,
        statistics,
        progression: Progression {
            iteration,
            order,
            recent_psnr_db,
            rows,
            cpu_s,
            wall_s,
            densifier: DensifierState::from_bytes(densifier),
            backends,
        },
    })
}

/// Writes a checkpoint into `folder`, then removes those no longer needed.
///
/// # Errors
/// When it cannot be written; older ones then still stand.
pub fn write(folder: &Path, training: &Training, progression: &Progression, run: u64) -> Result<PathBuf, FolderError> {
    let path = folder.join(format!("checkpoint-{:09}.ckpt", progression.iteration));
    write_atomic(&path, &to_bytes(training, progression, run))?;
    for (_, old) in list(folder).into_iter().skip(KEPT) {
        if let Err(error) = storage::of(&old).remove_file(&old) {
            tracing::warn!(path = %old.display(), %error, "cannot remove an old checkpoint");
        }
    }
    Ok(path)
}

/// The newest whole checkpoint of the run in `folder`; `None` without any.
#[must_use]
pub fn newest(folder: &Path, run: u64) -> Option<State> {
    list(folder).into_iter().find_map(|(_, path)| {
        let read = fs::read(&path).map_err(|error| error.to_string());
        match read.and_then(|bytes| from_bytes(&bytes, run).map_err(|error| error.to_string())) {
            Ok(state) => Some(state),
            Err(error) => {
                tracing::warn!(path = %path.display(), error, "skipping a checkpoint that cannot be used");
                None
            }
        }
    })
}

/// The name of the newest checkpoint in a folder, whole or not.
#[must_use]
pub fn any(folder: &Path) -> Option<String> {
    let (_, path) = list(folder).into_iter().next()?;
    Some(path.file_name()?.to_string_lossy().into_owned())
}

/// Removes all checkpoints of a folder.
pub fn remove_all(folder: &Path) {
    for (_, path) in list(folder) {
        if let Err(error) = storage::of(&path).remove_file(&path) {
            tracing::warn!(path = %path.display(), %error, "cannot remove a checkpoint");
        }
    }
}

/// Checkpoints in a folder, newest first.
fn list(folder: &Path) -> Vec<(u32, PathBuf)> {
    let Ok(entries) = fs::read_dir(folder) else { return Vec::new() };
    let mut all: Vec<(u32, PathBuf)> = entries
        .filter_map(|entry| {
            let path = entry.ok()?.path();
            let name = path.file_name()?.to_str()?.strip_prefix("checkpoint-")?.strip_suffix(".ckpt")?;
            Some((name.parse().ok()?, path))
        })
        .collect();
    all.sort_by(|a, b| b.cmp(a));
    all
}
