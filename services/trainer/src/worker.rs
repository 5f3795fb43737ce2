//! The training thread: takes rounds, computes them slice by slice, writes checkpoints and models, hands results over.
//!
//! The service's loop must answer every tick, so it never computes. In lockstep everything that the thread does depends on
//! iteration counts alone ([`Pace::Counted`]); how fast it is decides only how long a due tick has to wait.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TryRecvError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use shared_types::folder::{FolderError, write_atomic};
use shared_types::stage;

use splatting::BackendError;

use crate::backend;
use crate::checkpoint;
use crate::keyframes::KeyframeSource;
use crate::progression::State;
use crate::round::{FinishedRound, Progress, RoundSpec};
use crate::session::{Session, SessionError, Snapshot};

/// Results that may wait to be published: bounds how far the thread runs ahead of the mission clock, and its memory.
const AHEAD: usize = 8;

/// How often the thread looks whether it is to try again.
const RETRY_POLL: Duration = Duration::from_millis(1);

/// Slices that may wait for a snapshot to arrive.
const HELD: usize = 4;

/// A slice that is computed, before it is handed over.
#[derive(Debug, Clone, Copy)]
struct Slice {
    progress: Progress,
    over: bool,
    with_snapshot: bool,
}

/// When snapshots and checkpoints are taken within a round.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pace {
    /// Each time so many iterations have passed: lockstep.
    Counted {
        /// Iterations between snapshots.
        snapshot_every: f64,
        /// Iterations between checkpoints.
        checkpoint_every: f64,
    },
    /// When the service asks for one: wall mode.
    OnDemand,
}

/// What the thread hands over.
#[derive(Debug)]
pub enum Output {
    /// It has looked at the mission folder.
    Ready {
        /// Rounds that are over.
        finished: Vec<FinishedRound>,
        /// Iterations of the round that was cut off, and what it was asked.
        active: Option<(RoundSpec, u32)>,
        /// The model at the end of the last round.
        snapshot: Option<Snapshot>,
    },
    /// A slice is computed.
    Slice {
        /// How far the round is.
        progress: Progress,
        /// Whether it was the last.
        over: bool,
        /// The model, when one is due.
        snapshot: Option<Snapshot>,
    },
    /// A round is over and on disk.
    Finished {
        /// How it ended.
        round: FinishedRound,
        /// The model.
        snapshot: Snapshot,
    },
    /// A round is over, and no room for it on the disk: told again after each [`Worker::retry`] that finds none.
    NoRoom {
        /// What does not fit.
        reason: String,
    },
    /// A round cannot be run.
    Failed {
        /// Which.
        round: u32,
        /// Why.
        reason: String,
    },
    /// The back end failed. What was trained since the newest checkpoint is lost, and the thread has ended.
    Broken {
        /// How.
        reason: String,
    },
    /// The thread was asked to stop and has written what it had.
    Stopped,
}

/// Signals between the service and its thread.
#[derive(Debug, Default)]
struct Signals {
    stop: AtomicBool,
    snapshot: AtomicBool,
    checkpoint: AtomicBool,
    retry: AtomicBool,
    work: AtomicU64,
    /// Checkpoints within rounds that could not be written, and why the last could not; empty once one was.
    skipped: AtomicU64,
    trouble: Mutex<String>,
}

impl Signals {
    fn tell(&self, trouble: String) {
        *self.trouble.lock().unwrap_or_else(PoisonError::into_inner) = trouble;
    }
}

/// The service's end.
#[derive(Debug)]
pub struct Worker {
    jobs: Option<SyncSender<RoundSpec>>,
    outputs: Receiver<Output>,
    signals: Arc<Signals>,
    thread: Option<JoinHandle<()>>,
}

/// The thread is gone: it panicked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "the training thread ended unexpectedly; its last words are in the log, and a restart goes on from the newest checkpoint"
)]
pub struct WorkerGone;

