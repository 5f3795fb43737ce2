//! The mission: prior, candidates, selection, paths, journal (Sections IV-B, C, E and Algorithm 1 of the paper).
//!
//! - [`logic`]: geometry and choice, pure;
//! - [`journal`] and [`ledger`]: the decisions, and the state that they add up to;
//! - [`mission`] and [`state`]: the state machine, which takes [`io::Inputs`] and gives [`io::Outputs`];
//! - [`desk`]: where decisions wait for the disk;
//! - [`ports`] and [`service`]: the channels, the mission folder, the loop.
#![forbid(unsafe_code)]

pub mod desk;
pub mod io;
pub mod journal;
pub mod ledger;
pub mod logic;
pub mod mission;
pub mod ports;
pub mod service;
pub mod state;

use anyhow::Context as _;

/// The service `planner`, until it is told to stop.
///
/// # Errors
/// When the mission folder, its journal or a channel cannot be had.
pub fn run(mut context: shared_types::service::Context) -> anyhow::Result<()> {
    let ports = ports::Ports::open(&context.bus)?;
    let mut service = service::Planner::new(ports, &context).context("the planner cannot start")?;
    context.run(&mut service)?;
    Ok(())
}

#[cfg(test)]
mod testing;

#[cfg(test)]
mod mission_tests;
#[cfg(test)]
mod simulated;
