//! A PX4-compatible vehicle and the mission clock, for machines without PX4 and Gazebo.
//!
//! The vehicle ([`vehicle`]) is a pure state machine on ticks of 10 ms: a body ([`dynamics`]) under PX4's cascade
//! ([`control`]), an estimator ([`estimator`]), an autopilot with modes and failsafes ([`autopilot`], [`guidance`],
//! [`failsafe`]), a gimbal and a battery. [`simulator`] gives it MAVLink 2 links; [`udp`] the sockets, by PX4's ports.
//! The clock ([`clock`]) lets simulated time go as fast as its slowest member, and the same each time.
//!
//! What the vehicle does and answers is what was measured of a real PX4 1.18; clients of other makers (MAVSDK, pymavlink)
//! fly it unchanged. It can be tried alone: `cargo run --release -p simulator --example standalone`.
//!
//! Not simulated: missions, RC receivers (MANUAL_CONTROL is taken), log and file transfer, EVENT messages, rally points and
//! fence polygons, the cone of a return near home (a return always climbs to RTL_RETURN_ALT).
#![forbid(unsafe_code)]

pub mod autopilot;
pub mod battery;
pub mod clock;
pub mod commands;
pub mod control;
pub mod dynamics;
pub mod estimator;
pub mod failsafe;
pub mod faults;
pub mod flight;
pub mod frames;
pub mod gimbal;
pub mod guidance;
pub mod mav;
pub mod modes;
pub mod params;
pub mod ports;
pub mod rng;
pub mod service;
pub mod simulator;
pub mod standalone;
pub mod state;
pub mod streams;
pub mod trajectory;
pub mod udp;
pub mod vehicle;
pub mod watch;

use shared_types::service::{Context, ServiceError, ServiceName};

use service::SimulatorService;
use state::State;

/// Why the simulator ended.
#[derive(Debug, thiserror::Error)]
pub enum SimulatorError {
    /// The ports are taken.
    #[error(transparent)]
    Ports(#[from] udp::UdpError),
    /// Members never granted tick 0.
    #[error(
        "no grant of the first tick within 60 s from: {names}; they did not start, or belong to another system (see their logs)"
    )]
    MembersMissing {
        /// Names of the members.
        names: String,
    },
    /// The service or the bus.
    #[error(transparent)]
    Service(#[from] ServiceError),
}

impl SimulatorError {
    /// Exit code of a process that ends with this: 69 where something needed is missing, 64 where what it was given cannot be
    /// used, 70 otherwise.
    #[must_use]
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Ports(_) | Self::MembersMissing { .. } => 69,
            Self::Service(ServiceError::Bus(_) | ServiceError::Missing(_)) => 69,
            Self::Service(ServiceError::Unusable(_)) => 64,
            Self::Service(ServiceError::Other(_)) => 70,
        }
    }
}

/// Runs the simulator as a service of a system until it is asked to stop. In lockstep the clock waits for `members`; with
/// `clock.mode = "wall"`, or without members, the vehicle runs free at real time.
///
/// # Errors
/// Ports are taken, members are missing, or the bus fails; see [`SimulatorError::exit_code`].
pub fn run(context: &mut Context, members: &[ServiceName]) -> Result<(), SimulatorError> {
    let instance = u8::try_from(context.config.simulator.instance).ok();
    let links = udp::UdpLinks::bind(instance)?;
    if members.is_empty() {
        context.config.clock.mode = shared_types::config::ClockMode::Wall;
    }
    tracing::info!(instance = links.instance(), peer = %links.onboard_peer(), "simulator ready");
    let mut service = SimulatorService::open(context, links, members)?;
    context.run(&mut service)?;
    if let State::Failed(missing) = service.state() {
        let names: Vec<&str> =
            missing.iter().filter_map(|&code| ServiceName::from_code(code)).map(ServiceName::name).collect();
        return Err(SimulatorError::MembersMissing { names: names.join(", ") });
    }
    Ok(())
}
