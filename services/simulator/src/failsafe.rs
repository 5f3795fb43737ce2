//! Failsafes: what may go wrong, what the parameters say about it, and which action wins.
//!
//! A cause is either released when its condition clears (lost setpoints: the vehicle goes back to OFFBOARD by itself)
//! or latched until the pilot chooses a mode or the vehicle disarms (battery, geofence, ground station).

use crate::battery::Charge;
use crate::params::{Param, Params};

/// What a failsafe does, in order of severity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Action {
    /// Nothing.
    None,
    /// A message.
    Warn,
    /// Hold.
    Hold,
    /// Return and land.
    Return,
    /// Land here.
    Land,
    /// Disarm at once.
    Disarm,
    /// Motors off.
    Terminate,
}

/// Why.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(usize)]
pub enum Cause {
    /// OFFBOARD is chosen and setpoints stay away for COM_OF_LOSS_T.
    OffboardLoss,
    /// A mode that needs sticks has none for COM_RC_LOSS_T.
    SticksLoss,
    /// No ground station's heartbeat for COM_DL_LOSS_T.
    GcsLoss,
    /// Charge below BAT_LOW_THR.
    BatteryLow,
    /// Charge below BAT_CRIT_THR.
    BatteryCritical,
    /// Charge below BAT_EMERGEN_THR.
    BatteryEmergency,
    /// Beyond GF_MAX_HOR_DIST or GF_MAX_VER_DIST from home.
    Geofence,
}

impl Cause {
    const ALL: [Self; 7] = [
        Self::OffboardLoss,
        Self::SticksLoss,
        Self::GcsLoss,
        Self::BatteryLow,
        Self::BatteryCritical,
        Self::BatteryEmergency,
        Self::Geofence,
    ];

    /// What PX4 tells the pilot.
    #[must_use]
    pub fn text(self) -> &'static str {
        match self {
            Self::OffboardLoss => "Failsafe: no offboard signal",
            Self::SticksLoss => "Failsafe: no manual control",
            Self::GcsLoss => "Failsafe: connection to ground station lost",
            Self::BatteryLow => "Low battery level! Return advised",
            Self::BatteryCritical => "Critical battery level",
            Self::BatteryEmergency => "Emergency battery level! Land immediately",
            Self::Geofence => "Geofence violation! Approaching or crossing fence",
        }
    }
}

/// The conditions of a moment.
#[derive(Debug, Clone, Copy)]
pub struct Conditions {
    /// Motors armed.
    pub armed: bool,
    /// OFFBOARD is chosen, and its setpoints stay away.
    pub offboard_lost: bool,
    /// A pilot's sticks are there.
    pub sticks: bool,
    /// The chosen mode needs sticks, and they are not there.
    pub sticks_lost: bool,
    /// No ground station is heard.
    pub gcs_lost: bool,
    /// Charge.
    pub charge: Charge,
    /// Beyond the fence.
    pub fence_breached: bool,
}

#[derive(Debug, Clone, Copy, Default)]
struct Latch {
    active: bool,
    since_s: f64,
    /// The pilot has chosen a mode since: it stays quiet until its condition has cleared.
    taken_over: bool,
}

/// What the failsafes decide.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decision {
    /// The action that wins.
    pub action: Action,
    /// Its cause.
    pub cause: Option<Cause>,
    /// A cause that has just become active: to be said once.
    pub announce: Option<Cause>,
}

/// The failsafes' memory.
#[derive(Debug, Clone, Default)]
pub struct Failsafe {
    latches: [Latch; 7],
}

impl Failsafe {
    /// A client or pilot has chosen a mode: latched causes give way.
    pub fn take_over(&mut self) {
        for latch in &mut self.latches {
            latch.taken_over |= latch.active;
        }
    }

    /// Decides at a time. Everything is forgotten while disarmed.
    pub fn update(&mut self, now_s: f64, now: &Conditions, params: &Params) -> Decision {
        let mut decision = Decision { action: Action::None, cause: None, announce: None };
        if !now.armed {
            self.latches = [Latch::default(); 7];
            return decision;
        }
        for (latch, cause) in self.latches.iter_mut().zip(Cause::ALL) {
            let (holds, action, hold_first, latched) = rule(cause, now, params);
            if holds && action > Action::None && !latch.active {
                *latch = Latch { active: true, since_s: now_s, taken_over: false };
                decision.announce = Some(cause);
            }
            let in_delay = hold_first && now_s - latch.since_s < params.real(Param::COM_FAIL_ACT_T);
            if !holds && (!latched || in_delay || latch.taken_over) {
                *latch = Latch::default();
            }
            if !latch.active || latch.taken_over {
                continue;
            }
            let action = if in_delay { action.min(Action::Hold) } else { action };
            if action > decision.action {
                decision.action = action;
                decision.cause = Some(cause);
            }
        }
        decision
    }
}

