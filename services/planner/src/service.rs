//! The planner as a service: receive, decide, write down, act.

use std::time::{Duration, Instant};

use shared_types::folder::{FolderError, MissionFolder};
use shared_types::messages::{ServiceState, mission_key};
use shared_types::service::{Context, HealthReport, Service, ServiceError, Step, StopAnswer};

use shared_types::trace::InState;
use shared_types::{TICK_NS, ns_from_s, stage};

use crate::desk::{Desk, Settled, WriterGone, asks};
use crate::io::Inputs;
use crate::journal::Journal;
use crate::mission::{Mission, Setup};
use crate::ports::{FolderViews, Ports};

const ALIVE_PERIOD_NS: u64 = 100_000_000;
/// Wait for the disk within a turn: short beside the period of the sign of life.
const DISK_WAIT: Duration = Duration::from_millis(20);

/// The service.
#[derive(Debug)]
pub struct Planner {
    ports: Ports,
    desk: Desk,
    views: FolderViews,
    mission: Mission,
    /// What came since the last turn of the mission.
    inputs: Inputs,
    lockstep: bool,
    alive_ns: Option<u64>,
    turns: u64,
    /// Turns of the mission: real progress.
    decided: u64,
    /// The present tick, and when it began on the wall's clock.
    tick: (u64, Instant),
    stopping: bool,
    leaving: bool,
    last_error: String,
    phase: InState,
}

impl From<WriterGone> for ServiceError {
    fn from(gone: WriterGone) -> Self {
        Self::Other(gone.to_string())
    }
}

impl Planner {
    /// Opens the mission folder of the configuration and reads its journal.
    ///
    /// # Errors
    /// When no folder is configured, or it or its journal cannot be opened.
    pub fn new(mut ports: Ports, context: &Context) -> anyhow::Result<Self> {
        let config = &context.config;
        let root = &config.mission.folder;
        anyhow::ensure!(
            !root.is_empty(),
            "mission.folder is empty; expected the absolute path of a folder: `vantage fly --output DIR` fills it in"
        );
        let folder = MissionFolder::open(root).or_else(|error| match error {
            FolderError::NoMission { .. } => MissionFolder::create(root),
            other => Err(other),
        })?;
        let (journal, entries) = Journal::open(&folder.journal_path())?;
        let setup = Setup {
            planner: config.planner.clone(),
            camera: config.camera.clone(),
            mission_id: config.mission.id.clone(),
            folder: root.clone(),
            seed: config.mission.seed,
            epoch_ns: config.mission.epoch_ns,
        };
        ports.count_within(mission_key(&setup.mission_id, &setup.folder));
        tracing::info!(entries = entries.len(), "the journal is read");
        let mission = Mission::new(setup, &entries);
        let desk = Desk::start(journal, ns_from_s(config.planner.disk_patience_s))?;
        Ok(Self {
            ports,
            desk,
            views: FolderViews(folder),
            mission,
            inputs: Inputs::default(),
            lockstep: context.lockstep(),
            alive_ns: None,
            turns: 0,
            decided: 0,
            tick: (0, Instant::now()),
            stopping: false,
            leaving: false,
            last_error: String::new(),
            phase: InState::default(),
        })
    }
}

impl Planner {
    /// Takes a turn of the mission: what it decides lies on the desk then, or is done where there is nothing to write.
    fn decide(&mut self, now_ns: u64) -> Result<(), ServiceError> {
        let inputs = core::mem::take(&mut self.inputs);
        if self.stopping {
            // Not the operator's stop: he may only want this process away, and the mission goes on after that.
            self.stopping = false;
            self.mission.step_down();
        }
        let outputs = self.mission.step(now_ns, inputs, &mut self.views);
        self.decided += 1;
        let phase = self.mission.phase();
        self.phase.is(phase.code(), || stage!("phase", name = phase.name(), track = "flight"));
        if outputs.entries.is_empty() {
            return outputs.effects.iter().try_for_each(|effect| Ok(self.ports.carry_out(now_ns, effect)?));
        }
        Ok(self.desk.put(outputs)?)
    }

