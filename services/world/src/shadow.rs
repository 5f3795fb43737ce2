//! Shadows of the sun. It shines along one direction and nothing moves, so that one depth map seen from it, drawn once,
//! answers for every frame: for each texel, how far towards the sun the outermost surface lies.

use glam::Vec3;

use crate::mesh::Mesh;

/// Texels along the map's edge; about 1.8 mm on an object of 1.5 m, a third of a pixel from 2.5 m.
const SIZE: usize = 1024;
/// A surface must lie this many texels behind the map to be in shadow, and points are lifted off their surface by twice as
/// much: otherwise surfaces that the sun grazes would shade themselves in stripes.
const BIAS_TEXELS: f32 = 1.0;

/// The outermost surface of the object as the sun sees it.
#[derive(Debug, Clone)]
pub struct ShadowMap {
    /// Axes across the sunlight, unit length.
    across: [Vec3; 2],
    toward_sun: Vec3,
    /// Lowest coordinates along the axes, metres.
    low: [f32; 2],
    texel_m: f32,
    /// Largest coordinate along `toward_sun`, metres.
    tops: Vec<f32>,
}

impl ShadowMap {
    /// Draws the map of a mesh for a unit direction towards the sun.
    #[must_use]
    pub fn new(mesh: &Mesh, toward_sun: Vec3) -> Self {
        let (u, v) = toward_sun.any_orthonormal_pair();
        let (mut low, mut high) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
        for p in &mesh.positions {
            for (k, axis) in [u, v].into_iter().enumerate() {
                low[k] = low[k].min(p.dot(axis));
                high[k] = high[k].max(p.dot(axis));
            }
        }
        let extent = (high[0] - low[0]).max(high[1] - low[1]).max(1e-6);
        // Two texels of margin, so that interpolation at the border finds the empty map.
        let texel_m = extent / (SIZE - 4) as f32;
        let low = low.map(|l| l - 2.0 * texel_m);
        let mut map = Self { across: [u, v], toward_sun, low, texel_m, tops: vec![f32::NEG_INFINITY; SIZE * SIZE] };
        for t in 0..mesh.triangles.len() {
            map.draw(mesh.corners(t));
        }
        map
    }

    /// Position in texels and height towards the sun in metres.
    fn project(&self, point: Vec3) -> (f32, f32, f32) {
        let [u, v] = self.across;
        (
            (point.dot(u) - self.low[0]) / self.texel_m,
            (point.dot(v) - self.low[1]) / self.texel_m,
            point.dot(self.toward_sun),
        )
    }

    fn draw(&mut self, corners: [Vec3; 3]) {
        let [(ax, ay, ah), (bx, by, bh), (cx, cy, ch)] = corners.map(|p| self.project(p));
        let twice_area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay);
        if twice_area.abs() < 1e-9 {
            return;
        }
        let range = |a: f32, b: f32, c: f32| {
            let first = (a.min(b).min(c) - 0.5).ceil().max(0.0) as usize;
            let last = (a.max(b).max(c) - 0.5).floor().min((SIZE - 1) as f32) as usize;
            first..=last
        };
        for y in range(ay, by, cy) {
            for x in range(ax, bx, cx) {
                let (px, py) = (x as f32 + 0.5, y as f32 + 0.5);
                let wb = ((px - ax) * (cy - ay) - (cx - ax) * (py - ay)) / twice_area;
                let wc = ((bx - ax) * (py - ay) - (px - ax) * (by - ay)) / twice_area;
                if wb >= 0.0 && wc >= 0.0 && wb + wc <= 1.0 {
                    let top = &mut self.tops[y * SIZE + x];
                    *top = top.max(ah + (bh - ah) * wb + (ch - ah) * wc);
                }
            }
        }
    }

    /// Share of the sun that reaches a point of the ground, 0 to 1.
    #[inline]
    #[must_use]
    pub fn lit_ground(&self, point: Vec3) -> f32 {
        self.lit(self.project(point))
    }

    /// Share of the sun that reaches a point of the object whose surface normal (unit length) faces the sun, 0 to 1.
    #[inline]
    #[must_use]
    pub fn lit_surface(&self, point: Vec3, normal: Vec3) -> f32 {
        self.lit(self.project(point + normal * (2.0 * BIAS_TEXELS * self.texel_m)))
    }

    /// The four nearest texels vote, weighted by nearness: edges of shadows are smooth and about a texel wide.
    #[inline]
    fn lit(&self, (x, y, height): (f32, f32, f32)) -> f32 {
        let (x, y) = (x - 0.5, y - 0.5);
        let limit = (SIZE - 1) as f32;
        if !(x >= 0.0 && y >= 0.0 && x < limit && y < limit) {
            return 1.0;
        }
        let (i, j) = (x as usize, y as usize);
        let (tx, ty) = (x - i as f32, y - j as f32);
        let at = j * SIZE + i;
        let height = height + BIAS_TEXELS * self.texel_m;
        let lit = |k: usize| f32::from(u8::from(self.tops[k] <= height));
        let top = lit(at) * (1.0 - tx) + lit(at + 1) * tx;
        let bottom = lit(at + SIZE) * (1.0 - tx) + lit(at + SIZE + 1) * tx;
        top * (1.0 - ty) + bottom * ty
    }
}
