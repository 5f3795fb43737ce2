// Projection of a Gaussian: camera coordinates, 2-D covariance, conic, extent. The same formulas as `projection.rs`.
//
// Camera point p = R (mean - eye); M = R Q diag(scales); U = J M with the Jacobian J of the perspective map, so that the
// 2-D covariance is U Uᵀ plus the low-pass. Needs `parameters` in the kernel.

const SH_C0: f32 = 0.28209479;
const ALPHA_MAX: f32 = 0.999;
const DETERMINANT_MAX: f32 = 1e20;
const VALUE_MAX: f32 = 1e9;
const LN_2: f32 = 0.6931471805599453;
/// log2(e) / 2
const HALF_LOG2_E: f32 = 0.7213475204444817;

struct Gaussian {
    mean: vec3f,
    log_scales: vec3f,
    /// x, y, z, w; of any length.
    rotation: vec4f,
    logit: f32,
    sh: vec3f,
}

/// Where a parameter of a Gaussian is, in a buffer of blocks of 16.
fn parameter_place(index: u32, row: u32) -> u32 {
    return (index / LANES * ROWS + row) * LANES + index % LANES;
}

fn gaussian_at(index: u32) -> Gaussian {
    let p = parameter_place(index, 0u);
    return Gaussian(
        vec3f(parameters[p], parameters[p + 16u], parameters[p + 32u]),
        vec3f(parameters[p + 48u], parameters[p + 64u], parameters[p + 80u]),
        vec4f(parameters[p + 96u], parameters[p + 112u], parameters[p + 128u], parameters[p + 144u]),
        parameters[p + 160u],
        vec3f(parameters[p + 176u], parameters[p + 192u], parameters[p + 208u]),
    );
}

/// Whether all that a projection computes from it stays finite.
fn is_whole(g: Gaussian) -> bool {
    let length2 = dot(g.rotation, g.rotation);
    let size = abs(g.logit) + length2 + abs(g.log_scales.x) + abs(g.log_scales.y) + abs(g.log_scales.z);
    let color = abs(g.sh.x) + abs(g.sh.y) + abs(g.sh.z);
    let place = abs(g.mean.x) + abs(g.mean.y) + abs(g.mean.z);
    return below(size, VALUE_MAX) && length2 > 1.0 / VALUE_MAX && below(color, VALUE_MAX) && below(place, 1e30);
}

struct Projected {
    visible: bool,
    /// Camera coordinates, metres.
    point: vec3f,
    inv_z: f32,
    /// x/z and y/z of the Jacobian, and whether they are those of the point.
    jacobian: vec2f,
    free: vec2<bool>,
    /// Rows of M and of U.
    m0: vec3f,
    m1: vec3f,
    m2: vec3f,
    u0: vec3f,
    u1: vec3f,
    /// Covariance before the low-pass (a, b, c), and its determinant.
    raw: vec3f,
    raw_det: f32,
    /// Inverse of the covariance after the low-pass.
    conic: vec3f,
    /// Position of the mean, pixels.
    mean: vec2f,
    opacity: f32,
    /// Whether alpha is below its clamp, so that gradients pass.
    unclamped: bool,
    log2_alpha: f32,
    /// The exponent beyond which a pixel does not count.
    threshold: f32,
    /// First and last pixel along x and y, not yet truncated.
    low: vec2f,
    high: vec2f,
    scales: vec3f,
    /// Unit quaternion, and one over the length of the stored one.
    quat: vec4f,
    inv_quat_length: f32,
}

/// Columns of the rotation of a unit quaternion.
fn rotation_matrix(q: vec4f) -> mat3x3f {
    let d = 2.0 * q;
    let xx = q.x * d.x;
    let yy = q.y * d.y;
    let zz = q.z * d.z;
    let xy = q.x * d.y;
    let xz = q.x * d.z;
    let yz = q.y * d.z;
    let wx = q.w * d.x;
    let wy = q.w * d.y;
    let wz = q.w * d.z;
    return mat3x3f(
        vec3f(1.0 - (yy + zz), xy + wz, xz - wy),
        vec3f(xy - wz, 1.0 - (xx + zz), yz + wx),
        vec3f(xz + wy, yz - wx, 1.0 - (xx + yy)),
    );
}

