//! `vantage fly` and `vantage resume`: a whole mission, from its folder to its report.

use std::fs::File;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use rustix::fs::{FlockOperation, flock};
use shared_types::config::{Config, Layer, LinkConfig, load, load_mission};
use shared_types::folder::{MissionFolder, write_atomic};
use shared_types::messages::EndReason;
use shared_types::system::{Hold, System};
use shared_types::{ServiceName, stage, trace};
use world::SceneConfig;
use world::mesh::{Mesh, Placement};

use crate::cli::{Fly, Resume};
use crate::clock::date_stamp;
use crate::exit::{Exit, Refusal};
use crate::instance::{self, Claim};
use crate::machine_check::check_machine;
use crate::progress::Progress;
use crate::supervise::children::Starter;
use crate::supervise::{self, Flight, Outcome};
use crate::{evaluate, print, say, settings, summary, timeline};

/// Flies a new mission.
///
/// # Errors
/// Everything that keeps a mission from beginning, with the right exit code. How a flown mission went is the exit code
/// returned.
pub fn fly(arguments: &Fly) -> anyhow::Result<Exit> {
    let mut config = configure(arguments)?;
    // The ports are this run's and not the mission's: the folder keeps what was asked for, so that `resume` may have others.
    let text = load::to_toml(&config)?;
    let claim = claim_instance(&mut config)?;
    check_machine(Path::new(&config.mission.folder), &config)?;
    let folder = MissionFolder::create_with(&config.mission.folder, &text)?;
    let name = arguments.system.clone().unwrap_or_else(|| format!("fly-{}", std::process::id()));
    mission(&folder, &config, &name, arguments.json, claim)
}

/// Goes on with a mission that was cut off.
///
/// # Errors
/// As [`fly`]; also when the folder holds no mission, or another process flies it.
pub fn resume(arguments: &Resume) -> anyhow::Result<Exit> {
    let folder = MissionFolder::open(&arguments.folder)?;
    let mut config = load_mission(&folder.config_path())?;
    if !arguments.sets.is_empty() {
        config = load(&settings::relaid(&folder.config_path(), &arguments.sets)?)?;
    }
    config.mission.folder = utf8(folder.root())?;
    if let Some(speed) = arguments.speed {
        config.clock.speed = speed;
    }
    let journal = evaluate::journal::read(&folder.journal_path())?;
    if let Some(usable) = journal.over {
        return already_over(&folder, &config, usable, arguments.json);
    }
    if let Some(last_ns) = journal.last_ns {
        // A folder's mission clock never goes back.
        config.mission.epoch_ns = last_ns + shared_types::NS_PER_S;
    }
    if let Some(problem) = config.problems().first() {
        return Err(Refusal::usage(format!("{} = {}: expected {}", problem.key, problem.value, problem.expected)));
    }
    check_object(&config)?;
    config.mission.version = env!("CARGO_PKG_VERSION").to_owned();
    let claim = claim_instance(&mut config)?;
    check_machine(folder.root(), &config)?;
    mission(&folder, &config, &format!("fly-{}", std::process::id()), arguments.json, claim)
}

/// Nothing of a mission that is over is flown again: its figures are shown, and measured where a kill came before that.
fn already_over(folder: &MissionFolder, config: &Config, usable: bool, json: bool) -> anyhow::Result<Exit> {
    say(&format!("the mission in {} is over; `vantage fly` flies a new one", folder.root().display()));
    // Its launch may have been killed while it removed the system.
    sweep_dead_systems();
    if !usable {
        return Ok(Exit::Failed);
    }
    let metrics = match evaluate::read_metrics(folder)? {
        Some(metrics) => metrics,
        None => {
            let metrics = evaluate::measure(folder, config, evaluate::Effort::of(config), None)?;
            evaluate::write_metrics(folder, &metrics)?;
            metrics
        }
    };
    print(&if json { evaluate::to_json(&metrics)? } else { summary::table(&metrics, folder.root()) })
}

