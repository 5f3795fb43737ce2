//! Commands to the autopilot: sent, acknowledged, and believed only when the vehicle's state shows them.
//!
//! A [`Procedure`] is a list of stages. A stage that commands something sends it, waits for the acknowledgement (0.5 s, 3 s
//! while it is in progress, 3 repeats), and is over when the state shows the effect. Unused parameters are NaN: PX4 1.18
//! denies anything else.

use std::collections::VecDeque;

use glam::DVec3;
use mavlink::dialects::common::{MavCmd, MavResult};
use shared_types::messages::{FlightMode, VehicleCommand};

const ACK_NS: u64 = 500_000_000;
const IN_PROGRESS_NS: u64 = 3_000_000_000;
/// After an acceptance, how long the state may take to show it before the command is sent again.
const EFFECT_NS: u64 = 2_500_000_000;
const TRIES: u32 = 4;
/// The present pose is streamed this long before OFFBOARD is commanded.
const STREAM_FIRST_NS: u64 = 1_000_000_000;

/// One stage of a procedure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Stage {
    /// Command a mode; with `always` even where the vehicle is in it already (a failsafe's Hold is not a commanded one).
    Mode {
        /// Which.
        mode: FlightMode,
        /// Even if it is in it.
        always: bool,
    },
    /// Wait until the autopilot says that it can arm.
    UntilArmable,
    /// Command to arm.
    Arm,
    /// Wait until somebody has armed.
    UntilArmed,
    /// Command to disarm, which the autopilot does on the ground only.
    Disarm,
    /// Command to take off to a height above the sea, metres.
    Takeoff {
        /// Metres.
        above_sea_m: f64,
    },
    /// Wait until the takeoff is over and the vehicle holds.
    UntilHovering,
    /// Wait until it is slow, or two seconds.
    UntilSlow,
    /// Stream the present pose.
    StreamPose,
    /// Fly the stored return path.
    FlyBack,
    /// Move the world, metres.
    ShiftWorld(DVec3),
    /// Wait until it is on the ground and disarmed.
    UntilDisarmed,
}

/// What a procedure sees of the vehicle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// Mission time.
    pub now_ns: u64,
    /// Mode now.
    pub mode: FlightMode,
    /// Motors run.
    pub armed: bool,
    /// Known to be on the ground.
    pub landed: bool,
    /// Can arm.
    pub armable: bool,
    /// m/s.
    pub speed_mps: f64,
    /// The return path is flown to its end.
    pub flown_back: bool,
    /// Setpoints flow.
    pub streaming: bool,
}

/// What a procedure wants done.
#[derive(Debug, Clone, PartialEq)]
pub enum Wish {
    /// Send a command with its confirmation count.
    Command(MavCmd, [f32; 7], u8),
    /// Stream the present measured pose.
    Anchor,
    /// Send no setpoints any more.
    StopStream,
    /// Fly the stored return path.
    FlyBack,
    /// Move the world, metres.
    ShiftWorld(DVec3),
}

/// What became of a turn.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// Not over.
    Working,
    /// Everything was seen in the state.
    Done,
    /// It cannot be done; why.
    Failed(String),
}

#[derive(Debug, Clone, Copy, Default)]
struct Attempt {
    tries: u32,
    sent_ns: u64,
    accepted: bool,
    in_progress: bool,
    retry_at_ns: Option<u64>,
}

/// A command of the vehicle, stage by stage.
#[derive(Debug, Clone)]
pub struct Procedure {
    /// What it is for.
    pub command: VehicleCommand,
    stages: VecDeque<Stage>,
    since_ns: Option<u64>,
    attempt: Attempt,
    /// The last mode that it commanded.
    pub commanded: Option<FlightMode>,
}

const NAN7: [f32; 7] = [f32::NAN; 7];

/// DO_SET_MODE of a mode that Vantage commands.
#[must_use]
pub fn set_mode(mode: FlightMode) -> (MavCmd, [f32; 7]) {
    let (main, sub) = match mode {
        FlightMode::Offboard => (6.0, 0.0),
        FlightMode::Takeoff => (4.0, 2.0),
        FlightMode::Return => (4.0, 5.0),
        FlightMode::Land => (4.0, 6.0),
        _ => (4.0, 3.0),
    };
    let mut params = NAN7;
    params[..3].copy_from_slice(&[1.0, main, sub]);
    (MavCmd::MAV_CMD_DO_SET_MODE, params)
}

