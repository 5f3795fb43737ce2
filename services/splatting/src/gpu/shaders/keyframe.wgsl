// What the kernels of the loss share: the keyframe, and the 11x11 Gaussian window of SSIM (sigma 1.5), which is separable.

/// Colour over grey 0.5 outside of the foreground; depth in metres where it was measured, 0 on foreground without a
/// measurement, IGNORED or FREE elsewhere.
@group(1) @binding(0) var<storage, read> keyframe: array<vec4f>;
/// Windowed means of the keyframe that no iteration changes: of colour, then of its square, three planes each.
@group(1) @binding(1) var<storage, read> keyframe_means: array<f32>;
/// For each tile whether it has foreground (1), and whether it or a tile around it has (2): elsewhere both images show the
/// same grey, the similarity is 1 and its gradient 0.
@group(1) @binding(2) var<storage, read> keyframe_tiles: array<u32>;

const IGNORED: f32 = -1.0;
const FREE: f32 = -2.0;
const HAS_FOREGROUND: u32 = 1u;
const NEAR_FOREGROUND: u32 = 2u;

const RADIUS: u32 = 5u;
/// Pixels along a side that a tile's result needs.
const SPAN: u32 = 26u;
const C1: f32 = 0.0001;
const C2: f32 = 0.0009;
/// Numbers that each tile adds to the terms of the loss: L1, squares, depth, alpha of free pixels, similarity.
const TERMS: u32 = 8u;

/// Half of the window, from its middle outwards; the eleven weights sum to 1.
const WINDOW = array<f32, 6>(0.26601172, 0.21300554, 0.10936070, 0.03600077, 0.0075987582, 0.0010283801);

/// The rendered colour over the background, over grey outside of the foreground; 0 outside of the image.
fn composited(at: vec2i, channel: u32) -> f32 {
    if any(at < vec2i()) || at.x >= i32(job.width) || at.y >= i32(job.height) {
        return 0.0;
    }
    let pixels = job.width * job.height;
    let i = u32(at.y) * job.width + u32(at.x);
    if keyframe[i].w < 0.0 {
        return 0.5;
    }
    return image[channel * pixels + i] + image[4u * pixels + i] * views[0].background[channel];
}
