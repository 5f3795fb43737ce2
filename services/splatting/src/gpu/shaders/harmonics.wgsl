// Spherical harmonics of degree 1 to 3: values and slopes of the fifteen basis functions. Order, signs and constants as
// in `sh.rs` (3DGS, gsplat and every file format). `bands` of them are evaluated: 0, 3, 8 or 15.

const H1: f32 = 0.4886025119029199;
const H2_0: f32 = 1.0925484305920792;
const H2_1: f32 = 0.31539156525252005;
const H2_2: f32 = 0.5462742152960396;
const H3_0: f32 = 0.5900435899266435;
const H3_1: f32 = 2.890611442640554;
const H3_2: f32 = 0.4570457994644658;
const H3_3: f32 = 0.3731763325901154;
const H3_4: f32 = 1.445305721320277;

/// Value of basis function 1 + k for a direction of length 1.
fn basis(k: u32, d: vec3f) -> f32 {
    let xx = d.x * d.x;
    let yy = d.y * d.y;
    let zz = d.z * d.z;
    switch k {
        case 0u: { return -H1 * d.y; }
        case 1u: { return H1 * d.z; }
        case 2u: { return -H1 * d.x; }
        case 3u: { return H2_0 * d.x * d.y; }
        case 4u: { return -H2_0 * d.y * d.z; }
        case 5u: { return H2_1 * (2.0 * zz - xx - yy); }
        case 6u: { return -H2_0 * d.x * d.z; }
        case 7u: { return H2_2 * (xx - yy); }
        case 8u: { return -H3_0 * d.y * (3.0 * xx - yy); }
        case 9u: { return H3_1 * d.x * d.y * d.z; }
        case 10u: { return -H3_2 * d.y * (4.0 * zz - xx - yy); }
        case 11u: { return H3_3 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy); }
        case 12u: { return -H3_2 * d.x * (4.0 * zz - xx - yy); }
        case 13u: { return H3_4 * d.z * (xx - yy); }
        default: { return -H3_0 * d.x * (xx - 3.0 * yy); }
    }
}

/// Gradient of basis function 1 + k, as a polynomial, by the direction's coordinates.
fn basis_slope(k: u32, d: vec3f) -> vec3f {
    let xx = d.x * d.x;
    let yy = d.y * d.y;
    let zz = d.z * d.z;
    switch k {
        case 0u: { return vec3f(0.0, -H1, 0.0); }
        case 1u: { return vec3f(0.0, 0.0, H1); }
        case 2u: { return vec3f(-H1, 0.0, 0.0); }
        case 3u: { return H2_0 * vec3f(d.y, d.x, 0.0); }
        case 4u: { return -H2_0 * vec3f(0.0, d.z, d.y); }
        case 5u: { return H2_1 * vec3f(-2.0 * d.x, -2.0 * d.y, 4.0 * d.z); }
        case 6u: { return -H2_0 * vec3f(d.z, 0.0, d.x); }
        case 7u: { return H2_2 * vec3f(2.0 * d.x, -2.0 * d.y, 0.0); }
        case 8u: { return -H3_0 * vec3f(6.0 * d.x * d.y, 3.0 * (xx - yy), 0.0); }
        case 9u: { return H3_1 * vec3f(d.y * d.z, d.x * d.z, d.x * d.y); }
        case 10u: { return -H3_2 * vec3f(-2.0 * d.x * d.y, 4.0 * zz - xx - 3.0 * yy, 8.0 * d.y * d.z); }
        case 11u: { return H3_3 * vec3f(-6.0 * d.x * d.z, -6.0 * d.y * d.z, 6.0 * zz - 3.0 * (xx + yy)); }
        case 12u: { return -H3_2 * vec3f(4.0 * zz - 3.0 * xx - yy, -2.0 * d.x * d.y, 8.0 * d.x * d.z); }
        case 13u: { return H3_4 * vec3f(2.0 * d.x * d.z, -2.0 * d.y * d.z, xx - yy); }
        default: { return -H3_0 * vec3f(3.0 * (xx - yy), -6.0 * d.x * d.y, 0.0); }
    }
}

/// Where a coefficient above degree 0 is, in a buffer of `rows` rows of 16 per block.
fn band_place(index: u32, rows: u32, k: u32, channel: u32) -> u32 {
    return (index / LANES * rows + 3u * k + channel) * LANES + index % LANES;
}
