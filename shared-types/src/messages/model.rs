//! The model: training rounds, and snapshots of the Gaussians.

use crate::{codes, payload};

payload! {
    /// Request of `trainer/round`; the items are the keyframe ids (u64) to train on, all of which lie in the mission folder.
    pub struct RoundRequest [72] {
        /// Number of the round, from 0 (the seed views).
        pub round: u32,
        /// Most iterations (Eq. 6).
        pub max_iterations: u32,
        /// 1: end early once the loss has flattened.
        pub stop_when_flat: u32,
        /// Train only on this many views nearest to the newest (the orbit baseline's window); 0: all.
        pub window: u32,
        /// Centre of the clip box in the world, metres.
        pub box_center_m: [f64; 3],
        /// Edge of the clip box, metres.
        pub box_size_m: f64,
        /// Radius of the candidate sphere, metres.
        pub radius_m: f64,
        /// Height of the fitted ground, metres.
        pub ground_z_m: f64,
        /// Seed of the round's view order.
        pub seed: u64,
    }
}

codes! {
    /// How far a training round is.
    pub enum RoundStatus {
        /// Running.
        Progress = 1, "progress",
        /// Over; on disk, and its final snapshot published.
        Done = 2, "done",
        /// Cannot be run; the reason says why.
        Failed = 3, "failed",
    }
}

payload! {
    /// Reply of `trainer/round`: several `Progress`, then one `Done` or `Failed`.
    pub struct RoundReply [168] {
        /// Generation of the final snapshot; 0 before `Done`.
        pub generation: u64,
        /// Gaussians in the model.
        pub gaussians: u64,
        /// Number of the round.
        pub round: u32,
        /// [`RoundStatus`] code.
        pub status: u32,
        /// Iterations run in this round.
        pub iterations: u32,
        /// Iterations run in the mission.
        pub total_iterations: u32,
        /// Mean loss (Eq. 7) of the last 100 iterations.
        pub loss: f64,
        /// PSNR over foreground pixels of the last 100 training images, dB.
        pub psnr_train_db: f64,
        /// Why it failed; text.
        pub reason: [u8; 120],
    }
}

payload! {
    /// Header of `model/snapshot`; the items are the Gaussians.
    pub struct SnapshotHeader [64] {
        /// Increases with every snapshot of a mission, over restarts too.
        pub generation: u64,
        /// Training iterations behind it.
        pub iterations: u64,
        /// Centre of the clip box, metres.
        pub box_center_m: [f64; 3],
        /// Edge of the clip box, metres.
        pub box_size_m: f64,
        /// Round it belongs to.
        pub round: u32,
        /// 1 for the last snapshot of a round.
        pub is_final: u32,
        /// Degree of the spherical harmonics (0 live).
        pub sh_degree: u32,
        /// Unused, zero.
        pub reserved: u32,
    }
}

payload! {
    /// One Gaussian, as on channels and in checkpoints.
    pub struct GaussianRow [72] {
        /// Centre in the world, metres.
        pub mean_m: [f32; 3],
        /// Natural logarithms of the standard deviations along the own axes, metres.
        pub log_scales: [f32; 3],
        /// Rotation of the own axes, (x, y, z, w), unit length.
        pub rotation_xyzw: [f32; 4],
        /// Logit of the opacity.
        pub opacity_logit: f32,
        /// Degree-0 spherical-harmonics coefficients (red, green, blue): colour = 0.5 + 0.28209479 sh.
        pub sh0: [f32; 3],
        /// Stable id: low and high half.
        pub id: [u32; 2],
        /// Round of its birth.
        pub birth_round: u32,
        /// Unused, zero.
        pub reserved: u32,
    }
}

const _: () = assert!(size_of::<GaussianRow>() == 18 * 4);
