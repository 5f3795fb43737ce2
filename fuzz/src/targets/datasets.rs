//! Datasets of other tools, as `vantage reconstruct` takes them.

use std::path::{Path, PathBuf};

use reconstruct::dataset::image::MaskUse;
use reconstruct::dataset::{LoadOptions, list, load};
use tempfile::TempDir;

use crate::seal::{join, png, split};

/// A folder in memory with two images of 4 x 3 pixels, one for each thread.
struct Folder(TempDir);

impl Folder {
    fn new() -> Self {
        let folder =
            TempDir::new_in("/dev/shm").or_else(|_full| TempDir::new()).unwrap_or_else(|error| panic!("{error}"));
        let folder = Self(folder);
        for name in ["images", "sparse/0"] {
            std::fs::create_dir_all(folder.path().join(name)).unwrap_or_else(|error| panic!("{error}"));
        }
        folder.write("images/a.png", &image());
        folder.write("images/b.png", &image());
        folder
    }

    fn path(&self) -> &Path {
        self.0.path()
    }

    fn write(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.path().join(name);
        std::fs::write(&path, bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        path
    }
}

fn image() -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, 4, 3);
    encoder.set_color(png::ColorType::Rgb);
    let written = encoder.write_header().and_then(|mut writer| writer.write_image_data(&[90; 36]));
    written.unwrap_or_else(|error| panic!("{error}"));
    bytes
}

thread_local! {
    static COLMAP: Folder = Folder::new();
    static NERFSTUDIO: Folder = Folder::new();
}

/// Lists a dataset and decodes its images.
fn take(root: &Path) {
    let Ok(listing) = list(root, None) else { return };
    let options = LoadOptions { downscale: None, mask: MaskUse::Auto, memory_bytes: 64 << 20 };
    if let Ok(dataset) = load(&listing, &options) {
        assert!(dataset.images.iter().all(|image| image.training_view().is_ok()), "an image that cannot be trained on");
    }
}

fn colmap(data: &[u8], ending: &str) {
    COLMAP.with(|folder| {
        let files: [&[u8]; 3] = split(data);
        for (stem, bytes) in ["cameras", "images", "points3D"].iter().zip(files) {
            for other in ["bin", "txt"].iter().filter(|other| **other != ending) {
                std::fs::remove_file(folder.path().join(format!("sparse/0/{stem}.{other}"))).unwrap_or(());
            }
            folder.write(&format!("sparse/0/{stem}.{ending}"), bytes);
        }
        take(folder.path());
    });
}

/// COLMAP's binary files.
pub fn colmap_binary(data: &[u8]) {
    colmap(data, "bin");
}

/// COLMAP's text files.
pub fn colmap_text(data: &[u8]) {
    colmap(data, "txt");
}

/// Two images of one camera and two points.
pub fn colmap_binary_seeds() -> Vec<Vec<u8>> {
    let float = |values: &[f64]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
    let camera = [
        &1u64.to_le_bytes()[..],
        &1u32.to_le_bytes(),
        &1u32.to_le_bytes(),
        &4u64.to_le_bytes(),
        &3u64.to_le_bytes(),
        &float(&[4.0, 4.0, 2.0, 1.5]),
    ]
    .concat();
    let mut images = 2u64.to_le_bytes().to_vec();
    for (id, name) in [(1u32, b"a.png\0"), (2, b"b.png\0")] {
        images.extend(id.to_le_bytes());
        images.extend(float(&[1.0, 0.0, 0.0, 0.0, 0.1 * f64::from(id), 0.0, 2.0]));
        images.extend(1u32.to_le_bytes());
        images.extend(name);
        images.extend(1u64.to_le_bytes());
        images.extend([0; 24]);
    }
    let mut points = 2u64.to_le_bytes().to_vec();
    for id in 0..2u64 {
        points.extend(id.to_le_bytes());
        points.extend(float(&[0.1, 0.2, 0.3]));
        points.extend([10, 20, 30]);
        points.extend(float(&[0.5]));
        points.extend(1u64.to_le_bytes());
        points.extend([0; 8]);
    }
    vec![join([&camera, &images, &points])]
}

/// The same as text.
pub fn colmap_text_seeds() -> Vec<Vec<u8>> {
    let images = b"# images\n1 1 0 0 0 0.1 0 2 1 a.png\n1.0 2.0 -1\n2 0.7071 0 0.7071 0 0.2 0 2 1 b.png\n\n";
    let points = b"# points\n1 0.1 0.2 0.3 10 20 30 0.5 1 0\n2 0.3 0.2 0.1 1 2 3 0.5 1 0\n";
    vec![
        join([b"# cameras\n1 PINHOLE 4 3 4 4 2 1.5\n", images, points]),
        join([b"1 SIMPLE_RADIAL 4 3 4 2 1.5 0\n", images, points]),
    ]
}

/// nerfstudio's description, its point cloud, a mask and a depth image.
pub fn nerfstudio(data: &[u8]) {
    NERFSTUDIO.with(|folder| {
        let [json, points, mask] = split(data);
        folder.write("transforms.json", json);
        folder.write("points.ply", points);
        folder.write("mask.png", &png(mask));
        take(folder.path());
    });
}

/// Two frames with all that a frame may have.
pub fn nerfstudio_seeds() -> Vec<Vec<u8>> {
    let frame = |name: &str, more: &str| {
        format!(
            r#"{{"file_path":"images/{name}","transform_matrix":[[1,0,0,0.5],[0,1,0,0],[0,0,1,2],[0,0,0,1]]{more}}}"#
        )
    };
    let document = |more: &str| {
        format!(
            r#"{{"w":4,"h":3,"fl_x":4.0,"fl_y":4.0,"cx":2.0,"cy":1.5,"camera_model":"OPENCV","ply_file_path":"points.ply","frames":[{},{}]}}"#,
            frame("a.png", more),
            frame("b.png", "")
        )
    };
    let points = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n0.1 0.2 0.3 1 2 3\n";
    let mut binary = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty double x\nproperty double y\nproperty double z\nend_header\n".to_vec();
    binary.extend([0; 24]);
    vec![
        join([document("").as_bytes(), points, &image()]),
        join([document(r#","mask_path":"mask.png""#).as_bytes(), &binary, &image()]),
        join([document(r#","depth_file_path":"mask.png","k1":0"#).as_bytes(), points, &image()]),
    ]
}
