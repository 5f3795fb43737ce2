//! The loop of a supervised run.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use shared_types::ServiceName;
use shared_types::config::{ClockMode, Config};
use shared_types::messages::{Commander, EndReason, MissionCommand, MissionPhase, MissionState, VehicleCommand};
use shared_types::system::System;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

use super::children::{Children, Starter};
use super::machine::{Action, Event, Outcome, Policy, Supervisor};
use super::memory::Memory;
use super::plan::START_ORDER;
use super::ports::Ports;
use super::track::Track;
use crate::proc;
use crate::progress::{Progress, Report};

const TURN: Duration = Duration::from_millis(20);
/// Time that the vehicle gets to take the order to hold before everything is killed.
const HOLD_GRACE: Duration = Duration::from_millis(300);

/// What was seen of a run.
#[derive(Debug, Clone)]
pub struct Flight {
    /// How it ended.
    pub outcome: Outcome,
    /// The mission's last state; `None` when it never spoke.
    pub last: Option<MissionState>,
    /// Mission time from start to end, seconds; `None` when it never began.
    pub mission_s: Option<f64>,
    /// Wall time of the run, seconds.
    pub wall_s: f64,
    /// How often services were started again.
    pub restarts: BTreeMap<ServiceName, u32>,
    /// Whether the run repeats bit for bit; `None` before the clock began.
    pub deterministic: Option<bool>,
    /// Memory in flight.
    pub memory: Memory,
    /// Processor time of each scoring for a candidate, milliseconds.
    pub score_ms: Vec<f64>,
    /// For a broken run: what the service said last.
    pub last_words: Option<String>,
}

fn policy(config: &Config) -> Policy {
    let ms = |seconds: f64| shared_types::ns_from_s(seconds) / 1_000_000;
    Policy {
        restart_delay_ms: ms(config.launch.restart_delay_s),
        restart_delay_max_ms: ms(config.launch.restart_delay_max_s),
        crash_limit: config.launch.crash_limit as usize,
        crash_window_ms: ms(config.launch.crash_window_s),
        stop_timeout_ms: ms(config.launch.stop_timeout_s),
        landing_timeout_ms: ms(config.launch.landing_timeout_s),
        keeper_timeout_ms: 3_000,
        silence_ms: ms(config.launch.watchdog_s),
        start_ms: ms(config.launch.watchdog_start_s),
        stall_ms: ms(config.launch.watchdog_work_s),
        hold_on_fault: config.launch.hold_on_fault,
    }
}

/// The services of a mission: without a simulated vehicle, neither simulator nor world are started; the recorder where it is
/// asked for.
#[must_use]
pub fn services_of(config: &Config) -> Vec<ServiceName> {
    let simulated = config.link.is_local();
    START_ORDER
        .into_iter()
        .filter(|service| match service {
            ServiceName::Simulator | ServiceName::World => simulated,
            ServiceName::Recorder => config.recorder.enabled,
            _ => true,
        })
        .collect()
}

/// Starts the services of a mission and keeps them alive until it is over.
///
/// # Errors
/// When the system cannot be joined or a process cannot be started at all.
pub fn run(system: &System, config: &Config, starter: Starter, progress: &mut Progress) -> anyhow::Result<Flight> {
    let mut signals = Signals::new([SIGINT, SIGTERM, SIGHUP]).context("cannot install signal handlers")?;
    let mut run = Run {
        supervisor: Supervisor::new(policy(config), &services_of(config)),
        children: Children::new(starter),
        ports: Ports::open(system, config)?,
        progress,
        began: Instant::now(),
        memory: Memory::default(),
        sampled: Instant::now(),
        last: None,
        ended_ns: 0,
        outcome: None,
        last_words: None,
        armed: false,
        commander: 0,
        suspended: false,
        lacking: BTreeMap::new(),
        track: Track::default(),
        score_ms: Vec::new(),
        at_the_end: None,
    };
    run.event(&Event::Begin);
    while run.outcome.is_none() {
        for signal in signals.pending() {
            tracing::info!(signal, "asked to end");
            run.event(&Event::Interrupt);
        }
        run.turn(config)?;
        std::thread::sleep(TURN);
    }
    if let Err(error) = run.track.append(&Path::new(&config.mission.folder).join("report")) {
        tracing::warn!(%error, "the track could not be written; clearance will not be measured");
    }
    let flight = run.into_flight(config);
    let_signals_end_this_process().context("cannot give the signals back")?;
    Ok(flight)
}

