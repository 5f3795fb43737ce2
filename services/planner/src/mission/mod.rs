//! The mission as a state machine over plain data: Algorithm 1, and everything around it that goes wrong.
//!
//! What must outlive the planner is in the [`Ledger`], which changes only by records of the journal; what is here besides
//! is found again from the vehicle's state. A turn gives back the records first: they are on disk before their effects.

mod flight;
mod frame;
mod report;
mod rounds;
mod survey;
mod vehicle;

pub use rounds::round_request;

use std::collections::BTreeSet;

use glam::DVec3;
use shared_types::config::{CameraConfig, PlannerConfig};
use shared_types::messages::{
    CommandReply, CommandRequest, CommandStatus, EndReason, KeyframeReason, MissionCommand, MissionState,
    VehicleCommand, VehicleState,
};
use shared_types::ns_from_s;
use shared_types::payload::unpack_text;

use crate::io::{Effect, Inputs, Outputs, Views};
use crate::journal::{Entry, Record};
use crate::ledger::Ledger;
use crate::logic::candidates::Candidates;
use crate::logic::coverage::Coverage;
use crate::logic::path::Roadmap;
use crate::logic::space::{FreeSpace, Volume};
use crate::logic::view::Mount;
use crate::state::State;

/// Ids of prior views begin here: no keyframe has them.
pub const PRIOR_IDS: u64 = 1_000_000;

/// A home that moved by less is the same, metres.
const SAME_HOME_M: f64 = 0.01;

/// What a mission is given once.
#[derive(Debug, Clone)]
pub struct Setup {
    /// Section `[planner]`.
    pub planner: PlannerConfig,
    /// Section `[camera]`.
    pub camera: CameraConfig,
    /// The mission's id.
    pub mission_id: String,
    /// The mission folder, for `mission/state`.
    pub folder: String,
    /// Seed of everything random.
    pub seed: u64,
    /// Mission time at which `vantage fly` or `vantage resume` began: what lies before was measured in another flight.
    pub epoch_ns: u64,
}

/// A command that is being waited for.
#[derive(Debug)]
struct Pending {
    id: u64,
    command: VehicleCommand,
    since_ns: u64,
    /// px4-link works on it.
    accepted: bool,
    answer: Option<Result<(), String>>,
}

/// Where the vehicle may fly, and the views.
#[derive(Debug)]
struct Terrain {
    survey_m: DVec3,
    home_m: DVec3,
    space: FreeSpace,
    roadmap: Roadmap,
    candidates: Candidates,
}

/// The mission.
#[derive(Debug)]
pub struct Mission {
    setup: Setup,
    mount: Mount,
    ledger: Ledger,
    state: State,
    now_ns: u64,
    vehicle: Option<VehicleState>,
    terrain: Option<Terrain>,
    coverage: Coverage,
    counted: BTreeSet<u64>,
    pending: Option<Pending>,
    retry_ns: u64,
    refusals: u32,
    /// Since when a failsafe acts without telling why.
    unexplained_ns: Option<u64>,
    flight_failures: u32,
    flown: bool,
    scan_step: u32,
    pitch_rad: f64,
    path_m: f64,
    round_sent: Option<u64>,
    score_sent: Option<u64>,
    progress_ns: u64,
    trainer_failed: bool,
    /// Told to come home and to leave the mission open. In no journal: `resume` goes on as if it had not been said.
    recalled: bool,
    /// Recalled because the process that runs it is to end: the next one goes on, so nobody is told that it is over.
    stepping_down: bool,
    /// Told to end before it began.
    cancelled: bool,
    /// The object was not found as it was: recalled for that.
    misaligned: bool,
    published: Option<(MissionState, u64)>,
    sequence: u64,
    out: Outputs,
}

