// Sums of a block are added to its splat's by atomic addition of floats, where the adapter can.

@group(0) @binding(7) var<storage, read_write> gradients: array<atomic<f32>>;

fn prepare(place: u32) {}

fn settle(touched: bool, block: u32, splat: u32, place: u32, sums: array<f32, 10>) {
    if touched {
        for (var k = 0u; k < 10u; k++) {
            atomicAdd(&gradients[MOMENTS * splat + k], sums[k]);
        }
        atomicAdd(&gradients[MOMENTS * splat + 10u], 1.0);
    }
}
