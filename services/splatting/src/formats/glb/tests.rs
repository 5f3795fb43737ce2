use glam::{DQuat, Quat, Vec3};
use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;
use crate::formats::Format;
use crate::formats::tests::{angle_between, bare, bytes, model};
use crate::model::{Gaussian, Gaussians, SH_REST_MAX};

/// JSON and binary chunk.
fn taken_apart(file: &[u8]) -> (Value, Vec<u8>) {
    let length = u32::from_le_bytes(file[12..16].try_into().unwrap()) as usize;
    (serde_json::from_slice(&file[20..20 + length]).unwrap(), file[20 + length + 8..].to_vec())
}

fn put_together(json: &Value, binary: &[u8]) -> Vec<u8> {
    let mut text = json.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let length = 12 + 8 + text.len() + 8 + binary.len();
    let word = |value: usize| (value as u32).to_le_bytes().to_vec();
    [
        b"glTF".to_vec(),
        word(2),
        word(length),
        word(text.len()),
        b"JSON".to_vec(),
        text,
        word(binary.len()),
        b"BIN\0".to_vec(),
        binary.to_vec(),
    ]
    .concat()
}

/// The file after a change of its document.
fn changed(file: &[u8], change: impl FnOnce(&mut Value)) -> Vec<u8> {
    let (mut json, binary) = taken_apart(file);
    change(&mut json);
    put_together(&json, &binary)
}

/// Why the file is refused after a change of its document.
fn refusal(file: &[u8], change: impl FnOnce(&mut Value)) -> String {
    read(&changed(file, change)).unwrap_err().to_string()
}

fn assert_near(a: &Gaussians, b: &Gaussians, tolerance: f32) {
    assert_eq!((a.len(), a.sh_degree()), (b.len(), b.sh_degree()));
    for i in 0..a.len() {
        let (g, h) = (a.get(i), b.get(i));
        assert!((g.mean - h.mean).length() <= tolerance, "{} {}", g.mean, h.mean);
        assert!((g.log_scales - h.log_scales).abs().max_element() <= tolerance);
        assert!(angle_between(g.rotation, h.rotation) <= f64::from(tolerance).max(1e-3));
        assert!((g.opacity() - h.opacity()).abs() <= tolerance);
        assert!(g.sh.iter().zip(h.sh).all(|(a, b)| (a - b).abs() <= tolerance));
        let bands = a.sh_rest(i).into_iter().zip(b.sh_rest(i));
        assert!(bands.into_iter().all(|(a, b)| (0..3).all(|c| (a[c] - b[c]).abs() <= tolerance)));
    }
}

proptest! {
    #[test]
    fn a_model_comes_back(count in 1_usize..40, degree in 0_u8..4, seed: u64) {
        let model = model(count, degree, seed);
        let file = bytes(Format::Glb, &model);
        let back = read(&file).unwrap();
        assert_near(&back, &model, 2e-6);
        for (a, b) in back.iter().zip(model.iter()) {
            prop_assert_eq!((a.mean, a.sh), (b.mean, b.sh));
        }
        prop_assert!(file.len() < 8192 + count * (64 + 12 * SH_REST_MAX));
    }

    #[test]
    fn damaged_bytes_are_read_or_refused(at in 0_usize..2000, value: u8, seed in 0_u64..8) {
        let mut file = bytes(Format::Glb, &model(2, 1, seed));
        let at = at % file.len();
        file[at] = value;
        if let Ok(model) = read(&file) {
            prop_assert!(model.is_finite());
        }
    }
}

