//! The phases of the link, who commands the vehicle, and what is allowed when.
//!
//! DISCOVER -> SYNC -> GROUND (commands Hold) -> READY -> ARMED -> TAKEOFF -> HOLD -> ENTERING -> OFFBOARD -> RETURN / LAND ->
//! GROUND; SUSPENDED while a pilot or a failsafe flies. The phase follows from facts, so a restarted px4-link lands in the
//! right one; what must be remembered is only who commands.

use shared_types::messages::{ChargeState, Commander, FlightMode, VehicleCommand};

/// Where the link is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// No autopilot yet: listens, sends nothing but heartbeats.
    Discover,
    /// Asks what it must know: version, home, origin, rates, parameters, gimbal.
    Sync,
    /// On the ground, not ready to arm; commands Hold where another mode keeps it from getting ready.
    Ground,
    /// On the ground and ready.
    Ready,
    /// Motors run on the ground.
    Armed,
    /// Climbing by AUTO.TAKEOFF.
    Takeoff,
    /// In the air, the autopilot holds.
    Hold,
    /// Streams the present pose until OFFBOARD is on.
    Entering,
    /// Setpoints fly the vehicle.
    Offboard,
    /// The autopilot returns by our command.
    Return,
    /// The autopilot lands by our command.
    Land,
    /// A pilot or a failsafe flies: sends no command and no setpoint until the word to go on.
    Suspended,
}

/// What the phase follows from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Facts {
    /// An autopilot was found.
    pub found: bool,
    /// Everything asked was answered or given up.
    pub synced: bool,
    /// Motors run.
    pub armed: bool,
    /// Known to stand on the ground.
    pub landed: bool,
    /// Position, attitude and home are known, and the autopilot can arm.
    pub ready: bool,
    /// Setpoints flow.
    pub streaming: bool,
    /// Mode now.
    pub mode: FlightMode,
    /// Who commands.
    pub commander: Commander,
}

impl Phase {
    /// The phase that follows, for every phase and all facts.
    #[must_use]
    pub fn next(self, facts: &Facts) -> Self {
        match (facts.found, facts.synced, facts.armed) {
            (false, ..) => return Self::Discover,
            (true, false, _) => return Self::Sync,
            (true, true, false) => return if facts.ready { Self::Ready } else { Self::Ground },
            (true, true, true) => {}
        }
        if matches!(facts.commander, Commander::Pilot | Commander::Failsafe) {
            return Self::Suspended;
        }
        match facts.mode {
            FlightMode::Offboard if facts.streaming => Self::Offboard,
            FlightMode::Hold | FlightMode::Offboard if facts.streaming => Self::Entering,
            FlightMode::Takeoff => Self::Takeoff,
            FlightMode::Return => Self::Return,
            FlightMode::Land => Self::Land,
            FlightMode::Hold | FlightMode::Offboard if facts.landed => Self::Armed,
            FlightMode::Hold | FlightMode::Offboard => Self::Hold,
            // Our own arming may be seen before the mode is.
            FlightMode::Unknown | FlightMode::Pilot | FlightMode::Other => {
                if facts.landed {
                    Self::Armed
                } else {
                    Self::Suspended
                }
            }
        }
    }

    /// Why a command cannot be taken in this phase; `None` when it can.
    #[must_use]
    pub fn objection(self, command: VehicleCommand) -> Option<&'static str> {
        use VehicleCommand::{GoOn, Takeoff};
        match (self, command) {
            (Self::Discover, _) => Some("no autopilot was heard yet; is it running, and is link.url right?"),
            (Self::Sync, _) => Some("still asking the autopilot what must be known; ask again"),
            (Self::Suspended, GoOn) => None,
            (Self::Suspended, _) => Some("a pilot or a failsafe flies; waiting for the operator's word to go on"),
            (Self::Ground | Self::Ready, Takeoff) => Some("not armed"),
            _ => None,
        }
    }
}

