// Adds up the terms of an iteration's loss, in an order that is always the same, into a slot of the ring that the host
// reads. One workgroup.

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> control: array<u32>;
@group(0) @binding(2) var<storage, read> terms: array<f32>;
/// Twelve words of each iteration: five sums of the image, three of the model, whether it counts, pairs, drawn Gaussians.
@group(0) @binding(3) var<storage, read_write> ring: array<u32>;

const TERMS: u32 = 8u;
const RING_WORDS: u32 = 12u;

var<workgroup> sums: array<array<f32, 8>, 256>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) local: u32) {
    var sum = array<f32, 8>();
    for (var tile = local; tile < job.tiles_x * job.tiles_y; tile += 256u) {
        for (var k = 0u; k < 5u; k++) {
            sum[k] += terms[TERMS * tile + k];
        }
    }
    for (var group = local; group < job.parameter_groups; group += 256u) {
        for (var k = 0u; k < 3u; k++) {
            sum[5u + k] += bitcast<f32>(control[CONTROL_SUMS + 3u * group + k]);
        }
    }
    sums[local] = sum;
    for (var step = 128u; step > 0u; step /= 2u) {
        workgroupBarrier();
        if local < step {
            for (var k = 0u; k < 8u; k++) {
                sums[local][k] += sums[local + step][k];
            }
        }
    }
    if local == 0u {
        let at = RING_WORDS * job.slot;
        for (var k = 0u; k < 8u; k++) {
            ring[at + k] = bitcast<u32>(sums[0][k]);
        }
        ring[at + 8u] = 1u - min(control[CONTROL_HALT], 1u);
        ring[at + 9u] = control[CONTROL_PAIRS];
        ring[at + 10u] = control[CONTROL_VISIBLE];
        ring[at + 11u] = 0u;
    }
}