impl Mission {
    /// A mission that goes on after these entries of its journal; a new one after none.
    #[must_use]
    pub fn new(setup: Setup, entries: &[Entry]) -> Self {
        let ledger = Ledger::replay_for(entries, setup.epoch_ns);
        let misaligned = ledger.misaligned_ns.is_some_and(|at_ns| at_ns >= setup.epoch_ns);
        let state = if ledger.over.is_some() {
            State::Over
        } else if ledger.started_ns.is_none() {
            State::Idle
        } else if ledger.suspended {
            State::Suspended(false)
        } else if ledger.airborne.is_some() {
            State::Deciding
        } else {
            State::Preparing
        };
        let mount = Mount {
            pivot_in_body_m: DVec3::from_array(setup.camera.body_from_gimbal_m),
            camera_in_payload_m: DVec3::from_array(setup.camera.gimbal_from_camera_m),
        };
        Self {
            setup,
            mount,
            progress_ns: ledger.last_ns,
            ledger,
            state,
            now_ns: 0,
            vehicle: None,
            terrain: None,
            coverage: Coverage::default(),
            counted: BTreeSet::new(),
            pending: None,
            retry_ns: 0,
            refusals: 0,
            unexplained_ns: None,
            flight_failures: 0,
            flown: false,
            scan_step: 0,
            pitch_rad: 0.0,
            path_m: 0.0,
            round_sent: None,
            score_sent: None,
            trainer_failed: false,
            recalled: misaligned,
            stepping_down: false,
            cancelled: false,
            misaligned,
            published: None,
            sequence: 0,
            out: Outputs::default(),
        }
    }

    /// What the journal adds up to.
    #[must_use]
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    /// What the mission is doing.
    #[must_use]
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Whether nothing is left to do.
    #[must_use]
    pub fn is_over(&self) -> bool {
        self.state == State::Over
    }

    /// Whether the planner may leave without leaving a vehicle in the air.
    #[must_use]
    pub fn on_ground(&self) -> bool {
        self.vehicle.is_none_or(|vehicle| vehicle.landed == 1 && vehicle.armed == 0)
    }

    /// Forgets what was in flight, as after a restart: everything sent before now is void.
    pub fn rejoin(&mut self) {
        self.pending = None;
        self.round_sent = None;
        self.score_sent = None;
        if matches!(self.state, State::Flying(_) | State::Capturing(..) | State::Looking(..)) {
            self.state = State::Deciding;
        }
    }

    /// Takes no more views: the journal could not be written for too long, and px4-link has begun to bring the vehicle home.
    pub fn come_home(&mut self) {
        self.rejoin();
        self.end(EndReason::ServiceFailed);
    }

    /// One turn at mission time `now_ns`.
    pub fn step(&mut self, now_ns: u64, inputs: Inputs, views: &mut dyn Views) -> Outputs {
        self.now_ns = now_ns;
        if let Some(vehicle) = inputs.vehicle {
            self.heard(vehicle);
        }
        for view in &inputs.depths {
            self.saw(view);
        }
        for (id, reply) in &inputs.command_replies {
            self.command_answered(*id, reply);
        }
        for (token, command) in &inputs.commands {
            let answer = self.told(*command);
            self.out.effects.push(Effect::Answer(*token, answer));
        }
        self.check_ends();
        self.rounds_turn(&inputs);
        // A turn may pass several states: a capture answered leads on to the next path at once.
        for _ in 0..8 {
            let before = core::mem::replace(&mut self.state, State::Deciding);
            let after = self.turn(before.clone(), &inputs, views);
            let settled = after == before;
            self.state = after;
            if settled {
                break;
            }
            self.rounds_turn(&Inputs::default());
        }
        self.report(views);
        core::mem::take(&mut self.out)
    }

    /// The transition.
    fn turn(&mut self, state: State, inputs: &Inputs, views: &mut dyn Views) -> State {
        match state {
            State::Idle => self.idle(),
            State::Preparing => self.preparing(),
            State::Launching => self.launching(),
            State::Deciding => self.deciding(views),
            State::Flying(flight) => self.flying(flight),
            State::Capturing(flight, request, deadline_ns) => {
                self.capturing(flight, request, deadline_ns, inputs, views)
            }
            State::Looking(step, since_ns) => self.looking(step, since_ns, inputs),
            State::Homing => self.homing(),
            State::Landing => self.landing(),
            State::Suspended(hold) => self.suspended(hold),
            State::GoingOn => self.going_on(),
            State::Finishing => self.finishing(views),
            State::Over => State::Over,
        }
    }

    fn record(&mut self, record: Record) -> u64 {
        let entry = Entry { id: self.ledger.entries + 1, now_ns: self.now_ns, record };
        self.ledger.apply(&entry);
        let id = entry.id;
        self.out.entries.push(entry);
        id
    }

    /// Whether no more views are taken and the vehicle is on its way down: the mission ends, or is recalled.
    fn homeward(&self) -> bool {
        self.ledger.ending.is_some() || self.recalled
    }

