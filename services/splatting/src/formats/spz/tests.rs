use glam::Quat;
use proptest::prelude::*;

use super::quantise::*;
use super::*;
use crate::formats::Format;
use crate::formats::tests::{angle_between, bare, bytes, model};

/// What a gzip stream holds.
fn unpacked(file: &[u8]) -> Vec<u8> {
    let mut data = Vec::new();
    GzDecoder::new(file).read_to_end(&mut data).unwrap();
    data
}

fn packed(data: &[u8]) -> Vec<u8> {
    let mut gzip = GzEncoder::new(Vec::new(), flate2::Compression::fast());
    gzip.write_all(data).unwrap();
    gzip.finish().unwrap()
}

proptest! {
    #[test]
    fn a_model_comes_back_within_the_quantisation(count in 0_usize..40, degree in 0_u8..4, seed: u64) {
        let model = model(count, degree, seed);
        let back = read(&bytes(Format::Spz, &model)).unwrap();
        prop_assert_eq!((back.len(), back.sh_degree()), (count, degree));
        let turn = Turn::world_to_y_up();
        for i in 0..count {
            let (g, original) = (back.get(i), model.get(i));
            prop_assert!((g.mean - original.mean).abs().max_element() <= 0.5001 / 4096.0);
            prop_assert!((g.log_scales - original.log_scales).abs().max_element() <= 0.5001 / 16.0);
            prop_assert!(angle_between(g.rotation, original.rotation) < 0.005);
            prop_assert!((g.opacity() - original.opacity()).abs() <= 0.5001 / 255.0);
            for (a, b) in g.sh.into_iter().zip(original.sh) {
                prop_assert!((a - b).abs() <= 0.5001 / 255.0 / 0.15);
            }
            // In the file's frame, half a bucket and half a 128th; beyond 1 there is nothing.
            let bands = turn.bands(&back.sh_rest(i)).into_iter().zip(turn.bands(&model.sh_rest(i)));
            for (k, (a, b)) in bands.enumerate() {
                let within = (0.5 * bucket(k) as f32 + 0.501) / 128.0;
                let near = |c: usize| (a[c] - b[c].clamp(-1.0, 127.0 / 128.0)).abs() <= within;
                prop_assert!((0..3).all(near), "{k}: {a:?}, {b:?}");
            }
        }
        // What was read has no more to lose, but for rotations with two components that are nearly the largest.
        let (first, second) = (unpacked(&bytes(Format::Spz, &model)), unpacked(&bytes(Format::Spz, &back)));
        prop_assert_eq!(&first[..16 + 16 * count], &second[..16 + 16 * count]);
    }

    #[test]
    fn any_data_are_read_or_refused(data in prop::collection::vec(any::<u8>(), 0..200), count in 0_u32..4, degree in 0_u8..4, version in 2_u32..4) {
        let mut file = unpacked(&bytes(Format::Spz, &bare(0)));
        file[4..8].copy_from_slice(&version.to_le_bytes());
        file[8..12].copy_from_slice(&count.to_le_bytes());
        file[12] = degree;
        file.extend(&data);
        if let Ok(model) = read(&packed(&file)) {
            prop_assert!(model.is_finite());
        }
    }

    #[test]
    fn every_quaternion_keeps_its_rotation(x in -1.0_f32..1.0, y in -1.0_f32..1.0, z in -1.0_f32..1.0, w in -1.0_f32..1.0) {
        let rotation = Quat::from_xyzw(x, y, z, w);
        prop_assume!(rotation.length() > 0.01);
        let bytes = rotation_to_bytes(rotation);
        prop_assert!(angle_between(rotation, rotation_from_bytes(bytes)) < 0.005);
        prop_assert_eq!(bytes, rotation_to_bytes(-rotation));
        let v2 = rotation.normalize();
        let v2 = if v2.w < 0.0 { -v2 } else { v2 };
        let bytes = [v2.x, v2.y, v2.z].map(|c| ((c + 1.0) * 127.5).round() as u8);
        // w near 0 is all in the rounding of the others.
        prop_assert!(angle_between(v2, rotation_from_v2_bytes(bytes)) < 0.25);
    }
}

