//! The simulator as a service: the vehicle, its sockets and the clock together, in lockstep or on the wall's clock.

use std::collections::VecDeque;
use std::os::fd::{AsFd as _, BorrowedFd};
use std::time::{Duration, Instant};

use shared_types::config::{CameraConfig, ClockMode, Config};
use shared_types::messages::ServiceState;
use shared_types::service::{Context, HealthReport, Service, ServiceError, ServiceName, Step, StopAnswer};

use crate::clock::{Lockstep, Phase};
use crate::estimator::EstimatorModel;
use crate::ports::Ports;
use crate::simulator::{LinkId, Simulator};
use crate::state::State;
use crate::udp::UdpLinks;
use crate::vehicle::{TICK_NS, VehicleConfig};
use crate::watch::Watch;

/// Lockstep: time within one turn of the service's loop, which sees to health and control between turns.
const TURN: Duration = Duration::from_millis(20);
/// Wall mode: more than this behind, the lost time is given up.
const BEHIND_MAX_NS: u64 = 500_000_000;

/// The service.
#[derive(Debug)]
pub struct SimulatorService {
    state: State,
    simulator: Simulator,
    links: UdpLinks,
    ports: Ports,
    clock: Lockstep,
    watch: Watch,
    mount: CameraConfig,
    /// Lockstep: datagrams that came within the present tick; they are taken when the next one begins.
    pending: VecDeque<(LinkId, Vec<u8>)>,
    epoch_ns: u64,
    started: Instant,
    /// Wall mode: mission time of boot.
    boot_at_ns: Option<u64>,
    /// Since when the supervisor is gone: leave once the vehicle has landed and px4-link has left.
    orphaned: Option<Instant>,
    /// What a vehicle gets to come home without a supervisor.
    patience: Duration,
}

fn other(error: &dyn core::fmt::Display) -> ServiceError {
    ServiceError::Other(error.to_string())
}

/// The vehicle that a configuration describes.
#[must_use]
pub fn vehicle_config(config: &Config) -> VehicleConfig {
    let simulator = &config.simulator;
    VehicleConfig {
        seed: config.mission.seed,
        estimator: EstimatorModel::from_name(simulator.estimator.name()).unwrap_or(EstimatorModel::Exact),
        start_enu_m: simulator.start_m,
        start_yaw_enu_rad: simulator.start_yaw_deg.to_radians(),
        origin_enu_m: simulator.origin_m,
        wind_enu_mps: simulator.wind_mps,
        gust_mps: simulator.gust_mps,
        battery: simulator.battery,
        params: simulator.params.iter().map(|(name, &value)| (name.clone(), value)).collect(),
        resets: Vec::new(),
    }
}

impl SimulatorService {
    /// Opens channels and builds the vehicle on bound links. `members` are waited for in lockstep.
    ///
    /// # Errors
    /// The bus refuses a channel, or a parameter of the configuration is unknown.
    pub fn open(context: &Context, links: UdpLinks, members: &[ServiceName]) -> Result<Self, ServiceError> {
        let simulator = Simulator::new(vehicle_config(&context.config), links.instance())
            .map_err(|e| other(&e))?
            .with_faults(&context.config.simulator.faults, context.config.mission.seed);
        let codes: Vec<u32> = members.iter().map(|m| m.code()).collect();
        let lockstep = context.config.clock.mode == ClockMode::Lockstep;
        let link = ServiceName::Px4Link.code();
        Ok(Self {
            state: if lockstep { State::Gathering } else { State::Free },
            simulator,
            links,
            ports: Ports::open(&context.bus, context.incarnation)?,
            clock: Lockstep::new(context.incarnation, &codes, link, context.config.clock.speed, 0),
            watch: Watch::default(),
            mount: context.config.camera.clone(),
            pending: VecDeque::new(),
            epoch_ns: context.config.mission.epoch_ns,
            started: Instant::now(),
            boot_at_ns: None,
            orphaned: None,
            patience: Duration::try_from_secs_f64(context.config.launch.landing_timeout_s).unwrap_or(Duration::MAX),
        })
    }

    /// Where the service stands.
    #[must_use]
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Whether a run like this repeats bit for bit so far.
    #[must_use]
    pub fn deterministic(&self) -> bool {
        self.state == State::Running && self.clock.deterministic()
    }

    /// Whether a vehicle is in the air that somebody can still bring home, or its link still works on the clock.
    fn is_needed(&self) -> bool {
        if self.clock.link_died() || self.orphaned.is_some_and(|since| since.elapsed() > self.patience) {
            return false;
        }
        let link = ServiceName::Px4Link.code();
        self.simulator.vehicle().autopilot.armed() || self.clock.processes().any(|(code, _, _)| code == link)
    }

    fn wall_ns(&self) -> u64 {
        u64::try_from(self.started.elapsed().as_nanos()).unwrap_or(u64::MAX)
    }

    /// Mission time of the present tick.
    fn now_ns(&self) -> u64 {
        self.epoch_ns + self.simulator.vehicle().boot_ns()
    }

    fn send_datagrams(&mut self) -> Result<(), ServiceError> {
        for (link, datagram) in self.simulator.take_datagrams() {
            self.links.send(link, &datagram).map_err(|e| other(&e))?;
        }
        Ok(())
    }

    fn publish_tick(&mut self) -> Result<(), ServiceError> {
        let now_ns = self.now_ns();
        self.ports.send_truth(now_ns, &self.simulator.truth(), &self.mount)?;
        self.publish_clock(true)
    }

