//! Faults of the simulated vehicle and its link, each a sentence: `gone at 60 for 5`.

use core::fmt;
use core::str::FromStr;

use serde::{Deserialize, Serialize};

/// What goes wrong.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FaultKind {
    /// Packets vanish, in both directions: this share of them.
    Loss(f64),
    /// Packets take so much longer in each direction, seconds.
    Delay(f64),
    /// Packets come twice: this share.
    Duplicate(f64),
    /// Packets are overtaken by later ones: this share.
    Reorder(f64),
    /// Bytes that are no packet, and packets with a wrong bit, come between: one for this share of packets.
    Garbage(f64),
    /// Nothing comes through.
    Gone,
    /// The autopilot's heartbeats do not come through.
    HeartbeatLoss,
    /// Another autopilot, of the next system id, speaks on the link from far away.
    SecondAutopilot,
    /// Another ground station speaks to the vehicle and on the link.
    SecondStation,
    /// Components without an autopilot speak on the link, and answers come that are meant for others.
    WrongIds,
    /// The estimate jumps: metres toward east, north and up.
    Jump([f64; 3]),
    /// The battery is at this charge from one moment to the next, 0 to 1.
    Battery(f64),
    /// The autopilot's fence: it holds beyond so many metres from home.
    Fence(f64),
    /// A pilot takes over, flies gently by hand, and lets go with Hold.
    Pilot,
}

/// A fault and when it is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Fault {
    /// What.
    pub kind: FaultKind,
    /// Its beginning: seconds after the vehicle's boot.
    pub at_s: f64,
    /// Its length, seconds; infinite where none was given.
    pub for_s: f64,
}

/// A sentence that is none.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{sentence}` is no fault ({why}); expected `NAME [VALUES] [at SECONDS] [for SECONDS]` with one of: loss SHARE, \
     delay SECONDS, duplicate SHARE, reorder SHARE, garbage SHARE, gone, heartbeat-loss, second-autopilot, \
     second-station, wrong-ids, jump EAST NORTH UP, battery CHARGE, fence METRES, pilot"
)]
pub struct BadFault {
    sentence: String,
    why: String,
}

impl Fault {
    /// Whether it is going on.
    #[must_use]
    pub fn is_on(&self, boot_s: f64) -> bool {
        boot_s >= self.at_s && boot_s - self.at_s < self.for_s
    }
}

impl FromStr for Fault {
    type Err = BadFault;

    fn from_str(sentence: &str) -> Result<Self, BadFault> {
        parse(sentence).map_err(|why| BadFault { sentence: sentence.to_owned(), why })
    }
}

impl TryFrom<String> for Fault {
    type Error = BadFault;

    fn try_from(sentence: String) -> Result<Self, BadFault> {
        sentence.parse()
    }
}

impl From<Fault> for String {
    fn from(fault: Fault) -> Self {
        fault.to_string()
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.kind {
            FaultKind::Loss(share) => write!(f, "loss {share}"),
            FaultKind::Delay(seconds) => write!(f, "delay {seconds}"),
            FaultKind::Duplicate(share) => write!(f, "duplicate {share}"),
            FaultKind::Reorder(share) => write!(f, "reorder {share}"),
            FaultKind::Garbage(share) => write!(f, "garbage {share}"),
            FaultKind::Gone => write!(f, "gone"),
            FaultKind::HeartbeatLoss => write!(f, "heartbeat-loss"),
            FaultKind::SecondAutopilot => write!(f, "second-autopilot"),
            FaultKind::SecondStation => write!(f, "second-station"),
            FaultKind::WrongIds => write!(f, "wrong-ids"),
            FaultKind::Jump([east, north, up]) => write!(f, "jump {east} {north} {up}"),
            FaultKind::Battery(charge) => write!(f, "battery {charge}"),
            FaultKind::Fence(metres) => write!(f, "fence {metres}"),
            FaultKind::Pilot => write!(f, "pilot"),
        }?;
        if self.at_s > 0.0 {
            write!(f, " at {}", self.at_s)?;
        }
        if self.for_s.is_finite() {
            write!(f, " for {}", self.for_s)?;
        }
        Ok(())
    }
}

/// Words that are taken off one by one.
struct Words<'a>(core::str::SplitWhitespace<'a>);