/// The configuration of a new mission, complete.
fn configure(arguments: &Fly) -> anyhow::Result<Config> {
    let mut layers = settings::layers(&arguments.settings)?;
    if let Some(object) = &arguments.object {
        let path = settings::absolute(object)?;
        layers.push(set_text("world", "object", &utf8(&path)?));
    }
    if let Some(seed) = arguments.seed {
        layers.push(Layer {
            name: format!("--seed {seed}"),
            text: format!("mission.seed = {seed}\n"),
            has_lines: false,
        });
    }
    if let Some(speed) = arguments.speed {
        layers.push(Layer {
            name: format!("--speed {speed}"),
            text: format!("clock.speed = {speed:?}\n"),
            has_lines: false,
        });
    }
    let mut config = load(&layers)?;
    config.launch.trace |= arguments.trace;
    check(&config)?;
    config.mission.preset.clone_from(&arguments.settings.preset);
    config.mission.version = env!("CARGO_PKG_VERSION").to_owned();
    if config.mission.id.is_empty() {
        config.mission.id = match &arguments.output {
            // A name that does not tell the time: the same command in another minute is the same mission.
            Some(_) => format!("mission-{}", config.mission.seed),
            None => format!("{}-{}", date_stamp(), config.mission.seed),
        };
    }
    let folder = match &arguments.output {
        Some(output) => output.clone(),
        None if config.mission.folder.is_empty() => Path::new("missions").join(&config.mission.id),
        None => PathBuf::from(&config.mission.folder),
    };
    config.mission.folder = utf8(&settings::absolute(&folder)?)?;
    if config.mission.folder.len() > 255 {
        let problem = format!(
            "mission folder {}: {} bytes, expected at most 255",
            config.mission.folder,
            config.mission.folder.len()
        );
        return Err(Refusal::usage(problem));
    }
    Ok(config)
}

/// Refuses what could not be flown, before anything is made.
///
/// # Errors
/// No source of images, or an object that the world could not show.
pub(crate) fn check(config: &Config) -> anyhow::Result<()> {
    check_camera(config)?;
    check_object(config)
}

/// Refuses a vehicle that nothing here can see with: it would take off, take no view and land.
fn check_camera(config: &Config) -> anyhow::Result<()> {
    if config.link.is_local() {
        return Ok(());
    }
    Err(Refusal::missing(format!(
        "link.url = {}: expected the embedded simulator (127.0.0.1): the only source of images is the simulator's world; \
         `vantage px4-link --set link.url={}` speaks with the vehicle alone",
        config.link.url, config.link.url
    )))
}

/// Refuses an object that the world could not show or the prior could not hold, before anything is made.
fn check_object(config: &Config) -> anyhow::Result<()> {
    let world = &config.world;
    if !config.link.is_local() {
        return Ok(());
    }
    let largest_m = config.planner.box_max_m - config.planner.box_margin_m;
    if world.size_m > largest_m {
        return Err(Refusal::usage(format!(
            "world.size_m = {}: expected at most {largest_m} (planner.box_max_m less planner.box_margin_m): an object that the \
             prior's box cannot hold is cut off; make it smaller, or raise planner.box_max_m",
            world.size_m
        )));
    }
    if world.object != "rock" {
        let scene = SceneConfig::of(config);
        let placement = Placement { size_m: scene.size_m, yaw_deg: scene.yaw_deg, up: scene.up };
        Mesh::load(Path::new(&scene.object), &placement).map_err(|error| Refusal::usage(error.to_string()))?;
    }
    Ok(())
}

fn set_text(section: &str, key: &str, value: &str) -> Layer {
    Layer {
        name: format!("--{key} {value}"),
        text: format!("{section}.{key} = {}\n", toml::Value::String(value.to_owned())),
        has_lines: false,
    }
}

