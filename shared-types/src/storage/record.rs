//! A file system that notes every operation: its trace is what [`super::replay`] cuts.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use super::{Disk, Storage, WriteFile};

/// One operation. Paths are relative to the folder that is recorded; files are numbered in the order of their opening.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Op {
    /// A folder was made.
    CreateDir(PathBuf),
    /// A file was opened, and made where there was none.
    Open(usize, PathBuf),
    /// Bytes were written at a file's end.
    Write(usize, Vec<u8>),
    /// A file was cut.
    Cut(usize, usize),
    /// A file's bytes were synced.
    Sync(usize),
    /// A name was changed.
    Rename(PathBuf, PathBuf),
    /// Two names were exchanged.
    Exchange(PathBuf, PathBuf),
    /// A file, or a folder and all in it, was removed.
    Remove(PathBuf),
    /// The names of a folder were synced.
    SyncDir(PathBuf),
}

/// Everything below a folder: folders (`None`) and files, by their paths relative to it.
pub type Tree = BTreeMap<PathBuf, Option<Vec<u8>>>;

/// What was there before, all of it on the disk, and what was done.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Trace {
    /// Before the first operation.
    pub before: Tree,
    /// The operations, in order.
    pub ops: Vec<Op>,
}

/// The file system.
#[derive(Debug, Clone)]
pub struct Recorder {
    root: PathBuf,
    trace: Arc<Mutex<(Trace, usize)>>,
}

impl Recorder {
    /// Records what is written below a folder, which is read as it is now.
    ///
    /// # Errors
    /// When the folder cannot be read.
    pub fn new(root: &Path) -> io::Result<Self> {
        let trace = Trace { before: tree_of(root)?, ops: Vec::new() };
        Ok(Self { root: root.to_owned(), trace: Arc::new(Mutex::new((trace, 0))) })
    }

    /// What was recorded so far.
    #[must_use]
    pub fn trace(&self) -> Trace {
        self.trace.lock().unwrap_or_else(PoisonError::into_inner).0.clone()
    }

    fn note(&self, op: Op) {
        self.trace.lock().unwrap_or_else(PoisonError::into_inner).0.ops.push(op);
    }

    fn relative(&self, path: &Path) -> PathBuf {
        path.strip_prefix(&self.root).unwrap_or(path).to_owned()
    }

    fn opened(&self, path: &Path, file: Box<dyn WriteFile>) -> Box<dyn WriteFile> {
        let mut trace = self.trace.lock().unwrap_or_else(PoisonError::into_inner);
        let number = trace.1;
        trace.1 += 1;
        trace.0.ops.push(Op::Open(number, self.relative(path)));
        Box::new(RecordedFile { recorder: self.clone(), number, file })
    }
}

/// Everything below a folder.
///
/// # Errors
/// When something cannot be read.
pub fn tree_of(root: &Path) -> io::Result<Tree> {
    fn walk(root: &Path, below: &Path, tree: &mut Tree) -> io::Result<()> {
        for entry in fs::read_dir(root.join(below))? {
            let entry = entry?;
            let path = below.join(entry.file_name());
            if entry.file_type()?.is_dir() {
                tree.insert(path.clone(), None);
                walk(root, &path, tree)?;
            } else {
                tree.insert(path, Some(fs::read(entry.path())?));
            }
        }
        Ok(())
    }
    let mut tree = Tree::new();
    walk(root, Path::new(""), &mut tree)?;
    Ok(tree)
}

#[derive(Debug)]
struct RecordedFile {
    recorder: Recorder,
    number: usize,
    file: Box<dyn WriteFile>,
}

impl WriteFile for RecordedFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write(bytes)?;
        self.recorder.note(Op::Write(self.number, bytes.to_vec()));
        Ok(())
    }

    fn cut(&mut self, bytes: u64) -> io::Result<()> {
        self.file.cut(bytes)?;
        self.recorder.note(Op::Cut(self.number, usize::try_from(bytes).unwrap_or(usize::MAX)));
        Ok(())
    }

    fn sync(&mut self) -> io::Result<()> {
        self.file.sync()?;
        self.recorder.note(Op::Sync(self.number));
        Ok(())
    }
}

impl Storage for Recorder {
    fn create_dir(&self, path: &Path) -> io::Result<()> {
        Disk.create_dir(path)?;
        self.note(Op::CreateDir(self.relative(path)));
        Ok(())
    }

    fn create(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        Ok(self.opened(path, Disk.create(path)?))
    }

    fn append(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        Ok(self.opened(path, Disk.append(path)?))
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        Disk.rename(from, to)?;
        self.note(Op::Rename(self.relative(from), self.relative(to)));
        Ok(())
    }

    fn exchange(&self, one: &Path, other: &Path) -> io::Result<()> {
        Disk.exchange(one, other)?;
        self.note(Op::Exchange(self.relative(one), self.relative(other)));
        Ok(())
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        Disk.remove_file(path)?;
        self.note(Op::Remove(self.relative(path)));
        Ok(())
    }

    fn remove_dir_all(&self, path: &Path) -> io::Result<()> {
        Disk.remove_dir_all(path)?;
        self.note(Op::Remove(self.relative(path)));
        Ok(())
    }

    fn sync_dir(&self, path: &Path) -> io::Result<()> {
        Disk.sync_dir(path)?;
        self.note(Op::SyncDir(self.relative(path)));
        Ok(())
    }
}