    fn end(&mut self, reason: EndReason) {
        // A recalled vehicle comes home anyway, and what keeps it from more views now need not do so after `resume`.
        if self.ledger.ending.is_none() && !self.recalled {
            tracing::info!(reason = %reason, "the mission ends");
            self.record(Record::Ending { reason, land_here: false });
            if let Some(id) = self.score_sent.take() {
                self.out.effects.push(Effect::ScoreOver(id));
            }
        }
    }

    fn told(&mut self, command: MissionCommand) -> Result<(), String> {
        let running = self.ledger.started_ns.is_some() && self.ledger.over.is_none();
        match command {
            MissionCommand::Start if self.ledger.started_ns.is_none() => {
                self.start();
                Ok(())
            }
            MissionCommand::Start => Err("the mission of this folder has begun already".to_owned()),
            MissionCommand::Stop | MissionCommand::Land | MissionCommand::Abort | MissionCommand::Recall
                if self.ledger.started_ns.is_none() =>
            {
                // Nothing has begun and nothing is recorded: the next life of this folder's planner may begin it.
                tracing::info!(%command, "told to end before the mission began");
                self.cancelled = true;
                self.state = State::Over;
                Ok(())
            }
            _ if !running => Err(format!("no mission is running: {command} has no meaning")),
            MissionCommand::Recall => {
                self.recall();
                Ok(())
            }
            MissionCommand::Stop => {
                self.recalled = false;
                self.end(EndReason::Operator);
                if matches!(self.state, State::Suspended(_)) && self.commanded_by_us() {
                    self.state = State::Deciding;
                }
                Ok(())
            }
            MissionCommand::Land => {
                self.recalled = false;
                let land_here = self.may_land_here();
                self.record(Record::Ending { reason: EndReason::Operator, land_here });
                // A pilot who flies may land it, or give it back and be followed by `go-on`.
                self.state = match self.state {
                    _ if self.on_ground() => State::Finishing,
                    State::Suspended(_) if !self.commanded_by_us() => State::Suspended(false),
                    _ if land_here => State::Landing,
                    _ => State::Deciding,
                };
                Ok(())
            }
            MissionCommand::Abort => {
                if self.on_ground() {
                    self.end(EndReason::Operator);
                    self.state = State::Finishing;
                } else {
                    self.record(Record::Suspended);
                    self.state = State::Suspended(true);
                }
                Ok(())
            }
            MissionCommand::GoOn if matches!(self.state, State::Suspended(_)) => {
                self.record(Record::GoOn);
                self.state = State::GoingOn;
                Ok(())
            }
            MissionCommand::GoOn => Err("the mission is not suspended".to_owned()),
        }
    }

    /// The process is to end with the vehicle in the air: comes home and leaves the mission open, for a next process that goes
    /// on with it at once. Told otherwise before, it does that.
    pub fn step_down(&mut self) {
        if self.ledger.started_ns.is_some() && self.ledger.over.is_none() && !self.homeward() {
            self.stepping_down = true;
            self.recall();
        }
    }

    fn recall(&mut self) {
        tracing::info!("recalled: returning and landing; the mission stays open");
        self.recalled = true;
        if self.ledger.suspended && self.commanded_by_us() {
            // What the operator had held goes home too; held in the journal, it would not go on after that.
            self.record(Record::GoOn);
            self.state = State::Deciding;
        }
    }

    fn start(&mut self) {
        self.cancelled = false;
        let (mission_id, seed) = (self.setup.mission_id.clone(), self.setup.seed);
        self.record(Record::Started { mission_id, seed });
        self.state = State::Preparing;
    }

    fn idle(&mut self) -> State {
        if self.setup.planner.autostart {
            self.start();
            return State::Preparing;
        }
        State::Idle
    }

    /// Sees that a command is carried out: issues it, and gives its answer once. A refused command rests for 2 s.
    fn ensure(&mut self, command: VehicleCommand, altitude_m: f64) -> Option<Result<(), String>> {
        self.ensure_request(CommandRequest { command: command.code(), altitude_m, ..CommandRequest::default() })
    }