#[test]
fn another_reader_finds_the_accessors_and_their_values() {
    let model = model(7, 3, 3);
    let file = bytes(Format::Glb, &model);
    // The crate knows only glTF's own names of attributes, and those that begin with "_".
    let plain = changed(&file, |json| {
        let attributes = json["meshes"][0]["primitives"][0]["attributes"].as_object_mut().unwrap();
        attributes.retain(|name, _| !name.contains(':'));
    });
    let checked = gltf::Gltf::from_slice(&plain).expect("valid");
    let primitive = checked.meshes().next().unwrap().primitives().next().unwrap();
    assert_eq!(primitive.mode(), gltf::mesh::Mode::Points);
    let bounds = primitive.bounding_box();
    let reader = primitive.reader(|_| checked.blob.as_deref());
    let positions: Vec<[f32; 3]> = reader.read_positions().unwrap().collect();
    let colors: Vec<[f32; 4]> = reader.read_colors(0).unwrap().into_rgba_f32().collect();
    for (k, g) in model.iter().enumerate() {
        let [x, y, z] = positions[k];
        assert_eq!([x, -z, y], g.mean.to_array());
        assert!((0..3).all(|axis| (bounds.min[axis]..=bounds.max[axis]).contains(&positions[k][axis])));
        assert!((colors[k][3] - g.opacity()).abs() < 1e-4);
        for (linear, srgb) in colors[k].into_iter().zip(g.color()) {
            let encoded = if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
            assert!((encoded - srgb.clamp(0.0, 1.0)).abs() < 1e-3, "{encoded} {srgb}");
        }
    }
    for axis in 0..3 {
        assert!(
            positions.iter().any(|p| p[axis] == bounds.min[axis])
                && positions.iter().any(|p| p[axis] == bounds.max[axis])
        );
    }
    let attributes = taken_apart(&file).0["meshes"][0]["primitives"][0]["attributes"].clone();
    let floats = |name: &str, width: usize| -> Vec<Vec<f32>> {
        let accessor = checked.accessors().nth(attributes[name].as_u64().unwrap() as usize).unwrap();
        let view = accessor.view().unwrap();
        let from = view.offset() + accessor.offset();
        assert!(from.is_multiple_of(4) && accessor.count() == 7 && accessor.size() == 4 * width, "{name}");
        let data = &checked.blob.as_ref().unwrap()[from..from + view.length()];
        let values: Vec<f32> = data.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        values.chunks(width).map(<[f32]>::to_vec).collect()
    };
    let (rotations, scales) = (floats(ROTATION, 4), floats(SCALE, 3));
    let opacities = floats(OPACITY, 1);
    for (k, g) in model.iter().enumerate() {
        let written = Quat::from_slice(&rotations[k]);
        assert!((written.length() - 1.0).abs() < 1e-6);
        assert!(angle_between(written, Quat::from_rotation_x(-std::f32::consts::FRAC_PI_2) * g.rotation) < 1e-3);
        assert!((0..3).all(|axis| (scales[k][axis].ln() - g.log_scales[axis]).abs() < 1e-5));
        assert!((opacities[k][0] - g.opacity()).abs() < 1e-6);
    }
    // Colours by the extension's formula of degree 1, in the file's frame, against the model's.
    let (base, bands) = (floats(&sh_attribute(0, 0), 3), [0, 1, 2].map(|n| floats(&sh_attribute(1, n), 3)));
    let mut flat = model.clone();
    flat.set_sh_degree(1);
    for (k, position) in positions.iter().enumerate() {
        let eye = Vec3::new(0.3, -2.0, 1.0);
        let d = (Vec3::from_array(*position) - Vec3::new(eye.x, eye.z, -eye.y)).try_normalize().unwrap();
        let expected = flat.color_from(k, eye);
        for c in 0..3 {
            let color = 0.5
                + 0.282_094_8 * base[k][c]
                + 0.488_602_5 * (-d.y * bands[0][k][c] + d.z * bands[1][k][c] - d.x * bands[2][k][c]);
            assert!((color - expected[c]).abs() < 1e-5, "{color} {}", expected[c]);
        }
    }
}

