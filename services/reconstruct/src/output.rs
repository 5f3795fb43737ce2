//! The folder of a run: who may write into it, what lies there, and what is written at the end.

use std::fs::{self, File, TryLockError};
use std::path::{Component, Path, PathBuf};

use shared_types::folder::{FolderError, create_dir_durable, write_atomic};
use shared_types::storage;

use crate::checkpoint::{self, State};
use crate::error::ReconstructError;
use crate::options::Identity;

const RUN: &str = "run.json";
const LOCK: &str = "lock";
/// What a finished run leaves; `metrics.json` comes last.
const RESULTS: [&str; 5] = ["model.ply", "metrics.csv", "curve.png", "held-out.png", "metrics.json"];

/// What a mission keeps in folders of these names: no place for a run.
const MISSION_FOLDERS: [&str; 4] = ["keyframes", "prior", "model", "report"];

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
    /// [`ReconstructError::Output`] where it cannot be written into, [`ReconstructError::Busy`] where another run goes on,
    /// [`ReconstructError::NotOurs`] and [`ReconstructError::InMission`] where results would replace what no run wrote.
    pub fn open(root: &Path) -> Result<Self, ReconstructError> {
        if let Some(mission) = mission_around(root) {
            return Err(ReconstructError::InMission { out: root.to_owned(), mission });
        }
        check_ours(root)?;
        let refused = |path: &Path| {
            let path = path.to_owned();
            |source| ReconstructError::Output { path, source }
        };
        create_dir_durable(root).map_err(|error| match error {
            FolderError::Io { .. } => refused(root)(std::io::Error::other(error)),
            error => error.into(),
        })?;
        let path = root.join(LOCK);
        if !path.exists() {
            // It tells that what lies beside it is ours: on the disk before all of that.
            let disk = storage::of(root);
            disk.append(&path).and_then(|_file| disk.sync_dir(root)).map_err(refused(&path))?;
        }
        let lock = File::options().write(true).open(&path).map_err(refused(&path))?;
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

    /// The identity of the run that the folder holds; `None` where it holds none.
    ///
    /// # Errors
    /// [`ReconstructError::DamagedRun`] where `run.json` says nothing: what its checkpoints belong to is then not known.
    pub fn identity(&self) -> Result<Option<Identity>, ReconstructError> {
        let path = self.path(RUN);
        match fs::read(&path) {
            Ok(bytes) => match serde_json::from_slice(&bytes) {
                Ok(identity) => Ok(Some(identity)),
                Err(error) => Err(ReconstructError::DamagedRun { path, found: error.to_string() }),
            },
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
            Err(source) => Err(ReconstructError::Output { path, source }),
        }
    }

    /// Admits a run: gives where it stands if the folder holds the same one, unfinished; `None` where it begins.
    ///
    /// # Errors
    /// [`ReconstructError::OtherRun`] where another run lies there and may not be replaced; as [`Output::identity`].
    pub fn admit(&self, identity: &Identity, overwrite: bool) -> Result<Option<State>, ReconstructError> {
        if !overwrite && let Some(found) = self.identity()? {
            return match found.difference(identity) {
                None => Ok(checkpoint::newest(&self.root, run_sum(identity))),
                Some((what, found, wanted)) => {
                    Err(ReconstructError::OtherRun { out: self.root.clone(), what, found, wanted })
                }
            };
        }
        checkpoint::remove_all(&self.root);
        for name in RESULTS {
            match storage::of(&self.root).remove_file(&self.path(name)) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                    return Err(ReconstructError::Output { path: self.path(name), source: error });
                }
                _ => {}
            }
        }
        let text = serde_json::to_string_pretty(identity).unwrap_or_default() + "\n";
        write_atomic(&self.path(RUN), text.as_bytes())?;
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

