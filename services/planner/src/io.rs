//! What the mission takes and gives in one turn, as plain data: the ports translate, tests play the world.

use shared_types::messages::{
    CandidateScore, CandidateState, CandidateView, CaptureReply, CaptureRequest, CommandReply, CommandRequest,
    KeyframeReason, MissionCommand, MissionState, RoundReply, RoundRequest, ScoreReply, ScoreRequest, VehicleState,
    VehicleTarget, Waypoint,
};

use crate::journal::Entry;
use crate::logic::depth::DepthView;

/// Everything that came since the last turn.
#[derive(Debug, Default)]
pub struct Inputs {
    /// The newest state of the vehicle, where one came.
    pub vehicle: Option<VehicleState>,
    /// What the mission was told, with a number that its answer carries.
    pub commands: Vec<(usize, MissionCommand)>,
    /// Answers of the vehicle, with the request's id.
    pub command_replies: Vec<(u64, CommandReply)>,
    /// Answers of the camera.
    pub capture_replies: Vec<(u64, CaptureReply)>,
    /// Answers of the trainer.
    pub round_replies: Vec<(u64, RoundReply)>,
    /// Answers of the scorer.
    pub score_replies: Vec<(u64, ScoreReply, Vec<CandidateScore>)>,
    /// Small depth images.
    pub depths: Vec<DepthView>,
}

/// Depth images that are kept while no turn is taken.
const MOST_DEPTHS: usize = 64;

impl Inputs {
    /// Takes in what came later.
    pub fn absorb(&mut self, newer: Self) {
        self.vehicle = newer.vehicle.or(self.vehicle);
        self.commands.extend(newer.commands);
        self.command_replies.extend(newer.command_replies);
        self.capture_replies.extend(newer.capture_replies);
        self.round_replies.extend(newer.round_replies);
        self.score_replies.extend(newer.score_replies);
        self.depths.extend(newer.depths);
        let old = self.depths.len().saturating_sub(MOST_DEPTHS);
        self.depths.drain(..old);
    }
}

/// Where stored views are read from.
pub trait Views {
    /// The stored view of a reason and a keyframe id, and whether its gate was missed; `None` when there is none.
    fn read(&mut self, reason: KeyframeReason, keyframe_id: u64) -> Option<(DepthView, bool)>;
}

/// What is to be done, in order, once the entries are on disk.
#[derive(Debug, Clone, PartialEq)]
pub enum Effect {
    /// Publish a path: way there, then way back.
    Target(VehicleTarget, Vec<Waypoint>),
    /// Ask the vehicle.
    Command(u64, CommandRequest),
    /// The vehicle's answer is not waited for any more.
    CommandOver(u64),
    /// Ask the camera.
    Capture(u64, CaptureRequest),
    /// The camera's answer is not waited for any more.
    CaptureOver(u64),
    /// Ask the trainer, with keyframe ids.
    Round(u64, RoundRequest, Vec<u64>),
    /// The trainer's answer is not waited for any more.
    RoundOver(u64),
    /// Ask the scorer.
    Score(u64, ScoreRequest, Vec<CandidateView>),
    /// The scorer's answer is not waited for any more.
    ScoreOver(u64),
    /// Answer a command: its number, and why it was refused.
    Answer(usize, Result<(), String>),
    /// Publish the mission's state.
    State(Box<MissionState>, Vec<CandidateState>),
}

/// What a turn came to.
#[derive(Debug, Default)]
pub struct Outputs {
    /// To be written to the journal first.
    pub entries: Vec<Entry>,
    /// Then to be done.
    pub effects: Vec<Effect>,
}
