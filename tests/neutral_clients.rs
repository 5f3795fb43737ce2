//! Ground stations that know nothing of Vantage fly its simulator: MAVSDK and pymavlink, as they fly a real PX4.
//!
//! They need Python with the packages of `clients/requirements.txt`, named by `VANTAGE_CLIENTS_PYTHON` (`.ci/run` makes
//! it). Without it the tests say that they were skipped.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::{kill, vantage};
use shared_types::system::System;

struct Simulator {
    child: Child,
    name: &'static str,
    instance: u16,
}

impl Simulator {
    /// A vehicle alone, on the wall's clock.
    fn start(name: &'static str, instance: u16) -> Self {
        let mut command = vantage();
        command.args(["simulator", "--system", name, "--set", "clock.mode=wall"]);
        command.args(["--set", &format!("simulator.instance={instance}"), "--set", "simulator.start_m=[0.0, 0.0]"]);
        let child = command.stdin(Stdio::null()).stdout(Stdio::null()).spawn().expect("the simulator starts");
        std::thread::sleep(Duration::from_millis(500));
        Self { child, name, instance }
    }
}

impl Drop for Simulator {
    fn drop(&mut self) {
        kill(self.child.id(), "TERM");
        let patience = Instant::now() + Duration::from_secs(5);
        while Instant::now() < patience && matches!(self.child.try_wait(), Ok(None)) {
            std::thread::sleep(Duration::from_millis(20));
        }
        drop(self.child.kill());
        drop(self.child.wait());
        // Made by hand, so nobody else removes it.
        if let Ok(system) = System::find(&System::base_dir(), Some(self.name)) {
            system.remove_if_dead().ok();
        }
    }
}

fn fly(script: &str, scheme: &str, simulator: &Simulator) {
    let Some(python) = std::env::var_os("VANTAGE_CLIENTS_PYTHON") else {
        eprintln!("{script} skipped: VANTAGE_CLIENTS_PYTHON names no Python with tests/clients/requirements.txt");
        return;
    };
    let path = format!("{}/tests/clients/{script}", env!("CARGO_MANIFEST_DIR"));
    let output = Command::new(python)
        .arg(path)
        .arg(format!("{scheme}127.0.0.1:{}", 14540 + simulator.instance))
        .output()
        .expect("python runs");
    let told = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{told}\n{}", String::from_utf8_lossy(&output.stderr));
    assert!(told.lines().last().is_some_and(|line| line.ends_with(", 0 failed")), "{told}");
}

#[test]
fn mavsdk_flies_the_simulator() {
    let simulator = Simulator::start("mavsdk-client", 8);
    fly("mavsdk_flight.py", "udpin://", &simulator);
}

#[test]
fn pymavlink_gets_px4s_answers() {
    // Instance 0: its system id is 1, which the script addresses.
    let simulator = Simulator::start("pymavlink-client", 0);
    fly("pymavlink_matrix.py", "udpin:", &simulator);
}
