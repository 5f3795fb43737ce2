//! Files and folders that appear whole: written aside, brought to the disk, renamed, the folder brought to the disk.
//!
//! The name aside carries the writer's process id and start time, so that what a dead writer left is told from what a
//! living one is writing, and removed by the next writer in that folder.

use std::fs;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

use super::FolderError;
use crate::fault_point;
use crate::storage::{self, WriteFile};

const ASIDE: &str = ".tmp-";

/// Writes a file so that a reader finds the old content or the new, never a part, through a crash of the machine too.
///
/// # Errors
/// [`FolderError::Full`] or [`FolderError::Io`], naming the path; the old content then still stands.
pub fn write_atomic(path: &Path, bytes: &[u8]) -> Result<(), FolderError> {
    let parent = parent_of(path)?;
    create_dir_durable(parent)?;
    clean_leftovers(parent)?;
    let aside = aside_name(path);
    let written = write_durable(&aside, path, bytes)
        .and_then(|()| rename(&aside, path).map_err(|source| io_error("rename a new file to", path, source)));
    if written.is_err() {
        remove_quietly(&aside);
    }
    written?;
    sync_dir(parent)
}

/// Writes a folder of files so that a reader finds all of them or no folder.
///
/// # Errors
/// [`FolderError::Exists`] when the folder is there already; [`FolderError::Full`] or [`FolderError::Io`], naming the
/// path; nothing is left behind then.
pub fn write_dir_atomic(path: &Path, files: &[(&str, &[u8])]) -> Result<(), FolderError> {
    build_dir(path, files, |aside| {
        if path.exists() {
            return Err(FolderError::Exists { path: path.to_owned() });
        }
        // A non-empty folder that appeared since is not replaced by rename(2): it answers ENOTEMPTY or EEXIST.
        rename(aside, path).map_err(|source| match source.kind() {
            ErrorKind::DirectoryNotEmpty | ErrorKind::AlreadyExists => FolderError::Exists { path: path.to_owned() },
            _ => io_error("rename a new folder to", path, source),
        })
    })
}

/// As [`write_dir_atomic`], but takes the place of a folder that is there: the two are exchanged, so that at no moment
/// there is none.
///
/// # Errors
/// [`FolderError::Full`] or [`FolderError::Io`], naming the path; the old folder then still stands.
pub fn replace_dir_atomic(path: &Path, files: &[(&str, &[u8])]) -> Result<(), FolderError> {
    if !path.exists() {
        return write_dir_atomic(path, files);
    }
    build_dir(path, files, |aside| {
        let disk = storage::of(path);
        disk.exchange(aside, path).map_err(|source| io_error("exchange with a new folder", path, source))?;
        disk.remove_dir_all(aside).map_err(|source| io_error("remove the old version of", path, source))
    })
}

/// Removes what writers that are no longer alive left half-made in a folder. A folder that does not exist is clean.
///
/// # Errors
/// [`FolderError::Io`] when the folder cannot be read or a leftover cannot be removed.
pub fn clean_leftovers(folder: &Path) -> Result<(), FolderError> {
    let entries = match fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        Err(source) => return Err(io_error("read", folder, source)),
    };
    for entry in entries {
        let entry = entry.map_err(|source| io_error("read", folder, source))?;
        if !entry.file_name().to_str().is_some_and(is_leftover) {
            continue;
        }
        let path = entry.path();
        let is_dir = entry.file_type().is_ok_and(|kind| kind.is_dir());
        let disk = storage::of(&path);
        let removed = if is_dir { disk.remove_dir_all(&path) } else { disk.remove_file(&path) };
        match removed {
            Ok(()) => tracing::info!(path = %path.display(), "removed what a dead writer left"),
            // Another process cleans the same folder.
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(source) => return Err(io_error("remove the leftover", &path, source)),
        }
    }
    Ok(())
}

/// Makes a folder and those above it where they are not there, and brings every new entry to the disk.
///
/// # Errors
/// [`FolderError::Full`] or [`FolderError::Io`], naming the folder that cannot be made.
pub fn create_dir_durable(path: &Path) -> Result<(), FolderError> {
    if path.is_dir() {
        return Ok(());
    }
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    if let Some(parent) = parent {
        create_dir_durable(parent)?;
    }
    match storage::of(path).create_dir(path) {
        Ok(()) => {}
        Err(error) if error.kind() == ErrorKind::AlreadyExists && path.is_dir() => {}
        Err(source) => return Err(refused("make the folder", path, 0, source)),
    }
    parent.map_or(Ok(()), sync_dir)
}

