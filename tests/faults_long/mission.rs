//! One mission under faults.

use std::path::Path;
use std::time::{Duration, Instant};

use splatting::order::Random;

use crate::common::watch::{Moment, Watch};
use crate::common::{Flight, kill, leftovers, of_no_living_system, runs, system_files, vantage};
use crate::judge::judge;
use crate::load::{self, Loads, Meter};
use crate::record::{Fault, Flown, Mission};
use crate::{Blow, Options, phase};

/// What may be hit; the simulator is the vehicle.
const SERVICES: [&str; 8] = ["px4-link", "camera", "trainer", "scorer", "planner", "keeper", "world", "launch"];
/// Longest wait for a new process, and for the services to end after launch.
const PATIENCE: Duration = Duration::from_secs(60);
/// Longest wait for a phase.
const PHASE_PATIENCE: Duration = Duration::from_millis(1500);
/// How long px4-link is waited for to fly by setpoints again; in many phases it need not.
const OFFBOARD_PATIENCE: Duration = Duration::from_secs(3);
/// Seed of the missions, or of the first.
const SEED: u64 = 21;

/// A mission that is being flown.
struct Flying<'a> {
    options: &'a Options,
    index: u64,
    seed: u64,
    folder: &'a Path,
    /// `None` while launch is dead.
    flight: Option<(Flight, Watch)>,
    /// Of the launch that lives.
    meter: Option<Meter>,
    loads: Loads,
    faults: Vec<Fault>,
    largest_step_m: f64,
    error: String,
}

/// Flies mission `index`.
pub fn fly(options: &Options, index: u64) -> Flown {
    let folder = options.out.join(format!("mission-{index:05}"));
    drop(std::fs::remove_dir_all(&folder));
    let before = system_files();
    let began = Instant::now();
    let mut random = Random::new(options.seed ^ index.wrapping_mul(0x9e37_79b9));
    let seed = if options.vary_seed { SEED + index } else { SEED };
    let flight = start(options, &folder, seed);
    let watch = Watch::begin(flight.pid());
    let meter = Some(Meter::begin(flight.pid()));
    let mut flying = Flying {
        options,
        index,
        seed,
        folder: &folder,
        flight: Some((flight, watch)),
        meter,
        loads: Loads::new(),
        faults: Vec::new(),
        largest_step_m: 0.0,
        error: String::new(),
    };
    for _ in 0..options.kills {
        if flying.flight.is_none() {
            break;
        }
        flying.strike(&mut random);
    }
    let mission = flying.end(began, &before);
    if mission.is_well() {
        drop(std::fs::remove_dir_all(&folder));
        drop(std::fs::remove_file(folder.with_extension("terminal.log")));
    }
    Flown { faults: flying.faults, mission }
}

fn start(options: &Options, folder: &Path, seed: u64) -> Flight {
    let text = seed.to_string();
    let mut arguments = vec!["--preset", &options.preset, "--seed", &text, "--set", "launch.crash_limit=1000"];
    arguments.extend(options.sets.iter().flat_map(|set| ["--set", set]));
    Flight::start(folder, &arguments)
}

