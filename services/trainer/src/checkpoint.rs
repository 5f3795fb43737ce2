//! Checkpoints: everything that training needs to go on with the same bits, in one file that is whole or not there.
//!
//! A file holds a magic number, a version, the progression (voxel grid, rounds, random state, losses), the model with its
//! optimiser, and a checksum over all of it. Names carry the generation, which grows with training:
//! `model/checkpoint-000000000482-final.ckpt` at a round's end, `-live` within one. The newest that is whole wins; a
//! truncated or rotten one is skipped with a warning.

use std::fs;
use std::path::{Path, PathBuf};

use shared_types::folder::{FolderError, write_atomic};
use shared_types::storage;
use splatting::{Gaussians, Optimiser};

use crate::logic::rounds::LossHistory;
use crate::progression::{ActiveRound, Progression, State};
use crate::round::{FinishedRound, RoundSpec};
use crate::session::Session;
use splatting::bytes::{Reader, Truncated, Writer, checksum};
use splatting::order::ViewOrder;
use splatting::rgbd::voxels::VoxelGrid;

const MAGIC: u64 = u64::from_le_bytes(*b"VNTGCKPT");
const VERSION: u32 = 1;
/// Checkpoints kept, besides the newest of a round's end.
const KEPT: usize = 2;

/// Why a checkpoint cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The bytes end too early, or lengths in them make no sense.
    #[error(transparent)]
    Truncated(#[from] Truncated),
    /// Not a checkpoint, or of another version.
    #[error("it begins with {found}; expected a checkpoint of version {VERSION}")]
    Foreign {
        /// What it begins with.
        found: String,
    },
    /// The checksum does not fit.
    #[error("its checksum does not fit its content: the file is damaged")]
    Damaged,
    /// Numbers in it that contradict each other.
    #[error("its {what} cannot be: the file is damaged")]
    Impossible {
        /// What the numbers are of.
        what: &'static str,
    },
    /// The model in it cannot be read.
    #[error("its model cannot be read: {0}")]
    Model(String),
}

/// Iterations of a mission and ids of Gaussians stay far below this; sums of them do not overflow.
const MOST: u64 = 1 << 40;

/// A checkpoint in memory.
#[derive(Debug)]
pub struct Checkpoint {
    pub(crate) model: Gaussians,
    pub(crate) optimiser: Optimiser,
    pub(crate) progression: Progression,
}

impl Checkpoint {
    /// What the last round that ended was asked; `None` before the first.
    #[must_use]
    pub fn last_round(&self) -> Option<&RoundSpec> {
        self.progression.finished.last().map(|round| &round.spec)
    }

    /// Gaussians in its model.
    #[must_use]
    pub fn gaussians(&self) -> usize {
        self.model.len()
    }

    /// Its bytes.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        encode(self.state())
    }

    pub(crate) fn state(&self) -> State<'_> {
        State { progression: &self.progression, model: &self.model, optimiser: &self.optimiser }
    }

    /// Puts the session where the checkpoint was taken. The caller then reads the keyframes
    /// ([`Session::resume`]).
    pub fn restore_into(self, session: &mut Session) {
        session.restore(self.model, self.optimiser, self.progression);
    }
}

/// The bytes of a checkpoint of a session, as of its last [`Session::sync`].
#[must_use]
pub fn to_bytes(session: &Session) -> Vec<u8> {
    encode(session.state())
}

fn encode(State { progression, model, optimiser }: State<'_>) -> Vec<u8> {
    let mut w = Writer::default();
    w.u64(MAGIC);
    w.u32(VERSION);
    w.u64(progression.total_iterations);
    w.u64(progression.next_gaussian_id);
    w.list(progression.inserted.iter(), |w, &id| w.u64(id));
    w.list(progression.finished.iter(), |w, round| round.write(w));
    w.list(progression.active.iter(), |w, round| {
        round.spec.write(w);
        w.u32(round.iterations);
        let (state, views, left) = round.order.parts();
        w.u64(state);
        w.u32(views);
        w.list(left.iter(), |w, &view| w.u32(view));
        w.u32(round.losses.window());
        w.list(round.losses.losses(), Writer::f64);
        w.list(round.psnr_db.iter(), |w, &db| w.f64(db));
    });
    w.list(progression.grid.iter(), |w, grid| {
        w.f32(grid.edge_m());
        w.list(grid.sorted().into_iter(), |w, (key, footprint)| {
            key.into_iter().for_each(|k| w.i32(k));
            w.f32(footprint);
        });
    });
    w.blob(&splatting::checkpoint::encode(model, optimiser));
    let mut bytes = w.into_bytes();
    let sum = checksum(&bytes);
    bytes.extend_from_slice(&sum.to_le_bytes());
    bytes
}

