//! Reading.

use glam::{DMat3, DMat4, DQuat, DVec3, Vec3};

use super::accessor::{Allowed, Column};
use super::json::{Document, Node, Primitive, Splatting};
use super::{
    BIN, CHUNK_HEADER, COLOR_SPACE, EXTENSION, GlbError, HEADER, JSON, KERNEL, MAGIC, OPACITY, POSITION, PROJECTION,
    ROTATION, SCALE, SH_PREFIX, VERSION, rest_attributes, sh_attribute,
};
use crate::formats::frames::{Turn, WORLD_FROM_Y_UP};
use crate::formats::{FLAT_LOG_SCALE, degree_of_rest, logit};
use crate::model::{Gaussian, Gaussians, SH_REST_MAX, sh_rest_coefficients};

/// Extensions without which a file may not be read, and that are known here.
const KNOWN: [&str; 2] = [EXTENSION, "KHR_mesh_quantization"];
/// As many as a .glb of 4 GiB can hold: no file makes more of itself by placing a mesh again and again.
const GAUSSIANS_MAX: u64 = 1 << 26;
/// By how much the columns of a node's matrix may differ from evenly scaled orthogonal ones.
const SHEAR_MAX: f64 = 1e-4;

/// Reads a model from the bytes of a `.glb`: all splats of its scene.
///
/// # Errors
/// Where the bytes are no whole `.glb`, its document or accessors are not consistent, it asks for something that is not
/// supported, or holds values that no model may hold.
pub fn read(bytes: &[u8]) -> Result<Gaussians, GlbError> {
    let (text, binary) = chunks(bytes)?;
    let document: Document =
        serde_json::from_slice(text).map_err(|error| GlbError::Json { reason: error.to_string() })?;
    check_asset(&document)?;
    let mut fields = Vec::new();
    for (mesh, transform) in placed_meshes(&document)? {
        for (i, primitive) in document.meshes[mesh].primitives.iter().enumerate() {
            if let Some(splatting) = &primitive.extensions.splatting {
                let name = format!("meshes[{mesh}].primitives[{i}]");
                fields.push(Field::new(&document, binary, name, (primitive, splatting), transform)?);
            }
        }
    }
    let degree = fields.iter().map(|field| field.degree).max().ok_or(GlbError::NoSplats)?;
    let count = fields.iter().fold(0_u64, |sum, field| sum.saturating_add(field.means.count as u64));
    if count > GAUSSIANS_MAX {
        let expected = format!("{GAUSSIANS_MAX} at most: place each mesh once");
        return Err(document_error("the number of Gaussians in the scene", count.to_string(), expected));
    }
    let mut model = Gaussians::with_sh_degree(degree);
    for field in &fields {
        field.append(&mut model)?;
    }
    Ok(model)
}

/// The JSON and the binary chunk, which may be missing.
fn chunks(bytes: &[u8]) -> Result<(&[u8], &[u8]), GlbError> {
    if !bytes.starts_with(&MAGIC) {
        return Err(GlbError::Magic { found: bytes[..bytes.len().min(4)].to_vec() });
    }
    let found = bytes.len() as u64;
    let whole = |expected| GlbError::Length { what: "the file".to_owned(), expected, found };
    let (Some(version), Some(length)) = (u32_at(bytes, 4), u32_at(bytes, 8)) else {
        return Err(whole(HEADER as u64));
    };
    if version != VERSION {
        return Err(GlbError::Version { found: version });
    }
    if u64::from(length) != found {
        return Err(whole(u64::from(length)));
    }
    let (json, rest) = chunk(&bytes[HEADER..], JSON, "the JSON chunk")?;
    let (binary, _unknown) = if rest.is_empty() { (rest, rest) } else { chunk(rest, BIN, "the binary chunk")? };
    Ok((json, binary))
}

