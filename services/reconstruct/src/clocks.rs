//! How long training takes: processor and wall time, and the rate of late.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};

use crate::checkpoint::Progression;

/// Wall time that the rate is a mean over.
const RATE_WINDOW: Duration = Duration::from_secs(10);

/// Processor and wall time of training.
pub(crate) struct Watch {
    wall: Instant,
    cpu_s: f64,
}

impl Watch {
    pub(crate) fn start() -> Self {
        Self { wall: Instant::now(), cpu_s: process_cpu_s() }
    }

    pub(crate) fn stop(self, progression: &mut Progression) {
        progression.wall_s += self.wall.elapsed().as_secs_f64();
        progression.cpu_s += process_cpu_s() - self.cpu_s;
    }
}

/// Iterations a second of late.
pub(crate) struct Rate {
    marks: VecDeque<(Instant, u32)>,
}

impl Rate {
    pub(crate) fn new(iteration: u32) -> Self {
        Self { marks: VecDeque::from([(Instant::now(), iteration)]) }
    }

    pub(crate) fn at(&mut self, iteration: u32) -> f64 {
        let now = Instant::now();
        self.marks.push_back((now, iteration));
        while self.marks.len() > 2 && self.marks.front().is_some_and(|mark| now - mark.0 > RATE_WINDOW) {
            self.marks.pop_front();
        }
        self.marks.front().map_or(0.0, |(when, first)| {
            f64::from(iteration.saturating_sub(*first)) / (now - *when).as_secs_f64().max(1e-9)
        })
    }
}

/// Processor time of all threads of this process, seconds.
fn process_cpu_s() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}
