//! A system: one vehicle and its services, in one iceoryx2 domain of its own.
//!
//! Every run makes a fresh system, so that runs and tests live side by side and a domain that was wedged by a kill never
//! outlives its run. Its folder lies on tmpfs: opening a channel there is faster, and the instant in which a kill leaves
//! half-made files is shorter.

use std::fs::{self, File};
use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::fs::{FlockOperation, flock};
use serde::{Deserialize, Serialize};

use crate::folder::{FolderError, clean_leftovers, write_atomic};
use crate::storage;

/// Where iceoryx2 keeps shared memory.
pub const SHARED_MEMORY_DIR: &str = "/dev/shm";

/// Where systems of system services are.
pub const ONBOARD_DIR: &str = "/run/vantage";

/// The root path and names must fit a unix socket's path (107 bytes), of which iceoryx2 needs about 42.
const LONGEST_ROOT: usize = 64;

/// What went wrong with a system's folder.
#[derive(Debug, thiserror::Error)]
pub enum SystemError {
    /// A file or folder could not be handled.
    #[error("{}: cannot {action}; expected a folder on tmpfs that this user may write (see `vantage doctor`)", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// The operating system's word.
        #[source]
        source: std::io::Error,
    },
    /// `system.json` is not one.
    #[error("{}: not a system description; remove the folder, its run is over", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// The parser's word.
        #[source]
        source: serde_json::Error,
    },
    /// The folder's path is too long for sockets.
    #[error("{}: {length} bytes, expected at most {LONGEST_ROOT} (unix sockets lie inside); set XDG_RUNTIME_DIR to a shorter folder", path.display())]
    PathTooLong {
        /// The folder.
        path: PathBuf,
        /// Its length.
        length: usize,
    },
    /// Processes of a system of that name run.
    #[error("{}: a system of this name runs (`vantage status`); expected none: stop it first, or choose another --system", path.display())]
    Runs {
        /// Its folder.
        path: PathBuf,
    },
    /// A name that is none.
    #[error("--system {name:?}: expected a name without '/', at most {LONGEST_ROOT} bytes with its folder")]
    BadName {
        /// What was given.
        name: String,
    },
    /// The folder vanished while it was opened.
    #[error("{}: the system ended while it was joined; start it again", path.display())]
    Ended {
        /// The folder.
        path: PathBuf,
    },
    /// No system, or more than one, where one was expected.
    #[error("{found} systems in {}: {names}; expected one: name it with --system", base.display())]
    NotOne {
        /// Where was looked.
        base: PathBuf,
        /// How many there are.
        found: usize,
        /// Their names.
        names: String,
    },
}

impl SystemError {
    /// Whether there is no system description at all, as before a system is made.
    #[must_use]
    pub fn is_absent(&self) -> bool {
        matches!(self, Self::Io { action: "read", source, .. } if source.kind() == ErrorKind::NotFound)
    }
}

/// Keeps a system from being taken for dead: every process with a part in it has one for its life. A killed process loses
/// it with everything else, so no trace of the dead can be mistaken for life.
#[derive(Debug)]
pub struct Hold {
    _lock: File,
}

/// A system and where its parts lie. Stored as `system.json` in its folder.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct System {
    /// Name, unique among the systems of this user.
    pub name: String,
    /// Folder on tmpfs: `system.json`, the resolved configuration, px4-link's last return path, iceoryx2's files.
    pub runtime_dir: PathBuf,
    /// What every name in shared memory begins with.
    pub prefix: String,
    /// Process that made it and supervises it; 0 for none.
    pub supervisor_pid: u32,
    /// Version of the binary.
    pub version: String,
}

