//! Where decisions wait until they are in the journal.
//!
//! A thread writes and syncs: the planner's loop has a deadline, for px4-link brakes when its sign of life is 0.5 s old, and
//! an fsync may take seconds. One turn's entries are on the desk at a time, and no other turn is taken before they are on
//! the disk and what they announce is done. A disk that refuses is asked again every second; the vehicle flies its path to
//! the end meanwhile and waits there. When `planner.disk_patience_s` are over, the desk gives up: the loop then no longer
//! gives its sign of life, and px4-link brings the vehicle home.

use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use shared_types::NS_PER_S;

use crate::io::{Effect, Outputs};
use crate::journal::{Entry, Journal, JournalError};

/// Mission time between tries of a disk that refused.
const RETRY_NS: u64 = NS_PER_S;

/// The thread that writes is gone: it panicked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the thread that writes the journal ended unexpectedly; its last words are in the log")]
pub struct WriterGone;

/// What became of the turn on the desk.
#[derive(Debug, PartialEq)]
pub enum Settled {
    /// There was none.
    Empty,
    /// The disk has not answered yet.
    Writing,
    /// The disk refuses; the turn waits.
    Refused,
    /// It is on the disk: this may be done now.
    Written {
        /// What the entries announce.
        effects: Vec<Effect>,
        /// The desk had given up: who flies is px4-link.
        late: bool,
    },
}

#[derive(Debug)]
struct Turn {
    outputs: Outputs,
    /// When the disk is asked again; `None` while it is being asked.
    retry_ns: Option<u64>,
}

/// A disk that refuses.
#[derive(Debug)]
struct Trouble {
    since_ns: u64,
    tries: u32,
    reason: String,
    gave_up: bool,
}

/// The desk.
#[derive(Debug)]
pub struct Desk {
    jobs: Option<SyncSender<Vec<Entry>>>,
    results: Receiver<Result<(), JournalError>>,
    thread: Option<JoinHandle<()>>,
    patience_ns: u64,
    turn: Option<Turn>,
    trouble: Option<Trouble>,
}

impl Desk {
    /// Starts the thread that writes.
    ///
    /// # Errors
    /// When the system has no thread to give.
    pub fn start(mut journal: Journal, patience_ns: u64) -> std::io::Result<Self> {
        let (jobs, taken) = sync_channel::<Vec<Entry>>(1);
        let (written, results) = sync_channel(1);
        let thread = std::thread::Builder::new().name("journal-writer".to_owned()).spawn(move || {
            while let Ok(entries) = taken.recv() {
                if written.send(journal.append(&entries)).is_err() {
                    return;
                }
            }
        })?;
        Ok(Self { jobs: Some(jobs), results, thread: Some(thread), patience_ns, turn: None, trouble: None })
    }

    /// Whether a turn lies here.
    #[must_use]
    pub fn is_taken(&self) -> bool {
        self.turn.is_some()
    }

    /// Puts a turn here that has entries; nothing may lie here.
    ///
    /// # Errors
    /// When the thread is gone.
    pub fn put(&mut self, outputs: Outputs) -> Result<(), WriterGone> {
        self.write(&outputs)?;
        self.turn = Some(Turn { outputs, retry_ns: None });
        Ok(())
    }

    fn write(&self, outputs: &Outputs) -> Result<(), WriterGone> {
        let jobs = self.jobs.as_ref().ok_or(WriterGone)?;
        jobs.send(outputs.entries.clone()).map_err(|_gone| WriterGone)
    }

    /// Looks how the turn here stands, and waits for the disk so long at most.
    ///
    /// # Errors
    /// When the thread is gone.
    pub fn settle(&mut self, now_ns: u64, patience: Duration) -> Result<Settled, WriterGone> {
        let Some(mut turn) = self.turn.take() else { return Ok(Settled::Empty) };
        if let Some(retry_ns) = turn.retry_ns {
            if now_ns < retry_ns {
                self.turn = Some(turn);
                return Ok(Settled::Refused);
            }
            self.write(&turn.outputs)?;
            turn.retry_ns = None;
        }
        match self.results.recv_timeout(patience) {
            Err(RecvTimeoutError::Disconnected) => Err(WriterGone),
            Err(RecvTimeoutError::Timeout) => {
                self.turn = Some(turn);
                Ok(Settled::Writing)
            }
            Ok(Err(error)) => {
                self.refused(now_ns, &error);
                turn.retry_ns = Some(now_ns + RETRY_NS);
                self.turn = Some(turn);
                Ok(Settled::Refused)
            }
            Ok(Ok(())) => {
                let over = self.trouble.take();
                if let Some(trouble) = &over {
                    tracing::info!(tries = trouble.tries, "the journal can be written again; going on");
                }
                Ok(Settled::Written {
                    effects: turn.outputs.effects,
                    late: over.is_some_and(|trouble| trouble.gave_up),
                })
            }
        }
    }

    fn refused(&mut self, now_ns: u64, error: &JournalError) {
        let reason = error.to_string();
        let trouble = self.trouble.get_or_insert_with(|| {
            tracing::error!(%error, "nothing new is done before this is written; trying again every second");
            Trouble { since_ns: now_ns, tries: 0, reason: String::new(), gave_up: false }
        });
        trouble.tries += 1;
        trouble.reason = reason;
        if !trouble.gave_up && now_ns >= trouble.since_ns.saturating_add(self.patience_ns) {
            tracing::error!("waited long enough for the journal; px4-link brings the vehicle home");
            trouble.gave_up = true;
        }
    }

    /// Why the disk refuses; `None` while it does not.
    #[must_use]
    pub fn trouble(&self) -> Option<&str> {
        self.trouble.as_ref().map(|trouble| trouble.reason.as_str())
    }

    /// Whether the disk has refused for too long.
    #[must_use]
    pub fn gave_up(&self) -> bool {
        self.trouble.as_ref().is_some_and(|trouble| trouble.gave_up)
    }

    /// What was in flight is void, as after a restart: the turn here is still written, but nothing is asked of anybody for
    /// it; the mission looks at the state and decides anew.
    pub fn forget_requests(&mut self) {
        if let Some(turn) = &mut self.turn {
            turn.outputs.effects.retain(|effect| !asks(effect));
        }
    }
}

/// Whether something is asked of somebody.
#[must_use]
pub fn asks(effect: &Effect) -> bool {
    match effect {
        Effect::Target(..) | Effect::Command(..) | Effect::Capture(..) | Effect::Round(..) | Effect::Score(..) => true,
        Effect::CommandOver(_)
        | Effect::CaptureOver(_)
        | Effect::RoundOver(_)
        | Effect::ScoreOver(_)
        | Effect::Answer(..)
        | Effect::State(..) => false,
    }
}

impl Drop for Desk {
    fn drop(&mut self) {
        self.jobs = None;
        // A result that nobody takes any more must not keep the thread from ending.
        while self.results.recv().is_ok() {}
        if let Some(thread) = self.thread.take() {
            thread.join().ok();
        }
    }
}

#[cfg(test)]
#[path = "desk_tests.rs"]
mod tests;