/// After the flight, a signal ends this process as any other: what is left to do on the ground (measuring the model) may
/// take minutes, and `vantage evaluate` does it again. Dropping the handlers alone would leave the signals ignored.
fn let_signals_end_this_process() -> std::io::Result<()> {
    let always = Arc::new(AtomicBool::new(true));
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        signal_hook::flag::register_conditional_default(signal, Arc::clone(&always))?;
    }
    Ok(())
}

struct Run<'a> {
    supervisor: Supervisor,
    children: Children,
    ports: Ports,
    progress: &'a mut Progress,
    began: Instant,
    memory: Memory,
    sampled: Instant,
    last: Option<MissionState>,
    ended_ns: u64,
    outcome: Option<Outcome>,
    last_words: Option<String>,
    armed: bool,
    /// [`Commander`] code of the vehicle's last state.
    commander: u32,
    /// The mission waits for the operator, and the user was told.
    suspended: bool,
    /// What each service said that it lacks; empty where nothing.
    lacking: BTreeMap<ServiceName, String>,
    track: Track,
    score_ms: Vec<f64>,
    /// Whether the clock's run repeats, and restarts, when the mission was over: what happens while everybody leaves is not its
    /// doing.
    at_the_end: Option<(Option<bool>, BTreeMap<ServiceName, u32>)>,
}

