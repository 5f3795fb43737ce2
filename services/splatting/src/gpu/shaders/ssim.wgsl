// Structural similarity of a keyframe and its rendering, and its derivatives by the windowed means: a workgroup per tile.
//
// With S(E[x], E[x²], E[xt]) the gradient by x is E[∂S/∂E[x]] + 2 x E[∂S/∂E[x²]] + t E[∂S/∂E[xt]], because the windowed
// mean is its own adjoint (Wang et al. 2004, as in `ssim.rs`). `loss.wgsl` takes these means.

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read> image: array<f32>;
/// Derivatives by E[x], E[x²] and E[xt], three planes of each channel.
@group(0) @binding(3) var<storage, read_write> maps: array<f32>;
/// TERMS of each tile.
@group(0) @binding(4) var<storage, read_write> terms: array<f32>;

var<workgroup> rendered: array<f32, 676>;
var<workgroup> wanted: array<f32, 676>;
/// Means along x of x, x² and xt.
var<workgroup> along: array<vec3f, 416>;
var<workgroup> sums: array<f32, 256>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let tile = group.y * job.tiles_x + group.x;
    let corner = group.xy * TILE;
    let pixels = job.width * job.height;
    let pixel = corner + vec2u(local % TILE, local / TILE);
    let inside = pixel.x < job.width && pixel.y < job.height;
    let at = pixel.y * job.width + pixel.x;
    var similarity = select(0.0, 3.0, inside);
    let flags = keyframe_tiles[tile];
    if (flags & NEAR_FOREGROUND) != 0u && job.ssim != 0.0 {
        similarity = 0.0;
        for (var channel = 0u; channel < 3u; channel++) {
            for (var i = local; i < SPAN * SPAN; i += 256u) {
                let near = vec2i(corner) + vec2i(vec2u(i % SPAN, i / SPAN)) - i32(RADIUS);
                rendered[i] = composited(near, channel);
                var target_color = 0.0;
                if all(near >= vec2i()) && near.x < i32(job.width) && near.y < i32(job.height) {
                    target_color = keyframe[u32(near.y) * job.width + u32(near.x)][channel];
                }
                wanted[i] = target_color;
            }
            workgroupBarrier();
            for (var i = local; i < SPAN * TILE; i += 256u) {
                let middle = i / TILE * SPAN + i % TILE + RADIUS;
                let x = rendered[middle];
                var mean = WINDOW[0] * vec3f(x, x * x, x * wanted[middle]);
                for (var k = 1u; k <= RADIUS; k++) {
                    let a = rendered[middle - k];
                    let b = rendered[middle + k];
                    mean += WINDOW[k] * vec3f(a + b, a * a + b * b, a * wanted[middle - k] + b * wanted[middle + k]);
                }
                along[i] = mean;
            }
            workgroupBarrier();
            let middle = local + RADIUS * TILE;
            var mean = WINDOW[0] * along[middle];
            for (var k = 1u; k <= RADIUS; k++) {
                mean += WINDOW[k] * (along[middle - k * TILE] + along[middle + k * TILE]);
            }
            if inside {
                let t = keyframe_means[channel * pixels + at];
                let tt = keyframe_means[(3u + channel) * pixels + at];
                let x = mean.x;
                let a1 = 2.0 * x * t + C1;
                let a2 = 2.0 * (mean.z - x * t) + C2;
                let b1 = x * x + t * t + C1;
                let b2 = mean.y - x * x + tt - t * t + C2;
                let inv = 1.0 / (b1 * b2);
                let value = a1 * a2 * inv;
                similarity += value;
                let d_variance = -value * inv * b1;
                let d_covariance = 2.0 * a1 * inv;
                // By the mean directly, and through the variance (-2 x) and the covariance (-t).
                let direct = 2.0 * (t * a2 * inv - x * value * inv * b2);
                maps[(3u * channel) * pixels + at] = direct - 2.0 * x * d_variance - t * d_covariance;
                maps[(3u * channel + 1u) * pixels + at] = d_variance;
                maps[(3u * channel + 2u) * pixels + at] = d_covariance;
            }
            workgroupBarrier();
        }
    }
    sums[local] = similarity;
    for (var step = 128u; step > 0u; step /= 2u) {
        workgroupBarrier();
        if local < step {
            sums[local] += sums[local + step];
        }
    }
    if local == 0u {
        terms[TERMS * tile + 4u] = sums[0];
    }
}
