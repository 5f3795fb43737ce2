// What every kernel of a chain is told. The same layout as `gpu::job` on the host.

/// A view of a chain: camera and how it is rendered.
struct View {
    /// Rows of camera_from_world; w is the eye in the world.
    rotation_x: vec4f,
    rotation_y: vec4f,
    rotation_z: vec4f,
    /// fx, fy, cx, cy, pixels.
    intrinsics: vec4f,
    /// x/z and y/z between which the Jacobian is taken: low x, high x, low y, high y.
    limits: vec4f,
    /// Colour of the background; the depth that moments are relative to, metres.
    background: vec4f,
    /// Width and height, pixels; low-pass, px²; least alpha that counts.
    extent: vec4f,
    /// Near plane, metres; log2 of the least alpha; transmittance at which blocks stop; 1 where opacity is compensated.
    cuts: vec4f,
}

/// Sizes of a chain, and the settings of a training step.
struct Job {
    gaussians: u32,
    /// Most workgroups that share a pass of the sort, and that share the splats of the binning; see `groups.wgsl`.
    sort_groups: u32,
    bin_groups: u32,
    /// (tile, splat) pairs that a view has room for.
    capacity: u32,
    width: u32,
    height: u32,
    tiles_x: u32,
    tiles_y: u32,
    /// Coefficients above degree 0 that are evaluated, and rows of them that a block of the model has.
    bands: u32,
    band_rows: u32,
    /// Where the terms of the loss go.
    slot: u32,
    /// Workgroups of the parameter pass.
    parameter_groups: u32,
    /// Weights divided by the number of what they are means over.
    l1: f32,
    ssim: f32,
    depth: f32,
    free: f32,
    isotropic: f32,
    opacity: f32,
    scale: f32,
    lr_bands: f32,
    lr_means: f32,
    lr_log_scales: f32,
    lr_rotations: f32,
    lr_opacity: f32,
    lr_sh: f32,
    beta1: f32,
    beta2: f32,
    epsilon: f32,
    log_scale_min: f32,
    log_scale_max: f32,
    /// Natural logarithms of the betas, from double precision.
    ln_beta1: f32,
    ln_beta2: f32,
    /// Noise on the means: learning rate times noise rate, the opacity and the sharpness of its gate, its key.
    noise_rate: f32,
    noise_opacity: f32,
    noise_sharpness: f32,
    unused: u32,
    noise_key: vec2u,
}

const TILE: u32 = 16u;
const TILE_PIXELS: u32 = 256u;
/// Gaussians per block of the model, and rows of a block.
const LANES: u32 = 16u;
const ROWS: u32 = 14u;
/// Key of a Gaussian that is not drawn.
const NOT_DRAWN: u32 = 0xffffffffu;
/// Vectors of a projected splat: (x, y, A, B2), (C, log2 alpha, threshold, depth), (red, green, blue, -).
/// alpha = exp2(log2 alpha - (A dx² + B2 dx dy + C dy²)).
const ROW: u32 = 3u;
/// Numbers of a Gaussian's gradient: ten moments, whether it changed a pixel, and one that is not used.
const MOMENTS: u32 = 12u;
/// Words of the control buffer: whether the chain has stopped because pairs did not fit, the most pairs that a view had,
/// and from CONTROL_VISIBLE on the number of drawn Gaussians of each view, from CONTROL_SUMS on three sums of each
/// workgroup of the parameter pass.
const CONTROL_HALT: u32 = 0u;
const CONTROL_PAIRS: u32 = 1u;
const CONTROL_VISIBLE: u32 = 4u;
const CONTROL_SUMS: u32 = 132u;

/// Whether a number is finite and its magnitude below a limit. By its bits: a compiler may assume that no number is NaN.
fn below(value: f32, limit: f32) -> bool {
    return (bitcast<u32>(value) & 0x7fffffffu) < bitcast<u32>(limit);
}

/// Index of a workgroup in a grid that was folded because of the limit of 65,535 along a dimension.
fn unfold(group: vec3u, groups: vec3u) -> u32 {
    return group.y * groups.x + group.x;
}
