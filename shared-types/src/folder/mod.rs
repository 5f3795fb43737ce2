//! The mission folder, which is the truth of a mission: where everything lies in it, and how it is written so that a
//! reader finds each file complete or not at all, whatever dies in between.
//!
//! ```text
//! mission.toml                  the resolved configuration
//! journal.jsonl                 the planner's decisions, one line each
//! keyframes/000017/             rgb.png, depth.png, frame.json
//! prior/overhead, prior/side    the two views of the prior; the same three files
//! model/                        checkpoints and models
//! report/                       what was measured
//! ```

use std::path::{Path, PathBuf};

pub mod files;
pub mod keyframe;
mod png_file;

pub use files::{clean_leftovers, create_dir_durable, write_atomic, write_dir_atomic};
pub use keyframe::{Exposure, Frame, Gate, Keyframe};
pub use png_file::write_frame;

use crate::messages::KeyframeReason;
use crate::storage;

/// What can go wrong with a mission folder. Every variant names the file.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// The system refused.
    #[error("cannot {action} {path}: {source}")]
    Io {
        /// What was tried.
        action: &'static str,
        /// On what.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// No room for a file; nothing of it was left behind.
    #[error("no room for {bytes} bytes of {path}: free disk space, or choose another output folder ({source})")]
    Full {
        /// The file that does not fit.
        path: PathBuf,
        /// Its size.
        bytes: u64,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A new mission was to be put where another lies.
    #[error(
        "{root} already holds a mission ({found} is there): go on with it by `vantage resume {root}`, \
         or choose another folder with --output"
    )]
    HoldsMission {
        /// The folder.
        root: PathBuf,
        /// What gives it away.
        found: &'static str,
    },
    /// A folder that was to be opened holds no mission.
    #[error(
        "{root} holds no mission (neither mission.toml nor keyframes/): give the folder that `vantage fly` printed"
    )]
    NoMission {
        /// The folder.
        root: PathBuf,
    },
    /// What is to be written is there already, or an image is wanted that has no place in the folder.
    #[error("{path} exists already and is never overwritten")]
    Exists {
        /// What is there.
        path: PathBuf,
    },
    /// A file is cut, damaged, or does not fit the files beside it.
    #[error(
        "{path}: {field} is {found}, expected {expected}: the file is damaged; remove its folder and take the view again"
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Which part of it.
        field: String,
        /// What is there.
        found: String,
        /// What should be.
        expected: String,
    },
}

const SUBFOLDERS: [&str; 4] = ["keyframes", "prior", "model", "report"];

/// A mission folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MissionFolder {
    root: PathBuf,
}

impl MissionFolder {
    /// Makes the folder of a new mission, with its subfolders. The folder may exist, but not hold a mission.
    ///
    /// # Errors
    /// [`FolderError::HoldsMission`] where one lies already; [`FolderError::Io`] where the folder cannot be made.
    pub fn create(root: impl AsRef<Path>) -> Result<Self, FolderError> {
        let folder = Self::vacant(root.as_ref())?;
        folder.make_subfolders()?;
        Ok(folder)
    }

    /// As [`Self::create`], with `mission.toml` before everything else, so that what a kill leaves can be resumed. On an
    /// error, what was made is taken away again: the same command may be given once more.
    ///
    /// # Errors
    /// As [`Self::create`]; [`FolderError::Full`] where the disk is.
    pub fn create_with(root: impl AsRef<Path>, config: &str) -> Result<Self, FolderError> {
        let folder = Self::vacant(root.as_ref())?;
        let fresh = !folder.root.exists();
        let made = create_dir_durable(&folder.root)
            .and_then(|()| write_atomic(&folder.config_path(), config.as_bytes()))
            .and_then(|()| folder.make_subfolders());
        if let Err(error) = made {
            // Only what is empty or was written here: as far as it goes, the first error is the one to tell.
            for sub in SUBFOLDERS {
                std::fs::remove_dir(folder.root.join(sub)).ok();
            }
            storage::of(&folder.root).remove_file(&folder.config_path()).ok();
            if fresh {
                std::fs::remove_dir(&folder.root).ok();
            }
            return Err(error);
        }
        Ok(folder)
    }

    fn make_subfolders(&self) -> Result<(), FolderError> {
        SUBFOLDERS.iter().try_for_each(|sub| create_dir_durable(&self.root.join(sub)))
    }

    /// The folder of a mission that is yet to be made.
    fn vacant(root: &Path) -> Result<Self, FolderError> {
        let folder = Self { root: absolute(root)? };
        for found in ["mission.toml", "journal.jsonl", "keyframes", "prior", "model"] {
            if folder.root.join(found).exists() {
                return Err(FolderError::HoldsMission { root: folder.root, found });
            }
        }
        Ok(folder)
    }