#[test]
fn the_bytes_are_those_of_the_definition() {
    let mut model = Gaussians::with_sh_degree(1);
    model.push(&Gaussian {
        // In the file, y is up.
        mean: Vec3::new(1.0, 2.0, -0.5),
        log_scales: Vec3::new(-10.0, -9.9, 9.0),
        // Seen from the file's frame this is no rotation.
        rotation: Quat::from_rotation_x(std::f32::consts::FRAC_PI_2),
        opacity_logit: 0.0,
        sh: [0.0, -9.0, 1.0],
        id: 0,
        birth_round: 0,
    });
    // -C1 y, C1 z, -C1 x: a coefficient of the world's x is one of the file's x, of y one of -z, of z one of y.
    let mut bands = [[0.0; 3]; SH_REST_MAX];
    bands[..3].copy_from_slice(&[[0.5, 0.0, 0.0], [0.25, 0.0, 0.0], [-0.125, 2.0, 0.0]]);
    model.set_sh_rest(0, &bands);
    let data = unpacked(&bytes(Format::Spz, &model));
    assert_eq!(data[..16], [b'N', b'G', b'S', b'P', 3, 0, 0, 0, 1, 0, 0, 0, 1, 12, 1, 0]);
    // 1.0, -0.5 and -2.0 by 4096.
    assert_eq!(data[16..25], [0, 0x10, 0, 0, 0xf8, 0xff, 0, 0xe0, 0xff]);
    assert_eq!(data[25], 128, "0.5 by 255, rounded");
    assert_eq!(data[26..29], [128, 0, 166]);
    assert_eq!(data[29..32], [0, 2, 255]);
    assert_eq!(u32::from_le_bytes(data[32..36].try_into().unwrap()) >> 30, 3, "w is largest");
    assert!(angle_between(rotation_from_bytes(data[32..36].try_into().unwrap()), Quat::IDENTITY) < 1e-6);
    // -Y y: -0.25 C1 in the direction of the file's y; Z of the file: 0.5 C1.
    assert_eq!(data[36..], [96, 128, 128, 192, 128, 128, 112, 255, 128]);
}

/// Two Gaussians written by the format's own library: version 2.1.0 (SPZ 3), and commit 1986118 (SPZ 2).
const LIBRARY_3: &str = "1f8b0800000000000003f3730f0e60666060600262461e2021c1c0c0c2c0f0e03fc3be9f0c060c0c1c0c0d0f1b96454e \
     3e639c9051b3c06142e6d2a966f782562db170f0088848c828a868e8983063c18a0d3b0e0000dbff406b4a000000";
const LIBRARY_2: &str = "1f8b0800000000000003f3730f0e606260600061461e2021c1c0c0c2c0f0e03fc3be9f0c060c0c1c0c0d0f1b96454e3e \
     639c9051b3c061c27e87fdbdb3b82c1c3c022212320a2a1a3a26cc58b062c38e03006546b0a848000000";

#[test]
fn files_of_the_formats_own_library_are_read() {
    for (hex, within) in [(LIBRARY_3, 0.004), (LIBRARY_2, 0.02)] {
        let digits: Vec<u32> = hex.chars().filter_map(|c| c.to_digit(16)).collect();
        let file: Vec<u8> = digits.chunks_exact(2).map(|pair| (16 * pair[0] + pair[1]) as u8).collect();
        let model = read(&file).unwrap();
        assert_eq!((model.len(), model.sh_degree()), (2, 1));
        // What the library was given, with y up: (x, y, z) is the world's (x, -z, y).
        let to_world = Quat::from_rotation_x(std::f32::consts::FRAC_PI_2);
        let given = [
            ([1.5, 0.25, -2.0], [-4.0, -3.5, -2.25], [0.5, -0.5, 0.5, 0.5], 0.0, [0.0, 1.0, -1.0]),
            ([-100.125, 3.0, 0.5], [0.0, -6.0, -1.0], [0.1, 0.2, -0.9, 0.3], 2.0, [0.5, 2.0, -2.0]),
        ];
        for (i, (mean, log_scales, rotation, opacity_logit, sh)) in given.into_iter().enumerate() {
            let g = model.get(i);
            assert!((g.mean - to_world * Vec3::from_array(mean)).length() < 1e-4, "{}", g.mean);
            assert_eq!(g.log_scales, Vec3::from_array(log_scales));
            let angle = angle_between(g.rotation, to_world * Quat::from_array(rotation));
            assert!(angle < within, "{angle}");
            assert!((g.opacity_logit - opacity_logit).abs() < 0.02);
            assert!(g.sh.iter().zip::<[f32; 3]>(sh).all(|(a, b)| (a - b).abs() < 0.014), "{:?}", g.sh);
            // Of -y, z, -x with y up: -y is the world's -z, z is -y, x is x.
            let band = model.sh_rest(i);
            for c in 0..3 {
                let given = |k: usize| 0.0625 * (9 * i + 3 * k + c) as f32 - 0.5625;
                for (k, expected) in [(0, given(1)), (1, -given(0)), (2, given(2))] {
                    assert!((band[k][c] - expected).abs() < 4.6 / 128.0, "{k}: {} {expected}", band[k][c]);
                }
            }
        }
    }
}

