//! A slow, plain renderer and loss in double precision: the oracle that the engine's images and gradients are tested
//! against, and the shortest definition of what they mean. No tiles, no early stop, no SIMD; derivatives are central
//! differences.

use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::camera::{Camera, RenderSettings};
use crate::frame::TILE;
use crate::model::{Gaussians, ROWS, SH_C0};
use crate::projection::{ALPHA_MAX, JACOBIAN_MARGIN};
use crate::settings::TrainingSettings;
use crate::view::TrainingView;

/// Parameters of one Gaussian: mean, log scales, rotation (x, y, z, w), opacity logit, SH.
pub type Parameters = [f64; ROWS];

/// Parameters of a model.
pub fn parameters(gaussians: &Gaussians) -> Vec<Parameters> {
    gaussians
        .iter()
        .map(|g| {
            let (m, s, q) = (g.mean.as_dvec3(), g.log_scales.as_dvec3(), g.rotation.as_dquat());
            let sh = g.sh.map(f64::from);
            [m.x, m.y, m.z, s.x, s.y, s.z, q.x, q.y, q.z, q.w, g.opacity_logit.into(), sh[0], sh[1], sh[2]]
        })
        .collect()
}

/// What a pixel accumulates.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pixel {
    /// Σ w colour, before the background.
    pub color: DVec3,
    /// Σ w.
    pub alpha: f64,
    /// Σ w d.
    pub depth: f64,
    /// Σ w (d - d0).
    pub first: f64,
    /// Σ w (d - d0)².
    pub second: f64,
    /// Whether some alpha lies so near to the cut that rounding decides if it counts.
    pub at_cut: bool,
}

struct Splat {
    mean: DVec2,
    conic: [f64; 3],
    alpha: f64,
    color: DVec3,
    depth: f64,
}

/// Renders row by row. `reference_m` is the depth d0 of the moments.
pub fn render(parameters: &[Parameters], camera: &Camera, settings: &RenderSettings, reference_m: f64) -> Vec<Pixel> {
    let mut splats: Vec<Splat> = parameters.iter().filter_map(|p| project(p, camera, settings)).collect();
    splats.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    let alpha_min = f64::from(settings.alpha_min);
    (0..camera.pixels())
        .map(|i| {
            let (x, y) = (i % camera.width as usize, i / camera.width as usize);
            let centre = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            let mut pixel = Pixel::default();
            let mut transmittance = 1.0;
            for splat in &splats {
                let d = centre - splat.mean;
                let [a, b, c] = splat.conic;
                let alpha = splat.alpha * (-0.5 * (a * d.x * d.x + 2.0 * b * d.x * d.y + c * d.y * d.y)).exp();
                pixel.at_cut |= (alpha / alpha_min - 1.0).abs() < 1e-4 && transmittance > 1e-3;
                if alpha < alpha_min {
                    continue;
                }
                let weight = transmittance * alpha;
                let offset = splat.depth - reference_m;
                pixel.color += weight * splat.color;
                pixel.depth += weight * splat.depth;
                pixel.first += weight * offset;
                pixel.second += weight * offset * offset;
                transmittance -= weight;
            }
            pixel.alpha = 1.0 - transmittance;
            pixel
        })
        .collect()
}

