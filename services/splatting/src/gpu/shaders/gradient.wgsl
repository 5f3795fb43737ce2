// The gradient of every parameter without a step, for tests and for tools: fourteen rows in the model's layout, then those
// of the bands. Leaves zeros where the backward blend left moments.

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read> parameters: array<f32>;
@group(0) @binding(3) var<storage, read> bands: array<f32>;
@group(0) @binding(4) var<storage, read_write> gradients: array<f32>;
@group(0) @binding(5) var<storage, read_write> out: array<f32>;
@group(0) @binding(6) var<storage, read_write> bands_out: array<f32>;
@group(0) @binding(7) var<storage, read_write> control: array<u32>;

var<workgroup> sums: array<vec3f, 256>;

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
            gradients[MOMENTS * index + i] = 0.0;
        }
        var g = parameter_gradient(index, views[0], gaussian_at(index), moments);
        if !g.moves {
            g = ParameterGradient();
        }
        counted = g.sums;
        for (var k = 0u; k < 3u; k++) {
            out[parameter_place(index, k)] = g.mean[k];
            out[parameter_place(index, 3u + k)] = g.log_scales[k];
            out[parameter_place(index, 11u + k)] = SH_C0 * g.color[k];
        }
        for (var k = 0u; k < 4u; k++) {
            out[parameter_place(index, 6u + k)] = g.rotation[k];
        }
        out[parameter_place(index, 10u)] = g.logit;
        for (var band = 0u; band < job.bands; band++) {
            let value = basis(band, g.direction);
            for (var channel = 0u; channel < 3u; channel++) {
                bands_out[band_place(index, job.band_rows, band, channel)] = value * g.color[channel];
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
