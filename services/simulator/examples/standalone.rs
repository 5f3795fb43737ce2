//! The simulated vehicle alone, for any MAVLink client:
//!
//! `cargo run --release -p simulator --example standalone -- [instance] [speed] [NAME=value]...`
//!
//! An instance of `-` takes the first free one. Clients connect as to PX4's own simulation, for example MAVSDK to
//! `udpin://127.0.0.1:14540`. Ends with Ctrl-C.

use std::process::ExitCode;
use std::sync::atomic::AtomicBool;

use simulator::standalone::run_standalone;
use simulator::udp::UdpLinks;
use simulator::vehicle::VehicleConfig;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (settings, positional): (Vec<&String>, Vec<&String>) = arguments.iter().partition(|a| a.contains('='));
    let instance = positional.first().and_then(|a| a.parse::<u8>().ok());
    let speed = positional.get(1).and_then(|a| a.parse::<f64>().ok()).unwrap_or(1.0);
    let mut config = VehicleConfig::default();
    for setting in settings {
        match setting.split_once('=').map(|(name, value)| (name, value.parse::<f64>())) {
            Some((name, Ok(value))) => config.params.push((name.to_owned(), value)),
            _ => {
                eprintln!("{setting}: expected NAME=number, for example MPC_XY_VEL_MAX=4");
                return ExitCode::from(64);
            }
        }
    }
    let links = match UdpLinks::bind(instance) {
        Ok(links) => links,
        Err(error) => {
            eprintln!("{error}");
            return ExitCode::from(69);
        }
    };
    println!("instance {}, clients at {}", links.instance(), links.onboard_peer());
    match run_standalone(links, config, speed, &AtomicBool::new(false), |_, _| {}) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}
