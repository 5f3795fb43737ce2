use std::fs;

use serde_json::json;

use super::*;
use crate::dataset::{self, LoadOptions, MaskUse};

fn rows(right: [f64; 3], up: [f64; 3], back: [f64; 3], at: [f64; 3]) -> Value {
    let row = |k: usize| [right[k], up[k], back[k], at[k]];
    json!([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]])
}

/// At (0, -3, 1), looking north along y with z up: OpenGL's back is -y.
fn north() -> Value {
    rows([1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.0, -3.0, 1.0])
}

fn document() -> Value {
    json!({
        "camera_model": "OPENCV", "fl_x": 10.0, "fl_y": 11.0, "cx": 4.5, "cy": 3.0, "k1": 0.0,
        "frames": [
            { "file_path": "./images/b.png", "transform_matrix": north() },
            { "file_path": "images/a.png", "transform_matrix": north(), "fl_x": 12.0, "w": 8, "h": 6,
              "depth_file_path": "depth/a.png" },
        ],
    })
}

fn dataset_of(root: &Path, document: &Value) -> PathBuf {
    for (folder, name) in [("images", "a.png"), ("images", "b.png")] {
        fs::create_dir_all(root.join(folder)).expect("folder");
        ::image::RgbImage::new(8, 6).save(root.join(folder).join(name)).expect("saved");
    }
    fs::create_dir_all(root.join("depth")).expect("folder");
    let depth = ::image::ImageBuffer::<::image::Luma<u16>, _>::from_fn(8, 6, |x, _| ::image::Luma([1000 + x as u16]));
    depth.save(root.join("depth/a.png")).expect("saved");
    fs::write(root.join("transforms.json"), document.to_string()).expect("written");
    root.to_owned()
}

#[test]
fn frames_override_what_the_document_says_for_all() {
    let dir = tempfile::tempdir().expect("folder");
    let mut document = document();
    document["depth_unit_scale_factor"] = json!(0.002);
    let listing = dataset::list(&dataset_of(dir.path(), &document), None).expect("listed");
    let [a, b] = [&listing.entries[0], &listing.entries[1]];
    assert_eq!((a.name.as_str(), b.name.as_str()), ("images/a.png", "images/b.png"));
    assert_eq!((a.intrinsics.fx, a.intrinsics.fy, b.intrinsics.fx), (12.0, 11.0, 10.0));
    let ahead = a.world_from_camera.transform_point(DVec3::new(0.0, 0.0, 3.0));
    assert!((ahead - DVec3::new(0.0, 0.0, 1.0)).length() < 1e-12, "{ahead}");
    let below = a.world_from_camera.rotation * DVec3::Y;
    assert!((below - DVec3::NEG_Z).length() < 1e-12, "image down is down: {below}");
    let options = LoadOptions { downscale: None, mask: MaskUse::Auto, memory_bytes: 1 << 20 };
    let loaded = dataset::load(&listing, &options).expect("loaded");
    let depth = loaded.images[0].depth_m.as_ref().expect("depth");
    assert!((depth[3] - 2.006).abs() < 1e-6 && loaded.images[1].depth_m.is_none());
}

#[test]
fn a_field_of_view_stands_for_a_focal_length_and_test_views_are_held_out() {
    let dir = tempfile::tempdir().expect("folder");
    let root = dataset_of(dir.path(), &document());
    fs::remove_file(root.join("transforms.json")).expect("removed");
    let synthetic = |name: &str| {
        json!({ "camera_angle_x": 1.0,
        "frames": [{ "file_path": format!("./images/{name}"), "transform_matrix": north() }] })
    };
    fs::write(root.join("transforms_train.json"), synthetic("b").to_string()).expect("written");
    fs::write(root.join("transforms_test.json"), synthetic("a").to_string()).expect("written");
    let listing = dataset::list(&root, None).expect("listed");
    assert_eq!(listing.entries.iter().map(|e| e.held_out).collect::<Vec<_>>(), [Some(true), Some(false)]);
    let camera = listing.entries[0].intrinsics;
    assert!((camera.fx - 4.0 / 0.5f64.tan()).abs() < 1e-12 && camera.fx == camera.fy);
    assert_eq!((camera.cx, camera.cy), (4.0, 3.0));
}