/// What a px4-link that finds a vehicle in the air does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Found {
    /// Command Hold, stream the present pose, enter OFFBOARD.
    Recover,
    /// It holds, or climbs, by our own command: wait for the planner.
    Ours,
    /// Send nothing until the word to go on.
    LeaveTo(Commander),
}

/// Decides what to do with a vehicle found in the air after a start or a stall. `ours`: it is in the mode that we commanded
/// last, so that a Hold that an operator commanded meanwhile is not taken for our own.
#[must_use]
pub fn found_in_air(mode: FlightMode, intended: FlightMode, charge: ChargeState, fence: bool, ours: bool) -> Found {
    if fence || matches!(charge, ChargeState::Critical | ChargeState::Emergency) {
        return Found::LeaveTo(Commander::Failsafe);
    }
    match (mode, intended) {
        (FlightMode::Offboard, _) | (FlightMode::Hold, FlightMode::Offboard) => Found::Recover,
        (FlightMode::Hold | FlightMode::Takeoff, _) if ours => Found::Ours,
        (FlightMode::Return | FlightMode::Land | FlightMode::Hold, _)
            if intended != mode && intended != FlightMode::Unknown =>
        {
            Found::LeaveTo(Commander::Failsafe)
        }
        _ => Found::LeaveTo(Commander::Pilot),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FLYING: Facts = Facts {
        found: true,
        synced: true,
        armed: true,
        landed: false,
        ready: true,
        streaming: true,
        mode: FlightMode::Offboard,
        commander: Commander::Vantage,
    };

    #[test]
    fn every_phase_follows_from_facts_alone() {
        let all = [Phase::Discover, Phase::Sync, Phase::Ground, Phase::Ready, Phase::Offboard, Phase::Suspended];
        for phase in all {
            assert_eq!(phase.next(&FLYING), Phase::Offboard);
            assert_eq!(phase.next(&Facts { found: false, ..FLYING }), Phase::Discover);
            assert_eq!(phase.next(&Facts { commander: Commander::Pilot, ..FLYING }), Phase::Suspended);
            assert_eq!(phase.next(&Facts { streaming: false, ..FLYING }), Phase::Hold);
            assert_eq!(phase.next(&Facts { mode: FlightMode::Hold, ..FLYING }), Phase::Entering);
            assert_eq!(phase.next(&Facts { armed: false, ..FLYING }), Phase::Ready);
        }
    }

    #[test]
    fn a_suspended_link_hears_only_the_word_to_go_on() {
        for &command in VehicleCommand::ALL {
            assert_eq!(Phase::Suspended.objection(command).is_none(), command == VehicleCommand::GoOn);
            assert!(Phase::Offboard.objection(command).is_none());
        }
    }

    #[test]
    fn a_vehicle_found_in_the_air_is_taken_back_only_from_offboard() {
        use FlightMode::{Hold, Land, Offboard, Pilot, Return};
        let ok = ChargeState::Ok;
        assert_eq!(found_in_air(Hold, Offboard, ok, false, false), Found::Recover);
        assert_eq!(found_in_air(Offboard, Offboard, ok, false, false), Found::Recover);
        assert_eq!(found_in_air(Hold, Hold, ok, false, true), Found::Ours, "our own Hold");
        assert_eq!(found_in_air(Hold, Hold, ok, false, false), Found::LeaveTo(Commander::Pilot), "an operator's Hold");
        for mode in [Pilot, Return, Land] {
            assert_eq!(found_in_air(mode, mode, ok, false, true), Found::LeaveTo(Commander::Pilot));
        }
        assert_eq!(found_in_air(Return, Offboard, ok, false, true), Found::LeaveTo(Commander::Failsafe));
        assert_eq!(found_in_air(Hold, Offboard, ok, true, true), Found::LeaveTo(Commander::Failsafe));
        assert_eq!(
            found_in_air(Offboard, Offboard, ChargeState::Critical, false, true),
            Found::LeaveTo(Commander::Failsafe)
        );
    }
}
