// The reset of opacities of 3DGS (Kerbl et al. 2023, section 5.2): higher ones are lowered to a ceiling, and the moments of
// all are forgotten, not the step counts. A thread per Gaussian.

struct Ceiling {
    gaussians: u32,
    /// Where second moments begin, words.
    second: u32,
    logit: f32,
}

@group(0) @binding(0) var<uniform> ceiling: Ceiling;
@group(0) @binding(1) var<storage, read_write> parameters: array<f32>;
@group(0) @binding(2) var<storage, read_write> state: array<f32>;

const ROW_OPACITY: u32 = 10u;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let index = unfold(group, groups) * 256u + local;
    if index >= ceiling.gaussians {
        return;
    }
    let place = (index / LANES * ROWS + ROW_OPACITY) * LANES + index % LANES;
    if parameters[place] > ceiling.logit {
        parameters[place] = ceiling.logit;
    }
    state[place] = 0.0;
    state[ceiling.second + place] = 0.0;
}
