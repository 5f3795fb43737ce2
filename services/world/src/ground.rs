//! The lunar ground: the plane z = 0 with a precomputed texture of regolith, craters and small stones.
//!
//! The texture is a height field lit by the sun of the scene, times an albedo, as the factor by which a patch is brighter or
//! darker than flat regolith. It repeats every [`TILE_M`]; a second, turned and stretched lookup of the same texture breaks
//! the repetition up. Mip levels integrate it over a pixel.

use glam::{Vec2, Vec3};
use rayon::prelude::*;

use crate::random::{Stream, hash64, unit_from_hash};

/// Edge of the repeating tile, metres.
pub const TILE_M: f32 = 6.144;
/// Texels along the tile's edge: 6 mm each. A power of two, so that wrapping is a mask.
const TEXELS: usize = 1024;
/// Codes are square roots of brightness over this range, which spreads the bytes as the eye does.
const FULL_SCALE: f32 = 2.5;
/// Linear albedo of flat regolith: neutral, a touch warm.
const REGOLITH: Vec3 = Vec3::new(0.31, 0.30, 0.285);
/// The second lookup: stretch and turn (cosine, sine), an angle whose tangent is irrational.
const BROAD: (f32, f32, f32) = (1.0 / 5.3, 0.857_167, 0.515_038);

/// The ground of a scene.
#[derive(Debug, Clone)]
pub struct Ground {
    levels: Vec<Vec<u8>>,
}

impl Ground {
    /// The ground of a seed under a sun whose direction (towards it, unit length) shades its relief. Runs in the caller's
    /// rayon pool; the result does not depend on its size.
    #[must_use]
    pub fn new(seed: u64, toward_sun: Vec3) -> Self {
        let relief = Relief::new(seed);
        let texel_m = TILE_M / TEXELS as f32;
        let heights: Vec<f32> = (0..TEXELS)
            .into_par_iter()
            .flat_map_iter(|y| (0..TEXELS).map(move |x| (x, y)))
            .map(|(x, y)| relief.height_m(Vec2::new(x as f32 + 0.5, y as f32 + 0.5) * texel_m))
            .collect();
        let mask = TEXELS - 1;
        let height = |x: usize, y: usize| heights[(y & mask) * TEXELS + (x & mask)];
        let flat = toward_sun.z.max(0.1);
        let finest: Vec<u8> = (0..TEXELS)
            .into_par_iter()
            .flat_map_iter(|y| (0..TEXELS).map(move |x| (x, y)))
            .map(|(x, y)| {
                let slope_x = (height(x + 1, y) - height(x + mask, y)) / (2.0 * texel_m);
                let slope_y = (height(x, y + 1) - height(x, y + mask)) / (2.0 * texel_m);
                let normal = Vec3::new(-slope_x, -slope_y, 1.0) / (1.0 + slope_x * slope_x + slope_y * slope_y).sqrt();
                let shade = 0.25 + 0.75 * normal.dot(toward_sun).max(0.0) / flat;
                encode(shade * relief.tone(Vec2::new(x as f32 + 0.5, y as f32 + 0.5) * texel_m))
            })
            .collect();
        let mut levels = vec![finest];
        while let Some(next) = levels.last().and_then(|level| halved(level)) {
            levels.push(next);
        }
        Self { levels }
    }

    /// Linear albedo at a point of the plane, metres, filtered over 2^`lod` texels (see [`Self::lod`]).
    #[inline]
    #[must_use]
    pub fn albedo(&self, point_m: Vec2, lod: f32) -> Vec3 {
        let (stretch, cos, sin) = BROAD;
        let turned = Vec2::new(cos * point_m.x - sin * point_m.y, sin * point_m.x + cos * point_m.y) * stretch;
        let near = self.brightness(point_m, lod);
        // The broad pattern is smooth at the size of a pixel: one level of it is enough, two coarser.
        let broad = self.bilinear((lod.max(0.0) as usize).max(2), turned);
        REGOLITH * (near * (0.45 + 0.55 * broad))
    }

    /// Mip level for a footprint of this width, metres.
    #[inline]
    #[must_use]
    pub fn lod(width_m: f32) -> f32 {
        crate::texture::log2_approx(width_m * (TEXELS as f32 / TILE_M))
    }

    #[inline]
    fn brightness(&self, point_m: Vec2, lod: f32) -> f32 {
        let lod = lod.max(0.0);
        let fine = lod as usize;
        let weight = lod - fine as f32;
        let value = self.bilinear(fine, point_m);
        if weight < 0.01 { value } else { value + (self.bilinear(fine + 1, point_m) - value) * weight }
    }

