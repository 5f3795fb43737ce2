//! From moments per splat to gradients per parameter: the projection, backwards.

use crate::backward::MOMENTS;
use crate::blend::prefetch;
use crate::frame::Frame;
use crate::model::{
    Block, LANES, Lanes, ROW_LOG_SCALE, ROW_MEAN, ROW_OPACITY, ROW_ROTATION, ROW_SH, ROWS, SH_C0, SH_REST_MAX,
};
use crate::projection::{Projected, Shape, View, project};
use crate::sh;
use crate::simd::{Simd, build};

/// A gradient beyond this in any parameter is a broken Gaussian: it is left as it is.
const GRADIENT_MAX: f32 = 1e15;

/// Gradients of one block of 16 Gaussians.
pub(crate) struct BlockGradient<S: Simd> {
    pub rows: [S::F; ROWS],
    /// Where higher bands are evaluated: their basis functions. The gradient of a coefficient is its function times
    /// that of the colour, which is the one of degree 0 divided by [`SH_C0`].
    pub bands: Option<[S::F; SH_REST_MAX]>,
    /// Lanes that changed at least one pixel and whose gradient is finite.
    pub lanes: S::M,
    /// Standard deviations, metres.
    pub scales: [S::F; 3],
    pub screen: Screen<S>,
}

/// What the statistics of the screen are made of; costs nothing where it is not used.
pub(crate) struct Screen<S: Simd> {
    /// Gradient by the mean's position, per pixel.
    pub gradient: [S::F; 2],
    /// Covariance with the low-pass (a, b, c), px².
    pub covariance: [S::F; 3],
    /// Lanes that were projected into the image.
    pub visible: S::M,
    /// Lanes with a gradient.
    pub moved: S::M,
}

impl<S: Simd> BlockGradient<S> {
    /// No lane has a gradient.
    #[inline(always)]
    pub(crate) fn zero<const BANDS: bool>(s: S) -> Self {
        let (zero, none) = (s.splat(0.0), s.mask(0));
        // Zeros, not nothing: what the bands do must not depend on whether a neighbour in the block is drawn.
        let bands = if BANDS { Some([zero; SH_REST_MAX]) } else { None };
        let screen = Screen { gradient: [zero; 2], covariance: [zero; 3], visible: none, moved: none };
        Self { rows: [zero; ROWS], bands, lanes: none, scales: [zero; 3], screen }
    }
}

/// Place of a slot whose tile the splat changed nothing in: there are zeros.
pub(crate) const UNTOUCHED: u32 = 0;
/// How many slots ahead sums are asked for: those of neighbours are apart, in the depth order of their tiles.
const AHEAD: usize = 32;

/// What the backward blend left behind.
#[derive(Clone, Copy)]
pub(crate) struct Partials<'a> {
    /// Moments of every (tile, splat), tile after tile.
    pub sums: &'a [f32],
    /// For every slot, and behind them all, where its moments are or [`UNTOUCHED`].
    pub places: &'a [u32],
}

/// Sums a block's partials over tiles, in the order of the tiles, and takes them through the projection. `rest` are the
/// rows of higher bands that are evaluated; without `BANDS`, which costs nothing then, there are none.
///
/// `None` where none of the block's Gaussians changed a pixel, or with `OBSERVED` where none was projected into the image.
#[inline(always)]
pub(crate) fn block_gradient<S: Simd, const BANDS: bool, const OBSERVED: bool>(
    s: S,
    view: &View,
    frame: &Frame,
    partials: Partials<'_>,
    block_index: usize,
    (block, rest): (&Block, &[Lanes]),
) -> Option<BlockGradient<S>> {
    let zero = s.splat(0.0);
    let mut rows = [zero; 16];
    let mut drawn = 0_u16;
    let (first, base) = frame.block_slots(block_index);
    let nowhere = frame.slots;
    let mut add = |lane: usize, slot: usize| {
        let place = partials.places[slot];
        // Lanes beyond the moments hold those of a neighbour, and nobody asks for them.
        if let Some(sum) = partials.sums[place as usize * MOMENTS..].first_chunk() {
            rows[lane] = s.add(rows[lane], s.load(sum));
        }
        drawn |= u16::from(place != UNTOUCHED) << lane;
    };
    for lane in 0..LANES {
        let (from, to) = (base + first[lane] as usize, base + first[lane + 1] as usize);
        for ahead in 0..4 {
            if let Some(&next) = partials.places.get(from + AHEAD + ahead) {
                let at = next as usize * MOMENTS;
                prefetch(partials.sums.get(at));
                prefetch(partials.sums.get(at + MOMENTS - 1));
            }
        }
        // Most splats touch one, two or four tiles: without a loop, whose end would be mispredicted.
        for k in 0..4 {
            let slot = from + k;
            add(lane, if slot < to { slot } else { nowhere });
        }
        for slot in from + 4..to {
            add(lane, slot);
        }
    }
    let visible = if OBSERVED { frame.visible[block_index] } else { drawn };
    if visible == 0 {
        return None;
    }
    s.transpose(&mut rows);
    let moments = build!(zero; MOMENTS; |i| rows[i]);
    let shape = Shape::new(s, block);
    let projected = project(s, view, &shape, visible);
    let (mut rows, d_mean) = parameter_gradients(s, view, &shape, &projected, &moments);
    let mut bands = None;
    if BANDS {
        let d_color = [moments[6], moments[7], moments[8]];
        bands = Some(sh::bands_gradient(s, view, block, rest, &d_color, &mut rows[ROW_MEAN..]));
    }
    let mut size = zero;
    for g in rows {
        size = s.add(size, s.abs(g));
    }
    let lanes = s.and(s.mask(drawn), s.gt(s.splat(GRADIENT_MAX), size));
    let low_pass = s.splat(view.low_pass());
    let [a, b, c] = projected.raw;
    let covariance = [s.add(a, low_pass), b, s.add(c, low_pass)];
    let screen = Screen { gradient: d_mean, covariance, visible: s.mask(visible), moved: lanes };
    Some(BlockGradient { rows, bands, lanes, scales: shape.scales, screen })
}

