//! Removes files that a killed process left half-made.
//!
//! Two kinds wedge every later start: a service description that was written but not yet sealed (mode 0600 in the domain's
//! `services` folder), and a shared-memory file that was made but not yet sized (mode 0200, 0 bytes). A living process
//! passes through both states in far less than [`GRACE`]; what stays in one for longer has no owner.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use shared_types::system::{SHARED_MEMORY_DIR, System};

/// How long a file may stay half-made.
pub const GRACE: Duration = Duration::from_millis(1500);

/// Watches half-made files and removes them when their time is over.
#[derive(Debug)]
pub struct Janitor {
    prefix: String,
    services: PathBuf,
    shared_memory: PathBuf,
    seen: BTreeMap<PathBuf, Instant>,
}

impl Janitor {
    /// The janitor of a system.
    #[must_use]
    pub fn new(system: &System) -> Self {
        Self::with_folders(&system.prefix, &system.runtime_dir.join("bus/services"), Path::new(SHARED_MEMORY_DIR))
    }

    /// The janitor of a prefix in given folders.
    #[must_use]
    pub fn with_folders(prefix: &str, services: &Path, shared_memory: &Path) -> Self {
        Self {
            prefix: prefix.to_owned(),
            services: services.to_owned(),
            shared_memory: shared_memory.to_owned(),
            seen: BTreeMap::new(),
        }
    }

    /// Looks once, at `now`; returns how many files were removed.
    pub fn sweep(&mut self, now: Instant) -> u64 {
        let half_made = self.half_made();
        self.seen.retain(|path, _| half_made.contains(path));
        let mut removed = 0;
        for path in half_made {
            let first = *self.seen.entry(path.clone()).or_insert(now);
            if now.saturating_duration_since(first) < GRACE {
                continue;
            }
            match fs::remove_file(&path) {
                Ok(()) => {
                    removed += 1;
                    tracing::warn!(file = %path.display(), "removed what a killed process left half-made");
                }
                Err(error) => tracing::debug!(file = %path.display(), %error, "could not remove a half-made file"),
            }
            self.seen.remove(&path);
        }
        removed
    }

    fn half_made(&self) -> Vec<PathBuf> {
        let unsealed = self.files(&self.services, |mode, _| mode == 0o600);
        let unsized_memory = self.files(&self.shared_memory, |mode, bytes| mode == 0o200 && bytes == 0);
        unsealed.filter(|path| path.extension().is_some_and(|e| e == "service")).chain(unsized_memory).collect()
    }

    fn files(&self, folder: &Path, wanted: impl Fn(u32, u64) -> bool) -> impl Iterator<Item = PathBuf> {
        fs::read_dir(folder).into_iter().flatten().filter_map(move |entry| {
            let entry = entry.ok()?;
            let ours = entry.file_name().to_str().is_some_and(|name| name.starts_with(&self.prefix));
            // A file may be gone by now: then it is not half-made.
            let data = if ours { entry.metadata().ok()? } else { return None };
            (data.is_file() && wanted(data.permissions().mode() & 0o777, data.len())).then(|| entry.path())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Folders {
        root: tempfile::TempDir,
    }

    impl Folders {
        fn new() -> Self {
            let root = tempfile::tempdir().expect("folder");
            fs::create_dir(root.path().join("services")).expect("services");
            fs::create_dir(root.path().join("shm")).expect("shm");
            Self { root }
        }

        fn janitor(&self) -> Janitor {
            Janitor::with_folders("p_", &self.root.path().join("services"), &self.root.path().join("shm"))
        }

        fn file(&self, name: &str, bytes: &[u8], mode: u32) -> PathBuf {
            let path = self.root.path().join(name);
            fs::write(&path, bytes).expect("written");
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).expect("mode");
            path
        }
    }

    #[test]
    fn half_made_files_go_after_their_time_and_nothing_else_does() {
        let folders = Folders::new();
        let gone = [folders.file("services/p_a.service", b"x", 0o600), folders.file("shm/p_b.dynamic", b"", 0o200)];
        let kept = [
            folders.file("services/p_c.service", b"x", 0o400),
            folders.file("services/q_d.service", b"x", 0o600),
            folders.file("shm/p_e.data", b"x", 0o200),
            folders.file("shm/p_f.data", b"", 0o600),
            folders.file("shm/q_g.dynamic", b"", 0o200),
        ];
        let mut janitor = folders.janitor();
        let start = Instant::now();
        assert_eq!(janitor.sweep(start), 0);
        assert_eq!(janitor.sweep(start + GRACE / 2), 0, "a living process may need it");
        assert_eq!(janitor.sweep(start + GRACE), 2);
        assert!(gone.iter().all(|path| !path.exists()));
        assert!(kept.iter().all(|path| path.exists()));
    }

    #[test]
    fn a_file_that_was_finished_in_between_starts_anew() {
        let folders = Folders::new();
        let path = folders.file("services/p_a.service", b"x", 0o600);
        let mut janitor = folders.janitor();
        let start = Instant::now();
        janitor.sweep(start);
        fs::set_permissions(&path, fs::Permissions::from_mode(0o400)).expect("sealed");
        janitor.sweep(start + GRACE / 2);
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).expect("opened");
        assert_eq!(janitor.sweep(start + GRACE), 0);
        assert!(path.exists());
    }

    #[test]
    fn missing_folders_are_nothing_to_clean() {
        let mut janitor = Janitor::with_folders("p_", Path::new("/nowhere/services"), Path::new("/nowhere/shm"));
        assert_eq!(janitor.sweep(Instant::now()), 0);
    }
}