#[test]
fn the_extension_says_how_the_splats_are_drawn() {
    let (json, binary) = taken_apart(&bytes(Format::Glb, &model(2, 2, 1)));
    let primitive = &json["meshes"][0]["primitives"][0];
    assert_eq!(json["extensionsUsed"], json!(["KHR_gaussian_splatting"]));
    assert_eq!(primitive["mode"], 0);
    let extension = &primitive["extensions"]["KHR_gaussian_splatting"];
    assert_eq!(extension["kernel"], "ellipse");
    assert_eq!(extension["colorSpace"], "srgb_rec709_display");
    let mut names: Vec<&str> = primitive["attributes"].as_object().unwrap().keys().map(String::as_str).collect();
    names.retain(|name| name.contains("SH_DEGREE"));
    assert_eq!(names.len(), 1 + 3 + 5);
    assert!(names.contains(&"KHR_gaussian_splatting:SH_DEGREE_2_COEF_4"));
    assert_eq!(json["buffers"][0]["byteLength"], binary.len());
    assert_eq!(binary.len(), 2 * (64 + 8 * 12));
    assert_eq!(bytes(Format::Glb, &bare(1)).len() % 4, 0);
}

#[test]
fn an_empty_model_is_refused() {
    let message = write(&Gaussians::new(), &mut Vec::new()).unwrap_err().to_string();
    assert!(message.contains("0 Gaussians") && message.contains("glTF holds 1 to"), "{message}");
}

#[test]
fn nodes_turn_move_and_scale_the_splats() {
    let original = model(6, 3, 2);
    let file = bytes(Format::Glb, &original);
    let (turn, scale, moved) = (DQuat::from_rotation_z(0.4) * DQuat::from_rotation_x(1.1), 2.5, [1.0, 2.0, -3.0]);
    let placed = changed(&file, |json| {
        json["nodes"] = json!([
            {"children": [2], "translation": moved},
            {"mesh": 0},
            {"mesh": 0, "rotation": turn.to_array(), "scale": [scale, scale, scale]}
        ]);
        json["scenes"][0]["nodes"] = json!([1, 0]);
    });
    let back = read(&placed).unwrap();
    assert_eq!(back.len(), 12);
    let to_y_up = DQuat::from_rotation_x(-std::f64::consts::FRAC_PI_2);
    let to_world = to_y_up.conjugate() * turn * to_y_up;
    let offset = Vec3::new(1.0, 3.0, 2.0);
    let eye = Vec3::new(-1.0, 2.0, 0.5);
    for i in 0..6 {
        assert!((back.get(i).mean - original.get(i).mean).length() < 1e-6, "as it was");
        let (g, h) = (back.get(6 + i), original.get(i));
        let place = |p: Vec3| (to_world * (p.as_dvec3() * scale)).as_vec3() + offset;
        assert!((g.mean - place(h.mean)).length() < 1e-5, "{} {}", g.mean, place(h.mean));
        assert!((g.log_scales - h.log_scales - Vec3::splat(2.5_f32.ln())).length() < 1e-5);
        assert!(angle_between(g.rotation, to_world.as_quat() * h.rotation) < 1e-3);
        let (a, b) = (back.color_from(6 + i, place(eye)), original.color_from(i, eye));
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5));
        assert_eq!(g.id, 6 + i as u64);
    }
    let matrix = [0.0, 0.0, -2.0, 0.0, 0.0, 2.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 5.0, 0.0, 0.0, 1.0];
    let turned = read(&changed(&file, |json| json["nodes"][0]["matrix"] = json!(matrix))).unwrap();
    let (g, h) = (turned.get(1).mean, original.get(1).mean);
    // The file's x is -z, its z is x; y stays up, which is the world's z.
    assert!((g - Vec3::new(5.0 - 2.0 * h.y, 2.0 * h.x, 2.0 * h.z)).length() < 1e-5, "{g} {h}");
    for (value, why) in [
        (json!([1.0, 2.0, 1.0]), "uneven"),
        (json!([-1.0, 1.0, 1.0]), "determinant"),
        (json!([0.0, 0.0, 0.0]), "determinant"),
    ] {
        let message = refusal(&file, |json| json["nodes"][0]["scale"] = value);
        assert!(message.contains(why), "{message}");
    }
}

