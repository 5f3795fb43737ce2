//! What the trainer is doing, and when its results are due.

/// When results of a round are due on the mission clock: n iterations cost n / rate seconds (architecture, "Time", 4).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Schedule {
    /// Mission time at which counting began.
    pub base_ns: u64,
    /// Iterations of the round that were done then.
    pub base_iterations: u32,
    /// Iterations a second; infinite where results are due as soon as they are computed (wall mode).
    pub iterations_per_s: f64,
}

impl Schedule {
    /// Mission time at which the first `iterations` iterations of the round are due.
    #[must_use]
    pub fn due_ns(&self, iterations: u32) -> u64 {
        let count = f64::from(iterations.saturating_sub(self.base_iterations));
        self.base_ns + (count / self.iterations_per_s * 1e9).ceil() as u64
    }
}

/// A round under work, as the service sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Running {
    /// Number of the round.
    pub round: u32,
    /// Its cap.
    pub max_iterations: u32,
    /// When results are due.
    pub schedule: Schedule,
    /// Iterations published so far.
    pub published: u32,
    /// Whether the last slice was published: only the end is still to come.
    pub over: bool,
    /// Mission time of the last progress reply.
    pub progress_ns: u64,
}

impl Running {
    /// Mission time at which the next result is due, when slices have `slice` iterations.
    #[must_use]
    pub fn next_due_ns(&self, slice: u32) -> u64 {
        let end = if self.over { self.published } else { (self.published + slice).min(self.max_iterations) };
        self.schedule.due_ns(end.max(self.published))
    }
}

/// What the trainer is doing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum State {
    /// The thread looks at the mission folder.
    Starting,
    /// Nothing to do.
    Idle,
    /// A round is being computed.
    Training(Running),
    /// A round is over; its final snapshot waits for a free chunk.
    Publishing,
}

