//! The gradient of the reference's loss by every parameter, by hand: the chain rule from pixels back to Gaussians.

use glam::{DMat2, DMat3, DVec2, DVec3, DVec4};

use super::{
    PARAMETERS, Parameters, PixelGradient, Projection, Splat, anisotropy, blend, image_loss, logistic, render, splats,
};
use crate::model::{ROW_LOG_SCALE, ROW_MEAN, ROW_OPACITY, ROW_ROTATION, ROW_SH, sh_rest_coefficients};
use crate::projection::ALPHA_MAX;
use crate::settings::TrainingSettings;
use crate::sh;
use crate::ssim::{C1, C2};
use crate::view::TrainingView;

/// Gradient by what a splat is.
#[derive(Clone, Copy)]
struct SplatGradient {
    mean: DVec2,
    conic: DMat2,
    alpha: f64,
    color: DVec3,
    depth: f64,
    drawn: bool,
}

/// Gradient of [`super::loss`] by every parameter. Cuts and clamps count as constants, as everywhere in the field.
pub fn gradient(parameters: &[Parameters], view: &TrainingView, settings: &TrainingSettings) -> Vec<Parameters> {
    let camera = view.camera();
    let pixels = render(parameters, camera, &settings.render, 0.0);
    let (_, upstream) = image_loss(&pixels, view, settings);
    let splats = splats(parameters, camera, &settings.render);
    let zero = SplatGradient {
        mean: DVec2::ZERO,
        conic: DMat2::ZERO,
        alpha: 0.0,
        color: DVec3::ZERO,
        depth: 0.0,
        drawn: false,
    };
    let mut by_splat = vec![zero; splats.len()];
    blend(&splats, camera, &settings.render, |pixel, contributions, _| {
        // Σ weight * value of everything behind; value is what one unit of weight does to the loss.
        let mut behind = 0.0;
        for c in contributions.iter().rev() {
            let (splat, out) = (&splats[c.splat], &mut by_splat[c.splat]);
            let PixelGradient { color, alpha, depth } = upstream[pixel];
            let value = color.dot(splat.color) + depth * splat.depth + alpha;
            let weight = c.transmittance * c.alpha;
            let d_alpha = c.transmittance * value - behind / (1.0 - c.alpha);
            behind += weight * value;
            // alpha = peak * exp(-½ offsetᵀ conic offset), and the offset falls as the mean grows.
            let h = d_alpha * c.alpha;
            out.alpha += h / splat.alpha;
            out.mean += h * (symmetric(splat.conic) * c.offset);
            out.conic += DMat2::from_cols(c.offset * c.offset.x, c.offset * c.offset.y) * (-0.5 * h);
            out.color += weight * color;
            out.depth += weight * depth;
            out.drawn = true;
        }
    });
    let mut out = vec![[0.0; PARAMETERS]; parameters.len()];
    for (splat, gradient) in splats.iter().zip(&by_splat).filter(|(_, g)| g.drawn) {
        let index = splat.gaussian;
        if let Some(projection) = Projection::new(&parameters[index], camera, &settings.render) {
            out[index] = projection.backward(&parameters[index], splat, gradient, settings);
        }
        let weight = f64::from(settings.isotropic_weight) / (3 * parameters.len()) as f64;
        for (to, slope) in out[index][ROW_LOG_SCALE..].iter_mut().zip(anisotropy(&parameters[index]).1) {
            *to += weight * slope;
        }
    }
    let per = |weight: f32, each: usize| f64::from(weight) / (each * parameters.len().max(1)) as f64;
    for (out, parameters) in out.iter_mut().zip(parameters) {
        let opacity = logistic(parameters[ROW_OPACITY]);
        out[ROW_OPACITY] += per(settings.opacity_weight, 1) * opacity * (1.0 - opacity);
        for k in ROW_LOG_SCALE..ROW_LOG_SCALE + 3 {
            out[k] += per(settings.scale_weight, 3) * parameters[k].exp();
        }
    }
    out
}

/// [[a, b], [b, c]]
fn symmetric([a, b, c]: [f64; 3]) -> DMat2 {
    DMat2::from_cols(DVec2::new(a, b), DVec2::new(b, c))
}

