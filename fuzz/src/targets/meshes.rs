//! Meshes of objects, as `--object` takes them; what loads is looked at from outside as the world does.

use std::hint::black_box;
use std::path::Path;

use glam::Vec3;
use world::bvh::MeshIndex;
use world::mesh::{Mesh, Placement};

fn load(name: &str, data: &[u8]) {
    // Files that a mesh refers to are not there: relative names lead nowhere.
    let Ok(mesh) = Mesh::from_bytes(&Path::new("/nonexistent").join(name), data, &Placement::default()) else { return };
    let (low, high) = mesh.bounds();
    assert!(low.is_finite() && high.is_finite(), "bounds {low} to {high}");
    assert!(mesh.triangles.len() == mesh.normals.len() && mesh.triangles.len() == mesh.uvs.len());
    assert!(mesh.colors.is_empty() || mesh.colors.len() == mesh.triangles.len());
    assert!(mesh.triangle_materials.iter().all(|&material| usize::from(material) < mesh.materials.len()));
    let index = MeshIndex::new(&mesh);
    for eye in [Vec3::new(4.0, 0.1, 1.0), Vec3::new(-1.0, 3.0, 2.0), Vec3::new(0.1, 0.2, 5.0)] {
        let target = (low + high) * 0.5;
        black_box(index.first_hit(eye, (target - eye).normalize_or(Vec3::Z)));
        black_box(index.distance_m(eye));
    }
}

/// Wavefront OBJ.
pub fn obj(data: &[u8]) {
    load("mesh.obj", data);
}

/// PLY.
pub fn ply(data: &[u8]) {
    load("mesh.ply", data);
}

/// STL.
pub fn stl(data: &[u8]) {
    load("mesh.stl", data);
}

/// glTF, text or binary.
pub fn gltf(data: &[u8]) {
    load("mesh.glb", data);
}

const CORNERS: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
const FACES: [[u8; 3]; 4] = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]];

/// A tetrahedron in every dress.
pub fn obj_seeds() -> Vec<Vec<u8>> {
    let plain: String = CORNERS.iter().map(|[x, y, z]| format!("v {x} {y} {z}\n")).collect();
    let faces = |corner: fn(u8) -> String| -> String {
        FACES.iter().map(|face| format!("f {}\n", face.map(|i| corner(i + 1)).join(" "))).collect()
    };
    let coloured: String = CORNERS.iter().map(|[x, y, z]| format!("v {x} {y} {z} 0.5 {x} {y}\n")).collect();
    [
        format!("{plain}{}", faces(|i| i.to_string())),
        format!("mtllib a.mtl\n{plain}vt 0 0\nvt 1 1\nvn 0 0 1\nusemtl m\ng a b\n{}", faces(|i| format!("{i}/1/1"))),
        format!("{plain}vt 0 0\n{}", faces(|i| format!("{i}/1"))),
        format!("o a\n{coloured}vn 0 0 1\n{}f -1 -2 -3 -4\n", faces(|i| format!("{i}//1"))),
    ]
    .map(String::into_bytes)
    .to_vec()
}

/// Text, and binary of either byte order.
pub fn ply_seeds() -> Vec<Vec<u8>> {
    let header = |format: &str, extra: &str| {
        format!(
            "ply\nformat {format} 1.0\ncomment TextureFile a.png\nelement vertex 4\nproperty float x\nproperty float y\n\
             property float z\n{extra}element face 4\nproperty list uchar int vertex_indices\nend_header\n"
        )
    };
    let mut text = header("ascii", "property uchar red\nproperty float s\nproperty float nx\n");
    CORNERS.iter().for_each(|[x, y, z]| text.push_str(&format!("{x} {y} {z} 200 0.5 1\n")));
    FACES.iter().for_each(|[a, b, c]| text.push_str(&format!("3 {a} {b} {c}\n")));
    let binary = |big: bool| {
        let mut bytes = header(if big { "binary_big_endian" } else { "binary_little_endian" }, "").into_bytes();
        for value in CORNERS.as_flattened() {
            bytes.extend(if big { value.to_be_bytes() } else { value.to_le_bytes() });
        }
        for face in FACES {
            bytes.push(3);
            face.map(i32::from).iter().for_each(|i| bytes.extend(if big { i.to_be_bytes() } else { i.to_le_bytes() }));
        }
        bytes
    };
    vec![text.into_bytes(), binary(false), binary(true)]
}

/// Text and binary.
pub fn stl_seeds() -> Vec<Vec<u8>> {
    let corners = |face: [u8; 3]| face.map(|i| CORNERS[usize::from(i)]);
    let mut text = "solid a\n".to_owned();
    let mut binary = vec![0; 80];
    binary.extend(4u32.to_le_bytes());
    for face in FACES {
        text.push_str("facet normal 0 0 1\nouter loop\n");
        corners(face).iter().for_each(|[x, y, z]| text.push_str(&format!("vertex {x} {y} {z}\n")));
        text.push_str("endloop\nendfacet\n");
        binary.extend([0; 12]);
        corners(face).as_flattened().iter().for_each(|value| binary.extend(value.to_le_bytes()));
        binary.extend([0; 2]);
    }
    text.push_str("endsolid a\n");
    vec![text.into_bytes(), binary]
}

/// A GLB with its buffer, and a glTF with a data URI, an image and a strip.
pub fn gltf_seeds() -> Vec<Vec<u8>> {
    let mut buffer: Vec<u8> = CORNERS.as_flattened().iter().flat_map(|value| value.to_le_bytes()).collect();
    buffer.extend(FACES.as_flattened());
    let json = |uri: &str, mode: u32| {
        format!(
            r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0,"scale":[1,2,1],"children":[1]}},{{"mesh":0,"translation":[0,0,3]}}],"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1,"mode":{mode},"material":0}}]}}],"materials":[{{"pbrMetallicRoughness":{{"baseColorTexture":{{"index":0}}}}}}],"textures":[{{"source":0}}],"images":[{{"bufferView":1,"mimeType":"image/png"}}],"accessors":[{{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3","min":[0,0,0],"max":[1,1,1]}},{{"bufferView":1,"componentType":5121,"count":12,"type":"SCALAR"}}],"bufferViews":[{{"buffer":0,"byteLength":48}},{{"buffer":0,"byteOffset":48,"byteLength":12}}],"buffers":[{{"byteLength":60{uri}}}]}}"#
        )
    };
    let mut text = json("", 4).into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut glb = b"glTF".to_vec();
    let total = 12 + 8 + text.len() + 8 + buffer.len();
    let word = |value: usize| u32::try_from(value).unwrap_or(0).to_le_bytes();
    glb.extend([word(2), word(total), word(text.len())].concat());
    glb.extend(b"JSON");
    glb.extend(text);
    glb.extend(word(buffer.len()));
    glb.extend(b"BIN\0");
    glb.extend(&buffer);
    // 60 zero bytes in base 64.
    let uri = format!(r#","uri":"data:application/octet-stream;base64,{}""#, "A".repeat(80));
    vec![glb, json(&uri, 5).into_bytes()]
}
