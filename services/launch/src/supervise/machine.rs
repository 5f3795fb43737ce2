//! The supervisor's decisions: a pure state machine. Events and wall time in, actions out.
//!
//! Phases: *Starting* (keeper first, then the rest) -> *Flying* (the dead are started again with a back-off) ->
//! *Returning* (the first Ctrl-C, or a service that cannot be kept alive: the mission is told to return, land and save)
//! -> *Stopping* (group by group) -> *Over*. A second Ctrl-C kills at once. Before the motors ever ran there is nothing to
//! bring home: then the first Ctrl-C, and a service that cannot be kept alive, go to *Stopping* directly. Who hangs is
//! killed and so mended like the dead ([`watch`]).

mod watch;
mod words;

use std::collections::BTreeMap;

use shared_types::ServiceName;

use watch::Life;
pub use words::{Action, Event, Outcome, Policy};

use super::plan::{DISPENSABLE, START_ORDER, STOP_GROUPS};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Member {
    NotStarted,
    Running,
    Waiting {
        until_ms: u64,
    },
    /// Dead, and left as it is for a debugger.
    Held,
    Gone,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Phase {
    Starting {
        since_ms: u64,
    },
    Flying,
    /// `recalled`: by ourselves, with the mission left open; else by the user, and the mission ends.
    Returning {
        since_ms: u64,
        recalled: bool,
    },
    Stopping {
        group: usize,
        since_ms: u64,
        killed: bool,
    },
    Over,
}

#[derive(Debug, Clone)]
struct Record {
    member: Member,
    deaths_ms: Vec<u64>,
    restarts: u32,
    heard: bool,
    life: Life,
}

/// The state machine.
#[derive(Debug, Clone)]
pub struct Supervisor {
    policy: Policy,
    phase: Phase,
    outcome: Option<Outcome>,
    members: BTreeMap<ServiceName, Record>,
    services: Vec<ServiceName>,
    /// How often the user asked to end.
    interrupts: u32,
    armed: bool,
    ever_armed: bool,
    /// When the last event came.
    stepped_ms: u64,
}

impl Supervisor {
    /// A supervisor of these services; they are started in the order of [`START_ORDER`].
    #[must_use]
    pub fn new(policy: Policy, services: &[ServiceName]) -> Self {
        let services: Vec<ServiceName> = START_ORDER.into_iter().filter(|service| services.contains(service)).collect();
        let record = Record {
            member: Member::NotStarted,
            deaths_ms: Vec::new(),
            restarts: 0,
            heard: false,
            life: Life::default(),
        };
        let members = services.iter().map(|service| (*service, record.clone())).collect();
        Self {
            policy,
            phase: Phase::Starting { since_ms: 0 },
            outcome: None,
            members,
            services,
            interrupts: 0,
            armed: false,
            ever_armed: false,
            stepped_ms: 0,
        }
    }

    /// How often each service was started again; services that never were are left out.
    #[must_use]
    pub fn restarts(&self) -> BTreeMap<ServiceName, u32> {
        self.members.iter().filter(|(_, r)| r.restarts > 0).map(|(service, r)| (*service, r.restarts)).collect()
    }

    /// Whether the run is being ended.
    #[must_use]
    pub fn is_ending(&self) -> bool {
        !matches!(self.phase, Phase::Starting { .. } | Phase::Flying)
    }

    /// One event at a time of the wall's monotonic clock, milliseconds.
    pub fn step(&mut self, now_ms: u64, event: &Event) -> Vec<Action> {
        let mut actions = Vec::new();
        self.forgive_a_gap(now_ms);
        match event {
            Event::Begin => self.begin(now_ms, &mut actions),
            Event::Tick => {}
            Event::Heard(service) => self.heard(now_ms, *service, &mut actions),
            Event::Debugged(service) => self.debugged(now_ms, *service),
            Event::Stalled(service, for_ms) => self.stalled(*service, *for_ms, &mut actions),
            Event::Exited { service, code } => self.exited(now_ms, *service, *code, &mut actions),
            Event::Interrupt => self.interrupt(now_ms, &mut actions),
            Event::MissionOver { usable } => {
                if matches!(self.phase, Phase::Starting { .. } | Phase::Flying | Phase::Returning { .. }) {
                    self.outcome.get_or_insert(if *usable { Outcome::Done } else { Outcome::Failed });
                    self.stop_group(now_ms, 0, false, &mut actions);
                }
            }
            Event::Armed => (self.armed, self.ever_armed) = (true, true),
            Event::Disarmed => {
                self.armed = false;
                // Without a planner nobody reports the mission's end: the vehicle on the ground is the end.
                let planner_gone = self.member(ServiceName::Planner).is_none_or(|member| member == Member::Gone);
                if matches!(self.phase, Phase::Returning { .. }) && planner_gone {
                    self.stop_group(now_ms, 0, false, &mut actions);
                }
            }
        }
        self.time_passes(now_ms, &mut actions);
        actions
    }

    fn member(&self, service: ServiceName) -> Option<Member> {
        self.members.get(&service).map(|record| record.member)
    }

    fn begin(&mut self, now_ms: u64, actions: &mut Vec<Action>) {
        self.phase = Phase::Starting { since_ms: now_ms };
        match self.services.first().copied() {
            Some(first) => self.start(now_ms, first, actions),
            None => self.finish(actions),
        }
    }

    fn start(&mut self, now_ms: u64, service: ServiceName, actions: &mut Vec<Action>) {
        if let Some(record) = self.members.get_mut(&service) {
            record.member = Member::Running;
            record.life = Life::born(now_ms);
            actions.push(Action::Start(service));
        }
    }

    fn start_the_rest(&mut self, now_ms: u64, actions: &mut Vec<Action>) {
        self.phase = Phase::Flying;
        for service in self.services.clone() {
            if self.member(service) == Some(Member::NotStarted) {
                self.start(now_ms, service, actions);
            }
        }
    }

    fn heard(&mut self, now_ms: u64, service: ServiceName, actions: &mut Vec<Action>) {
        if let Some(record) = self.members.get_mut(&service) {
            record.heard = true;
            record.life.heard(now_ms);
        }
        if matches!(self.phase, Phase::Starting { .. }) && self.services.first() == Some(&service) {
            self.start_the_rest(now_ms, actions);
        }
    }

    fn exited(&mut self, now_ms: u64, service: ServiceName, code: Option<i32>, actions: &mut Vec<Action>) {
        let limit = self.policy.crash_limit;
        let window = self.policy.crash_window_ms;
        let ending = matches!(self.phase, Phase::Stopping { .. } | Phase::Over);
        let Some(record) = self.members.get_mut(&service) else { return };
        if ending {
            record.member = Member::Gone;
            return;
        }
        record.deaths_ms.retain(|death| death + window > now_ms);
        record.deaths_ms.push(now_ms);
        let (deaths, heard) = (record.deaths_ms.len(), record.heard);
        // Bad configuration or something missing: the same start would fail the same way. A planner whose journal finds no
        // room leaves so once the vehicle stands.
        let in_use = heard && if service == ServiceName::Planner { self.armed } else { self.ever_armed };
        let refuses = !in_use && matches!(code, Some(64 | 69));
        // The simulator is the vehicle itself: a new one would stand on the ground at time zero.
        let vehicle_lost = service == ServiceName::Simulator && heard && !refuses;
        if refuses || vehicle_lost {
            record.member = Member::Gone;
            self.outcome.get_or_insert(Outcome::Broken { service, code, worked: heard && !refuses });
            self.stop_group(now_ms, 0, vehicle_lost, actions);
        } else if self.policy.hold_on_fault {
            record.member = Member::Held;
            actions.push(Action::Say(format!(
                "{service} died and is left as it is (launch.hold_on_fault); start it again by hand with \
                 `vantage {service} --system NAME`, or end with Ctrl-C"
            )));
        } else if deaths > limit && DISPENSABLE.contains(&service) {
            record.member = Member::Gone;
            actions
                .push(Action::Say(format!("{service} died {deaths} times in a row: the mission goes on without it")));
        } else if deaths > limit {
            record.member = Member::Gone;
            self.outcome.get_or_insert(Outcome::Broken { service, code, worked: heard });
            if self.ever_armed {
                actions.push(Action::Say(format!("{service} died {deaths} times in a row: returning and landing")));
                self.return_home(now_ms, true, actions);
            } else {
                // Nothing is in the air: nobody need wait for a landing.
                actions.push(Action::Say(format!("{service} died {deaths} times in a row: stopping")));
                self.stop_group(now_ms, 0, false, actions);
            }
        } else {
            let doublings = u32::try_from(deaths - 1).unwrap_or(u32::MAX).min(20);
            let delay = (self.policy.restart_delay_ms << doublings).min(self.policy.restart_delay_max_ms);
            record.member = Member::Waiting { until_ms: now_ms + delay };
        }
    }

    fn return_home(&mut self, now_ms: u64, recalled: bool, actions: &mut Vec<Action>) {
        if matches!(self.phase, Phase::Starting { .. } | Phase::Flying) {
            self.phase = Phase::Returning { since_ms: now_ms, recalled };
            actions.push(if recalled { Action::CommandRecall } else { Action::CommandStop });
        }
    }

    /// The user's first Ctrl-C ends the run in order, or says that it is being ended already; the second stops at once.
    fn interrupt(&mut self, now_ms: u64, actions: &mut Vec<Action>) {
        if self.phase == Phase::Over {
            return;
        }
        self.interrupts += 1;
        let again = if self.armed {
            "Ctrl-C again holds the vehicle in place and stops at once"
        } else {
            "Ctrl-C again stops at once"
        };
        let say = |text: &str| Action::Say(format!("{text}; {again}"));
        match self.phase {
            _ if self.interrupts > 1 => self.stop_at_once(now_ms, actions),
            Phase::Starting { .. } | Phase::Flying if !self.ever_armed => {
                self.outcome.get_or_insert(Outcome::Failed);
                actions.push(say("stopping"));
                self.stop_group(now_ms, 0, false, actions);
            }
            Phase::Starting { .. } | Phase::Flying => {
                actions.push(say("returning, landing and saving"));
                self.return_home(now_ms, false, actions);
            }
            Phase::Returning { .. } => actions.push(say("the vehicle is returning and landing already")),
            Phase::Stopping { .. } => actions.push(say("the services are being stopped already")),
            Phase::Over => {}
        }
    }

    /// Holds a vehicle in the air, and kills everybody.
    fn stop_at_once(&mut self, now_ms: u64, actions: &mut Vec<Action>) {
        if self.armed {
            self.outcome = Some(Outcome::Aborted);
            actions.push(Action::Say("holding the vehicle where it is and stopping at once".to_owned()));
            actions.push(Action::VehicleHold);
        } else {
            // On the ground the mission is worth what it was worth before.
            self.outcome.get_or_insert(Outcome::Aborted);
            actions.push(Action::Say("stopping at once".to_owned()));
        }
        self.stop_group(now_ms, 0, true, actions);
    }

    /// Stops the groups from `group` on: asks the first that still has processes (kills all of them where `at_once`).
    fn stop_group(&mut self, now_ms: u64, group: usize, at_once: bool, actions: &mut Vec<Action>) {
        let mut group = group;
        if at_once {
            for service in self.running(&STOP_GROUPS.concat()) {
                actions.push(Action::Kill(service));
            }
            self.settle_waiting();
            self.phase = Phase::Stopping { group: STOP_GROUPS.len() - 1, since_ms: now_ms, killed: true };
            return;
        }
        self.settle_waiting();
        while let Some(services) = STOP_GROUPS.get(group) {
            let running = self.running(services);
            if !running.is_empty() {
                actions.extend(running.into_iter().map(Action::Ask));
                self.phase = Phase::Stopping { group, since_ms: now_ms, killed: false };
                return;
            }
            group += 1;
        }
        self.finish(actions);
    }

    /// Whoever waits for a restart is not started again.
    fn settle_waiting(&mut self) {
        for record in self.members.values_mut() {
            if record.member != Member::Running {
                record.member = Member::Gone;
            }
        }
    }

    fn running(&self, services: &[ServiceName]) -> Vec<ServiceName> {
        services.iter().copied().filter(|service| self.member(*service) == Some(Member::Running)).collect()
    }

    fn finish(&mut self, actions: &mut Vec<Action>) {
        self.phase = Phase::Over;
        actions.push(Action::Finish(self.outcome.clone().unwrap_or(Outcome::Failed)));
    }

    fn time_passes(&mut self, now_ms: u64, actions: &mut Vec<Action>) {
        if !matches!(self.phase, Phase::Stopping { .. } | Phase::Over) {
            for service in self.services.clone() {
                let Some(record) = self.members.get_mut(&service) else { continue };
                if matches!(record.member, Member::Waiting { until_ms } if now_ms >= until_ms) {
                    record.restarts += 1;
                    self.start(now_ms, service, actions);
                    if service == ServiceName::Planner && matches!(self.phase, Phase::Returning { recalled: true, .. })
                    {
                        // A recall is in no journal: a planner that was started anew does not know of it.
                        actions.push(Action::CommandRecall);
                    }
                }
            }
        }
        self.watch(now_ms, actions);
        match self.phase {
            Phase::Starting { since_ms } if now_ms >= since_ms + self.policy.keeper_timeout_ms => {
                self.start_the_rest(now_ms, actions);
            }
            Phase::Returning { since_ms, .. } if now_ms >= since_ms + self.policy.landing_timeout_ms => {
                self.outcome.get_or_insert(Outcome::NotLanded);
                actions.push(Action::Say(
                    "the vehicle has not landed in time: stopping; px4-link brings it home".to_owned(),
                ));
                self.stop_group(now_ms, 0, false, actions);
            }
            Phase::Stopping { group, since_ms, killed } => {
                let services: Vec<ServiceName> = match STOP_GROUPS.get(group) {
                    Some(_) if killed && group + 1 == STOP_GROUPS.len() => STOP_GROUPS.concat(),
                    Some(services) => services.to_vec(),
                    None => Vec::new(),
                };
                let running = self.running(&services);
                // With the vehicle in the air, px4-link's stop is a flight home.
                let patience = if services == [ServiceName::Px4Link] {
                    self.policy.landing_timeout_ms.max(self.policy.stop_timeout_ms)
                } else {
                    self.policy.stop_timeout_ms
                };
                if running.is_empty() {
                    self.stop_group(now_ms, group + 1, false, actions);
                } else if !killed && now_ms >= since_ms + patience {
                    for service in running {
                        actions.push(Action::Say(format!("{service} did not stop in time and is killed")));
                        actions.push(Action::Kill(service));
                    }
                    self.phase = Phase::Stopping { group, since_ms: now_ms, killed: true };
                }
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests;
