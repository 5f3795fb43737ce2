//! The summary: service by phase by fault.

use std::collections::BTreeSet;
use std::fmt::Write as _;

use crate::load::Load;
use crate::phase::PHASES;
use crate::record::{Fault, Mission, Results};

/// What was flown, in tables of Markdown. `baseline`: missions without faults, to compare PSNR with seed by seed.
pub fn table(results: &Results, baseline: Option<&Results>) -> String {
    let mut text = String::from(
        "\n| service | phase | fault | faults | in missions that were well | works again after, ms (median) |\n\
         |---|---|---|---|---|---|\n",
    );
    let kinds: BTreeSet<(&str, &str)> =
        results.faults.iter().map(|fault| (fault.service.as_str(), fault.blow.as_str())).collect();
    let is_well = |index: u64| results.missions.iter().any(|mission| mission.mission == index && mission.is_well());
    for (service, blow) in &kinds {
        let these = |phase: Option<&str>| -> Vec<&Fault> {
            let of_kind = |f: &&Fault| f.service == *service && f.blow == *blow && phase.is_none_or(|p| f.phase == p);
            results.faults.iter().filter(of_kind).collect()
        };
        for phase in PHASES.into_iter().map(Some).chain([None]) {
            let faults = these(phase);
            if faults.is_empty() {
                continue;
            }
            let well = faults.iter().filter(|fault| is_well(fault.mission)).count();
            let work = words(median(faults.iter().filter_map(|fault| fault.work_ms).collect()));
            let (phase, count) = (phase.unwrap_or("**all**"), faults.len());
            writeln!(text, "| {service} | {phase} | {blow} | {count} | {well} | {work} |").ok();
        }
    }
    let missions = &results.missions;
    let well = missions.iter().filter(|mission| mission.is_well()).count();
    let sum = |of: fn(&Mission) -> usize| missions.iter().map(of).sum::<usize>();
    writeln!(
        text,
        "\n{} missions, {well} well; {} faults; {} keyframes lost, {} doubled; {} files left over",
        missions.len(),
        results.faults.len(),
        sum(|mission| mission.lost),
        sum(|mission| mission.doubled),
        sum(|mission| mission.leftovers)
    )
    .ok();
    let offboard = median(results.faults.iter().filter_map(|fault| fault.offboard_ms).collect());
    if let Some(ms) = offboard {
        writeln!(text, "px4-link flies by setpoints again after {ms:.0} ms (median)").ok();
    }
    text += &psnr(missions, baseline);
    text += &loads(missions);
    let clearance = missions.iter().filter_map(|mission| mission.clearance_m).fold(f64::INFINITY, f64::min);
    if clearance.is_finite() {
        writeln!(text, "least clearance {clearance:.2} m").ok();
    }
    let step = missions.iter().map(|mission| mission.largest_step_m).fold(0.0, f64::max);
    writeln!(text, "longest way between two setpoints {step:.3} m").ok();
    text
}

/// What processes held in the first fifth of the missions, and in the last: medians of what each had at most.
fn loads(missions: &[Mission]) -> String {
    let share = missions.len() / 5;
    if share == 0 {
        return String::new();
    }
    let (first, last) = (&missions[..share], &missions[missions.len() - share..]);
    let names: BTreeSet<&str> = missions.iter().flat_map(|mission| mission.loads.keys().map(String::as_str)).collect();
    let mut text = format!(
        "\nWhat processes held at most, median of the first and of the last {share} missions:\n\n\
         | process | descriptors | maps | threads | resident MB |\n|---|---|---|---|---|\n"
    );
    for name in names {
        let of = |these: &[Mission], figure: fn(&Load) -> u64| {
            words(median(these.iter().filter_map(|mission| Some(figure(mission.loads.get(name)?) as f64)).collect()))
        };
        let both = |figure: fn(&Load) -> u64| format!("{} -> {}", of(first, figure), of(last, figure));
        writeln!(
            text,
            "| {name} | {} | {} | {} | {} |",
            both(|load| load.fds),
            both(|load| load.maps),
            both(|load| load.threads),
            both(|load| load.rss_kb / 1024)
        )
        .ok();
    }
    let shm = |these: &[Mission]| these.iter().map(|mission| mission.shared_memory_bytes).max().unwrap_or(0);
    let wall_min = missions.iter().map(|mission| mission.wall_s).sum::<f64>() / 60.0;
    writeln!(
        text,
        "\n/dev/shm after a mission, at most: {} -> {} bytes; {wall_min:.0} minutes of missions",
        shm(first),
        shm(last)
    )
    .ok();
    text
}

fn psnr(missions: &[Mission], baseline: Option<&Results>) -> String {
    let mut text = String::new();
    let values: Vec<f64> = missions.iter().filter_map(|mission| mission.psnr_db).collect();
    let least = values.iter().copied().fold(f64::INFINITY, f64::min);
    if let Some((mean, deviation)) = mean_and_deviation(&values) {
        writeln!(text, "PSNR of the object {mean:.2} dB, deviation {deviation:.2} dB, least {least:.2} dB").ok();
    }
    let Some(baseline) = baseline else { return text };
    let calm: Vec<f64> = baseline.missions.iter().filter_map(|mission| mission.psnr_db).collect();
    let pairs: Vec<f64> = missions
        .iter()
        .filter_map(|mission| {
            let calm = baseline.missions.iter().find(|calm| calm.seed == mission.seed)?;
            Some(mission.psnr_db? - calm.psnr_db?)
        })
        .collect();
    if let (Some((mean, deviation)), Some((change, spread))) = (mean_and_deviation(&calm), mean_and_deviation(&pairs)) {
        let within = pairs.iter().filter(|change| change.abs() <= 2.0 * deviation).count();
        writeln!(
            text,
            "without faults {mean:.2} dB, deviation {deviation:.2} dB over {} seeds; {} pairs of the same seed change by \
             {change:+.2} dB, deviation {spread:.2} dB; {within} of them within two deviations",
            calm.len(),
            pairs.len(),
        )
        .ok();
    }
    text
}

fn mean_and_deviation(values: &[f64]) -> Option<(f64, f64)> {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let deviation = (values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / count).sqrt();
    (!values.is_empty()).then_some((mean, deviation))
}

fn words(milliseconds: Option<f64>) -> String {
    milliseconds.map_or("-".to_owned(), |ms| format!("{ms:.0}"))
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