impl Worker {
    /// Starts the thread on what `model_folder` (the mission's `model/`) holds.
    ///
    /// # Errors
    /// When the system refuses a thread.
    pub fn start(
        session: Session,
        source: Box<dyn KeyframeSource>,
        model_folder: PathBuf,
        slice_iterations: u32,
        pace: Pace,
    ) -> std::io::Result<Self> {
        let (jobs, job_receiver) = sync_channel(1);
        let (output_sender, outputs) = sync_channel(AHEAD);
        let signals = Arc::new(Signals::default());
        let mut thread = Thread {
            session,
            source,
            model_folder,
            slice_iterations: slice_iterations.max(1),
            pace,
            outputs: output_sender,
            signals: Arc::clone(&signals),
        };
        let handle = std::thread::Builder::new().name("train".to_owned()).spawn(move || thread.run(&job_receiver))?;
        Ok(Self { jobs: Some(jobs), outputs, signals, thread: Some(handle) })
    }

    /// Gives it a round. It must be idle.
    ///
    /// # Errors
    /// When it is gone.
    pub fn begin(&self, spec: RoundSpec) -> Result<(), WorkerGone> {
        let sent = self.jobs.as_ref().is_some_and(|jobs| jobs.send(spec).is_ok());
        if sent { Ok(()) } else { Err(WorkerGone) }
    }

    /// The next result, if there is one.
    ///
    /// # Errors
    /// When it is gone.
    pub fn poll(&self) -> Result<Option<Output>, WorkerGone> {
        match self.outputs.try_recv() {
            Ok(output) => Ok(Some(output)),
            Err(TryRecvError::Empty) => Ok(None),
            Err(TryRecvError::Disconnected) => Err(WorkerGone),
        }
    }

    /// Asks for a snapshot with the next slice ([`Pace::OnDemand`]).
    pub fn ask_snapshot(&self) {
        self.signals.snapshot.store(true, Ordering::Relaxed);
    }

    /// Asks for a checkpoint after the next slice ([`Pace::OnDemand`]).
    pub fn ask_checkpoint(&self) {
        self.signals.checkpoint.store(true, Ordering::Relaxed);
    }

    /// Has it try again to write the end of a round for which there was no room.
    pub fn retry(&self) {
        self.signals.retry.store(true, Ordering::Relaxed);
    }

    /// Checkpoints within rounds that could not be written, and why not; no reason where the last one could.
    #[must_use]
    pub fn skipped(&self) -> (u64, String) {
        let reason = self.signals.trouble.lock().unwrap_or_else(PoisonError::into_inner).clone();
        (self.signals.skipped.load(Ordering::Relaxed), reason)
    }

    /// Counts real progress.
    #[must_use]
    pub fn work(&self) -> u64 {
        self.signals.work.load(Ordering::Relaxed)
    }

    /// Stops it after the present slice and a checkpoint; waits for that at most `patience`. True when it stopped in time.
    pub fn stop(&mut self, patience: Duration) -> bool {
        self.signals.stop.store(true, Ordering::Relaxed);
        self.jobs = None;
        let deadline = Instant::now() + patience;
        loop {
            match self.outputs.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(Output::Stopped | Output::Broken { .. }) | Err(RecvTimeoutError::Disconnected) => break,
                Ok(_) => {}
                Err(RecvTimeoutError::Timeout) => return false,
            }
        }
        self.thread.take().is_none_or(|thread| thread.join().is_ok())
    }
}

/// Why the thread ends.
enum End {
    /// The service has gone, or wants nothing any more.
    Unwanted,
    /// The back end failed.
    Broken(BackendError),
}

impl From<BackendError> for End {
    fn from(error: BackendError) -> Self {
        Self::Broken(error)
    }
}

struct Thread {
    session: Session,
    source: Box<dyn KeyframeSource>,
    model_folder: PathBuf,
    slice_iterations: u32,
    pace: Pace,
    outputs: SyncSender<Output>,
    signals: Arc<Signals>,
}

impl Thread {
    fn run(&mut self, jobs: &Receiver<RoundSpec>) {
        let ready = self.look_at_folder();
        let mut going = self.send(ready);
        while going.is_ok()
            && let Ok(spec) = jobs.recv()
        {
            going = self.round(spec);
        }
        let last = match going {
            Err(End::Broken(error)) => {
                backend::record_failure(&self.model_folder, &error);
                Output::Broken { reason: error.to_string() }
            }
            Ok(()) | Err(End::Unwanted) => Output::Stopped,
        };
        // Nobody may be left to hear it.
        self.outputs.send(last).ok();
    }

