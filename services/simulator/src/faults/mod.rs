//! What goes wrong with the vehicle and its link, by the configuration: seeded and in simulated time, so that a mission with
//! faults repeats like any other.
//!
//! [`lane`] is one direction of the link with its losses and delays; [`strangers`] are the others who speak on it. The link
//! meant is that of clients on board (14540); a ground station's link stays as it is.

pub mod lane;
pub mod strangers;

use glam::DVec3;
use shared_types::config::{Fault, FaultKind};

use crate::autopilot::Sticks;
use crate::frames::enu_from_ned;
use crate::modes::Mode;
use crate::params::Value;
use crate::vehicle::Vehicle;
use lane::{Disturbance, Lane};
use strangers::Strangers;

/// A pilot who took over flies sideways this gently.
const PILOT_STICKS: Sticks = [0.0, 0.15, 0.0, 0.0];

/// How far a fault with a beginning and an end has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Progress {
    Ahead,
    On,
    Over,
}

/// The faults of a vehicle and of its link on board.
#[derive(Debug, Clone)]
pub struct Faults {
    list: Vec<(Fault, Progress)>,
    /// To the vehicle.
    pub inbound: Lane,
    /// From the vehicle.
    pub outbound: Lane,
    strangers: Strangers,
}

impl Faults {
    /// The faults of a configuration; `None` where there are none, and the link is as it is.
    #[must_use]
    pub fn new(list: &[Fault], seed: u64, system_id: u8) -> Option<Self> {
        (!list.is_empty()).then(|| Self {
            list: list.iter().map(|fault| (*fault, Progress::Ahead)).collect(),
            inbound: Lane::new(seed ^ 0x696e_626f_756e_6400),
            outbound: Lane::new(seed ^ 0x6f75_7462_6f75_6e64),
            strangers: Strangers::new(system_id),
        })
    }

    /// What the link does to packets at a moment; of several faults of a kind the worst counts.
    #[must_use]
    pub fn disturbance(&self, boot_s: f64) -> Disturbance {
        let mut all = Disturbance::default();
        for (fault, _) in self.list.iter().filter(|(fault, _)| fault.is_on(boot_s)) {
            match fault.kind {
                FaultKind::Loss(share) => all.loss = all.loss.max(share),
                FaultKind::Delay(seconds) => all.delay_ticks = all.delay_ticks.max((seconds * 100.0).round() as u64),
                FaultKind::Duplicate(share) => all.duplicate = all.duplicate.max(share),
                FaultKind::Reorder(share) => all.reorder = all.reorder.max(share),
                FaultKind::Garbage(share) => all.garbage = all.garbage.max(share),
                FaultKind::Gone => all.gone = true,
                FaultKind::HeartbeatLoss => all.heartbeats_lost = true,
                _ => {}
            }
        }
        all
    }

    /// Does to the vehicle what is due in this tick.
    pub fn strike(&mut self, vehicle: &mut Vehicle) {
        let boot_s = vehicle.boot_s();
        for (fault, progress) in &mut self.list {
            let now = match (fault.is_on(boot_s), boot_s < fault.at_s) {
                (true, _) => Progress::On,
                (false, true) => Progress::Ahead,
                (false, false) => Progress::Over,
            };
            let before = core::mem::replace(progress, now);
            let begins = before == Progress::Ahead && now != Progress::Ahead;
            match fault.kind {
                FaultKind::Jump(metres) if begins => vehicle.reset_estimate(enu_from_ned(DVec3::from_array(metres))),
                FaultKind::Battery(charge) if begins => vehicle.battery.set(charge),
                FaultKind::Fence(metres) if begins => fence(vehicle, metres),
                FaultKind::Pilot => pilot(vehicle, before, now),
                _ => {}
            }
        }
    }

    /// What others say in this tick, on its way like everything: to the vehicle, and to the client on board.
    pub fn speak(&mut self, tick: u64, boot_s: f64) {
        let disturbance = self.disturbance(boot_s);
        for (fault, _) in self.list.iter().filter(|(fault, _)| fault.is_on(boot_s)) {
            let said = self.strangers.say(fault.kind, tick);
            for packet in said.to_client {
                self.outbound.push(tick, &packet, &disturbance);
            }
            for packet in said.to_vehicle {
                self.inbound.push(tick, &packet, &disturbance);
            }
        }
    }
}

/// The autopilot gets a fence, and holds beyond it.
fn fence(vehicle: &mut Vehicle, metres: f64) {
    for (name, value) in [("GF_MAX_HOR_DIST", Value::Real(metres as f32)), ("GF_ACTION", Value::Int(2))] {
        if let Err(error) = vehicle.params.set(name, value) {
            tracing::warn!(name, %error, "the fence could not be set");
        }
    }
}

/// A pilot with sticks: POSCTL when he begins, Hold when he lets go.
fn pilot(vehicle: &mut Vehicle, before: Progress, now: Progress) {
    if now == Progress::On {
        vehicle.autopilot.on_sticks(vehicle.boot_s(), PILOT_STICKS);
    }
    let mode = match (before, now) {
        (Progress::Ahead, Progress::On) => Mode::Posctl,
        (Progress::On, Progress::Over) => Mode::AutoLoiter,
        _ => return,
    };
    vehicle.autopilot.choose(mode, &vehicle.params);
}

#[cfg(test)]
mod tests;
