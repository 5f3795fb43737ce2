// Forward blending of colour and depth, front to back: a workgroup per tile, a thread per pixel.
//
// Leaves sums of colour and depth before the background, and transmittance. For the backward pass it keeps which blocks
// each entry of the tile's list reached, and how much of the list was used before all blocks had stopped.

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read> rows: array<vec4f>;
@group(0) @binding(3) var<storage, read> starts: array<u32>;
@group(0) @binding(4) var<storage, read> entries: array<u32>;
/// Entries used of each tile, then the blocks that each entry reached.
@group(0) @binding(5) var<storage, read_write> reached: array<u32>;
/// Planes of the image: red, green, blue, depth, transmittance; the loss has more behind them.
@group(0) @binding(6) var<storage, read_write> image: array<f32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let tiles = job.tiles_x * job.tiles_y;
    let tile = group.y * job.tiles_x + group.x;
    let begin = starts[tile];
    let end = starts[tile + 1u];
    let pixel = pixel_of(group.xy, local);
    let centre = vec2f(pixel) + 0.5;
    let alpha_min = views[0].extent.w;
    let limit = views[0].cuts.z;
    let block = local / 16u;
    var alive = blocks_inside(group.xy);
    var sums = vec4f();
    var transmittance = 1.0;
    var used = 0u;
    for (var first = begin; first < end && alive != 0u; first += BATCH) {
        clear_lists(local);
        workgroupBarrier();
        if first + local < end {
            let entry = first + local;
            reached[tiles + entry] = load_splat(entries[entry], local, group.xy, alive);
        }
        workgroupBarrier();
        for (var word = 0u; word < BATCH_WORDS; word++) {
            var bits = atomicLoad(&reaches[block * BATCH_WORDS + word]);
            while bits != 0u {
                let k = 32u * word + firstTrailingBit(bits);
                bits &= bits - 1u;
                let weight = transmittance * alpha_at(k, centre, alpha_min);
                sums += weight * vec4f(batch[ROW * k + 2u].xyz, batch[ROW * k + 1u].w);
                transmittance -= weight;
            }
        }
        used = min(first + BATCH, end) - begin;
        alive &= blocks_going(local, transmittance, limit);
    }
    if local == 0u {
        reached[tile] = used;
    }
    if pixel.x < job.width && pixel.y < job.height {
        let pixels = job.width * job.height;
        let at = pixel.y * job.width + pixel.x;
        image[at] = sums.x;
        image[pixels + at] = sums.y;
        image[2u * pixels + at] = sums.z;
        image[3u * pixels + at] = sums.w;
        image[4u * pixels + at] = transmittance;
    }
}
