// Fused multiply-adds and nothing else, to know what the adapter can do: eight chains of vectors per thread.

@group(0) @binding(0) var<storage, read_write> out: array<vec4f>;

const ROUNDS: u32 = 512u;

@compute @workgroup_size(256)
fn main(@builtin(global_invocation_id) id: vec3u, @builtin(num_workgroups) groups: vec3u) {
    var chains: array<vec4f, 8>;
    for (var k = 0u; k < 8u; k++) {
        chains[k] = vec4f(f32(id.x + k)) * 1e-6;
    }
    let a = vec4f(0.999 + f32(groups.y) * 1e-4);
    let b = vec4f(0.001);
    for (var round = 0u; round < ROUNDS; round++) {
        for (var k = 0u; k < 8u; k++) {
            chains[k] = fma(chains[k], a, b);
        }
    }
    var sum = vec4f();
    for (var k = 0u; k < 8u; k++) {
        sum += chains[k];
    }
    out[id.x % arrayLength(&out)] = sum;
}
