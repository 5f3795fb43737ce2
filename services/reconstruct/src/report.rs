//! What a run leaves besides its model: `metrics.csv`, `metrics.json`.

use std::fmt::Write as _;

use serde::{Deserialize, Serialize};
use splatting::bytes::{Reader, Truncated, Writer};

use crate::evaluate::Quality;
use crate::options::Identity;

/// One evaluation: a row of `metrics.csv`. Processor and wall time are of training alone, without evaluations.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Iterations run.
    pub iteration: u32,
    /// Processor seconds of all threads.
    pub cpu_s: f64,
    /// Wall seconds.
    pub wall_s: f64,
    /// Gaussians of the model.
    pub gaussians: usize,
    /// Mean over the last training images, dB; absent before the first.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub train_psnr_db: Option<f64>,
    /// Mean over the held-out images, over the pixels that count, dB; absent without such images.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub held_out_psnr_db: Option<f64>,
    /// Mean over the held-out images, over the pixels that count.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub held_out_ssim: Option<f64>,
    /// Mean over the held-out images, over the whole image, dB.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub held_out_frame_psnr_db: Option<f64>,
}

impl Row {
    /// Bytes of a row in a checkpoint.
    pub(crate) const LEAST_BYTES: usize = 4 + 8 * 7;

    /// Takes the figures of the held-out images.
    #[must_use]
    pub fn with(self, quality: Option<&Quality>) -> Self {
        Self {
            held_out_psnr_db: quality.map(|quality| quality.psnr_db),
            held_out_ssim: quality.map(|quality| quality.ssim),
            held_out_frame_psnr_db: quality.map(|quality| quality.frame_psnr_db),
            ..self
        }
    }

    pub(crate) fn write(&self, writer: &mut Writer) {
        writer.u32(self.iteration);
        writer.f64(self.cpu_s);
        writer.f64(self.wall_s);
        writer.u64(self.gaussians as u64);
        for figure in [self.train_psnr_db, self.held_out_psnr_db, self.held_out_ssim, self.held_out_frame_psnr_db] {
            writer.f64(figure.unwrap_or(f64::NAN));
        }
    }

    pub(crate) fn read(reader: &mut Reader<'_>) -> Result<Self, Truncated> {
        const WHAT: &str = "an evaluation";
        let (iteration, cpu_s, wall_s) = (reader.u32(WHAT)?, reader.f64(WHAT)?, reader.f64(WHAT)?);
        let gaussians = usize::try_from(reader.u64(WHAT)?).unwrap_or(usize::MAX);
        let mut figure = || Ok(Some(reader.f64(WHAT)?).filter(|value| !value.is_nan()));
        Ok(Self {
            iteration,
            cpu_s,
            wall_s,
            gaussians,
            train_psnr_db: figure()?,
            held_out_psnr_db: figure()?,
            held_out_ssim: figure()?,
            held_out_frame_psnr_db: figure()?,
        })
    }
}

/// `metrics.csv`. What was not measured is empty.
#[must_use]
pub fn csv(rows: &[Row]) -> String {
    let mut text = String::from(
        "iteration,cpu_s,wall_s,gaussians,train_psnr_db,held_out_psnr_db,held_out_ssim,held_out_frame_psnr_db\n",
    );
    let cell = |value: Option<f64>, digits: usize| value.map_or(String::new(), |value| format!("{value:.digits$}"));
    for row in rows {
        writeln!(
            text,
            "{},{:.3},{:.3},{},{},{},{},{}",
            row.iteration,
            row.cpu_s,
            row.wall_s,
            row.gaussians,
            cell(row.train_psnr_db, 4),
            cell(row.held_out_psnr_db, 4),
            cell(row.held_out_ssim, 6),
            cell(row.held_out_frame_psnr_db, 4),
        )
        .ok();
    }
    text
}

/// `metrics.json`: the whole run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// What was run.
    pub run: Identity,
    /// What the model began with.
    pub origin: String,
    /// Gaussians that it began with.
    pub first_gaussians: usize,
    /// Gaussians in the end.
    pub gaussians: usize,
    /// Least and greatest width of the images, pixels.
    pub width_px: [u32; 2],
    /// Up in the world.
    pub up: [f32; 3],
    /// Threads.
    pub threads: usize,
    /// What trained, one after the other: instruction set of the CPU, or adapter.
    pub backends: Vec<String>,
    /// Iterations a second of wall time.
    pub iterations_per_s: f64,
    /// Processor milliseconds an iteration.
    pub cpu_ms_per_iteration: f64,
    /// Evaluations, oldest first.
    pub evaluations: Vec<Row>,
    /// Megabytes.
    pub memory: Memory,
}

/// Memory by kind, megabytes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    /// Images as loaded.
    pub images_mb: f64,
    /// Views prepared for the loss.
    pub views_mb: f64,
    /// Parameters of the model, and two moments of each.
    pub model_mb: f64,
    /// Most that the process ever held; absent where the system does not tell.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub peak_rss_mb: Option<f64>,
}

impl Report {
    /// The last evaluation.
    #[must_use]
    pub fn last(&self) -> Option<&Row> {
        self.evaluations.last()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row() -> Row {
        Row {
            iteration: 1000,
            cpu_s: 12.5,
            wall_s: 7.25,
            gaussians: 4321,
            train_psnr_db: Some(30.0),
            held_out_psnr_db: Some(28.123456),
            held_out_ssim: None,
            held_out_frame_psnr_db: None,
        }
    }

    #[test]
    fn what_was_not_measured_is_empty() {
        let text = csv(&[row()]);
        let lines: Vec<&str> = text.lines().collect();
        assert!(lines[0].starts_with("iteration,cpu_s,wall_s,gaussians,train_psnr_db,held_out_psnr_db,held_out_ssim"));
        assert_eq!(lines[1], "1000,12.500,7.250,4321,30.0000,28.1235,,");
        assert!(serde_json::to_value(row()).expect("json").get("held_out_ssim").is_none());
    }

    #[test]
    fn a_row_survives_a_checkpoint() {
        let mut writer = Writer::default();
        row().write(&mut writer);
        let bytes = writer.into_bytes();
        assert_eq!(bytes.len(), Row::LEAST_BYTES);
        assert_eq!(Row::read(&mut Reader::new(&bytes)), Ok(row()));
    }
}