#[test]
fn strides_and_integers_are_read_where_the_extension_allows_them() {
    let model = model(9, 0, 5);
    let (mut json, binary) = taken_apart(&bytes(Format::Glb, &model));
    // Opacity u8, rotation i16 and scale u16 times 2, in rows of 20 bytes with 2 bytes before them.
    let opacity = |k: usize| (255.0 * model.get(k).opacity()).round() as u8;
    let floats = |accessor: usize, k: usize, n: usize| {
        let view = &json["bufferViews"][accessor];
        let (from, length) = (view["byteOffset"].as_u64().unwrap(), view["byteLength"].as_u64().unwrap());
        let at = (from + length / 9 * k as u64) as usize + 4 * n;
        f32::from_le_bytes(binary[at..at + 4].try_into().unwrap())
    };
    let attributes = json["meshes"][0]["primitives"][0]["attributes"].clone();
    let index = |name: &str| attributes[name].as_u64().unwrap() as usize;
    let mut packed = binary.clone();
    for k in 0..9 {
        packed.extend([0xff, 0xff, opacity(k), 0]);
        (0..4).for_each(|n| packed.extend(((32767.0 * floats(index(ROTATION), k, n)).round() as i16).to_le_bytes()));
        (0..3).for_each(|n| packed.extend(((65535.0 * floats(index(SCALE), k, n)).round() as u16).to_le_bytes()));
        packed.extend([0; 2]);
    }
    json["buffers"][0]["byteLength"] = json!(packed.len());
    let views = json["bufferViews"].as_array_mut().unwrap();
    views.push(
        json!({"buffer": 0, "byteOffset": binary.len(), "byteLength": packed.len() - binary.len(), "byteStride": 20}),
    );
    let view = views.len() - 1;
    for (name, kind, offset, component) in
        [(OPACITY, "SCALAR", 2, 5121), (ROTATION, "VEC4", 4, 5122), (SCALE, "VEC3", 12, 5123)]
    {
        json["accessors"][index(name)] = json!({"bufferView": view, "byteOffset": offset, "count": 9, "type": kind,
            "componentType": component, "normalized": true});
    }
    let back = read(&put_together(&json, &packed)).unwrap();
    for (a, b) in back.iter().zip(model.iter()) {
        assert_eq!((a.mean, a.sh), (b.mean, b.sh));
        assert!((a.opacity() - b.opacity()).abs() < 0.6 / 255.0);
        assert!(angle_between(a.rotation, b.rotation) < 1e-3);
        // The smallest scale is about 0.027.
        assert!((a.log_scales - b.log_scales).abs().max_element() < 1e-3);
    }
    json["accessors"][index(SCALE)]["normalized"] = json!(false);
    let back = read(&put_together(&json, &packed)).unwrap();
    assert!(
        (back.get(0).log_scales.x - 65535.0_f32.ln() - model.get(0).log_scales.x).abs() < 1e-3,
        "metres as they are"
    );
    json["accessors"][index(ROTATION)]["normalized"] = json!(false);
    let message = read(&put_together(&json, &packed)).unwrap_err().to_string();
    assert!(message.contains("componentType of the glTF is 5122"), "{message}");
}

