// Addition to a float of a buffer that other workgroups add to as well, where the adapter can.

@group(0) @binding(7) var<storage, read_write> gradients: array<atomic<f32>>;

fn add_to(place: u32, value: f32) {
    atomicAdd(&gradients[place], value);
}
