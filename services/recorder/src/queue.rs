//! Messages between the loop and the thread that writes: bounded in bytes, and what matters least gives way first.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// What gives way to what, when memory or disk run out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Priority {
    /// Images of the stream.
    Stream,
    /// Keyframes, small depth images, models.
    Bulk,
    /// Everything else.
    Small,
}

impl Priority {
    /// All of them, the least first.
    pub const ALL: [Self; 3] = [Self::Stream, Self::Bulk, Self::Small];

    /// Share of the memory up to which such messages are taken.
    fn share(self) -> f64 {
        match self {
            Self::Stream => 0.5,
            Self::Bulk => 0.85,
            Self::Small => 1.0,
        }
    }
}

/// A message, copied out of shared memory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Sample {
    /// Index of its channel in the table.
    pub channel: usize,
    /// See [`Priority`].
    pub priority: Priority,
    /// Mission time when it was sent, nanoseconds.
    pub sent_ns: u64,
    /// Mission time of what it describes.
    pub stamp_ns: u64,
    /// Its number among its sender's messages on the channel.
    pub sequence: u64,
    /// Envelope, header and items.
    pub bytes: Vec<u8>,
}

/// What comes out of the queue.
#[derive(Debug, PartialEq, Eq)]
pub enum Taken {
    /// The oldest message.
    Sample(Sample),
    /// None came in time.
    Nothing,
    /// It is closed and empty.
    End,
}

#[derive(Debug, Default)]
struct State {
    samples: VecDeque<Sample>,
    bytes: usize,
    spare: Vec<Vec<u8>>,
    dropped: [u64; 3],
    closed: bool,
}

/// The queue; shared by two threads.
#[derive(Debug)]
pub struct Queue {
    state: Mutex<State>,
    changed: Condvar,
    limit_bytes: usize,
}

/// Buffers kept for messages to come: as many as are in flight of the largest kind.
const MOST_SPARE: usize = 8;

impl Queue {
    /// A queue for so many bytes of messages.
    #[must_use]
    pub fn new(limit_bytes: usize) -> Self {
        Self { state: Mutex::default(), changed: Condvar::new(), limit_bytes }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        // Nothing that holds the lock can panic.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// An empty buffer, one that was used before where there is one.
    #[must_use]
    pub fn buffer(&self) -> Vec<u8> {
        self.state().spare.pop().unwrap_or_default()
    }

    /// Gives a buffer back.
    pub fn give_back(&self, mut buffer: Vec<u8>) {
        let mut state = self.state();
        if state.spare.len() < MOST_SPARE {
            buffer.clear();
            state.spare.push(buffer);
        }
    }

    /// Whether another message of this priority would be taken, whatever its size.
    #[must_use]
    pub fn has_room(&self, priority: Priority) -> bool {
        self.fits(self.state().bytes, priority)
    }

    #[expect(clippy::cast_precision_loss, reason = "bytes of memory")]
    fn fits(&self, bytes: usize, priority: Priority) -> bool {
        (bytes as f64) < self.limit_bytes as f64 * priority.share()
    }

    /// Takes a message in, or drops and counts it where there is no room. True when it was taken.
    pub fn offer(&self, sample: Sample) -> bool {
        let mut state = self.state();
        if state.closed || !self.fits(state.bytes, sample.priority) {
            state.dropped[sample.priority as usize] += 1;
            drop(state);
            self.give_back(sample.bytes);
            return false;
        }
        state.bytes += sample.bytes.len();
        state.samples.push_back(sample);
        drop(state);
        self.changed.notify_one();
        true
    }

    /// The oldest message; waits for one, but not longer than `patience`.
    #[must_use]
    pub fn take(&self, patience: Duration) -> Taken {
        let empty = |state: &mut State| state.samples.is_empty() && !state.closed;
        let waited = self.changed.wait_timeout_while(self.state(), patience, empty);
        let (mut state, _) = waited.unwrap_or_else(PoisonError::into_inner);
        match state.samples.pop_front() {
            Some(sample) => {
                state.bytes -= sample.bytes.len();
                Taken::Sample(sample)
            }
            None if state.closed => Taken::End,
            None => Taken::Nothing,
        }
    }

    /// No more messages will come.
    pub fn close(&self) {
        self.state().closed = true;
        self.changed.notify_one();
    }

    /// Messages dropped so far, by priority.
    #[must_use]
    pub fn dropped(&self) -> [u64; 3] {
        self.state().dropped
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(priority: Priority, bytes: usize, sequence: u64) -> Sample {
        Sample { channel: 0, priority, sent_ns: 0, stamp_ns: 0, sequence, bytes: vec![7; bytes] }
    }

    #[test]
    fn images_of_the_stream_give_way_first_and_small_messages_last() {
        let queue = Queue::new(1000);
        for (at, priority) in [(0, Priority::Stream), (1, Priority::Bulk), (2, Priority::Small)] {
            while queue.offer(sample(priority, 50, at)) {}
        }
        // Half, 85 % and all of it are taken; one of each was too much.
        let counts = [10, 7, 3];
        assert!(Priority::ALL.into_iter().all(|priority| !queue.has_room(priority)));
        for (priority, count) in Priority::ALL.into_iter().zip(counts) {
            for _ in 0..count {
                let Taken::Sample(taken) = queue.take(Duration::ZERO) else { panic!("{priority:?}") };
                assert_eq!(taken.priority, priority);
            }
        }
        assert_eq!(queue.take(Duration::ZERO), Taken::Nothing);
        assert_eq!(queue.dropped(), [1, 1, 1]);
        queue.close();
        assert_eq!(queue.take(Duration::from_secs(60)), Taken::End);
        assert!(!queue.offer(sample(Priority::Small, 1, 0)), "closed");
    }

    proptest::proptest! {
        /// Whatever comes and goes: messages keep their order, none is there twice, and memory is bounded by the limit and one
        /// message.
        #[test]
        fn order_is_kept_and_memory_is_bounded(
            steps in proptest::collection::vec((0usize..3, 1usize..400, proptest::bool::ANY), 1..200),
        ) {
            let queue = Queue::new(2000);
            let (mut offered, mut expected) = (0u64, VecDeque::new());
            for (priority, bytes, take) in steps {
                let priority = Priority::ALL[priority];
                if queue.offer(sample(priority, bytes, offered)) {
                    expected.push_back(offered);
                }
                offered += 1;
                proptest::prop_assert!(queue.state().bytes <= 2000 + 400);
                if take && let Taken::Sample(taken) = queue.take(Duration::ZERO) {
                    proptest::prop_assert_eq!(Some(taken.sequence), expected.pop_front());
                    queue.give_back(taken.bytes);
                }
            }
            let dropped: u64 = queue.dropped().iter().sum();
            let mut left = 0;
            while let Taken::Sample(taken) = queue.take(Duration::ZERO) {
                proptest::prop_assert_eq!(Some(taken.sequence), expected.pop_front());
                left += 1;
            }
            proptest::prop_assert!(expected.is_empty() && dropped + left <= offered);
            proptest::prop_assert_eq!(queue.state().bytes, 0);
        }
    }
}
