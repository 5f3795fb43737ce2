//! `vantage <service> --standalone --input RECORDING`: a service alone in the foreground, for a debugger or a profiler.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use shared_types::ServiceName;
use shared_types::config::{Config, Layer, load};
use shared_types::system::{Hold, System};

use crate::exit::Refusal;

/// The recording that a service alone runs on: played by a process of its own, so that this one holds nothing but the service.
#[derive(Debug)]
pub struct Played {
    system: String,
    player: std::process::Child,
}

impl Played {
    /// Starts the player for one service.
    ///
    /// # Errors
    /// When the process cannot be started.
    pub fn begin(name: ServiceName, input: &Path) -> anyhow::Result<Self> {
        let system = format!("alone-{}", std::process::id());
        let player = std::process::Command::new(std::env::current_exe().context("cannot find the vantage binary")?)
            .arg("replay")
            .arg(input)
            .args(["--services", name.name(), "--system", &system, "--joined"])
            .spawn()
            .context("cannot start the player")?;
        Ok(Self { system, player })
    }

    /// The player's system, once it is there.
    ///
    /// # Errors
    /// When the player has ended, having said why, or takes too long.
    pub fn join(&self) -> anyhow::Result<(System, Config, Option<Hold>)> {
        let began = Instant::now();
        loop {
            if let Ok(system) = System::find(&System::base_dir(), Some(&self.system))
                && system.config_path().exists()
            {
                let config = load(&[Layer::of_file(&system.config_path())?])?;
                return Ok((system, config, None));
            }
            let player = i32::try_from(self.player.id()).ok().and_then(rustix::process::Pid::from_raw);
            let gone = player.is_none_or(|pid| {
                rustix::process::waitid(
                    rustix::process::WaitId::Pid(pid),
                    rustix::process::WaitIdOptions::EXITED
                        | rustix::process::WaitIdOptions::NOHANG
                        | rustix::process::WaitIdOptions::NOWAIT,
                )
                .is_ok_and(|status| status.is_some())
            });
            if gone || began.elapsed() > PLAYER_PATIENCE {
                return Err(Refusal::missing("the player of --input did not begin; its message is above"));
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

impl Drop for Played {
    /// The player has dismissed this service, or the service ends before it: then nobody is left to play for.
    fn drop(&mut self) {
        let began = Instant::now();
        while matches!(self.player.try_wait(), Ok(None)) {
            if began.elapsed() > PLAYER_PATIENCE {
                self.player.kill().ok();
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

/// How long the player gets to begin, and to end.
const PLAYER_PATIENCE: Duration = Duration::from_secs(5);