    /// Opens the folder of a mission, and removes what dead writers left half-made in it.
    ///
    /// # Errors
    /// [`FolderError::NoMission`] where none lies; [`FolderError::Io`].
    pub fn open(root: impl AsRef<Path>) -> Result<Self, FolderError> {
        let folder = Self { root: absolute(root.as_ref())? };
        if !folder.config_path().is_file() && !folder.keyframes_path().is_dir() {
            return Err(FolderError::NoMission { root: folder.root });
        }
        for sub in ["", "keyframes", "prior", "model", "report"] {
            clean_leftovers(&folder.root.join(sub))?;
        }
        Ok(folder)
    }

    /// The folder itself, absolute.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// `mission.toml`: the resolved configuration, versions, seed, declared costs.
    #[must_use]
    pub fn config_path(&self) -> PathBuf {
        self.root.join("mission.toml")
    }

    /// `journal.jsonl`: the planner's decisions.
    #[must_use]
    pub fn journal_path(&self) -> PathBuf {
        self.root.join("journal.jsonl")
    }

    /// `keyframes`: one folder a keyframe.
    #[must_use]
    pub fn keyframes_path(&self) -> PathBuf {
        self.root.join("keyframes")
    }

    /// `keyframes/000017`.
    #[must_use]
    pub fn keyframe_path(&self, id: u64) -> PathBuf {
        self.keyframes_path().join(format!("{id:06}"))
    }

    /// `prior`: the two views of the prior, and those that checked them.
    #[must_use]
    pub fn prior_path(&self) -> PathBuf {
        self.root.join("prior")
    }

    /// Where a view taken for a reason lies: prior views under `prior/`, keyframes under their number. `None` for a
    /// frame of the stream, which is never stored.
    #[must_use]
    pub fn view_path(&self, reason: KeyframeReason, id: u64) -> Option<PathBuf> {
        match reason {
            KeyframeReason::Stream => None,
            KeyframeReason::PriorOverhead => Some(self.prior_path().join("overhead")),
            KeyframeReason::PriorSide => Some(self.prior_path().join("side")),
            KeyframeReason::CheckOverhead => Some(self.prior_path().join("check-overhead")),
            KeyframeReason::CheckSide => Some(self.prior_path().join("check-side")),
            KeyframeReason::Seed | KeyframeReason::Selected => Some(self.keyframe_path(id)),
        }
    }

    /// `model`: checkpoints, models of each round, the final model.
    #[must_use]
    pub fn model_path(&self) -> PathBuf {
        self.root.join("model")
    }

    /// `trace/`: how long stages of the processes took, where that was asked for.
    #[must_use]
    pub fn trace_path(&self) -> PathBuf {
        self.root.join("trace")
    }

    /// `report`: what was measured.
    #[must_use]
    pub fn report_path(&self) -> PathBuf {
        self.root.join("report")
    }
}

fn absolute(path: &Path) -> Result<PathBuf, FolderError> {
    std::path::absolute(path).map_err(|source| FolderError::Io { action: "find", path: path.to_owned(), source })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_takes_one_mission() {
        let dir = tempfile::tempdir().expect("tempdir");
        let root = dir.path().join("m");
        assert!(matches!(MissionFolder::open(&root), Err(FolderError::NoMission { .. })));
        let made = MissionFolder::create(&root).expect("new");
        assert_eq!(MissionFolder::open(&root).expect("open"), made);
        let message = MissionFolder::create(&root).expect_err("holds one").to_string();
        assert!(message.contains("vantage resume") && message.contains(&root.display().to_string()), "{message}");
    }

    #[test]
    fn what_could_not_be_made_whole_leaves_no_mission() {
        let dir = tempfile::tempdir().expect("tempdir");
        // A file in the way of the last subfolder.
        std::fs::write(dir.path().join("report"), "mine").expect("write");
        MissionFolder::create_with(dir.path(), "a = 1\n").expect_err("a file is in the way");
        assert_eq!(std::fs::read_dir(dir.path()).expect("there").count(), 1, "all but the file is gone");
        std::fs::remove_file(dir.path().join("report")).expect("out of the way");
        let folder = MissionFolder::create_with(dir.path(), "a = 1\n").expect("the same command again");
        assert_eq!(std::fs::read(folder.config_path()).expect("written"), b"a = 1\n");
    }

    #[test]
    fn an_existing_folder_without_a_mission_is_taken() {
        let dir = tempfile::tempdir().expect("tempdir");
        std::fs::write(dir.path().join("notes.txt"), "mine").expect("write");
        MissionFolder::create(dir.path()).expect("no mission in it");
        assert_eq!(std::fs::read(dir.path().join("notes.txt")).expect("kept"), b"mine");
    }

    #[test]
    fn a_file_in_the_way_is_named() {
        let dir = tempfile::tempdir().expect("tempdir");
        let root = dir.path().join("file");
        std::fs::write(&root, "x").expect("write");
        let message = MissionFolder::create(&root).expect_err("a file").to_string();
        assert!(message.contains("file"), "{message}");
    }
}
