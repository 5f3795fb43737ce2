//! COLMAP's binary files. Counts in them are never trusted: nothing is reserved for more than the bytes could hold.

use std::path::Path;

use splatting::bytes::{Reader, Truncated};

use super::{MODELS, RawCamera, RawImage, point_of};
use crate::dataset::Point;
use crate::error::DatasetError;

/// Least bytes of a camera, an image and a point.
const CAMERA_BYTES: u64 = 4 + 4 + 8 + 8 + 3 * 8;
const IMAGE_BYTES: u64 = 4 + 7 * 8 + 4 + 1 + 8;
const POINT_BYTES: u64 = 8 + 3 * 8 + 3 + 8 + 8;
/// Bytes of a 2D point of an image and of an element of a track.
const POINT2D_BYTES: u64 = 24;
const TRACK_BYTES: u64 = 8;

/// Line numbers are for text; binary files have none.
type Lines<T> = Vec<(Option<usize>, T)>;

fn bytes_of(path: &Path) -> Result<Vec<u8>, DatasetError> {
    std::fs::read(path).map_err(|source| DatasetError::read(path, source, "a COLMAP model has it beside cameras.bin"))
}

fn cut(path: &Path) -> impl Fn(Truncated) -> DatasetError {
    move |truncated| {
        let found = format!("cut off at byte {}", truncated.at);
        DatasetError::damaged(path, truncated.what, found, "a whole file: export the model again")
    }
}

fn count(path: &Path, reader: &mut Reader<'_>, what: &'static str, least: u64) -> Result<u64, DatasetError> {
    let count = reader.u64(what).map_err(cut(path))?;
    let most = reader.left() as u64 / least;
    if count > most {
        let expected = format!("at most {most}, which is what the file's size allows: export the model again");
        return Err(DatasetError::damaged(path, what, count.to_string(), expected));
    }
    Ok(count)
}

fn end(path: &Path, reader: &Reader<'_>) -> Result<(), DatasetError> {
    if reader.left() == 0 {
        return Ok(());
    }
    let found = format!("followed by {} bytes more", reader.left());
    Err(DatasetError::damaged(path, "the last entry", found, "the end of the file: export the model again"))
}

pub(super) fn cameras(path: &Path) -> Result<Lines<RawCamera>, DatasetError> {
    let bytes = bytes_of(path)?;
    let mut reader = Reader::new(&bytes);
    let mut cameras = Vec::new();
    for _ in 0..count(path, &mut reader, "the number of cameras", CAMERA_BYTES)? {
        let mut read = || -> Result<_, Truncated> {
            Ok((
                reader.u32("a camera's id")?,
                reader.i32("a camera's model")?,
                reader.u64("a width")?,
                reader.u64("a height")?,
            ))
        };
        let (id, model, width, height) = read().map_err(cut(path))?;
        let Some((name, params)) = usize::try_from(model).ok().and_then(|model| MODELS.get(model)) else {
            let expected = "the number of one of COLMAP's camera models, 0 to 10";
            return Err(DatasetError::damaged(path, format!("camera {id}: model"), model.to_string(), expected));
        };
        let params = (0..*params).map(|_| reader.f64("a camera's parameters")).collect::<Result<_, _>>();
        let params = params.map_err(cut(path))?;
        cameras.push((None, RawCamera { id, model: (*name).to_owned(), width, height, params }));
    }
    end(path, &reader)?;
    Ok(cameras)
}

pub(super) fn images(path: &Path) -> Result<Lines<RawImage>, DatasetError> {
    let bytes = bytes_of(path)?;
    let mut reader = Reader::new(&bytes);
    let mut images = Vec::new();
    for _ in 0..count(path, &mut reader, "the number of images", IMAGE_BYTES)? {
        let mut read = || -> Result<_, Truncated> {
            reader.u32("an image's id")?;
            let mut numbers = [0.0; 7];
            for number in &mut numbers {
                *number = reader.f64("an image's pose")?;
            }
            let camera = reader.u32("an image's camera")?;
            let mut name = Vec::new();
            loop {
                match reader.bytes(1, "an image's name")? {
                    [0] => break,
                    byte => name.extend_from_slice(byte),
                }
            }
            Ok((numbers, camera, name))
        };
        let ([w, x, y, z, tx, ty, tz], camera, name) = read().map_err(cut(path))?;
        let name = String::from_utf8(name).map_err(|error| {
            let found = format!("{:?}", String::from_utf8_lossy(error.as_bytes()));
            DatasetError::damaged(path, "an image's name", found, "text in UTF-8")
        })?;
        let points = count(path, &mut reader, "the number of an image's points", POINT2D_BYTES)?;
        skip(&mut reader, points * POINT2D_BYTES, "an image's points").map_err(cut(path))?;
        images.push((None, RawImage { rotation: [w, x, y, z], translation: [tx, ty, tz], camera, name }));
    }
    end(path, &reader)?;
    Ok(images)
}

pub(super) fn points(path: &Path) -> Result<Vec<Point>, DatasetError> {
    // Without a model's points training begins with random ones.
    if !path.exists() {
        return Ok(Vec::new());
    }
    let bytes = bytes_of(path)?;
    let mut reader = Reader::new(&bytes);
    let mut points = Vec::new();
    for _ in 0..count(path, &mut reader, "the number of points", POINT_BYTES)? {
        let mut read = || -> Result<_, Truncated> {
            let id = reader.u64("a point's id")?;
            let position = [reader.f64("a point")?, reader.f64("a point")?, reader.f64("a point")?];
            let rgb = reader.bytes(3, "a point's colour")?;
            let rgb = [rgb[0], rgb[1], rgb[2]];
            reader.f64("a point's error")?;
            Ok((id, position, rgb))
        };
        let (id, position, rgb) = read().map_err(cut(path))?;
        let track = count(path, &mut reader, "the length of a point's track", TRACK_BYTES)?;
        skip(&mut reader, track * TRACK_BYTES, "a point's track").map_err(cut(path))?;
        points.push(point_of(path, id, position, rgb)?);
    }
    end(path, &reader)?;
    Ok(points)
}

fn skip(reader: &mut Reader<'_>, bytes: u64, what: &'static str) -> Result<(), Truncated> {
    reader.bytes(usize::try_from(bytes).unwrap_or(usize::MAX), what).map(|_| ())
}
