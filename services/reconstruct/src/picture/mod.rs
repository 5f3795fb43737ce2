//! Pictures for people: the curve of quality over processor time, and held-out images beside their truth.

mod canvas;

use std::path::Path;

use shared_types::folder::write_atomic;
use splatting::{Engine, Gaussians, RenderSettings, Rendered};

use crate::dataset::Image;
use crate::error::ReconstructError;
use crate::report::Row;
use canvas::{Canvas, Rgb};

/// Held-out images shown at most.
const SHOWN: usize = 6;
/// Width that a shown image is shrunk to, at most, pixels.
const SHOWN_WIDTH: usize = 800;
const WHITE: Rgb = [255; 3];
const GREY: Rgb = [225; 3];
const DARK: Rgb = [60; 3];
const CURVE: Rgb = [200, 60, 20];

/// Writes the curve of held-out PSNR over processor seconds; nothing where there are no two points of it.
///
/// # Errors
/// Where the picture cannot be written.
pub fn write_curve(path: &Path, rows: &[Row]) -> Result<(), ReconstructError> {
    let points: Vec<(f64, f64)> =
        rows.iter().filter_map(|row| Some((row.cpu_s, row.held_out_psnr_db?))).filter(|p| p.1.is_finite()).collect();
    if points.len() < 2 {
        return Ok(());
    }
    write(path, &curve(&points))
}

fn curve(points: &[(f64, f64)]) -> Canvas {
    const SIZE: (usize, usize) = (900, 540);
    const LEFT: f64 = 70.0;
    const TOP: f64 = 40.0;
    const RIGHT: f64 = 870.0;
    const BOTTOM: f64 = 480.0;
    let mut canvas = Canvas::new(SIZE.0, SIZE.1, WHITE);
    let x_step = step(points.iter().map(|p| p.0).fold(0.0, f64::max));
    let x_most = points.iter().map(|p| p.0).fold(0.0, f64::max);
    let x_end = ((x_most / x_step).ceil() * x_step).max(x_step);
    let (low, high) =
        points.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), p| (low.min(p.1), high.max(p.1)));
    let y_step = step((high - low).max(1.0));
    let y_begin = (low / y_step).floor() * y_step;
    let y_end = ((high / y_step).ceil() * y_step).max(y_begin + y_step);
    let x_of = |x: f64| LEFT + x / x_end * (RIGHT - LEFT);
    let y_of = |y: f64| BOTTOM - (y - y_begin) / (y_end - y_begin) * (BOTTOM - TOP);
    let label = |value: f64, step: f64| format!("{value:.*}", usize::from(step < 1.0));
    for k in 0..=((x_end / x_step).round() as usize) {
        let (value, x) = (k as f64 * x_step, x_of(k as f64 * x_step));
        canvas.line((x, TOP), (x, BOTTOM), 1.0, GREY);
        let text = label(value, x_step);
        canvas.text((x - Canvas::text_width(&text) / 2.0, BOTTOM + 10.0), &text, DARK);
    }
    for k in 0..=(((y_end - y_begin) / y_step).round() as usize) {
        let value = y_begin + k as f64 * y_step;
        canvas.line((LEFT, y_of(value)), (RIGHT, y_of(value)), 1.0, GREY);
        let text = label(value, y_step);
        canvas.text((LEFT - 8.0 - Canvas::text_width(&text), y_of(value) - 7.0), &text, DARK);
    }
    canvas.line((LEFT, TOP), (LEFT, BOTTOM), 2.0, DARK);
    canvas.line((LEFT, BOTTOM), (RIGHT, BOTTOM), 2.0, DARK);
    canvas.text((LEFT, 12.0), "held-out PSNR, dB", DARK);
    let below = "processor time, s";
    canvas.text((RIGHT - Canvas::text_width(below), BOTTOM + 34.0), below, DARK);
    for pair in points.windows(2) {
        canvas.line((x_of(pair[0].0), y_of(pair[0].1)), (x_of(pair[1].0), y_of(pair[1].1)), 2.5, CURVE);
    }
    for point in points {
        canvas.line((x_of(point.0), y_of(point.1)), (x_of(point.0), y_of(point.1)), 7.0, CURVE);
    }
    canvas
}

/// A step of 1, 2 or 5 times a power of ten that divides a range into at most ten.
fn step(range: f64) -> f64 {
    let least = (range / 10.0).max(1e-6);
    let power = 10f64.powf(least.log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|factor| factor * power).find(|step| *step >= least).unwrap_or(least)
}