    fn send(&self, output: Output) -> Result<(), End> {
        self.outputs.send(output).map_err(|_gone| End::Unwanted)
    }

    fn look_at_folder(&mut self) -> Output {
        let mut snapshot = None;
        if let Some(last_final) = checkpoint::newest(&self.model_folder, true) {
            last_final.restore_into(&mut self.session);
            snapshot = self.session.snapshot();
            // A kill between a round's checkpoint and its model files leaves those of the round before: written again.
            if let Some(round) = self.session.finished().last().map(|finished| finished.spec.round)
                && let Err(error) = write_models(&self.model_folder, &self.session, round)
            {
                tracing::warn!(%error, "cannot write the model of a round; its checkpoint is written");
            }
        }
        if let Some(newest) = checkpoint::newest(&self.model_folder, false) {
            newest.restore_into(&mut self.session);
            tracing::info!(
                iterations = self.session.progress().total_iterations,
                rounds = self.session.finished().len(),
                within_round = self.session.active().is_some(),
                "going on from a checkpoint"
            );
        }
        Output::Ready {
            finished: self.session.finished().to_vec(),
            active: self.session.active().cloned().map(|spec| (spec, self.session.progress().iterations)),
            snapshot,
        }
    }

    fn round(&mut self, spec: RoundSpec) -> Result<(), End> {
        let round = spec.round;
        let done_before = self.session.active().is_none()
            && self.session.finished().last().is_some_and(|finished| finished.spec == spec);
        if !done_before {
            let keyframes = spec.keyframes.len();
            let stage = stage!("insert", round, keyframes);
            match self.begin(spec) {
                Ok(()) => {}
                Err(SessionError::Backend(error)) => return Err(error.into()),
                Err(SessionError::Keyframe(error)) => {
                    return self.send(Output::Failed { round, reason: error.to_string() });
                }
            }
            self.signals.work.fetch_add(1, Ordering::Relaxed);
            drop(stage);
            let stage = stage!("train", round, keyframes, gaussians = self.session.model().len());
            if !self.train()? {
                return Err(End::Unwanted);
            }
            drop(stage);
            let _stage = stage!("finish", round);
            backend::record_memory(&self.model_folder, self.session.backend());
            self.session.finish()?;
        }
        // On disk before anybody hears of it.
        let _stage = stage!("write the round", round);
        if let Err(error) = self.keep_round(round)? {
            return self.send(Output::Failed { round, reason: error.to_string() });
        }
        match (self.session.finished().last().cloned(), self.session.snapshot()) {
            (Some(round), Some(snapshot)) => self.send(Output::Finished { round, snapshot }),
            _ => self.send(Output::Failed { round, reason: "the round left no result".to_owned() }),
        }
    }

    fn begin(&mut self, spec: RoundSpec) -> Result<(), SessionError> {
        match self.session.active() {
            Some(active) if *active == spec => {
                self.session.resume(&mut *self.source)?;
                return Ok(self.session.hold_at_cap()?);
            }
            Some(_) => {
                tracing::warn!(
                    round = spec.round,
                    "the round of the newest checkpoint is not wanted any more; starting from the last round's end"
                );
                checkpoint::remove_live(&self.model_folder);
                match checkpoint::newest(&self.model_folder, true) {
                    Some(last_final) => last_final.restore_into(&mut self.session),
                    None => self.session.reset(),
                }
            }
            None => {}
        }
        self.session.begin(spec, &mut *self.source)
    }

