//! Writing.

use std::io::Write;

use glam::Vec3;
use serde_json::{Value, json};

use super::{
    BIN, CHUNK_HEADER, COLOR_SPACE, EXTENSION, F32, HEADER, JSON, KERNEL, MAGIC, OPACITY, POSITION, PROJECTION,
    ROTATION, SCALE, SORTING, U16, VERSION, rest_attributes, sh_attribute,
};
use crate::formats::frames::Turn;
use crate::formats::{WriteError, check_finite, linear_scales, opacity, unit_rotation};
use crate::model::Gaussians;

/// An attribute: its accessor and how it is written.
struct Column {
    name: String,
    kind: Kind,
}

#[derive(Clone, Copy)]
enum Kind {
    Mean,
    Color,
    Rotation,
    Scale,
    Opacity,
    Degree0,
    /// Coefficient above degree 0.
    Band(usize),
}

impl Kind {
    const fn accessor_type(self) -> &'static str {
        match self {
            Self::Mean | Self::Scale | Self::Degree0 | Self::Band(_) => "VEC3",
            Self::Color | Self::Rotation => "VEC4",
            Self::Opacity => "SCALAR",
        }
    }

    /// Of a Gaussian; multiples of 4, as glTF wants vertex attributes aligned.
    const fn bytes(self) -> usize {
        match self {
            Self::Mean | Self::Scale | Self::Degree0 | Self::Band(_) => 12,
            Self::Rotation => 16,
            Self::Color => 8,
            Self::Opacity => 4,
        }
    }

    /// Appends the attribute of one Gaussian.
    fn put(self, gaussians: &Gaussians, turn: &Turn, index: usize, to: &mut Vec<u8>) -> Result<(), WriteError> {
        let g = gaussians.get(index);
        let mut floats = |values: &[f32]| to.extend(values.iter().flat_map(|v| v.to_le_bytes()));
        match self {
            Self::Mean => floats(&turn.mean(g.mean).to_array()),
            Self::Rotation => {
                // Normalised after the turn, in f64: readers may rely on the unit length.
                let rotation = turn.rotation(unit_rotation(&g).as_quat()).as_dquat().normalize();
                floats(&rotation.as_quat().to_array());
            }
            Self::Scale => floats(&linear_scales(index, &g, FORMAT)?),
            Self::Opacity => floats(&[opacity(g.opacity_logit) as f32]),
            Self::Degree0 => floats(&g.sh),
            Self::Band(k) => floats(&turn.band_coefficient(k, &gaussians.sh_rest(index))),
            Self::Color => {
                let [red, green, blue] = g.color().map(|c| linear(f64::from(c).clamp(0.0, 1.0)));
                let values = [red, green, blue, opacity(g.opacity_logit)];
                to.extend(values.iter().flat_map(|v| ((65535.0 * v).round() as u16).to_le_bytes()));
            }
        }
        Ok(())
    }
}

const FORMAT: &str = "glTF";

/// A colour in [0, 1] decoded from sRGB (IEC 61966-2-1).
fn linear(srgb: f64) -> f64 {
    if srgb <= 0.040_45 { srgb / 12.92 } else { ((srgb + 0.055) / 1.055).powf(2.4) }
}

fn columns(degree: u8) -> Vec<Column> {
    let fixed = [
        (POSITION.to_owned(), Kind::Mean),
        ("COLOR_0".to_owned(), Kind::Color),
        (ROTATION.to_owned(), Kind::Rotation),
        (SCALE.to_owned(), Kind::Scale),
        (OPACITY.to_owned(), Kind::Opacity),
        (sh_attribute(0, 0), Kind::Degree0),
    ];
    let bands = rest_attributes(degree).into_iter().enumerate().map(|(k, name)| (name, Kind::Band(k)));
    fixed.into_iter().chain(bands).map(|(name, kind)| Column { name, kind }).collect()
}

/// Writes a model with all bands that it has.
///
/// # Errors
/// Those of the writer; [`WriteError::NotFinite`]; [`WriteError::Range`] for scales that f32 has not;
/// [`WriteError::Count`] for an empty model, which glTF has no way to say, and for one of more than 4 GiB.
pub fn write(gaussians: &Gaussians, to: &mut impl Write) -> Result<(), WriteError> {
    check_finite(gaussians)?;
    let columns = columns(gaussians.sh_degree());
    let each: usize = columns.iter().map(|column| column.kind.bytes()).sum();
    // Room for the JSON is what nobody misses.
    let most = (u64::from(u32::MAX) - (1 << 20)) / each as u64;
    let count = gaussians.len();
    if count == 0 || count as u64 > most {
        return Err(WriteError::Count { count, format: FORMAT, least: 1, most });
    }
    let turn = Turn::world_to_y_up();
    let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for (index, g) in gaussians.iter().enumerate() {
        linear_scales(index, &g, FORMAT)?;
        let mean = turn.mean(g.mean);
        (low, high) = (low.min(mean), high.max(mean));
    }

    let mut text = document(&columns, count, low, high).to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let binary = count * each;
    let length = HEADER + CHUNK_HEADER + text.len() + CHUNK_HEADER + binary;
    to.write_all(&[MAGIC, VERSION.to_le_bytes(), (length as u32).to_le_bytes()].concat())?;
    to.write_all(&[(text.len() as u32).to_le_bytes(), JSON].concat())?;
    to.write_all(&text)?;
    to.write_all(&[(binary as u32).to_le_bytes(), BIN].concat())?;
    let mut bytes = Vec::new();
    for column in &columns {
        for index in 0..count {
            bytes.clear();
            column.kind.put(gaussians, &turn, index, &mut bytes)?;
            to.write_all(&bytes)?;
        }
    }
    Ok(())
}

/// The JSON, with the means' bounds.
fn document(columns: &[Column], count: usize, low: Vec3, high: Vec3) -> Value {
    let (mut views, mut accessors, mut attributes) = (Vec::new(), Vec::new(), serde_json::Map::new());
    let mut offset = 0;
    for (i, column) in columns.iter().enumerate() {
        let bytes = count * column.kind.bytes();
        // 34962: vertex attributes.
        views.push(json!({"buffer": 0, "byteOffset": offset, "byteLength": bytes, "target": 34962}));
        let kind = column.kind.accessor_type();
        let mut accessor = json!({"bufferView": i, "componentType": F32, "count": count, "type": kind});
        match column.kind {
            Kind::Mean => {
                accessor["min"] = json!(low.to_array());
                accessor["max"] = json!(high.to_array());
            }
            Kind::Color => {
                accessor["componentType"] = json!(U16);
                accessor["normalized"] = json!(true);
            }
            _ => {}
        }
        accessors.push(accessor);
        attributes.insert(column.name.clone(), json!(i));
        offset += bytes;
    }
    json!({
        "asset": {"version": "2.0", "generator": "Vantage"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{
            "attributes": attributes,
            "mode": 0,
            "extensions": {EXTENSION: {
                "kernel": KERNEL,
                "colorSpace": COLOR_SPACE,
                "projection": PROJECTION,
                "sortingMethod": SORTING,
            }},
        }]}],
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    })
}