pub(crate) fn utf8(path: &Path) -> anyhow::Result<String> {
    path.to_str()
        .map(str::to_owned)
        .ok_or_else(|| Refusal::usage(format!("{}: expected a path in UTF-8", path.display())))
}

/// Claims the ports of a simulated mission: the first free instance, unless the configuration names an address of its own.
fn claim_instance(config: &mut Config) -> anyhow::Result<Option<Claim>> {
    if !config.link.is_local() {
        return Ok(None);
    }
    let address = config.link.url != LinkConfig::default().url;
    if let Ok(wanted) = u16::try_from(config.simulator.instance) {
        let claim = instance::claim(wanted);
        if !address {
            config.link.url = format!("udpin:127.0.0.1:{}", 14540 + wanted);
        }
        return claim.map(Some).ok_or_else(|| {
            let ports = instance::ports_of(wanted).map(|port| port.to_string()).join(", ");
            Refusal::missing(format!(
                "ports {ports} (instance {wanted}): in use; expected them free: end what uses them (`vantage status`, `ss -lupn`) \
                 or set simulator.instance"
            ))
        });
    }
    if address {
        // An address of its own: who speaks there is not known here, and nothing is claimed.
        return Ok(None);
    }
    let claim = instance::claim_first().ok_or_else(|| {
        Refusal::missing(
            "ports 14540-14549, 14580-14589, 18570-18579: no instance has all three free; expected one of ten: end what uses \
             them (`vantage status`, `ss -lupn`)",
        )
    })?;
    config.simulator.instance = i32::from(claim.instance);
    config.link.url = format!("udpin:127.0.0.1:{}", 14540 + claim.instance);
    Ok(Some(claim))
}

/// Removes the systems of launches that were killed together with all their services.
fn sweep_dead_systems() {
    for system in System::list(&System::base_dir()) {
        let launch = i32::try_from(system.supervisor_pid).ok().and_then(rustix::process::Pid::from_raw);
        let runs = launch.is_some_and(|pid| rustix::process::test_kill_process(pid).is_ok());
        if launch.is_none() || runs {
            continue;
        }
        match system.remove_if_dead() {
            Ok(true) => tracing::info!(system = %system.name, "removed what a launch that was killed left"),
            Ok(false) => {}
            Err(error) => tracing::warn!(%error, "a dead system could not be removed"),
        }
    }
}

/// A system that is removed when the run is over, however it ends; unless services of it still bring a vehicle home.
struct Owned {
    system: System,
    hold: Option<Hold>,
}

impl Drop for Owned {
    fn drop(&mut self) {
        self.hold = None;
        match self.system.remove_if_dead() {
            Ok(true) => {}
            Ok(false) => say(&format!(
                "system {} is left to its services, which land the vehicle, end and remove it",
                self.system.name
            )),
            Err(error) => tracing::warn!(%error, "the system's folder could not be removed"),
        }
    }
}

fn mission(
    folder: &MissionFolder,
    config: &Config,
    system: &str,
    json: bool,
    claim: Option<Claim>,
) -> anyhow::Result<Exit> {
    if config.launch.trace {
        trace::begin(&folder.trace_path(), ServiceName::Launch.name())
            .with_context(|| format!("launch.trace: {}", folder.trace_path().display()))?;
    }
    let lock = File::open(folder.root())?;
    if flock(&lock, FlockOperation::NonBlockingLockExclusive).is_err() {
        return Err(Refusal::missing(format!(
            "{}: another process flies this mission; wait for it, or end it",
            folder.root().display()
        )));
    }
    sweep_dead_systems();
    let mut progress = Progress::new();
    let flight = {
        let (system, hold) = System::create_held(&System::base_dir(), system, std::process::id())?;
        let owned = Owned { system, hold: Some(hold) };
        let system = &owned.system;
        write_atomic(&system.config_path(), load::to_toml(config)?.as_bytes())?;
        let starter = Starter {
            program: std::env::current_exe().context("cannot find the vantage binary")?,
            system_folder: system.runtime_dir.clone(),
            logs: folder.root().join("logs"),
            log_level: config.launch.log_level.clone(),
        };
        progress.say(&format!("mission {} in {}", config.mission.id, folder.root().display()));
        let stage = stage!("fly");
        let mut flight = supervise::run(system, config, starter, &mut progress)?;
        drop(stage);
        if config.mission.epoch_ns > 0 {
            // What the wall's clock cut off does not repeat.
            flight.deterministic = Some(false);
        }
        flight
    };
    drop(claim);
    finish(folder, config, &flight, &mut progress, json)
}

