//! Each export is read back by a reader of its own and must give the pixels that the keyframes have.

use std::fs;

use glam::{DMat4, DQuat, DVec2, DVec3, Quat, Vec3};
use shared_types::folder::{Exposure, Frame, Gate};
use shared_types::frames::look_at;
use shared_types::messages::KeyframeReason;
use splatting::formats::Format::{Glb, Ply, Splat, Spz};
use splatting::{Gaussian, Gaussians};

use super::*;

const POINT_M: DVec3 = DVec3::new(0.2, -0.1, 0.4);

/// Two views; in each the middle of the image is a plane 1.5 m away.
fn mission() -> (tempfile::TempDir, MissionFolder, Vec<Frame>) {
    let dir = tempfile::tempdir().expect("tempdir");
    let folder = MissionFolder::create_with(dir.path().join("m"), "mission.seed = 3\n").expect("folder");
    let mut frames = Vec::new();
    for (id, eye) in [(3, DVec3::new(1.2, 0.8, 1.5)), (7, DVec3::new(-1.0, 1.1, 0.9))] {
        let pose = look_at(eye, POINT_M + DVec3::new(0.05, 0.1, 0.0));
        let frame = Frame {
            id,
            stamp_ns: id,
            reason: KeyframeReason::Seed,
            candidate: None,
            target_id: 1,
            look_at_m: [0.0; 3],
            world_from_camera_position_m: pose.position_m.to_array(),
            world_from_camera_xyzw: pose.rotation.to_array(),
            intrinsics: Intrinsics::from_hfov(64, 48, 1.2),
            depth_unit_m: 0.001,
            gate: Gate::default(),
            exposure: Exposure::default(),
        };
        let depth_units = (0..64 * 48).map(|i| if (1_000..2_000).contains(&i) { 1_500 } else { 0 }).collect();
        let rgb = (0..64 * 48 * 3).map(|i| (i % 251) as u8).collect();
        folder.write_keyframe(&Keyframe { frame: frame.clone(), rgb, depth_units }).expect("write");
        frames.push(frame);
    }
    (dir, folder, frames)
}

/// Where our own camera sees the point.
fn seen(frame: &Frame) -> DVec2 {
    frame.intrinsics.project(frame.world_from_camera().inverse().transform_point(POINT_M)).expect("in front")
}

/// A cursor over little-endian numbers.
struct Bytes(Vec<u8>, usize);

impl Bytes {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        let taken = self.0[self.1..self.1 + N].try_into().expect("N bytes");
        self.1 += N;
        taken
    }
    fn u64(&mut self) -> u64 {
        u64::from_le_bytes(self.take())
    }
    fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.take())
    }
    fn f64(&mut self) -> f64 {
        f64::from_le_bytes(self.take())
    }
}

#[test]
fn colmap_projects_a_point_onto_the_same_pixel() {
    let (dir, folder, frames) = mission();
    let out = dir.path().join("colmap");
    let summary = export(&folder, Format::Colmap, &out).expect("exported");
    assert_eq!(summary.views, 2);
    assert!(summary.points > 300, "{summary:?}");
    assert_eq!(summary.masks, 0, "no box was found");
    let file = |name: &str| fs::read(out.join("sparse/0").join(name)).expect("file");

    let mut cameras = Bytes(file("cameras.bin"), 0);
    assert_eq!((cameras.u64(), cameras.u32(), cameras.u32()), (1, 1, 1), "one PINHOLE camera");
    assert_eq!((cameras.u64(), cameras.u64()), (64, 48));
    let [fx, fy, cx, cy] = [cameras.f64(), cameras.f64(), cameras.f64(), cameras.f64()];
    assert_eq!(cameras.1, cameras.0.len());

    let text = String::from_utf8(file("images.txt")).expect("text");
    let lines: Vec<Vec<&str>> =
        text.lines().filter(|l| !l.starts_with('#')).step_by(2).map(|l| l.split(' ').collect()).collect();
    let mut images = Bytes(file("images.bin"), 0);
    assert_eq!(images.u64(), 2);
    for (id, frame) in (1..).zip(&frames) {
        assert_eq!(images.u32(), id);
        let [w, x, y, z] = [images.f64(), images.f64(), images.f64(), images.f64()];
        let t = DVec3::new(images.f64(), images.f64(), images.f64());
        let p = DQuat::from_xyzw(x, y, z, w) * POINT_M + t;
        let pixel = DVec2::new(fx * p.x / p.z + cx, fy * p.y / p.z + cy);
        assert!((pixel - seen(frame)).length() < 1e-6);
        assert_eq!(images.u32(), 1);
        let name: Vec<u8> = std::iter::from_fn(|| Some(images.take::<1>()[0])).take_while(|b| *b != 0).collect();
        assert_eq!(String::from_utf8(name).expect("name"), format!("{:06}.png", frame.id));
        assert_eq!(images.u64(), 0);
        let line = &lines[id as usize - 1];
        assert_eq!((line[0], line[9]), (id.to_string().as_str(), format!("{:06}.png", frame.id).as_str()));
        assert!((line[1].parse::<f64>().expect("qw") - w).abs() < 1e-12);
        let image = fs::read(out.join(format!("images/{:06}.png", frame.id))).expect("image");
        assert_eq!(image, fs::read(folder.keyframe_path(frame.id).join("rgb.png")).expect("rgb"));
    }
    assert_eq!(images.1, images.0.len());

    let mut points = Bytes(file("points3D.bin"), 0);
    assert_eq!(points.u64(), summary.points as u64);
    assert_eq!(points.u64(), 1);
    let first = DVec3::new(points.f64(), points.f64(), points.f64());
    let depth_m = frames[0].world_from_camera().inverse().transform_point(first).z;
    assert!((depth_m - 1.5).abs() < 1e-9, "{depth_m}");
    assert_eq!(file("points3D.bin").len(), 8 + summary.points * (8 + 24 + 3 + 8 + 8));
}