/// The content of a chunk, and what follows it.
fn chunk<'a>(bytes: &'a [u8], kind: [u8; 4], what: &str) -> Result<(&'a [u8], &'a [u8]), GlbError> {
    let length_error = |expected| GlbError::Length { what: what.to_owned(), expected, found: bytes.len() as u64 };
    let (Some(length), Some(found)) = (u32_at(bytes, 0), bytes.get(4..CHUNK_HEADER)) else {
        return Err(length_error(CHUNK_HEADER as u64));
    };
    if found != kind {
        let (found, expected) = (format!("{found:02x?}"), format!("{kind:02x?}"));
        return Err(GlbError::Document { field: format!("the type of {what}"), found, expected });
    }
    let end = CHUNK_HEADER as u64 + u64::from(length);
    let content = usize::try_from(end).ok().and_then(|end| bytes.get(CHUNK_HEADER..end));
    let content = content.ok_or_else(|| length_error(end))?;
    Ok((content, &bytes[CHUNK_HEADER + content.len()..]))
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(*bytes.get(at..)?.first_chunk()?))
}

fn document_error(field: impl Into<String>, found: impl Into<String>, expected: impl Into<String>) -> GlbError {
    GlbError::Document { field: field.into(), found: found.into(), expected: expected.into() }
}

fn check_asset(document: &Document) -> Result<(), GlbError> {
    let version = document.asset.min_version.as_ref().unwrap_or(&document.asset.version);
    if version != "2.0" && !(document.asset.min_version.is_none() && version.starts_with("2.")) {
        return Err(document_error("asset.version", format!("{version:?}"), "\"2.0\""));
    }
    match document.extensions_required.iter().find(|name| !KNOWN.contains(&name.as_str())) {
        Some(name) => {
            let expected = "extensions that are read here: export without it (splats not compressed)";
            Err(document_error("extensionsRequired", format!("{name:?}"), expected))
        }
        None => Ok(()),
    }
}

/// Meshes of the scene, each with its transform to the scene; without scenes, of all nodes that are nobody's child.
fn placed_meshes(document: &Document) -> Result<Vec<(usize, DMat4)>, GlbError> {
    let nodes = &document.nodes;
    let roots: Vec<usize> = match document.scenes.get(document.scene.unwrap_or(0)) {
        Some(scene) => scene.nodes.clone(),
        None if document.scene.is_some() => return Err(document_error("scene", "missing", "one of the scenes")),
        None => {
            let mut is_child = vec![false; nodes.len()];
            for &child in nodes.iter().flat_map(|node| &node.children) {
                if let Some(is_child) = is_child.get_mut(child) {
                    *is_child = true;
                }
            }
            (0..nodes.len()).filter(|&node| !is_child[node]).collect()
        }
    };
    let mut placed = Vec::new();
    let mut seen = vec![false; nodes.len()];
    // Depth first, in the order of the document.
    let mut open: Vec<(usize, DMat4)> = roots.into_iter().rev().map(|root| (root, DMat4::IDENTITY)).collect();
    while let Some((index, parent)) = open.pop() {
        let Some(node) = nodes.get(index) else {
            return Err(document_error(format!("nodes[{index}]"), "missing", format!("one of {}", nodes.len())));
        };
        if std::mem::replace(&mut seen[index], true) {
            return Err(document_error(format!("nodes[{index}]"), "placed twice", "a tree of nodes"));
        }
        let transform = parent * local_transform(node);
        if let Some(mesh) = node.mesh {
            if mesh >= document.meshes.len() {
                let expected = format!("one of {} meshes", document.meshes.len());
                return Err(document_error(format!("nodes[{index}].mesh"), mesh.to_string(), expected));
            }
            placed.push((mesh, transform));
        }
        open.extend(node.children.iter().rev().map(|&child| (child, transform)));
    }
    Ok(placed)
}

fn local_transform(node: &Node) -> DMat4 {
    if let Some(matrix) = node.matrix {
        return DMat4::from_cols_array(&matrix);
    }
    DMat4::from_scale_rotation_translation(
        node.scale.map_or(DVec3::ONE, DVec3::from_array),
        node.rotation.map_or(DQuat::IDENTITY, DQuat::from_array),
        node.translation.map_or(DVec3::ZERO, DVec3::from_array),
    )
}

