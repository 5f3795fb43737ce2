//! How long the stages of a process take, as `tracing` spans: written, on request, as events of the Chrome trace format, a line
//! each. Times are the machine's monotonic clock, which all processes share, so that files of several make one picture.
//!
//! ```
//! let views = 95_u32;
//! let _stage = shared_types::stage!("score", views);
//! // What is done until `_stage` is dropped took that long.
//! ```

use std::fs::File;
use std::io::Write as _;
use std::path::Path;
use std::sync::{Mutex, OnceLock, PoisonError};

use rustix::time::{ClockId, clock_gettime};
use serde_json::{Map, Value, json};
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Span, Subscriber};
use tracing_subscriber::layer::{Context, Layer};
use tracing_subscriber::registry::LookupSpan;

/// Target of the spans that are stages: others are not written.
pub const TARGET: &str = "vantage::stage";
/// Field that is the stage's name where it is not known before.
const NAME: &str = "name";
/// Field that puts stages onto a line of their own, instead of that of their thread.
const TRACK: &str = "track";

/// A stage under work, until it is dropped. Made by [`stage!`](crate::stage).
#[derive(Debug)]
pub struct Stage(Span);

impl Stage {
    /// A stage of this span. It is not entered: log lines stay as they are.
    #[must_use]
    pub fn of(span: Span) -> Self {
        Self(span)
    }

    /// Adds a field that the stage was made without a value for.
    pub fn record(&self, field: &'static str, value: impl tracing::Value) {
        self.0.record(field, value);
    }
}

/// The stage of a state machine: the state that it is in, since it came there.
#[derive(Debug, Default)]
pub struct InState(Option<(u32, Stage)>);

impl InState {
    /// It is in the state with this code; `begin` is called when it was in another before.
    pub fn is(&mut self, code: u32, begin: impl FnOnce() -> Stage) {
        if self.0.as_ref().is_none_or(|(now, _)| *now != code) {
            self.0 = None;
            self.0 = Some((code, begin()));
        }
    }
}

/// Begins a stage: a name, and fields as those of `tracing` spans. The field `track` names a line of its own for stages that
/// overlap others of their thread, and `name` a name that only the run knows.
#[macro_export]
macro_rules! stage {
    ($name:literal $(, $($fields:tt)*)?) => {
        $crate::trace::Stage::of($crate::private::tracing::info_span!(
            target: "vantage::stage", parent: None, $name $(, $($fields)*)?
        ))
    };
}

struct Output {
    file: Mutex<File>,
    service: &'static str,
}

static OUTPUT: OnceLock<Output> = OnceLock::new();

/// From now on, stages of this process are added to `<service>.jsonl` in this folder, which is made if there is none.
///
/// # Errors
/// When the file cannot be written.
pub fn begin(folder: &Path, service: &'static str) -> std::io::Result<()> {
    std::fs::create_dir_all(folder)?;
    let file = File::options().create(true).append(true).open(folder.join(format!("{service}.jsonl")))?;
    // Asked for twice, it goes on with the first.
    drop(OUTPUT.set(Output { file: Mutex::new(file), service }));
    Ok(())
}

/// Whether stages are written.
#[must_use]
pub fn is_on() -> bool {
    OUTPUT.get().is_some()
}

/// Now, on the clock of traces: microseconds.
#[must_use]
pub fn now_us() -> f64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as f64 * 1e6 + now.tv_nsec as f64 / 1e3
}

/// Writes stages when they are over.
pub(crate) struct Stages;

struct Begun {
    at_us: f64,
    track: String,
    name: Option<String>,
    fields: Map<String, Value>,
}

impl Visit for Begun {
    fn record_f64(&mut self, field: &Field, value: f64) {
        self.fields.insert(field.name().to_owned(), json!(value));
    }

    fn record_i64(&mut self, field: &Field, value: i64) {
        self.fields.insert(field.name().to_owned(), json!(value));
    }

    fn record_u64(&mut self, field: &Field, value: u64) {
        self.fields.insert(field.name().to_owned(), json!(value));
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        match field.name() {
            NAME => self.name = Some(value.to_owned()),
            TRACK => self.track = value.to_owned(),
            name => drop(self.fields.insert(name.to_owned(), json!(value))),
        }
    }

    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        self.record_str(field, &format!("{value:?}"));
    }
}

