//! Snapshot and candidate views to scores (paper section IV-D).
//!
//! One pass per candidate renders alpha and the moments of depth; the variance of depth, averaged over the projected box,
//! tells where the model is uncertain ([`logic`]). The planner asks; a thread computes ([`worker`], [`job`]); this service
//! holds the snapshots to score on and answers with every term of every candidate.
#![forbid(unsafe_code)]

pub mod holdings;
pub mod job;
pub mod logic;
pub mod measure;
pub mod ports;
pub mod renderer;
pub mod state;
pub mod worker;

use std::collections::VecDeque;

use crate::holdings::{Holdings, Lookup};
use crate::job::Job;
use crate::ports::{Asked, Ports};
use crate::renderer::Renderer;
use crate::state::{Event, State, due_ns};
use crate::worker::{Scored, Worker, WorkerGone};
use anyhow::{Context as _, anyhow};
use shared_types::bus::ReplyAddress;
use shared_types::config::Config;
use shared_types::config::trainer::DeclaredCost;
use shared_types::messages::{CandidateScore, ScoreReply, ScoreStatus, ServiceState};
use shared_types::payload::pack_text;
use shared_types::service::{Context, HealthReport, Service, ServiceError, Step, StopAnswer, last_exit};

/// Answers kept for requests that are sent again.
const ANSWERS_KEPT: usize = 8;
/// Requests that may wait; the planner has one at a time.
const WAITING_MAX: usize = 32;

/// Runs the scorer until it is told to stop.
///
/// # Errors
/// When the bus or the system fails.
pub fn run(mut context: Context) -> anyhow::Result<()> {
    let ports = Ports::open(&context.bus)?;
    let mut service = Scorer::new(ports, &context.config, context.lockstep())?;
    context.run(&mut service)?;
    Ok(())
}

/// A request that waits for its snapshot, or is under work.
#[derive(Debug)]
struct Wanted {
    generation: u64,
    job: Job,
    address: ReplyAddress,
}

/// An answer that was given.
#[derive(Debug)]
struct Answer {
    address: ReplyAddress,
    reply: ScoreReply,
    scores: Vec<CandidateScore>,
}

/// The scorer's side of the bus.
#[derive(Debug)]
pub struct Scorer {
    ports: Ports,
    worker: Worker,
    state: State,
    holdings: Holdings,
    /// The first is under work where the state says so.
    wanted: VecDeque<Wanted>,
    answers: VecDeque<Answer>,
    transparent_alpha: f64,
    ms_per_candidate: f64,
    lockstep: bool,
    /// The present tick waits for the thread.
    awaited: bool,
}

impl From<WorkerGone> for ServiceError {
    fn from(gone: WorkerGone) -> Self {
        Self::Other(gone.to_string())
    }
}

impl Scorer {
    /// Starts the scoring thread.
    ///
    /// # Errors
    /// When the system refuses threads.
    pub fn new(ports: Ports, config: &Config, lockstep: bool) -> anyhow::Result<Self> {
        let threads = match config.scorer.threads {
            0 => std::thread::available_parallelism().map_or(1, usize::from),
            n => n as usize,
        };
        let mut renderer = Renderer::new(&config.scorer, threads, last_exit().is_some()).map_err(|error| {
            let expected = "expected one that `vantage doctor` lists, or scorer.backend=cpu";
            ServiceError::Unusable(format!("scorer.backend, scorer.adapter: {error}; {expected}"))
        })?;
        let ms_per_candidate = match config.scorer.ms_per_candidate {
            _ if !lockstep => 0.0,
            DeclaredCost::Fixed(ms) => ms,
            DeclaredCost::Word(_) => {
                measure::ms_per_candidate(renderer.backend(), config.model.width, config.model.height)
                    .map_err(|reason| anyhow!("scorer.ms_per_candidate = \"auto\" cannot be measured: {reason}"))?
            }
        };
        Ok(Self {
            ports,
            worker: Worker::start(renderer).context("cannot start the scoring thread")?,
            state: State::Idle,
            holdings: Holdings::default(),
            wanted: VecDeque::new(),
            answers: VecDeque::new(),
            transparent_alpha: config.scorer.transparent_alpha,
            ms_per_candidate,
            lockstep,
            awaited: false,
        })
    }

