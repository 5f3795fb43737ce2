//! Coloured points from a PLY file, as text or little-endian binary, whatever other properties and elements it has.

use std::path::Path;

use glam::DVec3;
use splatting::formats::ply::Scalar;

use super::Point;
use crate::error::DatasetError;

/// The vertex element of a header.
struct Header {
    text: bool,
    vertices: usize,
    properties: Vec<(String, Scalar)>,
    /// Bytes, and lines, before the first vertex.
    begin: usize,
    lines: usize,
}

const WANTED: [&str; 6] = ["x", "y", "z", "red", "green", "blue"];

/// Reads the points of a PLY file. Without colours they are grey.
///
/// # Errors
/// [`DatasetError`] naming the file, the line and what is wrong.
pub fn read(path: &Path) -> Result<Vec<Point>, DatasetError> {
    let bytes = std::fs::read(path).map_err(|source| {
        DatasetError::read(path, source, "the dataset names it; add it, or take ply_file_path out")
    })?;
    let header = header(path, &bytes)?;
    let places = WANTED.map(|name| header.properties.iter().position(|(property, _)| property == name));
    if let Some(missing) = places[..3].iter().position(Option::is_none) {
        let expected = "the properties x, y and z";
        return Err(DatasetError::damaged(path, "element vertex", format!("without {}", WANTED[missing]), expected));
    }
    let body = &bytes[header.begin..];
    let least = if header.text { 2 } else { header.properties.iter().map(|(_, kind)| kind.bytes()).sum() };
    if header.vertices > body.len().div_ceil(least.max(1)) {
        let expected = format!("at most {}, which is what the file's size allows", body.len() / least.max(1));
        return Err(DatasetError::damaged(path, "element vertex", header.vertices.to_string(), expected));
    }
    let mut points = Vec::with_capacity(header.vertices);
    let mut values = vec![0.0; header.properties.len()];
    if header.text {
        let text = std::str::from_utf8(body).map_err(|_error| {
            DatasetError::damaged(path, "text", "not UTF-8", "format ascii 1.0 as the header says")
        })?;
        let mut lines = text.lines().enumerate();
        for _ in 0..header.vertices {
            let Some((index, line)) = lines.next() else {
                let found = format!("cut off after {} points", points.len());
                return Err(DatasetError::damaged(path, "element vertex", found, header.vertices.to_string()));
            };
            let mut words = line.split_ascii_whitespace();
            for value in &mut values {
                let word = words.next().unwrap_or("the end of the line");
                *value = word.parse().map_err(|_not_one| {
                    DatasetError::damaged(path, "a vertex", word, "a number").at_line(header.lines + index + 1)
                })?;
            }
            points.push(point(path, &values, places)?);
        }
    } else {
        let mut rest = body;
        for index in 0..header.vertices {
            for (value, (_, kind)) in values.iter_mut().zip(&header.properties) {
                *value = kind.value(rest).ok_or_else(|| {
                    let found = format!("cut off after {index} points");
                    DatasetError::damaged(path, "element vertex", found, header.vertices.to_string())
                })?;
                rest = rest.get(kind.bytes()..).unwrap_or_default();
            }
            points.push(point(path, &values, places)?);
        }
    }
    Ok(points)
}

fn point(path: &Path, values: &[f64], places: [Option<usize>; 6]) -> Result<Point, DatasetError> {
    let at = |k: usize| places[k].and_then(|place| values.get(place)).copied();
    let position = DVec3::new(at(0).unwrap_or(0.0), at(1).unwrap_or(0.0), at(2).unwrap_or(0.0));
    if !position.is_finite() {
        return Err(DatasetError::damaged(path, "a vertex", position.to_string(), "finite numbers"));
    }
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to a byte")]
    let channel = |k: usize| at(k).map_or(128, |value| value.clamp(0.0, 255.0) as u8);
    Ok(Point { position, rgb: [channel(3), channel(4), channel(5)] })
}

