// Backward blending: from the gradient by every pixel to ten moments per splat. A workgroup of 64 per quarter of a tile,
// 16 threads for each of its four 4x4 blocks.
//
// For a splat with alpha a, transmittance T before it and c = Σ_k g_k f_k (gradients of the channels times its values):
// dL/da = T c - R / (1 - a), where R is the sum of weight times c over everything behind it, less g_A times the last
// transmittance. R begins as the sum over all, known from the forward pass, and shrinks; nothing is divided by T.
// With h = a dL/da a splat's gradient is determined by Σ h, h dx, h dy, h dx², h dx dy, h dy² and weight times g_k, k = 1..4.
//
// Sixteen splats at a time, in two halves. First the threads of a block are its pixels and go past the splats, which is a
// chain, leaving h and the weight of each. Then they are the splats and sum over the pixels: no shuffles, no atomics
// but one addition of each moment per (block, splat).
//
// What becomes of a block's sums is up to one of three files: `settle_native.wgsl` and `settle_compare.wgsl` add them to the
// splat's at once, in no order; `settle_ordered.wgsl` keeps them apart, for `gather.wgsl` to add in an order.

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> views: array<View>;
@group(0) @binding(2) var<storage, read> rows: array<vec4f>;
@group(0) @binding(3) var<storage, read> starts: array<u32>;
@group(0) @binding(4) var<storage, read> entries: array<u32>;
@group(0) @binding(5) var<storage, read> reached: array<u32>;
@group(0) @binding(6) var<storage, read> image: array<f32>;

const BATCH: u32 = 128u;
/// Words of a block's list.
const WORDS: u32 = 4u;
const TOGETHER: u32 = 16u;

var<workgroup> batch: array<vec4f, 384>;
var<workgroup> splats: array<u32, 128>;
var<workgroup> reaches: array<atomic<u32>, 16>;
var<workgroup> upstream: array<vec4f, 64>;
/// h and weight of splat k of 16 at pixel p of a block.
var<workgroup> shares: array<vec2f, 1024>;
var<workgroup> rounds: u32;

/// A place in a block's list: word, and bits of it that are left.
struct Cursor {
    word: u32,
    bits: u32,
}

