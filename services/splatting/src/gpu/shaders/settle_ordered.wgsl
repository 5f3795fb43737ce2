// Sums of the blocks of a quarter of a tile are added up in the order of the blocks, in a place of their own for each
// (tile, splat) and quarter. The same bits every time, for 192 bytes per pair.

@group(0) @binding(7) var<storage, read_write> partials: array<f32>;

/// Forgets what an iteration before left.
fn prepare(place: u32) {
    for (var k = 0u; k < 11u; k++) {
        partials[MOMENTS * place + k] = 0.0;
    }
}

fn settle(touched: bool, block: u32, splat: u32, place: u32, sums: array<f32, 10>) {
    for (var turn = 0u; turn < 4u; turn++) {
        storageBarrier();
        workgroupBarrier();
        if touched && turn == block {
            for (var k = 0u; k < 10u; k++) {
                partials[MOMENTS * place + k] += sums[k];
            }
            partials[MOMENTS * place + 10u] += 1.0;
        }
    }
}
