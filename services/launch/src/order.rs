//! `vantage stop`, `land`, `abort`, `go-on`: the operator's word to a mission that flies.

use std::time::{Duration, Instant};

use shared_types::ServiceName;
use shared_types::bus::{Bus, Limits};
use shared_types::channel::{ClockChannel, MissionCommandChannel};
use shared_types::config::{ClockMode, Config, Layer, load};
use shared_types::messages::{MissionCommand, MissionRequest};
use shared_types::payload::unpack_text;
use shared_types::system::System;

use crate::cli::Order;
use crate::clock::monotonic_ns;
use crate::exit::{Exit, Refusal};
use crate::print;
use crate::reach::in_time;

/// A planner answers within a tick; one that was just killed is back before this.
const PATIENCE: Duration = Duration::from_secs(10);

/// Gives an order and waits for the planner's answer.
///
/// # Errors
/// When there is no such system, nobody answers, or the planner refuses.
pub fn run(command: MissionCommand, arguments: &Order) -> anyhow::Result<Exit> {
    let system = System::find(&System::base_dir(), arguments.system.as_deref())?;
    let name = system.name.clone();
    if !system.is_alive() {
        return Err(Refusal::missing(format!("system {name} is dead: nobody there takes an order")));
    }
    let config = load(&[Layer::of_file(&system.config_path())?])?;
    let answer =
        in_time("order", PATIENCE + Duration::from_secs(2), move || give(command, &system, &config))?.flatten();
    match answer {
        None => Err(Refusal::missing(format!(
            "no answer to {command} from the planner of system {name} within {} s; `vantage status` shows what runs",
            PATIENCE.as_secs()
        ))),
        Some(Err(reason)) => Err(Refusal::failed(format!("the planner of system {name} refuses {command}: {reason}"))),
        Some(Ok(())) => print(&format!("{name}: {command}\n")),
    }
}

/// The planner's answer; `None` where none came.
fn give(command: MissionCommand, system: &System, config: &Config) -> anyhow::Result<Option<Result<(), String>>> {
    let bus = Bus::open(system, Limits::of(config), ServiceName::Command, monotonic_ns(), false)?;
    let mut clock = bus.subscriber::<ClockChannel>()?;
    let mut client = bus.client::<MissionCommandChannel>()?;
    let began = Instant::now();
    let id = monotonic_ns();
    let mut sent = false;
    while began.elapsed() < PATIENCE {
        // Mission time: the newest tick's, or the machine's.
        let now_ns = match config.clock.mode {
            ClockMode::Wall => Some(monotonic_ns().saturating_add(config.mission.epoch_ns)),
            ClockMode::Lockstep => clock.latest(0)?.map(|tick| tick.header().now_ns),
        };
        if let (Some(now_ns), false) = (now_ns, sent) {
            client.send(now_ns, id, &MissionRequest { command: command.code(), reserved: 0 }, &[])?;
            sent = true;
        }
        if let Some(reply) = client.receive(now_ns.unwrap_or(u64::MAX))? {
            let reply = reply.header();
            return Ok(Some(if reply.accepted == 1 { Ok(()) } else { Err(unpack_text(&reply.reason)) }));
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    Ok(None)
}
