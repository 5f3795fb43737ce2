//! Ground stations: what they order of the mission, and what they are told of it.
//!
//! Orders are MAVLink's user commands, sent to the system of the vehicle and to component 191 (onboard computer), as custom
//! actions of QGroundControl are: MAV_CMD_USER_1 (31010) start, USER_2 stop, USER_3 land, USER_4 abort, USER_5 go on. The
//! autopilot forwards them to the link on which that component was heard, and the COMMAND_ACK and the texts back.

use mavlink::dialects::common::{COMMAND_ACK_DATA, MavCmd, MavMessage, MavResult, MavSeverity, STATUSTEXT_DATA};
use mavlink::types::CharArray;
use shared_types::messages::{EndReason, MissionCommand, MissionPhase, MissionState};

use crate::mavlink_io::{OWN_COMPONENT, Received};

/// The user commands, and what they order.
pub const ORDERS: [(MavCmd, MissionCommand); 5] = [
    (MavCmd::MAV_CMD_USER_1, MissionCommand::Start),
    (MavCmd::MAV_CMD_USER_2, MissionCommand::Stop),
    (MavCmd::MAV_CMD_USER_3, MissionCommand::Land),
    (MavCmd::MAV_CMD_USER_4, MissionCommand::Abort),
    (MavCmd::MAV_CMD_USER_5, MissionCommand::GoOn),
];

/// Bytes of text in a STATUSTEXT, and the most of them that a sentence takes.
const TEXT_BYTES: usize = 50;
const MOST_TEXTS: usize = 4;
/// An order without an answer for so long is given up, and its user told; an answer is given again as long.
const PATIENCE_NS: u64 = 10_000_000_000;
/// A mission that waits for a human tells so again: whoever is to hear it may have come later.
const REMINDER_NS: u64 = 10_000_000_000;

/// What is ordered of a mission by a message, for this system's onboard computer.
#[must_use]
pub fn ordered(system: u8, received: &Received) -> Option<MissionCommand> {
    let (command, to) = match &received.message {
        MavMessage::COMMAND_LONG(m) => (m.command, (m.target_system, m.target_component)),
        MavMessage::COMMAND_INT(m) => (m.command, (m.target_system, m.target_component)),
        _ => return None,
    };
    if to != (system, OWN_COMPONENT) {
        return None;
    }
    ORDERS.iter().find(|(known, _)| *known == command).map(|&(_, order)| order)
}

/// What the planner is asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Passed {
    /// Id of the request.
    pub id: u64,
    /// The order.
    pub order: MissionCommand,
    /// The request whose place it takes, which nobody waits for any more.
    pub given_up: Option<u64>,
}

/// Whether a command says of itself that it was sent before.
fn is_repeat(received: &Received) -> bool {
    matches!(&received.message, MavMessage::COMMAND_LONG(m) if m.confirmation > 0)
}

/// An order of a ground station.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Asked {
    from: (u8, u8),
    order: MissionCommand,
    id: u64,
    at_ns: u64,
}

/// What has been ordered and told so far.
#[derive(Debug)]
pub struct Ground {
    asked: Option<Asked>,
    answered: Option<(Asked, MavResult)>,
    /// Ids grow over all lives of this process: it begins with the time of its start.
    next_id: u64,
    /// Phase and round that were told last.
    told: Option<(u32, u32)>,
    /// What waits for a human, and when it was told last.
    waits: Option<(u64, String)>,
    texts: u16,
    out: Vec<MavMessage>,
}

impl Ground {
    /// Nothing is ordered yet.
    #[must_use]
    pub fn new(incarnation: u64) -> Self {
        Self { asked: None, answered: None, next_id: incarnation, told: None, waits: None, texts: 0, out: Vec::new() }
    }

    /// Takes an order, which takes the place of one that the planner has not answered yet. Returns what the planner is to be
    /// asked; nothing for one that is repeated.
    pub fn on_order(&mut self, now_ns: u64, received: &Received, order: MissionCommand) -> Option<Passed> {
        let from = (received.system, received.component);
        if self.asked.is_some_and(|asked| (asked.from, asked.order) == (from, order)) {
            return None;
        }
        let answered = self.answered.filter(|(asked, _)| {
            (asked.from, asked.order) == (from, order)
                && is_repeat(received)
                && now_ns < asked.at_ns.saturating_add(PATIENCE_NS)
        });
        if let Some((_, result)) = answered {
            // The answer was lost on its way.
            self.acknowledge(from, order, result);
            return None;
        }
        let given_up = self.give_up(MavResult::MAV_RESULT_TEMPORARILY_REJECTED);
        self.next_id += 1;
        self.asked = Some(Asked { from, order, id: self.next_id, at_ns: now_ns });
        tracing::info!(system = from.0, component = from.1, %order, "ordered by MAVLink");
        Some(Passed { id: self.next_id, order, given_up })
    }

    /// The request that the planner has not answered for too long: it must not be carried out any more.
    pub fn overdue(&mut self, now_ns: u64) -> Option<u64> {
        self.asked.filter(|asked| now_ns >= asked.at_ns.saturating_add(PATIENCE_NS))?;
        self.give_up(MavResult::MAV_RESULT_FAILED)
    }

    fn give_up(&mut self, result: MavResult) -> Option<u64> {
        let Asked { from, order, id, .. } = self.asked.take()?;
        self.acknowledge(from, order, result);
        Some(id)
    }

