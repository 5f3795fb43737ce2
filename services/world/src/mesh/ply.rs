//! PLY, text or binary of either byte order: vertices with optional normals, colours and texture coordinates, and polygons.

use std::path::Path;

use glam::{Vec2, Vec3};

use super::{Material, MeshError, RawMesh, images};
use crate::color::linear_rgb_from_srgb;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn is_float(self) -> bool {
        matches!(self, Self::F32 | Self::F64)
    }
}

#[derive(Debug)]
struct Property {
    name: String,
    /// Type of the length, for lists.
    count: Option<Scalar>,
    value: Scalar,
}

#[derive(Debug)]
struct Element {
    name: String,
    rows: usize,
    properties: Vec<Property>,
}

#[derive(Debug, Clone, Copy)]
enum Encoding {
    Text,
    Little,
    Big,
}

struct Header {
    encoding: Encoding,
    elements: Vec<Element>,
    texture_file: Option<String>,
    length: usize,
}

/// Reads the bytes of a PLY file.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<RawMesh, MeshError> {
    parse(path, bytes).map_err(|(found, expected)| MeshError::Malformed {
        path: path.to_owned(),
        found: format!("PLY: {found}"),
        expected,
    })
}

type Fault = (String, &'static str);

fn parse(path: &Path, bytes: &[u8]) -> Result<RawMesh, Fault> {
    let header = parse_header(bytes)?;
    let mut body = Body { encoding: header.encoding, rest: &bytes[header.length..] };
    let mut mesh = Builder::default();
    for element in &header.elements {
        if element.properties.is_empty() && element.rows > 0 {
            // Its rows would take no data: nothing would bound their number.
            let found = format!("{} {}s without a property", element.rows, element.name);
            return Err((found, "at least one property in each element"));
        }
        let mut values = Vec::new();
        for row in 0..element.rows {
            mesh.begin_row();
            for property in &element.properties {
                let cut_short = || {
                    (
                        format!("the data end in row {row} of the {} {}s announced", element.rows, element.name),
                        "as many rows as the header announces, of readable numbers",
                    )
                };
                values.clear();
                let count = match property.count {
                    None => 1,
                    Some(kind) => body.value(kind).ok_or_else(cut_short)? as usize,
                };
                for _ in 0..count {
                    values.push(body.value(property.value).ok_or_else(cut_short)?);
                }
                mesh.take(&element.name, property, &values);
            }
            mesh.end_row(&element.name);
        }
    }
    Ok(mesh.finish(path, header.texture_file))
}

fn parse_header(bytes: &[u8]) -> Result<Header, Fault> {
    const MARK: &[u8] = b"end_header";
    let end = bytes.windows(MARK.len()).position(|w| w == MARK).filter(|_| bytes.starts_with(b"ply"));
    let end = end.ok_or_else(|| ("no header".to_owned(), "a first line \"ply\" and a line \"end_header\""))?;
    let after = end + MARK.len();
    let line_end = bytes[after..].iter().position(|b| *b == b'\n').map_or(bytes.len(), |n| after + n + 1);
    let text = String::from_utf8_lossy(&bytes[..end]);
    let mut header = Header { encoding: Encoding::Text, elements: Vec::new(), texture_file: None, length: line_end };
    for line in text.lines().skip(1) {
        let words: Vec<&str> = line.split_whitespace().collect();
        let bad = || (format!("header line {line:?}"), "format, comment, element and property lines of the PLY format");
        match words.as_slice() {
            ["format", "ascii", ..] => header.encoding = Encoding::Text,
            ["format", "binary_little_endian", ..] => header.encoding = Encoding::Little,
            ["format", "binary_big_endian", ..] => header.encoding = Encoding::Big,
            ["comment", "TextureFile", name @ ..] => header.texture_file = Some(name.join(" ")),
            ["comment" | "obj_info", ..] | [] => {}
            ["element", name, rows] => {
                let rows = rows.parse().map_err(|_error| bad())?;
                header.elements.push(Element { name: (*name).to_owned(), rows, properties: Vec::new() });
            }
            ["property", kind @ .., name] => {
                let (count, value) = match kind {
                    ["list", count, value] => (Some(Scalar::parse(count).ok_or_else(bad)?), Scalar::parse(value)),
                    [value] => (None, Scalar::parse(value)),
                    _ => return Err(bad()),
                };
                let property = Property { name: (*name).to_owned(), count, value: value.ok_or_else(bad)? };
                header.elements.last_mut().ok_or_else(bad)?.properties.push(property);
            }
            _ => return Err(bad()),
        }
    }
    Ok(header)
}

/// What is left of the data behind the header.
struct Body<'a> {
    encoding: Encoding,
    rest: &'a [u8],
}

impl Body<'_> {
    fn value(&mut self, kind: Scalar) -> Option<f64> {
        match self.encoding {
            Encoding::Text => self.word()?.parse().ok(),
            Encoding::Little => self.binary(kind, false),
            Encoding::Big => self.binary(kind, true),
        }
    }

    fn word(&mut self) -> Option<&str> {
        let start = self.rest.iter().position(|b| !b.is_ascii_whitespace())?;
        let tail = &self.rest[start..];
        let length = tail.iter().position(u8::is_ascii_whitespace).unwrap_or(tail.len());
        self.rest = &tail[length..];
        std::str::from_utf8(&tail[..length]).ok()
    }

    fn binary(&mut self, kind: Scalar, big: bool) -> Option<f64> {
        Some(match kind {
            Scalar::I8 => f64::from(i8::from_le_bytes(self.bytes(big)?)),
            Scalar::U8 => f64::from(u8::from_le_bytes(self.bytes(big)?)),
            Scalar::I16 => f64::from(i16::from_le_bytes(self.bytes(big)?)),
            Scalar::U16 => f64::from(u16::from_le_bytes(self.bytes(big)?)),
            Scalar::I32 => f64::from(i32::from_le_bytes(self.bytes(big)?)),
            Scalar::U32 => f64::from(u32::from_le_bytes(self.bytes(big)?)),
            Scalar::F32 => f64::from(f32::from_le_bytes(self.bytes(big)?)),
            Scalar::F64 => f64::from_le_bytes(self.bytes(big)?),
        })
    }

    /// The next N bytes in little-endian order.
    fn bytes<const N: usize>(&mut self, big: bool) -> Option<[u8; N]> {
        let (head, rest) = self.rest.split_first_chunk::<N>()?;
        self.rest = rest;
        let mut head = *head;
        if big {
            head.reverse();
        }
        Some(head)
    }
}

