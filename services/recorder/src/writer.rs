//! The thread that writes. What the disk refuses is told and tried again later, in another file; nobody waits for it.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use shared_types::config::Config;

use crate::file::RecordingFile;
use crate::queue::{Priority, Queue, Sample, Taken};

/// A chunk is ended and handed to the system this often.
const FLUSH_PERIOD: Duration = Duration::from_secs(1);
/// After an error of the disk.
const RETRY: Duration = Duration::from_secs(5);
/// Share of the room that is kept from the stream of images.
const RESERVE: f64 = 0.1;

/// What became of the messages so far.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Status {
    /// Messages in a file.
    pub written: u64,
    /// Messages that the disk or the budget had no room for.
    pub refused: u64,
    /// Why nothing is written now; empty while all is well.
    pub error: String,
    /// Files of this process.
    pub files: Vec<PathBuf>,
}

/// A recording in progress: a queue, and the thread behind it.
#[derive(Debug)]
pub struct Writer {
    queue: Arc<Queue>,
    status: Arc<Mutex<Status>>,
    thread: Option<JoinHandle<()>>,
}

impl Writer {
    /// Starts to write into a folder, into `recording.mcap` or, where that is there, `recording-2.mcap` and so on. The disk may
    /// be full: that is told by [`Self::status`].
    ///
    /// # Errors
    /// When there is no thread to be had.
    pub fn start(folder: &Path, config: &Config) -> io::Result<Self> {
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "8 to 4096 MB, as checked")]
        let queue = Arc::new(Queue::new((config.recorder.memory_mb * 1e6) as usize));
        let status = Arc::new(Mutex::new(Status::default()));
        let mut work = Work {
            queue: Arc::clone(&queue),
            status: Arc::clone(&status),
            folder: folder.to_owned(),
            config: config.clone(),
            file: None,
            retry: Instant::now(),
            before_bytes: recorded_bytes(folder),
        };
        let thread = std::thread::Builder::new().name("writer".to_owned()).spawn(move || work.run())?;
        Ok(Self { queue, status, thread: Some(thread) })
    }

    /// Where messages go.
    #[must_use]
    pub fn queue(&self) -> &Queue {
        &self.queue
    }

    /// What became of them.
    #[must_use]
    pub fn status(&self) -> Status {
        locked(&self.status).clone()
    }

    /// Writes what is queued, and the file's index.
    pub fn finish(&mut self) {
        self.queue.close();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the thread that writes has panicked");
        }
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.finish();
    }
}

fn locked(status: &Mutex<Status>) -> MutexGuard<'_, Status> {
    status.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The name of the `number`-th recording of a mission, from 1.
#[must_use]
pub fn file_name(number: u32) -> String {
    if number == 1 { "recording.mcap".to_owned() } else { format!("recording-{number}.mcap") }
}

/// Bytes of the recordings that are there.
fn recorded_bytes(folder: &Path) -> u64 {
    (1..).map(|number| folder.join(file_name(number)).metadata()).map_while(Result::ok).map(|file| file.len()).sum()
}

struct Work {
    queue: Arc<Queue>,
    status: Arc<Mutex<Status>>,
    folder: PathBuf,
    config: Config,
    file: Option<RecordingFile>,
    /// When a file may be tried again.
    retry: Instant,
    /// Bytes of earlier files.
    before_bytes: u64,
}

impl Work {
    fn run(&mut self) {
        let mut flushed = Instant::now();
        self.open();
        loop {
            match self.queue.take(FLUSH_PERIOD.saturating_sub(flushed.elapsed())) {
                Taken::Sample(sample) => {
                    self.write(&sample);
                    self.queue.give_back(sample.bytes);
                }
                Taken::Nothing => {}
                Taken::End => break,
            }
            if flushed.elapsed() >= FLUSH_PERIOD {
                flushed = Instant::now();
                let result = self.file.as_mut().map_or(Ok(()), RecordingFile::flush);
                self.settle(result);
                if self.file.is_none() && Instant::now() >= self.retry {
                    self.open();
                }
            }
        }
        if let Some(file) = self.file.take() {
            self.settle(file.finish());
        }
    }

    fn open(&mut self) {
        if self.room_left() <= 0.0 {
            self.out_of_room();
            return;
        }
        // A file is never written over: another process may have been killed between its making and now.
        let path = (1..).map(|number| self.folder.join(file_name(number))).find(|path| !path.exists());
        let Some(path) = path else { return };
        match RecordingFile::create(&path, &self.config) {
            Ok(file) => {
                tracing::info!(file = %path.display(), "recording");
                let mut status = locked(&self.status);
                status.error.clear();
                status.files.push(path);
                drop(status);
                self.file = Some(file);
            }
            Err(error) => {
                // An empty file would take the name of the next.
                shared_types::storage::of(&path).remove_file(&path).ok();
                self.settle(Err(error));
            }
        }
    }

    fn write(&mut self, sample: &Sample) {
        let left = self.room_left();
        if left <= 0.0 && self.file.is_some() {
            self.out_of_room();
        }
        let kept = if sample.priority == Priority::Stream { RESERVE } else { 0.0 };
        let (result, refused) = match &mut self.file {
            Some(file) if left > kept => (file.write(sample), false),
            _ => (Ok(()), true),
        };
        let failed = result.is_err();
        self.settle(result);
        let mut status = locked(&self.status);
        if refused || failed {
            status.refused += 1;
        } else {
            status.written += 1;
        }
    }

    /// Share of the budget that is left.
    #[expect(clippy::cast_precision_loss, reason = "bytes of a disk")]
    fn room_left(&self) -> f64 {
        let bytes = self.before_bytes + self.file.as_ref().map_or(0, RecordingFile::bytes);
        1.0 - bytes as f64 / (self.config.recorder.max_mb * 1e6)
    }

    /// The budget is used up: the file is ended, and there will be no other.
    fn out_of_room(&mut self) {
        let max_mb = self.config.recorder.max_mb;
        if let Some(file) = self.file.take() {
            self.before_bytes += file.bytes();
            let result = file.finish();
            self.settle(result);
        }
        self.tell(format!(
            "recorder.max_mb = {max_mb}: used up; expected more for a whole mission: nothing more is recorded"
        ));
    }

    /// Where the disk refused: what is in the file stays there, and another one is begun later.
    fn settle(&mut self, result: io::Result<()>) {
        let Err(error) = result else { return };
        if let Some(file) = self.file.take() {
            self.before_bytes += file.bytes();
            drop(file);
        }
        self.retry = Instant::now() + RETRY;
        let folder = self.folder.display();
        self.tell(format!(
            "{folder}: cannot write the recording ({error}); expected room on the disk: it goes on in another file when there is"
        ));
    }

    fn tell(&self, text: String) {
        let mut status = locked(&self.status);
        if status.error != text {
            tracing::warn!("{text}");
            status.error = text;
        }
    }
}