/// What happens to the trainer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Event {
    /// The thread has looked at the folder; `has_model` when a final snapshot is to be published again.
    Ready {
        /// Whether there is a model of a round's end.
        has_model: bool,
    },
    /// A round was given to the thread.
    Begun(Running),
    /// A slice was published.
    Slice {
        /// Iterations of the round so far.
        iterations: u32,
        /// Whether it was the last.
        over: bool,
    },
    /// The round is over and on disk.
    Finished,
    /// The round cannot be run.
    Failed,
    /// The final snapshot is out.
    Published,
    /// The clock found this member out, and in again: what is left is due from now.
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
            (Self::Starting, Event::Ready { has_model: true }) => Self::Publishing,
            (Self::Starting, Event::Ready { has_model: false }) => Self::Idle,
            (Self::Idle, Event::Begun(running)) => Self::Training(running),
            (Self::Training(running), Event::Slice { iterations, over }) => {
                Self::Training(Running { published: iterations, over, ..running })
            }
            (Self::Training(_), Event::Finished) => Self::Publishing,
            (Self::Training(_), Event::Failed) | (Self::Publishing, Event::Published) => Self::Idle,
            (Self::Training(running), Event::Rejoined { now_ns }) => {
                let schedule = Schedule { base_ns: now_ns, base_iterations: running.published, ..running.schedule };
                Self::Training(Running { schedule, progress_ns: now_ns, ..running })
            }
            (
                state,
                Event::Ready { .. }
                | Event::Begun(_)
                | Event::Slice { .. }
                | Event::Finished
                | Event::Failed
                | Event::Published
                | Event::Rejoined { .. },
            ) => state,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn running() -> Running {
        Running {
            round: 2,
            max_iterations: 90,
            schedule: Schedule { base_ns: 1_000_000_000, base_iterations: 0, iterations_per_s: 80.0 },
            published: 0,
            over: false,
            progress_ns: 0,
        }
    }

    #[test]
    fn slices_are_due_by_their_sum_and_not_by_their_number() {
        // 30 it/s: slices of 20 take 0.666 s each; three take 2 s and no rounding more.
        let schedule = Schedule { iterations_per_s: 30.0, ..running().schedule };
        assert_eq!(schedule.due_ns(0), 1_000_000_000);
        assert_eq!(schedule.due_ns(20), 1_666_666_667);
        assert_eq!(schedule.due_ns(60), 3_000_000_000);
        assert_eq!(Schedule { iterations_per_s: f64::INFINITY, ..schedule }.due_ns(60), 1_000_000_000);
    }

    #[test]
    fn the_last_slice_is_shorter_and_the_end_is_due_with_it() {
        let state = State::Training(running()).on(Event::Slice { iterations: 80, over: false });
        let State::Training(run) = state else { panic!("{state:?}") };
        assert_eq!(run.next_due_ns(20), run.schedule.due_ns(90));
        let state = state.on(Event::Slice { iterations: 90, over: true });
        let State::Training(run) = state else { panic!("{state:?}") };
        assert_eq!(run.next_due_ns(20), run.schedule.due_ns(90));
    }

    #[test]
    fn a_round_goes_its_way_and_strange_events_change_nothing() {
        let state = State::Starting.on(Event::Begun(running()));
        assert_eq!(state, State::Starting);
        assert_eq!(State::Starting.on(Event::Ready { has_model: true }), State::Publishing);
        let state = State::Starting.on(Event::Ready { has_model: false }).on(Event::Begun(running()));
        assert!(matches!(state, State::Training(_)));
        assert_eq!(state.on(Event::Failed), State::Idle);
        let state = state.on(Event::Finished);
        assert_eq!(state.on(Event::Slice { iterations: 5, over: false }), State::Publishing);
        assert_eq!(state.on(Event::Published), State::Idle);
    }

    #[test]
    fn after_an_out_what_is_left_is_due_from_now() {
        let state = State::Training(running()).on(Event::Slice { iterations: 40, over: false });
        let State::Training(run) = state.on(Event::Rejoined { now_ns: 9_000_000_000 }) else { panic!("training") };
        assert_eq!(run.next_due_ns(20), 9_250_000_000);
    }

    /// Any event.
    fn event() -> impl proptest::strategy::Strategy<Value = Event> {
        use proptest::prelude::*;
        prop_oneof![
            any::<bool>().prop_map(|has_model| Event::Ready { has_model }),
            Just(Event::Begun(running())),
            (0u32..=90, any::<bool>()).prop_map(|(iterations, over)| Event::Slice { iterations, over }),
            Just(Event::Finished),
            Just(Event::Failed),
            Just(Event::Published),
            (0u64..20_000_000_000).prop_map(|now_ns| Event::Rejoined { now_ns }),
        ]
    }

    proptest::proptest! {
        /// A round is begun from rest alone, its final model is always published before the next, and from everywhere there
        /// is a way back to rest.
        #[test]
        fn rounds_are_one_at_a_time_and_every_state_comes_to_rest(script in proptest::collection::vec(event(), 0..40)) {
            let (mut state, mut begun, mut settled) = (State::Starting, 0u32, 0u32);
            for event in script {
                let next = state.on(event);
                match (state, next) {
                    (State::Idle, State::Training(_)) => begun += 1,
                    (before, State::Training(_)) => proptest::prop_assert!(matches!(before, State::Training(_))),
                    (State::Training(_), State::Publishing | State::Idle) => settled += 1,
                    (State::Publishing, after) => {
                        proptest::prop_assert!(after == State::Publishing || (after == State::Idle && event == Event::Published));
                    }
                    _ => {}
                }
                proptest::prop_assert!(settled <= begun && begun <= settled + 1);
                state = next;
            }
            for event in [Event::Ready { has_model: true }, Event::Finished, Event::Published] {
                state = state.on(event);
            }
            proptest::prop_assert_eq!(state, State::Idle);
        }
    }
}
