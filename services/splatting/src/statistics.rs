//! What densification wants to know of every Gaussian: how hard the loss pulls at its place on the screen, in how many
//! views it was seen, and how large.

use thiserror::Error;

use crate::gradient::Screen;
use crate::model::{Gaussians, LANES, Lanes, select_row_lanes};
use crate::projection::View;
use crate::simd::{Simd, build};

/// Rows of a block: sum of gradients, views, largest radius.
pub(crate) const ROWS: usize = 3;
const SUM: usize = 0;
const VIEWS: usize = 1;
const RADIUS: usize = 2;
/// Standard deviations that a screen radius counts, as in 3DGS.
const RADIUS_SIGMAS: f32 = 3.0;

/// Statistics of every Gaussian since the last [`ScreenStatistics::reset`], in the order of the model, filled by
/// [`Engine::train_step_observed`](crate::Engine::train_step_observed).
///
/// As 3DGS (Kerbl et al. 2023, section 5.2 and its code) and gsplat define them: the gradient of the loss by the mean's
/// position in normalised device coordinates, that is the gradient by pixels times half the width and half the height of
/// the image, of which the length is summed over views; and a view counts where the Gaussian was projected into it,
/// hidden by others or not. What is done to the model's order is done here too, as with the optimiser.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ScreenStatistics {
    rows: Vec<Lanes>,
    length: usize,
}

/// Why bytes are not statistics.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum StatisticsError {
    /// Not the length that the number of Gaussians asks for.
    #[error("screen statistics of {found} bytes where {gaussians} Gaussians need {expected}: train on with empty ones")]
    Length {
        /// Bytes found.
        found: usize,
        /// Gaussians of the model.
        gaussians: usize,
        /// Bytes expected.
        expected: usize,
    },
    /// A number that no training gives.
    #[error("screen statistics of Gaussian {gaussian} are {value}, not finite and positive: train on with empty ones")]
    Value {
        /// Index of the Gaussian.
        gaussian: usize,
        /// What was read.
        value: String,
    },
}