impl Run<'_> {
    fn turn(&mut self, config: &Config) -> anyhow::Result<()> {
        let heard = self.ports.receive()?;
        for word in heard.services {
            self.tell_what_lacks(word.service, word.lacks);
            self.event(&Event::Heard(word.service));
            if word.stalled_ms > 0 {
                self.event(&Event::Stalled(word.service, word.stalled_ms));
            }
        }
        for (stamp_ns, state) in heard.missions {
            self.mission(stamp_ns, &state);
        }
        self.score_ms.extend(heard.score_ms);
        for truth in &heard.truths {
            self.track.note(truth);
        }
        if let Some(vehicle) = heard.vehicle {
            self.commander = vehicle.commander;
            let armed = vehicle.armed == 1;
            if armed != self.armed {
                self.armed = armed;
                self.children.set_in_the_air(armed);
                self.event(if armed { &Event::Armed } else { &Event::Disarmed });
            }
        }
        for (service, code, how) in self.children.reap() {
            if !self.supervisor.is_ending() || code != Some(0) {
                // What keeps a service waiting is why it ends; on a full disk, its log does not tell.
                let lacked = self.lacking.get(&service).filter(|lacks| !lacks.is_empty()).cloned();
                let words = lacked.or_else(|| self.children.last_words(service)).unwrap_or_default();
                tracing::info!(%service, %how, %words, "a service ended");
                if !self.supervisor.is_ending() {
                    self.progress
                        .say(&format!("{service} ended ({how}); see {}", self.children.log_path(service).display()));
                    // Of those that are told to end because of it, nobody asks.
                    if !words.is_empty() {
                        self.last_words = Some(words);
                    }
                }
            }
            self.event(&Event::Exited { service, code });
        }
        self.event(&Event::Tick);
        let period = config.launch.memory_period_s;
        if period > 0.0 && self.sampled.elapsed().as_secs_f64() >= period && !self.supervisor.is_ending() {
            self.sampled = Instant::now();
            let sizes: Vec<_> = self
                .children
                .pids()
                .into_iter()
                .filter_map(|(service, pid)| Some((service, proc::pss_bytes(pid)?)))
                .collect();
            self.memory.sample(&sizes);
        }
        Ok(())
    }

    /// Tells the user, in flight, what a service waits for, and that it waits no more. What only counts up is told once.
    fn tell_what_lacks(&mut self, service: ServiceName, lacks: String) {
        let known = self.lacking.insert(service, lacks.clone()).unwrap_or_default();
        let words = |text: &str| text.replace(|c: char| c.is_ascii_digit(), "");
        if self.armed && words(&known) != words(&lacks) {
            let text = if lacks.is_empty() { "goes on" } else { &lacks };
            self.progress.say(&format!("{service}: {text}"));
        }
    }

    /// A mission that waits for the operator would wait for ever if he did not know.
    fn tell_who_is_waited_for(&mut self, suspended: bool) {
        if core::mem::replace(&mut self.suspended, suspended) == suspended || !suspended {
            return;
        }
        let who = match Commander::from_code(self.commander) {
            Some(Commander::Pilot) => "a pilot flies",
            Some(Commander::Failsafe) => "a failsafe of the autopilot flies",
            _ => "the vehicle holds",
        };
        self.progress
            .say(&format!("{who} and the mission waits; `vantage go-on` when it may fly on, `vantage stop` to end"));
    }

    fn mission(&mut self, stamp_ns: u64, state: &MissionState) {
        self.last = Some(*state);
        self.ended_ns = stamp_ns.max(self.ended_ns);
        let Some(report) = Report::of(state, stamp_ns) else { return };
        self.progress.show(&report);
        if matches!(report.phase, MissionPhase::Done | MissionPhase::Failed) && self.at_the_end.is_none() {
            self.at_the_end = Some((self.ports.repeats(), self.supervisor.restarts()));
        }
        self.tell_who_is_waited_for(report.phase == MissionPhase::Suspended);
        match report.phase {
            MissionPhase::Done => self.event(&Event::MissionOver { usable: true }),
            MissionPhase::Failed => self.event(&Event::MissionOver { usable: false }),
            _ => {}
        }
    }

    /// Takes an event to the state machine, and does what it says.
    fn event(&mut self, event: &Event) {
        let now_ms = u64::try_from(self.began.elapsed().as_millis()).unwrap_or(u64::MAX);
        for action in self.supervisor.step(now_ms, event) {
            match action {
                Action::Start(service) => {
                    if let Err(error) = self.children.start(service) {
                        self.progress.say(&format!("cannot start {service}: {error}"));
                        self.event(&Event::Exited { service, code: Some(69) });
                    }
                }
                Action::Ask(service) => self.children.ask(service),
                Action::Kill(service) => self.children.kill(service),
                Action::Examine { service, kill } => self.examine(service, kill),
                Action::CommandStop => warn_if_lost(self.ports.command_mission(MissionCommand::Stop)),
                Action::CommandRecall => warn_if_lost(self.ports.command_mission(MissionCommand::Recall)),
                Action::VehicleHold => {
                    warn_if_lost(self.ports.command_vehicle(VehicleCommand::Hold));
                    std::thread::sleep(HOLD_GRACE);
                }
                Action::Say(text) => self.progress.say(&text),
                Action::Finish(outcome) => self.outcome = Some(outcome),
            }
        }
    }

    fn examine(&mut self, service: ServiceName, kill: bool) {
        let Some(pid) = self.children.pid(service) else { return };
        if proc::tracer(pid).is_some() {
            self.progress.say(&format!("a debugger holds {service} (pid {pid}): waiting for it"));
            self.event(&Event::Debugged(service));
        } else {
            let report = self.children.examine(service, kill);
            self.progress.say(&format!("what {service} (pid {pid}) was doing: {}", report.display()));
        }
    }

    fn into_flight(self, config: &Config) -> Flight {
        let lockstep = config.clock.mode == ClockMode::Lockstep;
        let (repeats, restarts) = self.at_the_end.unwrap_or_else(|| (self.ports.repeats(), self.supervisor.restarts()));
        // Sums on a GPU come out in no order unless they are asked for one.
        let unordered = trainer::backend::Record::read(&Path::new(&config.mission.folder).join("model")).unordered;
        let deterministic =
            if lockstep { repeats.map(|repeats| repeats && restarts.is_empty() && !unordered) } else { Some(false) };
        let mission_s =
            self.last.as_ref().map(|state| shared_types::s_from_ns(self.ended_ns.saturating_sub(state.started_ns)));
        Flight {
            outcome: self.outcome.unwrap_or(Outcome::Failed),
            last: self.last,
            mission_s,
            wall_s: self.began.elapsed().as_secs_f64(),
            restarts,
            deterministic,
            memory: self.memory,
            score_ms: self.score_ms,
            last_words: self.last_words,
        }
    }
}

fn warn_if_lost(sent: Result<(), shared_types::bus::BusError>) {
    if let Err(error) = sent {
        tracing::warn!(%error, "a command could not be sent at once; it is sent again");
    }
}

/// The end reason of a state, if it names one.
#[must_use]
pub fn end_reason(state: &MissionState) -> Option<EndReason> {
    EndReason::from_code(state.end_reason).filter(|reason| *reason != EndReason::None)
}
