use std::path::PathBuf;

use super::*;

/// A unit cube as OBJ, each face a quad, with texture coordinates.
const CUBE_OBJ: &str = "mtllib cube.mtl\nusemtl paint\nv 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\nv 0 0 2\nv 2 0 2\nv 2 2 2\nv 0 2 2\n\
    vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n\
    f 1/1 4/2 3/3 2/4\nf 5/1 6/2 7/3 8/4\nf 1/1 2/2 6/3 5/4\nf 2/1 3/2 7/3 6/4\nf 3/1 4/2 8/3 7/4\nf 4/1 1/2 5/3 8/4\n";

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a temporary folder"))
    }

    fn write(&self, name: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
        let path = self.0.path().join(name);
        std::fs::write(&path, bytes).expect("written");
        path
    }
}

fn load(path: &Path) -> Result<Mesh, MeshError> {
    Mesh::load(path, &Placement { size_m: 1.0, ..Placement::default() })
}

fn error_of(name: &str, bytes: impl AsRef<[u8]>) -> (MeshError, String) {
    let folder = Folder::new();
    let error = load(&folder.write(name, bytes)).expect_err("must be refused");
    let text = error.to_string();
    assert!(text.contains(name), "the message names the file: {text}");
    (error, text)
}

fn assert_is_unit_cube(mesh: &Mesh) {
    let (low, high) = mesh.bounds();
    assert_eq!(mesh.triangles.len(), 12);
    assert!((low - Vec3::new(-0.5, -0.5, 0.0)).length() < 1e-6 && (high - Vec3::new(0.5, 0.5, 1.0)).length() < 1e-6);
    assert!((mesh.area_m2() - 6.0).abs() < 1e-5);
    for t in 0..12 {
        let [a, b, c] = mesh.corners(t);
        let outward = (b - a).cross(c - a).normalize_or_zero();
        assert!(outward.dot(a - Vec3::new(0.0, 0.0, 0.5)) > 0.0, "wound outwards");
        assert!(mesh.normals[t].iter().all(|n| n.distance(outward) < 1e-5), "edges of a cube stay sharp");
    }
}

#[test]
fn obj_with_its_texture() {
    let folder = Folder::new();
    let mut png = std::io::Cursor::new(Vec::new());
    image::RgbImage::from_raw(2, 2, vec![255, 0, 0, 0, 255, 0, 0, 0, 255, 255, 255, 255])
        .expect("four pixels")
        .write_to(&mut png, image::ImageFormat::Png)
        .expect("encoded");
    folder.write("paint.png", png.into_inner());
    folder.write("cube.mtl", "newmtl paint\nKd 1 1 1\nmap_Kd -s 1 1 1 paint.png\n");
    let mesh = load(&folder.write("cube.obj", CUBE_OBJ)).expect("loads");
    assert_is_unit_cube(&mesh);
    let Material::Texture(texture) = &mesh.materials[usize::from(mesh.triangle_materials[0])] else {
        panic!("textured")
    };
    // OBJ's (0, 0) is the lower left corner of the image: blue.
    let corner = mesh.uvs.iter().flatten().find(|uv| uv.x == 0.0 && uv.y == 1.0).expect("v is flipped");
    let color = texture.sample(*corner + Vec2::new(0.25, -0.25), 0.0);
    assert!(color.z > 0.99 && color.x < 0.01);
}

#[test]
fn a_missing_or_broken_texture_is_no_error() {
    let folder = Folder::new();
    let mesh = load(&folder.write("cube.obj", CUBE_OBJ)).expect("without its mtl");
    assert!(matches!(mesh.materials[usize::from(mesh.triangle_materials[0])], Material::Procedural));
    folder.write("cube.mtl", "newmtl paint\nmap_Kd gone.png\n");
    let mesh = load(&folder.write("cube.obj", CUBE_OBJ)).expect("without its texture");
    assert!(matches!(mesh.materials[usize::from(mesh.triangle_materials[0])], Material::Procedural));
    folder.write("gone.png", b"no image at all");
    let mesh = load(&folder.write("cube.obj", CUBE_OBJ)).expect("with a broken texture");
    assert!(matches!(mesh.materials[usize::from(mesh.triangle_materials[0])], Material::Procedural));
}

/// The cube's vertices and triangles.
fn cube() -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    let vertices = (0..8).map(|i| [(i & 1) as f32 * 2.0, (i >> 1 & 1) as f32 * 2.0, (i >> 2) as f32 * 2.0]).collect();
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [1, 3, 7, 5], [3, 2, 6, 7], [2, 0, 4, 6]];
    (vertices, quads.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect())
}

