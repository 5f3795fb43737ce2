//! Logs: `tracing` events, quiet by default, and iceoryx2's own messages brought into them. To the journal with their fields
//! where systemd has connected standard error with it, else as lines to standard error.

use std::os::fd::AsFd as _;

use iceoryx2_log::{Log, LogLevel};
pub use tracing_subscriber::filter::LevelFilter;
use tracing_subscriber::filter::{FilterExt as _, filter_fn};
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{EnvFilter, Layer as _};

use crate::post_mortem::lines::LastLines;
use crate::trace::{self, Stages};

/// Sends iceoryx2's messages to `tracing`. Its informational chatter is below our debug level.
struct Bridge;

impl Log for Bridge {
    fn log(&self, level: LogLevel, origin: core::fmt::Arguments<'_>, message: core::fmt::Arguments<'_>) {
        match level {
            LogLevel::Trace | LogLevel::Debug | LogLevel::Info => {
                tracing::trace!(target: "iceoryx2", %origin, "{message}")
            }
            LogLevel::Warn => tracing::debug!(target: "iceoryx2", %origin, "{message}"),
            LogLevel::Error | LogLevel::Fatal => tracing::warn!(target: "iceoryx2", %origin, "{message}"),
        }
    }
}

static BRIDGE: Bridge = Bridge;

type Reload = Box<dyn Fn(LevelFilter) -> bool + Send + Sync>;
static RELOAD: std::sync::OnceLock<Reload> = std::sync::OnceLock::new();

/// Starts logging. `VANTAGE_LOG` takes `tracing-subscriber` filters, such as `debug` or `planner=trace`; the default is
/// `info` for the services and `warn` for the commands.
pub fn init(default: LevelFilter) {
    let env = EnvFilter::builder().with_default_directive(default.into()).with_env_var("VANTAGE_LOG").from_env_lossy();
    let (filter, handle) = tracing_subscriber::reload::Layer::new(env);
    let lines = tracing_subscriber::fmt::layer().with_writer(std::io::stderr).with_target(true).with_ansi(false);
    let output = match to_journal() {
        // The journal keeps every field of an event by its name: `journalctl VANTAGE_SERVICE=trainer`.
        Some(journal) => journal.with_field_prefix(Some("VANTAGE".to_owned())).boxed(),
        None => lines.boxed(),
    };
    let kept = LastLines.with_filter(LevelFilter::INFO);
    let stages = Stages.with_filter(filter_fn(|metadata| metadata.target() == trace::TARGET));
    // Stages are no part of the log, whatever its level.
    let output = output.with_filter(filter.and(filter_fn(|metadata| metadata.target() != trace::TARGET)));
    if tracing_subscriber::registry().with(output).with(kept).with(stages).try_init().is_ok() {
        let reload: Reload =
            Box::new(move |level| handle.reload(EnvFilter::default().add_directive(level.into())).is_ok());
        // A second initialisation cannot get here: try_init succeeds once.
        drop(RELOAD.set(reload));
    }
    iceoryx2_log::set_logger(&BRIDGE);
    iceoryx2_log::set_log_level(LogLevel::Warn);
}

/// The journal, where standard error leads to it. systemd names the stream in `JOURNAL_STREAM`; a process that was started
/// with another standard error, as by launch, inherits the name only.
fn to_journal() -> Option<tracing_journald::Layer> {
    let named = std::env::var("JOURNAL_STREAM").ok()?;
    let stream = rustix::fs::fstat(std::io::stderr().as_fd()).ok()?;
    if named != format!("{}:{}", stream.st_dev, stream.st_ino) {
        return None;
    }
    tracing_journald::layer().ok()
}

/// Levels by the numbers of [`set_level`].
pub const LEVELS: [&str; 5] = ["error", "warn", "info", "debug", "trace"];

/// Changes the level of this process while it runs, to that of [`LEVELS`] with this number. False when there is none, or when
/// logging was not started here.
#[must_use]
pub fn set_level(level: u32) -> bool {
    let filter = match level {
        0 => LevelFilter::ERROR,
        1 => LevelFilter::WARN,
        2 => LevelFilter::INFO,
        3 => LevelFilter::DEBUG,
        4 => LevelFilter::TRACE,
        _ => return false,
    };
    RELOAD.get().is_some_and(|reload| reload(filter))
}
