use std::fs;

use splatting::bytes::Writer;

use super::*;
use crate::dataset;

const SIZE: (u32, u32) = (8, 6);

/// Two images of one camera, three points.
struct Scene {
    cameras: Vec<(u32, i32, u64, u64, Vec<f64>)>,
    images: Vec<([f64; 7], u32, &'static str)>,
    points: Vec<([f64; 3], [u8; 3])>,
}

fn scene() -> Scene {
    let half = 0.5f64.sqrt();
    Scene {
        cameras: vec![(7, 1, 8, 6, vec![9.0, 9.5, 4.25, 3.0])],
        images: vec![
            ([1.0, 0.0, 0.0, 0.0, 0.5, -0.25, 2.0], 7, "b.png"),
            ([half, 0.0, half, 0.0, 0.0, 0.0, 3.0], 7, "a c.png"),
        ],
        points: vec![([0.0, 1.0, 2.0], [1, 2, 3]), ([-1.0, 0.5, 0.0], [255, 0, 9]), ([3.0, 3.0, 3.0], [9, 9, 9])],
    }
}

impl Scene {
    fn binary(&self) -> [Vec<u8>; 3] {
        let mut cameras = Writer::default();
        cameras.list(self.cameras.iter(), |w, (id, model, width, height, params)| {
            w.u32(*id);
            w.i32(*model);
            w.u64(*width);
            w.u64(*height);
            params.iter().for_each(|p| w.f64(*p));
        });
        let mut images = (self.images.len() as u64).to_le_bytes().to_vec();
        for (id, (pose, camera, name)) in (1u32..).zip(&self.images) {
            images.extend(id.to_le_bytes());
            pose.iter().for_each(|p| images.extend(p.to_le_bytes()));
            images.extend(camera.to_le_bytes());
            images.extend(name.as_bytes());
            images.push(0);
            // One 2D point.
            images.extend(1u64.to_le_bytes());
            images.extend([0; 24]);
        }
        let mut points = (self.points.len() as u64).to_le_bytes().to_vec();
        for (id, (position, rgb)) in (1u64..).zip(&self.points) {
            points.extend(id.to_le_bytes());
            position.iter().for_each(|p| points.extend(p.to_le_bytes()));
            points.extend(rgb);
            points.extend(0.5f64.to_le_bytes());
            points.extend(2u64.to_le_bytes());
            points.extend([0; 16]);
        }
        [cameras.into_bytes(), images, points]
    }