fn project(p: &Parameters, camera: &Camera, settings: &RenderSettings) -> Option<Splat> {
    let pose = camera.world_from_camera;
    let camera_from_world = DMat3::from_quat(pose.rotation.as_dquat().normalize()).transpose();
    let point = camera_from_world * (DVec3::new(p[0], p[1], p[2]) - pose.translation.as_dvec3());
    if point.z < f64::from(settings.near_m) {
        return None;
    }
    let (fx, fy) = (f64::from(camera.fx), f64::from(camera.fy));
    let (cx, cy) = (f64::from(camera.cx), f64::from(camera.cy));
    let mean = DVec2::new(fx * point.x / point.z + cx, fy * point.y / point.z + cy);
    // The Jacobian is that of a point at most a margin outside of the image.
    let clamped = |ratio: f64, size: u32, centre: f64, focal: f64| {
        let margin = (f64::from(JACOBIAN_MARGIN) - 1.0) * 0.5 * f64::from(size);
        ratio.clamp((-centre - margin) / focal, (f64::from(size) - centre + margin) / focal)
    };
    let jx = clamped(point.x / point.z, camera.width, cx, fx);
    let jy = clamped(point.y / point.z, camera.height, cy, fy);
    let rotation = DMat3::from_quat(DQuat::from_xyzw(p[6], p[7], p[8], p[9]).normalize());
    let scales = DMat3::from_diagonal(DVec3::new(p[3].exp(), p[4].exp(), p[5].exp()));
    let m = (camera_from_world * rotation * scales).transpose();
    let u0 = fx / point.z * (m.x_axis - jx * m.z_axis);
    let u1 = fy / point.z * (m.y_axis - jy * m.z_axis);
    let (a, b, c) = (u0.dot(u0), u0.dot(u1), u1.dot(u1));
    let low_pass = f64::from(settings.low_pass_px2);
    let determinant = (a + low_pass) * (c + low_pass) - b * b;
    let compensation =
        if settings.opacity_compensation { (u0.cross(u1).length_squared() / determinant).sqrt() } else { 1.0 };
    let alpha = (compensation / (1.0 + (-p[10]).exp())).min(f64::from(ALPHA_MAX));
    Some(Splat {
        mean,
        conic: [(c + low_pass) / determinant, -b / determinant, (a + low_pass) / determinant],
        alpha,
        color: DVec3::splat(0.5) + f64::from(SH_C0) * DVec3::new(p[11], p[12], p[13]),
        depth: point.z,
    })
}

/// The training loss of a view, including its weights.
pub fn loss(parameters: &[Parameters], view: &TrainingView, settings: &TrainingSettings) -> f64 {
    let camera = view.camera();
    let (width, height) = (camera.width as usize, camera.height as usize);
    let pixels = render(parameters, camera, &settings.render, 0.0);
    let background = settings.render.background.as_dvec3();
    let tiles_x = width.div_ceil(TILE);
    let (mut rendered, mut target) = (Vec::new(), Vec::new());
    let (mut l1, mut depth, mut free) = (0.0, 0.0, 0.0);
    for (i, pixel) in pixels.iter().enumerate() {
        let (x, y) = (i % width, i / width);
        let tile = &view.tiles[y / TILE * tiles_x + x / TILE];
        let (row, bit, at) = (y % TILE, x % TILE, y % TILE * TILE + x % TILE);
        let is = |mask: &[u16; TILE]| mask[row] >> bit & 1 == 1;
        let color =
            if is(&tile.foreground) { pixel.color + (1.0 - pixel.alpha) * background } else { DVec3::splat(0.5) };
        let wanted = DVec3::from_array(std::array::from_fn(|k| f64::from(tile.color[k].0[at])));
        l1 += (color - wanted).abs().element_sum();
        if is(&tile.has_depth) && pixel.alpha > f64::from(crate::loss::DEPTH_ALPHA_MIN) {
            depth += (pixel.depth / pixel.alpha - f64::from(tile.depth.0[at])).abs();
        }
        if is(&tile.free) {
            free += pixel.alpha;
        }
        rendered.push(color.to_array());
        target.push(wanted.to_array());
    }
    let isotropic: f64 = parameters
        .iter()
        .map(|p| {
            let scales = [p[3].exp(), p[4].exp(), p[5].exp()];
            let mean = scales.iter().sum::<f64>() / 3.0;
            scales.iter().map(|s| (s - mean).abs()).sum::<f64>()
        })
        .sum();
    let opacity: f64 = parameters.iter().map(|p| 1.0 / (1.0 + (-p[10]).exp())).sum();
    let scale: f64 = parameters.iter().flat_map(|p| &p[3..6]).map(|s| s.exp()).sum();
    let similarity = crate::metrics::ssim_map(&rendered, &target, width, height)
        .map_or(1.0, |map| map.iter().sum::<f64>() / map.len() as f64);
    let per = |sum: f64, count: usize| sum / count.max(1) as f64;
    f64::from(settings.l1_weight) * per(l1, 3 * pixels.len())
        + f64::from(settings.ssim_weight) * (1.0 - similarity)
        + f64::from(settings.depth_weight) * per(depth, view.with_depth)
        + f64::from(settings.free_weight) * per(free, view.free)
        + f64::from(settings.isotropic_weight) * per(isotropic, 3 * parameters.len())
        + f64::from(settings.opacity_weight) * per(opacity, parameters.len())
        + f64::from(settings.scale_weight) * per(scale, 3 * parameters.len())
}
