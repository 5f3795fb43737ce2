//! A slow, plain renderer and loss in double precision, and the analytic gradient of that loss: the oracle of the
//! engine's images and gradients, and the shortest definition of what they mean. No tiles, no lists, no SIMD.
//!
//! The cuts are the engine's: a contribution below `alpha_min` is dropped, and a 4x4 block of pixels stops behind the
//! first splat after which all its transmittances are below `transmittance_min`. The engine looks for that only every
//! few splats, so it may go a little further: a pixel then differs by less than `transmittance_min` times a colour.

mod gradient;

pub use gradient::gradient;

use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::camera::{Camera, RenderSettings};
use crate::frame::TILE;
use crate::model::{Gaussians, ROW_LOG_SCALE, ROW_OPACITY, ROW_SH, ROWS, SH_REST_MAX, sh_rest_coefficients};
use crate::projection::{ALPHA_MAX, JACOBIAN_MARGIN};
use crate::settings::TrainingSettings;
use crate::sh;
use crate::view::TrainingView;

/// Parameters per Gaussian.
pub const PARAMETERS: usize = ROWS + 3 * SH_REST_MAX;

/// Parameters of one Gaussian: mean, log scales, rotation (x, y, z, w), opacity logit, then spherical harmonics, red,
/// green, blue of each of the sixteen coefficients in turn. Those of bands that are not evaluated count for nothing.
pub type Parameters = [f64; PARAMETERS];

/// How near to a cut an alpha or a transmittance may lie before rounding decides on which side it is.
pub const CUT_MARGIN: f64 = 1e-5;

/// Parameters of a model.
pub fn parameters(gaussians: &Gaussians) -> Vec<Parameters> {
    let one = |(index, g): (usize, crate::Gaussian)| {
        let (m, s, q) = (g.mean.to_array(), g.log_scales.to_array(), g.rotation.to_array());
        let rest = gaussians.sh_rest(index);
        let all = m.iter().chain(&s).chain(&q).chain([&g.opacity_logit]).chain(&g.sh).chain(rest.iter().flatten());
        let mut out = [0.0; PARAMETERS];
        out.iter_mut().zip(all).for_each(|(to, &from)| *to = from.into());
        out
    };
    gaussians.iter().enumerate().map(one).collect()
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
    /// Whether some alpha, or some transmittance of its 4x4 block, lies within [`CUT_MARGIN`] of its cut.
    pub at_cut: bool,
}

/// Renders row by row. `reference_m` is the depth d0 of the moments.
pub fn render(parameters: &[Parameters], camera: &Camera, settings: &RenderSettings, reference_m: f64) -> Vec<Pixel> {
    let splats = splats(parameters, camera, settings);
    let mut pixels = vec![Pixel::default(); camera.pixels()];
    blend(&splats, camera, settings, |index, contributions, at_cut| {
        let pixel = &mut pixels[index];
        pixel.at_cut = at_cut;
        for c in contributions {
            let (splat, weight) = (&splats[c.splat], c.transmittance * c.alpha);
            let offset = splat.depth - reference_m;
            pixel.color += weight * splat.color;
            pixel.alpha += weight;
            pixel.depth += weight * splat.depth;
            pixel.first += weight * offset;
            pixel.second += weight * offset * offset;
        }
    });
    pixels
}

/// A projected Gaussian.
struct Splat {
    /// Index in the model.
    gaussian: usize,
    mean: DVec2,
    /// Inverse covariance [[a, b], [b, c]].
    conic: [f64; 3],
    /// Peak alpha.
    alpha: f64,
    color: DVec3,
    depth: f64,
}

/// What a splat does to a pixel.
struct Contribution {
    splat: usize,
    /// From the splat's mean to the pixel's centre.
    offset: DVec2,
    alpha: f64,
    /// Before the splat.
    transmittance: f64,
}

/// Splats in front of the camera, nearest first.
fn splats(parameters: &[Parameters], camera: &Camera, settings: &RenderSettings) -> Vec<Splat> {
    let project = |(index, p)| Some(Projection::new(p, camera, settings)?.splat(index));
    let mut splats: Vec<Splat> = parameters.iter().enumerate().filter_map(project).collect();
    splats.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    splats
}