#[test]
fn version_2_is_read() {
    let model = bare(5);
    let three = unpacked(&bytes(Format::Spz, &model));
    let at = 16 + 5 * 16;
    let mut two = three[..at].to_vec();
    two[4] = 2;
    for rotation in three[at..].as_chunks::<4>().0 {
        let q = rotation_from_bytes(*rotation);
        let q = if q.w < 0.0 { -q } else { q };
        two.extend([q.x, q.y, q.z].map(|c| ((c + 1.0) * 127.5).round() as u8));
    }
    let back = read(&packed(&two)).unwrap();
    for (a, b) in back.iter().zip(model.iter()) {
        assert!((a.mean - b.mean).length() < 1e-3);
        assert!(angle_between(a.rotation, b.rotation) < 0.1);
    }
}

#[test]
fn means_far_away_take_fewer_fractional_bits_and_too_far_are_refused() {
    let mut model = bare(3);
    let far = |x| Gaussian { mean: Vec3::new(0.0, x, 0.1), ..bare(1).get(0) };
    for (x, bits) in [(2047.0, 12), (2049.0, 11), (-8.0e6, 0)] {
        model.set(1, &far(x));
        let file = bytes(Format::Spz, &model);
        assert_eq!(unpacked(&file)[13], bits);
        let back = read(&file).unwrap();
        assert!((back.get(1).mean.y - x).abs() <= 0.5, "{}", back.get(1).mean);
    }
    model.set(1, &far(9.0e6));
    let message = write(&model, true, &mut Vec::new()).unwrap_err().to_string();
    assert!(message.contains("Gaussian 1") && message.contains("mean 9000000"), "{message}");
}

#[test]
fn every_truncation_is_refused_of_the_file_and_of_what_it_holds() {
    let file = bytes(Format::Spz, &model(4, 2, 1));
    for length in 0..file.len() {
        assert!(read(&file[..length]).is_err(), "{length} bytes");
    }
    let data = unpacked(&file);
    for length in 0..data.len() {
        let error = read(&packed(&data[..length])).unwrap_err();
        let right = match length {
            0..4 => matches!(error, SpzError::Magic { .. }),
            4..16 => matches!(error, SpzError::Gzip { .. }),
            _ => matches!(error, SpzError::Length { found, .. } if found == length as u64 - 16),
        };
        assert!(right, "{length}: {error}");
    }
    let longer = packed(&[data.as_slice(), b"x"].concat());
    assert!(read(&longer).unwrap_err().to_string().contains("something else follows"));
    assert!(read(&[file.as_slice(), b"x"].concat()).unwrap_err().to_string().contains("something else follows"));
    let mut damaged = file.clone();
    *damaged.last_mut().unwrap() ^= 1;
    assert!(matches!(read(&damaged), Err(SpzError::Gzip { .. })));
}

#[test]
fn headers_that_lie_are_refused() {
    let data = unpacked(&bytes(Format::Spz, &model(4, 2, 1)));
    let with = |at: usize, value: &[u8]| {
        let mut data = data.clone();
        data[at..at + value.len()].copy_from_slice(value);
        read(&packed(&data)).unwrap_err().to_string()
    };
    assert!(with(0, b"PLY ").contains("begins with"));
    assert!(with(4, &[1]).contains("version 1"));
    assert!(with(8, &u32::MAX.to_le_bytes()).contains("announces 4294967295 Gaussians"));
    assert!(with(12, &[4]).contains("SH degree 4"));
    assert!(with(13, &[24]).contains("24 fractional bits"));
    assert!(read(b"NGSP\x04\0\0\0....").unwrap_err().to_string().contains("version 4"));
    assert!(read(b"ply\n").unwrap_err().to_string().contains("begins with"));
}

#[test]
fn records_of_vendors_are_skipped_unless_they_change_the_frame() {
    let mut data = unpacked(&bytes(Format::Spz, &bare(2)));
    data[14] |= EXTENSIONS;
    let record =
        |kind: u32, payload: &[u8]| [&kind.to_le_bytes()[..], &(payload.len() as u32).to_le_bytes(), payload].concat();
    let with = |records: &[u8]| read(&packed(&[&data, records].concat()));
    assert_eq!(with(&[]).unwrap().len(), 2);
    assert_eq!(with(&[record(0xadbe_0002, &[0; 12]), record(0x1234_0001, b"")].concat()).unwrap().len(), 2);
    assert_eq!(
        with(&[record(0x1234_0001, b"xy"), record(COORDINATE_SYSTEM, &[5, 0, 0, 0])].concat()),
        Err(SpzError::CoordinateSystem)
    );
    let whole = record(0xadbe_0002, &[0; 12]);
    for length in 1..whole.len() {
        assert_eq!(with(&whole[..length]), Err(SpzError::Extension));
    }
}
