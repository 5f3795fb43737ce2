// Addition to a float of a buffer that other workgroups add to as well, by comparing and swapping its bits.

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
