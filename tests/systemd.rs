//! The services as systemd has them: units that it understands and that touch little, and what a service tells it.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::net::UdpSocket;
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::{Flight, kill, vantage};
use shared_types::folder::MissionFolder;
use shared_types::system::System;

/// How far a unit may be exposed, by systemd's own count.
const MOST_EXPOSED: f64 = 2.0;

fn units() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy/systemd");
    let of_kind =
        |path: &PathBuf| path.extension().is_some_and(|kind| kind == "service" || kind == "target" || kind == "slice");
    let mut units: Vec<PathBuf> =
        std::fs::read_dir(folder).expect("units").flatten().map(|entry| entry.path()).filter(of_kind).collect();
    units.sort();
    units
}

/// The units in a folder of their own, with the binary under test instead of the installed one.
fn installed(folder: &Path) -> Vec<PathBuf> {
    let install = |unit: PathBuf| {
        let text = std::fs::read_to_string(&unit).expect("a unit");
        let path = folder.join(unit.file_name().expect("a name"));
        std::fs::write(&path, text.replace("/usr/bin/vantage", env!("CARGO_BIN_EXE_vantage"))).expect("written");
        path
    };
    units().into_iter().map(install).collect()
}

#[test]
fn systemd_understands_every_unit_and_finds_little_exposed() {
    let test = "systemd_understands_every_unit_and_finds_little_exposed";
    let there = Command::new("systemd-analyze").arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
    if there.is_err() {
        println!("{test}: skipped, no systemd-analyze");
        return;
    }
    let folder = tempfile::tempdir().expect("folder");
    let units = installed(folder.path());
    assert_eq!(units.len(), 10 + 2 + 1, "services, targets, the slice");
    let output = Command::new("systemd-analyze")
        .args(["verify", "--man=no"])
        .args(&units)
        .env("SYSTEMD_UNIT_PATH", format!("{}:", folder.path().display()))
        .output()
        .expect("systemd-analyze runs");
    // It ends well even with an unknown key; what it says counts.
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.is_empty(), "{said}");
    for unit in units.iter().filter(|unit| unit.extension().is_some_and(|kind| kind == "service")) {
        let output =
            Command::new("systemd-analyze").args(["security", "--offline=yes"]).arg(unit).output().expect("runs");
        let text = String::from_utf8_lossy(&output.stdout);
        let line = text.lines().rev().find(|line| line.contains("Overall exposure level")).expect("a verdict");
        let level: f64 = line.split_whitespace().filter_map(|word| word.parse().ok()).next_back().expect("a number");
        println!("{}: {level}", unit.display());
        assert!(level <= MOST_EXPOSED, "{line}");
    }
}

/// A service under a supervisor that listens.
struct Told {
    child: Child,
    socket: UnixDatagram,
    began: Instant,
}

impl Told {
    fn start(folder: &Path, service: &str, system: &str, sets: &[String]) -> Self {
        let path = folder.join(format!("{service}.socket"));
        // Of an earlier life.
        std::fs::remove_file(&path).ok();
        let socket = UnixDatagram::bind(&path).expect("a socket");
        socket.set_read_timeout(Some(Duration::from_secs(20))).expect("a timeout");
        let child = vantage()
            .args([service, "--system", system])
            .args(sets.iter().flat_map(|set| ["--set", set]))
            .env("NOTIFY_SOCKET", &path)
            .env("WATCHDOG_USEC", "10000000")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("vantage starts");
        Self { child, socket, began: Instant::now() }
    }

    /// What it says next; `None` where it says nothing for so long.
    fn next(&self, patience: Duration) -> Option<String> {
        self.socket.set_read_timeout(Some(patience)).expect("a timeout");
        let mut bytes = [0; 4096];
        let count = self.socket.recv(&mut bytes).ok()?;
        Some(String::from_utf8_lossy(&bytes[..count]).trim().to_owned())
    }

    fn wait_for(&self, word: &str) -> Duration {
        let began = Instant::now();
        while let Some(said) = self.next(Duration::from_secs(20)) {
            if said == word {
                return self.began.elapsed();
            }
            assert!(began.elapsed() < Duration::from_secs(30), "no {word}, last {said}");
        }
        panic!("no {word}");
    }

    fn end(mut self) {
        kill(self.child.id(), "TERM");
        self.wait_for("STOPPING=1");
        assert!(self.child.wait().expect("ended").success());
    }
}

impl Drop for Told {
    fn drop(&mut self) {
        drop(self.child.kill());
        drop(self.child.wait());
    }
}

