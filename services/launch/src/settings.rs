//! From the command line to a configuration.

use std::path::{Path, PathBuf};

use shared_types::config::{Config, ConfigError, Layer, load};

use crate::cli::Settings;

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

/// A path made absolute against the present folder, without asking the disk.
///
/// # Errors
/// When the present folder is gone.
pub fn absolute(path: &Path) -> std::io::Result<PathBuf> {
    std::path::absolute(path)
}
