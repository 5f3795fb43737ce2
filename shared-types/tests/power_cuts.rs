//! A loss of power at any place of the writing of a mission folder's and a system folder's files: what is read then is what
//! was before, what was written, or nothing.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

use std::path::Path;
use std::sync::Arc;

use glam::DVec3;
use shared_types::config::{load, load_mission, preset};
use shared_types::folder::{Exposure, Frame, Gate, Keyframe, MissionFolder, write_atomic};
use shared_types::frames::{Intrinsics, look_at};
use shared_types::messages::KeyframeReason;
use shared_types::storage;
use shared_types::storage::record::{Recorder, Trace};
use shared_types::storage::replay::{Findings, every_outcome};
use shared_types::system::System;

/// A folder whose file system is a recorder while `write` runs.
fn recorded(before: impl FnOnce(&Path), write: impl FnOnce(&Path)) -> Trace {
    let dir = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
    before(dir.path());
    let recorder = Recorder::new(dir.path()).expect("read");
    let mount = storage::mount(dir.path(), Arc::new(recorder.clone()));
    write(dir.path());
    drop(mount);
    recorder.trace()
}

/// Cuts a trace everywhere and prints what was found; `read` is given the folder.
fn cut(name: &str, trace: &Trace, read: impl FnMut(&Path) -> Result<&'static str, String>) -> Findings {
    let dir = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
    match every_outcome(trace, &dir.path().join("after"), read) {
        Ok(findings) => {
            println!("{name}: {} cuts, {} outcomes: {:?}", findings.places, findings.distinct, findings.by_name);
            findings
        }
        Err(why) => panic!("{name}: {why}"),
    }
}

fn keyframe(reason: KeyframeReason, id: u64, shade: u8) -> Keyframe {
    let (width, height) = (40, 30);
    let camera = look_at(DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO);
    Keyframe {
        frame: Frame {
            id,
            stamp_ns: 1_000_000_000 + u64::from(shade),
            reason,
            candidate: Some(3),
            target_id: 7,
            look_at_m: [0.0; 3],
            world_from_camera_position_m: camera.position_m.to_array(),
            world_from_camera_xyzw: camera.rotation.to_array(),
            intrinsics: Intrinsics::from_hfov(width, height, 1.2),
            depth_unit_m: 0.000_2,
            gate: Gate::default(),
            exposure: Exposure::default(),
        },
        rgb: (0..width * height * 3).map(|i| (i * 7 % 251) as u8 ^ shade).collect(),
        depth_units: (0..width * height).map(|i| (i * 13 % 30_011) as u16 ^ u16::from(shade)).collect(),
    }
}

/// One of the versions that were ever written, or none.
fn version<T: PartialEq>(found: Option<T>, old: Option<&T>, new: &T) -> Result<&'static str, String> {
    match found {
        None if old.is_none() => Ok("absent"),
        None => Err("the old version is gone and the new one not there".to_owned()),
        Some(found) if found == *new => Ok("new"),
        Some(found) if Some(&found) == old => Ok("old"),
        Some(_) => Err("content that nobody wrote".to_owned()),
    }
}

fn text(error: impl core::fmt::Display) -> String {
    error.to_string()
}

#[test]
fn a_small_file_is_the_old_or_the_new() {
    let (old, new) = (b"the old content".to_vec(), b"the new and longer content of the file".repeat(20));
    let trace = recorded(
        |root| write_atomic(&root.join("a.json"), &old).expect("old"),
        |root| write_atomic(&root.join("a.json"), &new).expect("new"),
    );
    let findings = cut("a file of 760 bytes", &trace, |root| {
        version(Some(std::fs::read(root.join("a.json")).map_err(text)?), Some(&old), &new)
    });
    assert!(findings.by_name["old"] >= new.len() && findings.by_name["new"] >= 1, "cut at every byte: {findings:?}");
}

#[test]
fn a_large_file_is_the_old_or_the_new() {
    let content = |seed: u32| (0..300_000_u32).map(|i| (i.wrapping_mul(seed) >> 7) as u8).collect::<Vec<u8>>();
    let (old, new) = (content(2_654_435_761), content(40_503));
    let trace = recorded(
        |root| write_atomic(&root.join("model.ply"), &old).expect("old"),
        |root| write_atomic(&root.join("model.ply"), &new).expect("new"),
    );
    let findings = cut("a file of 300 kB", &trace, |root| {
        version(Some(std::fs::read(root.join("model.ply")).map_err(text)?), Some(&old), &new)
    });
    assert!(findings.places >= 400, "200 random places, two fates each: {findings:?}");
}

#[test]
fn a_new_mission_is_there_with_its_configuration_or_not_at_all() {
    let config = load::to_toml(&preset("tiny").expect("preset")).expect("toml");
    let trace = recorded(
        |_| {},
        |root| {
            MissionFolder::create_with(root.join("m"), &config).expect("made");
        },
    );
    let expected = preset("tiny").expect("preset");
    let findings = cut("mission.toml", &trace, |root| {
        let path = root.join("m");
        let Ok(folder) = MissionFolder::open(&path) else {
            // What is there keeps nobody from giving the same command again.
            MissionFolder::create_with(&path, &config).map_err(text)?;
            return Ok("absent");
        };
        let found = load_mission(&folder.config_path()).map_err(text)?;
        // What subfolders are missing is made where they are written to.
        folder.write_keyframe(&keyframe(KeyframeReason::Seed, 0, 1)).map_err(text)?;
        version(Some(found), None, &expected)
    });
    assert!(findings.by_name["absent"] > config.len() && findings.by_name["new"] >= 2, "{findings:?}");
}

