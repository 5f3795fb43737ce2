//! From the command line to a configuration.

use std::path::{Path, PathBuf};

use shared_types::config::{Config, ConfigError, Layer, load};

use crate::cli::Settings;
use crate::exit::Refusal;

/// The layers of the command line, the lowest first.
///
/// # Errors
/// Unknown preset, unreadable file, malformed `--set`.
pub fn layers(settings: &Settings) -> Result<Vec<Layer>, ConfigError> {
    let mut layers = vec![Layer::of_preset(&settings.preset)?];
    if let Some(path) = &settings.config {
        layers.push(Layer::of_file(path)?);
    }
    for set in &settings.sets {
        layers.push(Layer::of_set(set)?);
    }
    Ok(layers)
}

/// The configuration of the command line.
///
/// # Errors
/// As [`layers`], and everything that [`load`] refuses.
pub fn resolve(settings: &Settings) -> Result<Config, ConfigError> {
    let mut config = load(&layers(settings)?)?;
    if config.mission.preset.is_empty() {
        config.mission.preset.clone_from(&settings.preset);
    }
    Ok(config)
}

/// What `vantage resume` flies with: the mission's file, and keys of this flight. What the journal and the keyframes were
/// made with stays.
///
/// # Errors
/// Malformed `--set`, or one of a section that stays.
pub fn relaid(mission: &Path, sets: &[String]) -> anyhow::Result<Vec<Layer>> {
    let mut layers = vec![Layer::of_file(mission)?];
    for set in sets {
        let section = set.split('.').next().unwrap_or_default();
        if ["mission", "planner", "camera", "world"].contains(&section) {
            return Err(Refusal::usage(format!(
                "--set {set}: expected a key of another section than [{section}], which a mission that has begun keeps; \
                 `vantage fly` flies a new one"
            )));
        }
        layers.push(Layer::of_set(set)?);
    }
    Ok(layers)
}

/// A path made absolute against the present folder, without asking the disk.
///
/// # Errors
/// When the present folder is gone.
pub fn absolute(path: &Path) -> std::io::Result<PathBuf> {
    std::path::absolute(path)
}