fn build_dir(
    path: &Path,
    files: &[(&str, &[u8])],
    put_in_place: impl FnOnce(&Path) -> Result<(), FolderError>,
) -> Result<(), FolderError> {
    let parent = parent_of(path)?;
    create_dir_durable(parent)?;
    clean_leftovers(parent)?;
    let aside = aside_name(path);
    let built = fill_dir(&aside, path, files).and_then(|()| put_in_place(&aside));
    if built.is_err() {
        storage::of(path).remove_dir_all(&aside).ok();
    }
    built?;
    sync_dir(parent)
}

fn fill_dir(aside: &Path, path: &Path, files: &[(&str, &[u8])]) -> Result<(), FolderError> {
    storage::of(path).create_dir(aside).map_err(|source| refused("make the folder", path, 0, source))?;
    for (name, bytes) in files {
        write_durable(&aside.join(name), &path.join(name), bytes)?;
    }
    sync_dir(aside)
}

/// Writes and fsyncs a file that does not exist yet; errors name `shown`, the place it is meant for.
fn write_durable(aside: &Path, shown: &Path, bytes: &[u8]) -> Result<(), FolderError> {
    let mut file = storage::of(aside).create(aside).map_err(|source| refused("create", shown, bytes.len(), source))?;
    fill(&mut *file, shown, bytes)
}

fn fill(file: &mut dyn WriteFile, shown: &Path, bytes: &[u8]) -> Result<(), FolderError> {
    file.write(bytes).map_err(|source| refused("write", shown, bytes.len(), source))?;
    file.sync().map_err(|source| refused("bring to the disk", shown, bytes.len(), source))
}

fn sync_dir(path: &Path) -> Result<(), FolderError> {
    storage::of(path).sync_dir(path).map_err(|source| io_error("bring to the disk", path, source))
}

fn rename(from: &Path, to: &Path) -> io::Result<()> {
    fault_point::reach("file", "unrenamed");
    storage::of(to).rename(from, to)?;
    fault_point::reach("file", "renamed");
    Ok(())
}

fn refused(action: &'static str, path: &Path, bytes: usize, source: io::Error) -> FolderError {
    if storage::is_full(&source) {
        FolderError::Full { path: path.to_owned(), bytes: bytes as u64, source }
    } else {
        io_error(action, path, source)
    }
}

pub(super) fn io_error(action: &'static str, path: &Path, source: io::Error) -> FolderError {
    FolderError::Io { action, path: path.to_owned(), source }
}

fn parent_of(path: &Path) -> Result<&Path, FolderError> {
    match (path.parent(), path.file_name()) {
        (Some(parent), Some(_)) if parent.as_os_str().is_empty() => Ok(Path::new(".")),
        (Some(parent), Some(_)) => Ok(parent),
        _ => Err(io_error("write", path, io::Error::new(ErrorKind::InvalidInput, "not the name of a file"))),
    }
}

fn remove_quietly(path: &Path) {
    // The first error is the one worth telling; a leftover is removed by the next writer.
    storage::of(path).remove_file(path).ok();
}

fn aside_name(path: &Path) -> PathBuf {
    static OWN_START: OnceLock<u64> = OnceLock::new();
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let pid = std::process::id();
    let start = *OWN_START.get_or_init(|| start_of(pid).unwrap_or(0));
    let count = COUNT.fetch_add(1, Ordering::Relaxed);
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!("{ASIDE}{pid}-{start}-{count}-{name}"))
}

/// Whether a file's name is that of a half-made file whose writer is gone.
fn is_leftover(name: &str) -> bool {
    let Some(rest) = name.strip_prefix(ASIDE) else { return false };
    let mut parts = rest.splitn(4, '-');
    let mut number = || parts.next().and_then(|part| part.parse::<u64>().ok());
    let (Some(pid), Some(start)) = (number(), number()) else { return false };
    let Ok(pid) = u32::try_from(pid) else { return false };
    start_of(pid).unwrap_or(u64::MAX) != start
}

