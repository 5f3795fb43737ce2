//! Triangle meshes: loading (OBJ, PLY, STL, glTF), checking, and standing them on the ground at a chosen size and yaw.
//!
//! A loader fills a [`RawMesh`] with what the file says; [`Mesh::from_raw`] checks it, drops triangles without an area,
//! makes the winding outward, supplies missing normals and places the object. From there on, nothing can be out of range.

mod error;
mod gltf;
mod images;
mod normals;
mod obj;
mod placement;
mod ply;
mod stl;

use std::path::Path;

use glam::{Vec2, Vec3};

pub use error::MeshError;
pub use placement::{Placement, UpAxis};

use crate::texture::Texture;

/// What gives a surface its colour.
#[derive(Debug, Clone)]
pub enum Material {
    /// An image, by the triangles' texture coordinates.
    Texture(Texture),
    /// Colours at the corners.
    CornerColors,
    /// Nothing in the file: a procedural albedo by position.
    Procedural,
}

/// What a file says, unchecked. Values per corner are per triangle, three each, and absent where the file has none.
#[derive(Debug, Clone, Default)]
pub struct RawMesh {
    /// Vertices, in the file's unit and axes.
    pub positions: Vec<Vec3>,
    /// Three vertices each.
    pub triangles: Vec<[u32; 3]>,
    /// Normals at the corners.
    pub normals: Option<Vec<[Vec3; 3]>>,
    /// Texture coordinates at the corners, v downwards.
    pub uvs: Option<Vec<[Vec2; 3]>>,
    /// Linear colours at the corners.
    pub colors: Option<Vec<[Vec3; 3]>>,
    /// Material of each triangle.
    pub triangle_materials: Vec<u16>,
    /// The materials.
    pub materials: Vec<Material>,
}

/// A checked mesh in world coordinates: finite, in range, outward, every triangle with an area.
#[derive(Debug, Clone)]
pub struct Mesh {
    /// Vertices in the world frame, metres.
    pub positions: Vec<Vec3>,
    /// Three vertices each, counter-clockwise from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Unit normals at the corners of each triangle.
    pub normals: Vec<[Vec3; 3]>,
    /// Texture coordinates at the corners of each triangle, v downwards; zero without a texture.
    pub uvs: Vec<[Vec2; 3]>,
    /// Linear colours at the corners of each triangle; empty if there are none.
    pub colors: Vec<[Vec3; 3]>,
    /// Index into `materials` for each triangle.
    pub triangle_materials: Vec<u16>,
    /// The materials.
    pub materials: Vec<Material>,
}

impl Mesh {
    /// Loads a mesh by its extension and places it.
    ///
    /// # Errors
    /// [`MeshError`] if the file cannot be read, is not what its format demands, or holds no usable surface. A texture that
    /// is missing or broken is a warning, and the object gets a procedural albedo instead.
    pub fn load(path: &Path, placement: &Placement) -> Result<Self, MeshError> {
        let bytes = std::fs::read(path).map_err(|source| MeshError::Unreadable { path: path.to_owned(), source })?;
        Self::from_bytes(path, &bytes, placement)
    }

    /// As [`Self::load`], of the bytes of a file. `path` names them, and is where files that they refer to are looked for.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn from_bytes(path: &Path, bytes: &[u8], placement: &Placement) -> Result<Self, MeshError> {
        if bytes.is_empty() {
            return Err(MeshError::Empty { path: path.to_owned() });
        }
        let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
        let (raw, native_up) = match extension.as_str() {
            "obj" => (obj::read(path, bytes)?, UpAxis::Z),
            "ply" => (ply::read(path, bytes)?, UpAxis::Z),
            "stl" => (stl::read(path, bytes)?, UpAxis::Z),
            // The format's specification fixes y as up.
            "gltf" | "glb" => (gltf::read(path, bytes)?, UpAxis::Y),
            _ => return Err(MeshError::UnknownFormat { path: path.to_owned(), found: extension }),
        };
        Self::from_raw(path, raw, native_up, placement)
    }

    /// Checks and places what a loader (or a generator) made. `path` names the mesh in errors, `native_up` is the up axis
    /// that the format implies, used unless the placement names one.
    ///
    /// # Errors
    /// [`MeshError`] for non-finite vertices, indices out of range, no triangle with an area, or a bad placement.
    pub fn from_raw(path: &Path, raw: RawMesh, native_up: UpAxis, placement: &Placement) -> Result<Self, MeshError> {
        let mut raw = raw;
        check(path, &raw)?;
        drop_degenerate(path, &mut raw)?;
        if signed_volume(&raw) < 0.0 {
            flip_winding(&mut raw);
        }
        placement.apply(native_up, &mut raw)?;
        let count = raw.triangles.len();
        let computed = || normals::smooth(&raw.positions, &raw.triangles);
        let normals = match raw.normals.take() {
            Some(given) => normals::repaired(&raw.positions, &raw.triangles, given),
            None => computed(),
        };
        let uvs = raw.uvs.unwrap_or_else(|| vec![[Vec2::ZERO; 3]; count]);
        let colors = raw.colors.unwrap_or_default();
        Ok(Self {
            positions: raw.positions,
            triangles: raw.triangles,
            normals,
            uvs,
            colors,
            triangle_materials: raw.triangle_materials,
            materials: raw.materials,
        })
    }

    /// The corners of a triangle, metres.
    #[must_use]
    pub fn corners(&self, triangle: usize) -> [Vec3; 3] {
        self.triangles[triangle].map(|i| self.positions[i as usize])
    }

    /// Smallest and largest coordinates, metres.
    #[must_use]
    pub fn bounds(&self) -> (Vec3, Vec3) {
        bounds_of(&self.positions)
    }

    /// Surface area, square metres.
    #[must_use]
    pub fn area_m2(&self) -> f64 {
        (0..self.triangles.len()).map(|t| f64::from(area(self.corners(t)))).sum()
    }
}