impl System {
    /// The folder that holds all systems: `/run/vantage` under systemd, else `$XDG_RUNTIME_DIR/vantage`, else in shared
    /// memory.
    #[must_use]
    pub fn base_dir() -> PathBuf {
        if std::env::var_os("RUNTIME_DIRECTORY").is_some() {
            return PathBuf::from(ONBOARD_DIR);
        }
        match std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from) {
            Some(dir) if dir.is_dir() => dir.join("vantage"),
            _ => PathBuf::from(format!("{SHARED_MEMORY_DIR}/vantage-{}", rustix::process::getuid().as_raw())),
        }
    }

    /// Makes a fresh system below `base`. What a dead one of that name left is removed first.
    ///
    /// # Errors
    /// When the folder cannot be made or its path is too long, or when a system of that name runs.
    pub fn create(base: &Path, name: &str, supervisor_pid: u32) -> Result<Self, SystemError> {
        Self::create_held(base, name, supervisor_pid).map(|(system, _)| system)
    }

    /// As [`Self::create`]; the system is held from its first instant, so that nobody takes it for dead meanwhile.
    ///
    /// # Errors
    /// As [`Self::create`].
    pub fn create_held(base: &Path, name: &str, supervisor_pid: u32) -> Result<(Self, Hold), SystemError> {
        if name.is_empty() || name.contains('/') || name.starts_with('.') {
            return Err(SystemError::BadName { name: name.to_owned() });
        }
        let runtime_dir = base.join(name);
        let length = runtime_dir.as_os_str().len();
        if length > LONGEST_ROOT {
            return Err(SystemError::PathTooLong { path: runtime_dir, length });
        }
        let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
        let unique =
            (now.tv_sec.unsigned_abs() << 20) ^ now.tv_nsec.unsigned_abs() ^ (u64::from(std::process::id()) << 40);
        let system = Self {
            name: name.to_owned(),
            prefix: format!("v{:08x}_", crate::payload::fold(crate::payload::SCHEMA_SEED, unique) >> 32),
            runtime_dir,
            supervisor_pid,
            version: env!("CARGO_PKG_VERSION").to_owned(),
        };
        io(base, "make", fs::create_dir_all(base))?;
        let hold = system.claim_folder()?;
        let config = format!(
            "[global]\nroot-path = '{}'\nprefix = '{}'\n",
            system.runtime_dir.join("bus").display(),
            system.prefix
        );
        let config_path = system.bus_config_path();
        write_whole(&config_path, config.as_bytes())?;
        let description = system.runtime_dir.join("system.json");
        let text = serde_json::to_string_pretty(&system)
            .map_err(|source| SystemError::Malformed { path: description.clone(), source })?;
        write_whole(&description, text.as_bytes())?;
        Ok((system, hold))
    }

    /// Makes the folder and holds it. Another process may make or remove the same one at the same time: then once more.
    fn claim_folder(&self) -> Result<Hold, SystemError> {
        for _ in 0..50 {
            match storage::of(&self.runtime_dir).create_dir(&self.runtime_dir) {
                Ok(()) => match self.hold() {
                    Err(SystemError::Ended { .. } | SystemError::Runs { .. }) => {}
                    held => return held,
                },
                Err(error) if error.kind() == ErrorKind::AlreadyExists => remove_dead(&self.runtime_dir)?,
                Err(source) => {
                    return Err(SystemError::Io { path: self.runtime_dir.clone(), action: "make", source });
                }
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Err(SystemError::Runs { path: self.runtime_dir.clone() })
    }

    /// Holds the system for as long as the returned value lives.
    ///
    /// # Errors
    /// When it is gone, or being removed.
    pub fn hold(&self) -> Result<Hold, SystemError> {
        let ended = || SystemError::Ended { path: self.runtime_dir.clone() };
        let lock = match File::open(&self.runtime_dir) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Err(ended()),
            opened => io(&self.runtime_dir, "open", opened)?,
        };
        let mut tries = 0;
        while let Err(error) = flock(&lock, FlockOperation::NonBlockingLockShared) {
            // Somebody looks whether the system is alive, which takes an instant, or removes it.
            if error != rustix::io::Errno::WOULDBLOCK {
                return io(&self.runtime_dir, "lock", Err(error.into()));
            }
            if tries == 50 {
                return Err(ended());
            }
            tries += 1;
            std::thread::sleep(Duration::from_millis(2));
        }
        // The folder may have been removed, and even made anew, between opening and locking.
        let inode = io(&self.runtime_dir, "read", lock.metadata())?.ino();
        match fs::metadata(&self.runtime_dir) {
            Ok(now) if now.ino() == inode => Ok(Hold { _lock: lock }),
            _ => Err(ended()),
        }
    }

    /// Whether any process has a part in this system.
    #[must_use]
    pub fn is_alive(&self) -> bool {
        File::open(&self.runtime_dir)
            .is_ok_and(|folder| flock(&folder, FlockOperation::NonBlockingLockExclusive).is_err())
    }

    /// Removes everything that belongs to this system, unless a process has a part in it; true when it is removed.
    ///
    /// # Errors
    /// When the folder cannot be removed.
    pub fn remove_if_dead(&self) -> Result<bool, SystemError> {
        match remove_dead(&self.runtime_dir) {
            Ok(()) => Ok(true),
            Err(SystemError::Runs { .. }) => Ok(false),
            Err(error) => Err(error),
        }
    }

    /// Opens a system by its folder.
    ///
    /// # Errors
    /// When there is no readable `system.json`.
    pub fn open(runtime_dir: &Path) -> Result<Self, SystemError> {
        let path = runtime_dir.join("system.json");
        let text = io(&path, "read", fs::read_to_string(&path))?;
        serde_json::from_str(&text).map_err(|source| SystemError::Malformed { path, source })
    }

    /// Opens the system of a name (or folder), or the only one there is.
    ///
    /// # Errors
    /// When there is none, or several and none was named.
    pub fn find(base: &Path, name: Option<&str>) -> Result<Self, SystemError> {
        match name {
            Some(name) if name.contains('/') => Self::open(Path::new(name)),
            Some(name) => Self::open(&base.join(name)),
            None => {
                let mut systems = Self::list(base);
                if systems.is_empty() {
                    // A user who looks at what runs as a system service.
                    systems = Self::list(Path::new(ONBOARD_DIR));
                }
                match (systems.len(), systems.pop()) {
                    (1, Some(system)) => Ok(system),
                    (found, last) => {
                        let names = systems.iter().chain(&last).map(|s| s.name.as_str()).collect::<Vec<_>>().join(", ");
                        Err(SystemError::NotOne { base: base.to_owned(), found, names })
                    }
                }
            }
        }
    }

    /// Every system below `base`, by name; what cannot be read is left out.
    #[must_use]
    pub fn list(base: &Path) -> Vec<Self> {
        let mut systems: Vec<Self> =
            fs::read_dir(base).into_iter().flatten().filter_map(|entry| Self::open(&entry.ok()?.path()).ok()).collect();
        systems.sort_by(|a, b| a.name.cmp(&b.name));
        systems
    }

    /// iceoryx2's configuration of this domain.
    #[must_use]
    pub fn bus_config_path(&self) -> PathBuf {
        self.runtime_dir.join("iceoryx2.toml")
    }

    /// The resolved configuration that all services of this system read.
    #[must_use]
    pub fn config_path(&self) -> PathBuf {
        self.runtime_dir.join("config.toml")
    }

    /// Names of this system's files in shared memory.
    #[must_use]
    pub fn shared_memory_files(&self) -> Vec<PathBuf> {
        let mut files: Vec<PathBuf> = fs::read_dir(SHARED_MEMORY_DIR)
            .into_iter()
            .flatten()
            .filter_map(|entry| Some(entry.ok()?.path()))
            .filter(|path| path.file_name().and_then(|n| n.to_str()).is_some_and(|n| n.starts_with(&self.prefix)))
            .collect();
        files.sort();
        files
    }

    /// Removes everything that belongs to this system. Only when none of its processes runs: files removed under a
    /// running process split the domain in two.
    ///
    /// # Errors
    /// When the folder cannot be removed; shared memory is removed as far as possible first.
    pub fn remove(&self) -> Result<(), SystemError> {
        for file in self.shared_memory_files() {
            if let Err(error) = fs::remove_file(&file) {
                tracing::warn!(file = %file.display(), %error, "could not remove shared memory");
            }
        }
        io(&self.runtime_dir, "remove", fs::remove_dir_all(&self.runtime_dir))
    }
}

