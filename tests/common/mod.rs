//! Flies real missions with the real binary, and looks at what they leave.

#![allow(dead_code, reason = "each test binary uses its own part")]

pub mod watch;

use std::collections::BTreeMap;
use std::fs;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

pub mod namespace;

/// The binary under test.
pub fn vantage() -> Command {
    Command::new(env!("CARGO_BIN_EXE_vantage"))
}

/// Longest time that any mission of these tests may take; a watchdog, never a figure.
pub const LONGEST: Duration = Duration::from_secs(300);

/// A `vantage fly` in a folder of its own.
pub struct Flight {
    child: Child,
    /// The mission folder.
    pub folder: PathBuf,
    log: PathBuf,
    started: Instant,
}

impl Flight {
    /// Starts a mission into `folder`, with more arguments.
    pub fn start(folder: &Path, arguments: &[&str]) -> Self {
        let mut command = vantage();
        command.arg("fly").arg("--output").arg(folder).args(arguments);
        Self::spawn(folder, command)
    }

    /// Starts any command whose result lies in `folder`.
    pub fn spawn(folder: &Path, mut command: Command) -> Self {
        let log = folder.with_extension("terminal.log");
        let output = fs::File::options().create(true).append(true).open(&log).expect("log");
        let errors = output.try_clone().expect("log");
        let child = command.stdin(Stdio::null()).stdout(output).stderr(errors).spawn().expect("vantage starts");
        Self { child, folder: folder.to_owned(), log, started: Instant::now() }
    }

    /// Process id of launch.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Pids of the services that run now, by name.
    pub fn services(&self) -> BTreeMap<String, u32> {
        children_of(self.child.id())
    }