#[test]
fn nerfstudio_projects_a_point_onto_the_same_pixel() {
    let (dir, folder, frames) = mission();
    let out = dir.path().join("ns");
    let summary = export(&folder, Format::Nerfstudio, &out).expect("exported");
    let json: serde_json::Value =
        serde_json::from_slice(&fs::read(out.join("transforms.json")).expect("file")).expect("json");
    for (written, frame) in json["frames"].as_array().expect("frames").iter().zip(&frames) {
        let rows: [[f64; 4]; 4] = serde_json::from_value(written["transform_matrix"].clone()).expect("matrix");
        let p = DMat4::from_cols_array_2d(&rows).transpose().inverse().transform_point3(POINT_M);
        assert!(p.z < 0.0, "OpenGL looks along -z");
        let number = |key: &str| written[key].as_f64().expect("number");
        let pixel = DVec2::new(number("fl_x") * p.x / -p.z + number("cx"), number("fl_y") * -p.y / -p.z + number("cy"));
        assert!((pixel - seen(frame)).length() < 1e-6);
        for key in ["file_path", "depth_file_path"] {
            assert!(out.join(written[key].as_str().expect("path")).is_file());
        }
    }
    let ply = fs::read_to_string(out.join("points.ply")).expect("ply");
    assert_eq!(ply.lines().skip_while(|line| *line != "end_header").count() - 1, summary.points);
}

/// Nine Gaussians of a degree.
fn model(degree: u8) -> Gaussians {
    let mut model = Gaussians::with_sh_degree(degree);
    for i in 0..9_u8 {
        let x = f32::from(i);
        model.push(&Gaussian {
            mean: Vec3::new(0.1 * x, -0.2 * x, 0.5),
            log_scales: Vec3::new(-4.0, -3.0, -5.0 + 0.1 * x),
            rotation: Quat::from_rotation_z(0.3 * x),
            opacity_logit: 0.5 * x - 2.0,
            sh: [0.1 * x, -0.1, 0.3],
            id: u64::from(i),
            birth_round: 0,
        });
        let bands = std::array::from_fn(|k| [0.01 * k as f32, 0.02 * x, -0.1]);
        model.set_sh_rest(usize::from(i), &bands);
    }
    model
}

fn bytes(format: formats::Format, model: &Gaussians) -> Vec<u8> {
    let mut bytes = Vec::new();
    formats::write(format, model, true, &mut bytes).expect("written");
    bytes
}