/// Collects rows into a mesh.
#[derive(Default)]
struct Builder {
    positions: Vec<Vec3>,
    vertex_normals: Vec<Vec3>,
    vertex_uvs: Vec<Vec2>,
    vertex_colors: Vec<Vec3>,
    triangles: Vec<[u32; 3]>,
    face_uvs: Vec<[Vec2; 3]>,
    has: Has,
    row: Row,
}

/// Which optional properties the vertices (and faces) have.
#[derive(Default)]
struct Has {
    normals: bool,
    uvs: bool,
    colors: bool,
    face_uvs: bool,
}

#[derive(Default)]
struct Row {
    position: Vec3,
    normal: Vec3,
    uv: Vec2,
    color: Vec3,
    polygon: Vec<u32>,
    polygon_uvs: Vec<Vec2>,
}

impl Builder {
    fn begin_row(&mut self) {
        self.row.polygon.clear();
        self.row.polygon_uvs.clear();
    }

    fn take(&mut self, element: &str, property: &Property, values: &[f64]) {
        let value = values.first().map_or(0.0, |v| *v as f32);
        let row = &mut self.row;
        // Bytes are sRGB codes, floats are 0..1 of the same code.
        let color =
            || linear_rgb_from_srgb([if property.value.is_float() { (value * 255.0) as u8 } else { value as u8 }; 3]).x;
        match (element, property.name.as_str()) {
            ("vertex", "x") => row.position.x = value,
            ("vertex", "y") => row.position.y = value,
            ("vertex", "z") => row.position.z = value,
            ("vertex", "nx") => (row.normal.x, self.has.normals) = (value, true),
            ("vertex", "ny") => row.normal.y = value,
            ("vertex", "nz") => row.normal.z = value,
            ("vertex", "s" | "u" | "texture_u") => (row.uv.x, self.has.uvs) = (value, true),
            ("vertex", "t" | "v" | "texture_v") => row.uv.y = value,
            ("vertex", "red" | "r" | "diffuse_red") => (row.color.x, self.has.colors) = (color(), true),
            ("vertex", "green" | "g" | "diffuse_green") => row.color.y = color(),
            ("vertex", "blue" | "b" | "diffuse_blue") => row.color.z = color(),
            // An index that is negative or too large stays out of range, and is reported as such.
            ("face", "vertex_indices" | "vertex_index") => {
                row.polygon.extend(values.iter().map(|v| if *v < 0.0 { u32::MAX } else { *v as u32 }))
            }
            ("face", "texcoord") => {
                self.has.face_uvs = true;
                row.polygon_uvs
                    .extend(values.as_chunks::<2>().0.iter().map(|uv| Vec2::new(uv[0] as f32, uv[1] as f32)));
            }
            _ => {}
        }
    }

    fn end_row(&mut self, element: &str) {
        let row = &self.row;
        match element {
            "vertex" => {
                self.positions.push(row.position);
                self.vertex_normals.push(row.normal);
                self.vertex_uvs.push(row.uv);
                self.vertex_colors.push(row.color);
            }
            "face" => {
                for k in 2..row.polygon.len() {
                    self.triangles.push([row.polygon[0], row.polygon[k - 1], row.polygon[k]]);
                    self.face_uvs.push([0, k - 1, k].map(|i| row.polygon_uvs.get(i).copied().unwrap_or_default()));
                }
            }
            _ => {}
        }
    }

    fn finish(self, path: &Path, texture_file: Option<String>) -> RawMesh {
        let at_corners = |table: &[Vec3]| -> Vec<[Vec3; 3]> {
            self.triangles.iter().map(|t| t.map(|i| table.get(i as usize).copied().unwrap_or_default())).collect()
        };
        let uvs = if self.has.face_uvs {
            Some(self.face_uvs)
        } else {
            self.has.uvs.then(|| {
                self.triangles
                    .iter()
                    .map(|t| t.map(|i| self.vertex_uvs.get(i as usize).copied().unwrap_or_default()))
                    .collect()
            })
        };
        let uvs: Option<Vec<[Vec2; 3]>> = uvs.map(|table: Vec<[Vec2; 3]>| {
            table.into_iter().map(|corners| corners.map(|uv| Vec2::new(uv.x, 1.0 - uv.y))).collect()
        });
        let material = match texture_file {
            Some(name) if uvs.is_some() => images::from_file(path, &path.with_file_name(name)),
            _ if self.has.colors => Material::CornerColors,
            _ => Material::Procedural,
        };
        RawMesh {
            normals: self.has.normals.then(|| at_corners(&self.vertex_normals)),
            colors: self.has.colors.then(|| at_corners(&self.vertex_colors)),
            uvs,
            triangle_materials: vec![0; self.triangles.len()],
            materials: vec![material],
            positions: self.positions,
            triangles: self.triangles,
        }
    }
}