    /// Trains to the round's end; false when it was asked to stop before.
    fn train(&mut self) -> Result<bool, End> {
        // Slices whose turn comes once a snapshot that was begun before them has arrived.
        let mut held: VecDeque<Slice> = VecDeque::new();
        loop {
            let before = self.session.progress().iterations;
            let work = &self.signals.work;
            let over = self.session.advance(self.slice_iterations, || {
                work.fetch_add(1, Ordering::Relaxed);
            })?;
            let progress = self.session.progress();
            if !over && self.is_due(before, progress.iterations, false) && !self.session.begin_checkpoint()? {
                self.write_checkpoint(self.session.state());
            }
            if let Some(checkpoint) = self.session.take_checkpoint()? {
                self.write_checkpoint(checkpoint.state());
            }
            if self.signals.stop.load(Ordering::Relaxed) {
                self.session.sync()?;
                self.write_checkpoint(self.session.state());
                return Ok(false);
            }
            if progress.iterations == before {
                self.hand_over(&mut held, true)?;
                return Ok(true);
            }
            let wanted = !over && self.is_due(before, progress.iterations, true);
            if wanted {
                self.hand_over(&mut held, true)?;
                self.session.begin_snapshot()?;
            }
            held.push_back(Slice { progress, over, with_snapshot: wanted });
            let all = over || held.len() > HELD;
            self.hand_over(&mut held, all)?;
            if over {
                return Ok(true);
            }
        }
    }

    /// Sends slices in their order, up to the first whose snapshot has not arrived; with `all`, it is waited for.
    fn hand_over(&mut self, held: &mut VecDeque<Slice>, all: bool) -> Result<(), End> {
        while let Some(&Slice { progress, over, with_snapshot }) = held.front() {
            let snapshot = if with_snapshot { self.session.take_snapshot(all)? } else { None };
            if with_snapshot && snapshot.is_none() && !all {
                break;
            }
            held.pop_front();
            self.send(Output::Slice { progress, over, snapshot })?;
        }
        Ok(())
    }

    fn is_due(&self, before: u32, now: u32, snapshot: bool) -> bool {
        match self.pace {
            Pace::Counted { snapshot_every, checkpoint_every } => {
                let every = if snapshot { snapshot_every } else { checkpoint_every }.max(1.0);
                (f64::from(before) / every).floor() < (f64::from(now) / every).floor()
            }
            Pace::OnDemand => {
                let asked = if snapshot { &self.signals.snapshot } else { &self.signals.checkpoint };
                asked.swap(false, Ordering::Relaxed)
            }
        }
    }

    /// Brings a round's end to the disk: its checkpoint, then its model. Where there is no room it waits for some; whether
    /// that takes too long is for the planner to say.
    fn keep_round(&mut self, round: u32) -> Result<Result<(), FolderError>, End> {
        loop {
            let written = checkpoint::write(&self.model_folder, &self.session)
                .and_then(|_path| write_models(&self.model_folder, &self.session, round));
            let Err(error @ FolderError::Full { .. }) = written else {
                // What was skipped within the round is in this.
                self.signals.tell(String::new());
                return Ok(written);
            };
            self.send(Output::NoRoom { reason: error.to_string() })?;
            while !self.signals.retry.swap(false, Ordering::Relaxed) {
                if self.signals.stop.load(Ordering::Relaxed) {
                    return Err(End::Unwanted);
                }
                std::thread::sleep(RETRY_POLL);
            }
        }
    }

    /// Writes a checkpoint within a round; training goes on without it.
    fn write_checkpoint(&self, state: State<'_>) {
        let _stage = stage!("write a checkpoint");
        match checkpoint::write_state(&self.model_folder, state) {
            Ok(_path) => self.signals.tell(String::new()),
            Err(error) => {
                let skipped = self.signals.skipped.fetch_add(1, Ordering::Relaxed) + 1;
                tracing::warn!(%error, skipped, "a checkpoint is skipped; training goes on");
                self.signals.tell(error.to_string());
            }
        }
    }
}

/// Writes `rounds/07.ply` and `model.ply`.
fn write_models(folder: &Path, session: &Session, round: u32) -> Result<(), FolderError> {
    let path = folder.join("model.ply");
    let mut ply = Vec::new();
    // Into memory: what it says then is of the model.
    splatting::ply::write(session.model(), &mut ply).map_err(|error| FolderError::Io {
        action: "make",
        path: path.clone(),
        source: std::io::Error::other(error),
    })?;
    write_atomic(&folder.join("rounds").join(format!("{round:02}.ply")), &ply)?;
    write_atomic(&path, &ply)
}