    fn ensure_request(&mut self, request: CommandRequest) -> Option<Result<(), String>> {
        let command = VehicleCommand::from_code(request.command)?;
        if let Some(pending) = &mut self.pending {
            if pending.command == command {
                // A pilot who is to arm takes the time he needs.
                let waits_for_pilot = command == VehicleCommand::Arm && pending.accepted;
                let overdue = self.now_ns > pending.since_ns + ns_from_s(self.setup.planner.command_deadline_s);
                let (id, late) = (pending.id, overdue && !waits_for_pilot);
                let answer = pending.answer.take().or_else(|| late.then(|| Err("no answer in time".to_owned())));
                let answer = answer?;
                self.pending = None;
                self.out.effects.push(Effect::CommandOver(id));
                if let Err(why) = &answer {
                    tracing::warn!(command = %command, why, "the vehicle refused");
                    self.refusals += 1;
                    self.retry_ns = self.now_ns + 2_000_000_000;
                } else {
                    self.refusals = 0;
                }
                return Some(answer);
            }
            let id = pending.id;
            self.pending = None;
            self.out.effects.push(Effect::CommandOver(id));
        }
        if self.now_ns >= self.retry_ns {
            let id = self.record(Record::Command { command, altitude_m: request.altitude_m });
            self.pending = Some(Pending { id, command, since_ns: self.now_ns, accepted: false, answer: None });
            self.out.effects.push(Effect::Command(id, request));
        }
        None
    }

    fn command_answered(&mut self, id: u64, reply: &CommandReply) {
        let Some(pending) = self.pending.as_mut().filter(|pending| pending.id == id) else { return };
        match CommandStatus::from_code(reply.status) {
            Some(CommandStatus::Confirmed) => pending.answer = Some(Ok(())),
            Some(CommandStatus::Refused) => pending.answer = Some(Err(unpack_text(&reply.reason))),
            Some(CommandStatus::Restarted) => {
                // px4-link has lived anew: the state is looked at, and a new id asked with where it is still wanted.
                self.pending = None;
                self.out.effects.push(Effect::CommandOver(id));
            }
            Some(CommandStatus::Accepted) => pending.accepted = true,
            None => {}
        }
    }

    fn survey_m(&self) -> DVec3 {
        DVec3::from_array(self.ledger.survey_m.unwrap_or(self.setup.planner.survey_point_m))
    }

    /// Sees that the terrain is known, as far as the journal knows it.
    fn ensure_terrain(&mut self) {
        let Some((_, home_m)) = self.ledger.airborne else { return };
        let placed = self.is_placed();
        // In a world that is not yet found again nothing is where it was: neither the object nor where this began.
        let home_m = match self.vehicle.filter(|vehicle| vehicle.ready == 1) {
            _ if placed => home_m,
            Some(vehicle) => vehicle.home_m,
            None => return,
        };
        // And when it moves, everything moves.
        let stays = |terrain: &Terrain| placed || terrain.home_m.distance(DVec3::from_array(home_m)) < SAME_HOME_M;
        if self.terrain.as_ref().is_some_and(stays) {
            return;
        }
        let config = &self.setup.planner;
        let (survey_m, home_m) = (self.survey_m(), DVec3::from_array(home_m));
        let volume = Volume::of_mission(survey_m, home_m, config);
        let (space, candidates) = match self.ledger.prior.as_ref().filter(|_| placed) {
            None => (FreeSpace::around_survey(survey_m, volume, config), Candidates::default()),
            Some((prior, limits)) => {
                let space = FreeSpace::around_prior(prior, volume, self.mount.least_drop_m(), config);
                let limits = crate::logic::candidates::PitchLimits { min_rad: limits[0], max_rad: limits[1] };
                let candidates = crate::logic::candidates::generate(prior, &space, &self.mount, limits, config);
                (space, candidates)
            }
        };
        let roadmap = Roadmap::new(&space);
        self.terrain = Some(Terrain { survey_m, home_m, space, roadmap, candidates });
    }

    /// The terrain anew after the prior or the survey point changed; what was seen is kept where the volume is the same.
    fn renew_terrain(&mut self) {
        let seen = self.terrain.take().map(|old| (old.space.volume, old.space.occupancy));
        self.ensure_terrain();
        if let (Some(terrain), Some((volume, occupancy))) = (&mut self.terrain, seen)
            && terrain.space.volume == volume
        {
            terrain.space.occupancy = occupancy;
        }
    }

    /// Counts a keyframe in `paper_coverage`, once.
    fn count_coverage(&mut self, views: &mut dyn Views) {
        let Some((prior, _)) = &self.ledger.prior else { return };
        for taken in &self.ledger.taken {
            let id = taken.shot.keyframe_id;
            if !self.counted.contains(&id)
                && let Some((view, _)) = views.read(KeyframeReason::Selected, id)
            {
                self.coverage.add(&view, prior, self.setup.planner.coverage_points);
                self.counted.insert(id);
            }
        }
    }
}
