//! RGB-D images: frames, small depth images, keyframes, and the request to take one.

use glam::{DQuat, DVec3};

use crate::frames::{Intrinsics, Pose};
use crate::{codes, payload};

codes! {
    /// Why an image was taken.
    pub enum KeyframeReason {
        /// A frame of the stream.
        Stream = 0, "stream",
        /// The overhead view of the prior.
        PriorOverhead = 1, "prior-overhead",
        /// The side view of the prior.
        PriorSide = 2, "prior-side",
        /// A seed view.
        Seed = 3, "seed",
        /// A view chosen by the selector.
        Selected = 4, "selected",
        /// The overhead view of the prior again, to find where the world has gone.
        CheckOverhead = 5, "check-overhead",
        /// The side view of the prior again.
        CheckSide = 6, "check-side",
    }
}

impl KeyframeReason {
    /// Whether a view taken for this lies under `prior/`, where the next one takes its place: no keyframe of the model.
    #[must_use]
    pub fn is_survey(self) -> bool {
        matches!(self, Self::PriorOverhead | Self::PriorSide | Self::CheckOverhead | Self::CheckSide)
    }
}

payload! {
    /// Header of `camera/frame`, `camera/depth` and `camera/keyframe`. The items are `width * height * 3` bytes of sRGB
    /// colour (none on `camera/depth`), row by row, then `width * height` little-endian u16 of depth (centre z in units of
    /// `depth_unit_m`, 0 = no measurement). See [`FrameView`].
    pub struct FrameHeader [152] {
        /// Keyframe id; of the stream, a counter.
        pub id: u64,
        /// Pose of the camera (optical: x right, y down, z forward) in the world at the image's stamp: position, metres.
        pub world_from_camera_position_m: [f64; 3],
        /// Pose of the camera in the world: rotation.
        pub world_from_camera_xyzw: [f64; 4],
        /// Focal lengths in pixels.
        pub focal_px: [f64; 2],
        /// Principal point in pixels; the centre of pixel (0, 0) is (0.5, 0.5).
        pub principal_px: [f64; 2],
        /// Metres per unit of depth.
        pub depth_unit_m: f64,
        /// Speed of the camera at the stamp, m/s.
        pub speed_mps: f64,
        /// Angular rate of the camera at the stamp, rad/s.
        pub rate_radps: f64,
        /// One standard deviation of the stamp, seconds.
        pub time_uncertainty_s: f64,
        /// Width in pixels.
        pub width: u32,
        /// Height in pixels.
        pub height: u32,
        /// 1 when the items begin with colour.
        pub has_color: u32,
        /// [`KeyframeReason`] code.
        pub reason: u32,
        /// 1 when the capture gate was never met and the stillest frame was taken.
        pub gate_missed: u32,
        /// The candidate's index on the Fibonacci sphere, or `u32::MAX`.
        pub candidate: u32,
    }
}

impl FrameHeader {
    /// Pose of the camera in the world.
    #[must_use]
    pub fn world_from_camera(&self) -> Pose {
        Pose {
            position_m: DVec3::from_array(self.world_from_camera_position_m),
            rotation: DQuat::from_array(self.world_from_camera_xyzw).normalize(),
        }
    }

    /// Sets the pose of the camera in the world.
    pub fn set_world_from_camera(&mut self, pose: &Pose) {
        self.world_from_camera_position_m = pose.position_m.to_array();
        self.world_from_camera_xyzw = pose.rotation.to_array();
    }

    /// The pinhole camera.
    #[must_use]
    pub fn intrinsics(&self) -> Intrinsics {
        Intrinsics {
            fx: self.focal_px[0],
            fy: self.focal_px[1],
            cx: self.principal_px[0],
            cy: self.principal_px[1],
            width: self.width,
            height: self.height,
        }
    }

    /// Sets the pinhole camera, width and height included.
    pub fn set_intrinsics(&mut self, intrinsics: &Intrinsics) {
        self.focal_px = [intrinsics.fx, intrinsics.fy];
        self.principal_px = [intrinsics.cx, intrinsics.cy];
        self.width = intrinsics.width;
        self.height = intrinsics.height;
    }

    /// Number of item bytes that follow this header.
    #[must_use]
    pub fn items_len(&self) -> usize {
        let pixels = self.width as usize * self.height as usize;
        pixels * 2 + if self.has_color == 1 { pixels * 3 } else { 0 }
    }
}

