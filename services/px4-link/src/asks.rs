//! What is asked of a newly found autopilot: one thing at a time, each with a timeout and repeats, none of them fatal.

use std::collections::VecDeque;

use mavlink::dialects::common::{MavCmd, MavMessage};

use crate::params;

const TIMEOUT_NS: u64 = 500_000_000;
const TRIES: u32 = 3;

/// Message ids and their intervals in microseconds.
const INTERVALS: [(u32, f32); 9] = [
    (331, 20_000.0),
    (285, 20_000.0),
    (0, 200_000.0),
    (436, 200_000.0),
    (1, 200_000.0),
    (245, 200_000.0),
    (147, 500_000.0),
    (242, 1_000_000.0),
    (231, 1_000_000.0),
];
/// Messages asked for once: version, home, the estimator's origin, the gimbal's manager and device.
const MESSAGES: [u32; 5] = [148, 242, 49, 280, 283];

/// One question.
#[derive(Debug, Clone, PartialEq)]
pub enum Ask {
    /// A command; its acknowledgement is the answer, whatever it says.
    Command(MavCmd, [f32; 7]),
    /// A parameter; its value is the answer.
    Read(&'static str),
    /// A parameter to set; its value is the answer.
    Set(&'static str, i32),
}

fn command(command: MavCmd, first: f32, second: f32) -> Ask {
    let mut parameters = [f32::NAN; 7];
    parameters[0] = first;
    parameters[1] = second;
    Ask::Command(command, parameters)
}

impl Ask {
    /// Asks where the estimator has its origin.
    #[must_use]
    pub fn origin() -> Self {
        command(MavCmd::MAV_CMD_REQUEST_MESSAGE, 49.0, f32::NAN)
    }
}

/// The questions, in order.
#[derive(Debug, Clone, Default)]
pub struct Asks {
    waiting: VecDeque<Ask>,
    tries: u32,
    sent_ns: u64,
    begun: bool,
}

impl Asks {
    /// Everything, from the start.
    #[must_use]
    pub fn all() -> Self {
        #[expect(clippy::cast_precision_loss, reason = "message ids are small")]
        let requests = MESSAGES.iter().map(|&id| command(MavCmd::MAV_CMD_REQUEST_MESSAGE, id as f32, f32::NAN));
        #[expect(clippy::cast_precision_loss, reason = "message ids are small")]
        let intervals = INTERVALS.iter().map(|&(id, us)| command(MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL, id as f32, us));
        let reads = params::READ.iter().map(|name| Ask::Read(name));
        Self { waiting: intervals.chain(requests).chain(reads).collect(), begun: true, ..Self::default() }
    }

    /// Adds one at the end.
    pub fn push(&mut self, ask: Ask) {
        self.waiting.push_back(ask);
    }

    /// Whether everything was asked and answered or given up.
    #[must_use]
    pub fn done(&self) -> bool {
        self.begun && self.waiting.is_empty()
    }

    fn answered(&mut self) {
        self.waiting.pop_front();
        self.tries = 0;
    }

    /// A command was acknowledged.
    pub fn acknowledged(&mut self, command: MavCmd) {
        if self.tries > 0 && matches!(self.waiting.front(), Some(Ask::Command(ours, _)) if *ours == command) {
            self.answered();
        }
    }

    /// A parameter's value was heard.
    pub fn valued(&mut self, name: &str) {
        if self.tries > 0 && matches!(self.waiting.front(), Some(Ask::Read(ours) | Ask::Set(ours, _)) if *ours == name)
        {
            self.answered();
        }
    }

    /// The message to send now, if one is due.
    pub fn step(&mut self, now_ns: u64, system: u8) -> Option<MavMessage> {
        if self.tries > 0 && now_ns < self.sent_ns + TIMEOUT_NS {
            return None;
        }
        if self.tries >= TRIES {
            tracing::warn!(ask = ?self.waiting.front(), "the autopilot does not answer; going on without");
            self.answered();
        }
        let message = match self.waiting.front()? {
            Ask::Command(command, parameters) => crate::logic::command_long(system, *command, *parameters, 0),
            Ask::Read(name) => params::request(system, name),
            Ask::Set(name, value) => params::set(system, name, *value),
        };
        self.tries += 1;
        self.sent_ns = now_ns;
        Some(message)
    }
}
