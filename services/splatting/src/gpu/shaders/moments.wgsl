// Forward blending of the moments of depth (A1, A7) of every view of a chain: Σ w, Σ w (d - d0), Σ w (d - d0)². What becomes
// of a pixel's is in `moments_store.wgsl` and in `moments_variance.wgsl`.

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read> rows: array<vec4f>;
@group(0) @binding(3) var<storage, read> starts: array<u32>;
@group(0) @binding(4) var<storage, read> entries: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let view = group.z;
    let tiles = job.tiles_x * job.tiles_y;
    let tile = view * (tiles + 1u) + group.y * job.tiles_x + group.x;
    let begin = starts[tile];
    let end = starts[tile + 1u];
    let pixel = pixel_of(group.xy, local);
    let centre = vec2f(pixel) + 0.5;
    let alpha_min = views[view].extent.w;
    let limit = views[view].cuts.z;
    let reference = views[view].background.w;
    let block = local / 16u;
    var alive = blocks_inside(group.xy);
    var first_moment = 0.0;
    var second_moment = 0.0;
    var transmittance = 1.0;
    for (var first = begin; first < end && alive != 0u; first += BATCH) {
        clear_lists(local);
        workgroupBarrier();
        if first + local < end {
            let splat = entries[view * job.capacity + first + local];
            let reached = load_splat(view * job.gaussians + splat, local, group.xy, alive);
        }
        workgroupBarrier();
        for (var word = 0u; word < BATCH_WORDS; word++) {
            var bits = atomicLoad(&reaches[block * BATCH_WORDS + word]);
            while bits != 0u {
                let k = 32u * word + firstTrailingBit(bits);
                bits &= bits - 1u;
                let weight = transmittance * alpha_at(k, centre, alpha_min);
                let depth = batch[ROW * k + 1u].w - reference;
                first_moment += weight * depth;
                second_moment += weight * depth * depth;
                transmittance -= weight;
            }
        }
        alive &= blocks_going(local, transmittance, limit);
    }
    take(view, group.xy, pixel, local, 1.0 - transmittance, first_moment, second_moment);
}