/// Calls `visit(pixel, contributions, whether one is at a cut)` for every pixel.
fn blend(
    splats: &[Splat],
    camera: &Camera,
    settings: &RenderSettings,
    mut visit: impl FnMut(usize, &[Contribution], bool),
) {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let (alpha_min, limit) = (f64::from(settings.alpha_min), f64::from(settings.transmittance_min));
    let near = |value: f64, cut: f64| (value - cut).abs() < CUT_MARGIN;
    for block in 0..width.div_ceil(4) * height.div_ceil(4) {
        let corner = (block % width.div_ceil(4) * 4, block / width.div_ceil(4) * 4);
        let at = |i: usize| (corner.0 + i % 4, corner.1 + i / 4);
        let mut transmittance = [1.0; 16];
        let mut at_cut = [false; 16];
        let mut contributions: [Vec<Contribution>; 16] = Default::default();
        for (index, splat) in splats.iter().enumerate() {
            for i in 0..16 {
                let offset = DVec2::new(at(i).0 as f64 + 0.5, at(i).1 as f64 + 0.5) - splat.mean;
                let [a, b, c] = splat.conic;
                let power = a * offset.x * offset.x + 2.0 * b * offset.x * offset.y + c * offset.y * offset.y;
                let alpha = splat.alpha * (-0.5 * power).exp();
                at_cut[i] |= near(alpha, alpha_min);
                if alpha >= alpha_min {
                    contributions[i].push(Contribution {
                        splat: index,
                        offset,
                        alpha,
                        transmittance: transmittance[i],
                    });
                    transmittance[i] *= 1.0 - alpha;
                }
            }
            if transmittance.iter().any(|&t| near(t, limit)) {
                at_cut = [true; 16];
            }
            if transmittance.iter().all(|&t| t < limit) {
                break;
            }
        }
        for i in 0..16 {
            let (x, y) = at(i);
            if x < width && y < height {
                visit(y * width + x, &contributions[i], at_cut[i]);
            }
        }
    }
}

/// A Gaussian in the camera, with what its derivatives need. Symbols as in the engine's projection: camera point
/// p = R (mean - eye); M = R Q diag(s); rows u0 and u1 of U = J M; covariance U Uᵀ plus the low-pass.
struct Projection {
    r: DMat3,
    p: DVec3,
    /// Focal lengths.
    f: DVec2,
    centre: DVec2,
    /// x/z and y/z of the Jacobian: those of a point at most a margin outside of the image.
    j: DVec2,
    q: DQuat,
    s: DVec3,
    m: DMat3,
    u: [DVec3; 2],
    /// Covariance before the low-pass, [[a, b], [b, c]].
    raw: [f64; 3],
    conic: [f64; 3],
    compensation: f64,
    opacity: f64,
    direction: DVec3,
    distance: f64,
    color: DVec3,
}

impl Projection {
    /// `None` in front of the near plane and behind the camera.
    fn new(parameters: &Parameters, camera: &Camera, settings: &RenderSettings) -> Option<Self> {
        let at = |row: usize| DVec3::from_slice(&parameters[row..]);
        let pose = camera.world_from_camera;
        let r = DMat3::from_quat(pose.rotation.as_dquat().normalize()).transpose();
        let from_eye = at(0) - pose.translation.as_dvec3();
        let p = r * from_eye;
        if p.z < f64::from(settings.near_m) {
            return None;
        }
        let f = DVec2::new(camera.fx.into(), camera.fy.into());
        let centre = DVec2::new(camera.cx.into(), camera.cy.into());
        let size = DVec2::new(camera.width.into(), camera.height.into());
        let margin = (f64::from(JACOBIAN_MARGIN) - 1.0) * 0.5 * size;
        let j = (p.truncate() / p.z).clamp((-centre - margin) / f, (size - centre + margin) / f);
        let q = DQuat::from_slice(&parameters[6..]).normalize();
        let s = DVec3::new(parameters[3].exp(), parameters[4].exp(), parameters[5].exp());
        let m = r * DMat3::from_quat(q) * DMat3::from_diagonal(s);
        let row = |i: usize| m.row(i);
        let u = [f.x / p.z * (row(0) - j.x * row(2)), f.y / p.z * (row(1) - j.y * row(2))];
        let raw = [u[0].dot(u[0]), u[0].dot(u[1]), u[1].dot(u[1])];
        let low_pass = f64::from(settings.low_pass_px2);
        let (a, b, c) = (raw[0] + low_pass, raw[1], raw[2] + low_pass);
        let determinant = a * c - b * b;
        let raw_determinant = u[0].cross(u[1]).length_squared();
        let compensation = if settings.opacity_compensation { (raw_determinant / determinant).sqrt() } else { 1.0 };
        let direction = from_eye.normalize();
        let evaluated = 1 + sh_rest_coefficients(settings.sh_degree);
        let bands = sh::basis(direction).into_iter().take(evaluated).enumerate();
        Some(Self {
            color: DVec3::splat(0.5) + bands.map(|(k, value)| value * at(ROW_SH + 3 * k)).sum::<DVec3>(),
            conic: [c / determinant, -b / determinant, a / determinant],
            opacity: logistic(parameters[ROW_OPACITY]),
            distance: from_eye.length(),
            r,
            p,
            f,
            centre,
            j,
            q,
            s,
            m,
            u,
            raw,
            compensation,
            direction,
        })
    }

    fn splat(&self, gaussian: usize) -> Splat {
        Splat {
            gaussian,
            mean: self.f * self.p.truncate() / self.p.z + self.centre,
            conic: self.conic,
            alpha: (self.compensation * self.opacity).min(ALPHA_MAX.into()),
            color: self.color,
            depth: self.p.z,
        }
    }
}

