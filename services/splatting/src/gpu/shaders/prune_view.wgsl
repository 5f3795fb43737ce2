// Pruning by depth: whether each Gaussian lies before everything that one keyframe measured in the 3x3 pixels about it. The
// rule is that of `rgbd/prune.rs`; a thread per Gaussian, a dispatch per keyframe.
//
// Here the numbers are rounded differently than on the host, so each test is made with a margin to both sides: one count is
// of the views that surely look through a Gaussian, the other of those that may. Where that makes a difference the host
// decides, and both back ends remove the same ones.

struct DepthView {
    /// Rows of camera_from_world; w is the eye in the world.
    rotation_x: vec4f,
    rotation_y: vec4f,
    rotation_z: vec4f,
    /// fx, fy, cx, cy, pixels.
    intrinsics: vec4f,
    gaussians: u32,
    width: u32,
    height: u32,
    front_m: f32,
}

@group(0) @binding(0) var<uniform> view: DepthView;
@group(0) @binding(1) var<storage, read> parameters: array<f32>;
/// Centre z, metres, 0 where nothing was measured.
@group(0) @binding(2) var<storage, read> depths: array<f32>;
/// Views that surely look through each Gaussian, and from 65,536 on those that may.
@group(0) @binding(3) var<storage, read_write> looked_through: array<u32>;

const SURELY: u32 = 0x00010001u;
const MAYBE: u32 = 0x00010000u;
/// Rounding of both ways to the camera's coordinates, relative to those of the world: ten times what was estimated.
const ROUNDING: f32 = 4e-6;
/// Rounding of a product or quotient, with something to spare.
const ROUNDING_PX: f32 = 1e-6;

/// Whether all measured depths about a pixel position lie beyond `depth`.
fn lies_before(at: vec2f, depth: f32) -> bool {
    if !(at.x >= 1.0 && at.y >= 1.0 && at.x < f32(view.width) - 1.0 && at.y < f32(view.height) - 1.0) {
        return false;
    }
    let first = vec2u(at) - 1u;
    var before = true;
    for (var i = 0u; i < 9u; i++) {
        let measured = depths[(first.y + i / 3u) * view.width + first.x + i % 3u];
        before = before && measured > 0.0 && depth < measured;
    }
    return before;
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let index = unfold(group, groups) * 256u + local;
    if index >= view.gaussians {
        return;
    }
    let mean = gaussian_at(index).mean;
    let eye = vec3f(view.rotation_x.w, view.rotation_y.w, view.rotation_z.w);
    let size = dot(abs(mean), vec3f(1.0)) + dot(abs(eye), vec3f(1.0));
    if !below(size, VALUE_MAX) {
        looked_through[index] += MAYBE;
        return;
    }
    let offset = mean - eye;
    let point = vec3f(dot(view.rotation_x.xyz, offset), dot(view.rotation_y.xyz, offset), dot(view.rotation_z.xyz, offset));
    let margin_m = ROUNDING * size;
    if point.z <= margin_m {
        // In the camera's plane, or behind it.
        looked_through[index] += select(0u, MAYBE, point.z >= -margin_m);
        return;
    }
    let ratio = point.xy / point.z;
    let centred = view.intrinsics.xy * ratio;
    let at = centred + view.intrinsics.zw;
    let margin_px = view.intrinsics.xy * (margin_m * (1.0 + abs(ratio)) / point.z)
        + ROUNDING_PX * (abs(centred) + abs(view.intrinsics.zw));
    if max(margin_px.x, margin_px.y) >= 0.5 {
        looked_through[index] += MAYBE;
        return;
    }
    let depth = point.z + view.front_m;
    let margin_depth = margin_m + ROUNDING_PX * depth;
    var surely = true;
    var maybe = false;
    let low = at - margin_px;
    let high = at + margin_px;
    let one_pixel = all(floor(low) == floor(high));
    for (var corner = 0u; corner < 4u; corner++) {
        let place = vec2f(select(low.x, high.x, (corner & 1u) != 0u), select(low.y, high.y, (corner & 2u) != 0u));
        surely = surely && lies_before(place, depth + margin_depth);
        maybe = maybe || lies_before(place, depth - margin_depth);
        if one_pixel {
            break;
        }
    }
    looked_through[index] += select(select(0u, MAYBE, maybe), SURELY, surely);
}
