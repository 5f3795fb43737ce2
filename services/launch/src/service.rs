//! `vantage <service>`: one process in the foreground.

use std::time::{Duration, Instant};

use anyhow::Context as _;
use shared_types::ServiceName;
use shared_types::channel::HealthChannel;
use shared_types::config::{Config, Layer, load};
use shared_types::folder::write_atomic;
use shared_types::messages::ServiceState;
use shared_types::service::Context;
use shared_types::system::System;

use crate::cli::Service;
use crate::exit::Refusal;
use crate::settings;
use crate::supervise::plan::apply_scheduling;

/// Joins the system that was named (or the only one; a name that no system has makes one), and runs the service until it
/// is asked to stop.
///
/// # Errors
/// Bad configuration, no system, no shared memory, and whatever the service cannot go on with.
pub fn run(name: ServiceName, arguments: &Service) -> anyhow::Result<()> {
    apply_scheduling(name);
    let (system, config) = join(arguments)?;
    if system.version != env!("CARGO_PKG_VERSION") {
        return Err(Refusal::missing(format!(
            "system {} was made by Vantage {}, expected {}; stop it and start all services with one version",
            system.name,
            system.version,
            env!("CARGO_PKG_VERSION")
        )));
    }
    let context = Context::open(name, config, system, arguments.supervised)?;
    tracing::info!(service = %name, system = %context.system.name, pid = std::process::id(), "started");
    let result = dispatch(name, context).with_context(|| format!("{name} cannot go on"));
    tracing::info!(service = %name, ok = result.is_ok(), "ended");
    result
}

/// The system and its resolved configuration.
fn join(arguments: &Service) -> anyhow::Result<(System, Config)> {
    let base = System::base_dir();
    if let Ok(system) = System::find(&base, arguments.system.as_deref()) {
        let config = load(&[Layer::of_file(&system.config_path())?])?;
        return Ok((system, config));
    }
    let Some(name) = arguments.system.as_deref().filter(|name| !name.contains('/')) else {
        // Nothing to make: the error of the search says what was expected.
        return Err(System::find(&base, arguments.system.as_deref()).err().map_or_else(
            || Refusal::missing("the system vanished while it was opened; try again"),
            anyhow::Error::from,
        ));
    };
    let config = settings::resolve(&arguments.settings)?;
    let system = System::create(&base, name, 0)?;
    let text = shared_types::config::load::to_toml(&config)?;
    write_atomic(&system.config_path(), text.as_bytes())?;
    Ok((system, config))
}

fn dispatch(name: ServiceName, mut context: Context) -> anyhow::Result<()> {
    match name {
        ServiceName::Keeper => keeper::run(context),
        ServiceName::Simulator => {
            // Alone (for other ground stations, or to try something), it runs free; in a mission it waits for its members.
            let members: &[ServiceName] = if context.supervised { &ServiceName::MEMBERS } else { &[] };
            simulator::run(&mut context, members).map_err(|error| match error.exit_code() {
                69 => Refusal::missing(error.to_string()),
                _ => error.into(),
            })
        }
        ServiceName::World => world::run(context),
        ServiceName::Px4Link => px4_link::run(context),
        ServiceName::Camera => {
            if context.supervised && context.config.link.is_local() {
                await_world(&context)?;
            }
            camera::run(context)
        }
        ServiceName::Trainer => trainer::run(context),
        ServiceName::Scorer => scorer::run(context),
        ServiceName::Planner => planner::run(context),
        ServiceName::Command | ServiceName::Launch => Err(Refusal::usage(format!("{name} is no service"))),
    }
}

/// How long the camera waits for the world's scene before it goes on without.
const WORLD_PATIENCE: Duration = Duration::from_secs(30);

/// Waits until the world has built its scene. Simulated time does not begin before the camera is there; an image that is
/// asked for while the scene is still being built would come when the machine is ready, not when the mission says.
fn await_world(context: &Context) -> anyhow::Result<()> {
    let mut health = context.bus.subscriber::<HealthChannel>()?;
    let began = Instant::now();
    while began.elapsed() < WORLD_PATIENCE {
        while let Some(message) = health.receive(0)? {
            let heard = message.header();
            if heard.service == ServiceName::World.code() && heard.state == ServiceState::Running.code() {
                return Ok(());
            }
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    tracing::warn!("the world is not ready; going on without");
    Ok(())
}
