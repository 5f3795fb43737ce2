//! Keyframes to Gaussian model to snapshots (paper section IV-F).
//!
//! The planner asks for training rounds; a thread computes them ([`worker`], [`session`]) from the keyframes in the mission
//! folder; this service answers, publishes snapshots of the model, and decides when results are due on the mission clock.
//! Everything is on disk before it is told: a restarted trainer goes on from its newest checkpoint.
#![forbid(unsafe_code)]

pub mod backend;
pub mod checkpoint;
pub mod keyframes;
pub mod logic;
pub mod measure;
pub mod memory;
pub mod ports;
mod progression;
pub mod requests;
pub mod round;
pub mod session;
pub mod state;
pub mod untrained;
pub mod worker;

use std::time::{Duration, Instant};

use anyhow::{Context as _, bail};
use shared_types::config::Config;
use shared_types::config::trainer::DeclaredCost;
use shared_types::folder::MissionFolder;
use shared_types::messages::ServiceState;
use shared_types::service::{Context, HealthReport, Service, ServiceError, Step, StopAnswer};
use shared_types::{NS_PER_S, TICK_NS, ns_from_s};
use splatting::Training;

use crate::backend::{NoBackend, Past};
use crate::ports::{Outcome, Ports};
use crate::requests::{Requests, Verdict};
use crate::round::Progress;
use crate::session::{Session, Snapshot};
use crate::state::{Event, Running, Schedule, State};
use crate::worker::{Output, Pace, Worker, WorkerGone};

/// How long a stop may wait for the present slice and its checkpoint.
const STOP_PATIENCE: Duration = Duration::from_secs(8);

/// Runs the trainer until it is told to stop.
///
/// # Errors
/// When the configuration names no mission folder, or the bus, the folder or the system fails.
pub fn run(mut context: Context) -> anyhow::Result<()> {
    let ports = Ports::open(&context.bus)?;
    let mut service = Trainer::new(ports, &context.config, context.lockstep())?;
    context.run(&mut service)?;
    Ok(())
}

/// The trainer's side of the bus.
#[derive(Debug)]
pub struct Trainer {
    ports: Ports,
    worker: Worker,
    state: State,
    requests: Requests,
    final_snapshot: Option<Snapshot>,
    progress: Progress,
    slice_iterations: u32,
    /// Infinite in wall mode: results are due when they are there.
    iterations_per_s: f64,
    lockstep: bool,
    /// The present tick waits for the thread.
    awaited: bool,
    snapshot_period_ns: u64,
    checkpoint_period_ns: u64,
    asked_snapshot_ns: u64,
    asked_checkpoint_ns: u64,
    no_room: Option<NoRoom>,
    last_error: String,
}

/// A round's end waits for room on the disk.
#[derive(Debug)]
struct NoRoom {
    reason: String,
    retry_ns: u64,
    /// The present tick, and when it began on the wall's clock.
    tick: (u64, Instant),
}

impl From<WorkerGone> for ServiceError {
    fn from(gone: WorkerGone) -> Self {
        Self::Other(gone.to_string())
    }
}