/// Refuses a folder that holds files of a run's names without being a run's folder: they are somebody's own.
fn check_ours(root: &Path) -> Result<(), ReconstructError> {
    if root.join(RUN).exists() && root.join(LOCK).exists() {
        return Ok(());
    }
    let mut found: Vec<String> =
        RESULTS.iter().chain([&RUN]).filter(|name| root.join(name).exists()).map(ToString::to_string).collect();
    found.extend(checkpoint::any(root));
    if found.is_empty() {
        Ok(())
    } else {
        Err(ReconstructError::NotOurs { out: root.to_owned(), found: found.join(", ") })
    }
}

/// The mission that a folder is, or that keeps its own files there. `<mission>/reconstruct` is in none of its folders.
fn mission_around(out: &Path) -> Option<PathBuf> {
    let out = resolved(out);
    let is_mission = |folder: &Path| folder.join("mission.toml").is_file() || folder.join("keyframes").is_dir();
    if is_mission(&out) {
        return Some(out);
    }
    let kept = |folder: &Path| {
        let mission = folder.parent()?;
        let name = folder.file_name()?.to_str()?;
        (MISSION_FOLDERS.contains(&name) && is_mission(mission)).then(|| mission.to_owned())
    };
    out.ancestors().find_map(kept)
}

/// A path without links and steps back, as far as it exists.
fn resolved(path: &Path) -> PathBuf {
    let absolute = std::path::absolute(path).unwrap_or_else(|_none| path.to_owned());
    let mut whole = PathBuf::new();
    for part in absolute.components() {
        match part {
            Component::ParentDir => {
                whole.pop();
            }
            part => whole.push(part),
        }
        if let Ok(real) = whole.canonicalize() {
            whole = real;
        }
    }
    whole
}

#[cfg(test)]
mod tests {
    use super::*;

    fn files(root: &Path) -> Vec<(String, Vec<u8>)> {
        let mut files: Vec<_> = fs::read_dir(root)
            .expect("folder")
            .map(|entry| entry.expect("entry").path())
            .filter(|path| path.is_file())
            .map(|path| (path.display().to_string(), fs::read(&path).expect("readable")))
            .collect();
        files.sort();
        files
    }

    #[test]
    fn what_no_run_wrote_is_named_and_stays() {
        let dir = tempfile::tempdir().expect("folder");
        for name in RESULTS.iter().chain(&["checkpoint-000000007.ckpt", RUN]) {
            let root = dir.path().join(format!("{name}.d"));
            fs::create_dir(&root).expect("folder");
            fs::write(root.join(name), "mine").expect("written");
            let before = files(&root);
            let message = Output::open(&root).expect_err("somebody's").to_string();
            assert!(message.contains(name) && message.contains("--out"), "{message}");
            assert_eq!(files(&root), before, "untouched, and no lock beside it");
        }
        fs::write(dir.path().join("notes.txt"), "mine").expect("written");
        Output::open(dir.path()).expect("nothing of a run's names");
    }

    #[test]
    fn a_mission_and_its_own_folders_are_no_output() {
        let dir = tempfile::tempdir().expect("folder");
        let mission = dir.path().join("m");
        for name in MISSION_FOLDERS {
            fs::create_dir_all(mission.join(name)).expect("folder");
        }
        fs::write(mission.join("mission.toml"), "").expect("written");
        for inside in ["", "model", "report", "report/new", "keyframes/x/y", "prior", "new/../model"] {
            let refused = Output::open(&mission.join(inside)).expect_err(inside);
            assert!(matches!(refused, ReconstructError::InMission { .. }), "{inside}: {refused}");
        }
        assert!(!mission.join("report/new").exists() && !mission.join("lock").exists());
        std::os::unix::fs::symlink(mission.join("report"), dir.path().join("link")).expect("link");
        assert!(matches!(Output::open(&dir.path().join("link")), Err(ReconstructError::InMission { .. })));
        for beside in ["m/reconstruct", "m/more/model", "model"] {
            Output::open(&dir.path().join(beside)).expect(beside);
        }
    }
}
