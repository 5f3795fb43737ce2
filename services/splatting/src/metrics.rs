//! Image quality: PSNR and SSIM, in double precision and without tricks. The engine's SSIM is tested against this one.

use crate::ssim::{C1, C2, window};

/// Peak signal-to-noise ratio of a mean squared error of colours in [0, 1], dB; infinite for 0.
pub fn psnr_db(mean_squared_error: f64) -> f64 {
    -10.0 * mean_squared_error.log10()
}

/// PSNR between two images of one size, colours clamped to [0, 1], over the pixels where `mask` is true (all pixels
/// without a mask), dB. `None` where the sizes differ or no pixel counts.
pub fn psnr(a: &[[f32; 3]], b: &[[f32; 3]], mask: Option<&[bool]>) -> Option<f64> {
    if a.len() != b.len() || mask.is_some_and(|m| m.len() != a.len()) {
        return None;
    }
    let (mut sum, mut count) = (0.0, 0_usize);
    for (i, (a, b)) in a.iter().zip(b).enumerate() {
        if mask.is_none_or(|m| m[i]) {
            let clamp = |v: f32| f64::from(v.clamp(0.0, 1.0));
            sum += a.iter().zip(b).map(|(&a, &b)| (clamp(a) - clamp(b)).powi(2)).sum::<f64>();
            count += 3;
        }
    }
    (count > 0).then(|| psnr_db(sum / count as f64))
}

/// Structural similarity of every pixel, mean over channels: 11x11 Gaussian window of sigma 1.5, zeros outside of the
/// image. `None` where a size is not `width` x `height`.
pub fn ssim_map<T: Into<f64> + Copy>(a: &[[T; 3]], b: &[[T; 3]], width: usize, height: usize) -> Option<Vec<f64>> {
    if a.len() != width * height || b.len() != a.len() {
        return None;
    }
    let mut map = vec![0.0; a.len()];
    for channel in 0..3 {
        let x: Vec<f64> = a.iter().map(|c| c[channel].into()).collect();
        let y: Vec<f64> = b.iter().map(|c| c[channel].into()).collect();
        let product = |p: &[f64], q: &[f64]| p.iter().zip(q).map(|(p, q)| p * q).collect::<Vec<f64>>();
        let smooth = |values: &[f64]| blur(values, width, height);
        let (mx, my) = (smooth(&x), smooth(&y));
        let (xx, yy, xy) = (smooth(&product(&x, &x)), smooth(&product(&y, &y)), smooth(&product(&x, &y)));
        for i in 0..map.len() {
            let covariance = xy[i] - mx[i] * my[i];
            let variances = xx[i] - mx[i] * mx[i] + yy[i] - my[i] * my[i];
            let (c1, c2) = (f64::from(C1), f64::from(C2));
            map[i] += (2.0 * mx[i] * my[i] + c1) * (2.0 * covariance + c2)
                / ((mx[i] * mx[i] + my[i] * my[i] + c1) * (variances + c2))
                / 3.0;
        }
    }
    Some(map)
}

/// Mean structural similarity over the pixels where `mask` is true (all without a mask). `None` as for [`ssim_map`] and
/// [`psnr`].
pub fn ssim(a: &[[f32; 3]], b: &[[f32; 3]], width: usize, height: usize, mask: Option<&[bool]>) -> Option<f64> {
    let map = ssim_map(a, b, width, height)?;
    if mask.is_some_and(|m| m.len() != map.len()) {
        return None;
    }
    let counted = map.iter().enumerate().filter(|(i, _)| mask.is_none_or(|m| m[*i]));
    let (sum, count) = counted.fold((0.0, 0_usize), |(sum, count), (_, v)| (sum + v, count + 1));
    (count > 0).then(|| sum / count as f64)
}