fn header(path: &Path, bytes: &[u8]) -> Result<Header, DatasetError> {
    let wrong = |line: usize, field: &str, found: &str, expected: &str| {
        Err(DatasetError::damaged(path, field, format!("{found:?}"), expected).at_line(line))
    };
    let mut header = Header { text: false, vertices: 0, properties: Vec::new(), begin: 0, lines: 0 };
    let (mut in_vertex, mut seen_vertex) = (false, false);
    loop {
        let rest = &bytes[header.begin..];
        let Some(length) = rest.iter().position(|byte| *byte == b'\n') else {
            return wrong(header.lines + 1, "header", "its end is missing", "a line \"end_header\"");
        };
        header.begin += length + 1;
        header.lines += 1;
        let line = String::from_utf8_lossy(&rest[..length]);
        let line = line.trim_end_matches('\r');
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words[..] {
            ["ply"] if header.lines == 1 => {}
            _ if header.lines == 1 => return wrong(1, "header", line, "\"ply\""),
            ["end_header"] => break,
            ["format", format, _] => match format {
                "ascii" => header.text = true,
                "binary_little_endian" => header.text = false,
                _ => return wrong(header.lines, "format", format, "ascii or binary_little_endian"),
            },
            ["element", "vertex", count] => {
                (in_vertex, seen_vertex) = (true, true);
                match count.parse() {
                    Ok(count) => header.vertices = count,
                    Err(_) => return wrong(header.lines, "element vertex", count, "a number"),
                }
            }
            ["element", name, ..] => {
                if !seen_vertex {
                    return wrong(header.lines, "element", name, "the vertices as the first element");
                }
                in_vertex = false;
            }
            ["property", kind, name] if in_vertex => match Scalar::named(kind) {
                Some(kind) => header.properties.push((name.to_owned(), kind)),
                None => return wrong(header.lines, "property", kind, "a scalar type of PLY"),
            },
            ["property", ..] if in_vertex => return wrong(header.lines, "property", line, "a scalar property"),
            _ => {}
        }
    }
    if !seen_vertex {
        return wrong(header.lines, "header", "no vertices", "an element \"vertex\"");
    }
    Ok(header)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(bytes: &[u8]) -> Result<Vec<Point>, String> {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("points.ply");
        std::fs::write(&path, bytes).expect("written");
        read(&path).map_err(|error| error.to_string())
    }

    const TEXT: &str = "ply\nformat ascii 1.0\ncomment x\nelement vertex 2\nproperty float x\nproperty float y\n\
        property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face 0\n\
        property list uchar int vertex_indices\nend_header\n1 2 3 10 20 30\n-1.5 0 2e1 255 0 7\n";

    #[test]
    fn text_and_binary_give_the_same_points() {
        let text = of(TEXT.as_bytes()).expect("text");
        assert_eq!(text[1], Point { position: DVec3::new(-1.5, 0.0, 20.0), rgb: [255, 0, 7] });
        let mut binary = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty uchar red\nproperty double x\n\
            property float y\nproperty float z\nproperty short nx\nproperty uchar green\nproperty uchar blue\nend_header\n"
            .to_vec();
        for point in &text {
            binary.push(point.rgb[0]);
            binary.extend(point.position.x.to_le_bytes());
            binary.extend((point.position.y as f32).to_le_bytes());
            binary.extend((point.position.z as f32).to_le_bytes());
            binary.extend((-7i16).to_le_bytes());
            binary.extend([point.rgb[1], point.rgb[2]]);
        }
        assert_eq!(of(&binary).expect("binary"), text);
        let message = of(&binary[..binary.len() - 1]).expect_err("cut");
        assert!(message.contains("cut off after 1 points") || message.contains("at most"), "{message}");
    }

    #[test]
    fn what_is_wrong_is_named_with_its_line() {
        let refused = |from: &str, to: &str| of(TEXT.replace(from, to).as_bytes()).expect_err(to);
        assert!(
            refused("-1.5 0", "-1.5 zero").contains("line 15: a vertex is zero"),
            "{}",
            refused("-1.5 0", "-1.5 zero")
        );
        assert!(refused("vertex 2", "vertex 99999999999").contains("99999999999"));
        assert!(refused("vertex 2", "vertex 3").contains("cut off after 2 points"));
        assert!(refused("float y", "float why").contains("without y"));
        assert!(refused("ascii", "binary_big_endian").contains("line 2: format is \"binary_big_endian\""));
        assert!(refused("end_header", "end").contains("end_header"));
        assert!(refused("1 2 3", "1 2 nan").contains("finite"));
        assert!(of(b"").is_err() && of(b"solid\n").is_err());
    }
}
