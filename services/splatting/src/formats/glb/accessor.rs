//! Accessors: typed views of the binary chunk, checked before anything is read through them.

use super::json::Document;
use super::{F32, GlbError, U16};

/// Types that an attribute may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Allowed {
    /// f32, and all integers of 8 and 16 bits where the document requires `KHR_mesh_quantization`.
    Position,
    /// f32, and normalised integers with sign.
    Rotation,
    /// f32, and integers without sign, normalised or not.
    Scale,
    /// f32, and normalised integers without sign.
    Opacity,
    /// f32.
    Harmonics,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Component {
    I8,
    U8,
    I16,
    U16,
    F32,
}

impl Component {
    fn of(code: u32) -> Option<Self> {
        Some(match code {
            5120 => Self::I8,
            5121 => Self::U8,
            5122 => Self::I16,
            U16 => Self::U16,
            F32 => Self::F32,
            _ => return None,
        })
    }

    const fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::F32 => 4,
        }
    }
}

impl Allowed {
    fn has(self, component: Component, normalized: bool, quantized: bool) -> bool {
        match (self, component) {
            (_, Component::F32) => !normalized,
            (Self::Position, _) => quantized,
            (Self::Rotation, Component::I8 | Component::I16) => normalized,
            (Self::Scale, Component::U8 | Component::U16) => true,
            (Self::Opacity, Component::U8 | Component::U16) => normalized,
            _ => false,
        }
    }

    /// Numbers of an element, and their name in glTF.
    const fn shape(self) -> (usize, &'static str) {
        match self {
            Self::Position | Self::Scale | Self::Harmonics => (3, "VEC3"),
            Self::Rotation => (4, "VEC4"),
            Self::Opacity => (1, "SCALAR"),
        }
    }
}

/// The numbers of an attribute.
#[derive(Clone, Copy, Debug)]
pub struct Column<'a> {
    bytes: &'a [u8],
    stride: usize,
    component: Component,
    normalized: bool,
    /// Number of elements.
    pub count: usize,
}

impl<'a> Column<'a> {
    /// Checks an accessor and finds its data in the binary chunk.
    pub fn new(document: &Document, binary: &'a [u8], index: usize, allowed: Allowed) -> Result<Self, GlbError> {
        let at = format!("accessors[{index}]");
        let wrong = |field: &str, found: String, expected: String| GlbError::Document {
            field: format!("{at}{field}"),
            found,
            expected,
        };
        let missing = |count: usize| format!("one of the {count} there are");
        let Some(accessor) = document.accessors.get(index) else {
            return Err(wrong("", "missing".to_owned(), missing(document.accessors.len())));
        };
        let (width, kind) = allowed.shape();
        if accessor.kind != kind {
            return Err(wrong(".type", format!("{:?}", accessor.kind), format!("{kind:?}")));
        }
        let quantized = document.extensions_required.iter().any(|name| name == "KHR_mesh_quantization");
        let component = Component::of(accessor.component_type)
            .filter(|component| allowed.has(*component, accessor.normalized, quantized))
            .ok_or_else(|| {
                let normalized = if accessor.normalized { ", normalised" } else { "" };
                let found = format!("{}{normalized}", accessor.component_type);
                wrong(".componentType", found, "5126 (f32), or an integer that the extension allows here".to_owned())
            })?;
        if accessor.sparse.is_some() {
            return Err(wrong(".sparse", "present".to_owned(), "a plain accessor".to_owned()));
        }
        let Some(view_index) = accessor.buffer_view else {
            return Err(wrong(".bufferView", "missing".to_owned(), "data of the binary chunk".to_owned()));
        };
        let view_at = format!("bufferViews[{view_index}]");
        let Some(view) = document.buffer_views.get(view_index) else {
            return Err(wrong(".bufferView", view_index.to_string(), missing(document.buffer_views.len())));
        };
        // The binary chunk is the first buffer, if that has no URI.
        let first = document.buffers.first().filter(|buffer| buffer.uri.is_none());
        let Some(buffer) = first.filter(|_| view.buffer == 0) else {
            let field = format!("{view_at}.buffer");
            let expected = "0, the binary chunk: pack the file into one .glb".to_owned();
            return Err(GlbError::Document { field, found: format!("{}, or has a URI", view.buffer), expected });
        };
        let length = |what: &str, expected: u64, found: u64| {
            if expected > found {
                return Err(GlbError::Length { what: what.to_owned(), expected, found });
            }
            Ok(())
        };
        length("the binary chunk", buffer.byte_length, binary.len() as u64)?;
        length("buffers[0]", view.byte_offset.saturating_add(view.byte_length), buffer.byte_length)?;
        let element = width * component.bytes();
        let stride = view.byte_stride.unwrap_or(element as u64);
        if stride < element as u64 || stride > 252 {
            let expected = format!("{element} to 252");
            return Err(GlbError::Document {
                field: format!("{view_at}.byteStride"),
                found: stride.to_string(),
                expected,
            });
        }
        let last = stride.saturating_mul(accessor.count.saturating_sub(1));
        let used = if accessor.count == 0 { 0 } else { last.saturating_add(element as u64) };
        length(&view_at, accessor.byte_offset.saturating_add(used), view.byte_length)?;
        // All in range now, and so in usize.
        let from = (view.byte_offset + accessor.byte_offset) as usize;
        Ok(Self {
            bytes: &binary[from..from + used as usize],
            stride: stride as usize,
            component,
            normalized: accessor.normalized,
            count: accessor.count as usize,
        })
    }

    /// The numbers of element `index`; those beyond the end are not a number.
    pub fn element<const N: usize>(&self, index: usize) -> [f64; N] {
        std::array::from_fn(|k| self.number(index * self.stride + k * self.component.bytes()).unwrap_or(f64::NAN))
    }

    fn number(&self, at: usize) -> Option<f64> {
        let bytes = self.bytes.get(at..)?;
        let (value, largest) = match self.component {
            Component::F32 => return Some(f64::from(f32::from_le_bytes(*bytes.first_chunk()?))),
            Component::I8 => (f64::from(i8::from_le_bytes(*bytes.first_chunk()?)), f64::from(i8::MAX)),
            Component::U8 => (f64::from(u8::from_le_bytes(*bytes.first_chunk()?)), f64::from(u8::MAX)),
            Component::I16 => (f64::from(i16::from_le_bytes(*bytes.first_chunk()?)), f64::from(i16::MAX)),
            Component::U16 => (f64::from(u16::from_le_bytes(*bytes.first_chunk()?)), f64::from(u16::MAX)),
        };
        // The most negative integer is -1 too.
        Some(if self.normalized { (value / largest).max(-1.0) } else { value })
    }
}