impl Trainer {
    /// Starts the training thread on the configured mission folder.
    ///
    /// # Errors
    /// When there is no such folder, or the system refuses threads.
    pub fn new(ports: Ports, config: &Config, lockstep: bool) -> anyhow::Result<Self> {
        if config.mission.folder.is_empty() {
            bail!("mission.folder is empty; expected the mission folder's path (`vantage fly` fills it in)");
        }
        memory::limit(config.trainer.memory_mb);
        let folder = MissionFolder::open(&config.mission.folder)?;
        let threads = match config.trainer.threads {
            0 => std::thread::available_parallelism().map_or(1, usize::from),
            n => n as usize,
        };
        let model_folder = folder.model_path();
        let last_exit = shared_types::service::last_exit();
        let past = Past { flight_ns: config.mission.epoch_ns, last_exit: last_exit.as_deref() };
        let backend = match backend::choose(&config.trainer, &model_folder, threads, past) {
            Err(error @ NoBackend::Configured(_)) => return Err(ServiceError::Unusable(error.to_string()).into()),
            chosen => chosen?,
        };
        let mut training = Training::new(backend);
        let iterations_per_s = match config.trainer.iterations_per_s {
            _ if !lockstep => f64::INFINITY,
            DeclaredCost::Fixed(rate) => rate,
            DeclaredCost::Word(_) => measure::iterations_per_s(&mut training, config.model.width, config.model.height)?,
        };
        let pace = if lockstep {
            Pace::Counted {
                snapshot_every: config.trainer.snapshot_period_s * iterations_per_s,
                checkpoint_every: config.trainer.checkpoint_period_s * iterations_per_s,
            }
        } else {
            Pace::OnDemand
        };
        let mut model = config.model.clone();
        model.max_gaussians = memory::most_gaussians(
            &model_folder,
            model.max_gaussians,
            // With core dumps a panic ends in SIGABRT, which else is the end of an allocation that was refused.
            last_exit.as_deref().filter(|exit| !(config.launch.core_dumps && *exit == "signal 6")),
            memory::kernel_kills(),
            || checkpoint::newest(&model_folder, false).map(|newest| newest.gaussians()),
        );
        let session = Session::new(config.trainer.clone(), model, training.into_backend());
        let worker = Worker::start(session, Box::new(folder), model_folder, config.trainer.slice_iterations, pace)
            .context("cannot start the training thread")?;
        Ok(Self {
            ports,
            worker,
            state: State::Starting,
            requests: Requests::default(),
            final_snapshot: None,
            progress: Progress::default(),
            slice_iterations: config.trainer.slice_iterations,
            iterations_per_s,
            lockstep,
            awaited: false,
            snapshot_period_ns: ns_from_s(config.trainer.snapshot_period_s),
            checkpoint_period_ns: ns_from_s(config.trainer.checkpoint_period_s),
            asked_snapshot_ns: 0,
            asked_checkpoint_ns: 0,
            no_room: None,
            last_error: String::new(),
        })
    }

    fn turn(&mut self, now_ns: u64) -> Result<Step, ServiceError> {
        // Before the folder was looked at, nothing is known of rounds that are over: requests wait in their queue.
        if self.state == State::Starting && !self.look()? {
            return Ok(self.waiting());
        }
        self.receive(now_ns)?;
        loop {
            match self.state {
                State::Starting => return Ok(self.waiting()),
                State::Idle => {
                    if !self.begin(now_ns)? {
                        return Ok(Step::Done);
                    }
                }
                State::Training(running) => {
                    if now_ns < running.next_due_ns(self.slice_iterations) {
                        return Ok(Step::Done);
                    }
                    if let Some(step) = self.wait_for_room(now_ns) {
                        return Ok(step);
                    }
                    self.ask(now_ns);
                    match self.worker.poll()? {
                        Some(output) => self.training_output(now_ns, running, output)?,
                        None => return Ok(self.waiting()),
                    }
                }
                State::Publishing => {
                    if let Some(snapshot) = &self.final_snapshot
                        && !self.ports.publish(now_ns, snapshot)?
                    {
                        // Every chunk is with a slow reader: the final one is retried, never skipped.
                        return Ok(Step::Done);
                    }
                    self.published(now_ns)?;
                }
            }
        }
    }

    /// Takes what the thread found in the mission folder; false while it still looks.
    fn look(&mut self) -> Result<bool, ServiceError> {
        let Some(Output::Ready { finished, active, snapshot }) = self.worker.poll()? else { return Ok(false) };
        self.progress = finished.last().map_or_else(Progress::default, |round| round.progress);
        self.progress.iterations = active.map_or(0, |(_, iterations)| iterations);
        self.requests.finished = finished;
        self.state = self.state.on(Event::Ready { has_model: snapshot.is_some() });
        self.final_snapshot = snapshot;
        Ok(true)
    }