/// The training loss of a view, including its weights.
pub fn loss(parameters: &[Parameters], view: &TrainingView, settings: &TrainingSettings) -> f64 {
    let pixels = render(parameters, view.camera(), &settings.render, 0.0);
    let mut drawn = vec![false; parameters.len()];
    let splats = splats(parameters, view.camera(), &settings.render);
    blend(&splats, view.camera(), &settings.render, |_, contributions, _| {
        contributions.iter().for_each(|c| drawn[splats[c.splat].gaussian] = true);
    });
    let weight = f64::from(settings.isotropic_weight) / (3 * parameters.len().max(1)) as f64;
    let isotropic: f64 = (0..parameters.len()).filter(|&i| drawn[i]).map(|i| anisotropy(&parameters[i]).0).sum();
    let mean = |sum: f64, each: usize| sum / (each * parameters.len().max(1)) as f64;
    let opacity: f64 = parameters.iter().map(|p| logistic(p[ROW_OPACITY])).sum();
    let scale: f64 = parameters.iter().flat_map(|p| &p[ROW_LOG_SCALE..ROW_LOG_SCALE + 3]).map(|s| s.exp()).sum();
    image_loss(&pixels, view, settings).0
        + weight * isotropic
        + f64::from(settings.opacity_weight) * mean(opacity, 1)
        + f64::from(settings.scale_weight) * mean(scale, 3)
}

fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// Σ |s - mean(s)| over a Gaussian's standard deviations, and its gradient by their logarithms.
fn anisotropy(parameters: &Parameters) -> (f64, [f64; 3]) {
    let s: [f64; 3] = std::array::from_fn(|k| parameters[3 + k].exp());
    let mean = s.iter().sum::<f64>() / 3.0;
    let mean_sign = s.iter().map(|s| sign(s - mean)).sum::<f64>() / 3.0;
    (s.iter().map(|s| (s - mean).abs()).sum(), s.map(|s| (sign(s - mean) - mean_sign) * s))
}

/// 1, -1 or 0.
fn sign(x: f64) -> f64 {
    if x == 0.0 { 0.0 } else { x.signum() }
}

/// Gradient of the loss by what a pixel accumulates.
#[derive(Clone, Copy, Default)]
struct PixelGradient {
    color: DVec3,
    alpha: f64,
    depth: f64,
}

/// The loss of what was rendered, and its gradient by every pixel.
fn image_loss(pixels: &[Pixel], view: &TrainingView, settings: &TrainingSettings) -> (f64, Vec<PixelGradient>) {
    let (width, height) = (view.camera().width as usize, view.camera().height as usize);
    let background = settings.render.background.as_dvec3();
    let per = |weight: f32, count: usize| f64::from(weight) / count.max(1) as f64;
    let l1_weight = per(settings.l1_weight, 3 * pixels.len());
    let depth_weight = per(settings.depth_weight, view.with_depth);
    let free_weight = per(settings.free_weight, view.free);
    let mut total = 0.0;
    let mut gradients = vec![PixelGradient::default(); pixels.len()];
    let (mut rendered, mut target, mut is_foreground) = (Vec::new(), Vec::new(), Vec::new());
    for (i, (pixel, gradient)) in pixels.iter().zip(&mut gradients).enumerate() {
        let (x, y) = (i % width, i / width);
        let tile = &view.tiles[y / TILE * width.div_ceil(TILE) + x / TILE];
        let (row, bit, at) = (y % TILE, x % TILE, y % TILE * TILE + x % TILE);
        let is = |mask: &[u16; TILE]| mask[row] >> bit & 1 == 1;
        let foreground = is(&tile.foreground);
        let color = if foreground { pixel.color + (1.0 - pixel.alpha) * background } else { DVec3::splat(0.5) };
        let wanted = DVec3::from_array(std::array::from_fn(|k| f64::from(tile.color[k].0[at])));
        total += l1_weight * (color - wanted).abs().element_sum();
        gradient.color = l1_weight * DVec3::from_array((color - wanted).to_array().map(sign));
        if is(&tile.has_depth) && pixel.alpha > f64::from(crate::loss::DEPTH_ALPHA_MIN) {
            let expected = pixel.depth / pixel.alpha;
            let difference = expected - f64::from(tile.depth.0[at]);
            total += depth_weight * difference.abs();
            gradient.depth = depth_weight * sign(difference) / pixel.alpha;
            gradient.alpha -= gradient.depth * expected;
        }
        if is(&tile.free) {
            total += free_weight * pixel.alpha;
            gradient.alpha += free_weight;
        }
        rendered.push(color.to_array());
        target.push(wanted.to_array());
        is_foreground.push(foreground);
    }
    let similarity = crate::metrics::ssim_map(&rendered, &target, width, height)
        .map_or(1.0, |map| map.iter().sum::<f64>() / map.len() as f64);
    let slopes = gradient::ssim_gradient(&rendered, &target, width, height);
    for (i, gradient) in gradients.iter_mut().enumerate() {
        gradient.color -= f64::from(settings.ssim_weight) * slopes[i];
        if !is_foreground[i] {
            gradient.color = DVec3::ZERO;
        }
        gradient.alpha -= gradient.color.dot(background);
    }
    (total + f64::from(settings.ssim_weight) * (1.0 - similarity), gradients)
}
