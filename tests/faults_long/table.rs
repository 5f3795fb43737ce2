//! The summary: service by phase.

use std::fmt::Write as _;

use crate::phase::PHASES;
use crate::record::{Mission, Results};

/// What was flown, in a table of Markdown.
pub fn table(results: &Results) -> String {
    let mut text = String::from(
        "\n| service | phase | kills | in missions that were well | new process after, ms |\n|---|---|---|---|---|\n",
    );
    let mut services: Vec<&str> = results.faults.iter().map(|fault| fault.service.as_str()).collect();
    services.sort_unstable();
    services.dedup();
    let is_well = |index: u64| results.missions.iter().any(|mission| mission.mission == index && mission.is_well());
    for service in services {
        for phase in PHASES {
            let of_these = || results.faults.iter().filter(|f| f.service == service && f.phase == phase);
            let kills = of_these().count();
            if kills > 0 {
                let well = of_these().filter(|fault| is_well(fault.mission)).count();
                let restarts = median(of_these().filter_map(|fault| fault.restart_ms).collect());
                let restarts = restarts.map_or("-".to_owned(), |ms| format!("{ms:.0}"));
                writeln!(text, "| {service} | {phase} | {kills} | {well} | {restarts} |").ok();
            }
        }
    }
    let missions = &results.missions;
    let well = missions.iter().filter(|mission| mission.is_well()).count();
    let sum = |of: fn(&Mission) -> usize| missions.iter().map(of).sum::<usize>();
    writeln!(
        text,
        "\n{} missions, {well} well; {} kills; {} keyframes lost, {} doubled; {} files left over",
        missions.len(),
        results.faults.len(),
        sum(|mission| mission.lost),
        sum(|mission| mission.doubled),
        sum(|mission| mission.leftovers)
    )
    .ok();
    let psnr: Vec<f64> = missions.iter().filter_map(|mission| mission.psnr_db).collect();
    if !psnr.is_empty() {
        let mean = psnr.iter().sum::<f64>() / psnr.len() as f64;
        let deviation = (psnr.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / psnr.len() as f64).sqrt();
        let least = psnr.iter().copied().fold(f64::INFINITY, f64::min);
        writeln!(text, "PSNR of the object {mean:.2} dB, deviation {deviation:.2} dB, least {least:.2} dB").ok();
    }
    let clearance = missions.iter().filter_map(|mission| mission.clearance_m).fold(f64::INFINITY, f64::min);
    if clearance.is_finite() {
        writeln!(text, "least clearance {clearance:.2} m").ok();
    }
    text
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
