//! `vantage replay`: one or more services alone on what was recorded. Everything that the others sent then is sent again on
//! the same channels at the same mission times, and the mission's clock waits for the services that are being looked at.
//!
//! - [`source`]: what was recorded, from a recording or from a mission folder;
//! - [`player`]: sends it again, and stores keyframes where services read them;
//! - [`clock`]: the mission clock, with the replayed services for members;
//! - [`alone`]: a service in the foreground, with a player beside it.

pub mod alone;
pub mod clock;
pub mod player;
pub mod source;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use shared_types::bus::{Bus, Limits};
use shared_types::channel::HealthChannel;
use shared_types::config::{ClockMode, Config, Layer, load};
use shared_types::folder::{MissionFolder, write_atomic};
use shared_types::system::System;
use shared_types::{ServiceName, TICK_NS, ns_from_s, s_from_ns};

use crate::cli::Replay;
use crate::clock::monotonic_ns;
use crate::exit::{Exit, Refusal};
use crate::progress::Progress;
use crate::supervise::children::{Children, Starter};
use crate::{print, settings};
use clock::Clock;
use player::Player;
use source::Source;

/// What can be replayed: px4-link speaks with a vehicle, and the others make time or keep house.
const REPLAYABLE: [ServiceName; 5] =
    [ServiceName::Camera, ServiceName::Trainer, ServiceName::Scorer, ServiceName::Planner, ServiceName::World];
/// Mission time after the last message, in which work that was asked for comes to its end.
const TAIL_S: f64 = 5.0;
/// How long services are waited for to end in order.
const STOP_PATIENCE: Duration = Duration::from_secs(15);
/// How long the keeper is waited for.
const KEEPER_PATIENCE: Duration = Duration::from_secs(3);

/// Replays.
///
/// # Errors
/// When the recording cannot be used, services are unknown, or one of them ends before the end.
pub fn run(arguments: &Replay) -> anyhow::Result<Exit> {
    let services = services(&arguments.services)?;
    let mut source = Source::open(&arguments.input)?;
    let output = output(arguments)?;
    let config = configure(source.config(), arguments, &output)?;
    let folder = MissionFolder::create_with(&output, &shared_types::config::load::to_toml(&config)?)?;
    let mut progress = Progress::new();
    let name = arguments.system.clone().unwrap_or_else(|| format!("replay-{}", std::process::id()));
    let (system, hold) = System::create_held(&System::base_dir(), &name, std::process::id())?;
    write_atomic(&system.config_path(), shared_types::config::load::to_toml(&config)?.as_bytes())?;
    let starter = Starter {
        program: std::env::current_exe().context("cannot find the vantage binary")?,
        system_folder: system.runtime_dir.clone(),
        logs: folder.root().join("logs"),
        log_level: config.launch.log_level.clone(),
    };
    let mut children = Children::new(starter);
    let result = play(&mut source, &services, &config, &system, &mut children, arguments, &mut progress);
    stop(&mut children);
    progress.clear();
    drop(hold);
    if let Err(error) = system.remove_if_dead() {
        tracing::warn!(%error, "the system's folder could not be removed");
    }
    let played = result?;
    print(&format!(
        "{} messages of {:.1} s of mission in {:.1} s; what the services made of it: {}\n",
        played.messages,
        s_from_ns(played.mission_ns),
        played.wall_s,
        folder.root().display()
    ))
}

/// What was played.
struct Played {
    messages: u64,
    mission_ns: u64,
    wall_s: f64,
}

fn services(names: &[String]) -> anyhow::Result<Vec<ServiceName>> {
    let known: Vec<&str> = REPLAYABLE.iter().map(|service| service.name()).collect();
    let of = |name: &String| {
        REPLAYABLE.into_iter().find(|service| service.name() == name.as_str()).ok_or_else(|| {
            Refusal::usage(format!("--services {name}: cannot be replayed; expected one of: {}", known.join(", ")))
        })
    };
    let mut services = names.iter().map(of).collect::<anyhow::Result<Vec<_>>>()?;
    services.sort_unstable();
    services.dedup();
    Ok(services)
}

/// Where the services write: beside what is replayed, in a folder of its own, unless one is given.
fn output(arguments: &Replay) -> anyhow::Result<PathBuf> {
    if let Some(output) = &arguments.output {
        return Ok(settings::absolute(output)?);
    }
    let input = settings::absolute(&arguments.input)?;
    let beside = if input.is_dir() { input.as_path() } else { input.parent().unwrap_or(Path::new("/")) };
    let free = (1..).map(|number| beside.join(format!("replay-{number}"))).find(|path| !path.exists());
    free.ok_or_else(|| Refusal::missing("no name is free for the output; expected --output"))
}

