//! The simulator's truth, and images rendered of it. In simulation only.

use crate::{codes, payload};

payload! {
    /// `simulator/truth`: once per tick.
    pub struct Truth [144] {
        /// Mission time.
        pub now_ns: u64,
        /// True position of the body in the world, metres.
        pub position_m: [f64; 3],
        /// True velocity, m/s.
        pub velocity_mps: [f64; 3],
        /// True attitude of the body (FLU).
        pub world_from_body_xyzw: [f64; 4],
        /// True position of the camera, metres.
        pub camera_position_m: [f64; 3],
        /// True attitude of the camera (optical).
        pub world_from_camera_xyzw: [f64; 4],
    }
}

codes! {
    /// What an image is wanted for: how finely it is rendered.
    pub enum RenderPurpose {
        /// A keyframe: full quality.
        Capture = 1, "capture",
        /// The stream: one sample per pixel.
        Stream = 2, "stream",
        /// Depth only.
        Depth = 3, "depth",
    }
}

payload! {
    /// Request of `simulator/render`.
    pub struct RenderRequest [56] {
        /// Mission time whose true camera pose is rendered; at most 5 s old.
        pub image_stamp_ns: u64,
        /// Focal lengths, pixels.
        pub focal_px: [f64; 2],
        /// Principal point, pixels.
        pub principal_px: [f64; 2],
        /// Width, pixels.
        pub width: u32,
        /// Height, pixels.
        pub height: u32,
        /// [`RenderPurpose`] code.
        pub purpose: u32,
        /// Unused, zero.
        pub reserved: u32,
    }
}

codes! {
    /// What became of a render request.
    pub enum RenderStatus {
        /// The items are the images.
        Done = 1, "done",
        /// The truth of that stamp is gone or was never had.
        NoTruth = 2, "no-truth",
        /// The request makes no sense.
        Refused = 3, "refused",
    }
}

payload! {
    /// Reply of `simulator/render`; the items are as on `camera/frame` (colour unless the purpose is depth, then depth).
    pub struct RenderReply [40] {
        /// Stamp of the request.
        pub image_stamp_ns: u64,
        /// Metres per unit of depth.
        pub depth_unit_m: f64,
        /// CPU time of the rendering, nanoseconds.
        pub cpu_ns: u64,
        /// [`RenderStatus`] code.
        pub status: u32,
        /// Width, pixels.
        pub width: u32,
        /// Height, pixels.
        pub height: u32,
        /// 1 when the items begin with colour.
        pub has_color: u32,
    }
}
