//! What systemd is told by a service that it supervises: ready, alive, what it is doing, leaving. Nothing where nobody asked
//! (`NOTIFY_SOCKET` is not set).

use std::time::Duration;

use sd_notify::NotifyState;

use crate::messages::ServiceState;

/// Tells the supervisor of this process, from the service's own loop: a loop that stands tells nothing, and is killed and
/// started again after `WatchdogSec`.
#[derive(Debug)]
pub(super) struct Notifier {
    /// A worker without progress for this long is as good as a loop that stands.
    longest_stall: Duration,
    watchdog: bool,
    ready: bool,
    told: String,
}

impl Notifier {
    pub(super) fn new(longest_stall: Duration) -> Self {
        Self { longest_stall, watchdog: sd_notify::watchdog_enabled().is_some(), ready: false, told: String::new() }
    }

    /// After a turn of the loop.
    pub(super) fn turn(&mut self, state: ServiceState, last_error: &str, stalled: Duration) {
        if !core::mem::replace(&mut self.ready, true) {
            tell(NotifyState::Ready);
        }
        if self.watchdog && stalled < self.longest_stall {
            tell(NotifyState::Watchdog);
        }
        let status = if last_error.is_empty() { state.to_string() } else { format!("{state}: {last_error}") };
        if status != self.told {
            tell(NotifyState::Status(&status));
            self.told = status;
        }
    }

    /// The service has begun to leave.
    pub(super) fn stopping(&self) {
        tell(NotifyState::Stopping);
    }
}

fn tell(state: NotifyState<'_>) {
    if let Err(error) = sd_notify::notify(&[state]) {
        tracing::debug!(%error, "the supervisor could not be told");
    }
}