/// What is left to do on the ground: measures, writes the report, tells the user.
fn finish(
    folder: &MissionFolder,
    config: &Config,
    flight: &Flight,
    progress: &mut Progress,
    json: bool,
) -> anyhow::Result<Exit> {
    // A disk that is full now is told, and does not hide how the mission went.
    if let Err(error) = evaluate::flight::write(folder, flight) {
        say(&format!("vantage: the figures of this run are not kept: {error:#}"));
    }
    progress.doing("measuring the model against held-out views");
    let stage = stage!("evaluate");
    let metrics = evaluate::measure(folder, config, evaluate::Effort::of(config), None);
    drop(stage);
    progress.clear();
    if config.launch.trace
        && let Err(error) = timeline::write(folder)
    {
        say(&format!("vantage: the trace is not kept: {error:#}"));
    }
    match metrics {
        Ok(metrics) => {
            if let Err(error) = evaluate::write_metrics(folder, &metrics) {
                say(&format!("vantage: the metrics are not kept: {error:#}; `vantage evaluate` measures again"));
            }
            let text = if json { evaluate::to_json(&metrics)? } else { summary::table(&metrics, folder.root()) };
            print(&text)?;
        }
        Err(error) => say(&format!("vantage: not measured: {error:#}")),
    }
    verdict(folder, flight)
}

