use clap::Parser as _;
use glam::DVec3;
use reconstruct::dataset::{self, Dataset, LoadOptions};
use shared_types::folder::{Exposure, Frame, Gate, Keyframe};
use shared_types::frames::{Intrinsics, look_at};
use shared_types::messages::KeyframeReason;

use super::*;

#[test]
fn the_command_s_defaults_are_the_library_s() {
    let cli = cli::Cli::try_parse_from(["vantage", "reconstruct", "scene"]).expect("parses");
    let cli::Command::Reconstruct(arguments) = cli.command else { panic!("another command") };
    assert_eq!(format!("{:?}", options_of(&arguments)), format!("{:?}", Options::new("scene")));
}

#[test]
fn errors_carry_the_exit_code_of_their_kind() {
    let unknown = reconstruct::run(&Options::new("/nonexistent"), &mut |_: &Event| ControlFlow::Continue(()));
    let error = refusal(unknown.expect_err("no dataset"));
    assert_eq!(crate::exit::exit_of(&error), Exit::Usage, "{error}");
}

/// A mission of three views whose depth is a plane 1.5 m away, with a prior about the point that they look at.
fn mission(root: &Path) -> MissionFolder {
    let folder = MissionFolder::create_with(root, "mission.seed = 3\n").expect("folder");
    let target = DVec3::new(0.2, -0.1, 0.4);
    for (id, eye) in [(3, DVec3::new(1.2, 0.8, 1.5)), (7, DVec3::new(-1.0, 1.1, 0.9)), (8, DVec3::new(0.3, -1.2, 1.1))]
    {
        let pose = look_at(eye, target);
        let frame = Frame {
            id,
            stamp_ns: id,
            reason: KeyframeReason::Seed,
            candidate: None,
            target_id: 1,
            look_at_m: [0.0; 3],
            world_from_camera_position_m: pose.position_m.to_array(),
            world_from_camera_xyzw: pose.rotation.to_array(),
            intrinsics: Intrinsics { cx: 31.25, ..Intrinsics::from_hfov(64, 48, 1.2) },
            depth_unit_m: 0.0005,
            gate: Gate::default(),
            exposure: Exposure::default(),
        };
        let depth_units = (0..64 * 48).map(|i| if (1_000..2_000).contains(&i) { 3_000 } else { 0 }).collect();
        let rgb = (0..64 * 48 * 3).map(|i| ((i + id as usize) % 251) as u8).collect();
        folder.write_keyframe(&Keyframe { frame, rgb, depth_units }).expect("written");
    }
    let prior = r#"{"center_m":[0.2,-0.1,0.4],"size_m":1.5,"ground":{"slope":[0.0,0.1],"offset_m":-0.2}}"#;
    std::fs::write(folder.journal_path(), format!("{{\"event\":\"prior\",\"prior\":{prior}}}\n")).expect("journal");
    folder
}

fn loaded(root: &Path) -> Dataset {
    let listing = dataset::list(root, None).expect("listed");
    let mask = reconstruct::MaskUse::Off;
    dataset::load(&listing, &LoadOptions { downscale: Some(2), mask, memory_bytes: 1 << 24 }).expect("loaded")
}

