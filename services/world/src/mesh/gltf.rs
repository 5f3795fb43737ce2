//! glTF 2.0, text or binary (GLB), with embedded or external buffers and base-colour textures. All meshes of the default
//! scene count, each moved by its node.

use std::path::Path;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use glam::{Mat3, Mat4, Vec2, Vec3};
use gltf::Accessor;
use gltf::accessor::{DataType, Dimensions};
use gltf::mesh::Mode;

use super::{Material, MeshError, RawMesh, images};

/// Vertices of all nodes together: more would not fit beside the other processes.
const MAX_VERTICES: usize = 50_000_000;
/// Nodes nested deeper than this are a cycle or a bomb.
const MAX_DEPTH: usize = 64;

/// Reads the bytes of a .gltf or .glb file; external files are looked up beside it.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<RawMesh, MeshError> {
    let malformed = |found: String, expected| MeshError::Malformed {
        path: path.to_owned(),
        found: format!("glTF: {found}"),
        expected,
    };
    const VALID: &str = "a valid glTF 2.0 file without compression extensions";
    let gltf::Gltf { document, blob } =
        gltf::Gltf::from_slice_without_validation(bytes).map_err(|error| malformed(error.to_string(), VALID))?;
    let mut json = document.into_json();
    complete_images(&mut json);
    check_positions(&json).map_err(|found| malformed(found, VALID))?;
    let document = gltf::Document::from_json(json).map_err(|error| malformed(error.to_string(), VALID))?;
    let mut buffers = Vec::new();
    for buffer in document.buffers() {
        let data = match buffer.source() {
            gltf::buffer::Source::Bin => blob
                .clone()
                .ok_or_else(|| malformed("no binary chunk".to_owned(), "a GLB file with its binary chunk"))?,
            gltf::buffer::Source::Uri(uri) => resource(path, uri)?,
        };
        if data.len() < buffer.length() {
            let found =
                format!("buffer {} has {} bytes of the {} announced", buffer.index(), data.len(), buffer.length());
            return Err(malformed(found, "complete buffers"));
        }
        buffers.push(data);
    }
    let mut materials: Vec<Material> =
        document.materials().map(|material| base_color(path, &material, &buffers)).collect();
    materials.push(Material::Procedural);
    let mut parts = Parts { raw: RawMesh { materials, ..RawMesh::default() }, ..Parts::default() };
    parts.unvisited = vec![true; document.nodes().len()];
    let scene = document.default_scene().or_else(|| document.scenes().next());
    let Some(scene) = scene else {
        return Err(malformed("no scene".to_owned(), "a scene with at least one mesh"));
    };
    for node in scene.nodes() {
        parts
            .add_node(&node, Mat4::IDENTITY, &buffers, 0)
            .map_err(|found| malformed(found, "triangles whose positions and indices lie inside their buffers"))?;
    }
    Ok(parts.finish())
}

/// Whether the accessors of all positions are there: the library's own validation takes that for granted.
fn check_positions(json: &gltf::json::Root) -> Result<(), String> {
    let positions = gltf::json::validation::Checked::Valid(gltf::Semantic::Positions);
    let used = json.meshes.iter().flat_map(|mesh| &mesh.primitives).filter_map(|p| p.attributes.get(&positions));
    match used.map(|index| index.value()).find(|&index| index >= json.accessors.len()) {
        Some(index) => Err(format!("positions in accessor {index} of {}", json.accessors.len())),
        None => Ok(()),
    }
}

/// The library takes for granted that an image says where it lies and, in a buffer, of what kind it is. The kind is told
/// from the bytes anyway, and an image that lies nowhere is one that cannot be read.
fn complete_images(json: &mut gltf::json::Root) {
    for image in &mut json.images {
        match image.buffer_view {
            Some(_) => {
                image.mime_type.get_or_insert_with(|| gltf::json::image::MimeType("image/png".to_owned()));
            }
            None => {
                image.uri.get_or_insert_default();
            }
        }
    }
}

/// The bytes of a data URI or of a file beside the mesh.
fn resource(path: &Path, uri: &str) -> Result<Vec<u8>, MeshError> {
    if let Some(data) = uri.strip_prefix("data:") {
        let encoded = data.split_once("base64,").map_or("", |(_, encoded)| encoded);
        return BASE64.decode(encoded).map_err(|error| MeshError::Malformed {
            path: path.to_owned(),
            found: format!("glTF: a data URI that cannot be decoded: {error}"),
            expected: "base64",
        });
    }
    let file = path.with_file_name(percent_decoded(uri));
    let bytes = images::check_beside(&file).and_then(|()| std::fs::read(&file));
    bytes.map_err(|source| MeshError::Unreadable { path: file, source })
}

