//! The watchdog: a service that hangs is examined and killed, and then mended like any that died.
//!
//! Health is sent by a service's work loop itself, so silence means that the loop stands; the loop in turn tells how long its
//! worker has been without progress.

use shared_types::ServiceName;

use super::words::Action;
use super::{Member, Phase, Supervisor};

/// Longer than this between two events, the supervisor itself stood: nobody is blamed for that time.
const GAP_MS: u64 = 1_000;

/// What is known of the present process of a service.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Life {
    /// When it was last known to be well.
    well_ms: u64,
    spoke: bool,
    /// It hangs, and was dealt with.
    examined: bool,
}

impl Life {
    pub(super) fn born(now_ms: u64) -> Self {
        Self { well_ms: now_ms, spoke: false, examined: false }
    }

    /// It spoke. Words of a process that is being killed may still come; one that is only held is watched again.
    pub(super) fn heard(&mut self, now_ms: u64) {
        (self.well_ms, self.spoke) = (now_ms, true);
    }
}

impl Supervisor {
    /// Takes the time in which the supervisor itself was stopped from everybody's silence.
    pub(super) fn forgive_a_gap(&mut self, now_ms: u64) {
        let gap = now_ms.saturating_sub(self.stepped_ms);
        self.stepped_ms = now_ms;
        if gap > GAP_MS {
            for record in self.members.values_mut() {
                record.life.well_ms = (record.life.well_ms + gap).min(now_ms);
            }
        }
    }

    pub(super) fn debugged(&mut self, now_ms: u64, service: ServiceName) {
        if let Some(record) = self.members.get_mut(&service) {
            (record.life.well_ms, record.life.examined) = (now_ms, false);
        }
    }

    /// A worker without progress.
    pub(super) fn stalled(&mut self, service: ServiceName, for_ms: u64, actions: &mut Vec<Action>) {
        if for_ms >= self.policy.stall_ms {
            let why = format!("a job of {service} has made no progress for {} s", for_ms / 1_000);
            self.examine(service, &why, actions);
        }
    }

    /// Finds who is silent.
    pub(super) fn watch(&mut self, now_ms: u64, actions: &mut Vec<Action>) {
        if matches!(self.phase, Phase::Stopping { .. } | Phase::Over) {
            // Who does not stop in time is killed anyway.
            return;
        }
        for service in self.services.clone() {
            let Some(record) = self.members.get(&service) else { continue };
            let limit_ms = if record.life.spoke { self.policy.silence_ms } else { self.policy.start_ms };
            let silent_ms = now_ms.saturating_sub(record.life.well_ms);
            if record.member == Member::Running && silent_ms >= limit_ms {
                self.examine(service, &format!("{service} has said nothing for {} s", silent_ms / 1_000), actions);
            }
        }
    }

    fn examine(&mut self, service: ServiceName, why: &str, actions: &mut Vec<Action>) {
        let kill = !self.policy.hold_on_fault;
        let Some(record) = self.members.get_mut(&service) else { return };
        if record.member != Member::Running || core::mem::replace(&mut record.life.examined, true) {
            return;
        }
        let what =
            if kill { "it is killed and started again" } else { "it is held for a debugger (launch.hold_on_fault)" };
        actions.push(Action::Say(format!("{why}: {what}")));
        actions.push(Action::Examine { service, kill });
    }
}
