//! What the processes of a mission did when, on one time axis: the lines that each wrote (`trace/`) made one trace that
//! Perfetto and Chrome open (`report/trace.json`), and a picture (`report/timeline.svg`): the paper's Fig. 3, measured.

mod picture;

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::{Map, Value, json};
use shared_types::folder::{MissionFolder, write_atomic};

/// A stage of a process, as [`shared_types::trace`] writes it.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub(crate) struct Stage {
    pub name: String,
    /// The service.
    pub cat: String,
    /// Microseconds of the monotonic clock.
    pub ts: f64,
    /// Microseconds.
    pub dur: f64,
    pub pid: u32,
    /// The line that it is drawn on.
    pub tid: String,
    #[serde(default)]
    pub args: Map<String, Value>,
}

/// Makes trace and picture of what is in `trace/`; false where nothing is.
///
/// # Errors
/// When they cannot be written.
pub fn write(folder: &MissionFolder) -> anyhow::Result<bool> {
    let stages = read(folder);
    if stages.is_empty() {
        return Ok(false);
    }
    let trace = serde_json::to_vec(&to_trace(&stages))?;
    write_atomic(&folder.report_path().join("trace.json"), &trace)?;
    write_atomic(&folder.report_path().join("timeline.svg"), picture::draw(&stages).as_bytes())?;
    Ok(true)
}

/// All stages by their beginning, from the first one on. Lines that are none are passed over: a process may have been cut
/// off, or the disk been full.
fn read(folder: &MissionFolder) -> Vec<Stage> {
    let files = std::fs::read_dir(folder.trace_path()).into_iter().flatten().flatten();
    let lines = files.filter_map(|file| std::fs::read_to_string(file.path()).ok());
    let mut stages: Vec<Stage> = lines
        .flat_map(|text| text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect::<Vec<Stage>>())
        .filter(|stage| stage.ts.is_finite() && stage.dur.is_finite() && stage.dur >= 0.0)
        .collect();
    stages.sort_by(|a, b| a.ts.total_cmp(&b.ts).then(b.dur.total_cmp(&a.dur)));
    let first = stages.first().map_or(0.0, |stage| stage.ts);
    stages.iter_mut().for_each(|stage| stage.ts -= first);
    stages
}

/// Lines in the order in which they are drawn: what flies first, what computes below.
const ORDER: [&str; 9] =
    ["planner", "px4-link", "camera", "trainer", "scorer", "world", "recorder", "simulator", "launch"];

fn place(service: &str) -> usize {
    ORDER.iter().position(|name| *name == service).unwrap_or(ORDER.len())
}

/// Lines of the picture by service and name.
pub(crate) fn tracks(stages: &[Stage]) -> Vec<(&str, &str)> {
    let mut tracks: Vec<(usize, &str, &str)> =
        stages.iter().map(|stage| (place(&stage.cat), stage.cat.as_str(), stage.tid.as_str())).collect();
    tracks.sort_unstable();
    tracks.dedup();
    tracks.into_iter().map(|(_, service, track)| (service, track)).collect()
}

/// The Chrome trace: a process for each life of a service, a thread for each line. Of stages that overlap on a line without
/// one being inside the other, which the format does not allow, the later get further lines.
fn to_trace(stages: &[Stage]) -> Value {
    let mut threads: BTreeMap<(u32, &str), usize> = BTreeMap::new();
    let mut open: BTreeMap<(u32, &str), Vec<Vec<f64>>> = BTreeMap::new();
    let mut events = Vec::new();
    let mut named = std::collections::BTreeSet::new();
    for stage in stages {
        let key = (stage.pid, stage.tid.as_str());
        let next = threads.len();
        let thread = *threads.entry(key).or_insert(next);
        let rows = open.entry(key).or_default();
        let row = row_for(rows, stage.ts, stage.ts + stage.dur);
        let tid = 100 * thread + row;
        if named.insert((stage.pid, None)) {
            let arguments = json!({"name": format!("{} ({})", stage.cat, stage.pid)});
            events.push(json!({"name": "process_name", "ph": "M", "pid": stage.pid, "args": arguments}));
            let order = json!({"sort_index": place(&stage.cat)});
            events.push(json!({"name": "process_sort_index", "ph": "M", "pid": stage.pid, "args": order}));
        }
        if named.insert((stage.pid, Some(tid))) {
            let arguments = json!({"name": stage.tid});
            events.push(json!({"name": "thread_name", "ph": "M", "pid": stage.pid, "tid": tid, "args": arguments}));
        }
        events.push(json!({
            "name": stage.name, "cat": stage.cat, "ph": "X", "ts": stage.ts, "dur": stage.dur,
            "pid": stage.pid, "tid": tid, "args": stage.args,
        }));
    }
    json!({"traceEvents": events, "displayTimeUnit": "ms"})
}

