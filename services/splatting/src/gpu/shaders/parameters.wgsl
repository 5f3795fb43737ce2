// From the ten moments of a splat to the gradient of every parameter: the projection, backwards, and the regularisers. The
// same formulas as `gradient.rs` and `training.rs`. Needs `bands` in the kernel.

/// A gradient beyond this in any parameter is a broken Gaussian: it is left as it is.
const GRADIENT_MAX: f32 = 1e15;

struct ParameterGradient {
    /// Whether the Gaussian takes a step.
    moves: bool,
    mean: vec3f,
    log_scales: vec3f,
    rotation: vec4f,
    logit: f32,
    /// By the colour; that of degree 0 is SH_C0 times this.
    color: vec3f,
    /// From the eye to the mean, of length 1.
    direction: vec3f,
    /// Σ |s - mean(s)|, opacity and Σ s of what counts.
    sums: vec3f,
}


/// Gradient of a unit quaternion (x, y, z, w) from that of its rotation matrix, by columns.
fn quaternion_gradient(q: vec4f, d: mat3x3f) -> vec4f {
    // d[column][row]
    let plus = vec3f(d[2].y + d[1].z, d[2].x + d[0].z, d[1].x + d[0].y);
    let minus = vec3f(d[1].z - d[2].y, d[2].x - d[0].z, d[0].y - d[1].x);
    let twice = 2.0 * vec3f(d[1].y + d[2].z, d[0].x + d[2].z, d[0].x + d[1].y);
    return 2.0 * vec4f(
        q.y * plus.z + q.z * plus.y + q.w * minus.x - q.x * twice.x,
        q.x * plus.z + q.z * plus.x + q.w * minus.y - q.y * twice.y,
        q.x * plus.y + q.y * plus.x + q.w * minus.z - q.z * twice.z,
        q.x * minus.x + q.y * minus.y + q.z * minus.z,
    );
}

fn parameter_gradient(index: u32, view: View, g: Gaussian, moments: array<f32, 11>) -> ParameterGradient {
    var out: ParameterGradient;
    let drawn = moments[10] > 0.0;
    var p: Projected;
    if drawn {
        p = project_gaussian(view, g);
        let h = vec3f(moments[0], moments[1], moments[2]);
        let k = p.conic;
        let d_mean = vec2f(k.x * h.y + k.y * h.z, k.y * h.y + k.z * h.z);

        // The gradient of the conic K is G, so that of the covariance is V = -K G K.
        let ga = -0.5 * moments[3];
        let gb = -0.5 * moments[4];
        let gc = -0.5 * moments[5];
        let p00 = k.x * ga + k.y * gb;
        let p01 = k.x * gb + k.y * gc;
        let p10 = k.y * ga + k.z * gb;
        let p11 = k.y * gb + k.z * gc;
        var v = -vec3f(p00 * k.x + p01 * k.y, p00 * k.y + p01 * k.z, p10 * k.y + p11 * k.z);

        // Peak alpha: opacity, and the compensation sqrt(det before / det after), unless clamped.
        let h_alpha = select(0.0, h.x, p.unclamped);
        if view.cuts.w > 0.0 {
            let inv = 1.0 / max(p.raw_det, 1e-30);
            v += 0.5 * h_alpha * (vec3f(p.raw.z, -p.raw.y, p.raw.x) * inv - k);
        }
        out.logit = h_alpha * (1.0 - p.opacity);

        // Covariance = U Uᵀ, U = J M.
        let du0 = 2.0 * (v.x * p.u0 + v.y * p.u1);
        let du1 = 2.0 * (v.y * p.u0 + v.z * p.u1);
        let gain = p.inv_z * view.intrinsics.xy;
        let dm0 = gain.x * du0;
        let dm1 = gain.y * du1;
        let dm2 = -(gain.x * p.jacobian.x * du0 + gain.y * p.jacobian.y * du1);
        // J's entries depend on the camera point: its gains on z, its shear on x/z and y/z where not clamped.
        let d_shear = select(vec2f(), -gain * vec2f(dot(du0, p.m2), dot(du1, p.m2)), p.free);
        let d_ratio = view.intrinsics.xy * d_mean + d_shear;
        let d_xy = d_ratio * p.inv_z;
        let d_z = moments[9] - p.inv_z * (dot(du0, p.u0) + dot(du1, p.u1))
            - dot(d_ratio, p.point.xy) * p.inv_z * p.inv_z;
        let r_x = view.rotation_x.xyz;
        let r_y = view.rotation_y.xyz;
        let r_z = view.rotation_z.xyz;
        out.mean = d_xy.x * r_x + d_xy.y * r_y + d_z * r_z;

        // M = R Q diag(s): along each axis of the Gaussian.
        out.log_scales = dm0 * p.m0 + dm1 * p.m1 + dm2 * p.m2;
        let d_q = mat3x3f(
            p.scales.x * (dm0.x * r_x + dm1.x * r_y + dm2.x * r_z),
            p.scales.y * (dm0.y * r_x + dm1.y * r_y + dm2.y * r_z),
            p.scales.z * (dm0.z * r_x + dm1.z * r_y + dm2.z * r_z),
        );
        let d_quat = quaternion_gradient(p.quat, d_q);
        out.rotation = p.inv_quat_length * (d_quat - p.quat * dot(p.quat, d_quat));
        out.color = vec3f(moments[6], moments[7], moments[8]);

        if job.bands > 0u {
            let offset = g.mean - vec3f(view.rotation_x.w, view.rotation_y.w, view.rotation_z.w);
            let inv_distance = 1.0 / max(length(offset), 1e-12);
            out.direction = offset * inv_distance;
            var slope = vec3f();
            for (var band = 0u; band < job.bands; band++) {
                let at = band_place(index, job.band_rows, band, 0u);
                let weight = dot(vec3f(bands[at], bands[at + LANES], bands[at + 2u * LANES]), out.color);
                slope += weight * basis_slope(band, out.direction);
            }
            out.mean += (slope - out.direction * dot(slope, out.direction)) * inv_distance;
        }
        let size = dot(abs(out.mean), vec3f(1.0)) + dot(abs(out.log_scales), vec3f(1.0))
            + dot(abs(out.rotation), vec4f(1.0)) + abs(out.logit) + dot(abs(out.color), vec3f(1.0));
        out.moves = below(size, GRADIENT_MAX);
        if out.moves && job.isotropic != 0.0 {
            let mean = (p.scales.x + p.scales.y + p.scales.z) / 3.0;
            let difference = p.scales - mean;
            let signs = sign(difference);
            let mean_sign = (signs.x + signs.y + signs.z) / 3.0;
            out.log_scales += (signs - mean_sign) * p.scales * job.isotropic;
            out.sums.x = dot(abs(difference), vec3f(1.0));
        }
    }
    if job.opacity != 0.0 || job.scale != 0.0 {
        // What every Gaussian of the model has, drawn or not.
        if !out.moves {
            out.mean = vec3f();
            out.log_scales = vec3f();
            out.rotation = vec4f();
            out.logit = 0.0;
            out.color = vec3f();
        }
        out.moves = is_whole(g) && below(g.mean.x, VALUE_MAX) && below(g.mean.y, VALUE_MAX) && below(g.mean.z, VALUE_MAX);
        if out.moves {
            let opacity = 1.0 / (1.0 + exp(-g.logit));
            let scales = exp(g.log_scales);
            out.logit += opacity * (1.0 - opacity) * job.opacity;
            out.log_scales += scales * job.scale;
            out.sums.y = opacity;
            out.sums.z = scales.x + scales.y + scales.z;
        }
    }
    return out;
}