    /// Tells that nobody takes orders here.
    pub fn refuse(&mut self, received: &Received, order: MissionCommand) {
        self.acknowledge((received.system, received.component), order, MavResult::MAV_RESULT_DENIED);
    }

    /// The planner's answer to the request with this id.
    pub fn on_answer(&mut self, id: u64, answer: Result<(), String>) {
        let Some(asked) = self.asked.take_if(|asked| asked.id == id) else { return };
        let Asked { from, order, .. } = asked;
        let result = match answer {
            Ok(()) => MavResult::MAV_RESULT_ACCEPTED,
            Err(reason) => {
                self.tell(MavSeverity::MAV_SEVERITY_WARNING, &format!("vantage: {order} refused: {reason}"));
                MavResult::MAV_RESULT_DENIED
            }
        };
        self.acknowledge(from, order, result);
        self.answered = Some((asked, result));
    }

    /// Tells what the mission does, where that is something new.
    pub fn on_mission(&mut self, now_ns: u64, state: &MissionState) {
        let Some(phase) = MissionPhase::from_code(state.phase) else { return };
        let (severity, text) = words(phase, state);
        // Of the many short phases between two views, the round is told.
        let key = match phase {
            MissionPhase::Transit | MissionPhase::Capture | MissionPhase::Training | MissionPhase::Scoring => {
                (MissionPhase::Transit.code(), state.round)
            }
            _ => (phase.code(), 0),
        };
        if self.told.replace(key) != Some(key) {
            self.tell(severity, &text);
            let waits = matches!(phase, MissionPhase::Idle | MissionPhase::Suspended);
            self.waits = waits.then_some((now_ns, text));
        }
    }

    /// What is to be sent.
    pub fn take_messages(&mut self, now_ns: u64) -> Vec<MavMessage> {
        let due = self.waits.take_if(|(told_ns, _)| now_ns >= told_ns.saturating_add(REMINDER_NS));
        if let Some((_, text)) = due {
            self.tell(MavSeverity::MAV_SEVERITY_INFO, &text);
            self.waits = Some((now_ns, text));
        }
        core::mem::take(&mut self.out)
    }

    fn acknowledge(&mut self, (target_system, target_component): (u8, u8), order: MissionCommand, result: MavResult) {
        let Some(&(command, _)) = ORDERS.iter().find(|(_, known)| *known == order) else { return };
        self.out.push(MavMessage::COMMAND_ACK(COMMAND_ACK_DATA {
            command,
            result,
            target_system,
            target_component,
            ..COMMAND_ACK_DATA::default()
        }));
    }

    /// A sentence, in as many texts as it takes.
    fn tell(&mut self, severity: MavSeverity, sentence: &str) {
        // Texts are ASCII.
        let bytes: Vec<u8> =
            sentence.chars().map(|c| if c.is_ascii_graphic() || c == ' ' { c as u8 } else { b'?' }).collect();
        let several = bytes.len() > TEXT_BYTES;
        if several {
            // 0 says that a text is whole.
            self.texts = self.texts.wrapping_add(1).max(1);
        }
        for (chunk_seq, part) in (0..).zip(bytes.chunks(TEXT_BYTES).take(MOST_TEXTS)) {
            let mut text = [0; TEXT_BYTES];
            for (to, from) in text.iter_mut().zip(part) {
                *to = *from;
            }
            let id = if several { self.texts } else { 0 };
            self.out.push(MavMessage::STATUSTEXT(STATUSTEXT_DATA {
                severity,
                text: CharArray::new(text),
                id,
                chunk_seq,
            }));
        }
    }
}

/// What a pilot is told.
fn words(phase: MissionPhase, state: &MissionState) -> (MavSeverity, String) {
    let views = format!("{} of {} views", state.keyframes, state.keyframes_wanted);
    let reason = EndReason::from_code(state.end_reason).map_or("?", EndReason::name);
    let text = match phase {
        MissionPhase::Idle => "waiting for the order to start".to_owned(),
        MissionPhase::Preparing => "preparing".to_owned(),
        MissionPhase::Takeoff => "taking off".to_owned(),
        MissionPhase::Prior => "looking at the object".to_owned(),
        MissionPhase::Seed => "seed views".to_owned(),
        MissionPhase::Transit | MissionPhase::Capture | MissionPhase::Training | MissionPhase::Scoring => {
            format!("round {}, {views}", state.round)
        }
        MissionPhase::Return => format!("returning, {views}"),
        MissionPhase::Landing => format!("landing, {views}"),
        MissionPhase::Finishing => "training the last round".to_owned(),
        MissionPhase::Done => format!("done ({reason}), {views}"),
        MissionPhase::Failed => format!("failed ({reason}), {views}"),
        MissionPhase::Suspended => "suspended, waiting for the order to go on".to_owned(),
    };
    let severity = match phase {
        MissionPhase::Failed => MavSeverity::MAV_SEVERITY_ERROR,
        MissionPhase::Suspended => MavSeverity::MAV_SEVERITY_WARNING,
        _ => MavSeverity::MAV_SEVERITY_INFO,
    };
    (severity, format!("vantage: {text}"))
}

#[cfg(test)]
#[path = "ground_tests.rs"]
mod tests;