#[test]
fn quantised_means_need_their_extension() {
    let (mut json, mut binary) = taken_apart(&bytes(Format::Glb, &bare(2)));
    let offset = binary.len();
    for value in [100_i16, -200, 300, 0, -32767, -100, 200, -300] {
        binary.extend(value.to_le_bytes());
    }
    json["buffers"][0]["byteLength"] = json!(binary.len());
    json["bufferViews"]
        .as_array_mut()
        .unwrap()
        .push(json!({"buffer": 0, "byteOffset": offset, "byteLength": 16, "byteStride": 8}));
    json["accessors"][0] = json!({"bufferView": 6, "count": 2, "type": "VEC3", "componentType": 5122});
    assert!(read(&put_together(&json, &binary)).unwrap_err().to_string().contains("componentType"));
    json["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
    let back = read(&put_together(&json, &binary)).unwrap();
    assert_eq!(back.get(0).mean, Vec3::new(100.0, -300.0, -200.0));
    json["accessors"][0]["normalized"] = json!(true);
    let back = read(&put_together(&json, &binary)).unwrap();
    assert_eq!(back.get(1).mean.x, -1.0);
}

#[test]
fn every_truncation_is_refused() {
    let file = bytes(Format::Glb, &model(2, 1, 1));
    for length in 0..file.len() {
        assert!(read(&file[..length]).is_err(), "{length} bytes");
        // With a header that fits, the chunks are too short.
        let mut cut = file[..length].to_vec();
        if length >= 12 {
            cut[8..12].copy_from_slice(&(length as u32).to_le_bytes());
            assert!(read(&cut).is_err(), "{length} bytes");
        }
    }
    assert!(read(&[file.as_slice(), b"x"].concat()).unwrap_err().to_string().contains("something else follows"));
    let (json, binary) = taken_apart(&file);
    for length in 0..binary.len() {
        assert!(matches!(read(&put_together(&json, &binary[..length])), Err(GlbError::Length { .. })), "{length}");
    }
}

#[test]
fn documents_that_lie_are_refused() {
    let file = bytes(Format::Glb, &model(3, 1, 1));
    let huge = u64::MAX;
    for (path, value, expected) in [
        ("/accessors/0/count", json!(huge), "bufferViews[0] of the .glb"),
        ("/accessors/0/count", json!(4), "bufferViews[0] of the .glb"),
        ("/accessors/3/count", json!(2), "accessors[3].count of the glTF is 2, expected 3"),
        ("/accessors/0/bufferView", json!(99), "accessors[0].bufferView of the glTF is 99"),
        ("/accessors/0/type", json!("VEC2"), "expected \"VEC3\""),
        ("/accessors/5/componentType", json!(5121), "accessors[5].componentType"),
        ("/bufferViews/0/byteLength", json!(huge), "buffers[0]"),
        ("/bufferViews/0/byteOffset", json!(huge), "buffers[0]"),
        ("/bufferViews/0/buffer", json!(1), "bufferViews[0].buffer"),
        ("/buffers/0/byteLength", json!(huge), "the binary chunk"),
        ("/nodes/0/mesh", json!(5), "nodes[0].mesh"),
        ("/scenes/0/nodes", json!([0, 0]), "placed twice"),
        ("/scenes/0/nodes", json!([7]), "nodes[7]"),
        ("/scenes/0/nodes", json!([]), "no mesh primitive"),
        ("/scene", json!(4), "scene of the glTF is missing"),
        ("/asset/version", json!("1.0"), "asset.version"),
        ("/accessors/0/count", json!(-1), "JSON"),
        ("/meshes/0/primitives/0/mode", json!(4), "mode of the glTF is 4"),
        ("/meshes/0/primitives/0/attributes/POSITION", json!(77), "accessors[77]"),
    ] {
        let message = refusal(&file, |json| *json.pointer_mut(path).unwrap() = value.clone());
        assert!(message.contains(expected), "{path} {value}: {message}");
    }
    let message = refusal(&file, |json| json["bufferViews"][0]["byteStride"] = json!(4));
    assert!(message.contains("byteStride of the glTF is 4, expected 12 to 252"), "{message}");
    let message = refusal(&file, |json| json["accessors"][0]["byteOffset"] = json!(huge));
    assert!(message.contains("bufferViews[0]"), "{message}");
    let message = refusal(&file, |json| json["nodes"][0]["children"] = json!([0]));
    assert!(message.contains("placed twice"), "{message}");
    for name in [POSITION, ROTATION, SCALE, OPACITY, &sh_attribute(0, 0), &sh_attribute(1, 1)] {
        let message = refusal(&file, |json| {
            json["meshes"][0]["primitives"][0]["attributes"].as_object_mut().unwrap().remove(name);
        });
        assert!(message.contains(&format!("attributes.{name} of the glTF is missing")), "{message}");
    }
}

#[test]
fn a_mesh_placed_too_often_is_refused_before_memory_is_taken() {
    let file = bytes(Format::Glb, &bare(2000));
    let message = refusal(&file, |json| {
        json["nodes"] = json!(vec![json!({"mesh": 0}); 40_000]);
        json["scenes"][0]["nodes"] = json!((0..40_000).collect::<Vec<u32>>());
    });
    assert!(message.contains("is 80000000, expected 67108864 at most"), "{message}");
}

#[test]
fn what_is_not_supported_is_named() {
    let file = bytes(Format::Glb, &bare(3));
    let extension = |json: &mut Value, field: &str, value: Value| {
        json["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"][field] = value;
    };
    for (field, value) in
        [("kernel", json!("beta")), ("colorSpace", json!("lin_rec709_display")), ("projection", json!("fisheye"))]
    {
        let message = refusal(&file, |json| extension(json, field, value.clone()));
        assert!(message.contains(field) && message.contains(value.as_str().unwrap()), "{message}");
    }
    let compressed = json!({"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}});
    let message = refusal(&file, |json| extension(json, "extensions", compressed));
    assert!(message.contains("compression_spz_2"), "{message}");
    let message = refusal(&file, |json| json["extensionsRequired"] = json!(["EXT_meshopt_compression"]));
    assert!(message.contains("EXT_meshopt_compression"), "{message}");
    let message = refusal(&file, |json| json["accessors"][0]["sparse"] = json!({"count": 1}));
    assert!(message.contains("sparse"), "{message}");
    let message = refusal(&file, |json| json["buffers"][0]["uri"] = json!("a.bin"));
    assert!(message.contains("URI"), "{message}");
    let message = refusal(&file, |json| {
        json["meshes"][0]["primitives"][0]["attributes"][sh_attribute(4, 0)] = json!(0);
    });
    assert!(message.contains("SH_DEGREE_4_COEF_0"), "{message}");
    let message = refusal(&file, |json| {
        json["meshes"][0]["primitives"][0]["extensions"].as_object_mut().unwrap().clear();
    });
    assert!(message.contains("no mesh primitive"), "{message}");
    assert!(read(b"ply\nformat").unwrap_err().to_string().contains("begins with"));
    let mut one = file.clone();
    one[4] = 1;
    assert_eq!(read(&one), Err(GlbError::Version { found: 1 }));
}

#[test]
fn values_that_no_model_may_hold_are_named() {
    let file = bytes(Format::Glb, &model(4, 1, 1));
    let (json, binary) = taken_apart(&file);
    let attributes = json["meshes"][0]["primitives"][0]["attributes"].clone();
    let coefficient = sh_attribute(1, 2);
    for (name, value) in [
        (POSITION, f32::NAN),
        (ROTATION, f32::INFINITY),
        (SCALE, f32::NAN),
        (SCALE, -1.0),
        (OPACITY, 1.5),
        (OPACITY, f32::NAN),
        (coefficient.as_str(), f32::NEG_INFINITY),
    ] {
        let accessor = attributes[name].as_u64().unwrap() as usize;
        let view = &json["bufferViews"][accessor];
        let (from, length) =
            (view["byteOffset"].as_u64().unwrap() as usize, view["byteLength"].as_u64().unwrap() as usize);
        let mut broken = binary.clone();
        let at = from + length / 4 * 2;
        broken[at..at + 4].copy_from_slice(&value.to_le_bytes());
        let message = read(&put_together(&json, &broken)).unwrap_err().to_string();
        assert!(message.contains("Gaussian 2") && message.contains(name), "{message}");
    }
    let accessor = attributes[SCALE].as_u64().unwrap() as usize;
    let from = json["bufferViews"][accessor]["byteOffset"].as_u64().unwrap() as usize;
    let mut flat = binary.clone();
    flat[from..from + 4].fill(0);
    let back = read(&put_together(&json, &flat)).unwrap();
    assert_eq!(back.get(0).log_scales.x, -20.0);
    let solid = Gaussian { opacity_logit: 40.0, ..model(1, 0, 1).get(0) };
    let back = read(&bytes(Format::Glb, &[solid].into_iter().collect())).unwrap();
    assert_eq!(back.get(0).opacity_logit, 16.0);
}
