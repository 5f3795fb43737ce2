//! Progress on the terminal: one line that changes, or one line for each change of phase where there is no terminal.

use std::io::IsTerminal as _;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};
use shared_types::messages::{MissionPhase, MissionState};

/// What the user is told of the mission's state.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    /// What it is doing.
    pub phase: MissionPhase,
    /// Training rounds begun.
    pub round: u32,
    /// Keyframes stored.
    pub keyframes: u32,
    /// Keyframes wanted.
    pub keyframes_wanted: u32,
    /// PSNR of the training views, dB; `None` before the first.
    pub psnr_train_db: Option<f64>,
    /// Literal coverage of the paper, 0..1; `None` before the first.
    pub paper_coverage: Option<f64>,
    /// Mission time still expected, seconds; `None` where nothing is known.
    pub remaining_s: Option<f64>,
    /// Mission time so far, seconds.
    pub mission_s: f64,
}

impl Report {
    /// The report of a state at mission time `now_ns`. `None` when the state's phase is not one (a wild writer).
    #[must_use]
    pub fn of(state: &MissionState, now_ns: u64) -> Option<Self> {
        let positive = |value: f64| (value.is_finite() && value > 0.0).then_some(value);
        let elapsed_ns = if state.started_ns == 0 { 0 } else { now_ns.saturating_sub(state.started_ns) };
        Some(Self {
            phase: MissionPhase::from_code(state.phase)?,
            round: state.round,
            keyframes: state.keyframes,
            keyframes_wanted: state.keyframes_wanted,
            psnr_train_db: positive(state.psnr_train_db),
            paper_coverage: positive(state.paper_coverage),
            remaining_s: positive(state.remaining_s),
            mission_s: shared_types::s_from_ns(elapsed_ns),
        })
    }

    /// One line. What is not known is left out.
    #[must_use]
    pub fn line(&self) -> String {
        let mut parts = vec![format!("{:>6.1} s", self.mission_s), format!("{:<9}", self.phase.name())];
        if self.keyframes_wanted > 0 {
            parts.push(format!("round {}", self.round));
            parts.push(format!("views {}/{}", self.keyframes, self.keyframes_wanted));
        }
        parts.extend(self.psnr_train_db.map(|psnr| format!("training {psnr:.1} dB")));
        parts.extend(self.paper_coverage.map(|share| format!("coverage {:.0} %", share * 100.0)));
        parts.extend(self.remaining_s.map(|left| format!("{left:.0} s left")));
        parts.join("  ")
    }
}

/// Shows reports to the user, on standard error.
#[derive(Debug)]
pub struct Progress {
    bar: Option<ProgressBar>,
    last_phase: Option<MissionPhase>,
    last_line: String,
}

impl Progress {
    /// A line that changes on a terminal, else lines.
    #[must_use]
    pub fn new() -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new_spinner();
            if let Ok(style) = ProgressStyle::with_template("{spinner} {wide_msg}") {
                bar.set_style(style);
            }
            bar.enable_steady_tick(Duration::from_millis(200));
            bar
        });
        Self { bar, last_phase: None, last_line: String::new() }
    }

    /// Shows a report. Without a terminal, only changes of phase make a line.
    pub fn show(&mut self, report: &Report) {
        let line = report.line();
        if line == self.last_line {
            return;
        }
        let new_phase = self.last_phase != Some(report.phase);
        match &self.bar {
            Some(bar) => bar.set_message(line.clone()),
            None if new_phase => crate::say(&line),
            None => {}
        }
        self.last_phase = Some(report.phase);
        self.last_line = line;
    }

    /// Says something that stays on the screen.
    pub fn say(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| crate::say(text)),
            None => crate::say(text),
        }
    }

    /// Says what is being done while no mission state comes.
    pub fn doing(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.set_message(text.to_owned()),
            None => crate::say(text),
        }
    }

    /// Says how something goes that takes a while; nothing without a terminal.
    pub fn doing_quietly(&self, text: &str) {
        if let Some(bar) = &self.bar {
            bar.set_message(text.to_owned());
        }
    }

    /// Takes the changing line away.
    pub fn clear(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

impl Default for Progress {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_tells_what_is_known_and_leaves_out_the_rest() {
        let mut state = MissionState { phase: MissionPhase::Preparing.code(), ..MissionState::default() };
        assert_eq!(Report::of(&state, 5).expect("known phase").line(), "   0.0 s  preparing");
        state.phase = MissionPhase::Capture.code();
        (state.round, state.keyframes, state.keyframes_wanted) = (3, 16, 48);
        (state.psnr_train_db, state.paper_coverage, state.remaining_s) = (31.25, 0.625, f64::NAN);
        state.started_ns = 1_000_000_000;
        let report = Report::of(&state, 62_500_000_000).expect("known phase");
        assert_eq!(report.line(), "  61.5 s  capture    round 3  views 16/48  training 31.2 dB  coverage 62 %");
    }

    #[test]
    fn a_wild_phase_is_not_reported() {
        assert_eq!(Report::of(&MissionState { phase: 999, ..MissionState::default() }, 0), None);
    }
}
