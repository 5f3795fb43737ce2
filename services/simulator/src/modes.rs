//! Flight modes: PX4's custom mode numbers, and what each mode needs and forbids.

/// A flight mode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// Sticks to tilt and thrust (treated as tilt and climb rate).
    Manual,
    /// Sticks to tilt, altitude held.
    Altctl,
    /// Sticks to velocity, position held.
    Posctl,
    /// Sticks to levelled tilt.
    Stabilized,
    /// Climb to MIS_TAKEOFF_ALT, then Hold.
    AutoTakeoff,
    /// Hold.
    AutoLoiter,
    /// Climb, fly home, descend, land.
    AutoRtl,
    /// Land here.
    AutoLand,
    /// Setpoints from outside.
    Offboard,
    /// Motors off, for good.
    Termination,
}

const MAIN_AUTO: u8 = 4;

impl Mode {
    /// PX4's main and sub mode numbers.
    #[must_use]
    pub fn main_sub(self) -> (u8, u8) {
        match self {
            Self::Manual => (1, 0),
            Self::Altctl => (2, 0),
            Self::Posctl => (3, 0),
            Self::AutoTakeoff => (MAIN_AUTO, 2),
            Self::AutoLoiter => (MAIN_AUTO, 3),
            Self::AutoRtl => (MAIN_AUTO, 5),
            Self::AutoLand => (MAIN_AUTO, 6),
            Self::Offboard => (6, 0),
            Self::Stabilized => (7, 0),
            Self::Termination => (10, 0),
        }
    }

    /// The mode of a pair of numbers; `None` for a mode this vehicle does not have (missions among them: it holds none).
    #[must_use]
    pub fn from_main_sub(main: u8, sub: u8) -> Option<Self> {
        Some(match (main, sub) {
            (1, _) => Self::Manual,
            (2, _) => Self::Altctl,
            (3, 0) => Self::Posctl,
            (MAIN_AUTO, 2) => Self::AutoTakeoff,
            (MAIN_AUTO, 3) => Self::AutoLoiter,
            (MAIN_AUTO, 5) => Self::AutoRtl,
            (MAIN_AUTO, 6) => Self::AutoLand,
            (6, _) => Self::Offboard,
            (7, _) => Self::Stabilized,
            _ => return None,
        })
    }

    /// HEARTBEAT.custom_mode.
    #[must_use]
    pub fn custom_mode(self) -> u32 {
        let (main, sub) = self.main_sub();
        u32::from(main) << 16 | u32::from(sub) << 24
    }

    /// HEARTBEAT.base_mode without the armed bit: custom 1, auto 4, guided 8, stabilised 16, manual 64.
    #[must_use]
    pub fn base_mode(self) -> u8 {
        match self {
            Self::Manual => 1 | 64,
            Self::Altctl | Self::Posctl | Self::Stabilized => 1 | 16 | 64,
            Self::AutoTakeoff | Self::AutoLoiter | Self::AutoRtl | Self::AutoLand | Self::Offboard => 1 | 4 | 8 | 16,
            Self::Termination => 1,
        }
    }

    /// Needs a pilot's sticks.
    #[must_use]
    pub fn needs_sticks(self) -> bool {
        matches!(self, Self::Manual | Self::Altctl | Self::Posctl | Self::Stabilized)
    }

    /// Arming is refused in it, and a disarm falls back to the mode before it.
    #[must_use]
    pub fn prevents_arming(self) -> bool {
        matches!(self, Self::AutoRtl | Self::AutoLand | Self::Termination)
    }

    /// Keeps itself on a path of its own (PX4's auto modes).
    #[must_use]
    pub fn is_auto(self) -> bool {
        matches!(self, Self::AutoTakeoff | Self::AutoLoiter | Self::AutoRtl | Self::AutoLand)
    }
}

/// What the pilot or client chose, against what flies: PX4's user mode intention.
#[derive(Debug, Clone)]
pub struct Intention {
    intended: Mode,
    after_disarm: Mode,
}

impl Default for Intention {
    fn default() -> Self {
        Self { intended: Mode::AutoLoiter, after_disarm: Mode::AutoLoiter }
    }
}

impl Intention {
    /// The chosen mode.
    #[must_use]
    pub fn mode(&self) -> Mode {
        self.intended
    }

    /// Chooses a mode.
    pub fn choose(&mut self, mode: Mode) {
        self.intended = mode;
        if !mode.prevents_arming() {
            self.after_disarm = mode;
        }
    }

    /// A disarm goes back to the last mode that may be armed in: after OFFBOARD and Land it is OFFBOARD again.
    pub fn on_disarm(&mut self) {
        self.intended = self.after_disarm;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [Mode; 10] = [
        Mode::Manual,
        Mode::Altctl,
        Mode::Posctl,
        Mode::Stabilized,
        Mode::AutoTakeoff,
        Mode::AutoLoiter,
        Mode::AutoRtl,
        Mode::AutoLand,
        Mode::Offboard,
        Mode::Termination,
    ];

    #[test]
    fn numbers_are_px4s_and_go_both_ways() {
        assert_eq!(Mode::AutoLoiter.custom_mode(), 4 << 16 | 3 << 24);
        assert_eq!(Mode::Offboard.custom_mode(), 6 << 16);
        assert_eq!(Mode::AutoLoiter.base_mode(), 0b11101);
        for mode in ALL {
            let (main, sub) = mode.main_sub();
            if mode != Mode::Termination {
                assert_eq!(Mode::from_main_sub(main, sub), Some(mode));
            }
        }
        assert_eq!(Mode::from_main_sub(4, 4), None, "no missions");
    }

    #[test]
    fn a_landing_gives_way_to_the_mode_before_it() {
        let mut intention = Intention::default();
        intention.choose(Mode::Offboard);
        intention.choose(Mode::AutoLand);
        intention.on_disarm();
        assert_eq!(intention.mode(), Mode::Offboard);
        intention.choose(Mode::AutoLoiter);
        intention.choose(Mode::AutoRtl);
        intention.on_disarm();
        assert_eq!(intention.mode(), Mode::AutoLoiter);
    }
}
