// What a view is scored by, summed over the pixels of each tile that lie in the projected box: the variance of depth, alpha,
// and how many pixels are transparent. The same formulas as `uncertainty/variance.rs`.

/// The box as a view sees it.
struct Candidate {
    /// Corners of the box relative to the eye, metres; alpha below which a pixel knows nothing.
    low: vec4f,
    /// 1 where variance is normalised by alpha, 0 where it is as printed.
    high: vec4f,
    /// Edge of the box, metres.
    edge: vec4f,
}

/// A vector for each tile of each view.
@group(0) @binding(5) var<storage, read_write> sums: array<vec4f>;
/// For each row of each view the first column that counts and, in the high half, the first behind it that does not.
@group(0) @binding(6) var<storage, read> spans: array<u32>;
@group(0) @binding(7) var<storage, read> candidates: array<Candidate>;

/// Length of a pixel's ray inside the box, in depth.
fn chord(view: u32, pixel: vec2u) -> f32 {
    let intrinsics = views[view].intrinsics;
    let at_one = (vec2f(pixel) + 0.5 - intrinsics.zw) / intrinsics.xy;
    // The point of the ray at depth 1 lies this far from the eye, so the ray's parameter is the depth.
    let direction = views[view].rotation_x.xyz * at_one.x + views[view].rotation_y.xyz * at_one.y
        + views[view].rotation_z.xyz;
    let low = candidates[view].low;
    let high = candidates[view].high;
    var enter = 0.0;
    var leave = 1e30;
    for (var axis = 0u; axis < 3u; axis++) {
        if abs(direction[axis]) < 1e-12 {
            if low[axis] > 0.0 || high[axis] < 0.0 {
                return 0.0;
            }
        } else {
            let a = low[axis] / direction[axis];
            let b = high[axis] / direction[axis];
            enter = max(enter, min(a, b));
            leave = min(leave, max(a, b));
        }
    }
    return select(0.0, leave - enter, enter < leave && leave < 1e30);
}

fn variance_of(view: u32, pixel: vec2u, alpha: f32, first: f32, second: f32) -> f32 {
    let normalised = candidates[view].high.w > 0.0;
    var variance = 0.0;
    if alpha < candidates[view].low.w {
        let half = 0.5 * candidates[view].edge.x;
        variance = half * half;
        if normalised {
            let length = chord(view, pixel);
            variance = length * length / 12.0;
        }
    } else if normalised {
        let mean = first / alpha;
        variance = second / alpha - mean * mean;
    } else {
        let offset = views[view].background.w;
        variance = second - first * first + offset * (1.0 - alpha) * (2.0 * first + offset * alpha);
    }
    return max(variance, 0.0);
}

fn take(view: u32, tile: vec2u, pixel: vec2u, local: u32, alpha: f32, first: f32, second: f32) {
    var sum = vec4f();
    if pixel.y < job.height {
        let span = spans[view * job.height + pixel.y];
        if pixel.x >= (span & 0xffffu) && pixel.x < (span >> 16u) {
            let known = clamp(alpha, 0.0, 1.0);
            let transparent = f32(known < candidates[view].low.w);
            sum = vec4f(variance_of(view, pixel, known, first, second), known, transparent, 0.0);
        }
    }
    // The batch of splats is no longer needed.
    workgroupBarrier();
    batch[local] = sum;
    for (var step = 128u; step > 0u; step /= 2u) {
        workgroupBarrier();
        if local < step {
            batch[local] += batch[local + step];
        }
    }
    if local == 0u {
        sums[(view * job.tiles_y + tile.y) * job.tiles_x + tile.x] = batch[0];
    }
}
