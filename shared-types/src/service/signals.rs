//! SIGTERM and the supervisor's death.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use signal_hook::consts::{SIGINT, SIGTERM};

use super::ServiceError;

/// Tells when this process should end.
pub(super) struct StopSignals {
    raised: Arc<AtomicBool>,
    parent: Option<i32>,
}

impl StopSignals {
    /// SIGTERM asks to stop. Under a supervisor SIGINT is ignored: the terminal sends it to everybody at once, and the
    /// order of stopping is the supervisor's; a service in the foreground of its own takes it like SIGTERM.
    pub(super) fn install(supervised: bool) -> Result<Self, ServiceError> {
        let raised = Arc::new(AtomicBool::new(false));
        let failed = |source: std::io::Error| ServiceError::Other(format!("cannot install signal handlers: {source}"));
        signal_hook::flag::register(SIGTERM, Arc::clone(&raised)).map_err(failed)?;
        let ignored = Arc::new(AtomicBool::new(false));
        signal_hook::flag::register(SIGINT, if supervised { ignored } else { Arc::clone(&raised) }).map_err(failed)?;
        Ok(Self { raised, parent: supervised.then(parent) })
    }

    pub(super) fn raised(&self) -> bool {
        self.raised.load(Ordering::Relaxed)
    }

    /// Whether the supervisor that started this process is gone: the process then has another parent.
    pub(super) fn orphaned(&self) -> bool {
        self.parent.is_some_and(|then| parent() != then)
    }
}

fn parent() -> i32 {
    rustix::process::getppid().map_or(0, rustix::process::Pid::as_raw_pid)
}