/// Ready, alive from its loop, silent when it stands, leaving.
#[test]
fn every_service_tells_its_supervisor() {
    let folder = tempfile::tempdir().expect("folder");
    let mission = folder.path().join("mission");
    MissionFolder::create(&mission).expect("a mission folder");
    let system = format!("told-{}", std::process::id());
    // Missions fly beside this test: a port that is nobody's.
    let port = UdpSocket::bind("127.0.0.1:0").and_then(|socket| socket.local_addr()).expect("a port").port();
    let sets = vec![
        "clock.mode=wall".to_owned(),
        format!("mission.folder={}", mission.display()),
        format!("link.url=udpin:127.0.0.1:{port}"),
    ];
    let keeper = Told::start(folder.path(), "keeper", &system, &sets);
    // Who is first makes the system.
    println!("keeper: ready after {} ms", keeper.wait_for("READY=1").as_millis());
    // The camera waits for the world's scene.
    let world = Told::start(folder.path(), "world", &system, &[]);
    println!("world: ready after {} ms", world.wait_for("READY=1").as_millis());
    for service in ["px4-link", "camera", "trainer", "scorer", "planner", "recorder"] {
        let told = Told::start(folder.path(), service, &system, &[]);
        println!("{service}: ready after {} ms", told.wait_for("READY=1").as_millis());
        told.wait_for("WATCHDOG=1");
        told.wait_for("WATCHDOG=1");
        told.end();
    }
    // Not from a side thread: a process that stands says nothing.
    let told = Told::start(folder.path(), "scorer", &system, &[]);
    told.wait_for("WATCHDOG=1");
    kill(told.child.id(), "STOP");
    while told.next(Duration::from_millis(300)).is_some() {}
    assert_eq!(told.next(Duration::from_secs(3)), None, "it stands");
    kill(told.child.id(), "CONT");
    told.wait_for("WATCHDOG=1");
    told.end();
    world.end();
    keeper.end();
    System::find(&System::base_dir(), Some(&system)).expect("found").remove_if_dead().expect("removed");
}

/// Processes that do not outlive a test that fails.
struct Children(Vec<(&'static str, Child)>);

impl Drop for Children {
    fn drop(&mut self) {
        for (_, child) in &mut self.0 {
            drop(child.kill());
            drop(child.wait());
        }
    }
}

/// The same services under another supervisor than launch: prepared, and started in an order that is nobody's.
/// The journal is that of `vantage fly`, word for word.
#[test]
fn another_supervisor_flies_the_same_mission() {
    let base = tempfile::tempdir().expect("folder");
    let by_launch = base.path().join("by-launch");
    let sets = ["--preset", "tiny", "--set", "mission.seed=21", "--set", "mission.id=same"];
    let mut fly = vantage();
    fly.arg("fly").args(sets).arg("--output").arg(&by_launch);
    Flight::spawn(&by_launch, fly).finish_well();

    let state = base.path().join("state");
    std::fs::create_dir_all(state.join("missions")).expect("a folder");
    let system = format!("by-systemd-{}", std::process::id());
    // Ports of its own: other missions fly beside this test.
    let prepared = vantage()
        .arg("prepare")
        .args(sets)
        .args(["--set", "simulator.instance=7", "--system", &system])
        .env("STATE_DIRECTORY", &state)
        .output()
        .expect("vantage runs");
    assert!(prepared.status.success(), "{}", String::from_utf8_lossy(&prepared.stderr));
    let folder = state.join("missions/same");
    let order = ["planner", "px4-link", "simulator", "scorer", "keeper", "world", "trainer", "camera"];
    let start = |service: &str| {
        let mut command = vantage();
        command.args([service, "--system", &system]).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        command.spawn().expect("vantage starts")
    };
    let mut children = Children(order.iter().map(|service| (*service, start(service))).collect());
    let began = Instant::now();
    let is_over = || common::journal(&folder).iter().any(|entry| entry["event"] == "over");
    while !is_over() {
        assert!(began.elapsed() < common::LONGEST, "not over: {:?}", common::journal(&folder).last());
        for (service, child) in &mut children.0 {
            if let Some(status) = child.try_wait().expect("looked at") {
                panic!("{service} ended: {status}");
            }
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    children.0.iter().for_each(|(_, child)| kill(child.id(), "TERM"));
    for (service, child) in &mut children.0 {
        assert!(child.wait().expect("ended").success(), "{service}");
    }
    let journal = |folder: &Path| std::fs::read_to_string(folder.join("journal.jsonl")).expect("a journal");
    assert_eq!(journal(&folder), journal(&by_launch));
    System::find(&System::base_dir(), Some(&system)).expect("found").remove_if_dead().expect("removed");
}

#[test]
fn every_configuration_that_is_shipped_is_one() {
    let deploy = Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy");
    let profiles = std::fs::read_dir(deploy.join("profiles")).expect("profiles").flatten().map(|entry| entry.path());
    let files: Vec<PathBuf> = profiles.chain([deploy.join("config/vantage.toml")]).collect();
    assert_eq!(files.len(), 4);
    for file in files {
        let output = vantage().arg("config").arg("--config").arg(&file).output().expect("vantage runs");
        assert!(output.status.success(), "{}: {}", file.display(), String::from_utf8_lossy(&output.stderr));
        let text = std::fs::read_to_string(&file).expect("read");
        let says = text.contains("Measured on") || text.contains("Not measured") || file.ends_with("vantage.toml");
        assert!(says, "{}: says what it was measured on", file.display());
    }
}
