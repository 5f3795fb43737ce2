//! What a run tells while it goes on: events, and the line that shows them.

use std::ops::ControlFlow;

use crate::report::Row;

/// How far a run is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    /// Iterations run.
    pub iteration: u32,
    /// Iterations in all.
    pub iterations: u32,
    /// Iterations a second of wall time, of late.
    pub per_s: f64,
    /// Mean over the last training images, dB.
    pub train_psnr_db: Option<f64>,
    /// At the last evaluation, dB.
    pub held_out_psnr_db: Option<f64>,
    /// Gaussians of the model.
    pub gaussians: usize,
}

impl Progress {
    /// Wall time still expected, seconds; `None` before anything is known.
    #[must_use]
    pub fn left_s(&self) -> Option<f64> {
        (self.per_s > 0.0).then(|| f64::from(self.iterations.saturating_sub(self.iteration)) / self.per_s)
    }

    /// One line. What is not known is left out.
    #[must_use]
    pub fn line(&self) -> String {
        let mut parts = vec![format!("{:>6}/{}", self.iteration, self.iterations)];
        if self.per_s > 0.0 {
            parts.push(format!("{:.1} it/s", self.per_s));
        }
        parts.extend(self.train_psnr_db.map(|db| format!("training {db:.2} dB")));
        parts.extend(self.held_out_psnr_db.map(|db| format!("held out {db:.2} dB")));
        parts.push(format!("{} Gaussians", self.gaussians));
        parts.extend(self.left_s().map(|left| format!("{} left", duration(left))));
        parts.join("  ")
    }
}

/// A time as people read it.
fn duration(seconds: f64) -> String {
    let whole = seconds.max(0.0).ceil() as u64;
    match whole {
        0..60 => format!("{whole} s"),
        60..3600 => format!("{} min {} s", whole / 60, whole % 60),
        _ => format!("{} h {} min", whole / 3600, whole % 3600 / 60),
    }
}

/// What happened.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// The dataset is in memory.
    Loaded {
        /// Its format.
        format: &'static str,
        /// Images trained on.
        training: usize,
        /// Images held out.
        held_out: usize,
        /// Width and height of the first image, pixels.
        size: (u32, u32),
        /// Megabytes of the images.
        megabytes: f64,
    },
    /// Training begins.
    Began {
        /// What the model comes from.
        origin: &'static str,
        /// Its Gaussians.
        gaussians: usize,
    },
    /// Training goes on where a checkpoint left it.
    Resumed {
        /// Iterations run before.
        iteration: u32,
    },
    /// Iterations were run.
    Trained(Progress),
    /// The model was measured.
    Evaluated(Row),
}

impl Event {
    /// The event as a line.
    #[must_use]
    pub fn line(&self) -> String {
        match self {
            Self::Loaded { format, training, held_out, size: (width, height), megabytes } => format!(
                "{format} dataset: {training} images to train on, {held_out} held out, {width}x{height}, {megabytes:.0} MB"
            ),
            Self::Began { origin, gaussians } => format!("beginning with {gaussians} Gaussians from {origin}"),
            Self::Resumed { iteration } => format!("going on from the checkpoint at iteration {iteration}"),
            Self::Trained(progress) => progress.line(),
            Self::Evaluated(row) => {
                let mut line = format!("iteration {}: {} Gaussians", row.iteration, row.gaussians);
                if let (Some(psnr), Some(ssim)) = (row.held_out_psnr_db, row.held_out_ssim) {
                    line += &format!(", held out {psnr:.2} dB, SSIM {ssim:.4}");
                }
                line + &format!(", {:.1} s of processor time", row.cpu_s)
            }
        }
    }
}

/// Hears of a run's events, and may end it: on [`ControlFlow::Break`] a checkpoint is written and the run stops.
pub trait Observer {
    /// Hears of an event.
    fn on(&mut self, event: &Event) -> ControlFlow<()>;
}

impl<F: FnMut(&Event) -> ControlFlow<()>> Observer for F {
    fn on(&mut self, event: &Event) -> ControlFlow<()> {
        self(event)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_tells_what_is_known_and_leaves_out_the_rest() {
        let progress = Progress {
            iteration: 420,
            iterations: 7000,
            per_s: 80.25,
            train_psnr_db: Some(31.256),
            held_out_psnr_db: None,
            gaussians: 12345,
        };
        assert_eq!(progress.line(), "   420/7000  80.2 it/s  training 31.26 dB  12345 Gaussians  1 min 22 s left");
        let nothing = Progress { iteration: 0, per_s: 0.0, train_psnr_db: None, ..progress };
        assert_eq!(nothing.line(), "     0/7000  12345 Gaussians");
        assert_eq!((duration(59.5), duration(7384.0)), ("1 min 0 s".to_owned(), "2 h 3 min".to_owned()));
    }
}
