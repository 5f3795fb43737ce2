//! Wavefront OBJ with the diffuse texture (`map_Kd`) of its MTL files.

use std::cell::RefCell;
use std::path::{Path, PathBuf};

use glam::{Vec2, Vec3};
use tobj::LoadError;

use super::{Material, MeshError, RawMesh, images};

const OPTIONS: tobj::LoadOptions =
    tobj::LoadOptions { single_index: false, triangulate: true, ignore_points: true, ignore_lines: true };

/// Reads the text of an OBJ file; material files are looked up beside it.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<RawMesh, MeshError> {
    let folder = path.parent().unwrap_or(Path::new("")).to_owned();
    let warnings = RefCell::new(Vec::new());
    let loaded = tobj::load_obj_buf(&mut &bytes[..], &OPTIONS, |file| {
        let file = folder.join(file);
        let known = images::check_beside(&file).map_err(|_unreadable| LoadError::OpenFileFailed);
        known
            .and_then(|()| tobj::load_mtl(&file))
            .inspect_err(|error| warnings.borrow_mut().push((file.clone(), *error)))
    });
    for (file, error) in warnings.into_inner() {
        tracing::warn!(mesh = %path.display(), material = %file.display(), %error, "material file cannot be read; its textures are left out");
    }
    let (models, materials) = loaded.map_err(|error| malformed(path, error))?;
    let materials = materials.unwrap_or_default();

    let mut raw =
        RawMesh { materials: materials.iter().map(|m| material(path, &folder, m)).collect(), ..RawMesh::default() };
    // The last material is for faces that name none.
    let default_material = raw.materials.len() as u16;
    raw.materials.push(Material::Procedural);
    let meshes = || models.iter().map(|model| &model.mesh).filter(|mesh| !mesh.indices.is_empty());
    let has_normals = meshes().all(|mesh| mesh.normal_indices.len() == mesh.indices.len());
    let has_colors = meshes().all(|mesh| mesh.vertex_color.len() == mesh.positions.len() && !mesh.positions.is_empty());
    let (mut normals, mut uvs, mut colors) = (Vec::new(), Vec::new(), Vec::new());
    for mesh in meshes() {
        let base = raw.positions.len() as u32;
        raw.positions.extend(mesh.positions.as_chunks::<3>().0.iter().map(|p| Vec3::from_array(*p)));
        let textured = mesh.texcoord_indices.len() == mesh.indices.len();
        let own = mesh.material_id.map_or(default_material, |id| id as u16);
        let own = if textured || !matches!(raw.materials.get(usize::from(own)), Some(Material::Texture(_))) {
            own
        } else {
            default_material
        };
        for (t, corners) in mesh.indices.as_chunks::<3>().0.iter().enumerate() {
            raw.triangles.push(corners.map(|i| base + i));
            raw.triangle_materials.push(own);
            let tables = |indices: &[u32]| [0, 1, 2].map(|k| indices.get(3 * t + k).map_or(0, |i| *i as usize));
            if has_normals {
                normals.push(tables(&mesh.normal_indices).map(|i| vec3_at(&mesh.normals, i)));
            }
            // OBJ counts v upwards from the lower left corner of the image.
            uvs.push(if textured {
                tables(&mesh.texcoord_indices).map(|i| uv_at(&mesh.texcoords, i))
            } else {
                [Vec2::ZERO; 3]
            });
            if has_colors {
                colors.push(corners.map(|i| vec3_at(&mesh.vertex_color, i as usize)));
            }
        }
    }
    raw.normals = (has_normals && !normals.is_empty()).then_some(normals);
    raw.uvs = Some(uvs);
    if has_colors && !colors.is_empty() {
        raw.colors = Some(colors);
        raw.materials
            .iter_mut()
            .filter(|m| matches!(m, Material::Procedural))
            .for_each(|m| *m = Material::CornerColors);
    }
    Ok(raw)
}

fn vec3_at(flat: &[f32], index: usize) -> Vec3 {
    flat.get(3 * index..3 * index + 3).map_or(Vec3::ZERO, Vec3::from_slice)
}

fn uv_at(flat: &[f32], index: usize) -> Vec2 {
    flat.get(2 * index..2 * index + 2)
        .map_or(Vec2::ZERO, |uv| Vec2::new(uv[0], 1.0 - uv[1]))
        .clamp(Vec2::splat(-1e6), Vec2::splat(1e6))
}

fn material(mesh: &Path, folder: &Path, material: &tobj::Material) -> Material {
    let Some(name) = material.diffuse_texture.as_deref().map(str::trim).filter(|name| !name.is_empty()) else {
        return Material::Procedural;
    };
    images::from_file(mesh, &texture_path(folder, name))
}

/// Paths from Windows have backslashes, and options (`-s 1 1 1 file.png`) may stand before the name.
fn texture_path(folder: &Path, name: &str) -> PathBuf {
    let name = name.replace('\\', "/");
    let whole = folder.join(&name);
    if whole.exists() || !name.starts_with('-') {
        return whole;
    }
    folder.join(name.rsplit(char::is_whitespace).next().unwrap_or(&name))
}

fn malformed(path: &Path, error: LoadError) -> MeshError {
    let expected = match error {
        LoadError::FaceVertexOutOfBounds
        | LoadError::FaceTexCoordOutOfBounds
        | LoadError::FaceNormalOutOfBounds
        | LoadError::FaceColorOutOfBounds => {
            "faces whose indices are within the vertices, texture coordinates and normals above them"
        }
        LoadError::PositionParseError => "three numbers after each v",
        LoadError::ReadError => "UTF-8 text",
        LoadError::FaceParseError | LoadError::InvalidPolygon => {
            "at least three indices after each f, as v, v/t, v//n or v/t/n"
        }
        _ => "a Wavefront OBJ file",
    };
    MeshError::Malformed { path: path.to_owned(), found: format!("OBJ: {error}"), expected }
}
