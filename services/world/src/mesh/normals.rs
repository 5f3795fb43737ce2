//! Normals at the corners of triangles, where a file has none or broken ones: smooth over gentle bends, sharp over edges.

use std::collections::BTreeMap;

use glam::Vec3;

/// Faces that meet at more than this angle keep an edge between them.
const CREASE_DEG: f32 = 50.0;

/// For each corner, the mean normal of the faces that meet there, weighted by their angle at the corner; faces beyond the
/// crease angle are left out. Vertices at the same place count as one, whatever their texture coordinates.
pub(super) fn smooth(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<[Vec3; 3]> {
    let welded = weld(positions);
    let faces: Vec<Vec3> = triangles.iter().map(|t| face_normal(positions, *t)).collect();
    // Corner lists per vertex in compressed rows: `starts[v]..starts[v + 1]` of `around`.
    let mut starts = vec![0_usize; positions.len() + 1];
    for corner in triangles.iter().flatten() {
        starts[welded[*corner as usize] as usize + 1] += 1;
    }
    for i in 1..starts.len() {
        starts[i] += starts[i - 1];
    }
    let mut fill = starts.clone();
    let mut around = vec![(0_u32, 0.0_f32); triangles.len() * 3];
    for (t, corners) in triangles.iter().enumerate() {
        for k in 0..3 {
            let vertex = welded[corners[k] as usize] as usize;
            around[fill[vertex]] = (t as u32, corner_angle(positions, *corners, k));
            fill[vertex] += 1;
        }
    }
    let limit = CREASE_DEG.to_radians().cos();
    triangles
        .iter()
        .enumerate()
        .map(|(t, corners)| {
            corners.map(|corner| {
                let vertex = welded[corner as usize] as usize;
                let sum: Vec3 = around[starts[vertex]..starts[vertex + 1]]
                    .iter()
                    .map(|(other, angle)| (faces[*other as usize], *angle))
                    .filter(|(normal, _)| normal.dot(faces[t]) >= limit)
                    .map(|(normal, angle)| normal * angle)
                    .sum();
                sum.try_normalize().unwrap_or(faces[t])
            })
        })
        .collect()
}

/// The file's normals, made unit length; those that are zero, not finite, or on the wrong side of their face are replaced
/// by the face's.
pub(super) fn repaired(positions: &[Vec3], triangles: &[[u32; 3]], given: Vec<[Vec3; 3]>) -> Vec<[Vec3; 3]> {
    given
        .into_iter()
        .zip(triangles)
        .map(|(normals, corners)| {
            let face = face_normal(positions, *corners);
            normals.map(|n| n.try_normalize().filter(|n| n.dot(face) > 0.0).unwrap_or(face))
        })
        .collect()
}

fn face_normal(positions: &[Vec3], corners: [u32; 3]) -> Vec3 {
    let [a, b, c] = corners.map(|i| positions[i as usize].as_dvec3());
    // In double precision: the cross product of two tiny edges underflows f32.
    (b - a).cross(c - a).try_normalize().unwrap_or(glam::DVec3::Z).as_vec3()
}

fn corner_angle(positions: &[Vec3], corners: [u32; 3], k: usize) -> f32 {
    let at = |i: usize| positions[corners[i % 3] as usize];
    (at(k + 1) - at(k)).angle_between(at(k + 2) - at(k))
}

/// For each vertex, the first vertex at exactly the same place.
fn weld(positions: &[Vec3]) -> Vec<u32> {
    let mut first = BTreeMap::new();
    positions
        .iter()
        .enumerate()
        // Adding zero turns -0 into +0, so that both weld.
        .map(|(i, p)| *first.entry((*p + Vec3::ZERO).to_array().map(f32::to_bits)).or_insert(i as u32))
        .collect()
}
