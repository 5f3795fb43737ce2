//! A colour for objects that bring none: a lunar breccia by position, sampled once on a lattice over every triangle, so that
//! a lookup while rendering is a few loads instead of a dozen noise functions.
//!
//! The lattice of a triangle divides each edge into n equal parts (n differs from triangle to triangle, so that the spacing
//! on the surface is about the same) and colours are interpolated on the small triangles between its points.

use fastnoise_lite::{CellularReturnType, FastNoiseLite, FractalType, NoiseType};
use glam::Vec3;
use rayon::prelude::*;

use crate::color::{decode_table, srgb_from_linear_rgb};
use crate::mesh::Mesh;

/// Lattice points per object size: 3.5 mm on an object of 1.5 m, two thirds of what a pixel covers from 2.5 m.
const POINTS_PER_SIZE: f32 = 430.0;
/// More lattice points than this are not worth their memory (4 bytes each); the lattice gets coarser instead.
const MAX_POINTS: usize = 6_000_000;

/// The lattices of all triangles.
#[derive(Debug, Clone, Default)]
pub struct SurfaceLattice {
    triangles: Vec<TriangleLattice>,
    texels: Vec<[u8; 4]>,
}

#[derive(Debug, Clone, Copy, Default)]
struct TriangleLattice {
    /// Index of its first texel.
    start: u32,
    /// Parts of an edge; 0: the triangle has no lattice.
    parts: u32,
}

impl SurfaceLattice {
    /// Samples `color` (linear, by world position) on the triangles for which `wanted` holds. Runs in the caller's rayon
    /// pool; the result does not depend on its size.
    #[must_use]
    pub fn sample_from(
        mesh: &Mesh,
        size_m: f32,
        wanted: impl Fn(usize) -> bool,
        color: impl Fn(Vec3) -> Vec3 + Sync,
    ) -> Self {
        let mut spacing_m = size_m / POINTS_PER_SIZE;
        let triangles = loop {
            let (triangles, total) = layout(mesh, spacing_m, &wanted);
            if total <= MAX_POINTS || triangles.iter().all(|t| t.parts <= 1) {
                break triangles;
            }
            spacing_m *= 1.25;
        };
        let chunks: Vec<Vec<[u8; 4]>> = triangles
            .par_iter()
            .enumerate()
            .map(|(t, lattice)| {
                let [a, b, c] = mesh.corners(t);
                let n = lattice.parts;
                let rows = (0..=n)
                    .filter(|_| n > 0)
                    .flat_map(|j| (0..=n - j).map(move |i| (i as f32 / n as f32, j as f32 / n as f32)));
                rows.map(|(u, v)| {
                    let [r, g, b] = srgb_from_linear_rgb(color(a + (b - a) * u + (c - a) * v));
                    [r, g, b, 255]
                })
                .collect()
            })
            .collect();
        Self { triangles, texels: chunks.concat() }
    }

    /// Linear colour at barycentric (u, v): weights of the second and third corner.
    #[inline]
    #[must_use]
    pub fn color(&self, triangle: usize, u: f32, v: f32) -> Vec3 {
        let TriangleLattice { start, parts } = self.triangles[triangle];
        let n = parts as f32;
        // Rounding may carry a point over an edge by some ulps.
        let (u, v) = (u.clamp(0.0, 1.0), v.clamp(0.0, 1.0));
        let over = (u + v).max(1.0);
        let (x, y) = (u / over * n, v / over * n);
        let (i, j) = ((x as u32).min(parts - 1), (y as u32).min(parts - 1));
        // On the long edge the cell (i, j) may lie outside: step back into the last one inside.
        let i = if i + j >= parts { parts - 1 - j } else { i };
        let (fx, fy) = (x - i as f32, y - j as f32);
        let decode = decode_table();
        let fetch = |i: u32, j: u32| {
            let row = j * (parts + 1) - j * (j.saturating_sub(1)) / 2;
            let [r, g, b, _] = self.texels[(start + row + i) as usize];
            Vec3::new(decode[usize::from(r)], decode[usize::from(g)], decode[usize::from(b)])
        };
        let (right, down) = (fetch(i + 1, j), fetch(i, j + 1));
        if fx + fy <= 1.0 || i + j + 2 > parts {
            fetch(i, j) * (1.0 - fx - fy).max(0.0) + right * fx + down * fy
        } else {
            fetch(i + 1, j + 1) * (fx + fy - 1.0) + right * (1.0 - fy) + down * (1.0 - fx)
        }
    }
}

fn layout(mesh: &Mesh, spacing_m: f32, wanted: &impl Fn(usize) -> bool) -> (Vec<TriangleLattice>, usize) {
    let mut total = 0_usize;
    let triangles = (0..mesh.triangles.len())
        .map(|t| {
            if !wanted(t) {
                return TriangleLattice::default();
            }
            let [a, b, c] = mesh.corners(t);
            let longest = a.distance(b).max(b.distance(c)).max(c.distance(a));
            let parts = (longest / spacing_m).ceil().clamp(1.0, 4096.0) as u32;
            let lattice = TriangleLattice { start: total as u32, parts };
            total += (parts as usize + 1) * (parts as usize + 2) / 2;
            lattice
        })
        .collect();
    (triangles, total)
}