/// Chain rule from the ten moments to the fourteen parameters, and to the mean's position in pixels.
#[inline(always)]
fn parameter_gradients<S: Simd>(
    s: S,
    view: &View,
    shape: &Shape<S>,
    p: &Projected<S>,
    moments: &[S::F; MOMENTS],
) -> ([S::F; ROWS], [S::F; 2]) {
    let [h, hx, hy, hxx, hxy, hyy, red, green, blue, depth] = *moments;
    let zero = s.splat(0.0);
    let half = s.splat(0.5);
    let two = s.splat(2.0);
    let [ca, cb, cc] = p.conic;

    // Mean in pixels.
    let d_mean = [s.fma(ca, hx, s.mul(cb, hy)), s.fma(cb, hx, s.mul(cc, hy))];

    // The gradient of the conic K is G, so that of the covariance is V = -K G K.
    let (ga, gb, gc) = (s.mul(half, neg(s, hxx)), s.mul(half, neg(s, hxy)), s.mul(half, neg(s, hyy)));
    let (p00, p01) = (s.fma(ca, ga, s.mul(cb, gb)), s.fma(ca, gb, s.mul(cb, gc)));
    let (p10, p11) = (s.fma(cb, ga, s.mul(cc, gb)), s.fma(cb, gb, s.mul(cc, gc)));
    let mut v00 = neg(s, s.fma(p00, ca, s.mul(p01, cb)));
    let mut v01 = neg(s, s.fma(p00, cb, s.mul(p01, cc)));
    let mut v11 = neg(s, s.fma(p10, cb, s.mul(p11, cc)));

    // Peak alpha: opacity, and the compensation sqrt(det before / det after), unless clamped.
    let h_alpha = s.keep(p.unclamped, h);
    if view.compensated() {
        let weight = s.mul(half, h_alpha);
        let inv = s.div(s.splat(1.0), s.max(p.raw_det, s.splat(1e-30)));
        let [a, b, c] = p.raw;
        v00 = s.fma(weight, s.sub(s.mul(c, inv), ca), v00);
        v01 = s.fma(weight, s.sub(neg(s, s.mul(b, inv)), cb), v01);
        v11 = s.fma(weight, s.sub(s.mul(a, inv), cc), v11);
    }
    let d_logit = s.mul(h_alpha, s.sub(s.splat(1.0), p.opacity));

    // Covariance = U Uᵀ, U = J M.
    let d_u: [[S::F; 3]; 2] = [
        build!(zero; 3; |k| s.mul(two, s.fma(v00, p.u[0][k], s.mul(v01, p.u[1][k])))),
        build!(zero; 3; |k| s.mul(two, s.fma(v01, p.u[0][k], s.mul(v11, p.u[1][k])))),
    ];
    let gain = [s.mul(p.inv_z, s.splat(view.fx)), s.mul(p.inv_z, s.splat(view.fy))];
    let d_m: [[S::F; 3]; 3] = [
        build!(zero; 3; |k| s.mul(gain[0], d_u[0][k])),
        build!(zero; 3; |k| s.mul(gain[1], d_u[1][k])),
        build!(zero; 3; |k| neg(s, s.fma(s.mul(gain[0], p.jx), d_u[0][k], s.mul(s.mul(gain[1], p.jy), d_u[1][k])))),
    ];
    // J's entries depend on the camera point: its gains on z, its shear on x/z and y/z where not clamped.
    let d_jx = s.keep(p.free_x, neg(s, s.mul(gain[0], dot(s, &d_u[0], &p.m[2]))));
    let d_jy = s.keep(p.free_y, neg(s, s.mul(gain[1], dot(s, &d_u[1], &p.m[2]))));
    let d_ratio_x = s.mul(gain[0], s.mul(d_mean[0], p.z));
    let d_ratio_y = s.mul(gain[1], s.mul(d_mean[1], p.z));
    let (d_x, d_y) = (s.mul(s.add(d_ratio_x, d_jx), p.inv_z), s.mul(s.add(d_ratio_y, d_jy), p.inv_z));
    let mut d_z = s.sub(depth, s.mul(p.inv_z, s.add(dot(s, &d_u[0], &p.u[0]), dot(s, &d_u[1], &p.u[1]))));
    let inv_z2 = s.mul(p.inv_z, p.inv_z);
    d_z = s.fnma(s.mul(s.add(d_ratio_x, d_jx), p.x), inv_z2, d_z);
    d_z = s.fnma(s.mul(s.add(d_ratio_y, d_jy), p.y), inv_z2, d_z);

    let mut out = [zero; ROWS];
    // Columns of the rotation.
    let columns = build!([zero; 3]; 3; |j| build!(zero; 3; |i| s.splat(view.rotation[i][j])));
    for j in 0..3 {
        out[ROW_MEAN + j] = dot(s, &columns[j], &[d_x, d_y, d_z]);
    }
    // M = R Rot diag(s).
    let mut d_rot = [[zero; 3]; 3];
    for k in 0..3 {
        let d_column = [d_m[0][k], d_m[1][k], d_m[2][k]];
        out[ROW_LOG_SCALE + k] = dot(s, &d_column, &[p.m[0][k], p.m[1][k], p.m[2][k]]);
        for (j, d_row) in d_rot.iter_mut().enumerate() {
            d_row[k] = s.mul(shape.scales[k], dot(s, &columns[j], &d_column));
        }
    }
    let d_quat = quaternion_gradient(s, &shape.quat, &d_rot);
    let mut along = zero;
    for i in 0..4 {
        along = s.fma(shape.quat[i], d_quat[i], along);
    }
    for i in 0..4 {
        out[ROW_ROTATION + i] = s.mul(shape.inv_quat_length, s.fnma(shape.quat[i], along, d_quat[i]));
    }
    out[ROW_OPACITY] = d_logit;
    for (k, d_color) in [red, green, blue].into_iter().enumerate() {
        out[ROW_SH + k] = s.mul(s.splat(SH_C0), d_color);
    }
    (out, d_mean)
}

