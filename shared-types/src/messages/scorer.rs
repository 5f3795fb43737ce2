//! Scores of candidate views (Section IV-D of the paper).

use crate::{codes, payload};

codes! {
    /// How the depth variance of a pixel is taken (A1, A3, A4).
    pub enum VarianceMode {
        /// As printed: raw moments, transparent pixels (B/2)^2.
        Paper = 0, "paper",
        /// Normalised by alpha, transparent pixels L^2/12 of the ray's chord in the box.
        Normalised = 1, "normalised",
    }
}

payload! {
    /// Request of `scorer/score`; the items are the candidates and the visited views.
    pub struct ScoreRequest [112] {
        /// Snapshot to score on.
        pub generation: u64,
        /// Round the scores are for.
        pub round: u32,
        /// [`VarianceMode`] code.
        pub variance: u32,
        /// 1: clip the angular term to [0, 1] (I10).
        pub clip_angle: u32,
        /// Render width, pixels.
        pub width: u32,
        /// Render height, pixels.
        pub height: u32,
        /// Number of candidates N on the grid, for the grid scale sqrt(2 pi / N).
        pub grid_candidates: u32,
        /// Focal lengths at that size, pixels.
        pub focal_px: [f64; 2],
        /// Principal point at that size, pixels.
        pub principal_px: [f64; 2],
        /// Centre of the box in the world, metres.
        pub box_center_m: [f64; 3],
        /// Edge of the box, metres.
        pub box_size_m: f64,
        /// Weight of the uncertainty in Eq. 4 (0.6).
        pub weight_uncertainty: f64,
        /// Weight of the angle in Eq. 4 (0.4).
        pub weight_angle: f64,
    }
}

payload! {
    /// A view in a scoring request.
    pub struct CandidateView [64] {
        /// Camera position in the world, metres.
        pub position_m: [f64; 3],
        /// Camera (optical) attitude in the world.
        pub world_from_camera_xyzw: [f64; 4],
        /// Index on the Fibonacci sphere.
        pub index: u32,
        /// 1: a view already taken (only its direction counts); 0: to be scored.
        pub visited: u32,
    }
}

codes! {
    /// What became of a scoring request.
    pub enum ScoreStatus {
        /// The items are the scores.
        Done = 1, "done",
        /// The snapshot is not to be had any more; ask with `newest_generation`.
        GenerationGone = 2, "generation-gone",
        /// The snapshot has not been seen yet; being waited for.
        Waiting = 3, "waiting",
        /// The request makes no sense; the reason says why.
        Refused = 4, "refused",
    }
}

payload! {
    /// Reply of `scorer/score`; the items are the scores, in the order of the request's candidates.
    pub struct ScoreReply [160] {
        /// Snapshot that was scored.
        pub generation: u64,
        /// Newest final snapshot that the scorer holds.
        pub newest_generation: u64,
        /// CPU time of the scoring, nanoseconds.
        pub cpu_ns: u64,
        /// [`ScoreStatus`] code.
        pub status: u32,
        /// Candidates scored.
        pub candidates: u32,
        /// The 95th percentile that normalised the uncertainties.
        pub uncertainty_p95: f64,
        /// Why not; text.
        pub reason: [u8; 120],
    }
}

payload! {
    /// Every term of one candidate's score.
    pub struct CandidateScore [72] {
        /// Mean of the pixels' depth variances inside the projected box, m^2 (Eq. 3).
        pub mean_variance_m2: f64,
        /// Area of the projected box over the image's (Eq. 3).
        pub area_fraction: f64,
        /// u_c: their product (Eq. 3).
        pub uncertainty: f64,
        /// Normalised and clipped uncertainty (Eq. 4).
        pub uncertainty_normalised: f64,
        /// a_c: least angle to a visited view over the grid scale (Eq. 4), clipped where asked.
        pub angle_normalised: f64,
        /// s_c (Eq. 4).
        pub score: f64,
        /// Mean alpha inside the projected box: the alpha-coverage signal.
        pub mean_alpha: f64,
        /// Share of the box's pixels with alpha < 0.1.
        pub transparent_fraction: f64,
        /// Index on the Fibonacci sphere.
        pub index: u32,
        /// Unused, zero.
        pub reserved: u32,
    }
}