/// Writes renders of the model beside the held-out images: the model left, the image right, one row each.
///
/// # Errors
/// Where the renderer cannot be started or the picture not be written.
pub fn write_held_out(
    path: &Path,
    model: &Gaussians,
    images: &[&Image],
    settings: &RenderSettings,
    threads: usize,
) -> Result<(), ReconstructError> {
    if images.is_empty() {
        return Ok(());
    }
    let mut engine = Engine::new(threads)?;
    let mut rendered = Rendered::default();
    let stride = images.len().div_ceil(SHOWN);
    let mut rows = Vec::new();
    for image in images.iter().step_by(stride) {
        engine.render(model, &image.camera, settings, &mut rendered);
        let (width, height) = (image.camera.width as usize, image.camera.height as usize);
        let shrink = width.div_ceil(SHOWN_WIDTH).max(1);
        if height < shrink {
            continue;
        }
        let [left, right] =
            [&rendered.color, &image.colors.to_f32()].map(|pixels| shrunk(pixels, width, height, shrink));
        rows.push((width / shrink, height / shrink, left, right));
    }
    let width = rows.iter().map(|row| row.0).max().unwrap_or(1);
    let mut canvas = Canvas::new(2 * width, rows.iter().map(|row| row.1).sum(), WHITE);
    let mut top = 0;
    for (row_width, height, left, right) in &rows {
        canvas.image((0, top), *row_width, left);
        canvas.image((width, top), *row_width, right);
        top += height;
    }
    write(path, &canvas)
}

/// Box means as bytes.
fn shrunk(pixels: &[[f32; 3]], width: usize, height: usize, factor: usize) -> Vec<Rgb> {
    let mut small = Vec::with_capacity((width / factor) * (height / factor));
    for row in 0..height / factor {
        for column in 0..width / factor {
            let mut sum = [0.0f32; 3];
            for y in row * factor..(row + 1) * factor {
                for pixel in &pixels[y * width + column * factor..y * width + (column + 1) * factor] {
                    for (sum, value) in sum.iter_mut().zip(pixel) {
                        *sum += value.clamp(0.0, 1.0);
                    }
                }
            }
            small.push(sum.map(|sum| (sum / (factor * factor) as f32 * 255.0 + 0.5) as u8));
        }
    }
    small
}

fn write(path: &Path, canvas: &Canvas) -> Result<(), ReconstructError> {
    let mut bytes = Vec::new();
    let mut encode = || -> Result<(), png::EncodingError> {
        let mut encoder = png::Encoder::new(&mut bytes, canvas.width() as u32, canvas.height() as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(canvas.pixels().as_flattened())?;
        writer.finish()
    };
    encode().map_err(|source| ReconstructError::Picture { path: path.to_owned(), source })?;
    write_atomic(path, &bytes)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_round_and_few() {
        for (range, expected) in [(9.0, 1.0), (10.0, 1.0), (11.0, 2.0), (47.0, 5.0), (0.3, 0.05), (640.0, 100.0)] {
            assert!((step(range) - expected).abs() < 1e-9, "{range}: {}", step(range));
        }
    }

    #[test]
    fn a_rising_curve_rises_in_the_picture() {
        let canvas = curve(&[(0.0, 20.0), (50.0, 30.0), (100.0, 32.0)]);
        let marks: Vec<(usize, usize)> = (0..canvas.pixels().len())
            .filter(|&i| canvas.pixels()[i] == CURVE)
            .map(|i| (i % canvas.width(), i / canvas.width()))
            .collect();
        let left = marks.iter().min_by_key(|p| p.0).expect("drawn");
        let right = marks.iter().max_by_key(|p| p.0).expect("drawn");
        assert!(left.0 < 80 && right.0 > 860, "{left:?} {right:?}");
        assert!(left.1 > right.1 + 300, "the right end is higher: {left:?} {right:?}");
        // One value at one time must not divide by zero.
        assert!(curve(&[(0.0, 20.0), (0.0, 20.0)]).pixels().contains(&CURVE));
    }

    #[test]
    fn shrinking_is_a_mean_of_clamped_colours() {
        let pixels = [[2.0, 0.0, 0.5], [0.0, 0.0, 0.5], [1.0, 0.0, 0.5], [0.0, -1.0, 0.5]];
        assert_eq!(shrunk(&pixels, 2, 2, 2), [[128, 0, 128]]);
    }
}
