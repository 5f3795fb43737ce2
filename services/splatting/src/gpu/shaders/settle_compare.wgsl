// Sums of a block are added to its splat's by comparing and swapping their bits.

@group(0) @binding(7) var<storage, read_write> gradients: array<atomic<u32>>;

fn add_to(place: u32, value: f32) {
    var old = atomicLoad(&gradients[place]);
    loop {
        let sum = bitcast<u32>(bitcast<f32>(old) + value);
        let result = atomicCompareExchangeWeak(&gradients[place], old, sum);
        if result.exchanged {
            break;
        }
        old = result.old_value;
    }
}

fn prepare(place: u32) {}

fn settle(touched: bool, block: u32, splat: u32, place: u32, sums: array<f32, 10>) {
    if touched {
        for (var k = 0u; k < 10u; k++) {
            add_to(MOMENTS * splat + k, sums[k]);
        }
        add_to(MOMENTS * splat + 10u, 1.0);
    }
}
