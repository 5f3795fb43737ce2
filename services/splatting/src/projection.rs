//! Projection of 16 Gaussians at a time: camera coordinates, 2-D covariance, conic, extent.
//!
//! One function serves the renderer and the backward pass, which recomputes rather than stores its intermediates.
//! Symbols: camera point p = R (mean - eye); M = R Rot diag(scales); U = J M with the Jacobian J of the perspective
//! map, so that the 2-D covariance is U Uᵀ plus the low-pass.

use glam::{Mat3, Vec3};

use crate::camera::{Camera, RenderSettings};
use crate::model::{Block, Lanes, ROW_LOG_SCALE, ROW_MEAN, ROW_OPACITY, ROW_ROTATION, ROW_SH, SH_C0};
use crate::simd::{Simd, build};

/// Largest alpha of one splat. Clamped at projection, once per splat, instead of once per pixel.
pub(crate) const ALPHA_MAX: f32 = 0.999;
/// The Jacobian is taken at most this far outside of the image, in units of the half field of view's tangent.
pub(crate) const JACOBIAN_MARGIN: f32 = 1.3;
/// Splats whose 2-D covariance has a determinant beyond this (px⁴) are broken parameters, not surfaces.
const DETERMINANT_MAX: f32 = 1e20;
/// Bound on positions (px), colours and depths that may enter a sum.
pub(crate) const VALUE_MAX: f32 = 1e9;

/// What every lane needs from the camera and the settings.
#[derive(Clone, Copy)]
pub(crate) struct View {
    /// `camera_from_world`, row-major.
    pub rotation: [[f32; 3]; 3],
    pub eye: Vec3,
    pub fx: f32,
    pub fy: f32,
    pub cx: f32,
    pub cy: f32,
    pub width: f32,
    pub height: f32,
    /// Limits of x/z and y/z for the Jacobian: (low x, high x, low y, high y).
    limits: [f32; 4],
    low_pass: f32,
    compensation: bool,
    alpha_min: f32,
    near: f32,
}

impl View {
    pub(crate) fn new(camera: &Camera, settings: &RenderSettings) -> Self {
        let m = Mat3::from_quat(camera.world_from_camera.rotation.normalize());
        // The columns of world_from_camera are the rows of its inverse.
        let rotation = [m.x_axis.to_array(), m.y_axis.to_array(), m.z_axis.to_array()];
        let (width, height) = (camera.width as f32, camera.height as f32);
        let limits = |size: f32, centre: f32, focal: f32| {
            let margin = (JACOBIAN_MARGIN - 1.0) * 0.5 * size;
            ((-centre - margin) / focal, (size - centre + margin) / focal)
        };
        let (low_x, high_x) = limits(width, camera.cx, camera.fx);
        let (low_y, high_y) = limits(height, camera.cy, camera.fy);
        Self {
            rotation,
            eye: camera.world_from_camera.translation,
            fx: camera.fx,
            fy: camera.fy,
            cx: camera.cx,
            cy: camera.cy,
            width,
            height,
            limits: [low_x, high_x, low_y, high_y],
            low_pass: settings.low_pass_px2,
            compensation: settings.opacity_compensation,
            alpha_min: settings.alpha_min.max(1e-6),
            near: settings.near_m.max(1e-6),
        }
    }

    /// Limits of x/z and y/z for the Jacobian: low x, high x, low y, high y.
    pub(crate) fn limits(&self) -> [f32; 4] {
        self.limits
    }

    /// Least alpha that counts.
    pub(crate) fn alpha_min(&self) -> f32 {
        self.alpha_min
    }

    /// Least depth that is drawn, metres.
    pub(crate) fn near(&self) -> f32 {
        self.near
    }

    /// Variance added to both axes of the screen, px².
    pub(crate) fn low_pass(&self) -> f32 {
        self.low_pass
    }

    /// Whether opacity is compensated for the low-pass.
    pub(crate) fn compensated(&self) -> bool {
        self.compensation
    }
}

