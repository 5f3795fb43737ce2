//! An image on a surface, with a chain of half-sized copies (mip levels) averaged in linear light. A lookup names the
//! width of the sample's footprint, so that a pixel integrates the texture under it instead of picking one texel: aliased
//! images cost a reconstruction 2.5 dB.

use glam::{Vec2, Vec3};

use crate::color::{decode_table, linear_rgb_from_srgb, srgb_from_linear_rgb};

/// A mip-mapped sRGB image that repeats. u grows right, v grows down, (0, 0) is the image's upper left corner.
#[derive(Debug, Clone)]
pub struct Texture {
    levels: Vec<Level>,
}

#[derive(Debug, Clone)]
struct Level {
    width: usize,
    height: usize,
    /// sRGB and a byte of padding, so that a texel is one aligned load.
    texels: Vec<[u8; 4]>,
}

impl Texture {
    /// Builds the mip chain of an image of `width` x `height` RGB bytes, row by row. `None` if the length does not match.
    #[must_use]
    pub fn new(width: usize, height: usize, rgb: &[u8]) -> Option<Self> {
        if width == 0 || height == 0 || rgb.len() != width.checked_mul(height)?.checked_mul(3)? {
            return None;
        }
        let texels = rgb.chunks_exact(3).map(|c| [c[0], c[1], c[2], 255]).collect();
        let mut levels = vec![Level { width, height, texels }];
        while let Some(next) = levels.last().and_then(Level::halved) {
            levels.push(next);
        }
        Some(Self { levels })
    }

    /// Width and height of the full image, texels.
    #[must_use]
    pub fn size(&self) -> (usize, usize) {
        self.levels.first().map_or((0, 0), |level| (level.width, level.height))
    }

    /// Linear light at `uv`, filtered over a footprint of 2^`lod` texels of the full image (trilinear).
    #[must_use]
    pub fn sample(&self, uv: Vec2, lod: f32) -> Vec3 {
        let last = self.levels.len() - 1;
        let lod = lod.clamp(0.0, last as f32);
        let fine = lod as usize;
        let weight = lod - fine as f32;
        let color = self.levels[fine].bilinear(uv);
        if weight < 0.01 { color } else { color.lerp(self.levels[(fine + 1).min(last)].bilinear(uv), weight) }
    }
}

impl Level {
    /// The next smaller level: each texel is the mean of the texels it covers; `None` for a single texel.
    fn halved(&self) -> Option<Self> {
        if self.width == 1 && self.height == 1 {
            return None;
        }
        let (width, height) = ((self.width / 2).max(1), (self.height / 2).max(1));
        let mut texels = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                let (rows, columns) = (
                    y * self.height / height..(y + 1) * self.height / height,
                    x * self.width / width..(x + 1) * self.width / width,
                );
                let count = (rows.len() * columns.len()) as f32;
                let sum: Vec3 = rows
                    .flat_map(|row| columns.clone().map(move |column| row * self.width + column))
                    .map(|i| {
                        let [r, g, b, _] = self.texels[i];
                        linear_rgb_from_srgb([r, g, b])
                    })
                    .sum();
                let [r, g, b] = srgb_from_linear_rgb(sum / count);
                texels.push([r, g, b, 255]);
            }
        }
        Some(Self { width, height, texels })
    }

    #[inline]
    fn bilinear(&self, uv: Vec2) -> Vec3 {
        // Texel (0, 0) has its centre at half a texel from the corner.
        let x = (uv.x - uv.x.floor()) * self.width as f32 - 0.5;
        let y = (uv.y - uv.y.floor()) * self.height as f32 - 0.5;
        let (x0, y0) = (x.floor(), y.floor());
        let (tx, ty) = (x - x0, y - y0);
        let wrap = |i: isize, n: usize| if i < 0 { n - 1 } else { (i as usize) % n };
        let (x0, y0) = (x0 as isize, y0 as isize);
        let (xa, xb) = (wrap(x0, self.width), wrap(x0 + 1, self.width));
        let (ya, yb) = (wrap(y0, self.height) * self.width, wrap(y0 + 1, self.height) * self.width);
        let decode = decode_table();
        let fetch = |i: usize| {
            let [r, g, b, _] = self.texels[i];
            Vec3::new(decode[usize::from(r)], decode[usize::from(g)], decode[usize::from(b)])
        };
        let top = fetch(ya + xa).lerp(fetch(ya + xb), tx);
        let bottom = fetch(yb + xa).lerp(fetch(yb + xb), tx);
        top.lerp(bottom, ty)
    }
}

/// log2 for choosing mip levels: exact at powers of two, within 0.09 between, and a few nanoseconds cheaper.
#[inline]
pub(crate) fn log2_approx(x: f32) -> f32 {
    let bits = x.max(1e-30).to_bits();
    let exponent = ((bits >> 23) as i32 - 127) as f32;
    exponent + f32::from_bits((bits & 0x007F_FFFF) | 0x3F80_0000) - 1.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texel_centres_return_their_texel_and_v_grows_downwards() {
        // Red and green above, blue and white below.
        let texture = Texture::new(2, 2, &[255, 0, 0, 0, 255, 0, 0, 0, 255, 255, 255, 255]).expect("sizes match");
        let at = |u, v| srgb_from_linear_rgb(texture.sample(Vec2::new(u, v), 0.0));
        assert_eq!(at(0.25, 0.25), [255, 0, 0]);
        assert_eq!(at(0.75, 0.25), [0, 255, 0]);
        assert_eq!(at(0.25, 0.75), [0, 0, 255]);
        assert_eq!(at(-0.25, 1.75), [255, 255, 255], "the image repeats");
    }

    #[test]
    fn the_coarsest_level_is_the_mean_in_linear_light() {
        let rgb: Vec<u8> = (0..64).flat_map(|i| if (i / 8 + i) % 2 == 0 { [255; 3] } else { [0; 3] }).collect();
        let texture = Texture::new(8, 8, &rgb).expect("sizes match");
        let mean = texture.sample(Vec2::new(0.3, 0.9), 10.0);
        assert!((mean.x - 0.5).abs() < 0.01, "half of the light, not half of the code value: {mean}");
    }

    #[test]
    fn a_length_that_does_not_match_is_refused() {
        assert!(Texture::new(2, 2, &[0; 11]).is_none());
        assert!(Texture::new(0, 2, &[]).is_none());
    }

    #[test]
    fn the_quick_logarithm_is_close() {
        for x in [0.1_f32, 0.5, 1.0, 1.4, 3.0, 1000.0] {
            assert!((log2_approx(x) - x.log2()).abs() < 0.09);
        }
    }
}
