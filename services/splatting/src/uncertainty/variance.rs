//! The depth variance of each pixel, and what a candidate sees of it (Eq. 1-3).
//!
//! One render per candidate gives, per pixel, the accumulated alpha A and the first two moments of depth relative to the
//! depth c of the box centre (A7: squares of whole depths cancel badly in f32):
//! `m1 = sum w (d - c)`, `m2 = sum w (d - c)^2`. The printed variance is not indifferent to c where A < 1, so it is
//! taken back exactly: `sum w d^2 - (sum w d)^2 = m2 - m1^2 + 2 c m1 (1 - A) + c^2 A (1 - A)`.

use super::footprint;
use super::{UncertaintySettings, VarianceMode};
use crate::camera::Camera;
use crate::engine::Moments;
use glam::DVec2;

/// What a candidate sees (Eq. 3).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Uncertainty {
    /// Mean variance of the pixels inside the projected box, m^2.
    pub mean_variance_m2: f64,
    /// Area of the projected box over the image's.
    pub area_fraction: f64,
    /// u_c: the product.
    pub uncertainty: f64,
    /// Mean alpha inside the projected box.
    pub mean_alpha: f64,
    /// Share of those pixels that are transparent.
    pub transparent_fraction: f64,
}

/// Variance of one pixel, m^2. `chord_m` is the length, in depth, of its ray inside the box; pixels with less alpha than
/// `transparent_alpha` know nothing and get the greatest variance: `(B/2)^2` as printed, `chord^2 / 12` (a depth anywhere
/// on the chord, A3) otherwise.
#[must_use]
pub fn pixel_variance(
    mode: VarianceMode,
    (alpha, first, second): (f64, f64, f64),
    offset_m: f64,
    chord_m: f64,
    box_size_m: f64,
    transparent_alpha: f64,
) -> f64 {
    let variance = match mode {
        VarianceMode::Paper if alpha < transparent_alpha => (box_size_m / 2.0).powi(2),
        VarianceMode::Normalised if alpha < transparent_alpha => chord_m * chord_m / 12.0,
        VarianceMode::Paper => {
            second - first * first
                + 2.0 * offset_m * first * (1.0 - alpha)
                + offset_m * offset_m * alpha * (1.0 - alpha)
        }
        VarianceMode::Normalised => second / alpha - (first / alpha).powi(2),
    };
    // Rounding can bring the difference of squares below zero (A7).
    variance.max(0.0)
}

/// The uncertainty of one candidate (Eq. 3), over the pixels inside the projected box.
#[must_use]
pub fn uncertainty(settings: &UncertaintySettings, camera: &Camera, moments: &Moments) -> Uncertainty {
    let &UncertaintySettings { mode, bounding_box, transparent_alpha } = settings;
    let outline = bounding_box.outline(camera);
    let offset_m = f64::from(moments.reference_m);
    let mut sums = Sums::default();
    for (row, first, end) in footprint::covered_pixels(&outline, camera.width, camera.height) {
        for column in first..end {
            let index = row as usize * camera.width as usize + column as usize;
            let (Some(&a), Some(&m1), Some(&m2)) =
                (moments.alpha.get(index), moments.first.get(index), moments.second.get(index))
            else {
                continue;
            };
            let alpha = f64::from(a).clamp(0.0, 1.0);
            let chord_m = if alpha < transparent_alpha {
                let pixel = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5);
                bounding_box.depth_interval(camera, pixel).map_or(0.0, |(enter, leave)| leave - enter)
            } else {
                0.0
            };
            let values = (alpha, f64::from(m1), f64::from(m2));
            sums.variance += pixel_variance(mode, values, offset_m, chord_m, bounding_box.size_m, transparent_alpha);
            sums.alpha += alpha;
            sums.transparent += f64::from(u8::from(alpha < transparent_alpha));
            sums.pixels += 1;
        }
    }
    sums.uncertainty(footprint::area(&outline) / (f64::from(camera.width) * f64::from(camera.height)))
}

/// Sums over the pixels inside the projected box.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Sums {
    /// Of variance, m^2.
    pub variance: f64,
    /// Of alpha.
    pub alpha: f64,
    /// Pixels that are transparent.
    pub transparent: f64,
    /// Pixels.
    pub pixels: u32,
}