/// File names in URIs write blanks and other characters as %XX.
fn percent_decoded(uri: &str) -> String {
    let bytes = uri.as_bytes();
    let mut out = Vec::with_capacity(bytes.len());
    let mut i = 0;
    while i < bytes.len() {
        let code = (bytes[i] == b'%')
            .then(|| uri.get(i + 1..i + 3).and_then(|hex| u8::from_str_radix(hex, 16).ok()))
            .flatten();
        out.push(code.unwrap_or(bytes[i]));
        i += if code.is_some() { 3 } else { 1 };
    }
    String::from_utf8_lossy(&out).into_owned()
}

fn base_color(path: &Path, material: &gltf::Material, buffers: &[Vec<u8>]) -> Material {
    let Some(info) = material.pbr_metallic_roughness().base_color_texture() else { return Material::Procedural };
    match info.texture().source().source() {
        gltf::image::Source::View { view, .. } => {
            let bytes = buffers
                .get(view.buffer().index())
                .and_then(|data| data.get(view.offset()..view.offset().checked_add(view.length())?));
            images::from_bytes(path, "embedded image", bytes.unwrap_or_default())
        }
        gltf::image::Source::Uri { uri, .. } => match resource(path, uri) {
            Ok(bytes) => images::from_bytes(path, uri.get(..40).unwrap_or(uri), &bytes),
            Err(error) => {
                tracing::warn!(mesh = %path.display(), %error, "texture cannot be read; the object gets a procedural albedo");
                Material::Procedural
            }
        },
    }
}

#[derive(Default)]
struct Parts {
    raw: RawMesh,
    normals: Vec<[Vec3; 3]>,
    uvs: Vec<[Vec2; 3]>,
    missing_normals: bool,
    /// Nodes that were not met yet.
    unvisited: Vec<bool>,
}

