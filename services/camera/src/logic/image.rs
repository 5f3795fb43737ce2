//! From an image of a source to a keyframe, and to the header of a frame.

use shared_types::config::CameraConfig;
use shared_types::folder::{Exposure, Frame, Gate, Keyframe};
use shared_types::messages::{CaptureRequest, FrameHeader, KeyframeReason};

use super::gate::Shot;
use super::pose_buffer::CameraMotion;
use crate::source::Image;

/// The keyframe of a captured image. Depth outside the camera's range reads 0.
///
/// # Errors
/// When the image is not one with colour of the size it says, or the reason is not a keyframe's.
pub fn keyframe(
    config: &CameraConfig,
    request: &CaptureRequest,
    shot: &Shot,
    exposure_locked: bool,
    image: &Image<'_>,
) -> Result<Keyframe, String> {
    let pixels = image.intrinsics.width as usize * image.intrinsics.height as usize;
    if !image.has_color || image.items.len() != pixels * 5 {
        return Err(format!("the image has {} bytes; expected {} with colour", image.items.len(), pixels * 5));
    }
    let reason =
        KeyframeReason::from_code(request.reason).ok_or_else(|| format!("unknown reason {}", request.reason))?;
    let (rgb, depth) = image.items.split_at(pixels * 3);
    let in_range = |units: u16| {
        let depth_m = f64::from(units) * image.depth_unit_m;
        if (config.depth_min_m..=config.depth_max_m).contains(&depth_m) { units } else { 0 }
    };
    let depth_units = depth.chunks_exact(2).map(|pair| in_range(u16::from_le_bytes([pair[0], pair[1]]))).collect();
    let frame = Frame {
        id: request.keyframe_id,
        stamp_ns: image.stamp_ns,
        reason,
        candidate: (request.candidate != u32::MAX).then_some(request.candidate),
        target_id: request.target_id,
        look_at_m: request.look_at_m,
        world_from_camera_position_m: shot.motion.world_from_camera.position_m.to_array(),
        world_from_camera_xyzw: shot.motion.world_from_camera.rotation.to_array(),
        intrinsics: image.intrinsics,
        depth_unit_m: image.depth_unit_m,
        gate: Gate {
            missed: shot.gate_missed,
            speed_mps: shot.motion.speed_mps,
            rate_radps: shot.motion.rate_radps,
            time_uncertainty_s: shot.still.time_uncertainty_s,
            blur_px: shot.still.blur_px,
        },
        exposure: Exposure { locked: exposure_locked, time_s: config.exposure_s },
    };
    Ok(Keyframe { frame, rgb: rgb.to_vec(), depth_units })
}

/// Header of an image of the stream, or of a small depth image.
#[must_use]
pub fn stream_header(id: u64, image: &Image<'_>, motion: &CameraMotion, time_uncertainty_s: f64) -> FrameHeader {
    let mut header = FrameHeader {
        id,
        depth_unit_m: image.depth_unit_m,
        speed_mps: motion.speed_mps,
        rate_radps: motion.rate_radps,
        time_uncertainty_s,
        has_color: u32::from(image.has_color),
        reason: KeyframeReason::Stream.code(),
        candidate: u32::MAX,
        ..FrameHeader::default()
    };
    header.set_world_from_camera(&motion.world_from_camera);
    header.set_intrinsics(&image.intrinsics);
    header
}
