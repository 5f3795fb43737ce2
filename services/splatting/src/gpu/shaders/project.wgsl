// Projects every Gaussian into every view of the chain: one thread each.
//
// Leaves a row of the splat, the box of tiles that it may touch (first and last tile along x and y, a byte each), and its
// depth as a key that sorts: the bits of a positive float are in the order of the floats.

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read> parameters: array<f32>;
@group(0) @binding(3) var<storage, read> bands: array<f32>;
@group(0) @binding(4) var<storage, read_write> rows: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> boxes: array<u32>;
@group(0) @binding(6) var<storage, read_write> keys: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let index = unfold(group, groups) * 256u + local;
    if index >= job.gaussians {
        return;
    }
    let view = views[group.z];
    let place = group.z * job.gaussians + index;
    let g = gaussian_at(index);
    let p = project_gaussian(view, g);
    // A box without tiles, until there is one.
    boxes[place] = 0x0000ffffu;
    if !p.visible {
        keys[place] = NOT_DRAWN;
        return;
    }
    var color = 0.5 + SH_C0 * g.sh;
    if job.bands > 0u {
        let offset = g.mean - vec3f(view.rotation_x.w, view.rotation_y.w, view.rotation_z.w);
        let direction = normalize(offset);
        for (var k = 0u; k < job.bands; k++) {
            let at = band_place(index, job.band_rows, k, 0u);
            color += basis(k, direction) * vec3f(bands[at], bands[at + LANES], bands[at + 2u * LANES]);
        }
        if !(below(color.x, VALUE_MAX) && below(color.y, VALUE_MAX) && below(color.z, VALUE_MAX)) {
            keys[place] = NOT_DRAWN;
            return;
        }
    }
    let conic = p.conic * HALF_LOG2_E;
    rows[ROW * place] = vec4f(p.mean, conic.x, 2.0 * conic.y);
    rows[ROW * place + 1u] = vec4f(conic.z, p.log2_alpha, p.threshold, p.point.z);
    rows[ROW * place + 2u] = vec4f(color, 0.0);
    let low = vec2u(p.low) / TILE;
    let high = vec2u(p.high) / TILE;
    boxes[place] = low.x | low.y << 8u | high.x << 16u | high.y << 24u;
    keys[place] = bitcast<u32>(p.point.z);
}