fn ply(encoding: &str) -> Vec<u8> {
    let (vertices, triangles) = cube();
    let mut out = format!(
        "ply\nformat {encoding} 1.0\ncomment made by a test\nelement vertex 8\nproperty float x\nproperty double y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face 12\nproperty list uchar int vertex_indices\nend_header\n"
    )
    .into_bytes();
    let big = encoding == "binary_big_endian";
    let mut put = |text: String, mut bytes: Vec<u8>| {
        if encoding == "ascii" {
            out.extend(format!("{text} ").bytes());
        } else {
            if big {
                bytes.reverse();
            }
            out.extend(bytes);
        }
    };
    for [x, y, z] in vertices {
        put(x.to_string(), x.to_le_bytes().to_vec());
        put(y.to_string(), f64::from(y).to_le_bytes().to_vec());
        put(z.to_string(), z.to_le_bytes().to_vec());
        for code in [255_u8, 0, 188] {
            put(code.to_string(), vec![code]);
        }
    }
    for corners in triangles {
        put("3".to_owned(), vec![3]);
        corners.into_iter().for_each(|i| put(i.to_string(), i.to_le_bytes().to_vec()));
    }
    out
}

#[test]
fn ply_in_its_three_encodings_with_vertex_colours() {
    let folder = Folder::new();
    for encoding in ["ascii", "binary_little_endian", "binary_big_endian"] {
        let mesh = load(&folder.write("cube.ply", ply(encoding))).expect(encoding);
        assert_is_unit_cube(&mesh);
        assert!(matches!(mesh.materials[0], Material::CornerColors));
        assert!(
            mesh.colors.iter().flatten().all(|c| c.distance(Vec3::new(1.0, 0.0, 0.5029)) < 1e-3),
            "sRGB is decoded"
        );
    }
}

fn stl() -> Vec<u8> {
    let (vertices, triangles) = cube();
    let mut out = vec![0_u8; 80];
    out.extend((triangles.len() as u32).to_le_bytes());
    for corners in triangles {
        out.extend([0_u8; 12]);
        corners.iter().flat_map(|i| vertices[*i as usize]).for_each(|v| out.extend(v.to_le_bytes()));
        out.extend([0_u8; 2]);
    }
    out
}

#[test]
fn stl_binary() {
    let folder = Folder::new();
    assert_is_unit_cube(&load(&folder.write("cube.stl", stl())).expect("loads"));
}

/// The cube as glTF, and its buffer: indices, then positions. Its z is our -y, so only a cube looks the same.
fn gltf_json(buffer_uri: &str) -> (String, Vec<u8>) {
    let (vertices, triangles) = cube();
    let mut buffer: Vec<u8> = triangles.iter().flatten().flat_map(|i| (*i as u16).to_le_bytes()).collect();
    vertices.iter().flatten().for_each(|v| buffer.extend(v.to_le_bytes()));
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],
        "nodes":[{{"children":[1],"translation":[5,0,0]}},{{"mesh":0,"scale":[3,1,1]}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":1}},"indices":0}}]}}],
        "buffers":[{{{buffer_uri}"byteLength":168}}],
        "bufferViews":[{{"buffer":0,"byteOffset":0,"byteLength":72}},{{"buffer":0,"byteOffset":72,"byteLength":96}}],
        "accessors":[{{"bufferView":0,"componentType":5123,"count":36,"type":"SCALAR"}},
        {{"bufferView":1,"componentType":5126,"count":8,"type":"VEC3","min":[0,0,0],"max":[2,2,2]}}]}}"#
    );
    (json, buffer)
}

fn glb() -> Vec<u8> {
    let (mut json, buffer) = gltf_json("");
    while json.len() % 4 != 0 {
        json.push(' ');
    }
    let chunk = |kind: &[u8; 4], bytes: &[u8]| [&(bytes.len() as u32).to_le_bytes()[..], kind, bytes].concat();
    let body = [chunk(b"JSON", json.as_bytes()), chunk(b"BIN\0", &buffer)].concat();
    [b"glTF".as_slice(), &2_u32.to_le_bytes(), &(body.len() as u32 + 12).to_le_bytes(), &body].concat()
}

