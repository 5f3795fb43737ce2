//! The mission: what it is doing, and what it can be told.

use crate::{codes, payload};

/// A number for a mission, by its id and folder: what ids that count within a mission are told apart by (FNV-1a; never 0).
#[must_use]
pub fn mission_key(id: &str, folder: &str) -> u64 {
    let bytes = id.bytes().chain([0]).chain(folder.bytes());
    bytes.fold(0xcbf2_9ce4_8422_2325u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)).max(1)
}

codes! {
    /// The phases of Algorithm 1, and what surrounds them.
    pub enum MissionPhase {
        /// No mission.
        Idle = 0, "idle",
        /// Waiting for the services and the vehicle.
        Preparing = 1, "preparing",
        /// Arming and climbing.
        Takeoff = 2, "takeoff",
        /// The overhead and the side view.
        Prior = 3, "prior",
        /// The four seed views.
        Seed = 4, "seed",
        /// Flying to a view.
        Transit = 5, "transit",
        /// Taking a view.
        Capture = 6, "capture",
        /// Waiting for a training round.
        Training = 7, "training",
        /// Waiting for scores.
        Scoring = 8, "scoring",
        /// Flying home.
        Return = 9, "return",
        /// Landing.
        Landing = 10, "landing",
        /// On the ground: the last round trains, the model is saved.
        Finishing = 11, "finishing",
        /// Over; `end_reason` tells how.
        Done = 12, "done",
        /// Over without a usable model.
        Failed = 13, "failed",
        /// A pilot flies; waiting for the operator's go-on.
        Suspended = 14, "suspended",
    }
}

codes! {
    /// How a mission ended.
    pub enum EndReason {
        /// Not over.
        None = 0, "none",
        /// All keyframes taken.
        Complete = 1, "complete",
        /// `planner.stop_gain`: nothing left to gain.
        NothingToGain = 2, "nothing-to-gain",
        /// The battery ran low.
        Battery = 3, "battery",
        /// The time was up.
        Time = 4, "time",
        /// The operator asked to land or stop.
        Operator = 5, "operator",
        /// The geofence was crossed.
        Geofence = 6, "geofence",
        /// The link to the autopilot was lost.
        Link = 7, "link",
        /// No candidate can be reached or seen safely.
        NoCandidates = 8, "no-candidates",
        /// Nothing was found at the survey point.
        NoObject = 9, "no-object",
        /// A service could not go on.
        ServiceFailed = 10, "service-failed",
        /// The vehicle refused to arm, take off or take control.
        VehicleRefused = 11, "vehicle-refused",
        /// Wind above the limit.
        Wind = 12, "wind",
        /// After `vantage resume` the object was not found where, or as, the prior's views show it. The mission stays open.
        Misaligned = 13, "misaligned",
    }
}

codes! {
    /// What a mission can be told.
    pub enum MissionCommand {
        /// Begin the mission of the configured folder.
        Start = 1, "start",
        /// Return, land, save.
        Stop = 2, "stop",
        /// Hold where the vehicle is.
        Abort = 3, "abort",
        /// Land here.
        Land = 4, "land",
        /// Go on after a pilot or a failsafe.
        GoOn = 5, "go-on",
        /// Return and land, and leave the mission open: it goes on with `vantage resume`.
        Recall = 6, "recall",
    }
}

payload! {
    /// Request of `mission/command`.
    pub struct MissionRequest [8] {
        /// [`MissionCommand`] code.
        pub command: u32,
        /// Unused, zero.
        pub reserved: u32,
    }
}

payload! {
    /// Reply of `mission/command`.
    pub struct MissionReply [128] {
        /// 1 when accepted, 0 when refused.
        pub accepted: u32,
        /// Unused, zero.
        pub reserved: u32,
        /// Why not; text.
        pub reason: [u8; 120],
    }
}

payload! {
    /// `mission/state`: sent on every change, kept for late joiners. The items are the candidates.
    pub struct MissionState [448] {
        /// Counts the changes.
        pub sequence: u64,
        /// Mission time when it began (after the clock started).
        pub started_ns: u64,
        /// Text: the mission's id.
        pub mission_id: [u8; 64],
        /// Text: the mission folder, absolute.
        pub folder: [u8; 256],
        /// [`MissionPhase`] code.
        pub phase: u32,
        /// [`EndReason`] code.
        pub end_reason: u32,
        /// Training rounds begun (the seed's round is 0).
        pub round: u32,
        /// Keyframes stored (prior views not counted).
        pub keyframes: u32,
        /// Keyframes wanted.
        pub keyframes_wanted: u32,
        /// 1 when exposure and white balance are locked.
        pub exposure_locked: u32,
        /// 1 when the prior below is known.
        pub prior_known: u32,
        /// Training iterations run.
        pub iterations: u32,
        /// Centre of the object's box in the world, metres.
        pub box_center_m: [f64; 3],
        /// Edge of the box (B in the paper), metres.
        pub box_size_m: f64,
        /// Radius of the candidate sphere (R in the paper), metres.
        pub radius_m: f64,
        /// Height of the fitted ground under the box, metres.
        pub ground_z_m: f64,
        /// `paper_coverage` so far, 0..1.
        pub paper_coverage: f64,
        /// PSNR of the training views at the last report, dB; 0 before the first.
        pub psnr_train_db: f64,
        /// Mission time still expected, seconds.
        pub remaining_s: f64,
        /// Path length flown, metres.
        pub path_m: f64,
    }
}

codes! {
    /// What became of a candidate.
    pub enum CandidateStatus {
        /// Can be chosen.
        Free = 0, "free",
        /// In the batch being flown.
        Selected = 1, "selected",
        /// A keyframe was taken there.
        Visited = 2, "visited",
        /// No safe path, or the gimbal cannot look at the object from there.
        Unreachable = 3, "unreachable",
    }
}

payload! {
    /// One candidate view in `mission/state`.
    pub struct CandidateState [40] {
        /// Camera position in the world, metres.
        pub position_m: [f64; 3],
        /// Combined score (Eq. 4) when last scored; 0 before.
        pub score: f64,
        /// [`CandidateStatus`] code.
        pub status: u32,
        /// Index on the Fibonacci sphere.
        pub index: u32,
    }
}