/// Sixteen projected Gaussians with everything the backward pass needs again.
pub(crate) struct Projected<S: Simd> {
    /// Lanes that are drawn: in front, finite, visible enough, and touching the image.
    pub visible: S::M,
    /// Camera coordinates.
    pub x: S::F,
    pub y: S::F,
    pub z: S::F,
    pub inv_z: S::F,
    /// Clamped x/z and y/z of the Jacobian, and whether they are unclamped.
    pub jx: S::F,
    pub jy: S::F,
    pub free_x: S::M,
    pub free_y: S::M,
    /// M, row-major: m[i][k].
    pub m: [[S::F; 3]; 3],
    /// Rows of U.
    pub u: [[S::F; 3]; 2],
    /// Covariance before the low-pass (a, b, c) and its determinant.
    pub raw: [S::F; 3],
    pub raw_det: S::F,
    /// Inverse of the covariance after the low-pass.
    pub conic: [S::F; 3],
    /// Pixel position of the mean.
    pub mean: [S::F; 2],
    pub opacity: S::F,
    /// Whether alpha is below its clamp, so that gradients pass.
    pub unclamped: S::M,
    /// log2 of the peak alpha.
    pub log2_alpha: S::F,
    /// log2(alpha / alpha_min): the exponent at which a pixel no longer counts.
    pub threshold: S::F,
    pub color: [S::F; 3],
    /// First and last pixel index along x and y, not yet truncated to integers.
    pub bounds: [S::F; 4],
}

/// Rotation matrix entries of unit quaternions, row-major.
#[inline(always)]
pub(crate) fn rotation_matrix<S: Simd>(s: S, q: &[S::F; 4]) -> [[S::F; 3]; 3] {
    let [x, y, z, w] = *q;
    let two = s.splat(2.0);
    let one = s.splat(1.0);
    let (x2, y2, z2) = (s.mul(x, two), s.mul(y, two), s.mul(z, two));
    let (xx, yy, zz) = (s.mul(x, x2), s.mul(y, y2), s.mul(z, z2));
    let (xy, xz, yz) = (s.mul(x, y2), s.mul(x, z2), s.mul(y, z2));
    let (wx, wy, wz) = (s.mul(w, x2), s.mul(w, y2), s.mul(w, z2));
    [
        [s.sub(one, s.add(yy, zz)), s.sub(xy, wz), s.add(xz, wy)],
        [s.add(xy, wz), s.sub(one, s.add(xx, zz)), s.sub(yz, wx)],
        [s.sub(xz, wy), s.add(yz, wx), s.sub(one, s.add(xx, yy))],
    ]
}

#[inline(always)]
fn row<S: Simd>(s: S, block: &Block, index: usize) -> S::F {
    s.load(&block.0[index].0)
}

#[inline(always)]
fn dot3<S: Simd>(s: S, a: &[S::F; 3], b: &[S::F; 3]) -> S::F {
    s.fma(a[0], b[0], s.fma(a[1], b[1], s.mul(a[2], b[2])))
}

/// What a projection needs of sixteen Gaussians, whatever the view.
pub(crate) struct Shape<S: Simd> {
    pub mean: [S::F; 3],
    /// Rot diag(scales), row-major: the Gaussian's axes in the world, as long as its standard deviations.
    pub axes: [[S::F; 3]; 3],
    /// 0 where the parameters are broken: then nothing is drawn.
    pub opacity: S::F,
    /// Colour of degree 0.
    pub color: [S::F; 3],
    /// Unit quaternion (x, y, z, w) and one over the length of the stored one.
    pub quat: [S::F; 4],
    pub inv_quat_length: S::F,
    pub scales: [S::F; 3],
}

