// The loss of a keyframe and its gradient by what every pixel accumulated: a workgroup per tile (paper Eq. 7, with A30 and
// A31; the same terms as `loss.rs`).

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> views: array<View>;
/// Five planes of what was rendered; then, written here, gradients by red, green, blue, depth and alpha.
@group(0) @binding(2) var<storage, read_write> image: array<f32>;
@group(0) @binding(3) var<storage, read> maps: array<f32>;
@group(0) @binding(4) var<storage, read_write> terms: array<f32>;

/// Depth counts where alpha exceeds this.
const DEPTH_ALPHA_MIN: f32 = 0.5;

var<workgroup> map: array<f32, 676>;
var<workgroup> along: array<f32, 416>;
var<workgroup> sums: array<vec4f, 256>;

/// Windowed mean of a map at a thread's pixel; 0 outside of the image.
fn windowed(plane: u32, corner: vec2u, local: u32) -> f32 {
    let pixels = job.width * job.height;
    workgroupBarrier();
    for (var i = local; i < SPAN * SPAN; i += 256u) {
        let near = vec2i(corner) + vec2i(vec2u(i % SPAN, i / SPAN)) - i32(RADIUS);
        var value = 0.0;
        if all(near >= vec2i()) && near.x < i32(job.width) && near.y < i32(job.height) {
            value = maps[plane * pixels + u32(near.y) * job.width + u32(near.x)];
        }
        map[i] = value;
    }
    workgroupBarrier();
    for (var i = local; i < SPAN * TILE; i += 256u) {
        let middle = i / TILE * SPAN + i % TILE + RADIUS;
        var mean = WINDOW[0] * map[middle];
        for (var k = 1u; k <= RADIUS; k++) {
            mean += WINDOW[k] * (map[middle - k] + map[middle + k]);
        }
        along[i] = mean;
    }
    workgroupBarrier();
    let middle = local + RADIUS * TILE;
    var mean = WINDOW[0] * along[middle];
    for (var k = 1u; k <= RADIUS; k++) {
        mean += WINDOW[k] * (along[middle - k * TILE] + along[middle + k * TILE]);
    }
    return mean;
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let tile = group.y * job.tiles_x + group.x;
    let corner = group.xy * TILE;
    let pixels = job.width * job.height;
    let pixel = corner + vec2u(local % TILE, local / TILE);
    let inside = pixel.x < job.width && pixel.y < job.height;
    let at = pixel.y * job.width + pixel.x;
    let background = views[0].background.xyz;
    let has_similarity = (keyframe_tiles[tile] & HAS_FOREGROUND) != 0u && job.ssim != 0.0;

    var wanted = vec4f(0.0, 0.0, 0.0, IGNORED);
    var transmittance = 1.0;
    if inside {
        wanted = keyframe[at];
        transmittance = image[4u * pixels + at];
    }
    let foreground = wanted.w >= 0.0;
    let alpha = 1.0 - transmittance;
    var sum = vec4f();
    var d_alpha = 0.0;
    for (var channel = 0u; channel < 3u; channel++) {
        var slope = 0.0;
        let x = composited(vec2i(pixel), channel);
        if has_similarity {
            let mean = windowed(3u * channel, corner, local);
            let variance = windowed(3u * channel + 1u, corner, local);
            let covariance = windowed(3u * channel + 2u, corner, local);
            slope = mean + 2.0 * x * variance + wanted[channel] * covariance;
        }
        if foreground {
            let difference = x - wanted[channel];
            sum.x += abs(difference);
            sum.y += difference * difference;
            let d = sign(difference) * job.l1 - slope * job.ssim;
            d_alpha -= d * background[channel];
            image[(5u + channel) * pixels + at] = d;
        } else if inside {
            image[(5u + channel) * pixels + at] = 0.0;
        }
    }
    if inside {
        var d_depth = 0.0;
        if wanted.w > 0.0 && alpha > DEPTH_ALPHA_MIN {
            let expected = image[3u * pixels + at] / alpha;
            let difference = expected - wanted.w;
            sum.z = abs(difference);
            d_depth = sign(difference) * job.depth / alpha;
            d_alpha -= d_depth * expected;
        }
        if wanted.w == FREE {
            sum.w = alpha;
            d_alpha += job.free;
        }
        image[8u * pixels + at] = d_depth;
        image[9u * pixels + at] = d_alpha;
    }
    sums[local] = sum;
    for (var step = 128u; step > 0u; step /= 2u) {
        workgroupBarrier();
        if local < step {
            sums[local] += sums[local + step];
        }
    }
    if local == 0u {
        terms[TERMS * tile] = sums[0].x;
        terms[TERMS * tile + 1u] = sums[0].y;
        terms[TERMS * tile + 2u] = sums[0].z;
        terms[TERMS * tile + 3u] = sums[0].w;
    }
}
