//! The last log lines of this process, whatever of them is written.

use std::collections::VecDeque;
use std::fmt::{Debug, Write as _};
use std::sync::{LazyLock, Mutex, PoisonError};
use std::time::Instant;

use tracing::field::{Field, Visit};
use tracing::{Event, Subscriber};
use tracing_subscriber::layer::{Context, Layer};

/// Lines that are kept.
const KEPT: usize = 100;

static LINES: Mutex<VecDeque<String>> = Mutex::new(VecDeque::new());
static BEGAN: LazyLock<Instant> = LazyLock::new(Instant::now);

/// Keeps them.
pub(crate) struct LastLines;

impl<S: Subscriber> Layer<S> for LastLines {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let metadata = event.metadata();
        let mut line =
            Line(format!("{:10.3} s {:5} {}:", BEGAN.elapsed().as_secs_f64(), metadata.level(), metadata.target()));
        event.record(&mut line);
        let mut lines = LINES.lock().unwrap_or_else(PoisonError::into_inner);
        if lines.len() == KEPT {
            lines.pop_front();
        }
        lines.push_back(line.0);
    }
}

/// A line under work: the message first, as `tracing` records it first.
struct Line(String);

impl Visit for Line {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        // Writing to a string does not fail.
        match field.name() {
            "message" => write!(self.0, " {value:?}"),
            name => write!(self.0, " {name}={value:?}"),
        }
        .ok();
    }
}

/// The lines, oldest first. None where another thread adds one just now.
pub(crate) fn told() -> String {
    let Ok(lines) = LINES.try_lock() else { return String::new() };
    lines.iter().flat_map(|line| [line.as_str(), "\n"]).collect()
}