impl Procedure {
    /// A procedure of these stages.
    #[must_use]
    pub fn new(command: VehicleCommand, stages: &[Stage]) -> Self {
        Self {
            command,
            stages: stages.iter().copied().collect(),
            since_ns: None,
            attempt: Attempt::default(),
            commanded: None,
        }
    }

    /// The stage it is at.
    #[must_use]
    pub fn stage(&self) -> Option<Stage> {
        self.stages.front().copied()
    }

    /// Takes an acknowledgement.
    pub fn acknowledged(&mut self, now_ns: u64, command: MavCmd, result: MavResult) -> Option<String> {
        if self.stage().and_then(command_of).is_none_or(|(ours, _)| ours != command) || self.attempt.tries == 0 {
            return None;
        }
        match result {
            MavResult::MAV_RESULT_ACCEPTED => self.attempt.accepted = true,
            MavResult::MAV_RESULT_IN_PROGRESS => self.attempt.in_progress = true,
            MavResult::MAV_RESULT_TEMPORARILY_REJECTED => self.attempt.retry_at_ns = Some(now_ns + ACK_NS),
            other => return Some(format!("the autopilot answered {}", result_name(other))),
        }
        None
    }

    /// One turn: what to do now, and how far it is.
    pub fn turn(&mut self, view: &View) -> (Vec<Wish>, Outcome) {
        let mut wishes = Vec::new();
        // Stages that are over pass within one turn; the last repeats are bounded by the number of stages.
        while let Some(stage) = self.stage() {
            let since_ns = *self.since_ns.get_or_insert(view.now_ns);
            let age_ns = view.now_ns.saturating_sub(since_ns);
            if stage == Stage::StreamPose || (stage == Stage::UntilSlow && view.streaming) {
                wishes.push(Wish::Anchor);
            }
            if let Stage::ShiftWorld(by_m) = stage {
                wishes.push(Wish::ShiftWorld(by_m));
            }
            if self.is_over(stage, view, age_ns) {
                if let Stage::Mode { mode, .. } = stage
                    && mode != FlightMode::Offboard
                {
                    wishes.push(Wish::StopStream);
                }
                self.stages.pop_front();
                self.since_ns = None;
                self.attempt = Attempt::default();
                continue;
            }
            if stage == Stage::FlyBack && age_ns == 0 {
                wishes.push(Wish::FlyBack);
            }
            if let Stage::Mode { mode: FlightMode::Offboard, .. } = stage {
                // Until OFFBOARD is on, the setpoint is the present pose: nothing to jump to.
                wishes.push(Wish::Anchor);
            }
            if let Some(reason) = give_up(stage, age_ns) {
                return (wishes, Outcome::Failed(reason));
            }
            if let Some((command, params)) = command_of(stage) {
                return match self.send(view.now_ns, stage, command, params) {
                    Ok(wish) => {
                        wishes.extend(wish);
                        (wishes, Outcome::Working)
                    }
                    Err(reason) => (wishes, Outcome::Failed(reason)),
                };
            }
            return (wishes, Outcome::Working);
        }
        (wishes, Outcome::Done)
    }

    fn is_over(&self, stage: Stage, view: &View, age_ns: u64) -> bool {
        match stage {
            Stage::Mode { mode, always } => view.mode == mode && (!always || self.attempt.accepted),
            Stage::UntilArmable => view.armable || view.armed,
            Stage::Arm | Stage::UntilArmed => view.armed,
            Stage::Takeoff { .. } => view.mode == FlightMode::Takeoff || (self.attempt.accepted && !view.landed),
            Stage::UntilHovering => view.mode == FlightMode::Hold && !view.landed,
            Stage::UntilSlow => view.speed_mps < 0.3 || age_ns > 2_000_000_000,
            Stage::StreamPose => view.streaming && age_ns >= STREAM_FIRST_NS,
            Stage::FlyBack => view.flown_back && age_ns > 0,
            Stage::ShiftWorld(_) => true,
            Stage::Disarm | Stage::UntilDisarmed => !view.armed,
        }
    }

