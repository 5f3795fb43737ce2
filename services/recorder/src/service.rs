//! The recorder as a service: take what has come, hand it to the writer, say how it goes.

use std::path::Path;
use std::time::Duration;

use shared_types::messages::ServiceState;
use shared_types::service::{Context, HealthReport, Service, ServiceError, Step, StopAnswer};

use crate::ports::Ports;
use crate::writer::{Status, Writer};

/// Between two looks at the channels. Queues hold the traffic of many times this.
const PERIOD: Duration = Duration::from_millis(2);

/// The service's states.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// Messages are written.
    Recording,
    /// The disk refuses, or the budget is used up: messages are dropped.
    NoRoom,
    /// Told to leave.
    Leaving,
}

impl State {
    /// The transition of a turn.
    #[must_use]
    pub fn after(self, status: &Status) -> Self {
        match self {
            Self::Leaving => Self::Leaving,
            Self::Recording | Self::NoRoom if status.error.is_empty() => Self::Recording,
            Self::Recording | Self::NoRoom => Self::NoRoom,
        }
    }
}

/// The service.
pub struct Recorder {
    ports: Ports,
    writer: Writer,
    state: State,
    status: Status,
    /// The mission's clock waits for the disk.
    complete: bool,
}

impl core::fmt::Debug for Recorder {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Recorder").field("state", &self.state).field("status", &self.status).finish_non_exhaustive()
    }
}

impl Recorder {
    /// Opens every channel and a file in the mission folder.
    ///
    /// # Errors
    /// When no folder is configured or it is none, or a channel cannot be opened.
    pub fn open(context: &Context) -> anyhow::Result<Self> {
        let folder = &context.config.mission.folder;
        anyhow::ensure!(
            Path::new(folder).is_dir(),
            "mission.folder = {folder:?}: expected a folder that is there, for the recording; `vantage fly` fills it in"
        );
        Ok(Self {
            ports: Ports::open(&context.bus, context.config.recorder.frames)?,
            writer: Writer::start(Path::new(folder), &context.config)?,
            state: State::Recording,
            status: Status::default(),
            complete: context.lockstep(),
        })
    }

    /// Takes what is left, and ends the file.
    pub fn finish(&mut self) {
        // Whatever was sent until now; what cannot be read any more is lost.
        if let Err(error) = self.ports.drain(u64::MAX, self.writer.queue(), false) {
            tracing::warn!(%error, "the last messages are not recorded");
        }
        self.writer.finish();
        let (status, (received, lost)) = (self.writer.status(), self.ports.counts());
        let dropped: u64 = self.writer.queue().dropped().iter().sum();
        tracing::info!(written = status.written, refused = status.refused, received, lost, dropped, "recorded");
    }
}

impl Service for Recorder {
    fn step(&mut self, now_ns: u64) -> Result<Step, ServiceError> {
        self.status = self.writer.status();
        self.state = self.state.after(&self.status);
        // A disk that refuses is not waited for: time would stand still.
        let wait = self.complete && self.state == State::Recording;
        if !self.ports.drain(now_ns, self.writer.queue(), wait)? {
            return Ok(Step::Waiting);
        }
        Ok(if self.state == State::Leaving { Step::Leave } else { Step::Done })
    }

    fn work(&self) -> u64 {
        self.status.written
    }

    fn period(&self) -> Duration {
        PERIOD
    }

    fn stop(&mut self, _now_ns: u64) -> StopAnswer {
        self.state = State::Leaving;
        StopAnswer::Now
    }

    fn health(&self) -> HealthReport {
        let (received, lost) = self.ports.counts();
        let dropped: u64 = self.writer.queue().dropped().iter().sum();
        let state = if self.state == State::NoRoom { ServiceState::Degraded } else { ServiceState::Running };
        HealthReport {
            state,
            last_error: self.status.error.clone(),
            received,
            sent: self.status.written,
            dropped: lost + dropped + self.status.refused,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_state_follows_the_disk_until_it_is_told_to_leave() {
        let (well, full) = (Status::default(), Status { error: "no room".to_owned(), ..Status::default() });
        assert_eq!(State::Recording.after(&full), State::NoRoom);
        assert_eq!(State::NoRoom.after(&well), State::Recording);
        assert_eq!(State::Recording.after(&well), State::Recording);
        assert_eq!(State::Leaving.after(&well), State::Leaving);
    }
}