/// (condition holds, action, Hold for COM_FAIL_ACT_T first, latched) of a cause.
fn rule(cause: Cause, now: &Conditions, params: &Params) -> (bool, Action, bool, bool) {
    match cause {
        Cause::OffboardLoss => (now.offboard_lost, offboard_loss_action(now.sticks, params), false, false),
        Cause::GcsLoss => (now.gcs_lost, link_loss_action(params.int(Param::NAV_DLL_ACT)), true, true),
        Cause::SticksLoss => (now.sticks_lost, link_loss_action(params.int(Param::NAV_RCL_ACT)), true, true),
        Cause::BatteryLow => (now.charge >= Charge::Low, Action::Warn, false, true),
        Cause::BatteryCritical => {
            let action = match params.int(Param::COM_LOW_BAT_ACT) {
                2 => Action::Land,
                3 => Action::Return,
                _ => Action::Warn,
            };
            (now.charge >= Charge::Critical, action, true, true)
        }
        Cause::BatteryEmergency => {
            let action = if params.int(Param::COM_LOW_BAT_ACT) >= 2 { Action::Land } else { Action::Warn };
            (now.charge >= Charge::Emergency, action, false, true)
        }
        Cause::Geofence => {
            let action = match params.int(Param::GF_ACTION) {
                0 => Action::None,
                1 => Action::Warn,
                3 => Action::Return,
                4 => Action::Terminate,
                5 => Action::Land,
                _ => Action::Hold,
            };
            (now.fence_breached, action, false, true)
        }
    }
}

/// The values that NAV_DLL_ACT and NAV_RCL_ACT share.
fn link_loss_action(value: i32) -> Action {
    match value {
        0 => Action::None,
        1 => Action::Hold,
        3 => Action::Land,
        5 => Action::Terminate,
        6 => Action::Disarm,
        _ => Action::Return,
    }
}

/// COM_OBL_RC_ACT; 0 to 2 hand over to a pilot, and without sticks there is none: return.
fn offboard_loss_action(sticks: bool, params: &Params) -> Action {
    match params.int(Param::COM_OBL_RC_ACT) {
        4 => Action::Land,
        5 => Action::Hold,
        6 => Action::Terminate,
        7 => Action::Disarm,
        0..=2 if sticks => Action::Hold,
        _ => Action::Return,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::params::Value;

    const CALM: Conditions = Conditions {
        armed: true,
        offboard_lost: false,
        sticks: false,
        sticks_lost: false,
        gcs_lost: false,
        charge: Charge::Ok,
        fence_breached: false,
    };

    fn params(values: &[(&str, i32)]) -> Params {
        let mut params = Params::default();
        for &(name, value) in values {
            assert!(params.set(name, Value::Int(value)).is_ok());
        }
        params
    }

    #[test]
    fn lost_setpoints_act_by_the_parameter_and_clear_by_themselves() {
        for (value, action) in
            [(0, Action::Return), (3, Action::Return), (4, Action::Land), (5, Action::Hold), (7, Action::Disarm)]
        {
            let params = params(&[("COM_OBL_RC_ACT", value)]);
            let mut failsafe = Failsafe::default();
            let lost = Conditions { offboard_lost: true, ..CALM };
            assert_eq!(failsafe.update(1.0, &lost, &params).action, action);
            assert_eq!(failsafe.update(2.0, &CALM, &params).action, Action::None);
        }
    }

    #[test]
    fn a_critical_battery_holds_first_then_returns_and_an_emergency_lands_at_once() {
        let params = params(&[("COM_LOW_BAT_ACT", 3)]);
        let mut failsafe = Failsafe::default();
        let at = |charge| Conditions { charge, ..CALM };
        assert_eq!(failsafe.update(0.0, &at(Charge::Low), &params).action, Action::Warn);
        assert_eq!(failsafe.update(1.0, &at(Charge::Critical), &params).action, Action::Hold);
        assert_eq!(failsafe.update(5.9, &at(Charge::Critical), &params).action, Action::Hold);
        assert_eq!(failsafe.update(6.1, &at(Charge::Critical), &params).action, Action::Return);
        let landing = failsafe.update(6.2, &at(Charge::Emergency), &params);
        assert_eq!((landing.action, landing.cause), (Action::Land, Some(Cause::BatteryEmergency)));
    }

    #[test]
    fn a_fence_stays_latched_until_a_mode_is_chosen_and_then_until_it_is_crossed_again() {
        let params = params(&[("GF_ACTION", 2)]);
        let mut failsafe = Failsafe::default();
        let out = Conditions { fence_breached: true, ..CALM };
        assert_eq!(failsafe.update(0.0, &out, &params).action, Action::Hold);
        assert_eq!(failsafe.update(1.0, &CALM, &params).action, Action::Hold, "latched");
        failsafe.take_over();
        assert_eq!(failsafe.update(2.0, &out, &params).action, Action::None, "the pilot's choice stands");
        assert_eq!(failsafe.update(3.0, &CALM, &params).action, Action::None);
        assert_eq!(failsafe.update(4.0, &out, &params).action, Action::Hold, "crossed again");
    }

    #[test]
    fn a_ground_station_that_comes_back_does_not_cancel_the_return() {
        let params = params(&[("NAV_DLL_ACT", 2)]);
        let mut failsafe = Failsafe::default();
        let lost = Conditions { gcs_lost: true, ..CALM };
        assert_eq!(failsafe.update(0.0, &lost, &params).action, Action::Hold);
        assert_eq!(failsafe.update(2.0, &CALM, &params).action, Action::None, "back within the delay");
        assert_eq!(failsafe.update(3.0, &lost, &params).action, Action::Hold);
        assert_eq!(failsafe.update(8.1, &lost, &params).action, Action::Return);
        assert_eq!(failsafe.update(9.0, &CALM, &params).action, Action::Return);
        let disarmed = Conditions { armed: false, ..CALM };
        assert_eq!(failsafe.update(10.0, &disarmed, &params).action, Action::None);
        assert_eq!(failsafe.update(11.0, &CALM, &params).action, Action::None);
    }
}