    fn text(&self) -> [String; 3] {
        let numbers = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
        let mut cameras = String::from("# Camera list\n\n");
        for (id, model, width, height, params) in &self.cameras {
            cameras += &format!("{id} {} {width} {height} {}\n", MODELS[*model as usize].0, numbers(params));
        }
        let mut images = String::from("# Image list with two lines of data per image:\n");
        for (id, (pose, camera, name)) in (1..).zip(&self.images) {
            let points = if id == 1 { "" } else { "1.5 2.5 -1 3 4 17" };
            images += &format!("{id} {} {camera} {name}\n{points}\n", numbers(pose));
        }
        let mut points = String::new();
        for (id, (position, [r, g, b])) in (1..).zip(&self.points) {
            points += &format!("{id} {} {r} {g} {b} 0.5 1 2 2 3\n", numbers(position));
        }
        [cameras, images, points]
    }
}

fn write_images(root: &Path, names: &[&str], (width, height): (u32, u32)) {
    for name in names {
        let pixels = (0..width * height * 3).map(|i| (i % 251) as u8).collect();
        let image = ::image::RgbImage::from_raw(width, height, pixels).expect("size");
        fs::create_dir_all(root).expect("folder");
        image.save(root.join(name)).expect("saved");
    }
}

fn dataset_in(root: &Path, files: &[(&str, &[u8])]) -> PathBuf {
    let sparse = root.join("sparse/0");
    fs::create_dir_all(&sparse).expect("folder");
    for (name, bytes) in files {
        fs::write(sparse.join(name), bytes).expect("written");
    }
    write_images(&root.join("images"), &["b.png", "a c.png"], SIZE);
    root.to_owned()
}

fn binary_dataset(root: &Path, [cameras, images, points]: &[Vec<u8>; 3]) -> PathBuf {
    dataset_in(root, &[("cameras.bin", cameras), ("images.bin", images), ("points3D.bin", points)])
}

fn text_dataset(root: &Path, [cameras, images, points]: &[String; 3]) -> PathBuf {
    let files = [("cameras.txt", cameras), ("images.txt", images), ("points3D.txt", points)];
    dataset_in(root, &files.map(|(name, text)| (name, text.as_bytes())))
}

fn refused(root: &Path) -> String {
    dataset::list(root, None).expect_err("refused").to_string()
}

#[test]
fn text_and_binary_give_the_same_dataset_in_the_order_of_names() {
    let dir = tempfile::tempdir().expect("folder");
    let binary = dataset::list(&binary_dataset(&dir.path().join("bin"), &scene().binary()), None).expect("binary");
    let text = dataset::list(&text_dataset(&dir.path().join("txt"), &scene().text()), None).expect("text");
    assert_eq!(binary.points, text.points);
    assert_eq!(binary.entries.iter().map(|e| e.name.as_str()).collect::<Vec<_>>(), ["a c.png", "b.png"]);
    for (a, b) in binary.entries.iter().zip(&text.entries) {
        assert_eq!((a.world_from_camera, a.intrinsics, &a.name), (b.world_from_camera, b.intrinsics, &b.name));
    }
    let b = &binary.entries[1];
    // camera_from_world is a translation by (0.5, -0.25, 2): the camera is at its opposite.
    assert!((b.world_from_camera.position_m - DVec3::new(-0.5, 0.25, -2.0)).length() < 1e-12);
    assert_eq!((b.intrinsics.fx, b.intrinsics.fy, b.intrinsics.cx, b.intrinsics.cy), (9.0, 9.5, 4.25, 3.0));
    // Turned by 90 degrees about y: the camera at camera-z 3 sees the world's origin ahead.
    let a = &binary.entries[0];
    let ahead = a.world_from_camera.transform_point(DVec3::new(0.0, 0.0, 3.0));
    assert!(ahead.length() < 1e-9, "{ahead}");
}

#[test]
fn camera_models_without_distortion_are_taken_and_others_refused_with_the_way_out() {
    let dir = tempfile::tempdir().expect("folder");
    let with = |model: i32, params: Vec<f64>| {
        let scene = Scene { cameras: vec![(7, model, 8, 6, params)], ..scene() };
        dataset::list(&binary_dataset(dir.path(), &scene.binary()), None)
    };
    let focal = |listing: Listing| (listing.entries[0].intrinsics.fx, listing.entries[0].intrinsics.fy);
    assert_eq!(focal(with(0, vec![9.0, 4.0, 3.0]).expect("SIMPLE_PINHOLE")), (9.0, 9.0));
    assert_eq!(focal(with(2, vec![9.0, 4.0, 3.0, 0.0]).expect("SIMPLE_RADIAL")), (9.0, 9.0));
    assert_eq!(focal(with(4, vec![9.0, 8.0, 4.0, 3.0, 0.0, 0.0, 0.0, 0.0]).expect("OPENCV")), (9.0, 8.0));
    let message = |model: i32, params: Vec<f64>| with(model, params).expect_err("refused").to_string();
    let distorted = message(2, vec![9.0, 4.0, 3.0, 0.01]);
    assert!(distorted.contains("camera 7: distortion is [0.01]") && distorted.contains("undistort"), "{distorted}");
    let fisheye = message(5, vec![9.0, 8.0, 4.0, 3.0, 0.0, 0.0, 0.0, 0.0]);
    assert!(fisheye.contains("OPENCV_FISHEYE") && fisheye.contains("undistort"), "{fisheye}");
    assert!(message(11, vec![9.0, 4.0, 3.0]).contains("camera 7: model is 11"));
    assert!(message(1, vec![f64::NAN, 9.0, 4.0, 3.0]).contains("focal length"));
    assert!(message(1, vec![9.0, 9.0, f64::INFINITY, 3.0]).contains("principal point"));
}

#[test]
fn every_truncation_is_refused_and_counts_that_lie_reserve_nothing() {
    let whole = scene().binary();
    let dir = tempfile::tempdir().expect("folder");
    for file in 0..3 {
        for length in 0..whole[file].len() {
            let mut cut = whole.clone();
            cut[file].truncate(length);
            let message = refused(&binary_dataset(dir.path(), &cut));
            let name = ["cameras.bin", "images.bin", "points3D.bin"][file];
            assert!(message.contains(name), "{name} cut to {length}: {message}");
        }
        let mut lying = whole.clone();
        lying[file][..8].copy_from_slice(&(u64::MAX / 2).to_le_bytes());
        let message = refused(&binary_dataset(dir.path(), &lying));
        assert!(message.contains("which is what the file's size allows"), "{message}");
        let mut longer = whole.clone();
        longer[file].push(0);
        assert!(refused(&binary_dataset(dir.path(), &longer)).contains("followed by 1 bytes more"));
    }
}

#[test]
fn wrong_text_is_named_with_its_file_line_and_field() {
    let dir = tempfile::tempdir().expect("folder");
    let with = |file: usize, from: &str, to: &str| {
        let mut text = scene().text();
        assert!(text[file].contains(from), "{from} in {}", text[file]);
        text[file] = text[file].replacen(from, to, 1);
        refused(&text_dataset(dir.path(), &text))
    };
    let cases = [
        (0, "7 PINHOLE", "seven PINHOLE", "cameras.txt, line 3: CAMERA_ID is \"seven\""),
        (0, "PINHOLE", "FISHBOWL", "cameras.txt, line 3: camera 7: model is FISHBOWL"),
        (0, "9 9.5 4.25 3", "9 9.5 4.25", "number of parameters"),
        (0, "9.5", "-9.5", "focal length"),
        (0, " 8 6 ", " 0 6 ", "camera 7: size is 0 x 6"),
        (0, " 8 6 ", " 9 6 ", "size is 8 x 6; expected 9 x 6 as its camera 7 says"),
        (1, "1 1 0 0 0", "1 2 0 0 0", "images.txt, line 2: image \"b.png\": QW QX QY QZ"),
        (1, "1 1 0 0 0", "1 NaN 0 0 0", "QW QX QY QZ"),
        (1, "0.5 -0.25 2", "inf -0.25 2", "TX TY TZ"),
        (1, "0.5 -0.25 2 7", "0.5 -0.25 2 8", "CAMERA_ID is 8"),
        (1, "b.png", "missing.png", "missing.png does not exist"),
        (1, "b.png", "../b.png", "NAME is \"../b.png\""),
        (1, "a c.png", "b.png", "twice"),
        (1, "17\n", "\n", "POINTS2D"),
        (2, "1 0 1 2", "1 0 one 2", "points3D.txt, line 1: X Y Z is \"one\""),
        (2, "255 0 9", "256 0 9", "points3D.txt, line 2: R G B is \"256\""),
        (2, "1 0 1 2", "1 0 inf 2", "point 1: X Y Z"),
    ];
    for (file, from, to, expected) in cases {
        let message = with(file, from, to);
        assert!(message.contains(expected), "{from} -> {to}: {message}");
    }
}

#[test]
fn smaller_images_take_scaled_cameras_where_they_are_asked_for() {
    let dir = tempfile::tempdir().expect("folder");
    let root = binary_dataset(dir.path(), &scene().binary());
    write_images(&root.join("images_2"), &["b.png", "a c.png"], (4, 3));
    let half = dataset::list(&root, Some("images_2")).expect("half");
    let camera = half.entries[0].intrinsics;
    assert_eq!(
        (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy),
        (4, 3, 4.5, 4.75, 2.125, 1.5)
    );
    write_images(&root.join("images_3"), &["b.png", "a c.png"], (4, 6));
    assert!(dataset::list(&root, Some("images_3")).expect_err("another shape").to_string().contains("4 x 6"));
    assert!(dataset::list(&root, Some("images_4")).expect_err("none").to_string().contains("--images"));
}

#[test]
fn masks_of_the_original_size_serve_smaller_images() {
    use splatting::PixelClass::{Foreground, Ignored};
    let dir = tempfile::tempdir().expect("folder");
    let root = binary_dataset(dir.path(), &scene().binary());
    write_images(&root.join("images_2"), &["b.png", "a c.png"], (4, 3));
    fs::create_dir_all(root.join("masks")).expect("folder");
    let mask = |width, height| {
        ::image::GrayImage::from_fn(width, height, |x, _| ::image::Luma([if x < width / 2 { 0 } else { 255 }]))
            .save(root.join("masks/b.png.png"))
            .expect("saved");
        let listing = dataset::list(&root, Some("images_2")).expect("listed");
        let options = dataset::LoadOptions { downscale: None, mask: dataset::MaskUse::Auto, memory_bytes: 1 << 20 };
        dataset::load(&listing, &options).map(|dataset| dataset.images[1].classes.clone().expect("classes"))
    };
    let half = [Ignored, Ignored, Foreground, Foreground];
    for size in [(8, 6), (4, 3), (9, 6), (10, 8)] {
        assert_eq!(mask(size.0, size.1).expect("a whole or nearly whole ratio")[4..8], half, "{size:?}");
    }
    for size in [(8, 3), (2, 2), (6, 8)] {
        let message = mask(size.0, size.1).expect_err("another shape, or too small").to_string();
        assert!(message.contains("b.png.png") && message.contains("--mask off"), "{message}");
    }
}

#[test]
fn broken_images_are_named() {
    let dir = tempfile::tempdir().expect("folder");
    let root = binary_dataset(dir.path(), &scene().binary());
    fs::write(root.join("images/b.png"), b"no image").expect("written");
    assert!(refused(&root).contains("b.png"), "{}", refused(&root));
    write_images(&root.join("images"), &["b.png"], SIZE);
    let bytes = fs::read(root.join("images/b.png")).expect("read");
    fs::write(root.join("images/b.png"), &bytes[..bytes.len() / 2]).expect("written");
    let listing = dataset::list(&root, None).expect("its header is whole");
    let options = dataset::LoadOptions { downscale: None, mask: dataset::MaskUse::Auto, memory_bytes: 1 << 20 };
    let message = dataset::load(&listing, &options).expect_err("cut").to_string();
    assert!(message.contains("b.png") && message.contains("not readable"), "{message}");
    // A header that promises more pixels than anything has.
    let mut huge = bytes.clone();
    huge[16..24].copy_from_slice(&[0x7f, 0xff, 0xff, 0xff, 0x7f, 0xff, 0xff, 0xff]);
    fs::write(root.join("images/b.png"), huge).expect("written");
    assert!(refused(&root).contains("b.png"));
}

#[test]
fn images_that_do_not_fit_the_memory_say_how_they_would() {
    let dir = tempfile::tempdir().expect("folder");
    let root = binary_dataset(dir.path(), &scene().binary());
    let listing = dataset::list(&root, None).expect("listed");
    let options = dataset::LoadOptions { downscale: None, mask: dataset::MaskUse::Auto, memory_bytes: 300 };
    let message = dataset::load(&listing, &options).expect_err("too large").to_string();
    assert!(message.contains("--downscale 2") && message.contains("--memory"), "{message}");
}

#[test]
fn masks_and_alpha_tell_pixels_apart() {
    use splatting::PixelClass::{Foreground, Free, Ignored};
    let dir = tempfile::tempdir().expect("folder");
    let root = binary_dataset(dir.path(), &scene().binary());
    // Alpha: the left half is transparent. Mask: the upper half is black.
    let rgba = ::image::RgbaImage::from_fn(8, 6, |x, _| ::image::Rgba([10, 20, 30, if x < 4 { 0 } else { 255 }]));
    rgba.save(root.join("images/b.png")).expect("saved");
    fs::create_dir_all(root.join("masks")).expect("folder");
    ::image::GrayImage::from_fn(8, 6, |_, y| ::image::Luma([if y < 3 { 0 } else { 255 }]))
        .save(root.join("masks/a c.png.png"))
        .expect("saved");
    let listing = dataset::list(&root, None).expect("listed");
    let load = |mask, downscale| {
        let options = dataset::LoadOptions { downscale: Some(downscale), mask, memory_bytes: 1 << 20 };
        dataset::load(&listing, &options).expect("loaded").images
    };
    let classes = |mask| -> [Vec<splatting::PixelClass>; 2] {
        let images = load(mask, 1);
        [0, 1].map(|index: usize| images[index].classes.clone().expect("classes"))
    };
    let [masked, transparent] = classes(dataset::MaskUse::Auto);
    assert_eq!((masked[0], masked[5 * 8]), (Ignored, Foreground));
    assert_eq!((transparent[0], transparent[7]), (Free, Foreground));
    assert_eq!(classes(dataset::MaskUse::Ignore).map(|c| c[0]), [Ignored, Ignored]);
    assert_eq!(classes(dataset::MaskUse::Empty).map(|c| c[0]), [Free, Free]);
    assert!(load(dataset::MaskUse::Off, 1).iter().all(|image| image.classes.is_none()));
    let half = &load(dataset::MaskUse::Auto, 2)[1];
    assert_eq!((half.camera.width, half.camera.height, half.camera.fx, half.camera.cx), (4, 3, 4.5, 2.125));
    assert_eq!(half.classes.as_ref().expect("classes")[..4], [Free, Free, Foreground, Foreground]);
    assert!((half.colors.to_f32()[0][1] - 20.0 / 255.0).abs() < 1e-5);
}