    #[inline]
    fn bilinear(&self, level: usize, point_m: Vec2) -> f32 {
        let level = level.min(self.levels.len() - 1);
        let n = TEXELS >> level;
        let texels = &self.levels[level][..];
        let x = point_m.x * (n as f32 / TILE_M) - 0.5;
        let y = point_m.y * (n as f32 / TILE_M) - 0.5;
        let (x0, y0) = (x.floor(), y.floor());
        let (tx, ty) = (x - x0, y - y0);
        let mask = n - 1;
        // Two's complement makes the mask right for negative coordinates too.
        let (xa, ya) = (x0 as i64 as usize & mask, y0 as i64 as usize & mask);
        let (xb, yb) = ((xa + 1) & mask, (ya + 1) & mask);
        let at = |x: usize, y: usize| decode(texels[y * n + x]);
        let top = at(xa, ya) + (at(xb, ya) - at(xa, ya)) * tx;
        let bottom = at(xa, yb) + (at(xb, yb) - at(xa, yb)) * tx;
        top + (bottom - top) * ty
    }
}

fn encode(brightness: f32) -> u8 {
    ((brightness / FULL_SCALE).clamp(0.0, 1.0).sqrt() * 255.0).round() as u8
}

#[inline]
fn decode(code: u8) -> f32 {
    let root = f32::from(code);
    root * root * (FULL_SCALE / (255.0 * 255.0))
}

fn halved(level: &[u8]) -> Option<Vec<u8>> {
    let n = level.len().isqrt();
    if n <= 1 {
        return None;
    }
    let half = n / 2;
    let mean = |x: usize, y: usize| {
        let at = |i: usize| decode(level[i]);
        let corner = 2 * y * n + 2 * x;
        (at(corner) + at(corner + 1) + at(corner + n) + at(corner + n + 1)) / 4.0
    };
    Some((0..half * half).map(|i| encode(mean(i % half, i / half))).collect())
}

/// The height field and the tones of the tile; everything wraps at its edges.
struct Relief {
    seed: u64,
    /// Noise for the height, with its amplitude in metres, and for the tone, with its share of brightness.
    heights: Vec<(Noise, f32)>,
    tones: Vec<(Noise, f32)>,
    /// Craters and stones: centre, radius, height (negative: a bowl with a rim).
    bumps: Vec<(Vec2, f32, f32)>,
    /// Indices of the bumps that reach each cell of a coarse grid.
    cells: Vec<Vec<u32>>,
}

const CELLS: usize = 32;

impl Relief {
    fn new(seed: u64) -> Self {
        let mut random = Stream::new(seed ^ 0x0047_524F_554E_4400);
        let mut bumps = Vec::new();
        for i in 0..1500 {
            let center = Vec2::new(random.next_unit() as f32, random.next_unit() as f32) * TILE_M;
            let share = random.next_unit() as f32;
            // Numbers fall with the cube of the size, as on the Moon.
            if i < 420 {
                let radius = (0.035 * (1.0 - 0.985 * share).powf(-0.45)).min(0.34);
                bumps.push((center, radius, -0.2 * radius));
            } else {
                let radius = (0.007 * (1.0 - 0.99 * share).powf(-0.4)).min(0.05);
                bumps.push((center, radius, 0.6 * radius));
            }
        }
        let mut cells = vec![Vec::new(); CELLS * CELLS];
        let cell_m = TILE_M / CELLS as f32;
        for (index, (center, radius, _)) in bumps.iter().enumerate() {
            let reach = radius * 1.8;
            let range = |c: f32| ((c - reach) / cell_m).floor() as i64..=((c + reach) / cell_m).floor() as i64;
            for y in range(center.y) {
                for x in range(center.x) {
                    let wrap = |i: i64| i.rem_euclid(CELLS as i64) as usize;
                    cells[wrap(y) * CELLS + wrap(x)].push(index as u32);
                }
            }
        }
        cells.iter_mut().for_each(Vec::dedup);
        let octaves = |first: u64, list: &[(u32, f32)]| -> Vec<(Noise, f32)> {
            list.iter()
                .zip(first..)
                .map(|((cells, amplitude), octave)| (Noise::new(seed, octave, *cells), *amplitude))
                .collect()
        };
        Self {
            seed,
            heights: octaves(0, &[(4, 0.02), (10, 0.011), (26, 0.005), (66, 0.0024), (170, 0.0012), (400, 0.0006)]),
            tones: octaves(20, &[(5, 0.16), (37, 0.15), (230, 0.16)]),
            bumps,
            cells,
        }
    }

    fn height_m(&self, p: Vec2) -> f32 {
        let mut height: f32 = self.heights.iter().map(|(noise, amplitude_m)| amplitude_m * noise.at(p)).sum();
        for (distance, _, size) in self.near(p) {
            height += if size < 0.0 {
                let bowl = size * (1.0 - distance * distance).max(0.0);
                bowl - 0.25 * size * (-((distance - 1.05) / 0.25).powi(2)).exp()
            } else {
                size * (1.0 - distance * distance).max(0.0).sqrt()
            };
        }
        height
    }