impl<S: Simd> Shape<S> {
    /// From parameters.
    #[inline(always)]
    pub(crate) fn new(s: S, block: &Block) -> Self {
        let (one, zero) = (s.splat(1.0), s.splat(0.0));
        let raw_quat = build!(zero; 4; |i| row(s, block, ROW_ROTATION + i));
        let mut length2 = zero;
        for c in raw_quat {
            length2 = s.fma(c, c, length2);
        }
        let inv_quat_length = s.div(one, s.sqrt(length2));
        let quat = build!(zero; 4; |i| s.mul(raw_quat[i], inv_quat_length));
        let rot = rotation_matrix(s, &quat);
        let scales = build!(zero; 3; |k| s.exp(row(s, block, ROW_LOG_SCALE + k)));
        let color = build!(zero; 3; |k| s.fma(row(s, block, ROW_SH + k), s.splat(SH_C0), s.splat(0.5)));
        // Finite parameters that would overflow on the way (a rotation of 1e38, say) are as broken as infinite ones.
        let mut size = s.add(s.abs(row(s, block, ROW_OPACITY)), length2);
        for k in 0..3 {
            size = s.add(size, s.abs(row(s, block, ROW_LOG_SCALE + k)));
        }
        let mut whole = s.and(s.gt(s.splat(VALUE_MAX), size), s.gt(length2, s.splat(1.0 / VALUE_MAX)));
        for k in 0..3 {
            whole = s.and(whole, s.gt(s.splat(VALUE_MAX), s.abs(color[k])));
        }
        let opacity = s.div(one, s.add(one, s.exp(s.sub(zero, row(s, block, ROW_OPACITY)))));
        Self {
            mean: build!(zero; 3; |k| row(s, block, ROW_MEAN + k)),
            axes: build!([zero; 3]; 3; |i| build!(zero; 3; |k| s.mul(rot[i][k], scales[k]))),
            opacity: s.keep(whole, opacity),
            color,
            quat,
            inv_quat_length,
            scales,
        }
    }

    /// From what [`Shape::keep`] kept. Enough for a projection, not for its gradient or for colours.
    #[inline(always)]
    pub(crate) fn load(s: S, kept: &ShapeBlock) -> Self {
        let zero = s.splat(0.0);
        Self {
            mean: build!(zero; 3; |k| s.load(&kept[k].0)),
            axes: build!([zero; 3]; 3; |i| build!(zero; 3; |k| s.load(&kept[3 + 3 * i + k].0))),
            opacity: s.load(&kept[12].0),
            color: [zero; 3],
            quat: [zero; 4],
            inv_quat_length: zero,
            scales: [zero; 3],
        }
    }

    /// Keeps it for many views.
    #[inline(always)]
    pub(crate) fn keep(&self, s: S, kept: &mut ShapeBlock) {
        for i in 0..3 {
            s.store(self.mean[i], &mut kept[i].0);
            for k in 0..3 {
                s.store(self.axes[i][k], &mut kept[3 + 3 * i + k].0);
            }
        }
        s.store(self.opacity, &mut kept[12].0);
    }
}

/// Mean, axes and opacity of 16 Gaussians, kept for many views.
pub(crate) type ShapeBlock = [Lanes; 13];

