//! The desk on disks that are full, slow and dead.

use std::path::Path;
use std::sync::mpsc::sync_channel;
use std::sync::{Arc, Mutex};

use shared_types::messages::VehicleCommand;
use shared_types::storage::faulty::{Full, Slow};
use shared_types::storage::{self, Mount};

use super::*;
use crate::journal::{Record, parse};

const LONG: Duration = Duration::from_secs(20);
const PATIENCE_NS: u64 = 30 * NS_PER_S;

fn turn(id: u64) -> Outputs {
    let record = Record::Command { command: VehicleCommand::Takeoff, altitude_m: 2.5 };
    let entries = vec![Entry { id, now_ns: id * 10, record }];
    Outputs { entries, effects: vec![Effect::CommandOver(id), Effect::CaptureOver(id)] }
}

fn ids(path: &Path) -> Vec<u64> {
    let (entries, _) = parse(&std::fs::read(path).unwrap(), path).unwrap();
    entries.iter().map(|entry| entry.id).collect()
}

/// A desk over a journal on a disk with so much room.
fn on_a_full_disk(room_bytes: u64) -> (tempfile::TempDir, Full, Mount, Desk) {
    let folder = tempfile::tempdir().unwrap();
    let disk = Full::with_room(room_bytes);
    let mount = storage::mount(folder.path(), Arc::new(disk.clone()));
    let (journal, _) = Journal::open(&folder.path().join("journal.jsonl")).unwrap();
    (folder, disk, mount, Desk::start(journal, PATIENCE_NS).unwrap())
}

fn written(id: u64, late: bool) -> Settled {
    Settled::Written { effects: turn(id).effects, late }
}

#[test]
fn what_is_announced_is_done_once_it_is_on_the_disk() {
    let (folder, _disk, _mount, mut desk) = on_a_full_disk(10_000);
    assert_eq!(desk.settle(0, LONG).unwrap(), Settled::Empty);
    for id in 1..=3 {
        desk.put(turn(id)).unwrap();
        assert!(desk.is_taken());
        assert_eq!(desk.settle(id, LONG).unwrap(), written(id, false));
        assert_eq!(ids(&folder.path().join("journal.jsonl")).len() as u64, id);
    }
}

#[test]
fn a_full_disk_holds_the_turn_and_room_lets_it_go() {
    let (folder, disk, _mount, mut desk) = on_a_full_disk(120);
    let path = folder.path().join("journal.jsonl");
    desk.put(turn(1)).unwrap();
    assert_eq!(desk.settle(0, LONG).unwrap(), written(1, false));
    desk.put(turn(2)).unwrap();
    assert_eq!(desk.settle(NS_PER_S, LONG).unwrap(), Settled::Refused);
    let why = desk.trouble().unwrap().to_owned();
    assert!(why.contains("journal.jsonl") && why.contains("bytes") && why.contains("free disk space"), "{why}");
    assert_eq!(ids(&path), [1], "nothing of the second is left");
    assert_eq!(std::fs::read(&path).unwrap().last(), Some(&b'\n'), "and no torn line");
    // Asked again after a second, and not before.
    disk.free(200);
    assert_eq!(desk.settle(NS_PER_S + RETRY_NS - 1, LONG).unwrap(), Settled::Refused);
    assert_eq!(desk.settle(NS_PER_S + RETRY_NS, LONG).unwrap(), written(2, false));
    assert_eq!(desk.trouble(), None);
    assert_eq!(ids(&path), [1, 2]);
}

#[test]
fn after_its_patience_the_desk_gives_up_and_what_comes_after_is_late() {
    let (folder, disk, _mount, mut desk) = on_a_full_disk(0);
    desk.put(turn(1)).unwrap();
    let mut now_ns = 0;
    while now_ns <= PATIENCE_NS {
        assert_eq!(desk.settle(now_ns, LONG).unwrap(), Settled::Refused);
        assert_eq!(desk.gave_up(), now_ns >= PATIENCE_NS, "at {now_ns}");
        now_ns += RETRY_NS;
    }
    disk.free(1000);
    assert_eq!(desk.settle(now_ns, LONG).unwrap(), written(1, true));
    assert!(!desk.gave_up());
    assert_eq!(ids(&folder.path().join("journal.jsonl")), [1]);
}

#[test]
fn a_slow_disk_holds_nobody_up() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("journal.jsonl");
    let (journal, _) = Journal::open(&path).unwrap();
    drop(journal);
    let (pass, passed) = sync_channel::<()>(0);
    let waits = Arc::new(Mutex::new((Vec::new(), passed)));
    let noted = Arc::clone(&waits);
    let slow = Slow::new(
        1e6,
        Arc::new(move |wait| {
            let mut noted = noted.lock().unwrap();
            noted.0.push(wait);
            noted.1.recv().unwrap();
        }),
    );
    let _mount = storage::mount(folder.path(), Arc::new(slow));
    let (journal, _) = Journal::open(&path).unwrap();
    let mut desk = Desk::start(journal, PATIENCE_NS).unwrap();
    desk.put(turn(1)).unwrap();
    // The loop turns as often as it likes while the disk works.
    for tick in 0..50 {
        assert_eq!(desk.settle(tick * NS_PER_S, Duration::ZERO).unwrap(), Settled::Writing);
    }
    assert!(desk.is_taken() && desk.trouble().is_none(), "slow is not broken");
    pass.send(()).unwrap();
    assert_eq!(desk.settle(60 * NS_PER_S, LONG).unwrap(), written(1, false));
    let bytes = std::fs::read(&path).unwrap().len();
    assert_eq!(waits.lock().unwrap().0, [Duration::from_secs_f64(bytes as f64 / 1e6)]);
}

#[test]
fn what_was_in_flight_can_be_forgotten_while_its_line_is_kept() {
    let (folder, disk, _mount, mut desk) = on_a_full_disk(0);
    let mut outputs = turn(1);
    let request = shared_types::messages::CommandRequest { command: 1, ..Default::default() };
    outputs.effects.push(Effect::Command(1, request));
    desk.put(outputs).unwrap();
    assert_eq!(desk.settle(0, LONG).unwrap(), Settled::Refused);
    desk.forget_requests();
    disk.free(1000);
    assert_eq!(desk.settle(RETRY_NS, LONG).unwrap(), written(1, false), "the command is not sent");
    assert_eq!(ids(&folder.path().join("journal.jsonl")), [1]);
}
