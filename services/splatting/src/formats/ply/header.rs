//! The header of a binary PLY: its elements, and where in an element's row each property lies.

use super::PlyError;

/// A header longer than this is not one.
pub const HEADER_MAX: usize = 64 << 10;

/// Scalar type of a PLY property.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scalar {
    /// `char`
    I8,
    /// `uchar`
    U8,
    /// `short`
    I16,
    /// `ushort`
    U16,
    /// `int`
    I32,
    /// `uint`
    U32,
    /// `float`
    F32,
    /// `double`
    F64,
}

impl Scalar {
    /// The type of this name: `char` to `double`, or `int8` to `float64`.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
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

    /// Bytes of a value in a binary file.
    #[must_use]
    pub const fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The value at the beginning of these bytes, little-endian; `None` where they are too few.
    #[must_use]
    pub fn value(self, bytes: &[u8]) -> Option<f64> {
        fn first<const N: usize>(bytes: &[u8]) -> Option<[u8; N]> {
            bytes.first_chunk().copied()
        }
        Some(match self {
            Self::I8 => f64::from(i8::from_le_bytes(first(bytes)?)),
            Self::U8 => f64::from(u8::from_le_bytes(first(bytes)?)),
            Self::I16 => f64::from(i16::from_le_bytes(first(bytes)?)),
            Self::U16 => f64::from(u16::from_le_bytes(first(bytes)?)),
            Self::I32 => f64::from(i32::from_le_bytes(first(bytes)?)),
            Self::U32 => f64::from(u32::from_le_bytes(first(bytes)?)),
            Self::F32 => f64::from(f32::from_le_bytes(first(bytes)?)),
            Self::F64 => f64::from_le_bytes(first(bytes)?),
        })
    }
}

/// A property of the vertices, and where it lies in their rows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Property {
    pub name: String,
    pub scalar: Scalar,
    pub offset: usize,
}

impl Property {
    /// Its value in a row; not a number where the row is too short.
    pub fn value(&self, row: &[u8]) -> f32 {
        row.get(self.offset..).and_then(|bytes| self.scalar.value(bytes)).map_or(f32::NAN, |value| value as f32)
    }
}

/// An element and the properties of its rows.
#[derive(Clone, Debug)]
struct Element {
    name: String,
    count: u64,
    properties: Vec<Property>,
    stride: usize,
    /// Name of a property of no fixed length.
    list: Option<String>,
}

/// What a header says about the vertices and the data around them.
#[derive(Debug)]
pub struct Header<'a> {
    /// Number of vertices.
    pub count: u64,
    /// Their properties.
    pub properties: Vec<Property>,
    /// Bytes of a vertex.
    pub stride: usize,
    /// Data of the vertices and of what follows them.
    pub data: &'a [u8],
}

/// Reads the header.
pub fn parse(bytes: &[u8]) -> Result<Header<'_>, PlyError> {
    let (text, data) = split(bytes)?;
    let mut elements: Vec<Element> = Vec::new();
    let mut lines = 0;
    for (i, line) in text.lines().enumerate() {
        lines = i + 1;
        let words: Vec<&str> = line.split_whitespace().collect();
        parse_line(i, &words, &mut elements).map_err(|expected| {
            let found = line.trim_end().chars().take(80).collect();
            PlyError::Header { line: i + 1, found, expected }
        })?;
    }
    let vertex = elements.iter().position(|element| element.name == "vertex");
    let expected = "\"element vertex N\" before it";
    let no_vertex = PlyError::Header { line: lines + 1, found: "end_header".to_owned(), expected };
    let (before, rest) = elements.split_at(vertex.ok_or_else(|| no_vertex.clone())?);
    let Some((vertices, after)) = rest.split_first() else { return Err(no_vertex) };
    for element in before.iter().chain([vertices]) {
        if let Some(name) = element.list.clone() {
            return Err(PlyError::List { name, element: element.name.clone() });
        }
    }
    let skipped = before.iter().fold(0_u64, |sum, e| sum.saturating_add(e.count.saturating_mul(e.stride as u64)));
    let expected = skipped.saturating_add(vertices.count.saturating_mul(vertices.stride as u64));
    let found = data.len() as u64;
    if found < expected || (found > expected && after.is_empty()) {
        return Err(PlyError::Length { count: vertices.count, expected, found });
    }
    Ok(Header {
        count: vertices.count,
        properties: vertices.properties.clone(),
        stride: vertices.stride,
        // In range: not above the length of the data.
        data: &data[skipped as usize..],
    })
}

/// Text of the header without its last line, and what follows it.
fn split(bytes: &[u8]) -> Result<(String, &[u8]), PlyError> {
    const END: &[u8] = b"end_header";
    let searched = &bytes[..bytes.len().min(HEADER_MAX)];
    let mut from = 0;
    while let Some(at) = searched[from..].windows(END.len()).position(|w| w == END).map(|at| from + at) {
        let after = &bytes[at + END.len()..];
        let data = after.strip_prefix(b"\n").or_else(|| after.strip_prefix(b"\r\n"));
        if let (Some(data), true) = (data, at > 0 && bytes[at - 1] == b'\n') {
            return Ok((String::from_utf8_lossy(&bytes[..at]).into_owned(), data));
        }
        from = at + END.len();
    }
    Err(PlyError::NoEnd)
}

/// Takes one line in, or says what was expected in its place.
fn parse_line(number: usize, words: &[&str], elements: &mut Vec<Element>) -> Result<(), &'static str> {
    match (number, words) {
        (0, ["ply"]) | (2.., ["comment" | "obj_info", ..]) => {}
        (0, _) => return Err("\"ply\""),
        (1, ["format", "binary_little_endian", "1.0"]) => {}
        (1, ["format", ..]) => {
            return Err("\"format binary_little_endian 1.0\": convert the file, as text and big-endian are not read");
        }
        (1, _) => return Err("\"format binary_little_endian 1.0\""),
        (_, ["element", name, count]) => {
            if elements.iter().any(|element| element.name == *name) {
                return Err("each element once");
            }
            let count = count.parse().map_err(|_not_a_number| "a number of rows")?;
            let name = (*name).to_owned();
            elements.push(Element { name, count, properties: Vec::new(), stride: 0, list: None });
        }
        (_, ["property", "list", _, _, name]) => {
            let element = elements.last_mut().ok_or("an element before its properties")?;
            element.list.get_or_insert_with(|| (*name).to_owned());
        }
        (_, ["property", scalar, name]) => {
            let element = elements.last_mut().ok_or("an element before its properties")?;
            let scalar = Scalar::named(scalar).ok_or("a type of property: char to double, or int8 to float64")?;
            if element.properties.iter().any(|property| property.name == *name) {
                return Err("each property once");
            }
            let (name, offset) = ((*name).to_owned(), element.stride);
            element.properties.push(Property { name, scalar, offset });
            element.stride += scalar.bytes();
        }
        _ => return Err("\"element NAME COUNT\", \"property TYPE NAME\" or \"comment\""),
    }
    Ok(())
}
