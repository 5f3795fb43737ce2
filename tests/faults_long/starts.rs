//! Start storms: services that are started and killed at any instant of their start, all at once, beside the keeper.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use shared_types::ServiceName;
use shared_types::bus::{Bus, Limits};
use shared_types::channel::HealthChannel;
use shared_types::config::{Layer, load};
use shared_types::folder::MissionFolder;
use shared_types::system::System;
use splatting::order::Random;

use crate::common::{system_files, vantage};

/// Each is started and killed by a thread of its own. Not the camera, which waits for the world before it speaks.
const LANES: [&str; 5] = ["px4-link", "recorder", "trainer", "scorer", "planner"];
/// A start that takes longer than this hangs: joining takes a fraction of a second, and what another's death left half-made
/// is removed after 1.5 s at the latest.
const WEDGED: Duration = Duration::from_secs(20);
/// A start that nobody disturbs is looked at after so many that were killed.
const KILLS_PER_LOOK: u64 = 3;

/// What came of it.
#[derive(Debug, Default)]
struct Tally {
    kills: u64,
    /// Milliseconds until a start that was left alone was heard of.
    ready_ms: Vec<f64>,
    wedged: Vec<String>,
}

/// Starts and kills `cycles` services in all. Says what came of it; `true` where every start that was left alone came to
/// work, and nothing was left.
pub fn storm(cycles: u64, seed: u64, out: &Path) -> bool {
    shared_types::logging::init(shared_types::logging::LevelFilter::OFF);
    let before = system_files();
    let folder = std::path::absolute(out).expect("a path").join("starts");
    drop(std::fs::remove_dir_all(&folder));
    MissionFolder::create(&folder).expect("a mission folder");
    let name = format!("starts-{}", std::process::id());
    let setting = format!("mission.folder={}", folder.display());
    let mut keeper =
        spawn(vantage().args(["keeper", "--system", &name, "--set", "clock.mode=wall", "--set", &setting]));
    let system = await_system(&name);
    let (done, began) = (AtomicU64::new(0), Instant::now());
    let tallies: Vec<Tally> = std::thread::scope(|scope| {
        let lanes: Vec<_> = LANES
            .into_iter()
            .enumerate()
            .map(|(lane, service)| {
                let (system, done) = (&system, &done);
                scope.spawn(move || {
                    let mut random = Random::new(seed ^ ((lane as u64) << 32));
                    run_lane(service, system, &mut random, || done.fetch_add(1, Ordering::Relaxed) < cycles)
                })
            })
            .collect();
        lanes.into_iter().map(|lane| lane.join().expect("a lane")).collect()
    });
    let mut well = true;
    println!(
        "\n| service | killed while starting | starts left alone | heard of after, ms (median) | longest | hung |"
    );
    println!("|---|---|---|---|---|---|");
    for (service, tally) in LANES.into_iter().zip(tallies) {
        let mut times = tally.ready_ms;
        times.sort_by(f64::total_cmp);
        let (median, longest) = (times.get(times.len() / 2), times.last());
        println!(
            "| {service} | {} | {} | {:.0} | {:.0} | {} |",
            tally.kills,
            times.len(),
            median.copied().unwrap_or(f64::NAN),
            longest.copied().unwrap_or(f64::NAN),
            tally.wedged.len()
        );
        tally.wedged.iter().for_each(|text| println!("{service}: {text}"));
        well &= tally.wedged.is_empty() && !times.is_empty();
    }
    drop(Command::new("kill").args(["-TERM", &keeper.id().to_string()]).status());
    well &= keeper.wait().is_ok_and(|status| status.success());
    system.remove_if_dead().expect("removed");
    let left: Vec<_> = system_files().into_iter().filter(|path| !before.contains(path)).collect();
    println!("{:.0} s; left over: {left:?}", began.elapsed().as_secs_f64());
    drop(std::fs::remove_dir_all(&folder));
    well && left.is_empty()
}

fn run_lane(service: &str, system: &System, random: &mut Random, more: impl Fn() -> bool) -> Tally {
    let config = load(&[Layer::of_file(&system.config_path()).expect("a configuration")]).expect("a configuration");
    let bus = Bus::open(system, Limits::of(&config), ServiceName::Command, 0, false).expect("the bus");
    let mut health = bus.subscriber::<HealthChannel>().expect("health");
    let mut heard = |pid: u32| {
        let mut found = false;
        while let Some(message) = health.receive(u64::MAX).expect("health is read") {
            found |= message.header().pid == pid;
        }
        found
    };
    let mut tally = Tally::default();
    let mut start_ms = 300.0;
    for cycle in 0.. {
        if !more() {
            break;
        }
        let mut child = spawn(vantage().args([service, "--system", &system.name]));
        let began = Instant::now();
        if cycle % (KILLS_PER_LOOK + 1) == KILLS_PER_LOOK {
            let end = loop {
                if heard(child.id()) {
                    break Ok(1e3 * began.elapsed().as_secs_f64());
                }
                if let Ok(Some(status)) = child.try_wait() {
                    break Err(format!("start {cycle} ended by itself: {status}"));
                }
                if began.elapsed() > WEDGED {
                    break Err(format!("start {cycle} was not heard of after {WEDGED:?}"));
                }
                std::thread::sleep(Duration::from_millis(2));
            };
            match end {
                Ok(ms) => {
                    start_ms = ms;
                    tally.ready_ms.push(ms);
                }
                Err(text) => tally.wedged.push(text),
            }
        } else {
            // Anywhere in the start, and a little after it.
            std::thread::sleep(Duration::from_secs_f64(1e-3 * 1.2 * start_ms * f64::from(random.below(1000)) / 1000.0));
            tally.kills += 1;
        }
        drop(child.kill());
        drop(child.wait());
    }
    tally
}

fn spawn(command: &mut Command) -> Child {
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("vantage starts")
}

fn await_system(name: &str) -> System {
    let began = Instant::now();
    loop {
        if let Ok(system) = System::find(&System::base_dir(), Some(name))
            && system.config_path().exists()
        {
            return system;
        }
        assert!(began.elapsed() < WEDGED, "the keeper makes no system");
        std::thread::sleep(Duration::from_millis(5));
    }
}