impl Words<'_> {
    fn number(&mut self, what: &str, low: f64, high: f64) -> Result<f64, String> {
        let word = self.0.next().ok_or_else(|| format!("{what} is missing"))?;
        let number = word.parse::<f64>().ok().filter(|number| (low..=high).contains(number));
        number.ok_or_else(|| format!("{what} is {word}, expected a number from {low} to {high}"))
    }

    fn share(&mut self) -> Result<f64, String> {
        self.number("the share", 0.0, 1.0)
    }
}

fn parse(sentence: &str) -> Result<Fault, String> {
    let mut words = Words(sentence.split_whitespace());
    let name = words.0.next().ok_or("it is empty")?;
    let kind = match name {
        "loss" => FaultKind::Loss(words.share()?),
        "delay" => FaultKind::Delay(words.number("the delay", 0.0, 10.0)?),
        "duplicate" => FaultKind::Duplicate(words.share()?),
        "reorder" => FaultKind::Reorder(words.share()?),
        "garbage" => FaultKind::Garbage(words.share()?),
        "gone" => FaultKind::Gone,
        "heartbeat-loss" => FaultKind::HeartbeatLoss,
        "second-autopilot" => FaultKind::SecondAutopilot,
        "second-station" => FaultKind::SecondStation,
        "wrong-ids" => FaultKind::WrongIds,
        "jump" => {
            let mut metres = |axis| words.number(axis, -1000.0, 1000.0);
            FaultKind::Jump([metres("the way east")?, metres("the way north")?, metres("the way up")?])
        }
        "battery" => FaultKind::Battery(words.number("the charge", 0.0, 1.0)?),
        "fence" => FaultKind::Fence(words.number("the distance", 0.1, 1e4)?),
        "pilot" => FaultKind::Pilot,
        other => return Err(format!("there is no `{other}`")),
    };
    let mut fault = Fault { kind, at_s: 0.0, for_s: f64::INFINITY };
    while let Some(word) = words.0.next() {
        match word {
            "at" => fault.at_s = words.number("the beginning", 0.0, 1e6)?,
            "for" => fault.for_s = words.number("the length", 0.0, 1e6)?,
            other => return Err(format!("`{other}` is not understood")),
        }
    }
    Ok(fault)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn sentences_are_read() {
        let read = |text: &str| text.parse::<Fault>().expect(text);
        let always = f64::INFINITY;
        assert_eq!(read("loss 0.05"), Fault { kind: FaultKind::Loss(0.05), at_s: 0.0, for_s: always });
        assert_eq!(read("gone at 60 for 5"), Fault { kind: FaultKind::Gone, at_s: 60.0, for_s: 5.0 });
        assert_eq!(
            read(" jump 3  0 -0.5 at 50"),
            Fault { kind: FaultKind::Jump([3.0, 0.0, -0.5]), at_s: 50.0, for_s: always }
        );
        let pilot = read("pilot for 10 at 40");
        assert!(!pilot.is_on(39.9) && pilot.is_on(40.0) && pilot.is_on(49.9) && !pilot.is_on(50.0));
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (sentence, why) in [
            ("", "it is empty"),
            ("los 0.1", "there is no `los`"),
            ("loss", "the share is missing"),
            ("loss 1.5", "the share is 1.5, expected a number from 0 to 1"),
            ("loss NaN", "the share is NaN"),
            ("gone at", "the beginning is missing"),
            ("gone 5", "`5` is not understood"),
            ("jump 3 0 at 5", "the way up is at"),
        ] {
            let error = sentence.parse::<Fault>().expect_err(sentence).to_string();
            assert!(error.contains(why) && error.contains("second-autopilot"), "{sentence}: {error}");
        }
    }

    proptest! {
        #[test]
        fn a_fault_is_its_sentence(
            kind in prop_oneof![
                (0.0..=1.0).prop_map(FaultKind::Loss),
                (0.0..=1.0).prop_map(FaultKind::Battery),
                prop::array::uniform3(-9.0..9.0).prop_map(FaultKind::Jump),
                Just(FaultKind::Pilot),
            ],
            at_s in 0.0..1e5,
            for_s in prop_oneof![Just(f64::INFINITY), 0.0..1e5],
        ) {
            let fault = Fault { kind, at_s, for_s };
            prop_assert_eq!(fault.to_string().parse::<Fault>(), Ok(fault));
        }

        #[test]
        fn no_sentence_panics(text in ".{0,60}") {
            drop(text.parse::<Fault>());
        }
    }
}