impl<S: Subscriber + for<'a> LookupSpan<'a>> Layer<S> for Stages {
    fn on_new_span(&self, attributes: &Attributes<'_>, id: &Id, context: Context<'_, S>) {
        if !is_on() {
            return;
        }
        let track = std::thread::current().name().unwrap_or("main").to_owned();
        let mut begun = Begun { at_us: now_us(), track, name: None, fields: Map::new() };
        attributes.record(&mut begun);
        if let Some(span) = context.span(id) {
            span.extensions_mut().insert(begun);
        }
    }

    fn on_record(&self, id: &Id, values: &Record<'_>, context: Context<'_, S>) {
        if let Some(span) = context.span(id)
            && let Some(begun) = span.extensions_mut().get_mut::<Begun>()
        {
            values.record(begun);
        }
    }

    fn on_close(&self, id: Id, context: Context<'_, S>) {
        let Some(span) = context.span(&id) else { return };
        let (Some(output), Some(begun)) = (OUTPUT.get(), span.extensions_mut().remove::<Begun>()) else { return };
        let event = json!({
            "name": begun.name.as_deref().unwrap_or_else(|| span.name()),
            "cat": output.service,
            "ph": "X",
            "ts": begun.at_us,
            "dur": now_us() - begun.at_us,
            "pid": std::process::id(),
            "tid": begun.track,
            "args": begun.fields,
        });
        // One write a line: a process that is killed leaves whole ones. Where there is no room the trace has a gap.
        let line = format!("{event}\n");
        output.file.lock().unwrap_or_else(PoisonError::into_inner).write_all(line.as_bytes()).ok();
    }
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::*;

    const CHILD: &str = "VANTAGE_TEST_TRACES_INTO";

    /// In a process of its own: where stages go is the whole process's.
    #[test]
    fn stages_are_lines_of_a_trace_and_no_part_of_the_log() {
        if let Ok(folder) = std::env::var(CHILD) {
            return trace_into(Path::new(&folder));
        }
        let folder = tempfile::tempdir().unwrap();
        let name = "trace::tests::stages_are_lines_of_a_trace_and_no_part_of_the_log";
        let mut child = Command::new(std::env::current_exe().unwrap());
        child.args(["--exact", name, "--nocapture", "--test-threads=1"]).env(CHILD, folder.path());
        let output = child.output().unwrap();
        let log = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && log.contains("logged within a stage"), "{output:?}");
        assert!(!log.contains("score"), "{log}");
        let text = std::fs::read_to_string(folder.path().join("scorer.jsonl")).unwrap();
        let lines: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        let told: Vec<_> = lines.iter().map(|line| (line["name"].as_str().unwrap(), &line["args"])).collect();
        let expected =
            [("inner", json!({"k": 0.5})), ("score", json!({"views": 95, "found": 3})), ("landing", json!({}))];
        assert_eq!(told, expected.iter().map(|(name, fields)| (*name, fields)).collect::<Vec<_>>());
        let [inner, outer, flight] = &lines[..] else { panic!("{lines:?}") };
        let begin = outer["ts"].as_f64().unwrap();
        let end = begin + outer["dur"].as_f64().unwrap();
        let inside = inner["ts"].as_f64().unwrap();
        assert!(begin < inside && inside < end && end - begin >= 20_000.0 && end - begin < 5e6, "{text}");
        assert_eq!((&flight["tid"], &flight["ph"], &flight["cat"]), (&json!("flight"), &json!("X"), &json!("scorer")));
        assert_eq!(outer["tid"], inner["tid"]);
    }

    fn trace_into(folder: &Path) {
        crate::logging::init(tracing_subscriber::filter::LevelFilter::TRACE);
        drop(crate::stage!("score", before = true));
        begin(folder, "scorer").unwrap();
        let views = 95_u32;
        let outer = crate::stage!("score", views, found = tracing::field::Empty);
        let inner = crate::stage!("inner", k = 0.5);
        tracing::info!("logged within a stage");
        std::thread::sleep(std::time::Duration::from_millis(20));
        drop(inner);
        outer.record("found", 3_u32);
        drop(outer);
        drop(crate::stage!("phase", name = "landing", track = "flight"));
    }
}
