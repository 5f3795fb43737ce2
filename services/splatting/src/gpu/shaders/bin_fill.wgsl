// Lists of splats per tile, last of three: the lists, nearest splat first. See `bin_count.wgsl`.

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> control: array<u32>;
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read> boxes: array<u32>;
@group(0) @binding(4) var<storage, read> table: array<u32>;
@group(0) @binding(5) var<storage, read_write> entries: array<u32>;

var<workgroup> chunk: array<vec2u, 256>;

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
    var place = job.capacity;
    if tile < tiles {
        place = table[(view * job.bin_groups + group.x) * tiles + tile];
    }
    for (var first = begin; first < end; first += 256u) {
        let length = min(end - first, 256u);
        if local < length {
            let splat = order[base + first + local];
            chunk[local] = vec2u(splat, boxes[base + splat]);
        }
        workgroupBarrier();
        for (var i = 0u; i < length; i++) {
            let box = chunk[i].y;
            let low = vec2u(box, box >> 8u) & vec2u(255u);
            let high = vec2u(box >> 16u, box >> 24u) & vec2u(255u);
            if all(low <= at) && all(at <= high) {
                if place < job.capacity {
                    entries[view * job.capacity + place] = chunk[i].x;
                }
                place += 1u;
            }
        }
        workgroupBarrier();
    }
}
