//! What the world is doing: building its scene, or answering.

/// State of the service.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum State {
    /// The scene is being built on a thread of its own; requests wait.
    Building,
    /// Requests are answered.
    Serving,
    /// The scene cannot be built: the service ends with the reason, and a new start would meet the same.
    Failed,
}

/// What can happen to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Event {
    /// The scene is there.
    Built,
    /// It cannot be built, or its thread ended without a word.
    BuildFailed,
}

impl State {
    /// The state after an event.
    pub(crate) fn after(self, event: Event) -> Self {
        match (self, event) {
            (Self::Building, Event::Built) => Self::Serving,
            (Self::Building, Event::BuildFailed) => Self::Failed,
            // A scene is built once: nothing later changes what has become of it.
            (Self::Serving | Self::Failed, Event::Built | Event::BuildFailed) => self,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_is_built_once() {
        assert_eq!(State::Building.after(Event::Built), State::Serving);
        assert_eq!(State::Building.after(Event::BuildFailed), State::Failed);
        for state in [State::Serving, State::Failed] {
            assert!([Event::Built, Event::BuildFailed].iter().all(|event| state.after(*event) == state));
        }
    }
}