#[test]
fn a_keyframe_is_complete_or_absent() {
    let (first, second) = (keyframe(KeyframeReason::Selected, 4, 0), keyframe(KeyframeReason::Selected, 5, 9));
    let folder = |root: &Path| MissionFolder::create(root).expect("folder");
    let trace = recorded(
        |root| drop(folder(root).write_keyframe(&first).expect("first")),
        |root| drop(MissionFolder::open(root).expect("folder").write_keyframe(&second).expect("second")),
    );
    let findings = cut("keyframes/000005", &trace, |root| {
        let folder = MissionFolder::open(root).map_err(text)?;
        let leftovers = std::fs::read_dir(folder.keyframes_path()).map_err(text)?.count();
        let ids = folder.list_keyframes().map_err(text)?;
        if leftovers != ids.len() {
            return Err(format!("{leftovers} entries for {} keyframes: leftovers stay", ids.len()));
        }
        version(folder.read_keyframe(4).map_err(text)?, Some(&first), &first)?;
        let found = version(folder.read_keyframe(5).map_err(text)?, None, &second)?;
        if found == "absent" && ids != [4] {
            return Err(format!("listed {ids:?}, and not there"));
        }
        if found == "absent" {
            // The view is taken again.
            folder.write_keyframe(&second).map_err(text)?;
        }
        Ok(found)
    });
    assert!(findings.by_name["absent"] > 1000 && findings.by_name["new"] >= 1, "{findings:?}");
}

#[test]
fn a_view_of_the_prior_is_the_old_or_the_new() {
    let (old, new) = (keyframe(KeyframeReason::PriorSide, 77, 0), keyframe(KeyframeReason::PriorSide, 78, 9));
    let trace = recorded(
        |root| drop(MissionFolder::create(root).expect("folder").write_keyframe(&old).expect("old")),
        |root| drop(MissionFolder::open(root).expect("folder").write_keyframe(&new).expect("new")),
    );
    cut("prior/side", &trace, |root| {
        let folder = MissionFolder::open(root).map_err(text)?;
        version(folder.read_prior(KeyframeReason::PriorSide).map_err(text)?, Some(&old), &new)
    });
}

#[test]
fn a_system_is_described_whole_or_absent() {
    let trace = recorded(
        |_| {},
        |root| {
            drop(System::create_held(root, "s", 0).expect("made"));
        },
    );
    let findings = cut("system.json, iceoryx2.toml", &trace, |root| {
        let folder = root.join("s");
        let found = match System::open(&folder) {
            Ok(_) if folder.join("iceoryx2.toml").metadata().is_ok_and(|meta| meta.len() > 40) => "new",
            Ok(_) => return Err("described before its bus is configured".to_owned()),
            Err(error) if error.is_absent() => "absent",
            Err(error) => return Err(error.to_string()),
        };
        // What a dead one left is no obstacle for the next of its name.
        let (next, _hold) = System::create_held(root, "s", 0).map_err(text)?;
        if next.runtime_dir != folder || System::list(root).len() != 1 {
            return Err("not made anew".to_owned());
        }
        Ok(found)
    });
    assert!(findings.by_name["absent"] > 100 && findings.by_name["new"] >= 1, "{findings:?}");
}

#[test]
fn a_rename_without_a_sync_may_leave_an_empty_file() {
    // The model itself: what our writers must not do is found.
    let trace = recorded(
        |root| std::fs::write(root.join("a"), "old").expect("old"),
        |root| {
            let disk = storage::of(root);
            disk.create(&root.join("aside")).expect("made").write(b"new").expect("written");
            disk.rename(&root.join("aside"), &root.join("a")).expect("renamed");
        },
    );
    let mut found = Vec::new();
    cut("without a sync", &trace, |root| {
        found.push(std::fs::read_to_string(root.join("a")).map_err(text)?);
        Ok("something")
    });
    for expected in ["old", "new", ""] {
        assert!(found.iter().any(|text| text == expected), "{found:?}");
    }
    assert!(found.iter().any(|text| text == "n" || text == "ne"), "a part: {found:?}");
}

#[test]
fn what_was_written_before_stays_whatever_is_written_after() {
    let trace = recorded(
        |_| {},
        |root| {
            write_atomic(&root.join("a"), b"first").expect("written");
            write_atomic(&root.join("b"), b"second").expect("written");
        },
    );
    let findings = cut("one file after another", &trace, |root| {
        let read = |name: &str| std::fs::read(root.join(name)).ok();
        match (read("a").as_deref(), read("b").as_deref()) {
            (None, None) => Ok("neither"),
            (Some(b"first"), None) => Ok("first"),
            (Some(b"first"), Some(b"second")) => Ok("both"),
            other => Err(format!("{other:?}")),
        }
    });
    assert_eq!(findings.by_name.len(), 3, "{findings:?}");
}
