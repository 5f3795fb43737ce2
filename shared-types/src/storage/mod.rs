//! What Vantage asks of a disk, and nothing more: every file that it writes goes through [`Storage`].
//!
//! In the product that is always the machine's own file system ([`Disk`]). A test mounts another on a folder ([`mount`]): a
//! [`record::Recorder`], whose trace [`replay`] cuts as a loss of power would, or a disk that is [`faulty`]. Whoever writes
//! does not know; reading is by plain `std::fs`, for all of them keep their files where they say.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock};

pub mod faulty;
pub mod record;
pub mod replay;

/// A file system, as far as it is written to. Nothing is on the disk for certain before it was synced: the bytes of a file
/// by [`WriteFile::sync`], names by [`Storage::sync_dir`] of their folder. Errors are those of the operating system.
pub trait Storage: core::fmt::Debug + Send + Sync {
    /// Makes a folder in one that is there.
    ///
    /// # Errors
    /// As `mkdir(2)`.
    fn create_dir(&self, path: &Path) -> io::Result<()>;

    /// Makes a file that is not there yet.
    ///
    /// # Errors
    /// As `open(2)` with `O_CREAT | O_EXCL`.
    fn create(&self, path: &Path) -> io::Result<Box<dyn WriteFile>>;

    /// Opens a file to write at its end; makes it where there is none.
    ///
    /// # Errors
    /// As `open(2)` with `O_CREAT | O_APPEND`.
    fn append(&self, path: &Path) -> io::Result<Box<dyn WriteFile>>;

    /// Gives a file or folder another name in the same folder, in place of what has that name.
    ///
    /// # Errors
    /// As `rename(2)`.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;

    /// Exchanges the names of two files or folders of the same folder.
    ///
    /// # Errors
    /// As `renameat2(2)` with `RENAME_EXCHANGE`.
    fn exchange(&self, one: &Path, other: &Path) -> io::Result<()>;

    /// Removes a file.
    ///
    /// # Errors
    /// As `unlink(2)`.
    fn remove_file(&self, path: &Path) -> io::Result<()>;

    /// Removes a folder and all that is in it.
    ///
    /// # Errors
    /// As [`fs::remove_dir_all`].
    fn remove_dir_all(&self, path: &Path) -> io::Result<()>;

    /// Brings the names in a folder to the disk.
    ///
    /// # Errors
    /// As `fsync(2)`.
    fn sync_dir(&self, path: &Path) -> io::Result<()>;
}

/// A file that is written to.
pub trait WriteFile: core::fmt::Debug + Send {
    /// Writes at the end. After an error, a part may be there.
    ///
    /// # Errors
    /// As `write(2)`.
    fn write(&mut self, bytes: &[u8]) -> io::Result<()>;

    /// Cuts the file to so many bytes.
    ///
    /// # Errors
    /// As `ftruncate(2)`.
    fn cut(&mut self, bytes: u64) -> io::Result<()>;

    /// Brings what was written to the disk.
    ///
    /// # Errors
    /// As `fsync(2)`.
    fn sync(&mut self) -> io::Result<()>;
}

/// Whether an error says that there is no room.
#[must_use]
pub fn is_full(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded | io::ErrorKind::FileTooLarge)
}

static MOUNTS: RwLock<Vec<(PathBuf, Arc<dyn Storage>)>> = RwLock::new(Vec::new());

/// The file system that a path lies on.
#[must_use]
pub fn of(path: &Path) -> Arc<dyn Storage> {
    let mounts = MOUNTS.read().unwrap_or_else(PoisonError::into_inner);
    match mounts.iter().rev().find(|(folder, _)| path.starts_with(folder)) {
        Some((_, storage)) => Arc::clone(storage),
        None => Arc::new(Disk),
    }
}

/// While this lives, what is written below a folder goes to another file system.
#[derive(Debug)]
pub struct Mount {
    storage: Arc<dyn Storage>,
}

/// Mounts a file system on a folder, for this process: for tests.
#[must_use]
pub fn mount(folder: &Path, storage: Arc<dyn Storage>) -> Mount {
    let mut mounts = MOUNTS.write().unwrap_or_else(PoisonError::into_inner);
    mounts.push((folder.to_owned(), Arc::clone(&storage)));
    Mount { storage }
}

impl Drop for Mount {
    fn drop(&mut self) {
        let mut mounts = MOUNTS.write().unwrap_or_else(PoisonError::into_inner);
        mounts.retain(|(_, storage)| !Arc::ptr_eq(storage, &self.storage));
    }
}

/// The machine's own file system.
#[derive(Debug, Clone, Copy)]
pub struct Disk;

impl Storage for Disk {
    fn create_dir(&self, path: &Path) -> io::Result<()> {
        fs::create_dir(path)
    }

    fn create(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        Ok(Box::new(OpenOptions::new().write(true).create_new(true).open(path)?))
    }

    fn append(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        Ok(Box::new(OpenOptions::new().create(true).append(true).open(path)?))
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    fn exchange(&self, one: &Path, other: &Path) -> io::Result<()> {
        let here = rustix::fs::CWD;
        Ok(rustix::fs::renameat_with(here, one, here, other, rustix::fs::RenameFlags::EXCHANGE)?)
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }

    fn remove_dir_all(&self, path: &Path) -> io::Result<()> {
        fs::remove_dir_all(path)
    }

    fn sync_dir(&self, path: &Path) -> io::Result<()> {
        File::open(path)?.sync_all()
    }
}

impl WriteFile for File {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.write_all(bytes)
    }

    fn cut(&mut self, bytes: u64) -> io::Result<()> {
        self.set_len(bytes)
    }

    fn sync(&mut self) -> io::Result<()> {
        self.sync_all()
    }
}