/// The exit code of a flown mission.
fn verdict(folder: &MissionFolder, flight: &Flight) -> anyhow::Result<Exit> {
    let resume = format!("`vantage resume {}`", folder.root().display());
    let logs = folder.root().join("logs");
    match &flight.outcome {
        Outcome::Done => Ok(Exit::Ok),
        Outcome::Failed if flight.last.as_ref().and_then(supervise::run::end_reason) == Some(EndReason::Misaligned) => {
            let why = evaluate::journal::read(&folder.journal_path())?.misaligned;
            let why = why.as_deref().unwrap_or("no reason given");
            let way_out =
                format!("put it back as it was, and {resume} goes on; what was taken is there, `vantage evaluate`");
            Err(Refusal::failed(format!("the mission is not gone on with: {why}; {way_out} measures it")))
        }
        Outcome::Failed => {
            let reason = flight
                .last
                .as_ref()
                .and_then(supervise::run::end_reason)
                .map_or("no reason given", |reason| reason.name());
            Err(Refusal::failed(format!(
                "the mission ended without a usable model ({reason}); logs in {}",
                logs.display()
            )))
        }
        Outcome::Aborted => {
            Err(Refusal::failed(format!("stopped at once: the vehicle was told to hold where it is; {resume} goes on")))
        }
        Outcome::NotLanded => {
            Err(Refusal::failed(format!("the vehicle did not land in time; logs in {}", logs.display())))
        }
        Outcome::Broken { service, code, worked } => {
            let words = flight.last_words.as_deref().unwrap_or("it left no message");
            let exit = match (code, worked) {
                (Some(64), false) => Exit::Usage,
                (Some(69), false) => Exit::Missing,
                (_, true) => Exit::Failed,
                _ => Exit::Internal,
            };
            let message = format!(
                "{service}: {words}\nlog: {}; when that is mended, {resume} goes on",
                logs.join(format!("{service}.log")).display()
            );
            Err(Refusal { exit, message }.into())
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;
    use shared_types::config::ConfigError;

    use super::*;
    use crate::cli::{Cli, Command};

    fn arguments(line: &str) -> Fly {
        match Cli::try_parse_from(line.split_whitespace()).expect("parses").command {
            Command::Fly(fly) => fly,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn arguments_become_an_absolute_complete_configuration() {
        let config =
            configure(&arguments("vantage fly --preset tiny --output out --seed 7 --speed 2 --set planner.batch=2"))
                .expect("valid");
        assert_eq!((config.mission.seed, config.clock.speed, config.planner.batch), (7, 2.0, 2));
        assert_eq!((config.mission.id.as_str(), config.mission.preset.as_str()), ("mission-7", "tiny"));
        assert!(Path::new(&config.mission.folder).is_absolute() && config.mission.folder.ends_with("/out"));
        assert_eq!(config.mission.version, env!("CARGO_PKG_VERSION"));
    }

    #[test]
    fn a_mesh_that_cannot_be_read_is_refused_before_anything_is_made() {
        let error = configure(&arguments("vantage fly --object /nonexistent/a.obj")).expect_err("no mesh");
        assert_eq!(crate::exit::exit_of(&error), Exit::Usage);
        assert!(error.to_string().contains("/nonexistent/a.obj"));
        let dir = tempfile::tempdir().expect("folder");
        let bad = [
            ("empty.obj", ""),
            ("nan.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
            ("points.obj", "v 0 0 0\nv 1 0 0\n"),
        ];
        for (name, text) in bad {
            let path = dir.path().join(name);
            std::fs::write(&path, text).expect("written");
            let error =
                configure(&arguments(&format!("vantage fly --object {}", path.display()))).expect_err("bad mesh");
            assert_eq!(crate::exit::exit_of(&error), Exit::Usage);
            assert!(error.to_string().contains(name), "{error}");
        }
        let error = configure(&arguments("vantage fly --set world.size_m=3.9")).expect_err("too large");
        assert!(error.to_string().contains("planner.box_max_m"), "{error}");
        let error = configure(&arguments("vantage fly --set link.url=udpin:0.0.0.0:14540")).expect_err("no camera");
        assert_eq!(crate::exit::exit_of(&error), Exit::Missing);
        let error = configure(&arguments("vantage fly --speed -3")).expect_err("negative");
        assert!(
            error.downcast_ref::<ConfigError>().is_some_and(|e| e.to_string().starts_with("--speed -3: clock.speed"))
        );
    }

    #[test]
    fn a_broken_run_has_the_exit_code_of_what_broke_it() {
        let dir = tempfile::tempdir().expect("folder");
        let folder = MissionFolder::create(dir.path().join("m")).expect("made");
        let flight = |code, worked| Flight {
            outcome: Outcome::Broken { service: shared_types::ServiceName::World, code, worked },
            last: None,
            mission_s: None,
            wall_s: 1.0,
            restarts: std::collections::BTreeMap::new(),
            deterministic: None,
            memory: supervise::memory::Memory::default(),
            score_ms: Vec::new(),
            last_words: Some("mesh a.obj: no triangles".to_owned()),
        };
        let exit = |code, worked| crate::exit::exit_of(&verdict(&folder, &flight(code, worked)).expect_err("broken"));
        assert_eq!(exit(Some(64), false), Exit::Usage);
        assert_eq!(exit(Some(69), false), Exit::Missing);
        assert_eq!(exit(Some(69), true), Exit::Failed);
        assert_eq!(exit(None, false), Exit::Internal);
        let message = verdict(&folder, &flight(Some(64), false)).expect_err("broken").to_string();
        assert!(
            message.starts_with("world: mesh a.obj: no triangles\n") && message.contains("vantage resume"),
            "{message}"
        );
    }
}
