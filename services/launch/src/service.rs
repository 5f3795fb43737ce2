//! `vantage <service>`: one process in the foreground.

use std::ffi::CString;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use shared_types::ServiceName;
use shared_types::channel::HealthChannel;
use shared_types::config::{Config, Layer, load};
use shared_types::folder::write_atomic;
use shared_types::messages::ServiceState;
use shared_types::post_mortem::{self, About};
use shared_types::service::Context;
use shared_types::system::{Hold, System, SystemError};
use shared_types::trace;

use crate::cli::Service;
use crate::exit::Refusal;
use crate::replay::alone::Played;
use crate::settings;
use crate::supervise::plan::apply_scheduling;

/// Joins the system that was named (or the only one; a name that no system has makes one), and runs the service until it
/// is asked to stop.
///
/// # Errors
/// Bad configuration, no system, no shared memory, and whatever the service cannot go on with.
pub fn run(name: ServiceName, arguments: &Service) -> anyhow::Result<()> {
    // What `top` and `perf` show; threads that are started later have names of their own.
    if let Ok(text) = CString::new(name.name())
        && let Err(error) = rustix::thread::set_name(&text)
    {
        tracing::debug!(%error, "the process keeps its name");
    }
    shared_types::memory::give_back_freed_memory();
    let played = arguments.input.as_deref().map(|input| Played::begin(name, input)).transpose()?;
    apply_scheduling(name);
    let (system, config, made) = match &played {
        Some(played) => played.join()?,
        None => join(arguments)?,
    };
    let left_behind = arguments.supervised.then(|| system.clone());
    if system.version != env!("CARGO_PKG_VERSION") {
        return Err(Refusal::missing(format!(
            "system {} was made by Vantage {}, expected {}; stop it and start all services with one version",
            system.name,
            system.version,
            env!("CARGO_PKG_VERSION")
        )));
    }
    leave_traces(name, &config, &system)?;
    // Before the bus: joining it may wait for what only the keeper removes.
    let sweeping = if name == ServiceName::Keeper { Some(keeper::sweep(&system)?) } else { None };
    let context = Context::open(name, config, system, arguments.supervised)?;
    tracing::info!(service = %name, system = %context.system.name, pid = std::process::id(), "started");
    let result = dispatch(name, context, sweeping).with_context(|| format!("{name} cannot go on"));
    tracing::info!(service = %name, ok = result.is_ok(), "ended");
    drop(made);
    if let Some(system) = left_behind {
        clean_up(&system);
    }
    result
}

/// Sees to what a panic leaves: a report beside the logs, and on request the process itself or its core.
fn leave_traces(name: ServiceName, config: &Config, system: &System) -> anyhow::Result<()> {
    // Units see the missions of others, and may write into few.
    let mission = Path::new(&config.mission.folder);
    let folder = match rustix::fs::access(mission, rustix::fs::Access::WRITE_OK) {
        Ok(()) => mission.join("logs"),
        Err(_) => system.runtime_dir.clone(),
    };
    // A process that is held is there itself.
    let dump_core = config.launch.core_dumps && !config.launch.hold_on_fault;
    if dump_core {
        match post_mortem::allow_core_dumps() {
            Ok(Some(0)) => tracing::warn!("launch.core_dumps: the system allows none (ulimit -Hc is 0)"),
            Ok(_) => {}
            Err(error) => tracing::warn!(%error, "launch.core_dumps: the limit cannot be raised"),
        }
    }
    if config.launch.trace
        && !config.mission.folder.is_empty()
        && let Err(error) = trace::begin(&Path::new(&config.mission.folder).join("trace"), name.name())
    {
        tracing::warn!(%error, "launch.trace: the trace of this process cannot be written");
    }
    let about = About { service: name.name(), folder, config: load::to_toml(config)?, dump_core };
    post_mortem::report_panics(about);
    if config.launch.hold_on_fault {
        hold_panics();
    }
    Ok(())
}

/// From now on a panic stops this process where it is, for a debugger; SIGCONT lets it die.
fn hold_panics() {
    let tell = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        tell(panic);
        let pid = rustix::process::getpid();
        tracing::error!(pid = pid.as_raw_nonzero().get(), "a panic is held for a debugger: `gdb -p PID`, then SIGCONT");
        if let Err(error) = rustix::process::kill_process(pid, rustix::process::Signal::STOP) {
            tracing::error!(%error, "this process cannot be stopped");
        }
    }));
}

/// What launch does at the end, where it is gone: the last service to end removes the system.
fn clean_up(system: &System) {
    let parent = rustix::process::getppid().map_or(0, |pid| pid.as_raw_nonzero().get().unsigned_abs());
    if system.supervisor_pid == 0 || system.supervisor_pid == parent {
        return;
    }
    match system.remove_if_dead() {
        Ok(true) => tracing::info!(system = %system.name, "removed what its supervisor left"),
        // Others are still there, and see to it.
        Ok(false) => {}
        Err(error) => tracing::warn!(%error, "the system's folder could not be removed"),
    }
}

/// How long a system may be in the making by another service that was started at the same time.
const MAKING: Duration = Duration::from_secs(2);

