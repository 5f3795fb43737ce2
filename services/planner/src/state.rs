//! The states of the mission. Each turn goes through [`crate::mission::Mission::step`], whose transition is total: every
//! state says what it does with every situation of the vehicle.

use shared_types::messages::{MissionPhase, VehicleTarget, Waypoint};

use crate::journal::Shot;

/// What a path is flown for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Goal {
    /// A view to be taken at its end.
    View(Shot),
    /// A stop of the yaw scan, by its number.
    Scan(u32),
    /// Home, to land.
    Home,
}

/// A path that was sent.
#[derive(Debug, Clone, PartialEq)]
pub struct Flight {
    /// What for.
    pub goal: Goal,
    /// As sent; it is sent again until the vehicle's state names its id.
    pub target: VehicleTarget,
    /// Way there, then way back.
    pub waypoints: Vec<Waypoint>,
    /// When it was first sent.
    pub began_ns: u64,
    /// When it was last sent.
    pub sent_ns: u64,
    /// When it must have arrived, or something is wrong.
    pub overdue_ns: u64,
    /// Whether the vehicle's state has named it.
    pub seen: bool,
}

/// What the mission is doing.
#[derive(Debug, Clone, PartialEq)]
pub enum State {
    /// Waiting to be told to start.
    Idle,
    /// Waiting for the vehicle.
    Preparing,
    /// Arming, taking off, taking control; or taking control again in the air.
    Launching,
    /// In the air under control: the next thing is chosen, or waited for.
    Deciding,
    /// On a path.
    Flying(Box<Flight>),
    /// At a view, waiting for the camera: the path that led here, the request, when it is given up.
    Capturing(Box<Flight>, u64, u64),
    /// At a stop of the yaw scan, waiting for a depth image taken after this time.
    Looking(u32, u64),
    /// No path home was found: the autopilot's own return.
    Homing,
    /// Landing.
    Landing,
    /// Somebody else flies, or the operator said hold (then true until the vehicle holds).
    Suspended(bool),
    /// The operator said go on; px4-link is being told.
    GoingOn,
    /// On the ground, training to the end.
    Finishing,
    /// Over.
    Over,
}

impl State {
    /// The phase that others see. `waiting` is what the mission waits for while it decides.
    #[must_use]
    pub fn phase(&self, waiting: MissionPhase, usable: bool) -> MissionPhase {
        match self {
            Self::Idle => MissionPhase::Idle,
            Self::Preparing => MissionPhase::Preparing,
            Self::Launching => MissionPhase::Takeoff,
            Self::Deciding => waiting,
            Self::Flying(flight) => match flight.goal {
                Goal::View(shot) if shot.keyframe_id >= crate::mission::PRIOR_IDS => MissionPhase::Prior,
                Goal::View(shot) if shot.reason == shared_types::messages::KeyframeReason::Seed => MissionPhase::Seed,
                Goal::View(_) => MissionPhase::Transit,
                Goal::Scan(_) => MissionPhase::Prior,
                Goal::Home => MissionPhase::Return,
            },
            Self::Capturing(..) => MissionPhase::Capture,
            Self::Looking(..) => MissionPhase::Prior,
            Self::Homing => MissionPhase::Return,
            Self::Landing => MissionPhase::Landing,
            Self::Suspended(_) | Self::GoingOn => MissionPhase::Suspended,
            Self::Finishing => MissionPhase::Finishing,
            Self::Over if usable => MissionPhase::Done,
            Self::Over => MissionPhase::Failed,
        }
    }
}
