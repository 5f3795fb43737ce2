//! Where the simulator's service stands.

use crate::clock::Phase;

/// The service's state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum State {
    /// Lockstep: tick 0 stands until every member has granted it.
    Gathering,
    /// Lockstep: ticks follow the grants.
    Running,
    /// Wall mode: ticks follow the machine's clock, with nobody to wait for.
    Free,
    /// Lockstep: these members (service codes) never came; the service ends.
    Failed(Vec<u32>),
}

impl State {
    /// The state after the clock has said what it waits for. Total: a failed or free-running service stays what it is, and a
    /// clock that has begun does not gather again.
    #[must_use]
    pub fn after(self, phase: &Phase) -> Self {
        match (self, phase) {
            (Self::Gathering, Phase::Gathering(_)) => Self::Gathering,
            (Self::Gathering, Phase::GatheringFailed(missing)) => Self::Failed(missing.clone()),
            (Self::Gathering | Self::Running, _) => Self::Running,
            (same @ (Self::Free | Self::Failed(_)), _) => same,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_gathers_once_then_runs_or_fails() {
        let gathering = State::Gathering.after(&Phase::Gathering(vec![4]));
        assert_eq!(gathering, State::Gathering);
        assert_eq!(gathering.clone().after(&Phase::Ready), State::Running);
        assert_eq!(gathering.after(&Phase::GatheringFailed(vec![4])), State::Failed(vec![4]));
        assert_eq!(State::Running.after(&Phase::Gathering(vec![4])), State::Running);
        assert_eq!(State::Failed(vec![4]).after(&Phase::Ready), State::Failed(vec![4]));
        assert_eq!(State::Free.after(&Phase::Ready), State::Free);
    }
}
