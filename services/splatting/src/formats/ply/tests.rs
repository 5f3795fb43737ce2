use proptest::prelude::*;

use super::*;
use crate::formats::tests::{bare, model};

fn bytes(model: &Gaussians) -> Vec<u8> {
    let mut bytes = Vec::new();
    write(model, &mut bytes).unwrap();
    bytes
}

/// Header, and where the data begins.
fn split(file: &[u8]) -> (String, usize) {
    let end = file.windows(11).position(|w| w == b"end_header\n").unwrap();
    (String::from_utf8(file[..end].to_vec()).unwrap(), end + 11)
}

/// The same file with one piece of its header replaced.
fn with_header(from: &str, to: &str) -> Vec<u8> {
    let original = bytes(&model(5, 1, 1));
    let at = original.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
    [&original[..at], to.as_bytes(), &original[at + from.len()..]].concat()
}

proptest! {
    #[test]
    fn a_model_comes_back_as_it_was(count in 0_usize..40, degree in 0_u8..4, seed: u64) {
        let model = model(count, degree, seed);
        prop_assert_eq!(read(&bytes(&model)).unwrap(), model);
    }

    #[test]
    fn any_bytes_are_read_or_refused(tail in prop::collection::vec(any::<u8>(), 0..400), cut in 0_usize..800) {
        let mut file = bytes(&model(2, 1, 1));
        file.truncate(cut);
        file.extend(&tail);
        if let Ok(model) = read(&file) {
            prop_assert!(model.is_finite());
        }
    }
}

#[test]
fn the_header_is_the_one_that_viewers_expect() {
    for (degree, rest) in [(0, 0), (1, 9), (2, 24), (3, 45)] {
        let bytes = bytes(&model(3, degree, 1));
        let (header, data) = split(&bytes);
        let names: Vec<&str> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
        let rest_names: String = (0..rest).map(|k| format!(" f_rest_{k}")).collect();
        let expected = format!(
            "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2{rest_names} opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
        );
        assert_eq!(names.join(" "), expected);
        assert_eq!(bytes.len(), data + 3 * (17 + rest) * 4);
    }
}

#[test]
fn higher_bands_lie_channel_after_channel() {
    let model = model(2, 2, 4);
    let bytes = bytes(&model);
    let (_, data) = split(&bytes);
    let value = |gaussian: usize, property: usize| {
        let at = data + 4 * (gaussian * (17 + 24) + property);
        f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
    };
    for gaussian in 0..2 {
        let bands = model.sh_rest(gaussian);
        // f_rest_0 follows nine others; green begins at f_rest_8.
        for (property, coefficient, channel) in [(0, 0, 0), (7, 7, 0), (8, 0, 1), (13, 5, 1), (16, 0, 2), (23, 7, 2)] {
            assert_eq!(value(gaussian, 9 + property), bands[coefficient][channel], "f_rest_{property}");
        }
    }
}

#[test]
fn properties_come_in_any_order_and_type_among_others() {
    let model = bare(3);
    // Reversed, as doubles, with foreign properties and elements around.
    let mut names: Vec<&str> = PROPERTIES.to_vec();
    names.reverse();
    let mut file = "ply\r\nformat binary_little_endian 1.0\r\ncomment end_header is not here\r\nelement camera 2\r\n\
                    property ushort id\r\nelement vertex 3\r\nproperty uchar red\r\n"
        .to_owned();
    names.iter().for_each(|name| file += &format!("property double {name}\r\n"));
    file += "property short segment\r\nelement face 1\r\nproperty list uchar int vertex_indices\r\nend_header\r\n";
    let mut file = file.into_bytes();
    file.extend([1, 2, 3, 4]);
    for g in model.iter() {
        let (m, s, q) = (g.mean, g.log_scales, g.rotation);
        let v = [m.x, m.y, m.z, g.sh[0], g.sh[1], g.sh[2], g.opacity_logit, s.x, s.y, s.z, q.w, q.x, q.y, q.z];
        file.push(255);
        v.iter().rev().for_each(|v| file.extend(f64::from(*v).to_le_bytes()));
        file.extend([7, 7]);
    }
    file.extend([3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
    assert_eq!(read(&file).unwrap(), model);
}

#[test]
fn a_model_that_is_not_finite_is_not_written() {
    let mut model = bare(3);
    model.set(2, &Gaussian { opacity_logit: f32::NAN, ..model.get(2) });
    let mut file = Vec::new();
    let error = write(&model, &mut file).unwrap_err();
    assert_eq!((error.kind(), file.len()), (io::ErrorKind::InvalidData, 0));
    assert!(error.to_string().contains("Gaussian 2") && error.to_string().contains("opacity_logit"), "{error}");
}

#[test]
fn every_truncation_is_refused() {
    let bytes = bytes(&model(4, 1, 1));
    for length in 0..bytes.len() {
        assert!(read(&bytes[..length]).is_err(), "{length} bytes");
    }
    assert!(matches!(read(&[bytes.as_slice(), b"x"].concat()), Err(PlyError::Length { .. })));
}

#[test]
fn errors_name_what_is_wrong() {
    let message = |bytes: &[u8]| read(bytes).unwrap_err().to_string();
    for name in PROPERTIES {
        let said = message(&with_header(&format!("property float {name}\n"), &format!("property float {name}x\n")));
        assert!(said.contains(&format!("\"{name}\"")), "{said}");
    }
    assert!(message(&with_header("float f_rest_8", "float f_other")).contains("8 properties \"f_rest_*\""));
    assert!(message(&with_header("float f_rest_8", "float f_rest_9")).contains("\"f_rest_8\""));
    assert!(message(&with_header("float nx", "quad nx")).contains("a type of property"));
    assert!(
        message(&with_header("property float nx", "property list uchar float nx")).contains("list property \"nx\"")
    );
    assert!(message(&with_header("float ny", "float nx")).contains("once"));
    let text = message(&with_header("binary_little_endian", "ascii"));
    assert!(text.contains("binary_little_endian") && text.contains("convert"), "{text}");
    assert!(message(&with_header("vertex 5", "vertex many")).contains("number of rows"));
    assert!(message(&with_header("vertex 5", "vertex 99999999999999")).contains("truncated"));
    assert!(message(&with_header("vertex 5", &format!("vertex {}", u64::MAX))).contains("truncated"));
    assert!(message(&with_header("vertex 5", "point 5")).contains("element vertex N"));
    assert!(message(b"solid cube").contains("end_header"));
}

#[test]
fn a_parameter_that_is_not_finite_is_named() {
    let file = bytes(&model(5, 1, 1));
    let (header, data) = split(&file);
    let names: Vec<&str> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
    for (k, name) in names.iter().enumerate().filter(|(_, name)| !NORMALS.contains(name)) {
        for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let mut broken = file.clone();
            let at = data + 4 * (3 * names.len() + k);
            broken[at..at + 4].copy_from_slice(&value.to_le_bytes());
            let message = read(&broken).unwrap_err().to_string();
            assert!(message.contains("Gaussian 3") && message.contains(&format!("\"{name}\"")), "{message}");
        }
    }
}