    /// Sees what has become of what lies on the desk, and does it once it is written.
    fn settle(&mut self, now_ns: u64) -> Result<Step, ServiceError> {
        match self.desk.settle(now_ns, DISK_WAIT)? {
            Settled::Empty => Ok(Step::Done),
            // Syncs cost no mission time.
            Settled::Writing if self.lockstep => Ok(Step::Waiting),
            Settled::Writing => Ok(Step::Done),
            Settled::Refused => self.refused(),
            Settled::Written { effects, late } => {
                self.decided += 1;
                // After too long, these were decided for a vehicle that was still ours.
                for effect in effects.iter().filter(|effect| !(late && asks(effect))) {
                    self.ports.carry_out(now_ns, effect)?;
                }
                if late {
                    self.ports.forget()?;
                    self.mission.come_home();
                }
                Ok(Step::Done)
            }
        }
    }

    /// The disk takes nothing: the vehicle waits, in the air not for ever.
    fn refused(&self) -> Result<Step, ServiceError> {
        let landed = self.inputs.vehicle.map_or(self.mission.on_ground(), |v| v.landed == 1 && v.armed == 0);
        if self.desk.gave_up() && landed {
            return Err(ServiceError::Missing(self.desk.trouble().unwrap_or_default().to_owned()));
        }
        // Who frees the disk needs real time for it: simulated time keeps to the wall's meanwhile.
        let too_early = self.lockstep && self.tick.1.elapsed() < Duration::from_nanos(TICK_NS);
        Ok(if too_early { Step::Waiting } else { Step::Done })
    }
}

impl Service for Planner {
    fn step(&mut self, now_ns: u64) -> Result<Step, ServiceError> {
        let fresh = self.tick.0 != now_ns;
        if fresh {
            self.tick = (now_ns, Instant::now());
            self.turns += 1;
        }
        let newer = self.ports.receive(now_ns)?;
        self.inputs.absorb(newer);
        // In lockstep, a tick that was held for the disk has had its turn.
        if !self.desk.is_taken() && (fresh || !self.lockstep) {
            self.decide(now_ns)?;
        }
        let step = self.settle(now_ns)?;
        let alive = self.alive_ns.is_none_or(|last| now_ns >= last + ALIVE_PERIOD_NS);
        if alive && step == Step::Done && !self.desk.gave_up() {
            self.alive_ns = Some(now_ns);
            self.ports.alive(now_ns, self.turns)?;
        }
        if step == Step::Done && self.leaving && self.mission.is_over() && !self.desk.is_taken() {
            return Ok(Step::Leave);
        }
        Ok(step)
    }

    fn work(&self) -> u64 {
        self.decided
    }

    fn rejoin(&mut self, _now_ns: u64) {
        if let Err(error) = self.ports.forget() {
            self.last_error = error.to_string();
        }
        self.inputs = Inputs::default();
        self.desk.forget_requests();
        self.mission.rejoin();
    }

    fn health(&self) -> HealthReport {
        let trouble = self.desk.trouble();
        HealthReport {
            state: if trouble.is_some() { ServiceState::Degraded } else { ServiceState::Running },
            last_error: trouble.unwrap_or(&self.last_error).to_owned(),
            received: self.ports.received,
            sent: self.ports.sent,
            dropped: self.ports.dropped,
        }
    }

    fn stop(&mut self, _now_ns: u64) -> StopAnswer {
        // In the air the vehicle is brought home first; the journal says how to go on.
        if self.mission.on_ground() || self.mission.is_over() {
            return StopAnswer::Now;
        }
        self.stopping = true;
        self.leaving = true;
        StopAnswer::Later
    }

    fn orphaned(&mut self, _now_ns: u64) -> StopAnswer {
        // px4-link brings the vehicle home by itself. With nothing recorded that ends it, `resume` goes on.
        StopAnswer::Now
    }
}