    fn publish_clock(&mut self, fresh: bool) -> Result<(), ServiceError> {
        if self.clock.send_due(fresh, self.wall_ns()) {
            self.ports.send_clock(&self.clock, self.now_ns(), self.links.sent_onboard())?;
        }
        Ok(())
    }

    fn gather_input(&mut self) -> Result<(), ServiceError> {
        while let Some(received) = self.links.receive().map_err(|e| other(&e))? {
            if received.foreign && self.clock.on_foreign() {
                tracing::warn!(from = %received.from, "another client flies along: real time at most from now on");
            }
            self.pending.push_back((received.link, received.bytes.to_vec()));
        }
        let (read, wall_ns) = (self.links.received_onboard(), self.wall_ns());
        // Who has ended is looked at first: the grants read after that are all that it ever sent.
        let mut gone = self.watch.ended();
        for grant in self.ports.take_grants()? {
            self.clock.on_grant(&grant, read, wall_ns);
        }
        gone.extend(self.watch.follow(self.clock.processes()));
        for (code, incarnation) in gone {
            self.clock.on_gone(code, incarnation);
        }
        Ok(())
    }

    /// Begins the next tick: takes the datagrams, steps, sends telemetry and truth, then the clock.
    fn advance(&mut self) -> Result<(), ServiceError> {
        for (link, datagram) in core::mem::take(&mut self.pending) {
            self.simulator.receive(link, &datagram, 0);
        }
        self.simulator.step();
        self.clock.advance(self.wall_ns());
        self.send_datagrams()?;
        self.publish_tick()
    }

    fn lockstep_turn(&mut self) -> Result<Step, ServiceError> {
        let end = Instant::now() + TURN;
        if self.clock.tick() == 0 && self.clock.send_due(false, self.wall_ns().max(1)) {
            self.publish_tick()?;
        }
        loop {
            self.gather_input()?;
            let wall_ns = self.wall_ns();
            let phase = self.clock.poll(self.links.received_onboard(), wall_ns);
            self.state = core::mem::replace(&mut self.state, State::Gathering).after(&phase);
            let now = Instant::now();
            let left = end.saturating_duration_since(now);
            let wait = match phase {
                Phase::GatheringFailed(_) => return Ok(Step::Leave),
                Phase::Ready => {
                    self.advance()?;
                    if left.is_zero() {
                        return Ok(Step::Done);
                    }
                    continue;
                }
                Phase::Until(at) => Duration::from_nanos(at.saturating_sub(wall_ns)),
                Phase::Datagrams | Phase::Granting(_) | Phase::Gathering(_) => TURN,
            };
            self.publish_clock(false)?;
            if left.is_zero() {
                return Ok(Step::Done);
            }
            let fds: Vec<BorrowedFd<'_>> =
                self.links.sockets().into_iter().map(|s| s.as_fd()).chain(self.watch.fds()).collect();
            self.ports.wait(&fds, wait.min(left))?;
        }
    }

    fn free_turn(&mut self, now_ns: u64) -> Result<Step, ServiceError> {
        let boot_ns = self.simulator.vehicle().boot_ns();
        let mut boot_at_ns = *self.boot_at_ns.get_or_insert(now_ns);
        if now_ns.saturating_sub(boot_at_ns + boot_ns) > BEHIND_MAX_NS {
            // Stopped or suspended: the vehicle goes on from here instead of racing after the clock.
            boot_at_ns = now_ns - boot_ns;
            self.boot_at_ns = Some(boot_at_ns);
        }
        while let Some(received) = self.links.receive().map_err(|e| other(&e))? {
            let late_ns = now_ns.saturating_sub(boot_at_ns + boot_ns).min(TICK_NS);
            self.simulator.receive(received.link, received.bytes, late_ns);
        }
        self.send_datagrams()?;
        while boot_at_ns + self.simulator.vehicle().boot_ns() + TICK_NS <= now_ns {
            self.simulator.step();
            self.send_datagrams()?;
            let tick_ns = boot_at_ns + self.simulator.vehicle().boot_ns();
            self.ports.send_truth(tick_ns, &self.simulator.truth(), &self.mount)?;
        }
        Ok(Step::Done)
    }
}

impl Service for SimulatorService {
    fn step(&mut self, now_ns: u64) -> Result<Step, ServiceError> {
        if self.orphaned.is_some() && !self.is_needed() {
            return Ok(Step::Leave);
        }
        match self.state {
            State::Gathering | State::Running => self.lockstep_turn(),
            State::Free => self.free_turn(now_ns),
            State::Failed(_) => Ok(Step::Leave),
        }
    }

    fn orphaned(&mut self, _now_ns: u64) -> StopAnswer {
        self.orphaned = Some(Instant::now());
        if self.is_needed() { StopAnswer::Later } else { StopAnswer::Now }
    }

    fn period(&self) -> Duration {
        // In lockstep a turn waits by itself.
        if self.state == State::Free { Duration::from_nanos(TICK_NS) } else { Duration::ZERO }
    }

    fn fds(&self) -> Vec<BorrowedFd<'_>> {
        self.links.sockets().into_iter().map(|s| s.as_fd()).collect()
    }

    fn health(&self) -> HealthReport {
        let last_error = if matches!(self.state, State::Gathering | State::Running) && !self.clock.deterministic() {
            "this run does not repeat bit for bit: a member was out, a datagram was lost, or a foreign client flies"
                .to_owned()
        } else {
            String::new()
        };
        HealthReport {
            state: ServiceState::Running,
            last_error,
            received: self.links.received_onboard(),
            sent: self.links.sent_onboard(),
            dropped: self.clock.lost_datagrams(),
        }
    }
}