/// The splats of one primitive in its place.
struct Field<'a> {
    name: String,
    degree: u8,
    means: Column<'a>,
    rotations: Column<'a>,
    scales: Column<'a>,
    opacities: Column<'a>,
    degree_0: Column<'a>,
    bands: Vec<Column<'a>>,
    /// To the world frame: a uniform scale, then a rotation, then a translation.
    scale: f64,
    rotation: DMat3,
    translation: DVec3,
}

impl<'a> Field<'a> {
    fn new(
        document: &Document,
        binary: &'a [u8],
        name: String,
        (primitive, splatting): (&Primitive, &Splatting),
        transform: DMat4,
    ) -> Result<Self, GlbError> {
        check_supported(&name, primitive, splatting)?;
        let find = |attribute: &str, allowed: Allowed| {
            let Some(&accessor) = primitive.attributes.get(attribute) else {
                return Err(document_error(format!("{name}.attributes.{attribute}"), "missing", "an accessor"));
            };
            let column = Column::new(document, binary, accessor, allowed)?;
            Ok((column, format!("accessors[{accessor}].count")))
        };
        let (means, _) = find(POSITION, Allowed::Position)?;
        let others = |attribute: &str, allowed: Allowed| {
            let (column, field) = find(attribute, allowed)?;
            if column.count != means.count {
                return Err(document_error(field, column.count.to_string(), format!("{}, as POSITION", means.count)));
            }
            Ok(column)
        };
        let degree = degree_of(&name, primitive)?;
        let bands = rest_attributes(degree).into_iter().map(|name| others(&name, Allowed::Harmonics));
        let (scale, rotation) = decompose(&name, transform)?;
        Ok(Self {
            degree,
            means,
            rotations: others(ROTATION, Allowed::Rotation)?,
            scales: others(SCALE, Allowed::Scale)?,
            opacities: others(OPACITY, Allowed::Opacity)?,
            degree_0: others(&sh_attribute(0, 0), Allowed::Harmonics)?,
            bands: bands.collect::<Result<_, _>>()?,
            scale,
            rotation: WORLD_FROM_Y_UP * rotation,
            translation: WORLD_FROM_Y_UP * transform.w_axis.truncate(),
            name,
        })
    }

    fn append(&self, model: &mut Gaussians) -> Result<(), GlbError> {
        let Self { scale, translation, .. } = self;
        let turn = Turn::new(self.rotation);
        for index in 0..self.means.count {
            let wrong = |attribute: &str, value: String, expected| GlbError::Value {
                index,
                primitive: self.name.clone(),
                attribute: attribute.to_owned(),
                value,
                expected,
            };
            let mean =
                (turn.matrix() * (*scale * DVec3::from_array(self.means.element(index))) + *translation).as_vec3();
            if !mean.is_finite() {
                return Err(wrong(POSITION, mean.to_string(), "finite numbers"));
            }
            let scales: [f64; 3] = self.scales.element(index);
            if let Some(bad) = scales.into_iter().find(|s| !(s.is_finite() && *s >= 0.0)) {
                return Err(wrong(SCALE, bad.to_string(), "0 or a positive finite number"));
            }
            let rotation = DQuat::from_array(self.rotations.element(index));
            if !(rotation.is_finite() && rotation.length_squared() > 0.0) {
                return Err(wrong(ROTATION, rotation.to_string(), "a finite quaternion other than 0"));
            }
            let [opacity] = self.opacities.element(index);
            if !(0.0..=1.0).contains(&opacity) {
                return Err(wrong(OPACITY, opacity.to_string(), "0 to 1"));
            }
            let coefficients = |column: &Column<'_>| column.element::<3>(index).map(|c| c as f32);
            let mut rest = [[0.0; 3]; SH_REST_MAX];
            for (to, column) in rest.iter_mut().zip(&self.bands) {
                *to = coefficients(column);
            }
            let sh = coefficients(&self.degree_0);
            let mut names = std::iter::once(sh_attribute(0, 0)).chain(rest_attributes(self.degree));
            let used = std::iter::once(&sh).chain(&rest[..self.bands.len()]);
            if let Some((name, bad)) = names.by_ref().zip(used).find(|(_, c)| !c.iter().all(|c| c.is_finite())) {
                return Err(wrong(&name, format!("{bad:?}"), "finite numbers"));
            }
            model.push(&Gaussian {
                mean,
                log_scales: DVec3::from_array(scales.map(|s| (scale * s).ln()))
                    .as_vec3()
                    .max(Vec3::splat(FLAT_LOG_SCALE)),
                rotation: turn.rotation(rotation.normalize().as_quat()),
                opacity_logit: logit(opacity),
                sh,
                id: model.len() as u64,
                birth_round: 0,
            });
            if self.degree > 0 {
                model.set_sh_rest(model.len() - 1, &turn.bands(&rest));
            }
        }
        Ok(())
    }
}