impl ScreenStatistics {
    /// No Gaussians yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.length
    }

    /// Whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.length == 0
    }

    /// Sum over views of the length of the gradient of the loss by the Gaussian's position on the screen, in normalised
    /// device coordinates (-1 to 1 over the image).
    ///
    /// # Panics
    /// Where `index >= len()`, as a slice does.
    pub fn gradient_sum(&self, index: usize) -> f32 {
        self.at(index, SUM)
    }

    /// Number of views into which the Gaussian was projected.
    ///
    /// # Panics
    /// Where `index >= len()`, as a slice does.
    pub fn views(&self, index: usize) -> u32 {
        self.at(index, VIEWS) as u32
    }

    /// Largest radius on the screen in any of these views, pixels: three standard deviations of the projected Gaussian
    /// along its long axis, low-pass included.
    ///
    /// # Panics
    /// Where `index >= len()`, as a slice does.
    pub fn radius_px(&self, index: usize) -> f32 {
        self.at(index, RADIUS)
    }

    /// Mean over its views of the length of the gradient, which 3DGS compares with its threshold of 2e-4; 0 where the
    /// Gaussian was in no view.
    ///
    /// # Panics
    /// Where `index >= len()`, as a slice does.
    pub fn mean_gradient(&self, index: usize) -> f32 {
        self.gradient_sum(index) / self.at(index, VIEWS).max(1.0)
    }

    /// Takes the length of a model: nothing seen yet of Gaussians appended to it, none for those cut from its end.
    pub fn fit(&mut self, model: &Gaussians) {
        let length = model.len();
        if length < self.length {
            self.retain(|i| i < length);
        }
        self.rows.resize(length.div_ceil(LANES) * ROWS, Lanes([0.0; LANES]));
        self.length = length;
    }

    /// Forgets everything that was seen; the length stays.
    pub fn reset(&mut self) {
        self.rows.fill(Lanes([0.0; LANES]));
    }

    /// Keeps the statistics of the Gaussians for which `keep` says so, in order.
    pub fn retain(&mut self, mut keep: impl FnMut(usize) -> bool) {
        let kept: Vec<u32> = (0..self.length as u32).filter(|&i| keep(i as usize)).collect();
        self.select(&kept);
    }

    /// Reorders: the new `i` is the old `order[i]`.
    ///
    /// # Panics
    /// Where `order` is not as long as the statistics or names an index outside of them.
    pub fn permute(&mut self, order: &[u32]) {
        assert_eq!(order.len(), self.length, "a permutation has the length of the statistics");
        self.select(order);
    }

    /// Takes the order of an edited list: the new Gaussian `i` was seen as its source was, or not yet where it is fresh.
    pub(crate) fn follow(&mut self, sources: &[u32]) {
        self.select(sources);
    }

    /// Bytes for a checkpoint: gradient sum, views and radius of each Gaussian in turn, f32 little-endian.
    pub fn encode(&self) -> Vec<u8> {
        (0..self.length)
            .flat_map(|i| (0..ROWS).map(move |row| (i, row)))
            .flat_map(|(i, row)| self.at(i, row).to_le_bytes())
            .collect()
    }

    /// What [`ScreenStatistics::encode`] wrote for a model of `gaussians` Gaussians.
    ///
    /// # Errors
    /// Where the bytes are of another length or hold what no training gives.
    pub fn decode(bytes: &[u8], gaussians: usize) -> Result<Self, StatisticsError> {
        let expected = gaussians.saturating_mul(4 * ROWS);
        if bytes.len() != expected {
            return Err(StatisticsError::Length { found: bytes.len(), gaussians, expected });
        }
        let mut rows = vec![Lanes([0.0; LANES]); gaussians.div_ceil(LANES) * ROWS];
        for (at, value) in bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).enumerate() {
            let (gaussian, row) = (at / ROWS, at % ROWS);
            if !(value >= 0.0 && value.is_finite()) {
                return Err(StatisticsError::Value { gaussian, value: value.to_string() });
            }
            rows[gaussian / LANES * ROWS + row].0[gaussian % LANES] = value;
        }
        Ok(Self { rows, length: gaussians })
    }

    pub(crate) fn rows(&self) -> &[Lanes] {
        &self.rows
    }

    pub(crate) fn rows_mut(&mut self) -> &mut [Lanes] {
        &mut self.rows
    }

    fn at(&self, index: usize, row: usize) -> f32 {
        assert!(index < self.length, "Gaussian {index} of {}", self.length);
        self.rows[index / LANES * ROWS + row].0[index % LANES]
    }

    fn select(&mut self, from: &[u32]) {
        self.rows = select_row_lanes(&self.rows, ROWS, from);
        self.length = from.len();
    }
}

/// Adds one view of 16 Gaussians to their rows.
#[inline(always)]
pub(crate) fn observe<S: Simd>(s: S, view: &View, screen: &Screen<S>, rows: &mut [Lanes]) {
    let zero = s.splat(0.0);
    let half_size = [s.splat(0.5 * view.width), s.splat(0.5 * view.height)];
    let ndc = build!(zero; 2; |k| s.mul(screen.gradient[k], half_size[k]));
    let length = s.sqrt(s.fma(ndc[0], ndc[0], s.mul(ndc[1], ndc[1])));
    // Largest eigenvalue of [[a, b], [b, c]].
    let [a, b, c] = screen.covariance;
    let half = s.splat(0.5);
    let (middle, difference) = (s.mul(half, s.add(a, c)), s.mul(half, s.sub(a, c)));
    let variance = s.add(middle, s.sqrt(s.fma(difference, difference, s.mul(b, b))));
    let radius = s.mul(s.splat(RADIUS_SIGMAS), s.sqrt(variance));
    let seen = [s.keep(screen.moved, length), s.keep(screen.visible, s.splat(1.0)), s.keep(screen.visible, radius)];
    for (row, (to, seen)) in rows.iter_mut().zip(seen).enumerate() {
        let old = s.load(&to.0);
        s.store(if row == RADIUS { s.max(seen, old) } else { s.add(old, seen) }, &mut to.0);
    }
}
