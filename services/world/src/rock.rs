//! A procedural lunar rock: a subdivided icosahedron, displaced along its radius by several scales of noise, cut by a few
//! fracture planes and dented by craters. The same seed gives the same rock.

use std::collections::BTreeMap;

use fastnoise_lite::{FastNoiseLite, FractalType, NoiseType};
use glam::Vec3;

use crate::mesh::{Material, RawMesh};
use crate::random::Stream;

/// Subdivisions of the icosahedron: 20 x 4^6 = 81,920 triangles.
const SUBDIVISIONS: usize = 6;

/// The rock of a seed, about one unit in radius, z up.
#[must_use]
pub fn rock(seed: u64) -> RawMesh {
    let (mut positions, triangles) = icosphere(SUBDIVISIONS);
    let shape = Shape::new(seed);
    for p in &mut positions {
        *p = shape.displaced(*p);
    }
    RawMesh {
        triangle_materials: vec![0; triangles.len()],
        positions,
        triangles,
        materials: vec![Material::Procedural],
        ..RawMesh::default()
    }
}

/// Everything that depends on the seed.
struct Shape {
    stretch: Vec3,
    lumps: FastNoiseLite,
    ridges: FastNoiseLite,
    grain: FastNoiseLite,
    /// Fracture planes: unit normal and distance from the centre. What lies beyond is pressed onto the plane.
    cuts: Vec<(Vec3, f32)>,
    /// Craters: unit direction, angular radius in radians, depth.
    craters: Vec<(Vec3, f32, f32)>,
}

impl Shape {
    fn new(seed: u64) -> Self {
        let mut random = Stream::new(seed ^ 0x0052_4F43_4B00);
        let mut between = |low: f64, high: f64| (low + (high - low) * random.next_unit()) as f32;
        let stretch = Vec3::new(between(0.85, 1.1), between(0.75, 1.0), between(0.65, 0.9));
        let mut cuts: Vec<(Vec3, f32)> = (0..9)
            .map(|_| {
                let normal = direction(&mut between);
                // Few cuts from below: a rock that lies on the ground does not stand on its tip.
                let normal = if normal.z < -0.3 { -normal } else { normal };
                (normal, between(0.62, 0.85))
            })
            .collect();
        // The face it lies on.
        cuts.push((Vec3::new(between(-0.1, 0.1), between(-0.1, 0.1), -1.0).normalize_or(Vec3::NEG_Z), 0.5));
        let craters = (0..40)
            .map(|_| {
                // Small craters are many, large ones few.
                let radius = 0.05 * (4.0_f32).powf(between(0.0, 1.0).powi(3));
                (direction(&mut between), radius, radius * between(0.12, 0.25))
            })
            .collect();
        let noise = |offset: i32, frequency: f32, octaves: i32, fractal: FractalType| {
            let mut noise = FastNoiseLite::with_seed((seed as i32).wrapping_mul(31).wrapping_add(offset));
            noise.set_noise_type(Some(NoiseType::OpenSimplex2));
            noise.set_fractal_type(Some(fractal));
            noise.set_fractal_octaves(Some(octaves));
            noise.set_frequency(Some(frequency));
            noise
        };
        Self {
            stretch,
            lumps: noise(1, 0.9, 3, FractalType::FBm),
            ridges: noise(2, 2.4, 4, FractalType::Ridged),
            grain: noise(3, 9.0, 4, FractalType::FBm),
            cuts,
            craters,
        }
    }

    fn displaced(&self, direction: Vec3) -> Vec3 {
        let at = |noise: &FastNoiseLite| noise.get_noise_3d(direction.x, direction.y, direction.z);
        let mut radius = 1.0 + 0.22 * at(&self.lumps) + 0.05 * at(&self.ridges);
        for (normal, distance) in &self.cuts {
            let along = direction.dot(*normal);
            if along > 1e-3 {
                radius = smooth_min(radius, distance / along, 0.04);
            }
        }
        for (center, size, depth) in &self.craters {
            let angle = direction.angle_between(*center) / size;
            if angle < 1.6 {
                // A bowl with a raised rim that fades out.
                let bowl = -depth * (1.0 - angle * angle).max(0.0);
                let rim = 0.3 * depth * (-((angle - 1.0) / 0.22).powi(2)).exp();
                radius += bowl + rim;
            }
        }
        radius += 0.018 * at(&self.grain);
        direction * radius * self.stretch
    }
}

