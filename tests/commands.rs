//! Bad input: every refusal names the thing and the way out, has the right exit code, and loses nothing.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::fs;
use std::path::Path;
use std::process::Output;

use common::{leftovers, system_files, vantage};

fn run(arguments: &[&str]) -> (Option<i32>, String) {
    let Output { status, stderr, stdout } = vantage().args(arguments).output().expect("vantage runs");
    (status.code(), String::from_utf8_lossy(&stderr).into_owned() + &String::from_utf8_lossy(&stdout))
}

fn refused(arguments: &[&str], code: i32, words: &[&str]) {
    let (status, text) = run(arguments);
    assert_eq!(status, Some(code), "{arguments:?}: {text}");
    for word in words {
        assert!(text.contains(word), "{arguments:?} should say {word:?}: {text}");
    }
    assert!(!text.contains("panicked"), "{text}");
}

fn text(path: &Path) -> &str {
    path.to_str().expect("utf8")
}

#[test]
fn arguments_and_keys_that_do_not_exist_are_refused_with_64() {
    refused(&["fly", "--presett", "tiny"], 64, &["--presett"]);
    refused(&["fly", "--preset", "huge"], 64, &["huge", "tiny"]);
    refused(&["fly", "--set", "planner.keyframez=4"], 64, &["planner.keyframez", "keyframes"]);
    refused(&["fly", "--set", "planner.keyframes=-4"], 64, &["planner.keyframes"]);
    refused(&["fly", "--speed", "-3"], 64, &["clock.speed"]);
}

#[test]
fn a_wrong_configuration_file_is_named_with_its_line() {
    let folder = tempfile::tempdir().expect("folder");
    let file = folder.path().join("wrong.toml");
    fs::write(&file, "[world]\nsize_m = 1.0\nsize_cm = 3\n").expect("written");
    refused(&["fly", "--config", text(&file)], 64, &["wrong.toml:3", "size_cm"]);
    refused(&["fly", "--config", "/nonexistent/a.toml"], 64, &["/nonexistent/a.toml"]);
}

#[test]
fn meshes_that_cannot_be_flown_around_are_refused_before_anything_is_made() {
    let folder = tempfile::tempdir().expect("folder");
    let output = folder.path().join("mission");
    for (name, content, word) in [
        ("empty.obj", "", "empty.obj"),
        ("nan.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "nan.obj"),
        ("points.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "points.obj"),
        ("noise.glb", "glTF nonsense", "noise.glb"),
        ("text.txt", "hello", "text.txt"),
    ] {
        let mesh = folder.path().join(name);
        fs::write(&mesh, content).expect("written");
        refused(&["fly", "--object", text(&mesh), "--output", text(&output)], 64, &[word]);
    }
    refused(&["fly", "--object", "/nonexistent/rock.obj"], 64, &["/nonexistent/rock.obj"]);
    refused(&["fly", "--set", "world.size_m=3.9"], 64, &["world.size_m"]);
    assert!(!output.exists(), "nothing was made");
}

#[test]
fn a_folder_that_holds_a_mission_is_not_touched() {
    let folder = tempfile::tempdir().expect("folder");
    let mission = folder.path().join("mission");
    fs::create_dir(&mission).expect("made");
    fs::write(mission.join("mission.toml"), "# precious\n").expect("written");
    let before = system_files();
    refused(&["fly", "--preset", "tiny", "--output", text(&mission)], 64, &["mission", "resume"]);
    assert_eq!(fs::read_to_string(mission.join("mission.toml")).expect("kept"), "# precious\n");
    assert!(leftovers(&before).iter().all(|path| !text(path).contains("mission")));
}

#[test]
fn folders_without_a_mission_and_broken_models_are_named() {
    let folder = tempfile::tempdir().expect("folder");
    refused(&["resume", text(folder.path())], 64, &["mission"]);
    refused(&["evaluate", "/nonexistent/mission"], 64, &["/nonexistent/mission"]);
    refused(&["export", "/nonexistent/mission", "--format", "ply", "--output", "x.ply"], 64, &["/nonexistent/mission"]);
    refused(&["export", text(folder.path()), "--format", "docx", "--output", "x"], 64, &["docx"]);
}

#[test]
fn a_model_file_is_exported_in_another_format_and_a_broken_one_named() {
    let folder = tempfile::tempdir().expect("folder");
    let model = splatting::Gaussians::new();
    let source = folder.path().join("rock.ply");
    let mut file = fs::File::create(&source).expect("made");
    splatting::ply::write(&model, &mut file).expect("written");
    let (status, said) = run(&["export", text(&source), "--format", "spz"]);
    let out = folder.path().join("rock.spz");
    assert_eq!((status, said), (Some(0), format!("{}: 0 Gaussians\n", text(&out))));
    assert_eq!(splatting::formats::spz::read(&fs::read(&out).expect("there")).expect("an SPZ"), model);
    refused(&["export", text(&source), "--format", "colmap"], 64, &["rock.ply", "mission folder"]);
    refused(&["export", text(&source), "--format", "ply"], 64, &["rock.ply", "--output"]);
    refused(&["export", text(&source), "--format", "glb"], 1, &["rock.glb", "0 Gaussians"]);
    fs::write(&out, b"NGSP").expect("written");
    refused(&["export", text(&out), "--format", "ply"], 1, &["rock.spz", "version"]);
    let notes = folder.path().join("notes.txt");
    fs::write(&notes, "ply").expect("written");
    refused(&["export", text(&notes), "--format", "glb"], 64, &["notes.txt", ".glb"]);
}

#[test]
fn every_command_has_help_with_an_example_and_the_configuration_is_printed_whole() {
    for command in [
        "fly",
        "resume",
        "status",
        "doctor",
        "evaluate",
        "export",
        "reconstruct",
        "config",
        "px4-link",
        "camera",
        "trainer",
        "scorer",
        "planner",
        "keeper",
        "simulator",
        "world",
    ] {
        let (status, text) = run(&[command, "--help"]);
        assert_eq!(status, Some(0), "{command}: {text}");
        assert!(text.contains(&format!("Example: vantage {command}")), "{command}: {text}");
    }
    let folder = tempfile::tempdir().expect("folder");
    let (status, printed) = run(&["config", "--preset", "quick"]);
    assert_eq!(status, Some(0));
    let file = folder.path().join("quick.toml");
    fs::write(&file, &printed).expect("written");
    let (status, again) = run(&["config", "--config", text(&file)]);
    assert_eq!((status, again), (Some(0), printed), "a printed configuration reads back as itself");
}

#[test]
fn a_machine_that_lets_too_few_files_be_open_is_refused_with_both_numbers() {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let flown = |limit: &str| {
        let vantage = vantage();
        let mut shell = std::process::Command::new("sh");
        shell.args(["-c", &format!("ulimit {limit} && exec \"$0\" fly --preset tiny --output \"$1\"")]);
        shell.arg(vantage.get_program()).arg(&folder);
        shell
    };
    let output = flown("-n 300").output().expect("runs");
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(69), "{told}");
    assert!(told.contains("may open 300 files, expected at least 512: `ulimit -n 1024`"), "{told}");
    assert!(!folder.exists(), "nothing was made");
    // A soft limit is raised.
    let output = flown("-Sn 300").output().expect("runs");
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
}
