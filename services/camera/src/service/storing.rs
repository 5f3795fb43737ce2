//! Keyframes to the writer and, once they are on the disk, to the readers.

use shared_types::folder::Keyframe;
use shared_types::messages::{CaptureRequest, KeyframeReason};
use shared_types::service::ServiceError;

use super::Core;
use crate::state::Event;

impl Core {
    pub(super) fn store(&mut self, now_ns: u64) -> Result<(), ServiceError> {
        let (Some(keyframe), Some(folder)) = (self.built.take(), &self.folder) else {
            return self.on(now_ns, Event::Stored(Err("no mission folder".to_owned())));
        };
        match self.writer.write(folder, keyframe) {
            Ok(()) => {
                self.writing = true;
                Ok(())
            }
            Err(reason) => self.on(now_ns, Event::Stored(Err(reason))),
        }
    }

    pub(super) fn take_written(&mut self, now_ns: u64) -> Result<(), ServiceError> {
        if !self.writing {
            return Ok(());
        }
        let Some((keyframe, result)) = self.writer.finished().map_err(ServiceError::Other)? else { return Ok(()) };
        self.writing = false;
        self.progress += 1;
        if let Err(error) = &result {
            tracing::error!(%error, keyframe = keyframe.frame.id, "a keyframe could not be stored");
            self.last_error = error.to_string();
        }
        self.built = Some(keyframe);
        let outcome = self.on(now_ns, Event::Stored(result.map_err(|error| format!("not stored: {error}"))));
        self.built = None;
        outcome
    }

    pub(super) fn publish(&mut self, now_ns: u64, keyframe: &Keyframe) -> Result<(), ServiceError> {
        self.ports.send_keyframe(now_ns, keyframe)?;
        self.published.insert((keyframe.frame.reason.code(), keyframe.frame.id));
        tracing::debug!(id = keyframe.frame.id, gate_missed = keyframe.frame.gate.missed, "keyframe");
        Ok(())
    }

    pub(super) fn republish(&mut self, now_ns: u64, request: &CaptureRequest) -> Result<(), ServiceError> {
        let (Some(folder), Some(reason)) = (&self.folder, KeyframeReason::from_code(request.reason)) else {
            return Ok(());
        };
        if self.published.contains(&(request.reason, request.keyframe_id)) {
            return Ok(());
        }
        match folder.read_view(reason, request.keyframe_id) {
            Ok(Some(keyframe)) => self.publish(now_ns, &keyframe),
            Ok(None) => Ok(()),
            Err(error) => {
                self.last_error = error.to_string();
                Ok(())
            }
        }
    }
}