#[test]
fn a_model_is_exported_in_every_format_and_what_is_missing_is_named() {
    let (dir, folder, _) = mission();
    let out = dir.path().join("out.ply");
    let message = export(&folder, Format::Model(Ply), &out).expect_err("no model").to_string();
    assert!(message.contains("model.ply") && message.contains("vantage resume"), "{message}");
    let source = folder.model_path().join("model.ply");
    fs::write(&source, bytes(Ply, &model(0))).expect("write");
    for format in formats::Format::ALL {
        let out = dir.path().join(format!("out.{}", format.extension()));
        let summary = export(&folder, Format::Model(format), &out).expect("exported");
        assert_eq!((summary.gaussians, summary.views, summary.lost_sh_degree), (9, 0, None));
        assert_eq!(fs::read(&out).expect("read"), bytes(format, &model(0)), "{format:?}");
    }
    let message = export(&folder, Format::Model(Ply), &source).expect_err("itself").to_string();
    assert!(message.contains("model.ply") && message.contains("--output"), "{message}");
    assert_eq!(fs::read(&source).expect("kept"), bytes(Ply, &model(0)));
    let whole = fs::read(&source).expect("read");
    fs::write(&source, &whole[..whole.len() - 1]).expect("write");
    let message = export(&folder, Format::Model(Ply), &out).expect_err("truncated").to_string();
    assert!(message.contains("model.ply") && message.contains("truncated"), "{message}");
    let empty = MissionFolder::create(dir.path().join("empty")).expect("folder");
    assert!(matches!(export(&empty, Format::Colmap, &out), Err(ExportError::Missing { .. })));
}

#[test]
fn a_model_file_is_written_in_any_other_format() {
    let dir = tempfile::tempdir().expect("tempdir");
    for from in formats::Format::ALL {
        let source = dir.path().join(format!("source.{}", from.extension()));
        fs::write(&source, bytes(from, &model(2))).expect("write");
        for to in formats::Format::ALL {
            let out = dir.path().join("new folder").join(format!("out.{}", to.extension()));
            let summary = export_model(&source, to, &out).expect("exported");
            let back = formats::read(to, &fs::read(&out).expect("read")).expect("a model");
            let lost = from == Splat || to == Splat;
            assert_eq!((back.len(), back.sh_degree()), (9, if lost { 0 } else { 2 }), "{from:?} {to:?}");
            let expected = (to == Splat && from != Splat).then_some(2);
            assert_eq!((summary.gaussians, summary.lost_sh_degree), (9, expected), "{from:?} {to:?}");
            for g in model(2).iter() {
                let nearest = back.iter().map(|b| (b.mean - g.mean).length()).fold(f32::INFINITY, f32::min);
                assert!(nearest < 1e-3, "{from:?} {to:?}: {nearest} m");
            }
        }
    }
}

#[test]
fn only_our_models_are_marked_as_antialiased() {
    let dir = tempfile::tempdir().expect("tempdir");
    let (source, out) = (dir.path().join("m.ply"), dir.path().join("m.spz"));
    let ours = bytes(Ply, &model(0));
    let at = ours.windows(7).position(|window| window == b"Vantage").expect("comment");
    let mut foreign = ours.clone();
    foreign[at..at + 7].copy_from_slice(b"Another");
    for (file, antialiased) in [(ours, true), (foreign, false)] {
        fs::write(&source, file).expect("write");
        export_model(&source, Spz, &out).expect("exported");
        let mut expected = Vec::new();
        formats::write(Spz, &model(0), antialiased, &mut expected).expect("written");
        assert_eq!(fs::read(&out).expect("read"), expected);
    }
}

#[test]
fn files_that_are_no_models_are_named() {
    let dir = tempfile::tempdir().expect("tempdir");
    let out = dir.path().join("out.glb");
    let text = dir.path().join("notes.txt");
    fs::write(&text, "ply\n").expect("write");
    let message = export_model(&text, Glb, &out).expect_err("no model").to_string();
    assert!(message.contains("notes.txt") && message.contains(".splat"), "{message}");
    for format in formats::Format::ALL {
        let broken = dir.path().join(format!("broken.{}", format.extension()));
        fs::write(&broken, b"this is no model").expect("write");
        let message = export_model(&broken, Glb, &out).expect_err("no model").to_string();
        assert!(message.contains("broken."), "{message}");
    }
    let empty = dir.path().join("empty.ply");
    fs::write(&empty, bytes(Ply, &Gaussians::new())).expect("write");
    let message = export_model(&empty, Glb, &out).expect_err("nothing").to_string();
    assert!(message.contains("out.glb") && message.contains("0 Gaussians"), "{message}");
    assert!(!out.exists());
}
