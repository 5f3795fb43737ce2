//! `vantage log`: the log level of a service, changed while it runs.

use std::time::{Duration, Instant};

use shared_types::ServiceName;
use shared_types::bus::{Bus, Limits};
use shared_types::channel::ControlChannel;
use shared_types::config::{Layer, load};
use shared_types::logging::LEVELS;
use shared_types::messages::{ControlCommand, ControlRequest};
use shared_types::system::System;

use crate::cli::Log;
use crate::clock::monotonic_ns;
use crate::exit::{Exit, Refusal};
use crate::print;
use crate::reach::in_time;
use crate::supervise::plan::START_ORDER;

/// Services look at `control` ten times a second.
const PATIENCE: Duration = Duration::from_secs(3);

/// Sets the level of one service, or of all.
///
/// # Errors
/// When there is no such system, service or level, or a service that was named does not answer.
pub fn log(arguments: &Log) -> anyhow::Result<Exit> {
    let level = LEVELS.iter().position(|level| *level == arguments.level).unwrap_or_default();
    let services: Vec<ServiceName> = match arguments.service.as_str() {
        "all" => START_ORDER.to_vec(),
        name => START_ORDER.into_iter().filter(|service| service.name() == name).collect(),
    };
    if services.is_empty() {
        let known: Vec<&str> = START_ORDER.iter().map(|service| service.name()).collect();
        let (asked, known) = (&arguments.service, known.join(", "));
        return Err(Refusal::usage(format!("{asked:?} is no service; expected all, or one of: {known}")));
    }
    let system = System::find(&System::base_dir(), arguments.system.as_deref())?;
    let name = system.name.clone();
    if !system.is_alive() {
        return Err(Refusal::missing(format!("system {name} is dead: no service there has a log")));
    }
    let asked = services.clone();
    let answers = in_time("control", 2 * PATIENCE, move || set(&system, &asked, u32::try_from(level)?))?;
    let Some(answers) = answers else {
        return Err(Refusal::missing(format!("the bus of system {name} does not answer; is its keeper running?")));
    };
    let silent: Vec<&str> = services.iter().filter(|s| !answers.contains(s)).map(|s| s.name()).collect();
    // Not everybody runs everywhere: without a simulator there is no world.
    if answers.is_empty() || (arguments.service != "all" && !silent.is_empty()) {
        return Err(Refusal::missing(format!(
            "no answer from {} in system {name} within {} s; `vantage status` shows what runs",
            silent.join(", "),
            PATIENCE.as_secs()
        )));
    }
    let answered: Vec<&str> = answers.iter().map(|service| service.name()).collect();
    print(&format!("{name}: {} at {}\n", answered.join(", "), arguments.level))
}

/// Asks each; those that answered.
fn set(system: &System, services: &[ServiceName], level: u32) -> anyhow::Result<Vec<ServiceName>> {
    let config = load(&[Layer::of_file(&system.config_path())?])?;
    let bus = Bus::open(system, Limits::of(&config), ServiceName::Command, monotonic_ns(), false)?;
    let mut client = bus.client::<ControlChannel>()?;
    let first = monotonic_ns();
    for (id, service) in (first..).zip(services) {
        let command = ControlCommand::LogLevel.code();
        let request = ControlRequest { command, argument: level, service: service.code(), reserved: 0 };
        client.send(0, id, &request, &[])?;
    }
    let (mut answered, began) = (Vec::new(), Instant::now());
    while answered.len() < services.len() && began.elapsed() < PATIENCE {
        while let Some(reply) = client.receive(0)? {
            let (id, service) = (reply.request_id(), ServiceName::from_code(reply.header().service));
            let accepted = reply.header().accepted == 1;
            drop(reply);
            client.finish(id);
            answered.extend(service.filter(|_| accepted));
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    answered.sort_unstable();
    answered.dedup();
    Ok(answered)
}
