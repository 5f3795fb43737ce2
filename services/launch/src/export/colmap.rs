//! COLMAP's sparse model: cameras, images, points3D, as text and as little-endian binary.
//!
//! COLMAP's camera is ours (x right, y down, z forward; the centre of pixel (0, 0) is (0.5, 0.5)); its images carry
//! `camera_from_world` with the quaternion as w, x, y, z.

use std::fmt::Write as _;
use std::path::Path;

use shared_types::folder::{FolderError, Frame, write_atomic};
use shared_types::frames::Intrinsics;

use super::Point;

/// COLMAP's number for the model PINHOLE (fx, fy, cx, cy).
const PINHOLE: i32 = 1;

/// Writes `sparse/0` under `out`. The images' names are those in `images/`.
///
/// # Errors
/// When a file cannot be written.
pub fn write(out: &Path, views: &[Frame], points: &[Point]) -> Result<(), FolderError> {
    let sparse = out.join("sparse").join("0");
    let mut cameras: Vec<Intrinsics> = Vec::new();
    for view in views {
        if !cameras.contains(&view.intrinsics) {
            cameras.push(view.intrinsics);
        }
    }
    let (mut text, mut binary) = (String::from("# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n"), count(cameras.len()));
    for (id, camera) in (1_u32..).zip(&cameras) {
        let Intrinsics { fx, fy, cx, cy, width, height } = camera;
        writeln!(text, "{id} PINHOLE {width} {height} {fx} {fy} {cx} {cy}").ok();
        binary.extend(id.to_le_bytes());
        binary.extend(PINHOLE.to_le_bytes());
        binary.extend(u64::from(*width).to_le_bytes());
        binary.extend(u64::from(*height).to_le_bytes());
        numbers(&mut binary, &[*fx, *fy, *cx, *cy]);
    }
    write_atomic(&sparse.join("cameras.txt"), text.as_bytes())?;
    write_atomic(&sparse.join("cameras.bin"), &binary)?;

    let (mut text, mut binary) =
        (String::from("# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of points\n"), count(views.len()));
    for (id, view) in (1_u32..).zip(views) {
        let camera_from_world = view.world_from_camera().inverse();
        let ([x, y, z, w], t) = (camera_from_world.rotation.to_array(), camera_from_world.position_m);
        let camera = (1_u32..).zip(&cameras).find(|(_, camera)| **camera == view.intrinsics).map_or(1, |(id, _)| id);
        let name = format!("{:06}.png", view.id);
        writeln!(text, "{id} {w} {x} {y} {z} {} {} {} {camera} {name}\n", t.x, t.y, t.z).ok();
        binary.extend(id.to_le_bytes());
        numbers(&mut binary, &[w, x, y, z, t.x, t.y, t.z]);
        binary.extend(camera.to_le_bytes());
        binary.extend(name.as_bytes());
        binary.push(0);
        binary.extend(count(0));
    }
    write_atomic(&sparse.join("images.txt"), text.as_bytes())?;
    write_atomic(&sparse.join("images.bin"), &binary)?;

    let (mut text, mut binary) = (String::from("# POINT3D_ID X Y Z R G B ERROR TRACK[]\n"), count(points.len()));
    for (id, point) in (1_u64..).zip(points) {
        let (p, [r, g, b]) = (point.position_m, point.rgb);
        writeln!(text, "{id} {} {} {} {r} {g} {b} 0", p.x, p.y, p.z).ok();
        binary.extend(id.to_le_bytes());
        numbers(&mut binary, &p.to_array());
        binary.extend([r, g, b]);
        numbers(&mut binary, &[0.0]);
        binary.extend(count(0));
    }
    write_atomic(&sparse.join("points3D.txt"), text.as_bytes())?;
    write_atomic(&sparse.join("points3D.bin"), &binary)
}

fn count(number: usize) -> Vec<u8> {
    (number as u64).to_le_bytes().to_vec()
}

fn numbers(binary: &mut Vec<u8>, values: &[f64]) {
    binary.extend(values.iter().flat_map(|value| value.to_le_bytes()));
}
