//! `vantage prepare`: what launch does before it starts the services, for another supervisor that starts them, such as
//! systemd: looks at the machine, opens a mission folder, and makes the system that the services join.

use std::path::{Path, PathBuf};

use shared_types::config::{Config, LinkConfig, load_mission};
use shared_types::folder::{MissionFolder, write_atomic};
use shared_types::system::System;

use crate::cli::Prepare;
use crate::clock::date_stamp;
use crate::exit::{Exit, Refusal};
use crate::machine_check::check_machine;
use crate::{evaluate, fly, print, settings};

/// Where missions go when nobody says where: systemd's `StateDirectory=`, or the folder that the package makes.
const MISSIONS: &str = "/var/lib/vantage/missions";

/// Prepares a mission: a new one, or the newest one where that was cut off.
///
/// # Errors
/// When the configuration or the machine does not allow a mission, or a system of that name runs.
pub fn run(arguments: &Prepare) -> anyhow::Result<Exit> {
    let wanted = settings::resolve(&arguments.settings)?;
    let (folder, mut config) = match unfinished(&wanted)? {
        Some((folder, config)) => (folder, config),
        None => new(wanted)?,
    };
    if config.link.is_local() && config.link.url == LinkConfig::default().url {
        // Nobody claims ports for others: the first instance's, or those that are configured.
        let instance = config.simulator.instance.max(0);
        config.simulator.instance = instance;
        config.link.url = format!("udpin:127.0.0.1:{}", 14540 + instance);
    }
    forget_exits(&System::base_dir());
    let text = shared_types::config::load::to_toml(&config)?;
    let system = System::create(&System::base_dir(), &arguments.system, 0)?;
    write_atomic(&system.config_path(), text.as_bytes())?;
    print(&format!(
        "mission {} in {}\nsystem {}\n",
        config.mission.id,
        folder.root().display(),
        system.runtime_dir.display()
    ))
}

/// Removes what units keep of how services of an earlier mission ended (`ExecStopPost=`).
fn forget_exits(base: &Path) {
    let files = std::fs::read_dir(base).into_iter().flatten().flatten().map(|entry| entry.path());
    for path in files.filter(|path| path.extension().is_some_and(|extension| extension == "exit")) {
        if let Err(error) = std::fs::remove_file(&path) {
            tracing::warn!(path = %path.display(), %error, "cannot be removed; a service may take its last life for a crash");
        }
    }
}

/// The folder that holds missions.
fn missions() -> PathBuf {
    match std::env::var_os("STATE_DIRECTORY") {
        Some(state) => Path::new(&state).join("missions"),
        None => PathBuf::from(MISSIONS),
    }
}

fn new(mut config: Config) -> anyhow::Result<(MissionFolder, Config)> {
    fly::check(&config)?;
    config.mission.version = env!("CARGO_PKG_VERSION").to_owned();
    if config.mission.id.is_empty() {
        config.mission.id = format!("{}-{}", date_stamp(), config.mission.seed);
    }
    if config.mission.folder.is_empty() {
        config.mission.folder = fly::utf8(&missions().join(&config.mission.id))?;
    }
    check_machine(Path::new(&config.mission.folder), &config)?;
    let folder = MissionFolder::create_with(&config.mission.folder, &shared_types::config::load::to_toml(&config)?)?;
    Ok((folder, config))
}

/// The newest mission, where it was begun and cut off: by a power cut, or by whoever stopped the services. The folder that
/// the configuration names is the only one that counts where it names one.
fn unfinished(wanted: &Config) -> anyhow::Result<Option<(MissionFolder, Config)>> {
    let newest = if wanted.mission.folder.is_empty() {
        let mut folders: Vec<PathBuf> = std::fs::read_dir(missions())
            .into_iter()
            .flatten()
            .flatten()
            .map(|entry| entry.path())
            .filter(|path| path.join("mission.toml").is_file())
            .collect();
        // Their names begin with their dates.
        folders.sort();
        folders.pop()
    } else {
        Some(PathBuf::from(&wanted.mission.folder)).filter(|folder| folder.join("mission.toml").is_file())
    };
    let Some(path) = newest else { return Ok(None) };
    let folder = MissionFolder::open(&path)?;
    let journal = evaluate::journal::read(&folder.journal_path())?;
    match (journal.over, journal.last_ns) {
        (None, Some(last_ns)) => {
            let mut config = load_mission(&folder.config_path())?;
            config.mission.folder = fly::utf8(folder.root())?;
            // A folder's mission clock never goes back.
            config.mission.epoch_ns = last_ns + shared_types::NS_PER_S;
            check_machine(folder.root(), &config)?;
            Ok(Some((folder, config)))
        }
        _ if wanted.mission.folder.is_empty() => Ok(None),
        _ => Err(Refusal::usage(format!(
            "mission.folder = {}: holds a mission that is over or never began; expected another, or none, for a folder of \
             its own in {}",
            wanted.mission.folder,
            missions().display()
        ))),
    }
}