    /// Waits until `condition` holds; panics with the terminal's text when the mission ends or the time is over before.
    pub fn wait_until(&mut self, what: &str, mut condition: impl FnMut(&Self) -> bool) {
        while !condition(self) {
            if let Some(status) = self.child.try_wait().expect("waited") {
                panic!("the mission ended ({status}) before {what}\n{}", self.terminal());
            }
            self.watch(what);
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Waits for the end.
    pub fn finish(mut self) -> ExitStatus {
        loop {
            if let Some(status) = self.child.try_wait().expect("waited") {
                return status;
            }
            self.watch("the end");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Waits for the end, and expects success.
    pub fn finish_well(self) {
        let (log, folder) = (self.log.clone(), self.folder.clone());
        let status = self.finish();
        assert!(status.success(), "{status}\n{}", tell(&log, &folder));
    }

    /// Launch is killed; waits until its services have ended without it, with the vehicle on the ground.
    pub fn lose_launch(self) {
        let services = self.services();
        kill(self.pid(), "KILL");
        self.finish();
        let began = Instant::now();
        while services.values().any(|pid| runs(*pid)) {
            let left: Vec<_> = services.iter().filter(|(_, pid)| runs(**pid)).collect();
            assert!(began.elapsed() < Duration::from_secs(60), "still there: {left:?}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// What the terminal showed, and the end of the services' logs.
    pub fn terminal(&self) -> String {
        tell(&self.log, &self.folder)
    }

    fn watch(&mut self, what: &str) {
        if self.started.elapsed() > LONGEST {
            let told = self.terminal();
            drop(self.child.kill());
            panic!("no {what} after {LONGEST:?}\n{told}");
        }
    }
}

impl Drop for Flight {
    fn drop(&mut self) {
        if matches!(self.child.try_wait(), Ok(None)) {
            for pid in self.services().values().chain([&self.child.id()]) {
                kill(*pid, "KILL");
            }
            drop(self.child.wait());
        }
    }
}

fn tell(log: &Path, folder: &Path) -> String {
    let mut told = fs::read_to_string(log).unwrap_or_default();
    let logs = fs::read_dir(folder.join("logs")).into_iter().flatten().flatten();
    for entry in logs {
        let text = fs::read_to_string(entry.path()).unwrap_or_default();
        let tail: Vec<&str> = text.lines().rev().take(15).collect();
        told += &format!("\n--- {}\n", entry.path().display());
        for line in tail.iter().rev() {
            told += line;
            told.push('\n');
        }
    }
    told
}

/// Stops a mission's processes where they are, all at once, while `look` looks.
pub fn frozen<T>(flight: &Flight, look: impl FnOnce() -> T) -> T {
    let pids: Vec<u32> = flight.services().into_values().chain([flight.pid()]).collect();
    pids.iter().for_each(|pid| kill(*pid, "STOP"));
    let seen = look();
    pids.iter().for_each(|pid| kill(*pid, "CONT"));
    seen
}

/// Copies a folder and all in it.
pub fn copy_folder(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("made");
    for entry in fs::read_dir(from).expect("read") {
        let entry = entry.expect("entry");
        let (source, target) = (entry.path(), to.join(entry.file_name()));
        if entry.file_type().expect("kind").is_dir() {
            copy_folder(&source, &target);
        } else {
            fs::copy(&source, &target).expect("copied");
        }
    }
}

/// Sends a signal by name.
pub fn kill(pid: u32, signal: &str) {
    let status = Command::new("kill").args([format!("-{signal}"), pid.to_string()]).stderr(Stdio::null()).status();
    assert!(status.is_ok(), "kill runs");
}

/// The services among a process's children, by the first argument of their command lines.
pub fn children_of(parent: u32) -> BTreeMap<String, u32> {
    let mut found = BTreeMap::new();
    for entry in fs::read_dir("/proc").expect("/proc").flatten() {
        let Some(pid) = entry.file_name().to_str().and_then(|name| name.parse::<u32>().ok()) else { continue };
        let Ok(stat) = fs::read_to_string(entry.path().join("stat")) else { continue };
        // pid (name) state ppid: the name may hold spaces and brackets.
        let Some((_, rest)) = stat.rsplit_once(')') else { continue };
        let mut fields = rest.split_whitespace();
        let state = fields.next().unwrap_or_default().to_owned();
        if state == "Z" || fields.next().and_then(|ppid| ppid.parse::<u32>().ok()) != Some(parent) {
            continue;
        }
        let mut line = Vec::new();
        if let Ok(mut file) = fs::File::open(entry.path().join("cmdline")) {
            drop(file.read_to_end(&mut line));
        }
        if let Some(service) = line.split(|&b| b == 0).nth(1) {
            found.insert(String::from_utf8_lossy(service).into_owned(), pid);
        }
    }
    found
}

/// Whether a process runs; one that nobody has reaped does not.
pub fn runs(pid: u32) -> bool {
    fs::read_to_string(format!("/proc/{pid}/stat"))
        .is_ok_and(|stat| stat.rsplit_once(") ").is_some_and(|(_, rest)| !rest.starts_with('Z')))
}

/// The system that a launch supervises.
pub fn system_of(launch: u32) -> shared_types::system::System {
    let systems = shared_types::system::System::list(&shared_types::system::System::base_dir());
    systems.into_iter().find(|system| system.supervisor_pid == launch).expect("launch has made its system")
}

/// Ids of the complete keyframes in a mission folder.
pub fn keyframes(folder: &Path) -> Vec<u64> {
    let mut ids: Vec<u64> = fs::read_dir(folder.join("keyframes"))
        .into_iter()
        .flatten()
        .flatten()
        .filter(|entry| ["rgb.png", "depth.png", "frame.json"].iter().all(|file| entry.path().join(file).is_file()))
        .filter_map(|entry| entry.file_name().to_str()?.parse().ok())
        .collect();
    ids.sort_unstable();
    ids
}

/// The journal, line by line.
pub fn journal(folder: &Path) -> Vec<serde_json::Value> {
    fs::read_to_string(folder.join("journal.jsonl"))
        .unwrap_or_default()
        .lines()
        .map(|line| serde_json::from_str(line).expect("a line of JSON"))
        .collect()
}

/// `report/metrics.json`.
pub fn metrics(folder: &Path) -> serde_json::Value {
    let text = fs::read_to_string(folder.join("report/metrics.json")).expect("metrics.json");
    serde_json::from_str(&text).expect("JSON")
}

/// Files in shared memory and runtime folders that belong to no running process: names that appeared since `before`.
pub fn leftovers(before: &[PathBuf]) -> Vec<PathBuf> {
    system_files().into_iter().filter(|path| !before.contains(path)).collect()
}

/// Of these, what belongs to no system that is alive: others may have been started meanwhile.
pub fn of_no_living_system(files: Vec<PathBuf>) -> Vec<PathBuf> {
    let living = shared_types::system::System::list(&shared_types::system::System::base_dir());
    let living: Vec<_> = living.into_iter().filter(shared_types::system::System::is_alive).collect();
    let is_theirs = |path: &PathBuf| {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        living.iter().any(|system| *path == system.runtime_dir || name.starts_with(&system.prefix))
    };
    files.into_iter().filter(|path| !is_theirs(path)).collect()
}

/// Everything of any system: its folders, and files in shared memory with a system's prefix.
pub fn system_files() -> Vec<PathBuf> {
    let base = shared_types::system::System::base_dir();
    let folders = fs::read_dir(&base).into_iter().flatten().flatten().map(|entry| entry.path());
    let files = fs::read_dir("/dev/shm").into_iter().flatten().flatten().map(|entry| entry.path()).filter(|path| {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        name.len() > 10 && name.starts_with('v') && name.as_bytes()[9] == b'_'
    });
    folders.chain(files).collect()
}
