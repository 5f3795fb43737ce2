// Puts Gaussians that are no copies into their places: those that a depth image gave birth to, halves of one that was
// split, clones with an id of their own. A thread per Gaussian.
//
// What is inserted from depth, and where, the host decides (`rgbd/insertion.rs`): each point claims a voxel of a grid that
// outlives the model, one point after the other, and a point that rounding put on the other side of a voxel's face would be
// another model. So rows come up as they were made there, the same on both back ends.

struct Inserted {
    count: u32,
}

@group(0) @binding(0) var<uniform> inserted: Inserted;
/// Of each: index, id in two words, parameters.
@group(0) @binding(1) var<storage, read> rows: array<u32>;
@group(0) @binding(2) var<storage, read_write> parameters: array<u32>;
@group(0) @binding(3) var<storage, read_write> ids: array<u32>;

const ROW_WORDS: u32 = 3u + ROWS;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let k = unfold(group, groups) * 256u + local;
    if k >= inserted.count {
        return;
    }
    let row = ROW_WORDS * k;
    let index = rows[row];
    ids[2u * index] = rows[row + 1u];
    ids[2u * index + 1u] = rows[row + 2u];
    let place = index / LANES * LANES * ROWS + index % LANES;
    for (var i = 0u; i < ROWS; i++) {
        parameters[place + LANES * i] = rows[row + 3u + i];
    }
}