    /// Brightness of the material itself around 1: blotches, grain, and stones a little lighter than dust.
    fn tone(&self, p: Vec2) -> f32 {
        let mut tone = 1.0 + self.tones.iter().map(|(noise, share)| share * noise.at(p)).sum::<f32>();
        for (distance, index, size) in self.near(p) {
            if size > 0.0 && distance < 1.0 {
                tone *= 1.05 + 0.3 * unit_from_hash(hash64(self.seed ^ u64::from(index))) as f32;
            }
        }
        tone
    }

    /// Bumps near a point: distance in radii, index, height.
    fn near(&self, p: Vec2) -> impl Iterator<Item = (f32, u32, f32)> {
        let cell = |v: f32| ((v / TILE_M * CELLS as f32) as usize).min(CELLS - 1);
        self.cells[cell(p.y) * CELLS + cell(p.x)].iter().filter_map(move |index| {
            let (center, radius, size) = self.bumps[*index as usize];
            let offset = p - center;
            let wrapped = offset - (offset / TILE_M).round() * TILE_M;
            let distance = wrapped.length() / radius;
            (distance < 1.8).then_some((distance, *index, size))
        })
    }
}

/// Gradient noise of about -1..1 that repeats with the tile.
struct Noise {
    cells: u32,
    /// A unit vector for each corner of the cells.
    gradients: Vec<Vec2>,
}

impl Noise {
    /// `cells` periods along the tile; each octave of a seed has its own pattern.
    fn new(seed: u64, octave: u64, cells: u32) -> Self {
        let gradient = |corner: u64| {
            let angle = unit_from_hash(hash64(seed ^ (octave << 48) ^ corner)) * std::f64::consts::TAU;
            Vec2::new(angle.cos() as f32, angle.sin() as f32)
        };
        Self { cells, gradients: (0..u64::from(cells) * u64::from(cells)).map(gradient).collect() }
    }

    fn at(&self, p: Vec2) -> f32 {
        let q = p * (self.cells as f32 / TILE_M);
        let (x0, y0) = (q.x.floor(), q.y.floor());
        let f = Vec2::new(q.x - x0, q.y - y0);
        let corner = |dx: u32, dy: u32| {
            let (x, y) = ((x0 as u32 + dx) % self.cells, (y0 as u32 + dy) % self.cells);
            self.gradients[(y * self.cells + x) as usize].dot(f - Vec2::new(dx as f32, dy as f32))
        };
        let s = f * f * f * (f * (f * 6.0 - 15.0) + 10.0);
        let top = corner(0, 0) + (corner(1, 0) - corner(0, 0)) * s.x;
        let bottom = corner(0, 1) + (corner(1, 1) - corner(0, 1)) * s.x;
        1.4 * (top + (bottom - top) * s.y)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ground_is_textured_reproducible_and_seamless() {
        let sun = Vec3::new(0.5, -0.4, 0.77).normalize_or_zero();
        let ground = Ground::new(5, sun);
        assert_eq!(ground.levels, Ground::new(5, sun).levels);
        assert_ne!(ground.levels[0], Ground::new(6, sun).levels[0]);
        let finest = &ground.levels[0];
        let step = |a: usize, b: usize| (f32::from(finest[a]) - f32::from(finest[b])).abs();
        let inside: f32 = (0..TEXELS).map(|y| step(y * TEXELS + 500, y * TEXELS + 501)).sum();
        let across: f32 = (0..TEXELS).map(|y| step(y * TEXELS + TEXELS - 1, y * TEXELS)).sum();
        assert!(inside / TEXELS as f32 > 2.0, "neighbours differ: there is texture");
        assert!(across < 1.6 * inside, "the seam is no edge: {across} for {inside}");
    }

    #[test]
    fn coarse_levels_keep_the_mean_and_lose_the_contrast() {
        let ground = Ground::new(5, Vec3::new(0.5, -0.4, 0.77).normalize_or_zero());
        let at = |lod: f32| {
            let values: Vec<f32> = (0..900)
                .map(|i| ground.brightness(Vec2::new((i % 30) as f32 * 0.2 - 2.0, (i / 30) as f32 * 0.21 - 3.0), lod))
                .collect();
            let mean = values.iter().sum::<f32>() / 900.0;
            (mean, values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / 900.0)
        };
        let (fine, coarse) = (at(0.0), at(6.0));
        assert!((fine.0 - coarse.0).abs() < 0.04, "{} {}", fine.0, coarse.0);
        assert!(coarse.1 < 0.3 * fine.1, "{} {}", fine.1, coarse.1);
    }
}