    /// Takes a request: answers it at once where it was answered before or makes no sense, else queues it.
    fn take(&mut self, now_ns: u64, asked: Asked) -> Result<(), ServiceError> {
        if let Some(answer) = self.answers.iter().find(|answer| answer.address == asked.address) {
            self.ports.reply(now_ns, &asked.address, &answer.reply, &answer.scores)?;
            return Ok(());
        }
        if let Some(position) = self.wanted.iter().position(|wanted| wanted.address == asked.address) {
            let under_work = position == 0 && self.state != State::Idle;
            if !under_work && matches!(self.holdings.look(asked.request.generation), Lookup::NotYet) {
                self.reply_status(now_ns, &asked.address, asked.request.generation, ScoreStatus::Waiting, "")?;
            }
            return Ok(());
        }
        if self.wanted.len() >= WAITING_MAX {
            let reason = "too many requests wait; ask again later";
            return self.reply_status(now_ns, &asked.address, asked.request.generation, ScoreStatus::Refused, reason);
        }
        match Job::from_request(&asked.request, &asked.views, self.transparent_alpha) {
            Ok(job) => {
                self.wanted.push_back(Wanted { generation: asked.request.generation, job, address: asked.address });
                Ok(())
            }
            Err(reason) => {
                self.reply_status(now_ns, &asked.address, asked.request.generation, ScoreStatus::Refused, &reason)
            }
        }
    }

    /// Gives the next request whose snapshot is held to the thread, and turns away those whose snapshot is gone.
    fn begin(&mut self, now_ns: u64) -> Result<(), ServiceError> {
        let mut at = 0;
        while let Some(wanted) = self.wanted.get(at) {
            match self.holdings.look(wanted.generation) {
                Lookup::NotYet => at += 1,
                Lookup::Gone => {
                    let (address, generation) = (wanted.address, wanted.generation);
                    self.wanted.remove(at);
                    let reason = "another snapshot has taken its place; ask with the newest";
                    self.reply_status(now_ns, &address, generation, ScoreStatus::GenerationGone, reason)?;
                }
                Lookup::Found(held) => {
                    let due_ns = due_ns(now_ns, wanted.job.candidates(), self.ms_per_candidate);
                    self.worker.begin(wanted.job.clone(), held)?;
                    self.wanted.swap(0, at);
                    self.state = self.state.on(Event::Begun { due_ns });
                    return Ok(());
                }
            }
        }
        Ok(())
    }

    fn answer(&mut self, now_ns: u64, scored: Scored) -> Result<(), ServiceError> {
        self.state = self.state.on(Event::Answered);
        let Some(wanted) = self.wanted.pop_front() else { return Ok(()) };
        let scores = scored.scores.scores;
        let reply = ScoreReply {
            generation: wanted.generation,
            newest_generation: self.holdings.newest_generation(),
            cpu_ns: scored.cpu_ns,
            status: ScoreStatus::Done.code(),
            candidates: scores.len() as u32,
            uncertainty_p95: scored.scores.uncertainty_p95,
            reason: pack_text(""),
        };
        self.ports.reply(now_ns, &wanted.address, &reply, &scores)?;
        self.answers.push_back(Answer { address: wanted.address, reply, scores });
        if self.answers.len() > ANSWERS_KEPT {
            self.answers.pop_front();
        }
        Ok(())
    }

    fn reply_status(
        &mut self,
        now_ns: u64,
        to: &ReplyAddress,
        generation: u64,
        status: ScoreStatus,
        reason: &str,
    ) -> Result<(), ServiceError> {
        let reply = ScoreReply {
            generation,
            newest_generation: self.holdings.newest_generation(),
            status: status.code(),
            reason: pack_text(reason),
            ..ScoreReply::default()
        };
        self.ports.reply(now_ns, to, &reply, &[])?;
        Ok(())
    }

    fn turn(&mut self, now_ns: u64) -> Result<Step, ServiceError> {
        self.ports.receive_snapshots(now_ns, &mut self.holdings)?;
        while let Some(asked) = self.ports.receive_request(now_ns)? {
            self.take(now_ns, asked)?;
        }
        loop {
            match self.state {
                State::Idle => {
                    self.begin(now_ns)?;
                    if self.state == State::Idle {
                        return Ok(Step::Done);
                    }
                }
                State::Scoring { due_ns } if now_ns < due_ns => return Ok(Step::Done),
                State::Scoring { .. } => match self.worker.poll()? {
                    Some(scored) => self.answer(now_ns, scored)?,
                    // Due and not there yet: in lockstep the tick waits for it.
                    None => return Ok(if self.lockstep { Step::Waiting } else { Step::Done }),
                },
            }
        }
    }
}

impl Service for Scorer {
    fn step(&mut self, now_ns: u64) -> Result<Step, ServiceError> {
        let step = self.turn(now_ns)?;
        self.awaited = step == Step::Waiting;
        Ok(step)
    }

    fn work(&self) -> u64 {
        self.worker.work()
    }

    fn busy(&self) -> bool {
        if self.lockstep { self.awaited } else { matches!(self.state, State::Scoring { .. }) }
    }

    fn rejoin(&mut self, now_ns: u64) {
        self.state = self.state.on(Event::Rejoined { now_ns });
    }

    fn health(&self) -> HealthReport {
        HealthReport {
            state: ServiceState::Running,
            last_error: String::new(),
            received: self.ports.received,
            sent: self.ports.sent,
            dropped: self.ports.dropped,
        }
    }

    fn stop(&mut self, _now_ns: u64) -> StopAnswer {
        StopAnswer::Now
    }
}
