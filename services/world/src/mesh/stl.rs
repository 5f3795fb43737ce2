//! STL, text or binary. It knows no texture, no unit and no shared vertices.

use std::path::Path;

use glam::Vec3;

use super::{Material, MeshError, RawMesh};

/// Reads the bytes of an STL file. Its face normals are ignored: many programs leave them zero.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<RawMesh, MeshError> {
    let mesh = stl_io::read_stl(&mut std::io::Cursor::new(bytes)).map_err(|error| MeshError::Malformed {
        path: path.to_owned(),
        found: format!("STL of {} bytes: {error}", bytes.len()),
        expected: "a text STL (solid ... endsolid), or a binary one of 84 bytes and 50 more for each triangle it announces",
    })?;
    let triangles: Vec<[u32; 3]> = mesh.faces.iter().map(|face| face.vertices.map(|i| i as u32)).collect();
    Ok(RawMesh {
        positions: mesh.vertices.iter().map(|v| Vec3::from_array(v.0)).collect(),
        triangle_materials: vec![0; triangles.len()],
        triangles,
        materials: vec![Material::Procedural],
        ..RawMesh::default()
    })
}