/// The images of a frame, borrowed from where they lie (shared memory or a file's buffer).
#[derive(Debug, Clone, Copy)]
pub struct FrameView<'a> {
    /// What the images are.
    pub header: &'a FrameHeader,
    /// `width * height * 3` bytes of sRGB, row by row; empty on `camera/depth`.
    pub rgb: &'a [u8],
    depth_bytes: &'a [u8],
}

impl<'a> FrameView<'a> {
    /// Splits the items of a frame. `None` when their number does not fit the header, or the header is not sane
    /// (a size of zero, numbers that are not finite): the writer is another process and may be wild.
    #[must_use]
    pub fn new(header: &'a FrameHeader, items: &'a [u8]) -> Option<Self> {
        let sane = header.width > 0
            && header.height > 0
            && header.width <= 8192
            && header.height <= 8192
            && header.has_color <= 1
            && header.depth_unit_m > 0.0
            && header.depth_unit_m.is_finite()
            && header.world_from_camera_position_m.iter().all(|v| v.is_finite())
            && header.world_from_camera_xyzw.iter().all(|v| v.is_finite())
            && header.world_from_camera_xyzw.iter().map(|v| v * v).sum::<f64>() > 0.5
            && header.focal_px.iter().all(|v| v.is_finite() && *v > 0.0)
            && header.principal_px.iter().all(|v| v.is_finite());
        if !sane || items.len() != header.items_len() {
            return None;
        }
        let depth_len = header.width as usize * header.height as usize * 2;
        let (rgb, depth_bytes) = items.split_at(items.len() - depth_len);
        Some(Self { header, rgb, depth_bytes })
    }

    /// Depth of pixel `index` (row-major) in the header's units; 0 = no measurement or outside the image.
    #[must_use]
    pub fn depth_units(&self, index: usize) -> u16 {
        match self.depth_bytes.get(index * 2..index * 2 + 2) {
            Some(&[low, high]) => u16::from_le_bytes([low, high]),
            _ => 0,
        }
    }

    /// All depths in the header's units, row by row.
    #[must_use]
    pub fn depth_units_vec(&self) -> Vec<u16> {
        self.depth_bytes.chunks_exact(2).map(|b| u16::from_le_bytes([b[0], b[1]])).collect()
    }

    /// All depths in metres, row by row; 0 = no measurement.
    #[must_use]
    pub fn depth_m_vec(&self) -> Vec<f32> {
        #[expect(clippy::cast_possible_truncation, reason = "depth is kept as f32 metres inside programs")]
        let unit = self.header.depth_unit_m as f32;
        self.depth_bytes.chunks_exact(2).map(|b| f32::from(u16::from_le_bytes([b[0], b[1]])) * unit).collect()
    }
}

payload! {
    /// Request of `camera/capture`.
    pub struct CaptureRequest [56] {
        /// Keyframe id: the folder's number under `keyframes/`. The same id is answered from disk.
        pub keyframe_id: u64,
        /// The target whose end is the view; the camera waits until `vehicle/state` says that it arrived. 0: any.
        pub target_id: u64,
        /// Mission time at which to give up.
        pub deadline_ns: u64,
        /// What the camera should look at (the box centre), metres in the world.
        pub look_at_m: [f64; 3],
        /// [`KeyframeReason`] code.
        pub reason: u32,
        /// Candidate index, or `u32::MAX`.
        pub candidate: u32,
    }
}

codes! {
    /// What became of a capture.
    pub enum CaptureStatus {
        /// On disk and published.
        Stored = 1, "stored",
        /// The deadline passed.
        TimedOut = 2, "timed-out",
        /// The image could not be had (world or driver gone for good, disk full); the reason says which.
        Failed = 3, "failed",
        /// The request contradicts one with the same id.
        Refused = 4, "refused",
    }
}

payload! {
    /// Reply of `camera/capture`.
    pub struct CaptureReply [144] {
        /// Keyframe id of the request.
        pub keyframe_id: u64,
        /// Mission time of the image.
        pub image_stamp_ns: u64,
        /// [`CaptureStatus`] code.
        pub status: u32,
        /// 1 when the gate was never met and the stillest frame was taken.
        pub gate_missed: u32,
        /// Why not; text.
        pub reason: [u8; 120],
    }
}
