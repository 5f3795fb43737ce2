// Radix sort by depth, first half of a pass: how often each value of eight bits occurs in the part of each workgroup.
//
// Least significant digit first, four passes, stable. Each workgroup takes an equal part of however many keys there are (see
// `groups.wgsl`). The first pass reads all Gaussians in their
// order and skips those that are not drawn, which is the compaction. Two dispatches a pass instead of three: the scan over
// workgroups is so short that every workgroup of the second half repeats it.

struct Pass {
    shift: u32,
    is_first: u32,
}

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read> control: array<u32>;
@group(0) @binding(3) var<storage, read_write> counts: array<u32>;
@group(1) @binding(0) var<uniform> pass_: Pass;

var<workgroup> histogram: array<atomic<u32>, 256>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let view = group.z;
    let items = select(control[CONTROL_VISIBLE + view], job.gaussians, pass_.is_first != 0u);
    let groups = sort_groups_for(items);
    if group.x >= groups {
        return;
    }
    let part = (items + groups * 256u - 1u) / (groups * 256u) * 256u;
    let end = min((group.x + 1u) * part, items);
    atomicStore(&histogram[local], 0u);
    workgroupBarrier();
    for (var i = group.x * part + local; i < end; i += 256u) {
        let key = keys[view * job.gaussians + i];
        if key != NOT_DRAWN {
            atomicAdd(&histogram[key >> pass_.shift & 255u], 1u);
        }
    }
    workgroupBarrier();
    counts[(view * job.sort_groups + group.x) * 256u + local] = atomicLoad(&histogram[local]);
}