/// The configuration of then, on a clock that waits, in a folder of its own.
fn configure(recorded: &Config, arguments: &Replay, output: &Path) -> anyhow::Result<Config> {
    let mut config = recorded.clone();
    config.clock.mode = ClockMode::Lockstep;
    config.clock.speed = arguments.speed;
    config.recorder.enabled = arguments.record;
    config.recorder.complete = arguments.record;
    config.recorder.frames &= arguments.record;
    let path = output.to_str().ok_or_else(|| Refusal::usage(format!("{}: expected UTF-8", output.display())))?;
    path.clone_into(&mut config.mission.folder);
    let text = shared_types::config::load::to_toml(&config)?;
    let mut layers = vec![Layer { name: "the recording's configuration".to_owned(), text, has_lines: false }];
    for set in &arguments.sets {
        layers.push(Layer::of_set(set)?);
    }
    Ok(load(&layers)?)
}

fn play(
    source: &mut Source,
    services: &[ServiceName],
    config: &Config,
    system: &System,
    children: &mut Children,
    arguments: &Replay,
    progress: &mut Progress,
) -> anyhow::Result<Played> {
    let began = Instant::now();
    let bus = Bus::open(system, Limits::of(config), ServiceName::Launch, monotonic_ns(), false)?;
    children.start(ServiceName::Keeper)?;
    await_keeper(&bus)?;
    let mut members: Vec<ServiceName> =
        services.iter().copied().filter(|service| ServiceName::MEMBERS.contains(service)).collect();
    members.extend(config.recorder.enabled.then_some(ServiceName::Recorder));
    let to_start = if arguments.joined { &[] } else { services };
    for service in to_start.iter().copied().chain(config.recorder.enabled.then_some(ServiceName::Recorder)) {
        children.start(service)?;
    }
    let mut player = Player::open(&bus, config, services)?;
    let first_ns = player.skip_to(source, ns_from_s(arguments.from))?;
    let mut clock = Clock::open(&bus, &members, first_ns, config.clock.speed)?;
    progress.doing("waiting for the services");
    let mut told = Instant::now();
    while clock.is_gathering() {
        clock.turn()?;
        check(children)?;
    }
    let mut last_ns = first_ns;
    while (!player.is_over() || clock.now_ns() < last_ns + ns_from_s(TAIL_S)) && !clock.is_deserted() {
        // What is sent in a tick is seen in the next one, as it was then.
        player.send_until(source, clock.now_ns() + TICK_NS)?;
        bus.serve_late_joiners();
        if !player.is_over() {
            last_ns = clock.now_ns();
        }
        clock.tick()?;
        if told.elapsed() > Duration::from_millis(200) {
            told = Instant::now();
            check(children)?;
            let (now_s, messages) = (s_from_ns(clock.now_ns() - first_ns), player.messages());
            progress.doing_quietly(&format!("{now_s:>7.1} s of mission  {messages} messages"));
        }
    }
    if let Some(why) = source.is_cut() {
        progress.say(&format!("the recording was cut off ({why}): replayed up to its last whole chunk"));
    }
    if arguments.joined {
        player.dismiss(services)?;
    }
    Ok(Played {
        messages: player.messages(),
        mission_ns: clock.now_ns() - first_ns,
        wall_s: began.elapsed().as_secs_f64(),
    })
}

/// The keeper holds the channels open before anybody opens them.
fn await_keeper(bus: &Bus) -> anyhow::Result<()> {
    let mut health = bus.subscriber::<HealthChannel>()?;
    let began = Instant::now();
    while began.elapsed() < KEEPER_PATIENCE && health.latest(0)?.is_none() {
        std::thread::sleep(Duration::from_millis(5));
    }
    Ok(())
}

/// A service that ends is not started again: what made it end would be gone.
fn check(children: &mut Children) -> anyhow::Result<()> {
    let Some((service, _, how)) = children.reap().into_iter().next() else { return Ok(()) };
    let words = children.last_words(service).unwrap_or_default();
    let log = children.log_path(service);
    Err(Refusal::failed(format!("{service} ended in the replay ({how}): {words}\nlog: {}", log.display())))
}

/// Everybody ends in order, the keeper last.
fn stop(children: &mut Children) {
    let ask = |children: &mut Children, which: &dyn Fn(ServiceName) -> bool| {
        let began = Instant::now();
        let asked: Vec<ServiceName> = children.pids().into_iter().map(|(s, _)| s).filter(|s| which(*s)).collect();
        asked.iter().for_each(|service| children.ask(*service));
        while children.pids().iter().any(|(service, _)| which(*service)) {
            children.reap();
            if began.elapsed() > STOP_PATIENCE {
                asked.iter().for_each(|service| children.kill(*service));
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    ask(children, &|service| !matches!(service, ServiceName::Keeper | ServiceName::Recorder));
    ask(children, &|service| service == ServiceName::Recorder);
    ask(children, &|_| true);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_makes_time_or_speaks_with_a_vehicle_is_not_replayed() {
        let named = |names: &[&str]| services(&names.iter().map(|&name| name.to_owned()).collect::<Vec<_>>());
        assert_eq!(named(&["scorer", "trainer", "scorer"]).expect("two"), [ServiceName::Trainer, ServiceName::Scorer]);
        for name in ["px4-link", "simulator", "keeper", "viewer"] {
            let error = named(&[name]).expect_err("not replayed").to_string();
            assert!(error.contains(name) && error.contains("trainer"), "{error}");
        }
    }
}