/// The albedo of a lunar breccia: broad tones, lighter and darker clasts, grain down to centimetres, dark pits.
pub struct Breccia {
    tone: FastNoiseLite,
    clasts: FastNoiseLite,
    grain: FastNoiseLite,
    fine: FastNoiseLite,
    pits: FastNoiseLite,
    scale: f32,
}

impl Breccia {
    /// The pattern of a seed, for an object of `size_m`: features grow with the object, so that they look the same in
    /// images taken from a distance in proportion.
    #[must_use]
    pub fn new(seed: u64, size_m: f32) -> Self {
        let noise = |offset: i32, kind: NoiseType, frequency: f32, octaves: i32| {
            let mut noise = FastNoiseLite::with_seed((seed as i32).wrapping_mul(131).wrapping_add(offset));
            noise.set_noise_type(Some(kind));
            noise.set_frequency(Some(frequency));
            noise.set_fractal_type(Some(if octaves > 1 { FractalType::FBm } else { FractalType::None }));
            noise.set_fractal_octaves(Some(octaves));
            noise
        };
        let mut clasts = noise(12, NoiseType::Cellular, 9.0, 1);
        clasts.set_cellular_return_type(Some(CellularReturnType::CellValue));
        let mut pits = noise(15, NoiseType::Cellular, 26.0, 1);
        pits.set_cellular_return_type(Some(CellularReturnType::Distance));
        Self {
            tone: noise(11, NoiseType::OpenSimplex2, 1.7, 3),
            clasts,
            grain: noise(13, NoiseType::OpenSimplex2, 22.0, 3),
            fine: noise(14, NoiseType::OpenSimplex2, 90.0, 2),
            pits,
            scale: 1.5 / size_m,
        }
    }

    /// Linear albedo at a point of the surface, metres.
    #[must_use]
    pub fn albedo(&self, point_m: Vec3) -> Vec3 {
        let p = point_m * self.scale;
        let at = |noise: &FastNoiseLite, p: Vec3| noise.get_noise_3d(p.x, p.y, p.z);
        let (tone, grain) = (at(&self.tone, p), at(&self.grain, p));
        // Bending the clasts' borders by the grain takes away the straight edges of Voronoi cells.
        let bent = p + Vec3::new(grain, -grain, 0.7 * grain) * 0.03;
        let cell = at(&self.clasts, bent);
        let clast = if cell > 0.55 {
            0.16
        } else if cell < -0.6 {
            -0.12
        } else {
            0.0
        };
        // The cellular distance runs from -1 (at a cell's centre) upwards.
        let pit = 1.0 - ((at(&self.pits, p) + 1.0) / 0.32).clamp(0.0, 1.0);
        let value = 0.36 + 0.13 * tone + clast + 0.11 * grain + 0.12 * at(&self.fine, p) - 0.16 * pit;
        let warmth = 0.03 * tone + 0.02 * grain;
        Vec3::new(value * (1.02 + warmth), value, value * (0.95 - warmth)).clamp(Vec3::splat(0.03), Vec3::splat(0.85))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::color::linear_from_srgb;
    use crate::mesh::{Material, Placement, RawMesh, UpAxis};

    fn one_triangle() -> Mesh {
        let raw = RawMesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            triangles: vec![[0, 1, 2]],
            triangle_materials: vec![0],
            materials: vec![Material::Procedural],
            ..RawMesh::default()
        };
        Mesh::from_raw("triangle".as_ref(), raw, UpAxis::Z, &Placement { size_m: 1.0, ..Placement::default() })
            .expect("valid")
    }

    #[test]
    fn interpolation_returns_a_linear_function_of_position() {
        let mesh = one_triangle();
        let [a, b, c] = mesh.corners(0);
        let color = |p: Vec3| Vec3::new(0.5 + 0.3 * p.x, 0.5 - 0.4 * p.y, 0.5 + 0.2 * p.x + 0.2 * p.y);
        let lattice = SurfaceLattice::sample_from(&mesh, 50.0, |_| true, color);
        for (u, v) in
            [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.3, 0.3), (0.61, 0.38), (0.5, 0.5), (0.05, 0.93), (0.999, 0.0005)]
        {
            let found = lattice.color(0, u, v);
            let wanted = color(a + (b - a) * u + (c - a) * v);
            // The texels are bytes.
            assert!((found - wanted).abs().max_element() < 0.004, "at {u} {v}: {found} for {wanted}");
        }
        assert!(linear_from_srgb(128) < 0.5);
    }

    #[test]
    fn the_breccia_has_texture_at_centimetres() {
        let breccia = Breccia::new(3, 1.5);
        let values: Vec<f32> = (0..4000).map(|i| breccia.albedo(Vec3::new(i as f32 * 0.01, 0.3, 0.7)).y).collect();
        let mean = values.iter().sum::<f32>() / values.len() as f32;
        let step = values.windows(2).map(|w| (w[1] - w[0]).abs()).sum::<f32>() / values.len() as f32;
        assert!((0.2..0.5).contains(&mean), "{mean}");
        assert!(step > 0.03, "a centimetre changes the albedo by {step}");
    }
}
