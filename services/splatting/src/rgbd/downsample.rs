//! Images at training size: colour by the box mean, depth by the nearest of the box.
//!
//! Averaging depths across an edge would invent a surface between the two, so a box whose depths spread by more than
//! [`DEPTH_SPREAD`] has no depth at all.

/// A box whose depths spread by more than this share of the smallest holds an edge.
pub const DEPTH_SPREAD: f32 = 0.05;

/// Why an image cannot be brought to training size.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DownsampleError {
    /// The sizes do not divide.
    #[error(
        "an image of {width}x{height} pixels cannot be brought to {to_width}x{to_height}: both sides must shrink by the \
         same whole number (set model.width and model.height)"
    )]
    Size {
        /// Width of the image.
        width: u32,
        /// Height of the image.
        height: u32,
        /// Width of training images.
        to_width: u32,
        /// Height of training images.
        to_height: u32,
    },
    /// The data do not fit the size.
    #[error("an image of {pixels} pixels came with {colors} colour bytes and {depths} depths")]
    Length {
        /// Width times height.
        pixels: usize,
        /// Bytes of colour found.
        colors: usize,
        /// Depths found.
        depths: usize,
    },
}

/// The whole number by which both sides shrink.
///
/// # Errors
/// [`DownsampleError::Size`] where there is none.
pub fn factor(width: u32, height: u32, to_width: u32, to_height: u32) -> Result<u32, DownsampleError> {
    let error = DownsampleError::Size { width, height, to_width, to_height };
    if to_width == 0 || to_height == 0 || width < to_width {
        return Err(error);
    }
    let factor = width / to_width;
    if factor * to_width == width && factor * to_height == height { Ok(factor) } else { Err(error) }
}

/// An image at training size, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct SmallImage {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Red, green, blue of each pixel in [0, 1] (sRGB, not linearised).
    pub rgb: Vec<[f32; 3]>,
    /// Centre z of each pixel, metres; 0 = no measurement.
    pub depth_m: Vec<f32>,
}

/// Shrinks an image by `factor`: `rgb` holds 3 bytes a pixel, `depth_m` metres (0 = no measurement).
///
/// # Errors
/// [`DownsampleError::Length`] where the data do not fit the size.
pub fn downsample(
    width: u32,
    height: u32,
    rgb: &[u8],
    depth_m: &[f32],
    factor: u32,
) -> Result<SmallImage, DownsampleError> {
    let (w, h, k) = (width as usize, height as usize, factor.max(1) as usize);
    if rgb.len() != w * h * 3 || depth_m.len() != w * h {
        return Err(DownsampleError::Length { pixels: w * h, colors: rgb.len(), depths: depth_m.len() });
    }
    let (small_w, small_h) = (w / k, h / k);
    let scale = 1.0 / (255.0 * (k * k) as f32);
    let mut small = SmallImage {
        width: small_w as u32,
        height: small_h as u32,
        rgb: Vec::with_capacity(small_w * small_h),
        depth_m: Vec::with_capacity(small_w * small_h),
    };
    for row in 0..small_h {
        for column in 0..small_w {
            let mut sum = [0u32; 3];
            let (mut least, mut greatest) = (f32::INFINITY, 0.0f32);
            for y in row * k..(row + 1) * k {
                for x in column * k..(column + 1) * k {
                    let index = y * w + x;
                    for (s, &byte) in sum.iter_mut().zip(&rgb[index * 3..index * 3 + 3]) {
                        *s += u32::from(byte);
                    }
                    // A hole counts as zero, so that a box with a hole has no depth.
                    let depth = if depth_m[index].is_finite() { depth_m[index].max(0.0) } else { 0.0 };
                    least = least.min(depth);
                    greatest = greatest.max(depth);
                }
            }
            small.rgb.push(sum.map(|s| s as f32 * scale));
            small.depth_m.push(if greatest - least > DEPTH_SPREAD * least { 0.0 } else { least });
        }
    }
    Ok(small)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colour_is_the_mean_and_depth_the_nearest() {
        let rgb = [0, 100, 255, 10, 100, 255, 20, 100, 255, 30, 100, 253];
        let small = downsample(2, 2, &rgb, &[2.0, 2.05, 2.02, 2.01], 2).unwrap();
        assert_eq!((small.width, small.height), (1, 1));
        let expected = [15.0, 100.0, 254.5].map(|c: f32| c / 255.0);
        for (found, expected) in small.rgb[0].iter().zip(expected) {
            assert!((found - expected).abs() < 1e-6);
        }
        assert_eq!(small.depth_m, [2.0]);
    }

    #[test]
    fn an_edge_or_a_hole_has_no_depth() {
        let rgb = [7; 12];
        assert_eq!(downsample(2, 2, &rgb, &[2.0, 2.0, 2.0, 2.11], 2).unwrap().depth_m, [0.0], "spread 5.5 %");
        assert_eq!(downsample(2, 2, &rgb, &[2.0, 2.0, 2.0, 2.09], 2).unwrap().depth_m, [2.0], "spread 4.5 %");
        assert_eq!(downsample(2, 2, &rgb, &[2.0, 0.0, 2.0, 2.0], 2).unwrap().depth_m, [0.0]);
        assert_eq!(downsample(2, 2, &rgb, &[2.0, f32::NAN, 2.0, 2.0], 2).unwrap().depth_m, [0.0]);
    }

    #[test]
    fn sizes_must_divide_alike() {
        assert_eq!(factor(640, 480, 320, 240), Ok(2));
        assert_eq!(factor(96, 72, 96, 72), Ok(1));
        assert!(factor(640, 480, 320, 200).is_err());
        assert!(factor(640, 480, 300, 225).is_err());
        assert!(factor(160, 120, 320, 240).is_err());
        assert!(downsample(2, 2, &[0; 11], &[0.0; 4], 1).is_err());
    }
}