impl Sums {
    /// Means, where the box covers this share of the image.
    pub fn uncertainty(&self, area_fraction: f64) -> Uncertainty {
        if self.pixels == 0 {
            return Uncertainty::default();
        }
        let pixels = f64::from(self.pixels);
        let mean_variance_m2 = self.variance / pixels;
        Uncertainty {
            mean_variance_m2,
            area_fraction,
            uncertainty: mean_variance_m2 * area_fraction,
            mean_alpha: self.alpha / pixels,
            transparent_fraction: self.transparent / pixels,
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DVec3, Vec3};

    use super::*;
    use crate::camera::Pose;
    use crate::uncertainty::BoundingBox;

    /// Moments of layers (depth, opacity) from front to back, about `offset`.
    fn layers(layers: &[(f64, f64)], offset: f64) -> (f64, f64, f64) {
        let (mut t, mut m) = (1.0, (0.0, 0.0, 0.0));
        for &(depth, opacity) in layers {
            let (w, d) = (t * opacity, depth - offset);
            m = (m.0 + w, m.1 + w * d, m.2 + w * d * d);
            t *= 1.0 - opacity;
        }
        m
    }

    fn variance(mode: VarianceMode, pixel: &[(f64, f64)], offset: f64) -> f64 {
        pixel_variance(mode, layers(pixel, offset), offset, 0.9, 2.0, 0.1)
    }

    #[test]
    fn one_opaque_surface_is_certain_in_both_modes() {
        for mode in [VarianceMode::Paper, VarianceMode::Normalised] {
            assert!(variance(mode, &[(2.2, 1.0)], 2.5) < 1e-12);
        }
    }

    #[test]
    fn a_half_transparent_surface_is_an_opacity_signal_only_as_printed() {
        // A1: raw, one surface at depth d with opacity A gives A (1 - A) d^2.
        let raw = variance(VarianceMode::Paper, &[(2.2, 0.6)], 2.5);
        assert!((raw - 0.6 * 0.4 * 2.2 * 2.2).abs() < 1e-12, "{raw}");
        assert!(variance(VarianceMode::Normalised, &[(2.2, 0.6)], 2.5) < 1e-12);
    }

    #[test]
    fn two_half_transparent_layers_have_the_variance_of_their_weights() {
        // Weights 0.5 and 0.25 at 2 m and 3 m: normalised 2/3 and 1/3, variance 2/9 m^2.
        let pixel = [(2.0, 0.5), (3.0, 0.5)];
        assert!((variance(VarianceMode::Normalised, &pixel, 2.5) - 2.0 / 9.0).abs() < 1e-12);
        let raw = 0.5 * 4.0 + 0.25 * 9.0 - (0.5 * 2.0 + 0.25 * 3.0f64).powi(2);
        assert!((variance(VarianceMode::Paper, &pixel, 2.5) - raw).abs() < 1e-12);
    }

    #[test]
    fn the_offset_changes_neither_variance() {
        let pixel = [(1.9, 0.3), (2.4, 0.7), (2.9, 0.5)];
        for mode in [VarianceMode::Paper, VarianceMode::Normalised] {
            assert!((variance(mode, &pixel, 0.0) - variance(mode, &pixel, 2.5)).abs() < 1e-12);
        }
    }

    #[test]
    fn rounding_never_makes_a_variance_negative() {
        assert_eq!(pixel_variance(VarianceMode::Normalised, (0.9, 0.3, 0.0999), 2.0, 0.5, 2.0, 0.1), 0.0);
    }

    /// Of one alpha everywhere, all of it at the reference depth.
    fn image(alpha: f32) -> Moments {
        let plane = |value| vec![value; 96 * 72];
        let (first, second) = (plane(0.0), plane(0.0));
        Moments { width: 96, height: 72, reference_m: 3.0, alpha: plane(alpha), first, second }
    }

    #[test]
    fn an_empty_model_has_the_variance_of_not_knowing() {
        let camera =
            Camera::from_hfov(Pose::IDENTITY, 1.204, 96, 72).look_at(Vec3::new(0.0, -3.0, 0.0), Vec3::ZERO, Vec3::Z);
        let cube = BoundingBox { center_m: DVec3::ZERO, size_m: 1.0 };
        let moments = image(0.0);
        let seen = |mode| {
            let settings = UncertaintySettings { mode, bounding_box: cube, transparent_alpha: 0.1 };
            uncertainty(&settings, &camera, &moments)
        };
        let paper = seen(VarianceMode::Paper);
        assert!((paper.mean_variance_m2 - 0.25).abs() < 1e-12 && paper.transparent_fraction == 1.0);
        let ours = seen(VarianceMode::Normalised);
        // Seen face on, most rays cross the whole metre (1/12 m^2); those near the outline cross less.
        assert!(ours.mean_variance_m2 > 0.05 && ours.mean_variance_m2 < 1.0 / 12.0, "{}", ours.mean_variance_m2);
        assert!((ours.uncertainty - ours.mean_variance_m2 * ours.area_fraction).abs() < 1e-15);
        assert!(ours.area_fraction > 0.05 && ours.area_fraction < 0.5 && ours.mean_alpha == 0.0);
    }

    #[test]
    fn an_opaque_plane_through_the_centre_is_certain() {
        let camera =
            Camera::from_hfov(Pose::IDENTITY, 1.204, 96, 72).look_at(Vec3::new(0.0, -3.0, 0.0), Vec3::ZERO, Vec3::Z);
        let cube = BoundingBox { center_m: DVec3::ZERO, size_m: 1.0 };
        for mode in [VarianceMode::Paper, VarianceMode::Normalised] {
            let settings = UncertaintySettings { mode, bounding_box: cube, transparent_alpha: 0.1 };
            let seen = uncertainty(&settings, &camera, &image(1.0));
            assert!(seen.uncertainty.abs() < 1e-12 && seen.mean_alpha == 1.0 && seen.transparent_fraction == 0.0);
        }
    }
}
