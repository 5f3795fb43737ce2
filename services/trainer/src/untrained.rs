//! The model as inserted and never trained: the floor beside which a trained model is judged (`psnr_init_db`).

use shared_types::config::Config;
use shared_types::folder::MissionFolder;
use splatting::{Engine, Gaussians};

use crate::checkpoint;
use crate::session::Session;

/// Inserts all keyframes of a mission's last round at once, with the mission's own rules and box, and trains nothing.
/// `None` for a folder without a finished round.
///
/// # Errors
/// When a keyframe cannot be read, or the renderer's thread cannot be started.
pub fn untrained(folder: &MissionFolder, config: &Config) -> anyhow::Result<Option<Gaussians>> {
    let Some(last) = checkpoint::newest(&folder.model_path(), true).and_then(|last| last.last_round().cloned()) else {
        return Ok(None);
    };
    let mut session = Session::new(config.trainer.clone(), config.model.clone(), Engine::new(1)?);
    session.begin(last, &mut folder.clone())?;
    Ok(Some(session.into_model()))
}
