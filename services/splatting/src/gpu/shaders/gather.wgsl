// The deterministic variant of the backward pass, second half: every Gaussian adds up what `settle_ordered.wgsl` kept apart,
// tile after tile and quarter after quarter.
//
// A Gaussian finds itself in a tile's list by halving: lists are in the order of depth, and of index where depths are equal.

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> rows: array<vec4f>;
@group(0) @binding(2) var<storage, read> boxes: array<u32>;
@group(0) @binding(3) var<storage, read> starts: array<u32>;
@group(0) @binding(4) var<storage, read> entries: array<u32>;
@group(0) @binding(5) var<storage, read> reached: array<u32>;
@group(0) @binding(6) var<storage, read> partials: array<f32>;
@group(0) @binding(7) var<storage, read_write> gradients: array<f32>;

/// Where a Gaussian is in the part of a tile's list that was used; `end` where it is not.
fn find(index: u32, begin: u32, end: u32) -> u32 {
    let depth = rows[ROW * index + 1u].w;
    var low = begin;
    var high = end;
    while low < high {
        let middle = (low + high) / 2u;
        let other = entries[middle];
        let other_depth = rows[ROW * other + 1u].w;
        if other_depth < depth || (other_depth == depth && other < index) {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    if low < end && entries[low] == index {
        return low;
    }
    return end;
}

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
    let box = boxes[index];
    let low = vec2u(box, box >> 8u) & vec2u(255u);
    let high = vec2u(box >> 16u, box >> 24u) & vec2u(255u);
    let tiles = job.tiles_x * job.tiles_y;
    var sums = array<f32, 11>();
    for (var y = low.y; y <= high.y; y++) {
        for (var x = low.x; x <= high.x; x++) {
            let tile = y * job.tiles_x + x;
            let begin = starts[tile];
            let end = begin + reached[tile];
            let entry = find(index, begin, end);
            if entry == end {
                continue;
            }
            let blocks = reached[tiles + entry];
            for (var quarter = 0u; quarter < 4u; quarter++) {
                let first_block = quarter / 2u * 8u + quarter % 2u * 2u;
                if (blocks >> first_block & 51u) != 0u {
                    for (var k = 0u; k < 11u; k++) {
                        sums[k] += partials[MOMENTS * (4u * entry + quarter) + k];
                    }
                }
            }
        }
    }
    for (var k = 0u; k < 11u; k++) {
        gradients[MOMENTS * index + k] = sums[k];
    }
}
