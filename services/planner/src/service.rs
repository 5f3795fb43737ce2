//! The planner as a service: receive, decide, write down, act.

use shared_types::folder::{FolderError, MissionFolder};
use shared_types::messages::{MissionCommand, ServiceState, mission_key};
use shared_types::service::{Context, HealthReport, Service, ServiceError, Step, StopAnswer};

use crate::journal::Journal;
use crate::mission::{Mission, Setup};
use crate::ports::{FolderViews, Ports};

const ALIVE_PERIOD_NS: u64 = 100_000_000;

/// The service.
#[derive(Debug)]
pub struct Planner {
    ports: Ports,
    journal: Journal,
    views: FolderViews,
    mission: Mission,
    alive_ns: Option<u64>,
    turns: u64,
    stopping: bool,
    leaving: bool,
    last_error: String,
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
        };
        ports.count_within(mission_key(&setup.mission_id, &setup.folder));
        tracing::info!(entries = entries.len(), "the journal is read");
        let mission = Mission::new(setup, &entries);
        Ok(Self {
            ports,
            journal,
            views: FolderViews(folder),
            mission,
            alive_ns: None,
            turns: 0,
            stopping: false,
            leaving: false,
            last_error: String::new(),
        })
    }
}

impl Service for Planner {
    fn step(&mut self, now_ns: u64) -> Result<Step, ServiceError> {
        self.turns += 1;
        let mut inputs = self.ports.receive(now_ns)?;
        if self.stopping {
            // Not the operator's stop: he may only want this process away, and the mission goes on after that.
            self.stopping = false;
            inputs.commands.push((usize::MAX, MissionCommand::Recall));
        }
        let outputs = self.mission.step(now_ns, inputs, &mut self.views);
        self.journal.append(&outputs.entries).map_err(|error| {
            self.last_error = error.to_string();
            ServiceError::Other(error.to_string())
        })?;
        for effect in &outputs.effects {
            self.ports.carry_out(now_ns, effect)?;
        }
        if self.alive_ns.is_none_or(|last| now_ns >= last + ALIVE_PERIOD_NS) {
            self.alive_ns = Some(now_ns);
            self.ports.alive(now_ns, self.turns)?;
        }
        if self.leaving && self.mission.is_over() { Ok(Step::Leave) } else { Ok(Step::Done) }
    }

    fn work(&self) -> u64 {
        self.turns
    }

    fn rejoin(&mut self, _now_ns: u64) {
        if let Err(error) = self.ports.forget() {
            self.last_error = error.to_string();
        }
        self.mission.rejoin();
    }

    fn health(&self) -> HealthReport {
        HealthReport {
            state: ServiceState::Running,
            last_error: self.last_error.clone(),
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