    /// Answers what can be answered at once, and queues the rest.
    fn receive(&mut self, now_ns: u64) -> Result<(), ServiceError> {
        while let Some(asked) = self.ports.receive(now_ns)? {
            let verdict = match asked.spec {
                Ok(spec) => self.requests.take(spec, asked.address),
                Err(reason) => Verdict::Refused(reason),
            };
            let (progress, outcome) = match &verdict {
                Verdict::Waits => continue,
                Verdict::Done(round) => (round.progress, Outcome::Done { generation: round.generation }),
                Verdict::Refused(reason) => (Progress::default(), Outcome::Failed { reason }),
            };
            self.ports.reply(now_ns, &asked.address, asked.round, &progress, &outcome)?;
        }
        Ok(())
    }

    /// Gives the next wanted round to the thread; false when there is none.
    fn begin(&mut self, now_ns: u64) -> Result<bool, ServiceError> {
        let Some(wanted) = self.requests.wanted.front() else { return Ok(false) };
        let spec = wanted.spec.clone();
        // A round cut off by a restart goes on where its checkpoint is; what is left of it is due from now.
        let done = std::mem::take(&mut self.progress.iterations).min(spec.max_iterations);
        let running = Running {
            round: spec.round,
            max_iterations: spec.max_iterations,
            schedule: Schedule { base_ns: now_ns, base_iterations: done, iterations_per_s: self.iterations_per_s },
            published: done,
            over: false,
            progress_ns: now_ns,
        };
        tracing::info!(round = spec.round, keyframes = spec.keyframes.len(), done, "training");
        self.worker.begin(spec)?;
        (self.asked_snapshot_ns, self.asked_checkpoint_ns) = (now_ns, now_ns);
        self.state = self.state.on(Event::Begun(running));
        Ok(true)
    }

    /// The step of a tick in which a round's end waits for room; `None` where it does not, or is being written again.
    fn wait_for_room(&mut self, now_ns: u64) -> Option<Step> {
        let lockstep = self.lockstep;
        let waiting = self.no_room.as_mut()?;
        if now_ns >= waiting.retry_ns {
            waiting.retry_ns = u64::MAX;
            self.worker.retry();
        }
        if waiting.retry_ns == u64::MAX {
            return None;
        }
        // Who frees the disk needs real time for it: simulated time keeps to the wall's meanwhile.
        if waiting.tick.0 != now_ns {
            waiting.tick = (now_ns, Instant::now());
        }
        let too_early = lockstep && waiting.tick.1.elapsed() < Duration::from_nanos(TICK_NS);
        Some(if too_early { Step::Waiting } else { Step::Done })
    }

    fn training_output(&mut self, now_ns: u64, running: Running, output: Output) -> Result<(), ServiceError> {
        match output {
            Output::Slice { progress, over, snapshot } => {
                self.progress = progress;
                if let Some(snapshot) = snapshot {
                    // A live one without a free chunk is skipped, and counted by the port.
                    self.ports.publish(now_ns, &snapshot)?;
                }
                let due = now_ns.saturating_sub(running.progress_ns) >= NS_PER_S;
                if due {
                    self.reply_to_all(now_ns, running.round, &progress, &Outcome::Progress)?;
                }
                let progress_ns = if due { now_ns } else { running.progress_ns };
                self.state = State::Training(Running { progress_ns, ..running })
                    .on(Event::Slice { iterations: progress.iterations, over });
            }
            Output::NoRoom { reason } => {
                if self.no_room.is_none() {
                    tracing::error!(round = running.round, reason, "the end of a round waits for room on the disk");
                }
                self.no_room = Some(NoRoom { reason, retry_ns: now_ns + NS_PER_S, tick: (now_ns, Instant::now()) });
            }
            Output::Finished { round, snapshot } => {
                if self.no_room.take().is_some() {
                    tracing::info!(round = running.round, "the end of a round is on the disk now");
                }
                self.progress = round.progress;
                self.requests.finished.push(round);
                self.final_snapshot = Some(snapshot);
                self.state = self.state.on(Event::Finished);
            }
            Output::Failed { round, reason } => {
                self.no_room = None;
                tracing::error!(round, reason, "a training round cannot be run");
                self.last_error.clone_from(&reason);
                self.reply_to_all(now_ns, round, &Progress::default(), &Outcome::Failed { reason: &reason })?;
                self.requests.wanted.pop_front();
                self.progress.iterations = 0;
                self.state = self.state.on(Event::Failed);
            }
            Output::Broken { reason } => {
                // A restarted trainer goes on from the newest checkpoint, and knows what happened.
                return Err(ServiceError::Other(format!("the back end failed: {reason}")));
            }
            Output::Ready { .. } | Output::Stopped => {}
        }
        Ok(())
    }

