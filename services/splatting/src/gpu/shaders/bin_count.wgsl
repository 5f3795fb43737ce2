// Lists of splats per tile, first of three: how many splats of each workgroup's part of the depth order touch each tile.
//
// A thread owns a tile and goes past all splats of its part: what it counts (and later writes) is in depth order without
// a sort, an atomic or a scan. 300 tiles times 200,000 splats are 60 million tests of a box of four bytes, which a GPU
// does in about ten microseconds; sorting the pairs by tile would take more dispatches than that is worth.

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> control: array<u32>;
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read> boxes: array<u32>;
@group(0) @binding(4) var<storage, read_write> table: array<u32>;

var<workgroup> chunk: array<u32, 256>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let view = group.z;
    let base = view * job.gaussians;
    let splats = control[CONTROL_VISIBLE + view];
    let groups = bin_groups_for(splats);
    if group.x >= groups {
        return;
    }
    let part = (splats + groups - 1u) / groups;
    let begin = min(group.x * part, splats);
    let end = min(begin + part, splats);
    let tiles = job.tiles_x * job.tiles_y;
    let tile = group.y * 256u + local;
    let at = vec2u(tile % job.tiles_x, tile / job.tiles_x);
    var count = 0u;
    for (var first = begin; first < end; first += 256u) {
        let length = min(end - first, 256u);
        if local < length {
            chunk[local] = boxes[base + order[base + first + local]];
        }
        workgroupBarrier();
        for (var i = 0u; i < length; i++) {
            let box = chunk[i];
            let low = vec2u(box, box >> 8u) & vec2u(255u);
            let high = vec2u(box >> 16u, box >> 24u) & vec2u(255u);
            count += u32(all(low <= at) && all(at <= high));
        }
        workgroupBarrier();
    }
    if tile < tiles {
        table[(view * job.bin_groups + group.x) * tiles + tile] = count;
    }
}
