//! Brings keyframes to the disk on a thread of its own: encoding and fsync are slow, and the loop must not be.

use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, TrySendError, sync_channel};
use std::thread::JoinHandle;

use shared_types::folder::{FolderError, Keyframe, MissionFolder};
use shared_types::stage;

/// What became of a keyframe.
pub type Written = (Keyframe, Result<(), FolderError>);

/// The thread, and the way to it and back. One keyframe is written at a time.
#[derive(Debug)]
pub struct Writer {
    jobs: Option<SyncSender<(MissionFolder, Keyframe)>>,
    results: Receiver<Written>,
    thread: Option<JoinHandle<()>>,
}

impl Writer {
    /// Starts the thread.
    ///
    /// # Errors
    /// When the system has no thread to give.
    pub fn start() -> std::io::Result<Self> {
        let (jobs, taken) = sync_channel::<(MissionFolder, Keyframe)>(1);
        let (finished, results) = sync_channel(1);
        let thread = std::thread::Builder::new().name("keyframe-writer".to_owned()).spawn(move || {
            while let Ok((folder, keyframe)) = taken.recv() {
                let stage = stage!("write keyframe");
                let result = folder.write_keyframe(&keyframe).map(|_| ());
                drop(stage);
                if finished.send((keyframe, result)).is_err() {
                    return;
                }
            }
        })?;
        Ok(Self { jobs: Some(jobs), results, thread: Some(thread) })
    }

    /// Gives a keyframe to the thread.
    ///
    /// # Errors
    /// When the thread is gone or still has one waiting; the text says which.
    pub fn write(&self, folder: &MissionFolder, keyframe: Keyframe) -> Result<(), String> {
        let Some(jobs) = &self.jobs else { return Err("the writer is closed".to_owned()) };
        jobs.try_send((folder.clone(), keyframe)).map_err(|error| match error {
            TrySendError::Full(_) => "the writer still has a keyframe waiting".to_owned(),
            TrySendError::Disconnected(_) => "the writer thread is gone".to_owned(),
        })
    }

    /// The keyframe that has been written, or could not be.
    ///
    /// # Errors
    /// When the thread is gone.
    pub fn finished(&self) -> Result<Option<Written>, String> {
        match self.results.try_recv() {
            Ok(written) => Ok(Some(written)),
            Err(TryRecvError::Empty) => Ok(None),
            Err(TryRecvError::Disconnected) => Err("the writer thread is gone".to_owned()),
        }
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.jobs = None;
        // A result nobody takes any more must not keep the thread from ending.
        while self.results.recv().is_ok() {}
        if let Some(thread) = self.thread.take() {
            thread.join().ok();
        }
    }
}
