// Moments as they are: three planes of each view.

@group(0) @binding(5) var<storage, read_write> moments: array<f32>;

fn take(view: u32, tile: vec2u, pixel: vec2u, local: u32, alpha: f32, first: f32, second: f32) {
    if pixel.x < job.width && pixel.y < job.height {
        let pixels = job.width * job.height;
        let at = 3u * view * pixels + pixel.y * job.width + pixel.x;
        moments[at] = alpha;
        moments[at + pixels] = first;
        moments[at + 2u * pixels] = second;
    }
}
