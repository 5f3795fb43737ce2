//! What kernels are told: the host's side of `shaders/job.wgsl`.

use bytemuck::{Pod, Zeroable};

use crate::camera::{Camera, RenderSettings};
use crate::projection;

/// A view, as in `job.wgsl`.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(super) struct View {
    rotation: [[f32; 4]; 3],
    intrinsics: [f32; 4],
    limits: [f32; 4],
    background: [f32; 4],
    extent: [f32; 4],
    cuts: [f32; 4],
}

pub(super) const VIEW_BYTES: u64 = size_of::<View>() as u64;

impl View {
    /// `reference_m` is the depth that moments are relative to.
    pub fn new(camera: &Camera, settings: &RenderSettings, reference_m: f32) -> Self {
        let view = projection::View::new(camera, settings);
        let eye = view.eye.to_array();
        let [red, green, blue] = settings.background.to_array();
        let row = |i: usize| [view.rotation[i][0], view.rotation[i][1], view.rotation[i][2], eye[i]];
        Self {
            rotation: [row(0), row(1), row(2)],
            intrinsics: [view.fx, view.fy, view.cx, view.cy],
            limits: view.limits(),
            background: [red, green, blue, reference_m],
            extent: [view.width, view.height, view.low_pass(), view.alpha_min()],
            cuts: [
                view.near(),
                view.alpha_min().log2(),
                settings.transmittance_min,
                f32::from(u8::from(view.compensated())),
            ],
        }
    }
}

/// Sizes and settings, as in `job.wgsl`.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Job {
    pub gaussians: u32,
    pub sort_groups: u32,
    pub bin_groups: u32,
    pub capacity: u32,
    pub width: u32,
    pub height: u32,
    pub tiles_x: u32,
    pub tiles_y: u32,
    pub bands: u32,
    pub band_rows: u32,
    pub slot: u32,
    pub parameter_groups: u32,
    pub l1: f32,
    pub ssim: f32,
    pub depth: f32,
    pub free: f32,
    pub isotropic: f32,
    pub opacity: f32,
    pub scale: f32,
    pub lr_bands: f32,
    pub lr_means: f32,
    pub lr_log_scales: f32,
    pub lr_rotations: f32,
    pub lr_opacity: f32,
    pub lr_sh: f32,
    pub beta1: f32,
    pub beta2: f32,
    pub epsilon: f32,
    pub log_scale_min: f32,
    pub log_scale_max: f32,
    pub ln_beta1: f32,
    pub ln_beta2: f32,
    pub noise_rate: f32,
    pub noise_opacity: f32,
    pub noise_sharpness: f32,
    pub unused: u32,
    pub noise_key: [u32; 2],
    /// The uniform's size is a multiple of 16 bytes.
    pub padding: [u32; 2],
}

pub(super) const JOB_BYTES: u64 = size_of::<Job>() as u64;
/// Distance of jobs and of views in their rings: what every adapter accepts as an offset.
pub(super) const STRIDE: u64 = 256;
/// Views of a chain: all candidates of a round.
pub(super) const VIEWS_MAX: u32 = 128;
/// Words of the control buffer before the sums of the parameter pass: `CONTROL_SUMS` of `job.wgsl`.
pub(super) const CONTROL_WORDS: u64 = 4 + VIEWS_MAX as u64;
/// Whether the chain has stopped, and the most pairs that a view had.
pub(super) const CONTROL_HALT: usize = 0;
pub(super) const CONTROL_PAIRS: usize = 1;

/// Most workgroups along a dimension. Tests fold grids long before: 16.8 million Gaussians are beyond what they can draw.
const GROUPS_MAX: u32 = if cfg!(test) { 5 } else { 65_535 };

/// A grid of at least `groups` workgroups within the limit along a dimension, and hardly more.
pub(super) fn fold(groups: u32) -> (u32, u32) {
    folded(groups, GROUPS_MAX)
}

fn folded(groups: u32, most: u32) -> (u32, u32) {
    let rows = groups.div_ceil(most).max(1);
    (groups.div_ceil(rows).max(1), rows)
}

#[cfg(test)]
mod unit_tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn folded_grids_hold_all_groups_and_few_more(groups in 0_u32..1 << 30) {
            let (x, y) = folded(groups, 65_535);
            prop_assert!(x <= 65_535 && y <= 65_535 && x > 0 && y > 0);
            let held = u64::from(x) * u64::from(y);
            prop_assert!(held >= u64::from(groups) && held <= u64::from(groups.max(1)) + u64::from(y));
        }
    }

    #[test]
    fn jobs_and_views_fit_their_strides() {
        assert_eq!((JOB_BYTES, VIEW_BYTES), (160, 128));
        const { assert!(JOB_BYTES <= STRIDE && VIEW_BYTES <= STRIDE) };
        assert!(include_str!("shaders/job.wgsl").contains(&format!("CONTROL_SUMS: u32 = {CONTROL_WORDS}u;")));
    }
}