/// Uniform on the sphere.
fn direction(between: &mut impl FnMut(f64, f64) -> f32) -> Vec3 {
    let z = between(-1.0, 1.0);
    let angle = between(0.0, std::f64::consts::TAU);
    let r = (1.0 - z * z).max(0.0).sqrt();
    Vec3::new(r * angle.cos(), r * angle.sin(), z)
}

/// The smaller of two values, rounded where they meet over a width of `k`.
fn smooth_min(a: f32, b: f32, k: f32) -> f32 {
    let h = (0.5 + 0.5 * (b - a) / k).clamp(0.0, 1.0);
    b + (a - b) * h - k * h * (1.0 - h)
}

/// A sphere of equal triangles, wound counter-clockwise from outside.
pub(crate) fn icosphere(subdivisions: usize) -> (Vec<Vec3>, Vec<[u32; 3]>) {
    let golden = (1.0 + 5.0_f32.sqrt()) / 2.0;
    let mut positions: Vec<Vec3> = [
        [-1.0, golden, 0.0],
        [1.0, golden, 0.0],
        [-1.0, -golden, 0.0],
        [1.0, -golden, 0.0],
        [0.0, -1.0, golden],
        [0.0, 1.0, golden],
        [0.0, -1.0, -golden],
        [0.0, 1.0, -golden],
        [golden, 0.0, -1.0],
        [golden, 0.0, 1.0],
        [-golden, 0.0, -1.0],
        [-golden, 0.0, 1.0],
    ]
    .into_iter()
    .map(|p| Vec3::from_array(p).normalize_or_zero())
    .collect();
    let mut triangles: Vec<[u32; 3]> = vec![
        [0, 11, 5],
        [0, 5, 1],
        [0, 1, 7],
        [0, 7, 10],
        [0, 10, 11],
        [1, 5, 9],
        [5, 11, 4],
        [11, 10, 2],
        [10, 7, 6],
        [7, 1, 8],
        [3, 9, 4],
        [3, 4, 2],
        [3, 2, 6],
        [3, 6, 8],
        [3, 8, 9],
        [4, 9, 5],
        [2, 4, 11],
        [6, 2, 10],
        [8, 6, 7],
        [9, 8, 1],
    ];
    for _ in 0..subdivisions {
        let mut middles = BTreeMap::new();
        let mut next = Vec::with_capacity(triangles.len() * 4);
        for [a, b, c] in triangles {
            let mut middle = |i: u32, j: u32| {
                *middles.entry((i.min(j), i.max(j))).or_insert_with(|| {
                    positions.push((positions[i as usize] + positions[j as usize]).normalize_or_zero());
                    positions.len() as u32 - 1
                })
            };
            let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
            next.extend([[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]);
        }
        triangles = next;
    }
    (positions, triangles)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rock_is_fine_reproducible_and_different_for_another_seed() {
        let (a, b, c) = (rock(1), rock(1), rock(2));
        assert!(a.triangles.len() >= 50_000);
        assert_eq!(a.positions, b.positions);
        assert_ne!(a.positions, c.positions);
        assert!(a.positions.iter().all(|p| p.is_finite() && p.length() > 0.2 && p.length() < 2.0));
    }

    #[test]
    fn an_icosphere_is_a_closed_sphere() {
        let (positions, triangles) = icosphere(4);
        assert_eq!(triangles.len(), 20 * 256);
        assert_eq!(positions.len() as i64 - triangles.len() as i64 / 2, 2, "Euler's formula for a sphere");
        let area: f32 = triangles.iter().map(|t| crate::mesh::area(t.map(|i| positions[i as usize]))).sum();
        assert!((area / (4.0 * std::f32::consts::PI) - 1.0).abs() < 0.01);
    }
}
