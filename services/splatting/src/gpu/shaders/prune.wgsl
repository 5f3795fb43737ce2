// Pruning: what becomes of each Gaussian by the rules of `rgbd/prune.rs`, two bits each in a word per block of 16. What
// rounding could decide is left to the host (see `prune_view.wgsl`). A thread per Gaussian.

struct Rules {
    /// Corners of the clip box, metres; the least opacity; the greatest standard deviation, metres.
    low: vec3f,
    opacity: f32,
    high: vec3f,
    sigma_m: f32,
    gaussians: u32,
    /// Views that must look through a Gaussian; 0: that rule is off.
    front_views: u32,
}

@group(0) @binding(0) var<uniform> rules: Rules;
@group(0) @binding(1) var<storage, read> parameters: array<f32>;
@group(0) @binding(2) var<storage, read> looked_through: array<u32>;
@group(0) @binding(3) var<storage, read_write> verdicts: array<u32>;

const KEEP: u32 = 0u;
const REMOVE: u32 = 1u;
const ASK: u32 = 2u;
/// Relative rounding of an exponential and what is made of it, with something to spare.
const ROUNDING: f32 = 1e-4;
/// Squares of quaternions' lengths below this are left to the host.
const LENGTH2_MIN: f32 = 1e-30;

var<workgroup> words: array<atomic<u32>, 16>;

/// By its bits: a compiler may assume that no number is infinite.
fn is_finite(value: f32) -> bool {
    return (bitcast<u32>(value) & 0x7f800000u) != 0x7f800000u;
}

fn verdict(index: u32) -> u32 {
    for (var row = 0u; row < ROWS; row++) {
        if !is_finite(parameters[parameter_place(index, row)]) {
            return REMOVE;
        }
    }
    let g = gaussian_at(index);
    // Comparisons alone: nothing is rounded.
    if any(g.mean < rules.low) || any(g.mean > rules.high) {
        return REMOVE;
    }
    var asks = dot(g.rotation, g.rotation) < LENGTH2_MIN;
    let opacity = 1.0 / (1.0 + exp(-g.logit));
    let sigma_m = exp(max(max(g.log_scales.x, g.log_scales.y), g.log_scales.z));
    let opacity_unsure = abs(opacity - rules.opacity) <= ROUNDING * rules.opacity;
    let sigma_unsure = abs(sigma_m - rules.sigma_m) <= ROUNDING * rules.sigma_m;
    if (!opacity_unsure && opacity < rules.opacity) || (!sigma_unsure && sigma_m > rules.sigma_m) {
        return REMOVE;
    }
    asks = asks || opacity_unsure || sigma_unsure;
    if rules.front_views > 0u {
        if (looked_through[index] & 0xffffu) >= rules.front_views {
            return REMOVE;
        }
        asks = asks || (looked_through[index] >> 16u) >= rules.front_views;
    }
    return select(KEEP, ASK, asks);
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let workgroup = unfold(group, groups);
    let index = workgroup * 256u + local;
    if local < 16u {
        atomicStore(&words[local], 0u);
    }
    workgroupBarrier();
    if index < rules.gaussians {
        atomicOr(&words[local / LANES], verdict(index) << (2u * (local % LANES)));
    }
    workgroupBarrier();
    let word = 16u * workgroup + local;
    if local < 16u && word < arrayLength(&verdicts) {
        verdicts[word] = atomicLoad(&words[local]);
    }
}
