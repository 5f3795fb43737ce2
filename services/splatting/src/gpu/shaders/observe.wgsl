// What densification wants to know of every Gaussian, from the moments of its gradient before Adam takes them: the same as
// `statistics.rs`, in its layout. A thread per Gaussian.

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read> parameters: array<f32>;
@group(0) @binding(3) var<storage, read> gradients: array<f32>;
@group(0) @binding(4) var<storage, read> control: array<u32>;
/// Of each block of 16 Gaussians: sums of gradients, views, largest radii.
@group(0) @binding(5) var<storage, read_write> statistics: array<f32>;

const STATISTICS: u32 = 3u;
const RADIUS_SIGMAS: f32 = 3.0;
const LENGTH_MAX: f32 = 1e15;

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
    let p = project_gaussian(views[0], gaussian_at(index));
    if !p.visible {
        return;
    }
    let at = index / LANES * LANES * STATISTICS + index % LANES;
    let place = MOMENTS * index;
    if gradients[place + 10u] > 0.0 {
        let h = vec2f(gradients[place + 1u], gradients[place + 2u]);
        let d_mean = vec2f(dot(p.conic.xy, h), dot(p.conic.yz, h));
        let pull = length(d_mean * 0.5 * views[0].extent.xy);
        if below(pull, LENGTH_MAX) {
            statistics[at] += pull;
        }
    }
    statistics[at + LANES] += 1.0;
    // Largest eigenvalue of the covariance with its low-pass.
    let a = p.raw.x + views[0].extent.z;
    let c = p.raw.z + views[0].extent.z;
    let difference = 0.5 * (a - c);
    let variance = 0.5 * (a + c) + sqrt(difference * difference + p.raw.y * p.raw.y);
    let widest = at + 2u * LANES;
    statistics[widest] = max(statistics[widest], RADIUS_SIGMAS * sqrt(variance));
}