/// SSIM over the pixels where `mask` is true, colours clamped as a screen does: as [`ssim`] of the clamped images, but only
/// the part of the image that the pixels' windows reach is looked at. `None` where no pixel counts, or a size differs.
pub fn masked_ssim(a: &[[f32; 3]], b: &[[f32; 3]], mask: &[bool], width: usize, height: usize) -> Option<f64> {
    let reach = window().len() / 2;
    if mask.len() != width * height || a.len() != mask.len() || b.len() != mask.len() {
        return None;
    }
    let inside = || mask.iter().enumerate().filter(|(_, inside)| **inside).map(|(i, _)| (i % width, i / width));
    let left = inside().map(|(x, _)| x).min()?.saturating_sub(reach);
    let top = inside().map(|(_, y)| y).min()?.saturating_sub(reach);
    let right = (inside().map(|(x, _)| x).max()? + reach + 1).min(width);
    let bottom = (inside().map(|(_, y)| y).max()? + reach + 1).min(height);
    let rows = |row: usize| row * width + left..row * width + right;
    let crop = |image: &[[f32; 3]]| -> Vec<[f32; 3]> {
        (top..bottom).flat_map(|row| &image[rows(row)]).map(|color| color.map(|value| value.clamp(0.0, 1.0))).collect()
    };
    let part: Vec<bool> = (top..bottom).flat_map(|row| &mask[rows(row)]).copied().collect();
    ssim(&crop(a), &crop(b), right - left, bottom - top, Some(&part))
}

pub(crate) fn blur(values: &[f64], width: usize, height: usize) -> Vec<f64> {
    let window = window().map(f64::from);
    let radius = window.len() / 2;
    let pass = |from: &[f64], step: usize, position: &dyn Fn(usize) -> (usize, usize)| -> Vec<f64> {
        (0..from.len())
            .map(|i| {
                let (at, length) = position(i);
                window
                    .iter()
                    .enumerate()
                    .filter(|(tap, _)| (radius..length + radius).contains(&(at + tap)))
                    .map(|(tap, weight)| weight * from[i + tap * step - radius * step])
                    .sum()
            })
            .collect()
    };
    let rows = pass(values, 1, &|i| (i % width, width));
    pass(&rows, width, &|i| (i / width, height))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_known_error_gives_the_known_psnr() {
        let a = vec![[0.5; 3]; 4];
        let mut b = a.clone();
        assert_eq!(psnr(&a, &b, None), Some(f64::INFINITY));
        b[0] = [0.6; 3];
        // One of four pixels is off by 0.1: mean squared error 0.0025.
        assert!((psnr(&a, &b, None).unwrap() - 26.0206).abs() < 1e-4);
        let mask = [true, false, false, false];
        assert!((psnr(&a, &b, Some(&mask)).unwrap() - 20.0).abs() < 1e-4);
        assert_eq!(psnr(&a, &b[..3], None), None);
        assert_eq!(psnr(&a, &b, Some(&[false; 4])), None);
    }

    #[test]
    fn ssim_is_one_for_equal_images_and_falls_with_noise() {
        let image: Vec<[f32; 3]> = (0..20 * 15).map(|i| [(i % 7) as f32 / 7.0, (i % 5) as f32 / 5.0, 0.3]).collect();
        assert!((ssim(&image, &image, 20, 15, None).unwrap() - 1.0).abs() < 1e-9);
        let noisy: Vec<[f32; 3]> =
            image.iter().enumerate().map(|(i, c)| c.map(|v| v + if i % 2 == 0 { 0.1 } else { -0.1 })).collect();
        let similarity = ssim(&image, &noisy, 20, 15, None).unwrap();
        assert!(similarity < 0.95 && similarity > 0.0, "{similarity}");
        assert_eq!(ssim(&image, &noisy, 21, 15, None), None);
    }

    fn pattern(width: usize, height: usize, shift: usize) -> Vec<[f32; 3]> {
        (0..width * height).map(|i| [((i + shift) % 7) as f32 / 7.0, (i % 5) as f32 / 5.0, 0.4]).collect()
    }

    #[test]
    fn cropping_to_the_objects_windows_does_not_change_its_ssim() {
        let (width, height) = (40, 30);
        let (a, b) = (pattern(width, height, 0), pattern(width, height, 1));
        let mask: Vec<bool> =
            (0..width * height).map(|i| (12..20).contains(&(i % width)) && (10..15).contains(&(i / width))).collect();
        let whole = ssim(&a, &b, width, height, Some(&mask)).expect("ssim");
        let cropped = masked_ssim(&a, &b, &mask, width, height).expect("ssim");
        assert!((whole - cropped).abs() < 1e-12, "{whole} {cropped}");
        assert_eq!(masked_ssim(&a, &b, &vec![false; mask.len()], width, height), None);
    }
}