/// When a process started, in the kernel's ticks since boot (field 22 of its stat file); `None` when there is none.
/// Together with the id it names one life of one process.
fn start_of(pid: u32) -> Option<u64> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    let after_name = stat.get(stat.rfind(')')? + 1..)?;
    after_name.split_whitespace().nth(19)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use std::fs::OpenOptions;

    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<_> = fs::read_dir(folder)
            .expect("folder")
            .map(|entry| entry.expect("entry").file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn a_file_is_replaced_whole() {
        let dir = tempfile::tempdir().expect("tempdir");
        let path = dir.path().join("deep/er/a.toml");
        write_atomic(&path, b"one").expect("first");
        write_atomic(&path, b"two").expect("second");
        assert_eq!(fs::read(&path).expect("read"), b"two");
        assert_eq!(names(path.parent().expect("parent")), ["a.toml"]);
    }

    #[test]
    fn a_failed_write_leaves_nothing_behind() {
        let dir = tempfile::tempdir().expect("tempdir");
        let path = dir.path().join("taken");
        fs::create_dir(&path).expect("a folder in the way");
        let error = write_atomic(&path, b"x").expect_err("a folder cannot be replaced by a file");
        assert!(error.to_string().contains("taken"), "{error}");
        assert_eq!(names(dir.path()), ["taken"]);
    }

    #[test]
    fn a_folder_appears_once_and_whole() {
        let dir = tempfile::tempdir().expect("tempdir");
        let path = dir.path().join("000001");
        write_dir_atomic(&path, &[("a", b"1"), ("b", b"2")]).expect("new");
        let again = write_dir_atomic(&path, &[("a", b"9")]);
        assert!(matches!(again, Err(FolderError::Exists { .. })));
        assert_eq!(fs::read(path.join("a")).expect("a"), b"1");
        assert_eq!(names(dir.path()), ["000001"]);
    }

    #[test]
    fn a_folder_that_cannot_be_filled_leaves_nothing() {
        let dir = tempfile::tempdir().expect("tempdir");
        let path = dir.path().join("000001");
        write_dir_atomic(&path, &[("a", b"1"), ("no/such/sub", b"2")]).expect_err("no such subfolder");
        assert!(names(dir.path()).is_empty());
    }

    #[test]
    fn a_replaced_folder_holds_only_the_new_files() {
        let dir = tempfile::tempdir().expect("tempdir");
        let path = dir.path().join("overhead");
        replace_dir_atomic(&path, &[("a", b"1"), ("b", b"2")]).expect("first");
        replace_dir_atomic(&path, &[("a", b"9")]).expect("second");
        assert_eq!(names(&path), ["a"]);
        assert_eq!(fs::read(path.join("a")).expect("a"), b"9");
        assert_eq!(names(dir.path()), ["overhead"]);
    }

    #[test]
    fn leftovers_of_the_dead_go_and_work_of_the_living_stays() {
        let dir = tempfile::tempdir().expect("tempdir");
        let own = std::process::id();
        let alive = format!(".tmp-{own}-{}-77-x", start_of(own).expect("own start"));
        let recycled = format!(".tmp-{own}-1-77-x");
        fs::write(dir.path().join(&alive), "").expect("write");
        fs::write(dir.path().join(recycled), "").expect("write");
        fs::create_dir_all(dir.path().join(".tmp-4194305-5-0-000003")).expect("dir");
        fs::write(dir.path().join(".tmp-4194305-5-0-000003/rgb.png"), "half").expect("write");
        fs::write(dir.path().join(".tmp-notes"), "somebody else's").expect("write");
        clean_leftovers(dir.path()).expect("clean");
        let mut expected = vec![alive, ".tmp-notes".to_owned()];
        expected.sort();
        assert_eq!(names(dir.path()), expected);
        clean_leftovers(&dir.path().join("missing")).expect("a missing folder is clean");
    }

    #[test]
    fn a_full_disk_names_the_file_and_its_size() {
        let mut full = OpenOptions::new().write(true).open("/dev/full").expect("/dev/full");
        let error = fill(&mut full, Path::new("keyframes/000001/rgb.png"), &[0; 1234]).expect_err("full");
        assert!(matches!(error, FolderError::Full { bytes: 1234, .. }));
        let message = error.to_string();
        assert!(message.contains("000001/rgb.png") && message.contains("1234 bytes"), "{message}");
    }
}
