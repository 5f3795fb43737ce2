//! A loss of power at any place of the journal's writing: what is read then are the first so many of its lines, never fewer
//! than were synced, and the journal goes on.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

use std::path::Path;
use std::sync::Arc;

use planner::journal::{Entry, Journal, JournalError, Record};
use shared_types::messages::VehicleCommand;
use shared_types::storage;
use shared_types::storage::record::{Op, Recorder, Trace};
use shared_types::storage::replay::every_outcome;

fn short(id: u64, turn: u64) -> Entry {
    Entry {
        id,
        now_ns: turn * 10_000_000,
        record: Record::Command { command: VehicleCommand::Takeoff, altitude_m: 0.1 + 0.2 },
    }
}

/// A line of more than a block.
fn long(id: u64, turn: u64) -> Entry {
    let path: Vec<[f64; 6]> = (0..50).map(|i| [f64::from(i) / 7.0; 6]).collect();
    let record = Record::Target { purpose: "selected".to_owned(), keyframe_id: Some(id), path, back: Vec::new() };
    Entry { id, now_ns: turn * 10_000_000, record }
}

/// The turns of a mission: what each appended.
fn turns() -> Vec<Vec<Entry>> {
    vec![
        vec![short(1, 1)],
        vec![short(2, 2), short(3, 2), short(4, 2)],
        vec![long(5, 3)],
        vec![long(6, 4), short(7, 4), long(8, 4), short(9, 4)],
        vec![short(10, 5)],
    ]
}

/// Records the writing of these turns; a place in the trace for the end of each.
fn recorded(turns: &[Vec<Entry>]) -> (Trace, Vec<usize>) {
    let dir = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
    let recorder = Recorder::new(dir.path()).expect("read");
    let _mount = storage::mount(dir.path(), Arc::new(recorder.clone()));
    let (mut journal, _) = Journal::open(&dir.path().join("journal.jsonl")).expect("made");
    let mut ends = Vec::new();
    for turn in turns {
        journal.append(turn).expect("appended");
        ends.push(recorder.trace().ops.len());
    }
    (recorder.trace(), ends)
}

#[test]
fn a_cut_journal_holds_all_that_was_synced_and_goes_on() {
    let turns = turns();
    let all: Vec<Entry> = turns.concat();
    let (trace, ends) = recorded(&turns);
    assert!(trace.ops.iter().filter(|op| matches!(op, Op::Sync(_))).count() >= turns.len());
    // The same once more for each turn as the last: what was synced before it must be there.
    for (number, end) in ends.iter().enumerate() {
        let synced: usize = turns[..number].iter().map(Vec::len).sum();
        let begin = if number == 0 { 0 } else { ends[number - 1] };
        let before = materialised(&trace, begin);
        let last = Trace { before, ops: reopened(&trace, begin, *end) };
        let dir = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
        let findings = every_outcome(&last, &dir.path().join("m"), |root| {
            let path = root.join("journal.jsonl");
            let (mut journal, entries) = Journal::open(&path).map_err(|error| error.to_string())?;
            if entries != all[..entries.len()] {
                return Err("lines that nobody wrote".to_owned());
            }
            if entries.len() < synced {
                return Err(format!("{} lines, and {synced} were synced", entries.len()));
            }
            let next = short(entries.len() as u64 + 1, 99);
            journal.append(std::slice::from_ref(&next)).map_err(|error| error.to_string())?;
            let (_, again) = Journal::open(&path).map_err(|error| error.to_string())?;
            if again.len() != entries.len() + 1 || again.last() != Some(&next) {
                return Err("it does not go on".to_owned());
            }
            Ok(match entries.len() - synced {
                0 => "the turn is absent",
                n if n == turns[number].len() => "the turn is there",
                _ => "its first lines are there",
            })
        })
        .unwrap_or_else(|why| panic!("turn {number}: {why}"));
        println!("turn {number}: {} cuts, {} outcomes: {:?}", findings.places, findings.distinct, findings.by_name);
        assert!(findings.by_name.len() >= 2, "{findings:?}");
    }
}

/// What lies there after the first operations, all of them on the disk.
fn materialised(trace: &Trace, ops: usize) -> shared_types::storage::record::Tree {
    let mut tree = trace.before.clone();
    for op in &trace.ops[..ops] {
        match op {
            Op::Open(_, path) => {
                tree.entry(path.clone()).or_insert_with(|| Some(Vec::new()));
            }
            Op::Write(_, bytes) => {
                let file = tree.values_mut().flatten().next().expect("one file");
                file.extend_from_slice(bytes);
            }
            _ => {}
        }
    }
    tree
}

/// Operations of a stretch; the file, opened before it, is opened anew.
fn reopened(trace: &Trace, begin: usize, end: usize) -> Vec<Op> {
    let opening = trace.ops[..begin].iter().filter(|op| matches!(op, Op::Open(..))).cloned();
    opening.chain(trace.ops[begin..end].iter().cloned()).collect()
}

#[test]
fn a_hole_in_older_lines_is_damage_and_not_a_torn_end() {
    let dir = tempfile::tempdir().expect("folder");
    let path = dir.path().join("journal.jsonl");
    let (mut journal, _) = Journal::open(&path).expect("made");
    for turn in turns() {
        journal.append(&turn).expect("appended");
    }
    let mut bytes = std::fs::read(&path).expect("read");
    let at = String::from_utf8_lossy(&bytes).find("\"id\":3").expect("line 3");
    bytes[at..at + 6].fill(0);
    std::fs::write(&path, bytes).expect("damaged");
    let message = match Journal::open(&path) {
        Err(error @ JournalError::Damaged { line: 3, .. }) => error.to_string(),
        other => panic!("{other:?}"),
    };
    assert!(message.contains("line 3") && message.contains(&path.display().to_string()), "{message}");
}

#[test]
fn a_full_disk_leaves_whole_lines() {
    let dir = tempfile::tempdir().expect("folder");
    let path = dir.path().join("journal.jsonl");
    let full = |path: &Path| std::fs::read(path).expect("read").len();
    for room in 0..900 {
        let disk = storage::faulty::Full::with_room(room);
        let _mount = storage::mount(dir.path(), Arc::new(disk.clone()));
        let (mut journal, none) = Journal::open(&path).expect("made");
        assert!(none.is_empty());
        let mut kept = 0;
        for turn in &turns()[..2] {
            match journal.append(turn) {
                Ok(()) => kept += turn.len(),
                Err(JournalError::Full { bytes, .. }) => assert!(bytes > 0),
                Err(other) => panic!("{other}"),
            }
        }
        // Read by another meanwhile, and written once there is room.
        let entries = planner::journal::parse(&std::fs::read(&path).expect("read"), &path).expect("whole lines");
        assert_eq!((entries.0.len(), entries.1), (kept, full(&path)), "room for {room} bytes");
        std::fs::remove_file(&path).expect("removed");
    }
}