/// The system and its resolved configuration. Made where there is none of that name; of several services started at once,
/// one makes it and the others join.
///
/// Who made it holds it from then on: otherwise another, that saw nothing an instant before, would take it for dead.
fn join(arguments: &Service) -> anyhow::Result<(System, Config, Option<Hold>)> {
    join_below(&System::base_dir(), arguments)
}

fn join_below(base: &Path, arguments: &Service) -> anyhow::Result<(System, Config, Option<Hold>)> {
    let began = Instant::now();
    loop {
        let waited = began.elapsed() > MAKING;
        let to_make = arguments.system.as_deref().filter(|name| !name.contains('/'));
        match (System::find(base, arguments.system.as_deref()), to_make) {
            (Ok(system), _) if system.config_path().exists() || waited => {
                let config = load(&[Layer::of_file(&system.config_path())?])?;
                return Ok((system, config, None));
            }
            (Ok(_), _) => {}
            (Err(error), Some(name)) if error.is_absent() => {
                // A folder without a description is being made, or was left by a maker that was killed.
                if !base.join(name).exists() || waited {
                    let config = settings::resolve(&arguments.settings)?;
                    match System::create_held(base, name, 0) {
                        Ok((system, hold)) => {
                            let text = shared_types::config::load::to_toml(&config)?;
                            write_atomic(&system.config_path(), text.as_bytes())?;
                            return Ok((system, config, Some(hold)));
                        }
                        // Another was quicker.
                        Err(SystemError::Runs { .. }) if !waited => {}
                        Err(error) => return Err(error.into()),
                    }
                }
            }
            (Err(error), _) => return Err(error.into()),
        }
        std::thread::sleep(Duration::from_millis(10));
    }
}

fn dispatch(name: ServiceName, mut context: Context, sweeping: Option<keeper::Sweeping>) -> anyhow::Result<()> {
    match name {
        ServiceName::Keeper => match sweeping {
            Some(sweeping) => keeper::run(context, sweeping),
            None => Err(anyhow::anyhow!("the keeper does not sweep")),
        },
        ServiceName::Simulator => {
            // Alone (for other ground stations, or to try something), it runs free; in a mission it waits for its members.
            let members = if in_a_mission(&context) { ServiceName::members(&context.config) } else { Vec::new() };
            simulator::run(&mut context, &members).map_err(|error| match error.exit_code() {
                64 => Refusal::usage(error.to_string()),
                69 => Refusal::missing(error.to_string()),
                _ => error.into(),
            })
        }
        ServiceName::World => world::run(context),
        ServiceName::Px4Link => px4_link::run(context),
        ServiceName::Camera => {
            if in_a_mission(&context) && context.config.link.is_local() {
                await_world(&context)?;
            }
            camera::run(context)
        }
        ServiceName::Trainer => trainer::run(context),
        ServiceName::Scorer => scorer::run(context),
        ServiceName::Planner => planner::run(context),
        ServiceName::Recorder => recorder::run(context),
        ServiceName::Command | ServiceName::Launch => Err(Refusal::usage(format!("{name} is no service"))),
    }
}

/// Whether the others of a mission are there, or will be: under launch, or under another supervisor that was prepared for.
fn in_a_mission(context: &Context) -> bool {
    context.supervised || !context.config.mission.folder.is_empty()
}

/// How long the camera waits for the world's scene before it goes on without.
const WORLD_PATIENCE: Duration = Duration::from_secs(30);

/// Waits until the world has built its scene. Simulated time does not begin before the camera is there; an image that is
/// asked for while the scene is still being built would come when the machine is ready, not when the mission says.
fn await_world(context: &Context) -> anyhow::Result<()> {
    let mut health = context.bus.subscriber::<HealthChannel>()?;
    let began = Instant::now();
    // Without a supervisor nobody waits for this camera: its loop sees to the rest.
    while began.elapsed() < WORLD_PATIENCE && !context.orphaned() {
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

#[cfg(test)]
mod tests {
    use super::*;

    fn arguments(system: &str) -> Service {
        let settings = crate::cli::Settings { preset: "tiny".to_owned(), ..crate::cli::Settings::default() };
        Service { settings, system: Some(system.to_owned()), supervised: false, standalone: false, input: None }
    }

    #[test]
    fn services_that_start_at_once_join_one_system() {
        let base = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
        let joined: Vec<_> = std::thread::scope(|scope| {
            let start = || join_below(base.path(), &arguments("lab")).expect("joined");
            let threads: Vec<_> = (0..8).map(|_| scope.spawn(start)).collect();
            threads.into_iter().map(|thread| thread.join().expect("no panic")).collect()
        });
        assert!(joined.iter().all(|(system, ..)| *system == joined[0].0), "{joined:?}");
        assert_eq!(joined.iter().filter(|(.., made)| made.is_some()).count(), 1);
    }

    #[test]
    fn a_system_whose_description_cannot_be_read_is_not_made_anew() {
        let base = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
        std::fs::create_dir(base.path().join("lab")).expect("made");
        std::fs::write(base.path().join("lab/system.json"), "{").expect("written");
        let error = join_below(base.path(), &arguments("lab")).expect_err("malformed");
        assert!(error.to_string().contains("system.json"), "{error}");
        assert_eq!(std::fs::read(base.path().join("lab/system.json")).expect("kept"), b"{");
    }
}