impl Projection {
    /// From the gradient by a splat to that by its Gaussian's parameters.
    fn backward(
        &self,
        parameters: &Parameters,
        splat: &Splat,
        d: &SplatGradient,
        settings: &TrainingSettings,
    ) -> Parameters {
        let Self { r, p, f, j, s, m, u, .. } = *self;
        let mut out = [0.0; PARAMETERS];

        // Covariance: K = Σ⁻¹, so dΣ = -K dK K; and the peak alpha's sqrt(det before / det after the low-pass).
        let conic = symmetric(self.conic);
        let mut d_covariance = -(conic * d.conic * conic);
        let d_peak = if self.compensation * self.opacity < f64::from(ALPHA_MAX) { d.alpha } else { 0.0 };
        if settings.render.opacity_compensation {
            d_covariance += (symmetric(self.raw).inverse() - conic) * (0.5 * d_peak * splat.alpha);
        }
        out[ROW_OPACITY] = d_peak * self.compensation * self.opacity * (1.0 - self.opacity);

        // Σ = U Uᵀ, dU = 2 dΣ U; and U = J M.
        let du0 = 2.0 * (d_covariance.x_axis.x * u[0] + d_covariance.x_axis.y * u[1]);
        let du1 = 2.0 * (d_covariance.y_axis.x * u[0] + d_covariance.y_axis.y * u[1]);
        let (gain_x, gain_y) = (f.x / p.z, f.y / p.z);
        let d_m = DMat3::from_cols(gain_x * du0, gain_y * du1, -(gain_x * j.x * du0 + gain_y * j.y * du1)).transpose();
        let d_j = -DVec2::new(gain_x * m.row(2).dot(du0), gain_y * m.row(2).dot(du1));

        // The camera point: pixel position, the Jacobian where it is not clamped, U ~ 1/z, depth.
        let ratio = p.truncate() / p.z;
        let free = DVec2::new(f64::from(ratio.x == j.x), f64::from(ratio.y == j.y));
        let d_ratio = f * d.mean + free * d_j;
        let d_z = d.depth - (u[0].dot(du0) + u[1].dot(du1)) / p.z - d_ratio.dot(ratio) / p.z;
        let mut d_mean = r.transpose() * (d_ratio / p.z).extend(d_z);

        // M = R Q diag(s)
        let d_qs = r.transpose() * d_m;
        let rotation = DMat3::from_quat(self.q);
        for k in 0..3 {
            out[ROW_LOG_SCALE + k] = s[k] * d_qs.col(k).dot(rotation.col(k));
        }
        let d_rotation = d_qs * DMat3::from_diagonal(s);
        let q = DVec4::from_array(self.q.to_array());
        let d_q = DVec4::from_array(
            rotation_slopes(q).map(|slope| (0..3).map(|k| slope.col(k).dot(d_rotation.col(k))).sum::<f64>()),
        );
        let length = DVec4::from_slice(&parameters[ROW_ROTATION..]).length();
        out[ROW_ROTATION..ROW_OPACITY].copy_from_slice(&((d_q - q * q.dot(d_q)) / length).to_array());

        // Colour, and the direction that it depends on.
        let mut d_direction = DVec3::ZERO;
        let (basis, slopes) = (sh::basis(self.direction), basis_slopes(self.direction));
        for k in 0..=sh_rest_coefficients(settings.render.sh_degree) {
            let row = ROW_SH + 3 * k;
            out[row..row + 3].copy_from_slice(&(basis[k] * d.color).to_array());
            d_direction += slopes[k] * DVec3::from_slice(&parameters[row..]).dot(d.color);
        }
        d_mean += d_direction.reject_from_normalized(self.direction) / self.distance;
        out[ROW_MEAN..ROW_LOG_SCALE].copy_from_slice(&d_mean.to_array());
        out
    }
}

