//! What a process that panics leaves for whoever looks for the reason: a report in the mission folder, and a core dump where
//! the system makes them.

pub(crate) mod heard;
pub(crate) mod lines;

use std::backtrace::Backtrace;
use std::fmt::Write as _;
use std::io::Write as _;
use std::panic::PanicHookInfo;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// What a report says besides the panic itself.
#[derive(Debug, Clone)]
pub struct About {
    /// The service, as in its command.
    pub service: &'static str,
    /// The folder for reports; made if there is none.
    pub folder: PathBuf,
    /// The resolved configuration, as TOML.
    pub config: String,
    /// Whether the process then dumps its core, instead of ending with an exit code: see [`allow_core_dumps`].
    pub dump_core: bool,
}

/// From now on, a panic of this process writes `<service>-panic-<pid>.txt`. What hooks did before they still do first.
pub fn report_panics(about: About) {
    let tell = std::panic::take_hook();
    let since = Instant::now();
    std::panic::set_hook(Box::new(move |panic| {
        tell(panic);
        let path = path(&about.folder, about.service);
        let text = report(&about, panic, since.elapsed().as_secs_f64(), &Backtrace::force_capture());
        // Added: where a second thread panics because of the first, the first says why.
        let written = std::fs::create_dir_all(&about.folder)
            .and_then(|()| std::fs::File::options().create(true).append(true).open(&path))
            .and_then(|mut file| file.write_all(text.as_bytes()));
        match written {
            Ok(()) => tracing::error!(path = %path.display(), "a panic; its report is written"),
            Err(error) => tracing::error!(path = %path.display(), %error, "a panic whose report cannot be written"),
        }
        if about.dump_core {
            std::process::abort();
        }
    }));
}

fn path(folder: &Path, service: &str) -> PathBuf {
    folder.join(format!("{service}-panic-{}.txt", std::process::id()))
}

/// Raises the limit of core dumps as far as the system allows; where it ends up, bytes (`None`: no limit). What is made of a
/// dump and where it goes is up to the kernel (`/proc/sys/kernel/core_pattern`).
///
/// # Errors
/// When the limit cannot be set.
pub fn allow_core_dumps() -> std::io::Result<Option<u64>> {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let maximum = getrlimit(Resource::Core).maximum;
    setrlimit(Resource::Core, Rlimit { current: maximum, maximum })?;
    Ok(maximum)
}

fn report(about: &About, panic: &PanicHookInfo<'_>, age_s: f64, backtrace: &Backtrace) -> String {
    let thread = std::thread::current();
    let place = panic.location().map_or_else(|| "an unknown place".to_owned(), ToString::to_string);
    let payload = panic.payload();
    let words = payload
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| payload.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("no words");
    let mut text = format!(
        "vantage {} {} panicked at {place}: {words}\n\nprocess {}, thread {}, {age_s:.3} s after its start\n",
        about.service,
        env!("CARGO_PKG_VERSION"),
        std::process::id(),
        thread.name().unwrap_or("without a name"),
    );
    let mut part = |title: &str, lines: String| {
        // Writing to a string does not fail.
        let lines = if lines.is_empty() { "none\n".to_owned() } else { lines };
        write!(text, "\n== {title}\n{lines}").ok();
    };
    part("last message received of each channel", heard::told());
    part("last log lines", lines::told());
    part("backtrace", backtrace.to_string());
    part("configuration", about.config.clone());
    text
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::*;

    const CHILD: &str = "VANTAGE_TEST_PANICS_INTO";

    /// In a process of its own: hooks, logs and limits are the whole process's.
    #[test]
    fn a_panic_leaves_a_report_with_its_version_configuration_and_last_messages() {
        if let Ok(folder) = std::env::var(CHILD) {
            panic_into(folder.into());
        }
        for dump_core in [false, true] {
            let folder = tempfile::tempdir().unwrap();
            let logs = folder.path().join("logs");
            let mut child = Command::new(std::env::current_exe().unwrap());
            let name = "post_mortem::tests::a_panic_leaves_a_report_with_its_version_configuration_and_last_messages";
            child.args(["--exact", name, "--nocapture", "--test-threads=1"]).env(CHILD, &logs);
            if dump_core {
                child.env("VANTAGE_TEST_DUMPS", "1");
            }
            let output = child.current_dir(folder.path()).output().unwrap();
            use std::os::unix::process::ExitStatusExt as _;
            assert_eq!(output.status.signal(), dump_core.then_some(6), "{output:?}");
            assert!(!output.status.success());
            let reports: Vec<_> = std::fs::read_dir(&logs).unwrap().map(|entry| entry.unwrap().path()).collect();
            assert_eq!(reports.len(), 1);
            assert!(reports[0].file_name().unwrap().to_string_lossy().starts_with("trainer-panic-"));
            let text = std::fs::read_to_string(&reports[0]).unwrap();
            for part in [
                concat!("vantage trainer ", env!("CARGO_PKG_VERSION"), " panicked at "),
                "post_mortem",
                "a test of reports",
                "thread of the test",
                "vehicle/state from px4-link, number 17, sent at 2.500 s",
                "INFO",
                "this far round=3",
                "panic_into",
                "seed = 7",
            ] {
                assert!(text.contains(part), "{part} in {text}");
            }
            assert!(!text.contains("line 0 of many"), "only the last lines are kept");
        }
    }

    fn panic_into(folder: PathBuf) -> ! {
        crate::logging::init(tracing_subscriber::filter::LevelFilter::WARN);
        for line in 0..1000 {
            tracing::info!("line {line} of many");
        }
        tracing::info!(round = 3, "this far");
        heard::note("vehicle/state", 4, 17, 2_500_000_000);
        let dump_core = std::env::var_os("VANTAGE_TEST_DUMPS").is_some();
        if dump_core {
            // The limit is raised, and the dump itself not wanted here.
            allow_core_dumps().unwrap();
            let none = rustix::process::Rlimit { current: Some(0), maximum: Some(0) };
            rustix::process::setrlimit(rustix::process::Resource::Core, none).unwrap();
        }
        report_panics(About { service: "trainer", folder, config: "seed = 7\n".to_owned(), dump_core });
        let thread = std::thread::Builder::new().name("of the test".to_owned());
        let joined = thread.spawn(|| panic!("a test of reports")).unwrap().join();
        std::process::exit(if joined.is_err() { 70 } else { 0 });
    }
}
