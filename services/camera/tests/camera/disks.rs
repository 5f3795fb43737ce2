//! The camera on disks that are full or slow.

use std::sync::mpsc::sync_channel;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use shared_types::config::ClockMode;
use shared_types::messages::{CaptureStatus, ServiceState};
use shared_types::payload::unpack_text;
use shared_types::service::Service as _;
use shared_types::storage;
use shared_types::storage::faulty::{Full, Slow};

use crate::capture::Rig;
use crate::common::{request, tick};

#[test]
fn a_keyframe_that_finds_no_room_is_answered_and_taken_once_there_is_some() {
    let root = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
    let mut rig = Rig::new(root.path());
    let disk = Full::with_room(10_000);
    let _mount = storage::mount(root.path(), Arc::new(disk.clone()));
    rig.ask(1, &request(3, 7));
    let (_, reply) = rig.ticks_until_reply(600);
    let why = unpack_text(&reply.reason);
    assert_eq!(reply.status, CaptureStatus::Failed.code(), "{why}");
    assert!(why.starts_with("not stored: no room for ") && why.contains("bytes of "), "{why}");
    let health = rig.service.health();
    assert_eq!(health.state, ServiceState::Degraded, "{health:?}");
    assert!(health.last_error.contains("000003") && health.last_error.contains("bytes of"), "{health:?}");
    assert!(rig.keyframes_seen().is_empty(), "nothing is published that is not on the disk");
    let left = std::fs::read_dir(rig.folder.keyframes_path()).expect("folder").count();
    assert_eq!(left, 0, "nothing half-made is left");
    disk.free(1_000_000);
    rig.ask(2, &request(3, 7));
    let (_, reply) = rig.ticks_until_reply(600);
    assert_eq!(reply.status, CaptureStatus::Stored.code(), "{}", unpack_text(&reply.reason));
    assert_eq!(rig.keyframes_seen(), [3]);
    let health = rig.service.health();
    assert_eq!((health.state, health.last_error.as_str()), (ServiceState::Running, ""), "{health:?}");
}

#[test]
fn a_slow_disk_does_not_hold_the_loop_up_on_the_walls_clock() {
    let root = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
    let mut rig = Rig::with_clock(root.path(), ClockMode::Wall);
    let (pass, passed) = sync_channel::<()>(0);
    let waits = Arc::new(Mutex::new((Duration::ZERO, passed)));
    let noted = Arc::clone(&waits);
    let slow = Slow::new(
        1e6,
        Arc::new(move |wait| {
            let mut noted = noted.lock().expect("lock");
            noted.0 += wait;
            // Until the test says that this time is over.
            noted.1.recv().ok();
        }),
    );
    let _mount = storage::mount(root.path(), Arc::new(slow));
    rig.ask(1, &request(3, 7));
    let began = Instant::now();
    // The loop turns while the disk works: mission time that is longer than any fsync.
    while rig.service.health().received < 200 {
        rig.tick_once();
        assert!(rig.others.reply(tick(rig.k)).is_none(), "not before it is on the disk");
        assert!(began.elapsed() < Duration::from_secs(60));
    }
    assert!(rig.folder.list_keyframes().expect("list").is_empty());
    drop(pass);
    let (_, reply) = rig.ticks_until_reply(3_000);
    assert_eq!(reply.status, CaptureStatus::Stored.code(), "{}", unpack_text(&reply.reason));
    let waited = waits.lock().expect("lock").0;
    println!("a keyframe of 160 x 120 keeps a disk of 1 MB/s busy for {:.0} ms", waited.as_secs_f64() * 1e3);
    assert!(waited > Duration::from_millis(5));
}
