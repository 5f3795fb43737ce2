// Radix sort by depth, second half of a pass: every key to its place. See `sort_count.wgsl`.
//
// This part is common to both ways of finding a key's place among the 256 of a chunk: `sort_move_plain.wgsl` and
// `sort_move_subgroup.wgsl` have the entry points.

struct Pass {
    shift: u32,
    is_first: u32,
}

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read> counts: array<u32>;
@group(0) @binding(4) var<storage, read_write> control: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> order_out: array<u32>;
/// Workgroups of the next passes, and from word 4 on of the binning, three numbers each.
@group(0) @binding(7) var<storage, read_write> arguments: array<u32>;
@group(1) @binding(0) var<uniform> pass_: Pass;

/// Digit of a key that is not drawn.
const NO_DIGIT: u32 = 256u;

/// Where the next key of each digit goes.
var<workgroup> next: array<atomic<u32>, 256>;
var<workgroup> scan: array<u32, 256>;

/// A key of a chunk.
struct Item {
    key: u32,
    value: u32,
    digit: u32,
}

/// How a pass is shared.
struct Share {
    /// Keys of each workgroup, a multiple of a chunk.
    part: u32,
    /// Keys that are left, in all.
    items: u32,
    groups: u32,
}

fn share_of(view: u32) -> Share {
    let items = select(control[CONTROL_VISIBLE + view], job.gaussians, pass_.is_first != 0u);
    let groups = sort_groups_for(items);
    let chunk = groups * 256u;
    return Share((items + chunk - 1u) / chunk * 256u, items, groups);
}

/// Finds where each digit of this workgroup begins: one thread per digit.
fn begin(view: u32, groups: u32, group: u32, local: u32) {
    var before = 0u;
    var total = 0u;
    for (var other = 0u; other < groups; other++) {
        let count = counts[(view * job.sort_groups + other) * 256u + local];
        before += select(0u, count, other < group);
        total += count;
    }
    scan[local] = total;
    workgroupBarrier();
    for (var step = 1u; step < 256u; step *= 2u) {
        let beside = select(0u, scan[max(local, step) - step], local >= step);
        workgroupBarrier();
        scan[local] += beside;
        workgroupBarrier();
    }
    atomicStore(&next[local], scan[local] - total + before);
    workgroupBarrier();
}

/// Tells the following passes how many keys are left, and how many workgroups that is. Not before every thread has read what
/// `share_of` reads.
fn finish(view: u32, group: u32, local: u32) {
    if pass_.is_first != 0u && group == 0u && local == 0u {
        let visible = scan[255];
        control[CONTROL_VISIBLE + view] = visible;
        // Chains of many views are dispatched by what any of them could need.
        if view == 0u {
            arguments[0] = sort_groups_for(visible);
            arguments[1] = 1u;
            arguments[2] = 1u;
            arguments[4] = bin_groups_for(visible);
            arguments[5] = (job.tiles_x * job.tiles_y + 255u) / 256u;
            arguments[6] = 1u;
        }
    }
}

fn item_at(view: u32, i: u32, end: u32) -> Item {
    var item = Item(NOT_DRAWN, i, NO_DIGIT);
    if i < end {
        item.key = keys[view * job.gaussians + i];
        if pass_.is_first == 0u {
            item.value = order[view * job.gaussians + i];
        }
    }
    if item.key != NOT_DRAWN {
        item.digit = item.key >> pass_.shift & 255u;
    }
    return item;
}

fn put(view: u32, item: Item, place: u32) {
    if item.digit != NO_DIGIT {
        keys_out[view * job.gaussians + place] = item.key;
        order_out[view * job.gaussians + place] = item.value;
    }
}