/// Gradient of a unit quaternion (x, y, z, w) from that of its rotation matrix.
#[inline(always)]
fn quaternion_gradient<S: Simd>(s: S, q: &[S::F; 4], d: &[[S::F; 3]; 3]) -> [S::F; 4] {
    let [x, y, z, w] = *q;
    let two = s.splat(2.0);
    let plus = [s.add(d[1][2], d[2][1]), s.add(d[0][2], d[2][0]), s.add(d[0][1], d[1][0])];
    let minus = [s.sub(d[2][1], d[1][2]), s.sub(d[0][2], d[2][0]), s.sub(d[1][0], d[0][1])];
    let twice =
        [s.mul(two, s.add(d[1][1], d[2][2])), s.mul(two, s.add(d[0][0], d[2][2])), s.mul(two, s.add(d[0][0], d[1][1]))];
    [
        s.mul(two, s.fnma(x, twice[0], s.fma(y, plus[2], s.fma(z, plus[1], s.mul(w, minus[0]))))),
        s.mul(two, s.fnma(y, twice[1], s.fma(x, plus[2], s.fma(z, plus[0], s.mul(w, minus[1]))))),
        s.mul(two, s.fnma(z, twice[2], s.fma(x, plus[1], s.fma(y, plus[0], s.mul(w, minus[2]))))),
        s.mul(two, s.fma(x, minus[0], s.fma(y, minus[1], s.mul(z, minus[2])))),
    ]
}

#[inline(always)]
fn neg<S: Simd>(s: S, a: S::F) -> S::F {
    s.sub(s.splat(0.0), a)
}

#[inline(always)]
fn dot<S: Simd>(s: S, a: &[S::F; 3], b: &[S::F; 3]) -> S::F {
    s.fma(a[0], b[0], s.fma(a[1], b[1], s.mul(a[2], b[2])))
}
