// A step of Adam (Kingma and Ba 2015) fused with the projection's backward pass: a thread per Gaussian, each with its own
// step count (A32). Takes the moments that the backward blend left, and leaves zeros for the next iteration.

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read_write> parameters: array<f32>;
@group(0) @binding(3) var<storage, read_write> bands: array<f32>;
/// First moments of all blocks, then second moments.
@group(0) @binding(4) var<storage, read_write> state: array<f32>;
@group(0) @binding(5) var<storage, read_write> band_state: array<f32>;
@group(0) @binding(6) var<storage, read_write> steps: array<u32>;
@group(0) @binding(7) var<storage, read_write> gradients: array<f32>;
@group(0) @binding(8) var<storage, read_write> control: array<u32>;

var<workgroup> sums: array<vec3f, 256>;

/// 1 - exp(x) for x <= 0, without cancellation.
fn one_minus_exp(x: f32) -> f32 {
    if x > -0.1 {
        return -x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x * (1.0 / 24.0 + x / 120.0))));
    }
    return 1.0 - exp(x);
}

/// Moves both moments of a number and returns its step before the learning rate.
fn step_of(place: u32, second: u32, gradient: f32, corrections: vec2f) -> f32 {
    let g2 = gradient * gradient;
    let m = job.beta1 * (state[place] - gradient) + gradient;
    let v = job.beta2 * (state[second + place] - g2) + g2;
    state[place] = m;
    state[second + place] = v;
    return m * corrections.x / (sqrt(v) * corrections.y + job.epsilon);
}

fn band_step_of(place: u32, second: u32, gradient: f32, corrections: vec2f) -> f32 {
    let g2 = gradient * gradient;
    let m = job.beta1 * (band_state[place] - gradient) + gradient;
    let v = job.beta2 * (band_state[second + place] - g2) + g2;
    band_state[place] = m;
    band_state[second + place] = v;
    return m * corrections.x / (sqrt(v) * corrections.y + job.epsilon);
}

fn move_by(index: u32, row: u32, gradient: f32, rate: f32, corrections: vec2f) -> f32 {
    let place = parameter_place(index, row);
    let second = (job.gaussians + LANES - 1u) / LANES * LANES * ROWS;
    return parameters[place] - rate * step_of(place, second, gradient, corrections);
}

fn take_step(index: u32, g: ParameterGradient) {
    let step = steps[index] + 1u;
    steps[index] = step;
    let corrections = vec2f(
        1.0 / one_minus_exp(f32(step) * job.ln_beta1),
        inverseSqrt(one_minus_exp(f32(step) * job.ln_beta2)),
    );
    for (var k = 0u; k < 3u; k++) {
        parameters[parameter_place(index, k)] = move_by(index, k, g.mean[k], job.lr_means, corrections);
        let scale = move_by(index, 3u + k, g.log_scales[k], job.lr_log_scales, corrections);
        parameters[parameter_place(index, 3u + k)] = clamp(scale, job.log_scale_min, job.log_scale_max);
        let sh = move_by(index, 11u + k, SH_C0 * g.color[k], job.lr_sh, corrections);
        parameters[parameter_place(index, 11u + k)] = sh;
    }
    for (var k = 0u; k < 4u; k++) {
        parameters[parameter_place(index, 6u + k)] = move_by(index, 6u + k, g.rotation[k], job.lr_rotations, corrections);
    }
    parameters[parameter_place(index, 10u)] = move_by(index, 10u, g.logit, job.lr_opacity, corrections);
    let second = (job.gaussians + LANES - 1u) / LANES * LANES * job.band_rows;
    for (var band = 0u; band < job.bands; band++) {
        let value = basis(band, g.direction);
        for (var channel = 0u; channel < 3u; channel++) {
            let place = band_place(index, job.band_rows, band, channel);
            bands[place] -= job.lr_bands * band_step_of(place, second, value * g.color[channel], corrections);
        }
    }
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let workgroup = unfold(group, groups);
    let index = workgroup * 256u + local;
    var counted = vec3f();
    if index < job.gaussians {
        var moments: array<f32, 11>;
        for (var i = 0u; i < 11u; i++) {
            moments[i] = gradients[MOMENTS * index + i];
        }
        if moments[10] > 0.0 {
            for (var i = 0u; i < 11u; i++) {
                gradients[MOMENTS * index + i] = 0.0;
            }
        }
        if control[CONTROL_HALT] == 0u {
            let gradient = parameter_gradient(index, views[0], gaussian_at(index), moments);
            if gradient.moves {
                counted = gradient.sums;
                take_step(index, gradient);
            }
        }
    }
    sums[local] = counted;
    for (var step = 128u; step > 0u; step /= 2u) {
        workgroupBarrier();
        if local < step {
            sums[local] += sums[local + step];
        }
    }
    if local == 0u && workgroup < job.parameter_groups {
        for (var k = 0u; k < 3u; k++) {
            control[CONTROL_SUMS + 3u * workgroup + k] = bitcast<u32>(sums[0][k]);
        }
    }
}