#[test]
fn what_is_wrong_is_named_with_its_frame_and_field() {
    let dir = tempfile::tempdir().expect("folder");
    let with = |pointer: &str, value: Value| {
        let mut document = document();
        let (parent, key) = pointer.rsplit_once('/').expect("a pointer");
        match document.pointer_mut(parent).expect("there") {
            Value::Array(list) => list[key.parse::<usize>().expect("an index")] = value,
            object => object[key] = value,
        }
        dataset::list(&dataset_of(dir.path(), &document), None).expect_err(pointer).to_string()
    };
    let scaled = rows([2.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, -2.0, 0.0], [0.0; 3]);
    let mirrored = rows([-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.0; 3]);
    let singular = rows([1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0; 3]);
    let cases = [
        ("/frames", json!({}), "frames is {}; expected a list of frames"),
        ("/frames", json!("x"), "frames is \"x\"; expected a list of frames"),
        ("/frames", json!([]), "0 usable images"),
        ("/frames/0", json!(7), "frames[0] is 7"),
        ("/frames/0/file_path", json!("images/none.png"), "none.png does not exist"),
        ("/frames/0/file_path", json!(3), "frames[0].file_path is 3"),
        ("/frames/0/transform_matrix", json!([[1, 0], [0, 1]]), "frames[0].transform_matrix is of 2 rows"),
        ("/frames/0/transform_matrix", json!("I"), "four rows of four numbers"),
        ("/frames/0/transform_matrix", scaled, "right-handed axes of length 1"),
        ("/frames/0/transform_matrix", mirrored, "right-handed axes of length 1"),
        ("/frames/1/transform_matrix", singular, "frames[1].transform_matrix"),
        ("/frames/1/w", json!(9), "frames[1].w is 9; expected 8"),
        ("/frames/1/fl_x", json!(-1.0), "frames[1].focal length"),
        ("/fl_x", json!("wide"), "fl_x is \"wide\""),
        ("/k1", json!(0.1), "k1 is 0.1; expected 0: undistort"),
        ("/camera_model", json!("OPENCV_FISHEYE"), "camera_model is \"OPENCV_FISHEYE\""),
        ("/frames/1/depth_file_path", json!("depth/none.png"), "none.png does not exist"),
        ("/frames/1/file_path", json!("images/b.png"), "twice"),
        ("/ply_file_path", json!("none.ply"), "none.ply does not exist"),
        ("/depth_unit_m", json!(0.0), "depth_unit_m is 0"),
        ("/depth_unit_m", json!(1e-7), "expected metres a unit of depth, 1e-6 to 1"),
        ("/depth_unit_m", json!(1000.0), "depth_unit_m is 1000;"),
        ("/fl_x", json!(1e300), "expected 0.008 to 8000 pixels"),
        ("/cx", json!(1e300), "frames[0].principal point"),
        (
            "/frames/0/transform_matrix",
            rows([1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.0, 2e6, 0.0]),
            "from -1000000 to 1000000",
        ),
    ];
    for (pointer, value, expected) in cases {
        let message = with(pointer, value);
        assert!(message.contains(expected), "{pointer}: {message}");
    }
    fs::write(dir.path().join("transforms.json"), "{\n \"frames\": [\n").expect("written");
    let message = dataset::list(dir.path(), None).expect_err("broken").to_string();
    assert!(message.contains("transforms.json, line 3: JSON is broken"), "{message}");
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig::with_cases(64))]
    #[test]
    fn any_rigid_pose_comes_back(
        axis in proptest::array::uniform3(-1.0f64..1.0), angle in -3.0f64..3.0, at in proptest::array::uniform3(-9.0f64..9.0)
    ) {
        let axis = DVec3::from(axis).try_normalize().unwrap_or(DVec3::X);
        let rotation = DQuat::from_axis_angle(axis, angle);
        let [right, down, ahead] = [DVec3::X, DVec3::Y, DVec3::Z].map(|v| (rotation * v).to_array());
        let turned = |v: [f64; 3]| v.map(|x| -x);
        let matrix = rows(right, turned(down), turned(ahead), at);
        let object = json!({ "transform_matrix": matrix });
        let Value::Object(frame) = object else { unreachable!() };
        let empty = Map::new();
        let frame = Frame { path: Path::new("t.json"), index: 0, frame: &frame, document: &empty };
        let pose = pose_of(&frame).expect("rigid");
        proptest::prop_assert!((pose.position_m - DVec3::from(at)).length() < 1e-9);
        proptest::prop_assert!(pose.rotation.angle_between(rotation) < 1e-6);
    }
}