/// Refuses what would be drawn otherwise than the model is.
fn check_supported(name: &str, primitive: &Primitive, splatting: &Splatting) -> Result<(), GlbError> {
    let at = |field: &str| format!("{name}.extensions.{EXTENSION}.{field}");
    // 4 (triangles) is glTF's default.
    if primitive.mode.unwrap_or(4) != 0 {
        let found = primitive.mode.unwrap_or(4).to_string();
        return Err(document_error(format!("{name}.mode"), found, "0 (points)"));
    }
    if let Some(extension) = splatting.extensions.keys().next() {
        return Err(document_error(at("extensions"), format!("{extension:?}"), "none: export splats not compressed"));
    }
    let projection = splatting.projection.as_deref().unwrap_or(PROJECTION);
    for (field, found, expected) in [
        ("kernel", splatting.kernel.as_str(), KERNEL),
        ("colorSpace", splatting.color_space.as_str(), COLOR_SPACE),
        ("projection", projection, PROJECTION),
    ] {
        if found != expected {
            return Err(document_error(at(field), format!("{found:?}"), format!("{expected:?}")));
        }
    }
    Ok(())
}

/// The degree that a primitive's attributes make up; with parts of a degree its first missing attribute is asked for.
fn degree_of(name: &str, primitive: &Primitive) -> Result<u8, GlbError> {
    let mut highest = 0;
    for attribute in primitive.attributes.keys().filter_map(|attribute| attribute.strip_prefix(SH_PREFIX)) {
        let degree = attribute.split('_').next().and_then(|l| l.parse::<u8>().ok());
        match degree {
            Some(l @ 0..=3) => highest = highest.max(l),
            _ => {
                let found = format!("{SH_PREFIX}{attribute}");
                return Err(document_error(format!("{name}.attributes"), found, "SH degrees 0 to 3"));
            }
        }
    }
    debug_assert!(degree_of_rest(sh_rest_coefficients(highest)) == Some(highest));
    Ok(highest)
}

/// Uniform scale and rotation of a transform.
fn decompose(name: &str, transform: DMat4) -> Result<(f64, DMat3), GlbError> {
    let matrix = DMat3::from_mat4(transform);
    let scale = matrix.determinant().cbrt();
    let refused = |found: String| {
        let expected = "finite turns, moves and even scales: apply the nodes' transforms to the splats";
        Err(document_error(format!("the node transform of {name}"), found, expected))
    };
    if !(transform.is_finite() && scale.is_finite() && scale > 0.0) {
        return refused(format!("of determinant {}", matrix.determinant()));
    }
    let rotation = matrix * (1.0 / scale);
    let identity = rotation.transpose() * rotation;
    if !identity.abs_diff_eq(DMat3::IDENTITY, SHEAR_MAX) {
        return refused("uneven".to_owned());
    }
    // The nearest rotation, and the matrix itself where it is exact.
    if identity == DMat3::IDENTITY {
        return Ok((scale, rotation));
    }
    Ok((scale, DMat3::from_quat(DQuat::from_mat3(&rotation).normalize())))
}
