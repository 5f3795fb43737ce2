// What both blends share: batches of a tile's splats, tested against its sixteen 4x4 blocks.
//
// A block has a bit for each splat of the batch, so that its pixels go past the few splats that reach it and no others.
// At 100,000 Gaussians a splat reaches two of the sixteen blocks on average: an eighth of the work of a plain tile.

const BATCH: u32 = 256u;
const BATCH_WORDS: u32 = 8u;

/// Rows of the batch, ROW vectors each.
var<workgroup> batch: array<vec4f, 768>;
/// For each block the splats of the batch that reach it, a bit each.
var<workgroup> reaches: array<atomic<u32>, 128>;
/// Blocks that go on, a bit each.
var<workgroup> going: atomic<u32>;
var<workgroup> going_copy: u32;

/// The nearest pixel centre of the four from `low` on.
fn nearest(x: f32, low: f32) -> f32 {
    return clamp(x, low, low + 3.0);
}

/// The blocks of a tile that a splat reaches, a bit each: the least exponent over a block lies at the mean, or on the
/// nearer vertical or horizontal edge. A margin covers rounding. `origin` is the centre of the tile's first pixel.
fn blocks_reached(row: vec4f, more: vec4f, origin: vec2f) -> u32 {
    let b_by_a = row.w * 0.5 / row.z;
    let b_by_c = row.w * 0.5 / more.x;
    let reach = more.z * 1.0001 + 1e-3;
    var bits = 0u;
    for (var j = 0u; j < 4u; j++) {
        let top = origin.y + 4.0 * f32(j);
        let dy = nearest(row.y, top) - row.y;
        for (var i = 0u; i < 4u; i++) {
            let left = origin.x + 4.0 * f32(i);
            let dx = nearest(row.x, left) - row.x;
            let vy = nearest(row.y - dx * b_by_c, top) - row.y;
            let vertical = dx * (dx * row.z + vy * row.w) + vy * vy * more.x;
            let hx = nearest(row.x - dy * b_by_a, left) - row.x;
            let horizontal = hx * (hx * row.z + dy * row.w) + dy * dy * more.x;
            bits |= u32(min(vertical, horizontal) <= reach) << (4u * j + i);
        }
    }
    return bits;
}

/// Blocks of a tile that begin inside of the image.
fn blocks_inside(tile: vec2u) -> u32 {
    var bits = 0u;
    for (var block = 0u; block < 16u; block++) {
        let at = tile * TILE + 4u * vec2u(block % 4u, block / 4u);
        bits |= u32(at.x < job.width && at.y < job.height) << block;
    }
    return bits;
}

/// Pixel of a thread: blocks one after the other, and in them rows.
fn pixel_of(tile: vec2u, local: u32) -> vec2u {
    let block = local / 16u;
    return tile * TILE + vec2u(block % 4u, block / 4u) * 4u + vec2u(local % 4u, local / 4u % 4u);
}

/// Loads splat `local` of a batch and tells the blocks; returns those that it reaches.
fn load_splat(place: u32, local: u32, tile: vec2u, alive: u32) -> u32 {
    let row = rows[ROW * place];
    let more = rows[ROW * place + 1u];
    batch[ROW * local] = row;
    batch[ROW * local + 1u] = more;
    batch[ROW * local + 2u] = rows[ROW * place + 2u];
    let reached = blocks_reached(row, more, vec2f(tile * TILE) + 0.5) & alive;
    var left = reached;
    while left != 0u {
        let block = firstTrailingBit(left);
        left &= left - 1u;
        atomicOr(&reaches[block * BATCH_WORDS + local / 32u], 1u << (local % 32u));
    }
    return reached;
}

/// Alpha of a splat of the batch at a pixel's centre; 0 where it does not count.
fn alpha_at(k: u32, pixel: vec2f, alpha_min: f32) -> f32 {
    let row = batch[ROW * k];
    let more = batch[ROW * k + 1u];
    let d = pixel - row.xy;
    let alpha = exp2(more.y - d.x * (d.x * row.z + d.y * row.w) - d.y * d.y * more.x);
    return select(0.0, alpha, alpha >= alpha_min);
}

/// Forgets the batch before.
fn clear_lists(local: u32) {
    if local < 16u * BATCH_WORDS {
        atomicStore(&reaches[local], 0u);
    }
    if local == 0u {
        atomicStore(&going, 0u);
    }
}

/// Blocks that still have a pixel that light gets through; the same for all threads.
fn blocks_going(local: u32, transmittance: f32, limit: f32) -> u32 {
    if transmittance >= limit {
        atomicOr(&going, 1u << (local / 16u));
    }
    workgroupBarrier();
    if local == 0u {
        going_copy = atomicLoad(&going);
    }
    return workgroupUniformLoad(&going_copy);
}