/// What an accessor may hold: its shape, and the types of its numbers.
type Kinds = (Dimensions, &'static [DataType]);
const VECTORS: Kinds = (Dimensions::Vec3, &[DataType::F32]);
const INDICES: Kinds = (Dimensions::Scalar, &[DataType::U8, DataType::U16, DataType::U32]);
const COORDINATES: Kinds = (Dimensions::Vec2, &[DataType::F32, DataType::U8, DataType::U16]);

/// Whether an accessor holds what it should, and lies in its buffer with everything that it counts. The library's readers
/// take that for granted; an accessor without a view would be as many zeros as it likes.
fn check_accessor(accessor: Option<Accessor>, (shape, types): Kinds, buffers: &[Vec<u8>]) -> Result<(), String> {
    let Some(accessor) = accessor else { return Ok(()) };
    let fault = |what: &str| Err(format!("accessor {} {what}", accessor.index()));
    if accessor.dimensions() != shape || !types.contains(&accessor.data_type()) {
        let found = format!("holds {:?} of {:?}", accessor.dimensions(), accessor.data_type());
        return fault(&format!("{found} where {shape:?} of {types:?} belong"));
    }
    if accessor.sparse().is_some() {
        return fault("is sparse, which is not read: export the mesh without sparse accessors");
    }
    let Some(view) = accessor.view() else { return fault("has no buffer view") };
    let (size, count) = (accessor.size(), accessor.count());
    let stride = view.stride().unwrap_or(size);
    let bytes = count.checked_sub(1).and_then(|gaps| gaps.checked_mul(stride)?.checked_add(size));
    let inside = bytes.and_then(|bytes| bytes.checked_add(accessor.offset())).is_some_and(|end| end <= view.length());
    let end = view.offset().checked_add(view.length());
    let backed = buffers.get(view.buffer().index()).is_some_and(|buffer| end.is_some_and(|end| end <= buffer.len()));
    if stride < size || !inside || !backed {
        return fault(&format!("of {count} items, {stride} bytes apart, does not lie in its buffer"));
    }
    Ok(())
}

impl Parts {
    fn add_node(&mut self, node: &gltf::Node, parent: Mat4, buffers: &[Vec<u8>], depth: usize) -> Result<(), String> {
        if depth > MAX_DEPTH {
            return Err(format!("nodes are nested more than {MAX_DEPTH} deep"));
        }
        // Nodes are trees: with two ways to each of 64 levels, a small file would have more parts than memory holds.
        if self.unvisited.get_mut(node.index()).is_none_or(|unvisited| !core::mem::take(unvisited)) {
            return Err(format!("node {} has two parents", node.index()));
        }
        let transform = parent * Mat4::from_cols_array_2d(&node.transform().matrix());
        if let Some(mesh) = node.mesh() {
            for primitive in mesh.primitives() {
                self.add_primitive(&primitive, transform, buffers)?;
            }
        }
        for child in node.children() {
            self.add_node(&child, transform, buffers, depth + 1)?;
        }
        Ok(())
    }

    fn add_primitive(
        &mut self,
        primitive: &gltf::Primitive,
        transform: Mat4,
        buffers: &[Vec<u8>],
    ) -> Result<(), String> {
        let empty = |accessor: &gltf::Accessor| accessor.count() == 0;
        let unusable = primitive.get(&gltf::Semantic::Positions).is_none_or(|a| empty(&a))
            || primitive.indices().is_some_and(|a| empty(&a));
        if unusable || matches!(primitive.mode(), Mode::Points | Mode::Lines | Mode::LineLoop | Mode::LineStrip) {
            return Ok(());
        }
        for semantic in [gltf::Semantic::Positions, gltf::Semantic::Normals] {
            check_accessor(primitive.get(&semantic), VECTORS, buffers)?;
        }
        check_accessor(primitive.indices(), INDICES, buffers)?;
        let reader = primitive.reader(|buffer| buffers.get(buffer.index()).map(Vec::as_slice));
        let positions: Vec<Vec3> =
            reader.read_positions().ok_or("positions outside their buffer")?.map(Vec3::from_array).collect();
        let indices: Vec<u32> = match primitive.indices() {
            Some(_) => reader.read_indices().ok_or("indices outside their buffer")?.into_u32().collect(),
            None => (0..positions.len() as u32).collect(),
        };
        let normals: Option<Vec<Vec3>> = reader.read_normals().map(|normals| normals.map(Vec3::from_array).collect());
        let set = primitive.material().pbr_metallic_roughness().base_color_texture().map_or(0, |info| info.tex_coord());
        check_accessor(primitive.get(&gltf::Semantic::TexCoords(set)), COORDINATES, buffers)?;
        let uvs: Option<Vec<Vec2>> =
            reader.read_tex_coords(set).map(|uvs| uvs.into_f32().map(Vec2::from_array).collect());

        // A mesh may stand at many nodes.
        if self.raw.positions.len() + positions.len() > MAX_VERTICES
            || self.raw.triangles.len() + indices.len() > 3 * MAX_VERTICES
        {
            return Err(format!("more than {MAX_VERTICES} vertices, or triangles between them"));
        }
        let base = self.raw.positions.len() as u32;
        let linear = Mat3::from_mat4(transform);
        let mirrored = linear.determinant() < 0.0;
        let normal_matrix = if linear.determinant().abs() > 1e-12 { linear.inverse().transpose() } else { linear };
        let default_material = self.raw.materials.len() - 1;
        let textured = uvs.is_some();
        let material = primitive.material().index().filter(|_| textured).unwrap_or(default_material) as u16;
        self.missing_normals |= normals.is_none();
        for mut triangle in triangles(primitive.mode(), &indices) {
            if mirrored {
                triangle.swap(1, 2);
            }
            let normal =
                |i: u32| normals.as_ref().and_then(|n| n.get(i as usize)).map_or(Vec3::ZERO, |n| normal_matrix * *n);
            self.normals.push(triangle.map(normal));
            self.uvs
                .push(triangle.map(|i| uvs.as_ref().and_then(|uvs| uvs.get(i as usize)).copied().unwrap_or_default()));
            // An index that is out of range for its own primitive must stay so for the whole mesh.
            let vertices = positions.len() as u32;
            self.raw.triangles.push(triangle.map(|i| if i < vertices { base + i } else { u32::MAX }));
            self.raw.triangle_materials.push(material);
        }
        self.raw.positions.extend(positions.into_iter().map(|p| transform.transform_point3(p)));
        Ok(())
    }

    fn finish(self) -> RawMesh {
        RawMesh { normals: (!self.missing_normals).then_some(self.normals), uvs: Some(self.uvs), ..self.raw }
    }
}

fn triangles(mode: Mode, indices: &[u32]) -> Vec<[u32; 3]> {
    match mode {
        Mode::TriangleStrip => indices
            .windows(3)
            .enumerate()
            .map(|(i, w)| if i % 2 == 0 { [w[0], w[1], w[2]] } else { [w[1], w[0], w[2]] })
            .collect(),
        Mode::TriangleFan => indices.windows(2).skip(1).map(|w| [indices[0], w[0], w[1]]).collect(),
        _ => indices.as_chunks::<3>().0.to_vec(),
    }
}
