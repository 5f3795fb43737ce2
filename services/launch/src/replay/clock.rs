//! The mission clock of a replay: as the simulator's, without a vehicle.

use std::time::{Duration, Instant};

use shared_types::bus::Bus;
use shared_types::{ServiceName, TICK_NS};
use simulator::clock::{Lockstep, Phase};
use simulator::ports::Ports;
use simulator::watch::Watch;

use crate::clock::monotonic_ns;
use crate::exit::Refusal;

/// Nobody's datagrams are counted.
const NO_LINK: u32 = u32::MAX;
const WAIT: Duration = Duration::from_millis(20);

/// Time, tick by tick.
pub struct Clock {
    lockstep: Lockstep,
    ports: Ports,
    watch: Watch,
    first_ns: u64,
    began: Instant,
    gathering: bool,
    has_members: bool,
}

impl Clock {
    /// A clock whose first tick is the instant `first_ns`; it waits for `members`.
    ///
    /// # Errors
    /// When a channel cannot be opened.
    pub fn open(bus: &Bus, members: &[ServiceName], first_ns: u64, speed: f64) -> anyhow::Result<Self> {
        let incarnation = monotonic_ns();
        let codes: Vec<u32> = members.iter().map(|service| service.code()).collect();
        Ok(Self {
            lockstep: Lockstep::new(incarnation, &codes, NO_LINK, speed, 0),
            ports: Ports::open(bus, incarnation)?,
            watch: Watch::default(),
            first_ns,
            began: Instant::now(),
            gathering: true,
            has_members: !members.is_empty(),
        })
    }

    /// Mission time of the present tick, nanoseconds.
    #[must_use]
    pub fn now_ns(&self) -> u64 {
        self.first_ns + self.lockstep.tick() * TICK_NS
    }

    /// Whether members are still missing.
    #[must_use]
    pub fn is_gathering(&self) -> bool {
        self.gathering
    }

    /// Whether all members have ended.
    #[must_use]
    pub fn is_deserted(&self) -> bool {
        self.has_members && !self.gathering && self.lockstep.processes().next().is_none()
    }

    fn wall_ns(&self) -> u64 {
        u64::try_from(self.began.elapsed().as_nanos()).unwrap_or(u64::MAX)
    }

    /// Waits for the present tick's grants and begins the next one.
    ///
    /// # Errors
    /// When a channel is broken, or members never came.
    pub fn tick(&mut self) -> anyhow::Result<()> {
        let before = self.lockstep.tick();
        while self.lockstep.tick() == before {
            self.turn()?;
        }
        Ok(())
    }

    /// Looks at the grants once, and waits a little for more of them where they are missing.
    ///
    /// # Errors
    /// As [`Self::tick`].
    pub fn turn(&mut self) -> anyhow::Result<()> {
        let mut gone = self.watch.ended();
        let wall_ns = self.wall_ns();
        for grant in self.ports.take_grants()? {
            self.lockstep.on_grant(&grant, 0, wall_ns);
        }
        gone.extend(self.watch.follow(self.lockstep.processes()));
        for (code, incarnation) in gone {
            self.lockstep.on_gone(code, incarnation);
        }
        let phase = self.lockstep.poll(0, wall_ns);
        self.gathering = matches!(phase, Phase::Gathering(_));
        let wait = match phase {
            Phase::GatheringFailed(missing) => {
                let names: Vec<&str> =
                    missing.into_iter().filter_map(ServiceName::from_code).map(ServiceName::name).collect();
                return Err(Refusal::missing(format!(
                    "no grant of the first tick within 60 s from: {}; see their logs",
                    names.join(", ")
                )));
            }
            Phase::Ready => {
                self.lockstep.advance(wall_ns);
                return self.publish(true);
            }
            Phase::Until(at) => Duration::from_nanos(at.saturating_sub(wall_ns)).min(WAIT),
            Phase::Datagrams | Phase::Granting(_) | Phase::Gathering(_) => WAIT,
        };
        self.publish(false)?;
        let fds: Vec<_> = self.watch.fds().collect();
        self.ports.wait(&fds, wait)?;
        Ok(())
    }

    fn publish(&mut self, fresh: bool) -> anyhow::Result<()> {
        let wall_ns = self.wall_ns().max(1);
        if self.lockstep.send_due(fresh, wall_ns) {
            let now_ns = self.now_ns();
            self.ports.send_clock(&self.lockstep, now_ns, 0)?;
        }
        Ok(())
    }
}
