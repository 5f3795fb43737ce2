//! The folder of a run: who may write into it, what lies there, and what is written at the end.

use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};

use shared_types::folder::write_atomic;

use crate::checkpoint::{self, State};
use crate::error::ReconstructError;
use crate::options::Identity;

const RUN: &str = "run.json";
const LOCK: &str = "lock";
/// What a finished run leaves; `metrics.json` comes last.
const RESULTS: [&str; 5] = ["model.ply", "metrics.csv", "curve.png", "held-out.png", "metrics.json"];

/// The folder of a run, held by this process.
#[derive(Debug)]
pub struct Output {
    root: PathBuf,
    /// Held while this lives; the system lets it go when the process dies, however that happens.
    _lock: File,
}

impl Output {
    /// Makes the folder where there is none, and takes hold of it.
    ///
    /// # Errors
    /// [`ReconstructError::Output`] where it cannot be written into, [`ReconstructError::Busy`] where another run goes on.
    pub fn open(root: &Path) -> Result<Self, ReconstructError> {
        let refused = |path: &Path| {
            let path = path.to_owned();
            |source| ReconstructError::Output { path, source }
        };
        fs::create_dir_all(root).map_err(refused(root))?;
        let path = root.join(LOCK);
        let lock = File::options().create(true).write(true).truncate(false).open(&path).map_err(refused(&path))?;
        match lock.try_lock() {
            Ok(()) => Ok(Self { root: root.to_owned(), _lock: lock }),
            Err(TryLockError::WouldBlock) => Err(ReconstructError::Busy { out: root.to_owned() }),
            Err(TryLockError::Error(source)) => Err(ReconstructError::Output { path, source }),
        }
    }

    /// Refuses a folder whose results would be replaced without `overwrite`; needs no dataset, so that nothing is read in
    /// vain.
    ///
    /// # Errors
    /// [`ReconstructError::Finished`].
    pub fn check_finished(&self, overwrite: bool) -> Result<(), ReconstructError> {
        let finished = self.path("metrics.json").exists();
        if finished && !overwrite { Err(ReconstructError::Finished { out: self.root.clone() }) } else { Ok(()) }
    }

    /// Admits a run: gives where it stands if the folder holds the same one, unfinished; `None` where it begins.
    ///
    /// # Errors
    /// [`ReconstructError::OtherRun`] where another run lies there and may not be replaced.
    pub fn admit(&self, identity: &Identity, overwrite: bool) -> Result<Option<State>, ReconstructError> {
        let path = self.path(RUN);
        let found = match fs::read(&path) {
            Ok(bytes) => serde_json::from_slice::<Identity>(&bytes).ok(),
            Err(_absent) => None,
        };
        if !overwrite && let Some(found) = &found {
            return match found.difference(identity) {
                None => Ok(checkpoint::newest(&self.root, run_sum(identity))),
                Some((what, found, wanted)) => {
                    Err(ReconstructError::OtherRun { out: self.root.clone(), what, found, wanted })
                }
            };
        }
        checkpoint::remove_all(&self.root);
        for name in RESULTS {
            match fs::remove_file(self.path(name)) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                    return Err(ReconstructError::Output { path: self.path(name), source: error });
                }
                _ => {}
            }
        }
        let text = serde_json::to_string_pretty(identity).unwrap_or_default() + "\n";
        write_atomic(&path, text.as_bytes())?;
        Ok(None)
    }

    /// A file of the folder.
    #[must_use]
    pub fn path(&self, name: &str) -> PathBuf {
        self.root.join(name)
    }

    /// The folder.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }
}

/// Checksum of a run's identity, by which checkpoints know their run.
#[must_use]
pub fn run_sum(identity: &Identity) -> u64 {
    splatting::bytes::checksum(&serde_json::to_vec(identity).unwrap_or_default())
}