/// Removes the system in a folder if no process holds it. The lock is kept until the folder is gone, so that nobody joins
/// what is being removed.
fn remove_dead(folder: &Path) -> Result<(), SystemError> {
    let lock = match File::open(folder) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        opened => io(folder, "open", opened)?,
    };
    match flock(&lock, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => {}
        Err(rustix::io::Errno::WOULDBLOCK) => return Err(SystemError::Runs { path: folder.to_owned() }),
        Err(error) => io(folder, "lock", Err(error.into()))?,
    }
    match System::open(folder) {
        Ok(system) => System { runtime_dir: folder.to_owned(), ..system }.remove(),
        // Its maker was killed before the description was there: nothing else can be inside yet.
        Err(error) if error.is_absent() => {
            fs::remove_file(folder.join("iceoryx2.toml")).ok();
            // A leftover that cannot be removed is told by the folder, which then cannot be either.
            clean_leftovers(folder).ok();
            io(folder, "remove", fs::remove_dir(folder))
        }
        // Without its description, its files in shared memory cannot be told from others'.
        Err(error) => Err(error),
    }
}

/// Tools that list systems never read half of a file, whatever dies meanwhile.
fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), SystemError> {
    write_atomic(path, bytes).map_err(|error| match error {
        FolderError::Io { action, path, source } => SystemError::Io { path, action, source },
        other => SystemError::Io { path: path.to_owned(), action: "write", source: std::io::Error::other(other) },
    })
}

fn io<T>(path: &Path, action: &'static str, result: std::io::Result<T>) -> Result<T, SystemError> {
    result.map_err(|source| SystemError::Io { path: path.to_owned(), action, source })
}

#[cfg(test)]
mod tests;