#[test]
fn a_mission_and_its_exports_give_the_same_cameras_and_images() {
    let dir = tempfile::tempdir().expect("folder");
    let folder = mission(&dir.path().join("mission"));
    let exported = |format, name: &str| {
        let out = dir.path().join(name);
        crate::export::export(&folder, format, &out).expect("exported");
        loaded(&out)
    };
    let mission = loaded(folder.root());
    let colmap = exported(crate::export::Format::Colmap, "colmap");
    let nerfstudio = exported(crate::export::Format::Nerfstudio, "nerfstudio");
    let text = dir.path().join("colmap");
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        std::fs::remove_file(text.join("sparse/0").join(name)).expect("removed");
    }
    let text = loaded(&text);
    assert_eq!(mission.images.len(), 3);
    for other in [&colmap, &text, &nerfstudio] {
        assert_eq!(other.images.len(), 3);
        for (a, b) in mission.images.iter().zip(&other.images) {
            assert!(b.name.ends_with(&a.name), "{} and {}", a.name, b.name);
            assert_eq!(a.colors, b.colors);
            let (p, q) = (a.camera.world_from_camera, b.camera.world_from_camera);
            assert!((p.translation - q.translation).length() < 1e-5, "{p:?} {q:?}");
            assert!(1.0 - p.rotation.dot(q.rotation).abs() < 1e-6, "{p:?} {q:?}");
            for (x, y) in [
                (a.camera.fx, b.camera.fx),
                (a.camera.fy, b.camera.fy),
                (a.camera.cx, b.camera.cx),
                (a.camera.cy, b.camera.cy),
            ] {
                assert!((x - y).abs() < 1e-5, "{x} {y}");
            }
            assert_eq!((a.camera.width, a.camera.height), (32, 24));
            // The same point of the world on the same pixel, which is what the parts are for.
            let seen = [a, b].map(|image| image.camera.project(glam::Vec3::new(0.25, -0.05, 0.35)).expect("ahead"));
            assert!((seen[0].0 - seen[1].0).length() < 1e-3 && (seen[0].1 - seen[1].1).abs() < 1e-5, "{seen:?}");
        }
    }
    for (a, b) in mission.images.iter().zip(&nerfstudio.images) {
        assert_eq!(a.depth_m, b.depth_m, "depth goes with its unit");
    }
    assert!(!colmap.has_depth());
    assert_eq!(colmap.points.len(), text.points.len());
    let between = |a: &Dataset, b: &Dataset| {
        a.points.iter().zip(&b.points).map(|(p, q)| p.position.distance(q.position)).fold(0.0, f64::max)
    };
    assert!(colmap.points.len() > 100 && between(&colmap, &text) < 1e-9 && between(&colmap, &nerfstudio) < 1e-5);
    // The exports' masks are what training on the mission makes of depth and box.
    let masked = |root: &Path| {
        let listing = dataset::list(root, None).expect("listed");
        let options = LoadOptions { downscale: Some(1), mask: reconstruct::MaskUse::Auto, memory_bytes: 1 << 24 };
        let images = dataset::load(&listing, &options).expect("loaded").images;
        let counted = |image: dataset::Image| {
            image.classes.expect("classes").iter().map(|&class| class == splatting::PixelClass::Foreground).collect()
        };
        images.into_iter().map(counted).collect::<Vec<Vec<bool>>>()
    };
    let expected = masked(folder.root());
    assert!(expected.iter().flatten().any(|&object| object) && expected.iter().flatten().any(|&object| !object));
    assert_eq!(masked(&dir.path().join("colmap")), expected);
    assert_eq!(masked(&dir.path().join("nerfstudio")), expected);
    let stage = mission.stage.expect("the prior");
    assert!(
        (stage.clip.min.z - (-0.2 - 0.01 - 0.03)).abs() < 1e-6,
        "ground under the centre less the margin: {stage:?}"
    );
}

#[test]
fn a_mission_without_a_prior_says_so() {
    let dir = tempfile::tempdir().expect("folder");
    let folder = mission(dir.path());
    std::fs::write(folder.journal_path(), "{\"event\":\"started\"}\n").expect("journal");
    let message = dataset::list(folder.root(), None).expect_err("no prior").to_string();
    assert!(message.contains("journal.jsonl") && message.contains("never found its object"), "{message}");
    std::fs::remove_file(folder.journal_path()).expect("removed");
    assert!(dataset::list(folder.root(), None).expect_err("no journal").to_string().contains("does not exist"));
}

#[test]
fn a_mission_without_its_configuration_is_not_taken_for_one_of_the_defaults() {
    let dir = tempfile::tempdir().expect("folder");
    let folder = mission(dir.path());
    std::fs::write(folder.config_path(), "\n# nothing\n").expect("emptied");
    let options = Options::new(folder.root());
    let refused =
        || refusal(reconstruct::run(&options, &mut |_: &Event| ControlFlow::Continue(())).expect_err("refused"));
    assert!(refused().to_string().contains("mission.toml is empty"), "{}", refused());
    std::fs::remove_file(folder.config_path()).expect("removed");
    assert!(refused().to_string().contains("mission.toml is missing"), "{}", refused());
    assert_eq!(crate::exit::exit_of(&refused()), Exit::Usage);
}

#[test]
fn a_run_is_measured_once_its_figures_say_so() {
    let dir = tempfile::tempdir().expect("folder");
    let path = dir.path().join("metrics.json");
    assert!(!is_measured(dir.path()), "nothing is there");
    std::fs::write(&path, "{\"gaussians\": 3}").expect("written");
    assert!(!is_measured(dir.path()));
    std::fs::write(&path, "{\"gaussians\": 3, \"offline\": {}}").expect("written");
    assert!(is_measured(dir.path()));
}
