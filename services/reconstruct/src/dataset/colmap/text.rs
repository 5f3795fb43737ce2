//! COLMAP's text files: a line an entry, `#` begins a comment; images take two lines, of which the second may be empty.

use std::path::Path;
use std::str::FromStr;

use super::{RawCamera, RawImage, point_of};
use crate::dataset::Point;
use crate::error::DatasetError;

/// Entries with the numbers of their lines, from 1.
type Lines<T> = Vec<(Option<usize>, T)>;

fn text_of(path: &Path) -> Result<String, DatasetError> {
    let bytes = std::fs::read(path)
        .map_err(|source| DatasetError::read(path, source, "a COLMAP model has it beside cameras.txt"))?;
    String::from_utf8(bytes).map_err(|error| {
        let found = format!("not UTF-8 from byte {} on", error.utf8_error().valid_up_to());
        DatasetError::damaged(path, "text", found, "UTF-8: export the model again")
    })
}

/// The words of a line, taken one by one.
struct Words<'a> {
    path: &'a Path,
    line: usize,
    words: std::str::SplitAsciiWhitespace<'a>,
}

impl<'a> Words<'a> {
    fn word(&mut self, field: &str, expected: &str) -> Result<&'a str, DatasetError> {
        self.words.next().ok_or_else(|| self.wrong(field, "the end of the line", expected))
    }

    fn number<T: FromStr>(&mut self, field: &str, expected: &str) -> Result<T, DatasetError> {
        let word = self.word(field, expected)?;
        word.parse().map_err(|_not_one| self.wrong(field, &format!("{word:?}"), expected))
    }

    fn f64s<const N: usize>(&mut self, field: &str) -> Result<[f64; N], DatasetError> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.number(field, &format!("{N} numbers"))?;
        }
        Ok(numbers)
    }

    fn wrong(&self, field: &str, found: &str, expected: &str) -> DatasetError {
        DatasetError::damaged(self.path, field, found, expected).at_line(self.line)
    }
}

/// Lines that are no comments, with their numbers; of those of `images.txt` the empty ones too.
fn lines<'a>(path: &'a Path, text: &'a str, keep_empty: bool) -> impl Iterator<Item = (usize, &'a str, Words<'a>)> {
    text.lines()
        .enumerate()
        .map(|(index, line)| (index + 1, line))
        .filter(move |(_, line)| !line.trim_start().starts_with('#') && (keep_empty || !line.trim().is_empty()))
        .map(move |(number, line)| (number, line, Words { path, line: number, words: line.split_ascii_whitespace() }))
}

pub(super) fn cameras(path: &Path) -> Result<Lines<RawCamera>, DatasetError> {
    let text = text_of(path)?;
    let mut cameras = Vec::new();
    for (number, _, mut words) in lines(path, &text, false) {
        let id = words.number("CAMERA_ID", "a whole number")?;
        let model = words.word("MODEL", "a camera model")?.to_owned();
        let width = words.number("WIDTH", "pixels")?;
        let height = words.number("HEIGHT", "pixels")?;
        let mut params = Vec::new();
        while let Some(word) = words.words.next() {
            params.push(word.parse().map_err(|_not_one| words.wrong("PARAMS", &format!("{word:?}"), "numbers"))?);
        }
        cameras.push((Some(number), RawCamera { id, model, width, height, params }));
    }
    Ok(cameras)
}

pub(super) fn images(path: &Path) -> Result<Lines<RawImage>, DatasetError> {
    let text = text_of(path)?;
    let mut images = Vec::new();
    let mut lines = lines(path, &text, true);
    while let Some((number, line, mut words)) = lines.next() {
        // Between two images an empty line is the second line of the first; before the first image it is nothing.
        if line.trim().is_empty() {
            continue;
        }
        let _id: u32 = words.number("IMAGE_ID", "a whole number")?;
        let rotation = words.f64s("QW QX QY QZ")?;
        let translation = words.f64s("TX TY TZ")?;
        let camera = words.number("CAMERA_ID", "a whole number")?;
        let mut name = words.word("NAME", "the image's name")?.to_owned();
        for word in words.words.by_ref() {
            name.push(' ');
            name.push_str(word);
        }
        images.push((Some(number), RawImage { rotation, translation, camera, name }));
        // The image's points, which training does not need.
        if let Some((number, line, words)) = lines.next()
            && line.split_ascii_whitespace().count() % 3 != 0
        {
            let found = format!("{} words in line {number}", line.split_ascii_whitespace().count());
            return Err(words.wrong(
                "POINTS2D",
                &found,
                "three a point: every image has two lines, the second of points",
            ));
        }
    }
    Ok(images)
}

pub(super) fn points(path: &Path) -> Result<Vec<Point>, DatasetError> {
    // Without a model's points training begins with random ones.
    if !path.exists() {
        return Ok(Vec::new());
    }
    let text = text_of(path)?;
    let mut points = Vec::new();
    for (number, _, mut words) in lines(path, &text, false) {
        let id = words.number("POINT3D_ID", "a whole number")?;
        let position = words.f64s("X Y Z")?;
        let mut rgb = [0u8; 3];
        for value in &mut rgb {
            *value = words.number("R G B", "0 to 255")?;
        }
        points.push(point_of(path, id, position, rgb).map_err(|error| error.at_line(number))?);
    }
    Ok(points)
}
