//! The payload types of every channel, one file per subject.

pub mod camera;
pub mod check;
pub mod clock;
pub mod health;
pub mod mission;
pub mod model;
pub mod scorer;
pub mod simulator;
pub mod vehicle;

pub use camera::{CaptureReply, CaptureRequest, CaptureStatus, FrameHeader, FrameView, KeyframeReason};
pub use check::{Check, Fault};
pub use clock::{ClockGrant, ClockTick, MAX_SERVICES};
pub use health::{ControlCommand, ControlReply, ControlRequest, Health, ServiceState};
pub use mission::{
    CandidateState, CandidateStatus, EndReason, MissionCommand, MissionPhase, MissionReply, MissionRequest,
    MissionState, mission_key,
};
pub use model::{GaussianRow, RoundReply, RoundRequest, RoundStatus, SnapshotHeader};
pub use scorer::{CandidateScore, CandidateView, ScoreReply, ScoreRequest, ScoreStatus, VarianceMode};
pub use simulator::{RenderPurpose, RenderReply, RenderRequest, RenderStatus, Truth};
pub use vehicle::{
    Alive, ChargeState, CommandReply, CommandRequest, CommandStatus, Commander, FailsafeReason, FlightMode,
    TargetStatus, VehicleCommand, VehicleState, VehicleTarget, Waypoint,
};