fn project_gaussian(view: View, g: Gaussian) -> Projected {
    var p: Projected;
    let whole = is_whole(g);
    let r_x = view.rotation_x.xyz;
    let r_y = view.rotation_y.xyz;
    let r_z = view.rotation_z.xyz;
    let offset = g.mean - vec3f(view.rotation_x.w, view.rotation_y.w, view.rotation_z.w);
    p.point = vec3f(dot(r_x, offset), dot(r_y, offset), dot(r_z, offset));
    let in_front = whole && p.point.z >= view.cuts.x && below(p.point.z, VALUE_MAX);
    p.inv_z = 1.0 / select(1.0, p.point.z, in_front);
    let ratio = p.point.xy * p.inv_z;
    p.mean = ratio * view.intrinsics.xy + view.intrinsics.zw;
    p.free = (ratio > view.limits.xz) & (view.limits.yw > ratio);
    p.jacobian = min(max(ratio, view.limits.xz), view.limits.yw);

    p.inv_quat_length = 1.0 / sqrt(select(1.0, dot(g.rotation, g.rotation), whole));
    p.quat = g.rotation * p.inv_quat_length;
    p.scales = exp(select(vec3f(), g.log_scales, vec3<bool>(whole)));
    let q = rotation_matrix(p.quat);
    let a0 = q[0] * p.scales.x;
    let a1 = q[1] * p.scales.y;
    let a2 = q[2] * p.scales.z;
    p.m0 = vec3f(dot(r_x, a0), dot(r_x, a1), dot(r_x, a2));
    p.m1 = vec3f(dot(r_y, a0), dot(r_y, a1), dot(r_y, a2));
    p.m2 = vec3f(dot(r_z, a0), dot(r_z, a1), dot(r_z, a2));
    let gain = p.inv_z * view.intrinsics.xy;
    p.u0 = gain.x * (p.m0 - p.jacobian.x * p.m2);
    p.u1 = gain.y * (p.m1 - p.jacobian.y * p.m2);
    p.raw = vec3f(dot(p.u0, p.u0), dot(p.u0, p.u1), dot(p.u1, p.u1));
    // |u0 x u1|² is the determinant of U Uᵀ without its cancellation, and det(Σ + l I) = det Σ + l tr Σ + l².
    let across = cross(p.u0, p.u1);
    p.raw_det = dot(across, across);
    let low_pass = view.extent.z;
    let det = p.raw_det + low_pass * (p.raw.x + p.raw.z + low_pass);
    let sound = below(det, DETERMINANT_MAX) && det > 1e-12;
    let inv_det = 1.0 / select(1.0, det, sound);
    let a = p.raw.x + low_pass;
    let c = p.raw.z + low_pass;
    p.conic = vec3f(c, -p.raw.y, a) * inv_det;

    p.opacity = select(0.0, 1.0 / (1.0 + exp(-g.logit)), whole);
    let compensation = select(1.0, sqrt(p.raw_det * inv_det), view.cuts.w > 0.0);
    let alpha = p.opacity * compensation;
    p.unclamped = ALPHA_MAX > alpha;
    let seen = alpha > view.extent.w;
    p.log2_alpha = log2(select(1.0, min(alpha, ALPHA_MAX), seen));
    p.threshold = p.log2_alpha - view.cuts.y;

    // exp2(log2 alpha - log2(e)/2 d² / variance) >= least alpha bounds d; a margin covers rounding.
    let reach = max(p.threshold, 0.0) * (2.0 * LN_2);
    let extent = sqrt(reach * vec2f(a, c));
    let first = p.mean - extent - vec2f(0.501);
    let last = p.mean + extent - vec2f(0.499);
    let size = view.extent.xy;
    let touches = all(last >= vec2f()) && all(size - 1.0 >= first);
    p.low = max(first + 0.9999, vec2f());
    p.high = min(last, size - 1.0);
    p.visible = in_front && sound && seen && touches && below(p.mean.x, VALUE_MAX) && below(p.mean.y, VALUE_MAX);
    return p;
}
