// Noise of 3DGS-MCMC on the means: mean += Σ η (Kheradmand et al. 2024, equations 8 and 9). The same numbers as
// `densify/noise.rs`: a hash of the key of the iteration and of the Gaussian's id. A thread per Gaussian.

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read_write> parameters: array<f32>;
@group(0) @binding(2) var<storage, read> ids: array<vec2u>;
@group(0) @binding(3) var<storage, read> control: array<u32>;

const NEGLIGIBLE: f32 = 1e-5;
const EXPONENT_MAX: f32 = 80.0;
const TAU: f32 = 6.2831853;

/// Wellons' `lowbias32`.
fn mix_bits(seed: u32) -> u32 {
    var x = seed;
    x = (x ^ (x >> 16u)) * 0x7feb352du;
    x = (x ^ (x >> 15u)) * 0x846ca68bu;
    return x ^ (x >> 16u);
}

fn uniform_of(hash: u32, k: u32) -> f32 {
    return f32(mix_bits(hash + (k + 1u) * 0x9e3779b9u) >> 8u) / 16777216.0;
}

/// Three normal numbers (Box-Muller), of which the first two share a radius.
fn normal_of(id: vec2u) -> vec3f {
    let hash = mix_bits(mix_bits(id.x ^ job.noise_key.x) ^ id.y ^ job.noise_key.y);
    let radii = sqrt(-2.0 * log(vec2f(1.0 - uniform_of(hash, 0u), 1.0 - uniform_of(hash, 2u))));
    let first = TAU * (uniform_of(hash, 1u) - 0.5);
    let second = TAU * (uniform_of(hash, 3u) - 0.5);
    return vec3f(radii.x * cos(first), radii.x * sin(first), radii.y * cos(second));
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let index = unfold(group, groups) * 256u + local;
    if index >= job.gaussians || control[CONTROL_HALT] != 0u {
        return;
    }
    let g = gaussian_at(index);
    if !is_whole(g) {
        return;
    }
    let opacity = 1.0 / (1.0 + exp(-g.logit));
    let gate = 1.0 / (1.0 + exp(min(job.noise_sharpness * (opacity - job.noise_opacity), EXPONENT_MAX)));
    let amplitude = gate * job.noise_rate;
    let scales = exp(g.log_scales);
    if amplitude * max(max(scales.x, scales.y), scales.z) <= NEGLIGIBLE {
        return;
    }
    let rotation = rotation_matrix(normalize(g.rotation));
    // Σ η = R diag(s²) Rᵀ η
    let along = (normal_of(ids[index]) * rotation) * amplitude * scales * scales;
    let moved = g.mean + rotation * along;
    if below(dot(abs(moved), vec3f(1.0)), VALUE_MAX) {
        for (var k = 0u; k < 3u; k++) {
            parameters[parameter_place(index, k)] = moved[k];
        }
    }
}
