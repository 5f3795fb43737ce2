// Makes a new list of an old one: the compaction after pruning, the room for what is inserted, and the order along a
// curve, all in one gather. The sources are those of `edit.rs`. A thread per new Gaussian; one dispatch for each array that
// a model has. Words are copied as they are, so that a NaN stays the NaN that it was.

struct Rows {
    /// New Gaussians.
    count: u32,
    /// Words of a Gaussian, and how many Gaussians lie side by side: 16 in blocks, 1 where each has its words together.
    rows: u32,
    lanes: u32,
    /// Whether fresh ones have a copy, as of higher bands. Otherwise they keep the zeros of a new buffer.
    copies_fresh: u32,
    /// Where the array begins, words.
    old_begin: u32,
    new_begin: u32,
}

@group(0) @binding(0) var<uniform> rows: Rows;
@group(0) @binding(1) var<storage, read> sources: array<u32>;
@group(0) @binding(2) var<storage, read> before: array<u32>;
@group(0) @binding(3) var<storage, read_write> after: array<u32>;

const FRESH: u32 = 0x80000000u;
const BORN: u32 = 0xffffffffu;

fn place(index: u32, row: u32) -> u32 {
    return (index / rows.lanes * rows.rows + row) * rows.lanes + index % rows.lanes;
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let index = unfold(group, groups) * 256u + local;
    if index >= rows.count {
        return;
    }
    let source = sources[index];
    if source == BORN || ((source & FRESH) != 0u && rows.copies_fresh == 0u) {
        return;
    }
    let old = source & ~FRESH;
    for (var row = 0u; row < rows.rows; row++) {
        after[rows.new_begin + place(index, row)] = before[rows.old_begin + place(old, row)];
    }
}
