use super::*;

#[test]
fn a_system_is_found_by_name_alone_and_leaves_nothing() {
    let base = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
    let system = System::create(base.path(), "one", 0).expect("made");
    assert_eq!(System::find(base.path(), None).expect("the only one"), system);
    assert_eq!(System::find(base.path(), Some("one")).expect("named"), system);
    let other = System::create(base.path(), "two", 0).expect("made");
    assert_ne!(other.prefix, system.prefix);
    let error = System::find(base.path(), None).expect_err("two");
    assert!(error.to_string().contains("one, two"), "{error}");
    system.remove().expect("removed");
    other.remove().expect("removed");
    assert_eq!(fs::read_dir(base.path()).expect("base").count(), 0);
}

#[test]
fn a_running_system_is_not_taken_over_and_a_dead_one_makes_way() {
    let base = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
    let (system, hold) = System::create_held(base.path(), "one", 0).expect("made");
    let second = system.hold().expect("several hold it");
    assert!(system.is_alive());
    let error = System::create(base.path(), "one", 0).expect_err("runs");
    assert!(matches!(error, SystemError::Runs { .. }), "{error}");
    assert!(!system.remove_if_dead().expect("left alone"));
    drop(hold);
    assert!(system.is_alive(), "one is enough");
    drop(second);
    assert!(!system.is_alive());
    let anew = System::create(base.path(), "one", 0).expect("the dead one made way");
    assert_ne!(anew.prefix, system.prefix);
    assert!(anew.remove_if_dead().expect("removed"));
    assert!(matches!(anew.hold(), Err(SystemError::Ended { .. })));
}

#[test]
fn folders_that_are_no_dead_system_are_left_alone() {
    let base = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
    for name in ["..", "", "a/b", "/dev/shm/x"] {
        assert!(matches!(System::create(base.path(), name, 0), Err(SystemError::BadName { .. })), "{name:?}");
    }
    fs::create_dir(base.path().join("half")).expect("made");
    fs::write(base.path().join("half/iceoryx2.toml"), "").expect("written");
    System::create(base.path(), "half", 0).expect("what a killed maker left makes way");
    fs::create_dir(base.path().join("other")).expect("made");
    fs::write(base.path().join("other/precious"), "").expect("written");
    assert!(matches!(System::create(base.path(), "other", 0), Err(SystemError::Io { .. })));
    assert!(base.path().join("other/precious").exists());
    fs::create_dir(base.path().join("torn")).expect("made");
    fs::write(base.path().join("torn/system.json"), "{").expect("written");
    assert!(matches!(System::create(base.path(), "torn", 0), Err(SystemError::Malformed { .. })));
}

#[test]
fn a_path_too_long_for_sockets_is_refused() {
    let error = System::create(Path::new(&format!("/dev/shm/{}", "x".repeat(80))), "n", 0).expect_err("too long");
    assert!(error.to_string().contains("XDG_RUNTIME_DIR"), "{error}");
}