/// The first row on which something from `begin` to `end` is free, or within what is open there; rows hold the ends of what
/// is open, the innermost last.
fn row_for(rows: &mut Vec<Vec<f64>>, begin: f64, end: f64) -> usize {
    for (index, open) in rows.iter_mut().enumerate() {
        while open.last().is_some_and(|&last| last <= begin) {
            open.pop();
        }
        if open.last().is_none_or(|&last| end <= last) {
            open.push(end);
            return index;
        }
    }
    rows.push(vec![end]);
    rows.len() - 1
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn stage(service: &str, track: &str, ts: f64, dur: f64) -> Stage {
        let (cat, tid) = (service.to_owned(), track.to_owned());
        Stage { name: "work".to_owned(), cat, ts, dur, pid: 7, tid, args: Map::new() }
    }

    proptest! {
        #[test]
        fn stages_of_a_line_of_the_trace_lie_apart_or_inside_of_each_other(
            spans in prop::collection::vec((0_u32..50, 0_u32..20), 0..40),
        ) {
            let mut stages: Vec<Stage> =
                spans.iter().map(|&(ts, dur)| stage("trainer", "train", ts.into(), dur.into())).collect();
            stages.sort_by(|a, b| a.ts.total_cmp(&b.ts).then(b.dur.total_cmp(&a.dur)));
            let trace = to_trace(&stages);
            let events: Vec<&Value> =
                trace["traceEvents"].as_array().unwrap().iter().filter(|event| event["ph"] == "X").collect();
            prop_assert_eq!(events.len(), stages.len());
            let span = |event: &Value| {
                let begin = event["ts"].as_f64().unwrap();
                (begin, begin + event["dur"].as_f64().unwrap())
            };
            for (i, a) in events.iter().enumerate() {
                for b in &events[i + 1..] {
                    let ((begin, end), (later, later_end)) = (span(a), span(b));
                    prop_assert!(a["tid"] != b["tid"] || later >= end || (later >= begin && later_end <= end));
                }
            }
        }
    }

    #[test]
    fn lines_of_several_processes_make_one_trace_and_a_picture() {
        let parent = tempfile::tempdir().unwrap();
        let folder = MissionFolder::create(parent.path().join("mission")).unwrap();
        assert!(!write(&folder).unwrap(), "nothing was traced");
        std::fs::create_dir(folder.trace_path()).unwrap();
        let line = |cat: &str, tid: &str, name: &str, ts: f64, dur: f64| {
            let event = json!({"name": name, "cat": cat, "ph": "X", "ts": ts, "dur": dur, "pid": 3, "tid": tid,
                               "args": {"round": 2}});
            format!("{event}\n")
        };
        let trainer = [
            line("trainer", "train", "train", 5_000_000.0, 2_000_000.0),
            line("trainer", "train", "<&>", 7_000_000.0, 1.0),
            "{\"name\": \"cut o".to_owned(),
        ];
        std::fs::write(folder.trace_path().join("trainer.jsonl"), trainer.concat()).unwrap();
        let planner = line("planner", "flight", "transit", 4_000_000.0, 1_500_000.0);
        std::fs::write(folder.trace_path().join("planner.jsonl"), planner).unwrap();
        assert!(write(&folder).unwrap());
        let trace: Value =
            serde_json::from_slice(&std::fs::read(folder.report_path().join("trace.json")).unwrap()).unwrap();
        let events = trace["traceEvents"].as_array().unwrap();
        let train = events.iter().find(|event| event["name"] == "train").unwrap();
        assert_eq!((&train["ts"], &train["args"]["round"]), (&json!(1e6), &json!(2)));
        assert!(events.iter().any(|event| event["name"] == "thread_name" && event["args"]["name"] == "flight"));
        let picture = std::fs::read_to_string(folder.report_path().join("timeline.svg")).unwrap();
        assert!(picture.starts_with("<svg") && picture.contains("transit") && picture.contains("&lt;&amp;&gt;"));
        assert!(!picture.contains("<&>"));
    }
}
