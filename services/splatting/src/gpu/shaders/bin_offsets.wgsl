// Lists of splats per tile, second of three: where each tile's list begins, and where each workgroup's part of it does.
// One workgroup per view. Stops the chain where the pairs do not fit: nothing after this changes the model then, and the
// host makes room and goes on from the same iteration.

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read_write> control: array<atomic<u32>>;
@group(0) @binding(2) var<storage, read_write> table: array<u32>;
/// One more than tiles for each view.
@group(0) @binding(3) var<storage, read_write> starts: array<u32>;

var<workgroup> scan: array<u32, 256>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let view = group.z;
    let tiles = job.tiles_x * job.tiles_y;
    let per_thread = (tiles + 255u) / 256u;
    let first = min(local * per_thread, tiles);
    let last = min(first + per_thread, tiles);
    let base = view * job.bin_groups * tiles;
    let groups = bin_groups_for(atomicLoad(&control[CONTROL_VISIBLE + view]));
    var total = 0u;
    for (var tile = first; tile < last; tile++) {
        for (var part = 0u; part < groups; part++) {
            total += table[base + part * tiles + tile];
        }
    }
    scan[local] = total;
    workgroupBarrier();
    for (var step = 1u; step < 256u; step *= 2u) {
        let beside = select(0u, scan[max(local, step) - step], local >= step);
        workgroupBarrier();
        scan[local] += beside;
        workgroupBarrier();
    }
    var at = scan[local] - total;
    for (var tile = first; tile < last; tile++) {
        starts[view * (tiles + 1u) + tile] = min(at, job.capacity);
        for (var part = 0u; part < groups; part++) {
            let place = base + part * tiles + tile;
            let count = table[place];
            table[place] = at;
            at += count;
        }
    }
    if local == 255u {
        let pairs = scan[255];
        starts[view * (tiles + 1u) + tiles] = min(pairs, job.capacity);
        atomicMax(&control[CONTROL_PAIRS], pairs);
        if pairs > job.capacity {
            atomicMax(&control[CONTROL_HALT], 1u);
        }
    }
}
