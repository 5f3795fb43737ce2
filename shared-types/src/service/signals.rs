//! SIGTERM and the supervisor's death.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use signal_hook::consts::{SIGINT, SIGTERM};

use super::ServiceError;

/// Tells when this process should end.
pub(super) struct StopSignals {
    raised: Arc<AtomicBool>,
    supervisor: Option<u32>,
}

impl StopSignals {
    /// SIGTERM asks to stop. Under a supervisor SIGINT is ignored: the terminal sends it to everybody at once, and the
    /// order of stopping is the supervisor's; a service in the foreground of its own takes it like SIGTERM.
    pub(super) fn install(supervisor: Option<u32>) -> Result<Self, ServiceError> {
        let raised = Arc::new(AtomicBool::new(false));
        let failed = |source: std::io::Error| ServiceError::Other(format!("cannot install signal handlers: {source}"));
        signal_hook::flag::register(SIGTERM, Arc::clone(&raised)).map_err(failed)?;
        let ignored = Arc::new(AtomicBool::new(false));
        let interrupt = if supervisor.is_some() { ignored } else { Arc::clone(&raised) };
        signal_hook::flag::register(SIGINT, interrupt).map_err(failed)?;
        Ok(Self { raised, supervisor })
    }

    /// Whether a signal waits to be taken.
    pub(super) fn raised(&self) -> bool {
        self.raised.load(Ordering::Relaxed)
    }

    /// Takes the signals that came since the last call; true when there was one.
    pub(super) fn take(&self) -> bool {
        self.raised.swap(false, Ordering::Relaxed)
    }

    /// Whether the supervisor that started this process is gone: the process then has another parent. Compared with the
    /// pid that the system names and not with the parent found at start, which is another already when the supervisor
    /// died in between.
    pub(super) fn orphaned(&self) -> bool {
        self.supervisor.is_some_and(is_gone)
    }
}

/// Whether the supervisor of this pid is no longer this process's parent.
pub(super) fn is_gone(supervisor: u32) -> bool {
    let parent = rustix::process::getppid().map_or(0, rustix::process::Pid::as_raw_pid);
    u32::try_from(parent) != Ok(supervisor)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_supervisor_that_died_before_this_process_looked_is_gone_all_the_same() {
        let parent = rustix::process::getppid().map_or(0, rustix::process::Pid::as_raw_pid);
        let parent = u32::try_from(parent).expect("a pid");
        assert!(!is_gone(parent));
        assert!(is_gone(parent + 1));
        let signals = StopSignals::install(Some(parent + 1)).expect("installed");
        assert!(signals.orphaned() && !signals.take());
    }
}