#[test]
fn gltf_with_embedded_external_and_binary_buffers() {
    use base64::Engine as _;
    let folder = Folder::new();
    let (_, buffer) = gltf_json("");
    let embedded = format!(
        "\"uri\":\"data:application/octet-stream;base64,{}\",",
        base64::engine::general_purpose::STANDARD.encode(&buffer)
    );
    folder.write("the buffer.bin", &buffer);
    let files = [
        folder.write("embedded.gltf", gltf_json(&embedded).0),
        folder.write("external.gltf", gltf_json("\"uri\":\"the%20buffer.bin\",").0),
        folder.write("binary.glb", glb()),
    ];
    for file in files {
        let mesh = load(&file).expect("loads");
        assert_eq!(mesh.triangles.len(), 12);
        let (low, high) = mesh.bounds();
        let extent = high - low;
        // Three times as long in x by its node's scale, and that is the largest extent.
        assert!((extent - Vec3::new(1.0, 1.0 / 3.0, 1.0 / 3.0)).length() < 1e-5, "{}: {extent}", file.display());
    }
}

#[test]
fn y_up_files_are_stood_upright_and_face_south() {
    let folder = Folder::new();
    // A pyramid pointing along y, with one more vertex far out along z.
    let path = folder.write("up.obj", "v -1 0 -1\nv 1 0 -1\nv 0 0 3\nv 0 6 0\nf 1 2 3\nf 1 4 2\nf 2 4 3\nf 3 4 1\n");
    let mesh = Mesh::load(&path, &Placement { size_m: 6.0, yaw_deg: 0.0, up: UpAxis::Y }).expect("loads");
    let top = mesh.positions[3];
    assert!((top.z - 6.0).abs() < 1e-5, "the tip points up");
    assert!((mesh.positions[2].y + 2.0).abs() < 1e-5, "what faced +z faces south");
}

#[test]
fn an_inverted_mesh_is_turned_outward() {
    let folder = Folder::new();
    let inverted: String = CUBE_OBJ
        .lines()
        .map(|line| match line.strip_prefix("f ") {
            Some(corners) => format!("f {}\n", corners.split(' ').rev().collect::<Vec<_>>().join(" ")),
            None => format!("{line}\n"),
        })
        .collect();
    assert_is_unit_cube(&load(&folder.write("inverted.obj", inverted)).expect("loads"));
}

