//! What the scorer is doing.

/// What the scorer is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// No request can be worked on.
    Idle,
    /// The thread scores the first request of the queue.
    Scoring {
        /// Mission time at which the result is due.
        due_ns: u64,
    },
}

/// What happens to the scorer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// The thread was given a request.
    Begun {
        /// Mission time at which the result is due.
        due_ns: u64,
    },
    /// The answer is out.
    Answered,
    /// The clock found this member out, and in again: what is under work is due now.
    Rejoined {
        /// Mission time.
        now_ns: u64,
    },
}

impl State {
    /// The state after an event. An event that cannot happen in a state changes nothing.
    #[must_use]
    pub fn on(self, event: Event) -> Self {
        match (self, event) {
            (Self::Idle, Event::Begun { due_ns }) => Self::Scoring { due_ns },
            (Self::Scoring { .. }, Event::Answered) => Self::Idle,
            (Self::Scoring { .. }, Event::Rejoined { now_ns }) => Self::Scoring { due_ns: now_ns },
            (state, Event::Begun { .. } | Event::Answered | Event::Rejoined { .. }) => state,
        }
    }
}

/// Mission time at which scoring `candidates` candidates is due (architecture, "Time", 4).
#[must_use]
pub fn due_ns(now_ns: u64, candidates: usize, ms_per_candidate: f64) -> u64 {
    now_ns + (candidates as f64 * ms_per_candidate * 1e6).ceil() as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_goes_its_way_and_strange_events_change_nothing() {
        assert_eq!(State::Idle.on(Event::Answered), State::Idle);
        let state = State::Idle.on(Event::Begun { due_ns: 5 });
        assert_eq!(state.on(Event::Begun { due_ns: 9 }), state, "one at a time");
        assert_eq!(state.on(Event::Rejoined { now_ns: 7 }), State::Scoring { due_ns: 7 });
        assert_eq!(state.on(Event::Answered), State::Idle);
    }

    #[test]
    fn ninety_five_candidates_at_4_ms_take_380_ms() {
        assert_eq!(due_ns(1_000, 95, 4.0), 380_001_000);
        assert_eq!(due_ns(1_000, 95, 0.0), 1_000);
    }
}
