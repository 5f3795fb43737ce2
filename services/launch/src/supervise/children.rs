//! The processes themselves: start, log files, reaping, signals, memory.

use std::collections::BTreeMap;
use std::fs::{self, OpenOptions};
use std::io::{self, Read as _, Seek as _, SeekFrom};
use std::os::unix::process::{CommandExt as _, ExitStatusExt as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};

use rustix::process::{Pid, Signal, kill_process};
use shared_types::ServiceName;

use super::autopsy;

/// How children are started.
#[derive(Debug, Clone)]
pub struct Starter {
    /// The binary: this one.
    pub program: PathBuf,
    /// Folder of the system that the children join.
    pub system_folder: PathBuf,
    /// Folder of their log files.
    pub logs: PathBuf,
    /// Log level, as `VANTAGE_LOG` takes it.
    pub log_level: String,
}

impl Starter {
    /// The log file of a service.
    #[must_use]
    pub fn log_path(&self, service: ServiceName) -> PathBuf {
        self.logs.join(format!("{service}.log"))
    }

    fn start(&self, service: ServiceName, last_end: Option<&String>) -> io::Result<Child> {
        fs::create_dir_all(&self.logs)?;
        let log = OpenOptions::new().create(true).append(true).open(self.log_path(service))?;
        let mut command = Command::new(&self.program);
        command
            .arg(service.name())
            .arg("--supervised")
            .arg("--system")
            .arg(&self.system_folder)
            .stdin(Stdio::null())
            .stdout(log.try_clone()?)
            .stderr(log)
            // A group of its own, so that the terminal's Ctrl-C reaches the supervisor alone. Not a session of its own:
            // with autogroups, nice values would mean nothing between sessions.
            .process_group(0);
        if std::env::var_os("VANTAGE_LOG").is_none() {
            command.env("VANTAGE_LOG", &self.log_level);
        }
        if let Some(end) = last_end {
            command.env(shared_types::service::LAST_EXIT, end);
        }
        command.spawn()
    }
}

/// The running processes.
#[derive(Debug)]
pub struct Children {
    starter: Starter,
    running: BTreeMap<ServiceName, Child>,
    in_the_air: bool,
    /// How each ended last.
    ends: BTreeMap<ServiceName, String>,
    /// Reports of hung services so far.
    examined: u32,
}

impl Children {
    /// None yet.
    #[must_use]
    pub fn new(starter: Starter) -> Self {
        Self { starter, running: BTreeMap::new(), in_the_air: false, ends: BTreeMap::new(), examined: 0 }
    }

    /// Starts a service.
    ///
    /// # Errors
    /// When the process cannot be made or its log cannot be opened.
    pub fn start(&mut self, service: ServiceName) -> io::Result<()> {
        let child = self.starter.start(service, self.ends.get(&service))?;
        self.running.insert(service, child);
        Ok(())
    }

    /// Whether the vehicle is armed: then nobody is killed by accident.
    pub fn set_in_the_air(&mut self, in_the_air: bool) {
        self.in_the_air = in_the_air;
    }

    /// Process ids.
    #[must_use]
    pub fn pids(&self) -> Vec<(ServiceName, u32)> {
        self.running.iter().map(|(service, child)| (*service, child.id())).collect()
    }

    /// The process id of a service that runs.
    #[must_use]
    pub fn pid(&self, service: ServiceName) -> Option<u32> {
        self.running.get(&service).map(Child::id)
    }

    /// Writes down what a hung service's threads are doing, beside this thread, then kills it where `kill`. Gives the
    /// report's path.
    pub fn examine(&mut self, service: ServiceName, kill: bool) -> PathBuf {
        self.examined += 1;
        let path = self.starter.logs.join(format!("{service}-hung-{}.txt", self.examined));
        if let Some(pid) = self.pid(service) {
            autopsy::begin(service, pid, path.clone(), kill);
        }
        path
    }

    /// Those that ended since the last call, with their exit code (`None`: by a signal).
    pub fn reap(&mut self) -> Vec<(ServiceName, Option<i32>, String)> {
        let mut ended = Vec::new();
        for (service, child) in &mut self.running {
            if let Ok(Some(status)) = child.try_wait() {
                ended.push((*service, status.code(), describe(status)));
            }
        }
        for (service, _, end) in &ended {
            self.running.remove(service);
            self.ends.insert(*service, end.clone());
        }
        ended
    }

    /// Sends SIGTERM.
    pub fn ask(&self, service: ServiceName) {
        self.signal(service, Signal::TERM);
    }

    /// Sends SIGKILL.
    pub fn kill(&self, service: ServiceName) {
        self.signal(service, Signal::KILL);
    }

    fn signal(&self, service: ServiceName, signal: Signal) {
        // The child has not been reaped, so its id is still its own.
        let pid = self.running.get(&service).and_then(|child| Pid::from_raw(i32::try_from(child.id()).ok()?));
        if let Some(pid) = pid
            && let Err(error) = kill_process(pid, signal)
        {
            tracing::debug!(%service, ?signal, %error, "could not signal");
        }
    }

    /// Last error that a service wrote to its log, for the user: its last non-empty line.
    #[must_use]
    pub fn last_words(&self, service: ServiceName) -> Option<String> {
        last_line(&self.starter.log_path(service))
    }

