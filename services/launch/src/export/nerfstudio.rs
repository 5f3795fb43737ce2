//! nerfstudio's `transforms.json`: camera-to-world matrices with OpenGL's axes (x right, y up, z backwards).
//!
//! Depth is copied as it is; its unit is in the file as `depth_unit_m` and given to nerfstudio's parser as
//! `--depth-unit-scale-factor`.

use std::fmt::Write as _;
use std::path::Path;

use glam::{DMat4, DVec3};
use serde_json::json;
use shared_types::folder::{FolderError, Frame, write_atomic};

use super::Point;

/// Camera-to-world with OpenGL's axes: our y and z, turned round.
#[must_use]
pub fn world_from_gl_camera(view: &Frame) -> DMat4 {
    let pose = view.world_from_camera();
    DMat4::from_rotation_translation(pose.rotation, pose.position_m) * DMat4::from_scale(DVec3::new(1.0, -1.0, -1.0))
}

/// Writes `transforms.json` and `points.ply` under `out`; with `masks`, it names one for each image.
///
/// # Errors
/// When a file cannot be written.
pub fn write(out: &Path, views: &[Frame], points: &[Point], masks: bool) -> Result<(), FolderError> {
    let frames: Vec<_> = views
        .iter()
        .map(|view| {
            let matrix = world_from_gl_camera(view);
            let rows: Vec<[f64; 4]> = (0..4).map(|row| matrix.row(row).to_array()).collect();
            let camera = view.intrinsics;
            let mut frame = json!({
                "file_path": format!("images/{:06}.png", view.id),
                "depth_file_path": format!("depth/{:06}.png", view.id),
                "transform_matrix": rows,
                "w": camera.width, "h": camera.height,
                "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy,
            });
            if masks {
                frame["mask_path"] = json!(format!("masks/{:06}.png.png", view.id));
            }
            frame
        })
        .collect();
    let depth_unit_m = views.first().map(|view| view.depth_unit_m);
    let document = json!({
        "camera_model": "OPENCV",
        "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
        "depth_unit_m": depth_unit_m,
        "ply_file_path": "points.ply",
        "frames": frames,
    });
    write_atomic(&out.join("transforms.json"), format!("{document:#}\n").as_bytes())?;
    let mut ply = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
        points.len()
    );
    for point in points {
        let (p, [r, g, b]) = (point.position_m, point.rgb);
        writeln!(ply, "{:.6} {:.6} {:.6} {r} {g} {b}", p.x, p.y, p.z).ok();
    }
    write_atomic(&out.join("points.ply"), ply.as_bytes())
}
