//! The scoring thread: the service's loop must answer every tick, so it never renders.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::thread::JoinHandle;

use crate::job::{Held, Job, Scores};
use crate::renderer::Renderer;
use rustix::time::{ClockId, clock_gettime};
use shared_types::stage;

/// A scoring that is done.
#[derive(Debug, Clone, PartialEq)]
pub struct Scored {
    /// The terms.
    pub scores: Scores,
    /// CPU time that it took, nanoseconds.
    pub cpu_ns: u64,
}

/// The thread is gone: it panicked, or nothing could render any more.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the scoring thread ended unexpectedly; its last words are in the log, and a restarted scorer computes again")]
pub struct WorkerGone;

/// The service's end.
#[derive(Debug)]
pub struct Worker {
    jobs: Option<SyncSender<(Job, Held)>>,
    results: Receiver<Scored>,
    cancel: Arc<AtomicBool>,
    work: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
}

impl Worker {
    /// Starts the thread.
    ///
    /// # Errors
    /// When the system refuses a thread.
    pub fn start(mut renderer: Renderer) -> std::io::Result<Self> {
        let (jobs, job_receiver) = sync_channel::<(Job, Held)>(1);
        let (result_sender, results) = sync_channel(1);
        let (cancel, work) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
        let (cancelled, done) = (Arc::clone(&cancel), Arc::clone(&work));
        let thread = std::thread::Builder::new().name("score".to_owned()).spawn(move || {
            while let Ok((job, held)) = job_receiver.recv() {
                let stage = stage!("score", candidates = job.candidates(), gaussians = held.model.len());
                let before = process_cpu_ns();
                let Some(scores) = renderer.score(&job, &held.model, &cancelled, &done) else { return };
                let scored = Scored { scores, cpu_ns: process_cpu_ns().saturating_sub(before) };
                drop(stage);
                if result_sender.send(scored).is_err() {
                    return;
                }
            }
        })?;
        Ok(Self { jobs: Some(jobs), results, cancel, work, thread: Some(thread) })
    }

    /// Gives it a job. It must be idle.
    ///
    /// # Errors
    /// When it is gone.
    pub fn begin(&self, job: Job, held: Held) -> Result<(), WorkerGone> {
        let sent = self.jobs.as_ref().is_some_and(|jobs| jobs.send((job, held)).is_ok());
        if sent { Ok(()) } else { Err(WorkerGone) }
    }

    /// The result, if it is there.
    ///
    /// # Errors
    /// When it is gone.
    pub fn poll(&self) -> Result<Option<Scored>, WorkerGone> {
        match self.results.try_recv() {
            Ok(scored) => Ok(Some(scored)),
            Err(TryRecvError::Empty) => Ok(None),
            Err(TryRecvError::Disconnected) => Err(WorkerGone),
        }
    }

    /// Candidates scored so far: real progress.
    #[must_use]
    pub fn work(&self) -> u64 {
        self.work.load(Ordering::Relaxed)
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        self.cancel.store(true, Ordering::Relaxed);
        self.jobs = None;
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the scoring thread had panicked");
        }
    }
}

/// CPU time of this process, nanoseconds: all threads of a scoring, and little else.
fn process_cpu_ns() -> u64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    u64::try_from(time.tv_sec).unwrap_or(0) * 1_000_000_000 + u64::try_from(time.tv_nsec).unwrap_or(0)
}