/// The next splat of a block; BATCH where there is none.
fn next_splat(cursor: ptr<function, Cursor>, block: u32) -> u32 {
    while (*cursor).bits == 0u && (*cursor).word + 1u < WORDS {
        (*cursor).word += 1u;
        (*cursor).bits = atomicLoad(&reaches[block * WORDS + (*cursor).word]);
    }
    if (*cursor).bits == 0u {
        return BATCH;
    }
    let k = 32u * (*cursor).word + firstTrailingBit((*cursor).bits);
    (*cursor).bits &= (*cursor).bits - 1u;
    return k;
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let pixels = job.width * job.height;
    let tiles = job.tiles_x * job.tiles_y;
    let tile = group.y / 2u * job.tiles_x + group.x / 2u;
    let begin = starts[tile];
    let end = begin + reached[tile];
    let block = local / 16u;
    let lane = local % 16u;
    let pixel = group.xy * 8u + vec2u(block % 2u, block / 2u) * 4u + vec2u(lane % 4u, lane / 4u);
    let centre = vec2f(pixel) + 0.5;
    let corner = vec2f(group.xy * 8u + vec2u(block % 2u, block / 2u) * 4u) + 0.5;
    let alpha_min = views[0].extent.w;

    var gradient = vec4f();
    var behind = 0.0;
    if pixel.x < job.width && pixel.y < job.height {
        let at = pixel.y * job.width + pixel.x;
        gradient = vec4f(
            image[5u * pixels + at], image[6u * pixels + at], image[7u * pixels + at], image[8u * pixels + at]);
        let total = vec4f(image[at], image[pixels + at], image[2u * pixels + at], image[3u * pixels + at]);
        behind = dot(gradient, total) - image[9u * pixels + at] * image[4u * pixels + at];
    }
    upstream[local] = gradient;
    var transmittance = 1.0;

    let quarter = group.y % 2u * 2u + group.x % 2u;
    // Bits of this quarter's blocks among the sixteen of the tile.
    let first_block = group.y % 2u * 8u + group.x % 2u * 2u;
    for (var first = begin; first < end; first += BATCH) {
        if local < 4u * WORDS {
            atomicStore(&reaches[local], 0u);
        }
        workgroupBarrier();
        for (var i = local; i < min(BATCH, end - first); i += 64u) {
            let blocks = reached[tiles + first + i] >> first_block;
            let mine = (blocks & 3u) | (blocks >> 2u & 12u);
            if mine != 0u {
                prepare(4u * (first + i) + quarter);
                let splat = entries[first + i];
                splats[i] = splat;
                batch[3u * i] = rows[ROW * splat];
                batch[3u * i + 1u] = rows[ROW * splat + 1u];
                batch[3u * i + 2u] = rows[ROW * splat + 2u];
                for (var b = 0u; b < 4u; b++) {
                    if (mine >> b & 1u) != 0u {
                        atomicOr(&reaches[b * WORDS + i / 32u], 1u << (i % 32u));
                    }
                }
            }
        }
        workgroupBarrier();
        if local == 0u {
            var most = 0u;
            for (var b = 0u; b < 4u; b++) {
                var count = 0u;
                for (var word = 0u; word < WORDS; word++) {
                    count += countOneBits(atomicLoad(&reaches[b * WORDS + word]));
                }
                most = max(most, count);
            }
            rounds = (most + TOGETHER - 1u) / TOGETHER;
        }
        let all_rounds = workgroupUniformLoad(&rounds);
        var cursor = Cursor(0u, atomicLoad(&reaches[block * WORDS]));
        for (var round = 0u; round < all_rounds; round++) {
            // Threads are pixels.
            var mine = BATCH;
            for (var j = 0u; j < TOGETHER; j++) {
                let k = next_splat(&cursor, block);
                var share = vec2f();
                if k < BATCH {
                    if j == lane {
                        mine = k;
                    }
                    let row = batch[3u * k];
                    let more = batch[3u * k + 1u];
                    let d = centre - row.xy;
                    let alpha = exp2(more.y - d.x * (d.x * row.z + d.y * row.w) - d.y * d.y * more.x);
                    if alpha >= alpha_min {
                        let weight = transmittance * alpha;
                        let value = dot(gradient, vec4f(batch[3u * k + 2u].xyz, more.w));
                        behind -= weight * value;
                        share = vec2f(alpha * (transmittance * value - behind / (1.0 - alpha)), weight);
                        transmittance -= weight;
                    }
                }
                shares[(block * TOGETHER + j) * 16u + lane] = share;
            }
            workgroupBarrier();
            // Threads are splats.
            var sums = array<f32, 10>();
            var touched = false;
            if mine < BATCH {
                let mean = batch[3u * mine].xy;
                var sum_h = vec3f();
                var sum_hh = vec3f();
                var sum_channels = vec4f();
                for (var i = 0u; i < 16u; i++) {
                    // Each thread begins elsewhere, so that they read from different banks.
                    let p = (i + lane) % 16u;
                    let share = shares[(block * TOGETHER + lane) * 16u + p];
                    let d = corner + vec2f(vec2u(p % 4u, p / 4u)) - mean;
                    let hd = share.x * d;
                    sum_h += vec3f(share.x, hd);
                    sum_hh += vec3f(hd.x * d.x, hd.x * d.y, hd.y * d.y);
                    sum_channels += share.y * upstream[block * 16u + p];
                    touched |= share.y > 0.0;
                }
                sums = array<f32, 10>(
                    sum_h.x, sum_h.y, sum_h.z, sum_hh.x, sum_hh.y, sum_hh.z,
                    sum_channels.x, sum_channels.y, sum_channels.z, sum_channels.w);
            }
            settle(touched, block, splats[mine % BATCH], 4u * (first + mine % BATCH) + quarter, sums);
            workgroupBarrier();
        }
        workgroupBarrier();
    }
}