/// Projects 16 Gaussians; lanes outside of `lanes` are not visible.
#[inline(always)]
pub(crate) fn project<S: Simd>(s: S, view: &View, shape: &Shape<S>, lanes: u16) -> Projected<S> {
    let one = s.splat(1.0);
    let half = s.splat(0.5);

    let offset = [
        s.sub(shape.mean[0], s.splat(view.eye.x)),
        s.sub(shape.mean[1], s.splat(view.eye.y)),
        s.sub(shape.mean[2], s.splat(view.eye.z)),
    ];
    let zero = s.splat(0.0);
    let rotation = build!([zero; 3]; 3; |i| build!(zero; 3; |k| s.splat(view.rotation[i][k])));
    let x = dot3(s, &rotation[0], &offset);
    let y = dot3(s, &rotation[1], &offset);
    let z = dot3(s, &rotation[2], &offset);
    let in_front = s.ge(z, s.splat(view.near));
    let inv_z = s.div(one, s.select(in_front, z, one));
    let (ratio_x, ratio_y) = (s.mul(x, inv_z), s.mul(y, inv_z));
    let mean = [s.fma(ratio_x, s.splat(view.fx), s.splat(view.cx)), s.fma(ratio_y, s.splat(view.fy), s.splat(view.cy))];

    let [low_x, high_x, low_y, high_y] = build!(zero; 4; |i| s.splat(view.limits[i]));
    let free_x = s.and(s.gt(ratio_x, low_x), s.gt(high_x, ratio_x));
    let free_y = s.and(s.gt(ratio_y, low_y), s.gt(high_y, ratio_y));
    let jx = s.min(s.max(ratio_x, low_x), high_x);
    let jy = s.min(s.max(ratio_y, low_y), high_y);

    let axes = &shape.axes;
    let m = build!([zero; 3]; 3; |i| build!(zero; 3; |k| dot3(s, &rotation[i], &[axes[0][k], axes[1][k], axes[2][k]])));

    let (gain_x, gain_y) = (s.mul(inv_z, s.splat(view.fx)), s.mul(inv_z, s.splat(view.fy)));
    let u = [
        build!(zero; 3; |k| s.mul(gain_x, s.fnma(jx, m[2][k], m[0][k]))),
        build!(zero; 3; |k| s.mul(gain_y, s.fnma(jy, m[2][k], m[1][k]))),
    ];
    let raw = [dot3(s, &u[0], &u[0]), dot3(s, &u[0], &u[1]), dot3(s, &u[1], &u[1])];
    // |u0 x u1|² is the determinant of U Uᵀ without its cancellation.
    let cross = [
        s.sub(s.mul(u[0][1], u[1][2]), s.mul(u[0][2], u[1][1])),
        s.sub(s.mul(u[0][2], u[1][0]), s.mul(u[0][0], u[1][2])),
        s.sub(s.mul(u[0][0], u[1][1]), s.mul(u[0][1], u[1][0])),
    ];
    let raw_det = dot3(s, &cross, &cross);
    let low_pass = s.splat(view.low_pass);
    let (a, b, c) = (s.add(raw[0], low_pass), raw[1], s.add(raw[2], low_pass));
    // det(Σ + l I) = det Σ + l tr Σ + l²
    let det = s.fma(low_pass, s.add(s.add(raw[0], raw[2]), low_pass), raw_det);
    let sound = s.and(s.gt(det, s.splat(1e-12)), s.gt(s.splat(DETERMINANT_MAX), det));
    let inv_det = s.div(one, s.select(sound, det, one));
    let conic = [s.mul(c, inv_det), s.sub(s.splat(0.0), s.mul(b, inv_det)), s.mul(a, inv_det)];

    let opacity = shape.opacity;
    let compensation = if view.compensation { s.sqrt(s.mul(raw_det, inv_det)) } else { one };
    let alpha = s.mul(opacity, compensation);
    let unclamped = s.gt(s.splat(ALPHA_MAX), alpha);
    let seen = s.gt(alpha, s.splat(view.alpha_min));
    let alpha = s.select(seen, s.min(alpha, s.splat(ALPHA_MAX)), one);
    let log2_alpha = s.log2(alpha);
    let threshold = s.sub(log2_alpha, s.splat(view.alpha_min.log2()));

    // exp2(log2_alpha - log2(e)/2 * d² / variance) >= alpha_min bounds d.
    let reach = s.mul(threshold, s.splat(2.0 * std::f32::consts::LN_2));
    let extent = [s.sqrt(s.mul(reach, a)), s.sqrt(s.mul(reach, c))];
    let size = [s.splat(view.width), s.splat(view.height)];
    let rounding = s.splat(1e-3);
    let mut touches = s.and(sound, seen);
    let mut bounds = [one; 4];
    for axis in 0..2 {
        // First pixel whose centre is inside and last one; a margin covers rounding.
        let first = s.sub(s.sub(mean[axis], extent[axis]), s.add(half, rounding));
        let last = s.add(s.sub(s.add(mean[axis], extent[axis]), half), rounding);
        touches = s.and(touches, s.and(s.ge(last, s.splat(0.0)), s.ge(s.sub(size[axis], one), first)));
        bounds[axis] = s.max(s.add(first, s.splat(0.9999)), s.splat(0.0));
        bounds[axis + 2] = s.min(last, s.sub(size[axis], one));
        touches = s.and(touches, s.gt(s.splat(VALUE_MAX), s.abs(mean[axis])));
    }
    let sane_depth = s.and(in_front, s.gt(s.splat(VALUE_MAX), z));
    let visible = s.and(s.and(touches, sane_depth), s.mask(lanes));

    Projected {
        visible,
        x,
        y,
        z,
        inv_z,
        jx,
        jy,
        free_x,
        free_y,
        m,
        u,
        raw,
        raw_det,
        conic,
        mean,
        opacity,
        unclamped,
        log2_alpha,
        threshold,
        color: shape.color,
        bounds,
    }
}
