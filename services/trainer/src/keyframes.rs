//! From a keyframe on disk to what training needs: image at training size, pixel classes, camera.
//!
//! Keyframes are read from the mission folder and never from the bus: the folder is the truth, and after a restart
//! everything is still there.

use glam::Vec3;
use shared_types::config::trainer::LossMask;
use shared_types::config::{ModelConfig, TrainerConfig};
use shared_types::folder::{FolderError, Keyframe, MissionFolder};
use shared_types::frames::{Intrinsics, Pose};
use splatting::rgbd::clip_box::ClipBox;
use splatting::rgbd::downsample::{self, DownsampleError, SmallImage};
use splatting::rgbd::masks;
use splatting::{Camera, TrainingView};

/// Where keyframes come from.
pub trait KeyframeSource: Send {
    /// The keyframe with this id; `None` when there is none.
    ///
    /// # Errors
    /// When it is there and cannot be read.
    fn read(&mut self, id: u64) -> Result<Option<Keyframe>, FolderError>;
}

impl KeyframeSource for MissionFolder {
    fn read(&mut self, id: u64) -> Result<Option<Keyframe>, FolderError> {
        self.read_keyframe(id)
    }
}

/// Why a keyframe cannot be trained on.
#[derive(Debug, thiserror::Error)]
pub enum KeyframeError {
    /// There is none.
    #[error("keyframe {id:06} is not in the mission folder; the round may only name keyframes that were stored")]
    Missing {
        /// Its id.
        id: u64,
    },
    /// It cannot be read.
    #[error("keyframe {id:06}: {source}")]
    Read {
        /// Its id.
        id: u64,
        /// Why.
        source: FolderError,
    },
    /// It has another size than training wants.
    #[error("keyframe {id:06}: {source}")]
    Size {
        /// Its id.
        id: u64,
        /// Why.
        source: DownsampleError,
    },
    /// The optimiser refuses it.
    #[error("keyframe {id:06}: {source}")]
    View {
        /// Its id.
        id: u64,
        /// Why.
        source: splatting::ViewError,
    },
}

/// The renderer's camera for a pose and a pinhole camera.
#[must_use]
pub fn renderer_camera(world_from_camera: &Pose, intrinsics: &Intrinsics) -> Camera {
    Camera {
        world_from_camera: splatting::Pose {
            rotation: world_from_camera.rotation.as_quat().normalize(),
            translation: world_from_camera.position_m.as_vec3(),
        },
        fx: intrinsics.fx as f32,
        fy: intrinsics.fy as f32,
        cx: intrinsics.cx as f32,
        cy: intrinsics.cy as f32,
        width: intrinsics.width,
        height: intrinsics.height,
    }
}

/// A keyframe at training size.
#[derive(Debug, Clone)]
pub struct SmallKeyframe {
    /// The camera at training size.
    pub camera: Camera,
    /// Colour and depth.
    pub image: SmallImage,
}

/// Reads a keyframe and brings it to training size.
///
/// # Errors
/// [`KeyframeError`] names the keyframe and what is wrong with it.
pub fn load(source: &mut dyn KeyframeSource, id: u64, model: &ModelConfig) -> Result<SmallKeyframe, KeyframeError> {
    let keyframe =
        source.read(id).map_err(|source| KeyframeError::Read { id, source })?.ok_or(KeyframeError::Missing { id })?;
    let intrinsics = keyframe.frame.intrinsics;
    let size = |source| KeyframeError::Size { id, source };
    let factor = downsample::factor(intrinsics.width, intrinsics.height, model.width, model.height).map_err(size)?;
    let image = downsample::downsample(intrinsics.width, intrinsics.height, &keyframe.rgb, &keyframe.depth_m(), factor)
        .map_err(size)?;
    Ok(SmallKeyframe {
        camera: renderer_camera(&keyframe.frame.world_from_camera(), &intrinsics.downsampled(factor)),
        image,
    })
}

/// A keyframe as training holds it.
pub struct View {
    /// The camera at training size.
    pub camera: Camera,
    /// Centre z, metres, 0 = no measurement.
    pub depth_m: Vec<f32>,
    /// Colours, depths and classes as the optimiser wants them.
    pub training: TrainingView,
}

impl core::fmt::Debug for View {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("View").field("camera", &self.camera).finish_non_exhaustive()
    }
}

impl View {
    /// Prepares a keyframe: its pixels are classified against the clip box (A31), or all count (`paper`).
    ///
    /// # Errors
    /// [`KeyframeError::View`].
    pub fn new(
        id: u64,
        keyframe: SmallKeyframe,
        config: &TrainerConfig,
        clip: &ClipBox,
    ) -> Result<Self, KeyframeError> {
        let SmallKeyframe { camera, image } = keyframe;
        let training = match config.loss_mask {
            LossMask::Foreground => {
                let classes = masks::classify(&camera, &image.depth_m, clip);
                TrainingView::new(camera, &image.rgb, &image.depth_m, &classes)
            }
            LossMask::FullImage => TrainingView::full_image(camera, &image.rgb, &image.depth_m),
        }
        .map_err(|source| KeyframeError::View { id, source })?;
        Ok(Self { camera, depth_m: image.depth_m, training })
    }

    /// Where it was taken, metres.
    #[must_use]
    pub fn eye(&self) -> Vec3 {
        self.camera.world_from_camera.translation
    }
}