/// Derivatives of the rotation matrix by x, y, z, w of its unit quaternion.
fn rotation_slopes(q: DVec4) -> [DMat3; 4] {
    let DVec4 { x, y, z, w } = q;
    let rows = |a: [f64; 3], b: [f64; 3], c: [f64; 3]| DMat3::from_cols(a.into(), b.into(), c.into()).transpose() * 2.0;
    [
        rows([0.0, y, z], [y, -2.0 * x, -w], [z, w, -2.0 * x]),
        rows([-2.0 * y, x, w], [x, 0.0, z], [-w, z, -2.0 * y]),
        rows([-2.0 * z, -w, x], [w, -2.0 * z, y], [x, y, 0.0]),
        rows([0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]),
    ]
}

/// Gradients of the sixteen basis functions, as polynomials, by the coordinates of the direction.
fn basis_slopes(direction: DVec3) -> [DVec3; 16] {
    let DVec3 { x, y, z } = direction;
    let ([d, e, g], [h, i, k, l, n]) = (sh::C2, sh::C3);
    let v = DVec3::new;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        DVec3::ZERO,
        v(0.0, -sh::C1, 0.0),
        v(0.0, 0.0, sh::C1),
        v(-sh::C1, 0.0, 0.0),
        d * v(y, x, 0.0),
        -d * v(0.0, z, y),
        e * v(-2.0 * x, -2.0 * y, 4.0 * z),
        -d * v(z, 0.0, x),
        g * v(2.0 * x, -2.0 * y, 0.0),
        -h * v(6.0 * x * y, 3.0 * (xx - yy), 0.0),
        i * v(y * z, x * z, x * y),
        -k * v(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z),
        l * v(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * (xx + yy)),
        -k * v(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z),
        n * v(2.0 * x * z, -2.0 * y * z, xx - yy),
        -h * v(3.0 * (xx - yy), -6.0 * x * y, 0.0),
    ]
}

/// Gradient of the mean SSIM of two images by the first. The windowed mean is its own adjoint, so with
/// S(E[x], E[x²], E[xt]) it is E[∂S/∂E[x]] + 2 x E[∂S/∂E[x²]] + t E[∂S/∂E[xt]].
pub(super) fn ssim_gradient(a: &[[f64; 3]], b: &[[f64; 3]], width: usize, height: usize) -> Vec<DVec3> {
    let (c1, c2) = (f64::from(C1), f64::from(C2));
    let mut out = vec![DVec3::ZERO; a.len()];
    for channel in 0..3 {
        let x: Vec<f64> = a.iter().map(|c| c[channel]).collect();
        let t: Vec<f64> = b.iter().map(|c| c[channel]).collect();
        let mean = |values: &[f64]| crate::metrics::blur(values, width, height);
        let product = |p: &[f64], q: &[f64]| mean(&p.iter().zip(q).map(|(p, q)| p * q).collect::<Vec<f64>>());
        let (mx, mt, xx, tt, xt) = (mean(&x), mean(&t), product(&x, &x), product(&t, &t), product(&x, &t));
        let mut slopes = [vec![0.0; x.len()], vec![0.0; x.len()], vec![0.0; x.len()]];
        for i in 0..x.len() {
            let (a1, a2) = (2.0 * mx[i] * mt[i] + c1, 2.0 * (xt[i] - mx[i] * mt[i]) + c2);
            let (b1, b2) = (mx[i].powi(2) + mt[i].powi(2) + c1, xx[i] - mx[i].powi(2) + tt[i] - mt[i].powi(2) + c2);
            let value = a1 * a2 / (b1 * b2);
            slopes[1][i] = -value / b2;
            slopes[2][i] = 2.0 * a1 / (b1 * b2);
            let through_a1_and_b1 = 2.0 * mt[i] * a2 / (b1 * b2) - 2.0 * mx[i] * value / b1;
            slopes[0][i] = through_a1_and_b1 - 2.0 * mx[i] * slopes[1][i] - mt[i] * slopes[2][i];
        }
        let [by_x, by_xx, by_xt] = slopes.map(|slope| mean(&slope));
        for i in 0..x.len() {
            out[i][channel] = (by_x[i] + 2.0 * x[i] * by_xx[i] + t[i] * by_xt[i]) / (3 * x.len()) as f64;
        }
    }
    out
}