impl Flying<'_> {
    /// One fault: at a phase that is drawn, on services that are drawn.
    fn strike(&mut self, random: &mut Random) {
        let options = self.options;
        let Some((flight, _)) = self.flight.as_ref() else { return };
        if !options.storm {
            await_a_phase(flight, self.folder, random);
        }
        std::thread::sleep(Duration::from_millis(u64::from(random.below(options.pause_ms.max(1) as u32))));
        let services = flight.services();
        let drawn = self.draw(random);
        let pid_of = |name: &str| if name == "launch" { Some(flight.pid()) } else { services.get(name).copied() };
        let targets: Vec<(&str, u32)> =
            drawn.into_iter().filter_map(|name| Some((name, pid_of(name).filter(|pid| runs(*pid))?))).collect();
        let (phase, fault) = (phase::of(self.folder).to_owned(), Moment::now());
        let signal = match options.blow {
            Blow::Kill => "KILL",
            Blow::Term => "TERM",
            Blow::Stop => "STOP",
        };
        for (_, pid) in &targets {
            kill(*pid, signal);
        }
        if options.blow == Blow::Stop {
            std::thread::sleep(Duration::from_secs_f64(options.stop_s));
            for (_, pid) in &targets {
                kill(*pid, "CONT");
            }
        }
        let blow = match options.blow {
            Blow::Kill => "kill".to_owned(),
            Blow::Term => "term".to_owned(),
            Blow::Stop => format!("stop {} s", options.stop_s),
        };
        for (name, _) in &targets {
            let back = *name != "launch" && options.blow != Blow::Stop && !options.storm;
            let work_ms = if back { self.back(name, fault) } else { None };
            let offboard_ms = if back && *name == "px4-link" { self.offboard(fault) } else { None };
            let (service, phase, blow) = ((*name).to_owned(), phase.clone(), blow.clone());
            self.faults.push(Fault { mission: self.index, service, blow, phase, work_ms, offboard_ms });
        }
        if options.blow == Blow::Kill && targets.iter().any(|(name, _)| *name == "launch") {
            self.resume(&services.into_values().collect::<Vec<_>>());
        }
    }

    /// Different services, launch last: who is hit together with it has no supervisor any more.
    fn draw(&self, random: &mut Random) -> Vec<&'static str> {
        if let Some(only) = &self.options.service {
            return SERVICES.into_iter().filter(|name| name == only).collect();
        }
        // SIGTERM to launch ends the mission, as it should.
        let mut left: Vec<&str> =
            SERVICES.into_iter().filter(|name| self.options.blow != Blow::Term || *name != "launch").collect();
        let mut drawn = Vec::new();
        for _ in 0..self.options.at_once.min(left.len()) {
            drawn.push(left.swap_remove(random.below(left.len() as u32) as usize));
        }
        drawn.sort_by_key(|name| *name == "launch");
        drawn
    }

    /// Milliseconds until the service does useful work again.
    fn back(&self, service: &str, fault: Moment) -> Option<f64> {
        let (flight, watch) = self.flight.as_ref()?;
        wait_for(PATIENCE, fault, flight, || watch.back_after(service, fault))
    }

    /// Milliseconds until px4-link flies by setpoints again.
    fn offboard(&self, fault: Moment) -> Option<f64> {
        let (flight, watch) = self.flight.as_ref()?;
        wait_for(OFFBOARD_PATIENCE, fault, flight, || watch.offboard_after(fault))
    }

    /// After launch was killed: waits until its services have ended, and flies on.
    fn resume(&mut self, services: &[u32]) {
        self.take_notes();
        if let Some((flight, _)) = self.flight.take() {
            let _killed = flight.finish();
        }
        let began = Instant::now();
        while services.iter().any(|pid| runs(*pid)) && began.elapsed() < PATIENCE {
            std::thread::sleep(Duration::from_millis(20));
        }
        if services.iter().any(|pid| runs(*pid)) {
            "services outlive launch by a minute".clone_into(&mut self.error);
        }
        // Killed before there was a mission: a user would look, and fly.
        let flight = if self.folder.join("mission.toml").exists() {
            let mut resume = vantage();
            resume.arg("resume").arg(self.folder);
            Flight::spawn(self.folder, resume)
        } else {
            start(self.options, self.folder, self.seed)
        };
        let watch = Watch::begin(flight.pid());
        self.meter = Some(Meter::begin(flight.pid()));
        self.flight = Some((flight, watch));
    }

    fn take_notes(&mut self) {
        if let Some(meter) = self.meter.take() {
            load::merge(&mut self.loads, meter.end());
        }
        if let Some((_, watch)) = &self.flight {
            self.largest_step_m = self.largest_step_m.max(watch.look(|heard| heard.largest_step_m));
        }
    }

    fn end(&mut self, began: Instant, before: &[std::path::PathBuf]) -> Mission {
        if let Some((flight, watch)) = self.flight.take() {
            let terminal = self.folder.with_extension("terminal.log");
            let status = flight.finish();
            if let Some(meter) = self.meter.take() {
                load::merge(&mut self.loads, meter.end());
            }
            self.largest_step_m = self.largest_step_m.max(watch.look(|heard| heard.largest_step_m));
            if !status.success() {
                let text = std::fs::read_to_string(terminal).unwrap_or_default();
                self.error += &format!("{status}: {}", text.lines().last().unwrap_or_default());
            }
        }
        let mut mission = Mission {
            mission: self.index,
            seed: self.seed,
            end_reason: String::new(),
            lost: 0,
            doubled: 0,
            psnr_db: None,
            clearance_m: None,
            largest_step_m: self.largest_step_m,
            collisions: 0,
            leftovers: of_no_living_system(leftovers(before)).len(),
            wall_s: began.elapsed().as_secs_f64(),
            loads: core::mem::take(&mut self.loads),
            shared_memory_bytes: load::shared_memory_bytes(),
            error: core::mem::take(&mut self.error),
        };
        judge(&mut mission, self.folder);
        mission
    }
}

/// Waits until the mission is in a phase that is drawn, so that short ones have their share; not for long, and not for one
/// that is over.
fn await_a_phase(flight: &Flight, folder: &Path, random: &mut Random) {
    let aim = random.below(phase::PHASES.len() as u32) as usize;
    let began = Instant::now();
    while began.elapsed() < PHASE_PATIENCE && runs(flight.pid()) {
        let now = phase::of(folder);
        if now == phase::PHASES[aim] || now == "shutdown" {
            break;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Milliseconds that `look` gives at last; `None` where the mission ended, or time was over, before.
fn wait_for(patience: Duration, fault: Moment, flight: &Flight, look: impl Fn() -> Option<Duration>) -> Option<f64> {
    while fault.at.elapsed() < patience && runs(flight.pid()) {
        if let Some(after) = look() {
            return Some(1e3 * after.as_secs_f64());
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    None
}