    /// The wish to send, when it is time for a first or another try.
    fn send(&mut self, now_ns: u64, stage: Stage, command: MavCmd, params: [f32; 7]) -> Result<Option<Wish>, String> {
        let attempt = &mut self.attempt;
        let waits_ns = match (attempt.accepted, attempt.in_progress) {
            (true, _) => EFFECT_NS,
            (false, true) => IN_PROGRESS_NS,
            (false, false) => ACK_NS,
        };
        let due = match attempt.retry_at_ns {
            Some(at_ns) => now_ns >= at_ns,
            None => attempt.tries == 0 || now_ns >= attempt.sent_ns + waits_ns,
        };
        if !due {
            return Ok(None);
        }
        if attempt.tries >= TRIES {
            let what = if attempt.accepted {
                "was accepted without effect"
            } else if attempt.retry_at_ns.is_some() {
                "was rejected for now, again and again"
            } else {
                "was not acknowledged"
            };
            return Err(format!("{} {what}", stage_name(stage)));
        }
        let confirmation = u8::try_from(attempt.tries).unwrap_or(u8::MAX);
        *attempt = Attempt { tries: attempt.tries + 1, sent_ns: now_ns, ..Attempt::default() };
        if let Stage::Mode { mode, .. } = stage {
            self.commanded = Some(mode);
        } else if matches!(stage, Stage::Takeoff { .. }) {
            self.commanded = Some(FlightMode::Takeoff);
        }
        Ok(Some(Wish::Command(command, params, confirmation)))
    }
}

/// The command of a stage, if it has one.
fn command_of(stage: Stage) -> Option<(MavCmd, [f32; 7])> {
    match stage {
        Stage::Mode { mode, .. } => Some(set_mode(mode)),
        Stage::Arm | Stage::Disarm => {
            let mut params = NAN7;
            params[0] = if stage == Stage::Arm { 1.0 } else { 0.0 };
            Some((MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, params))
        }
        Stage::Takeoff { above_sea_m } => {
            let mut params = NAN7;
            #[expect(clippy::cast_possible_truncation, reason = "MAVLink speaks f32")]
            let altitude_m = above_sea_m as f32;
            params[6] = altitude_m;
            Some((MavCmd::MAV_CMD_NAV_TAKEOFF, params))
        }
        _ => None,
    }
}

fn stage_name(stage: Stage) -> String {
    match stage {
        Stage::Mode { mode, .. } => format!("the mode {mode}"),
        Stage::Arm => "arming".to_owned(),
        Stage::Disarm => "disarming".to_owned(),
        Stage::Takeoff { .. } => "the takeoff".to_owned(),
        other => format!("{other:?}"),
    }
}

fn result_name(result: MavResult) -> &'static str {
    match result {
        MavResult::MAV_RESULT_DENIED => "denied",
        MavResult::MAV_RESULT_UNSUPPORTED => "unsupported",
        MavResult::MAV_RESULT_FAILED => "failed",
        MavResult::MAV_RESULT_CANCELLED => "cancelled",
        _ => "no",
    }
}

/// Stages that wait give up after a while; why.
fn give_up(stage: Stage, age_ns: u64) -> Option<String> {
    let (limit_s, reason) = match stage {
        Stage::UntilArmable => (60, "the autopilot does not become ready to arm"),
        Stage::UntilArmed => (600, "the pilot did not arm"),
        Stage::UntilHovering => (60, "the takeoff does not end"),
        Stage::StreamPose => (5, "no setpoint can be sent"),
        Stage::FlyBack => (180, "the return path is not flown to its end"),
        Stage::UntilDisarmed => (300, "the vehicle does not land and disarm"),
        Stage::Mode { .. }
        | Stage::Arm
        | Stage::Disarm
        | Stage::Takeoff { .. }
        | Stage::UntilSlow
        | Stage::ShiftWorld(_) => return None,
    };
    (age_ns > limit_s * shared_types::NS_PER_S).then(|| reason.to_owned())
}

#[cfg(test)]
#[path = "commands_tests.rs"]
mod tests;