/// Reads a checkpoint.
///
/// # Errors
/// [`CheckpointError`]: never a part of a checkpoint.
pub fn from_bytes(bytes: &[u8]) -> Result<Checkpoint, CheckpointError> {
    let mut reader = Reader::new(bytes);
    let (magic, version) = (reader.u64("the magic number")?, reader.u32("the version")?);
    if magic != MAGIC || version != VERSION {
        return Err(CheckpointError::Foreign { found: format!("{magic:#018x}, version {version}") });
    }
    let Some((body, sum)) = bytes.split_last_chunk::<8>() else { return Err(CheckpointError::Damaged) };
    if checksum(body).to_le_bytes() != *sum || body.len() < 12 {
        return Err(CheckpointError::Damaged);
    }
    let mut r = Reader::new(&body[12..]);
    let total_iterations = r.u64("iterations")?;
    let next_gaussian_id = r.u64("the next id")?;
    let inserted = r.list("keyframes", 8, |r| r.u64("a keyframe"))?;
    let finished = r.list("rounds", 100, FinishedRound::read)?;
    let mut order_fits = true;
    let active = r.list("the round", 100, |r| {
        let spec = RoundSpec::read(r)?;
        let iterations = r.u32("iterations of the round")?;
        let (state, views) = (r.u64("random state")?, r.u32("views")?);
        let left = r.list("view order", 4, |r| r.u32("a view"))?;
        let window = r.u32("the loss window")?;
        let losses = r.list("losses", 8, |r| r.f64("a loss"))?;
        let psnr_db = r.list("PSNRs", 8, |r| r.f64("a PSNR"))?.into();
        // Views are counted among the round's keyframes.
        let order = ViewOrder::resume(state, views, left).filter(|_| views as usize <= spec.keyframes.len());
        order_fits &= order.is_some();
        Ok(ActiveRound {
            spec,
            iterations,
            order: order.unwrap_or_else(|| ViewOrder::new(state, 0)),
            losses: LossHistory::resume(window, &losses),
            psnr_db,
        })
    })?;
    let grid = r.list("the voxel grid", 4, |r| {
        let edge = r.f32("the voxel edge")?;
        let voxels = r.list("voxels", 16, |r| Ok(([r.i32("x")?, r.i32("y")?, r.i32("z")?], r.f32("a footprint")?)))?;
        Ok(VoxelGrid::from_entries(edge, voxels))
    })?;
    let sane_grid = |grid: &VoxelGrid| grid.edge_m().is_finite() && grid.edge_m() > 0.0;
    let generations = finished.iter().map(|round| round.generation).max().unwrap_or(0);
    for (fits, what) in [
        (order_fits, "view order"),
        (total_iterations <= MOST && next_gaussian_id <= MOST && generations <= 4 * MOST, "count of iterations"),
        (grid.iter().all(sane_grid), "voxel grid"),
    ] {
        if !fits {
            return Err(CheckpointError::Impossible { what });
        }
    }
    let blob = r.blob("the model")?;
    let (model, optimiser) =
        splatting::checkpoint::decode(blob).map_err(|error| CheckpointError::Model(error.to_string()))?;
    let progression = Progression {
        grid: grid.into_iter().next(),
        inserted,
        next_gaussian_id,
        total_iterations,
        finished,
        active: active.into_iter().next(),
    };
    Ok(Checkpoint { model, optimiser, progression })
}

/// Writes a checkpoint of a session, as of its last [`Session::sync`], into `folder` (the mission's `model/`), then removes
/// those no longer needed.
///
/// # Errors
/// When it cannot be written; older ones then still stand.
pub fn write(folder: &Path, session: &Session) -> Result<PathBuf, FolderError> {
    write_state(folder, session.state())
}

/// The same with a state that is not the session's any more.
pub(crate) fn write_state(folder: &Path, state: State<'_>) -> Result<PathBuf, FolderError> {
    let (generation, is_final) = state.progression.generation().unwrap_or_default();
    let kind = if is_final { "final" } else { "live" };
    let path = folder.join(format!("checkpoint-{generation:012}-{kind}.ckpt"));
    write_atomic(&path, &encode(state))?;
    let all = list(folder);
    let newest_final = all.iter().find(|entry| entry.is_final).map(|entry| entry.path.clone());
    for entry in all.iter().skip(KEPT).filter(|entry| Some(&entry.path) != newest_final.as_ref()) {
        if let Err(error) = storage::of(&entry.path).remove_file(&entry.path) {
            tracing::warn!(path = %entry.path.display(), %error, "cannot remove an old checkpoint");
        }
    }
    Ok(path)
}

/// The newest whole checkpoint in `folder`; of a round's end only, where `only_final`. `None` without any.
#[must_use]
pub fn newest(folder: &Path, only_final: bool) -> Option<Checkpoint> {
    list(folder).into_iter().filter(|entry| entry.is_final || !only_final).find_map(|entry| {
        let read = fs::read(&entry.path).map_err(|error| error.to_string());
        match read.and_then(|bytes| from_bytes(&bytes).map_err(|error| error.to_string())) {
            Ok(checkpoint) => Some(checkpoint),
            Err(error) => {
                tracing::warn!(path = %entry.path.display(), error, "skipping a checkpoint that cannot be used");
                None
            }
        }
    })
}

/// Removes checkpoints within a round, which were of a round that is not wanted any more.
pub fn remove_live(folder: &Path) {
    for entry in list(folder).into_iter().filter(|entry| !entry.is_final) {
        if let Err(error) = storage::of(&entry.path).remove_file(&entry.path) {
            tracing::warn!(path = %entry.path.display(), %error, "cannot remove a checkpoint");
        }
    }
}

struct Entry {
    generation: u64,
    is_final: bool,
    path: PathBuf,
}

/// Checkpoints in a folder, newest first.
fn list(folder: &Path) -> Vec<Entry> {
    let Ok(entries) = fs::read_dir(folder) else { return Vec::new() };
    let mut all: Vec<Entry> = entries
        .filter_map(|entry| {
            let path = entry.ok()?.path();
            let name = path.file_name()?.to_str()?.strip_prefix("checkpoint-")?.strip_suffix(".ckpt")?;
            let (generation, kind) = name.split_once('-')?;
            let is_final = match kind {
                "final" => true,
                "live" => false,
                _ => return None,
            };
            Some(Entry { generation: generation.parse().ok()?, is_final, path })
        })
        .collect();
    all.sort_by(|a, b| b.generation.cmp(&a.generation).then(b.is_final.cmp(&a.is_final)));
    all
}