    /// The final snapshot is out: whoever waited for the round hears that it is over.
    fn published(&mut self, now_ns: u64) -> Result<(), ServiceError> {
        self.final_snapshot = None;
        let over = self.requests.finished.last().map(|done| (done.spec.round, done.progress, done.generation));
        if let Some((round, progress, generation)) = over
            && self.requests.wanted.front().is_some_and(|wanted| wanted.spec.round == round)
        {
            tracing::info!(
                round,
                iterations = progress.iterations,
                gaussians = progress.gaussians,
                psnr_train_db = progress.psnr_train_db,
                "round over"
            );
            self.reply_to_all(now_ns, round, &progress, &Outcome::Done { generation })?;
            self.requests.wanted.pop_front();
            self.progress.iterations = 0;
        }
        self.state = self.state.on(Event::Published);
        Ok(())
    }

    fn reply_to_all(
        &mut self,
        now_ns: u64,
        round: u32,
        progress: &Progress,
        outcome: &Outcome<'_>,
    ) -> Result<(), ServiceError> {
        let addresses = self.requests.wanted.front().map_or_else(Vec::new, |wanted| wanted.addresses.clone());
        for address in &addresses {
            self.ports.reply(now_ns, address, round, progress, outcome)?;
        }
        Ok(())
    }

    /// In wall mode, asks the thread for what is due by time.
    fn ask(&mut self, now_ns: u64) {
        if self.lockstep {
            return;
        }
        if now_ns.saturating_sub(self.asked_snapshot_ns) >= self.snapshot_period_ns {
            self.asked_snapshot_ns = now_ns;
            self.worker.ask_snapshot();
        }
        if now_ns.saturating_sub(self.asked_checkpoint_ns) >= self.checkpoint_period_ns {
            self.asked_checkpoint_ns = now_ns;
            self.worker.ask_checkpoint();
        }
    }

    /// A result that is due is not there yet: in lockstep the tick waits for it.
    fn waiting(&self) -> Step {
        if self.lockstep { Step::Waiting } else { Step::Done }
    }
}

impl Service for Trainer {
    fn step(&mut self, now_ns: u64) -> Result<Step, ServiceError> {
        let step = self.turn(now_ns)?;
        self.awaited = step == Step::Waiting;
        Ok(step)
    }

    fn work(&self) -> u64 {
        self.worker.work()
    }

    /// In lockstep the thread runs ahead of the clock and then waits for it: only what is awaited is in work for certain.
    fn busy(&self) -> bool {
        if self.lockstep { self.awaited } else { matches!(self.state, State::Starting | State::Training(_)) }
    }

    fn rejoin(&mut self, now_ns: u64) {
        self.state = self.state.on(Event::Rejoined { now_ns });
    }

    fn health(&self) -> HealthReport {
        let (skipped, why) = self.worker.skipped();
        let trouble = match &self.no_room {
            Some(waiting) => Some(waiting.reason.clone()),
            None => (!why.is_empty()).then(|| format!("{skipped} checkpoints skipped: {why}")),
        };
        let state = match self.state {
            State::Starting => ServiceState::Starting,
            _ if trouble.is_some() => ServiceState::Degraded,
            _ => ServiceState::Running,
        };
        HealthReport {
            state,
            last_error: trouble.unwrap_or_else(|| self.last_error.clone()),
            received: self.ports.received,
            sent: self.ports.sent,
            dropped: self.ports.dropped + skipped,
        }
    }

    fn stop(&mut self, _now_ns: u64) -> StopAnswer {
        if !self.worker.stop(STOP_PATIENCE) {
            tracing::warn!("the training thread did not stop in time; its newest checkpoint stands");
        }
        StopAnswer::Now
    }
}
