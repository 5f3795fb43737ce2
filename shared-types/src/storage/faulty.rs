//! Disks that are full or slow, for tests. Their files lie where they say, on the machine's own disk.

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use super::{Disk, Storage, WriteFile};

/// A disk with so much room. What is removed gives none back: room comes by [`Full::free`] alone.
#[derive(Debug, Clone)]
pub struct Full {
    room_bytes: Arc<AtomicU64>,
}

impl Full {
    /// A disk with room for so many bytes more.
    #[must_use]
    pub fn with_room(bytes: u64) -> Self {
        Self { room_bytes: Arc::new(AtomicU64::new(bytes)) }
    }

    /// Makes room for so many bytes more.
    pub fn free(&self, bytes: u64) {
        self.room_bytes.fetch_add(bytes, Ordering::SeqCst);
    }

    /// Takes as much of the room as is left of so many bytes; returns how many those are.
    fn take(&self, bytes: u64) -> u64 {
        let left = |room: u64| Some(room.saturating_sub(bytes));
        // The closure always gives a value: both arms hold the room before.
        let room = match self.room_bytes.fetch_update(Ordering::SeqCst, Ordering::SeqCst, left) {
            Ok(before) | Err(before) => before,
        };
        room.min(bytes)
    }
}

fn no_room() -> io::Error {
    io::Error::from(io::ErrorKind::StorageFull)
}

#[derive(Debug)]
struct FullFile {
    disk: Full,
    file: Box<dyn WriteFile>,
}

impl WriteFile for FullFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        let fits = usize::try_from(self.disk.take(bytes.len() as u64)).unwrap_or(bytes.len());
        self.file.write(&bytes[..fits])?;
        if fits < bytes.len() { Err(no_room()) } else { Ok(()) }
    }

    fn cut(&mut self, bytes: u64) -> io::Result<()> {
        self.file.cut(bytes)
    }

    fn sync(&mut self) -> io::Result<()> {
        self.file.sync()
    }
}

impl Storage for Full {
    fn create_dir(&self, path: &Path) -> io::Result<()> {
        if self.take(1) == 0 { Err(no_room()) } else { Disk.create_dir(path) }
    }

    fn create(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        Ok(Box::new(FullFile { disk: self.clone(), file: Disk.create(path)? }))
    }

    fn append(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        Ok(Box::new(FullFile { disk: self.clone(), file: Disk.append(path)? }))
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        Disk.rename(from, to)
    }

    fn exchange(&self, one: &Path, other: &Path) -> io::Result<()> {
        Disk.exchange(one, other)
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        Disk.remove_file(path)
    }

    fn remove_dir_all(&self, path: &Path) -> io::Result<()> {
        Disk.remove_dir_all(path)
    }

    fn sync_dir(&self, path: &Path) -> io::Result<()> {
        Disk.sync_dir(path)
    }
}

/// What passes time, for a slow disk: a test's own clock, or the thread's sleep.
pub type Pass = Arc<dyn Fn(Duration) + Send + Sync>;

/// A disk that takes its time: writes go to memory at once, and syncing waits for what was written since.
#[derive(Clone)]
pub struct Slow {
    bytes_per_s: f64,
    pass: Pass,
}

impl core::fmt::Debug for Slow {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Slow").field("bytes_per_s", &self.bytes_per_s).finish_non_exhaustive()
    }
}

impl Slow {
    /// A disk that takes so many bytes a second; `pass` is called with every wait.
    #[must_use]
    pub fn new(bytes_per_s: f64, pass: Pass) -> Self {
        Self { bytes_per_s, pass }
    }
}

#[derive(Debug)]
struct SlowFile {
    disk: Slow,
    file: Box<dyn WriteFile>,
    waiting_bytes: usize,
}

impl WriteFile for SlowFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.waiting_bytes += bytes.len();
        self.file.write(bytes)
    }

    fn cut(&mut self, bytes: u64) -> io::Result<()> {
        self.file.cut(bytes)
    }

    fn sync(&mut self) -> io::Result<()> {
        let bytes = core::mem::take(&mut self.waiting_bytes);
        #[expect(clippy::cast_precision_loss, reason = "far below 2^53")]
        (self.disk.pass)(Duration::from_secs_f64(bytes as f64 / self.disk.bytes_per_s));
        self.file.sync()
    }
}

impl Storage for Slow {
    fn create_dir(&self, path: &Path) -> io::Result<()> {
        Disk.create_dir(path)
    }

    fn create(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        Ok(Box::new(SlowFile { disk: self.clone(), file: Disk.create(path)?, waiting_bytes: 0 }))
    }

    fn append(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        Ok(Box::new(SlowFile { disk: self.clone(), file: Disk.append(path)?, waiting_bytes: 0 }))
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        Disk.rename(from, to)
    }

    fn exchange(&self, one: &Path, other: &Path) -> io::Result<()> {
        Disk.exchange(one, other)
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        Disk.remove_file(path)
    }

    fn remove_dir_all(&self, path: &Path) -> io::Result<()> {
        Disk.remove_dir_all(path)
    }

    fn sync_dir(&self, path: &Path) -> io::Result<()> {
        Disk.sync_dir(path)
    }
}
