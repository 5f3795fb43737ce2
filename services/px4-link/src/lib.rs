//! MAVLink to vehicle state and setpoints: the only place that knows NED, FRD and MAVLink.
//!
//! [`mavlink_io`] turns bytes into messages and pins one autopilot. [`telemetry`], [`gimbal`] and [`timesync`] read what it
//! says into the world's frames ([`frames`]) and mission time. [`logic`] decides: the phases ([`state`]), questions
//! ([`asks`], [`params`]), commands that are believed only when the state shows them ([`commands`]), targets. [`stream`]
//! sends setpoints at 20 Hz from the generator ([`setpoint`]) along a [`path`]; [`runner`] gives it a thread of its own on
//! the wall's clock. [`store`] keeps what must outlive a restart.
#![forbid(unsafe_code)]

pub mod asks;
pub mod commands;
pub mod frames;
pub mod gimbal;
pub mod ground;
pub mod logic;
pub mod mavlink_io;
pub mod params;
pub mod path;
pub mod ports;
pub mod runner;
pub mod setpoint;
pub mod state;
pub mod store;
pub mod stream;
pub mod telemetry;
pub mod timesync;

use std::os::fd::BorrowedFd;
use std::time::Duration;

use anyhow::Context as _;
use shared_types::messages::{ClockTick, ServiceState};
use shared_types::service::{Context, HealthReport, Service, ServiceError, Step, StopAnswer};

use ground::Ground;
use logic::Core;
use mavlink_io::{Link, Sender};
use ports::Ports;
use runner::Runner;
use store::Store;
use stream::{GAP_BORDERS_MS, Settings};

/// `vehicle/state` is published at 50 Hz.
const STATE_PERIOD_NS: u64 = 20_000_000;
/// A turn that comes later than this after the one before is as after a restart.
const STALL_NS: u64 = 500_000_000;

struct Px4Link {
    ports: Ports,
    link: Link,
    sender: Sender,
    core: Core,
    ground: Ground,
    takes_orders: bool,
    runner: Runner,
    lockstep: bool,
    published_ns: Option<u64>,
    turned_ns: Option<u64>,
    trouble: Option<String>,
}

impl Service for Px4Link {
    fn step(&mut self, now_ns: u64) -> Result<Step, ServiceError> {
        if !self.lockstep {
            self.link.take_all();
            // Stopped or stalled: what has come meanwhile tells of a vehicle that somebody else may fly by now.
            if self.turned_ns.is_some_and(|turned_ns| now_ns.saturating_sub(turned_ns) > STALL_NS) {
                tracing::warn!("px4-link did not run for more than 0.5 s: looking at the vehicle anew");
                Service::rejoin(self, now_ns);
            }
            self.turned_ns = Some(now_ns);
        }
        while let Some(received) = self.link.next_message() {
            self.core.on_message(now_ns, &received);
        }
        while let Some((received, order)) = self.link.next_order() {
            if !self.takes_orders {
                self.ground.refuse(&received, order);
            } else if let Some(passed) = self.ground.on_order(now_ns, &received, order) {
                self.ports.order(now_ns, passed)?;
            }
        }
        self.core.on_report(self.runner.report());
        self.ports.receive(now_ns, &mut self.core)?;
        self.ports.receive_for_ground(now_ns, &mut self.ground)?;
        for message in self.ground.take_messages(now_ns) {
            self.sender.send(&message);
        }
        let outputs = self.core.step(now_ns);
        for message in &outputs.messages {
            self.sender.send(message);
        }
        self.runner.order(outputs.orders);
        self.runner.step(now_ns);
        for (to, reply) in &outputs.replies {
            self.ports.reply(now_ns, to, reply)?;
        }
        if self.published_ns.is_none_or(|last_ns| now_ns >= last_ns + STATE_PERIOD_NS) {
            self.published_ns = Some(now_ns);
            self.core.on_report(self.runner.report());
            let state = self.core.state(now_ns);
            self.ports.publish(now_ns, &state)?;
            self.trouble = self.core.trouble(now_ns);
        }
        Ok(if self.core.may_leave() { Step::Leave } else { Step::Done })
    }

    fn begin_tick(&mut self, tick: &ClockTick) {
        self.link.drain_to(tick.datagrams);
    }

    fn datagrams_sent(&self) -> u64 {
        self.sender.sent()
    }

    fn period(&self) -> Duration {
        Duration::from_millis(10)
    }

    fn fds(&self) -> Vec<BorrowedFd<'_>> {
        self.link.fd().into_iter().collect()
    }

    fn rejoin(&mut self, now_ns: u64) {
        self.link.rejoin();
        self.core.rejoin(now_ns);
        if let Err(error) = self.ports.forget() {
            tracing::warn!(%error, "cannot drop what was sent before");
        }
    }

    fn health(&self) -> HealthReport {
        let (received, sent, dropped) = self.ports.counts();
        HealthReport {
            state: if self.trouble.is_some() { ServiceState::Degraded } else { ServiceState::Running },
            last_error: self.trouble.clone().unwrap_or_default(),
            received,
            sent,
            dropped: dropped + self.link.missing + self.link.foreign,
        }
    }

    fn stop(&mut self, now_ns: u64) -> StopAnswer {
        if self.core.stop(now_ns) {
            tracing::info!("in the air: returning and landing before leaving");
            StopAnswer::Later
        } else {
            StopAnswer::Now
        }
    }
}

/// Runs px4-link until it is stopped.
///
/// # Errors
/// When the address cannot be opened or the bus fails.
pub fn run(mut context: Context) -> anyhow::Result<()> {
    let config = context.config.link.clone();
    let lockstep = context.lockstep();
    let link = Link::open(&config.url, lockstep)?;
    let sender = link.sender();
    let settings = Settings::new(&config);
    let runner = if lockstep {
        Runner::inline(settings, sender.clone())
    } else {
        Runner::thread(settings, sender.clone(), context.wall_now_ns()).context("cannot start the setpoint thread")?
    };
    let mut service = Px4Link {
        ports: Ports::open(&context.bus)?,
        link,
        sender,
        ground: Ground::new(context.incarnation),
        takes_orders: config.take_orders,
        core: Core::new(&config, lockstep, context.incarnation, Store::new(&context.system.runtime_dir)),
        runner,
        lockstep,
        published_ns: None,
        turned_ns: None,
        trouble: None,
    };
    let result = context.run(&mut service);
    let report = service.runner.report();
    tracing::info!(
        setpoints = report.sent, longest_gap_ms = report.longest_gap_ns / 1_000_000, gaps = ?report.gaps,
        borders_ms = ?GAP_BORDERS_MS, missing = service.link.missing, foreign = service.link.foreign, "leaving"
    );
    Ok(result?)
}