#[test]
fn each_fault_has_its_message() {
    let missing = load(Path::new("/nowhere/at/all.obj")).expect_err("no such file");
    assert!(matches!(missing, MeshError::Unreadable { .. }) && missing.to_string().contains("/nowhere/at/all.obj"));

    assert!(matches!(error_of("empty.obj", "").0, MeshError::Empty { .. }));
    let (error, text) = error_of("house.blend", "BLENDER");
    assert!(matches!(error, MeshError::UnknownFormat { .. }) && text.contains("blend") && text.contains(".ply"));

    let (error, text) = error_of("points.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n");
    assert!(matches!(error, MeshError::NoTriangles { .. }), "{text}");
    let (error, text) = error_of("line.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n");
    assert!(matches!(error, MeshError::NoTriangles { vertices: 3, .. }), "{text}");

    let (error, text) = error_of("nan.obj", "v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n");
    assert!(matches!(error, MeshError::NonFinite { vertex: 2, .. }) && text.contains("NaN"), "{text}");
    let (error, text) = error_of("inf.obj", "v 0 0 0\nv inf 0 0\nv 0 1 0\nf 1 2 3\n");
    assert!(matches!(error, MeshError::NonFinite { vertex: 1, .. }) && text.contains("inf"), "{text}");

    let (error, text) = error_of("range.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n");
    assert!(matches!(error, MeshError::Malformed { .. }) && text.contains("indices"), "{text}");
    let range = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n";
    let (error, text) = error_of("range.ply", range);
    assert!(matches!(error, MeshError::IndexOutOfRange { index: 7, vertices: 3, .. }), "{text}");
    let (error, _) = error_of("negative.ply", range.replace("3 0 1 7", "3 0 1 -1"));
    assert!(matches!(error, MeshError::IndexOutOfRange { .. }));

    for (name, bytes) in [
        ("words.obj", "v one two three\n".as_bytes().to_vec()),
        ("header.ply", b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n".to_vec()),
        ("cut.ply", ply("binary_little_endian")[..300].to_vec()),
        ("cut.stl", stl()[..200].to_vec()),
        ("short.stl", b"stl".to_vec()),
        ("cut.glb", glb()[..200].to_vec()),
        ("json.gltf", b"{ \"asset\": ".to_vec()),
        ("buffer.gltf", gltf_json("\"uri\":\"data:;base64,AAAA\",").0.into_bytes()),
    ] {
        let (error, text) = error_of(name, bytes);
        assert!(matches!(error, MeshError::Malformed { .. }) && text.contains("expected"), "{text}");
    }
    let (error, text) = {
        let folder = Folder::new();
        let error = load(&folder.write("lost.gltf", gltf_json("\"uri\":\"lost.bin\",").0)).expect_err("no buffer");
        let text = error.to_string();
        (error, text)
    };
    assert!(matches!(error, MeshError::Unreadable { .. }) && text.contains("lost.bin"), "{text}");
}

#[test]
fn an_impossible_size_or_yaw_is_refused() {
    let folder = Folder::new();
    let path = folder.write("cube.obj", CUBE_OBJ);
    for placement in [
        Placement { size_m: 0.0, ..Placement::default() },
        Placement { size_m: f64::NAN, ..Placement::default() },
        Placement { yaw_deg: f64::INFINITY, ..Placement::default() },
    ] {
        assert!(matches!(Mesh::load(&path, &placement), Err(MeshError::BadPlacement { .. })));
    }
}

proptest::proptest! {
    #[test]
    fn a_placed_object_has_its_size_stands_on_the_ground_and_is_centred(size_m in 0.1..5.0_f64, yaw_deg in -400.0..400.0_f64, shift in -1e4..1e4_f32) {
        let (vertices, triangles) = cube();
        let raw = RawMesh {
            positions: vertices.iter().map(|v| Vec3::new(v[0] * 2.0, v[1], v[2]) * 30.0 + Vec3::new(shift, -shift, 0.5 * shift)).collect(),
            triangle_materials: vec![0; triangles.len()],
            triangles,
            materials: vec![Material::Procedural],
            ..RawMesh::default()
        };
        let mesh = Mesh::from_raw(Path::new("cube"), raw, UpAxis::Z, &Placement { size_m, yaw_deg, up: UpAxis::Auto }).expect("valid");
        let (low, high) = mesh.bounds();
        proptest::prop_assert!(low.z.abs() < 1e-4 && (low + high).truncate().length() < 1e-3);
        // Length and width survive the yaw: 1 : 0.5 : 0.5 of the size.
        let area = mesh.area_m2() / (size_m * size_m);
        proptest::prop_assert!((area - 2.5).abs() < 0.02, "{area}");
    }

    #[test]
    fn damaged_files_never_panic(cut in 0_usize..600, at in 0_usize..600, byte in 0_u8..=255) {
        let folder = Folder::new();
        for (name, bytes) in [("a.ply", ply("binary_little_endian")), ("b.stl", stl()), ("c.glb", glb()), ("d.obj", CUBE_OBJ.as_bytes().to_vec()), ("e.ply", ply("ascii"))] {
            let mut bytes = bytes;
            bytes.truncate(cut.max(40));
            let place = at % bytes.len();
            bytes[place] = byte;
            match load(&folder.write(name, bytes)) {
                Ok(mesh) => proptest::prop_assert!(mesh.positions.iter().all(|p| p.is_finite())),
                Err(error) => proptest::prop_assert!(!error.to_string().is_empty()),
            }
        }
    }
}

#[test]
fn files_that_would_take_all_memory_or_time_are_refused() {
    // Sixty levels of nodes with two ways to each: 2^60 parts in a few kilobytes.
    let nodes: Vec<String> = (1..60).map(|next| format!(r#"{{"children":[{next},{next}]}}"#)).collect();
    let bomb = format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],"nodes":[{},{{}}]}}"#,
        nodes.join(",")
    );
    let (_, text) = error_of("bomb.gltf", bomb);
    assert!(text.contains("two parents"), "{text}");

    let (_, text) = error_of("rows.ply", "ply\nformat ascii 1.0\nelement vertex 18446744073709551615\nend_header\n");
    assert!(text.contains("without a property"), "{text}");

    let (_, text) = error_of("huge.obj", "v 0 0 0\nv 3e38 0 0\nv 0 3e38 0\nf 1 2 3\n");
    assert!(text.contains("units across") || text.contains("no triangle"), "{text}");

    let lost = r#"{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0}],"meshes":[{"primitives":[{"attributes":{"POSITION":5}}]}]}"#;
    let (_, text) = error_of("lost.gltf", lost);
    assert!(text.contains("accessor 5 of 0"), "{text}");
}

#[test]
fn a_mesh_that_names_a_device_reads_nothing_of_it() {
    let folder = Folder::new();
    let with_device = CUBE_OBJ.replace("mtllib cube.mtl", "mtllib /dev/zero");
    assert_is_unit_cube(&load(&folder.write("device.obj", with_device)).expect("loads without its material"));
    folder.write("cube.mtl", "newmtl paint\nmap_Kd /dev/zero\n");
    assert_is_unit_cube(&load(&folder.write("texture.obj", CUBE_OBJ)).expect("loads without its texture"));
}