    /// The log file of a service.
    #[must_use]
    pub fn log_path(&self, service: ServiceName) -> PathBuf {
        self.starter.log_path(service)
    }
}

impl Drop for Children {
    /// On an error path, with the vehicle on the ground, what still runs is killed and reaped. In the air everybody is
    /// left alone: they notice that the supervisor is gone, bring the vehicle home and end.
    fn drop(&mut self) {
        if self.in_the_air {
            return;
        }
        for child in self.running.values_mut() {
            if child.kill().is_ok() {
                child.wait().ok();
            }
        }
    }
}

fn describe(status: ExitStatus) -> String {
    match (status.code(), status.signal()) {
        (Some(code), _) => format!("exit code {code}"),
        (None, Some(signal)) => format!("signal {signal}"),
        (None, None) => "an unknown end".to_owned(),
    }
}

/// The last non-empty line of a file's last 8 KiB.
fn last_line(path: &Path) -> Option<String> {
    let mut file = fs::File::open(path).ok()?;
    let length = file.metadata().ok()?.len();
    file.seek(SeekFrom::Start(length.saturating_sub(8192))).ok()?;
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes).ok()?;
    let text = String::from_utf8_lossy(&bytes);
    text.lines().rev().map(str::trim).find(|line| !line.is_empty()).map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use super::*;

    fn script(folder: &Path, text: &str) -> Starter {
        use std::os::unix::fs::PermissionsExt as _;
        let program = folder.join("program");
        fs::write(&program, format!("#!/bin/sh\n{text}\n")).expect("written");
        fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).expect("executable");
        Starter { program, system_folder: "/sys".into(), logs: folder.join("logs"), log_level: "info".to_owned() }
    }

    fn reap_one(children: &mut Children) -> (ServiceName, Option<i32>, String) {
        let began = Instant::now();
        loop {
            if let Some(ended) = children.reap().pop() {
                return ended;
            }
            assert!(began.elapsed() < Duration::from_secs(10), "nothing ended");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    #[test]
    fn a_child_gets_its_name_and_system_and_its_last_words_are_kept() {
        let folder = tempfile::tempdir().expect("folder");
        let mut children = Children::new(script(folder.path(), "echo \"$@\"; echo; echo why >&2; exit 69"));
        children.start(ServiceName::World).expect("started");
        assert_eq!(reap_one(&mut children), (ServiceName::World, Some(69), "exit code 69".to_owned()));
        assert_eq!(children.last_words(ServiceName::World).as_deref(), Some("why"));
        let log = fs::read_to_string(children.log_path(ServiceName::World)).expect("log");
        assert!(log.starts_with("world --supervised --system /sys\n"), "{log}");
    }

    #[test]
    fn the_next_process_is_told_how_the_last_one_ended() {
        let folder = tempfile::tempdir().expect("folder");
        let mut children = Children::new(script(folder.path(), "echo last: $VANTAGE_LAST_EXIT; kill -ABRT $$"));
        for expected in ["last:", "last: signal 6"] {
            children.start(ServiceName::Trainer).expect("started");
            assert_eq!(reap_one(&mut children).2, "signal 6");
            assert_eq!(children.last_words(ServiceName::Trainer).as_deref(), Some(expected));
        }
    }

    #[test]
    fn a_child_is_in_a_group_of_its_own_and_dies_by_the_signals_sent() {
        let folder = tempfile::tempdir().expect("folder");
        let mut children = Children::new(script(folder.path(), "exec sleep 60"));
        children.start(ServiceName::Camera).expect("started");
        let (_, pid) = children.pids()[0];
        let pid = Pid::from_raw(i32::try_from(pid).expect("pid")).expect("pid");
        assert_eq!(rustix::process::getpgid(Some(pid)).expect("group"), pid);
        assert_eq!(
            rustix::process::getsid(Some(pid)).expect("session"),
            rustix::process::getsid(None).expect("session"),
            "the session is the supervisor's"
        );
        children.ask(ServiceName::Camera);
        assert_eq!(reap_one(&mut children), (ServiceName::Camera, None, "signal 15".to_owned()));
        children.start(ServiceName::Camera).expect("started");
        children.kill(ServiceName::Camera);
        assert_eq!(reap_one(&mut children).2, "signal 9");
    }

    #[test]
    fn a_supervisor_that_fails_in_flight_kills_nobody() {
        let folder = tempfile::tempdir().expect("folder");
        let mut children = Children::new(script(folder.path(), "exec sleep 60"));
        children.start(ServiceName::Px4Link).expect("started");
        children.set_in_the_air(true);
        let (_, pid) = children.pids()[0];
        drop(children);
        assert!(crate::proc::is_alive(pid), "px4-link brings the vehicle home");
        let pid = Pid::from_raw(i32::try_from(pid).expect("pid")).expect("pid");
        kill_process(pid, Signal::KILL).expect("killed");
    }

    #[test]
    fn nobody_outlives_a_dropped_supervisor() {
        let folder = tempfile::tempdir().expect("folder");
        let mut children = Children::new(script(folder.path(), "exec sleep 60"));
        children.start(ServiceName::Trainer).expect("started");
        let (_, pid) = children.pids()[0];
        drop(children);
        assert!(!crate::proc::is_alive(pid));
    }
}