/// Area of a triangle.
pub(crate) fn area([a, b, c]: [Vec3; 3]) -> f32 {
    0.5 * (b - a).cross(c - a).length()
}

pub(crate) fn bounds_of(points: &[Vec3]) -> (Vec3, Vec3) {
    points.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), p| (low.min(*p), high.max(*p)))
}

fn check(path: &Path, raw: &RawMesh) -> Result<(), MeshError> {
    if let Some((vertex, value)) = raw.positions.iter().enumerate().find(|(_, p)| !p.is_finite()) {
        return Err(MeshError::NonFinite { path: path.to_owned(), vertex, value: *value });
    }
    let vertices = raw.positions.len();
    for (triangle, corners) in raw.triangles.iter().enumerate() {
        if let Some(index) = corners.iter().find(|i| **i as usize >= vertices) {
            let index = u64::from(*index);
            return Err(MeshError::IndexOutOfRange { path: path.to_owned(), triangle, index, vertices });
        }
    }
    Ok(())
}

/// Extents that scaling and turning in single precision can take, in the file's unit.
const LEAST_EXTENT: f32 = 1e-15;
/// See [`LEAST_EXTENT`].
const MOST_EXTENT: f32 = 1e15;

/// Removes triangles without an area, keeping every per-triangle table in step.
fn drop_degenerate(path: &Path, raw: &mut RawMesh) -> Result<(), MeshError> {
    let (low, high) = bounds_of(&raw.positions);
    let extent = (high - low).max_element();
    let keep: Vec<bool> = raw
        .triangles
        .iter()
        .map(|corners| {
            let [a, b, c] = corners.map(|i| raw.positions[i as usize].as_dvec3() / f64::from(extent));
            (b - a).cross(c - a).length() > 1e-14
        })
        .collect();
    let dropped = keep.iter().filter(|k| !**k).count();
    if dropped == raw.triangles.len() {
        return Err(MeshError::NoTriangles { path: path.to_owned(), vertices: raw.positions.len() });
    }
    if !(LEAST_EXTENT..=MOST_EXTENT).contains(&extent)
        || !raw.positions.iter().all(|p| p.abs().max_element() <= MOST_EXTENT)
    {
        return Err(MeshError::Malformed {
            path: path.to_owned(),
            found: format!("an object {extent:e} units across, from {low} to {high}"),
            expected: "one of 1e-15 to 1e15 units, no farther from the origin",
        });
    }
    if dropped > 0 {
        tracing::debug!(mesh = %path.display(), dropped, "triangles without an area left out");
        retain(&mut raw.triangles, &keep);
        retain(&mut raw.triangle_materials, &keep);
        for table in [&mut raw.normals, &mut raw.colors].into_iter().flatten() {
            retain(table, &keep);
        }
        if let Some(uvs) = &mut raw.uvs {
            retain(uvs, &keep);
        }
    }
    Ok(())
}

fn retain<T>(table: &mut Vec<T>, keep: &[bool]) {
    let mut flags = keep.iter();
    table.retain(|_| flags.next().copied().unwrap_or(false));
}

/// Positive if the winding is outward; exact for closed surfaces, a good guess for open ones.
fn signed_volume(raw: &RawMesh) -> f64 {
    let (low, high) = bounds_of(&raw.positions);
    let center = (low.as_dvec3() + high.as_dvec3()) / 2.0;
    raw.triangles
        .iter()
        .map(|corners| {
            let [a, b, c] = corners.map(|i| raw.positions[i as usize].as_dvec3() - center);
            a.dot(b.cross(c)) / 6.0
        })
        .sum()
}

fn flip_winding(raw: &mut RawMesh) {
    raw.triangles.iter_mut().for_each(|corners| corners.swap(1, 2));
    for table in [&mut raw.normals, &mut raw.colors].into_iter().flatten() {
        table.iter_mut().for_each(|corners| corners.swap(1, 2));
    }
    if let Some(uvs) = &mut raw.uvs {
        uvs.iter_mut().for_each(|corners| corners.swap(1, 2));
    }
}

#[cfg(test)]
mod tests;
