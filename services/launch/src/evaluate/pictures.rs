//! Pictures for people: the model (left) beside the truth (right), seen from the four directions of the compass.

use std::path::Path;

use anyhow::Context as _;
use glam::DVec3;
use shared_types::folder::{MissionFolder, write_atomic};
use shared_types::frames::look_at;
use splatting::{Engine, Gaussians, RenderSettings, Rendered};

use super::truth::{Truth, cores};
use super::views::camera_of;

/// Size of each half, pixels.
const WIDTH: u32 = 480;
/// See [`WIDTH`].
const HEIGHT: u32 = 360;
/// Elevation that the pictures are taken from, degrees.
const ELEVATION_DEG: f64 = 20.0;

/// The directions: where the camera stands, seen from the object.
pub const DIRECTIONS: [(&str, DVec3); 4] =
    [("north", DVec3::Y), ("east", DVec3::X), ("south", DVec3::NEG_Y), ("west", DVec3::NEG_X)];

/// Writes `report/<direction>.png`.
///
/// # Errors
/// When a picture cannot be written.
pub fn write(folder: &MissionFolder, truth: &Truth, gaussians: &Gaussians) -> anyhow::Result<()> {
    let mut engine = Engine::new(cores())?;
    let mut rendered = Rendered::default();
    let settings = RenderSettings::default();
    for (name, direction) in DIRECTIONS {
        let elevation = ELEVATION_DEG.to_radians();
        let offset = direction * elevation.cos() + DVec3::Z * elevation.sin();
        let pose = look_at(truth.center_m() + offset * truth.radius_m(), truth.center_m());
        engine.render(gaussians, &camera_of(&pose, &truth.intrinsics(WIDTH, HEIGHT)), &settings, &mut rendered);
        let image = truth.image(&pose, WIDTH, HEIGHT);
        let pixels = side_by_side(&rendered.color, &image.color, WIDTH as usize);
        write_png(&folder.report_path().join(format!("{name}.png")), &pixels, WIDTH * 2, HEIGHT)?;
    }
    Ok(())
}

/// Two images of one size, left and right, as sRGB bytes.
fn side_by_side(left: &[[f32; 3]], right: &[[f32; 3]], width: usize) -> Vec<u8> {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to a byte")]
    let byte = |value: f32| (value.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
    let mut pixels = Vec::with_capacity((left.len() + right.len()) * 3);
    for (left, right) in left.chunks(width).zip(right.chunks(width)) {
        pixels.extend(left.iter().chain(right).flatten().map(|value| byte(*value)));
    }
    pixels
}

fn write_png(path: &Path, pixels: &[u8], width: u32, height: u32) -> anyhow::Result<()> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder
        .write_header()
        .and_then(|mut writer| writer.write_image_data(pixels))
        .with_context(|| format!("{}: cannot be encoded", path.display()))?;
    write_atomic(path, &bytes)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_model_is_left_and_the_truth_right_in_every_row() {
        let (model, truth) = (vec![[1.5, 0.0, 0.0]; 4], vec![[0.0, 0.0, 0.5]; 4]);
        let pixels = side_by_side(&model, &truth, 2);
        let row = [255, 0, 0, 255, 0, 0, 0, 0, 128, 0, 0, 128];
        assert_eq!(pixels, [row, row].concat());
    }

    #[test]
    fn a_picture_is_read_back_as_it_was() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("a.png");
        write_png(&path, &[1, 2, 3, 4, 5, 6], 2, 1).expect("written");
        let mut reader = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(&path).expect("open")))
            .read_info()
            .expect("png");
        let mut pixels = vec![0; 6];
        let info = reader.next_frame(&mut pixels).expect("frame");
        assert_eq!((info.width, info.height, pixels.as_slice()), (2, 1, [1, 2, 3, 4, 5, 6].as_slice()));
    }
}
