//! When a round ends, which views it sees, and how fast its means move.

use std::collections::VecDeque;

use glam::DVec3;

/// Length of a round with `views` views (paper Eq. 6): the length in the `paper` preset, the cap in the default.
#[must_use]
pub fn paper_iterations(views: u32) -> u32 {
    views.saturating_mul(50).clamp(750, 2500)
}

/// The losses of the last two windows of iterations, and the rule that tells when they have flattened: the mean of the
/// last window is less than a given share below that of the window before.
///
/// The rule looks at losses and counts alone, so a round's length is never a race.
#[derive(Debug, Clone, PartialEq)]
pub struct LossHistory {
    window: usize,
    losses: VecDeque<f64>,
}

impl LossHistory {
    /// An empty history with a window of `window` iterations.
    #[must_use]
    pub fn new(window: u32) -> Self {
        Self { window: window.max(1) as usize, losses: VecDeque::new() }
    }

    /// A history with these losses, oldest first.
    #[must_use]
    pub fn resume(window: u32, losses: &[f64]) -> Self {
        let mut history = Self::new(window);
        losses.iter().for_each(|&loss| history.push(loss));
        history
    }

    /// Iterations of a window.
    #[must_use]
    pub fn window(&self) -> u32 {
        self.window as u32
    }

    /// Adds the loss of an iteration.
    pub fn push(&mut self, loss: f64) {
        if self.losses.len() == 2 * self.window {
            self.losses.pop_front();
        }
        self.losses.push_back(loss);
    }

    /// The losses held, oldest first.
    pub fn losses(&self) -> impl ExactSizeIterator<Item = f64> + '_ {
        self.losses.iter().copied()
    }

    /// Mean loss of the last window (of what there is of it); 0 before the first.
    #[must_use]
    pub fn mean_of_last(&self) -> f64 {
        let n = self.losses.len().min(self.window);
        if n == 0 { 0.0 } else { self.losses.iter().rev().take(n).sum::<f64>() / n as f64 }
    }

    /// Whether the loss has flattened: two full windows, and less gained between them than the share `least_gain`.
    #[must_use]
    pub fn is_flat(&self, least_gain: f64) -> bool {
        if self.losses.len() < 2 * self.window {
            return false;
        }
        let before = self.losses.iter().take(self.window).sum::<f64>() / self.window as f64;
        self.mean_of_last() > (1.0 - least_gain) * before
    }
}

/// Indices of the views that a round trains on: all, or the `window` ones nearest to the newest (the last), itself
/// included; in ascending order. Ties go to the older view.
#[must_use]
pub fn window_views(positions_m: &[DVec3], window: u32) -> Vec<usize> {
    let Some(&newest) = positions_m.last() else { return Vec::new() };
    let mut indices: Vec<usize> = (0..positions_m.len()).collect();
    if window > 0 && (window as usize) < indices.len() {
        let distance = |i: usize| positions_m[i].distance_squared(newest);
        indices.sort_by(|&a, &b| distance(a).total_cmp(&distance(b)).then(a.cmp(&b)));
        indices.truncate(window as usize);
        indices.sort_unstable();
    }
    indices
}

/// Learning rate of the means after `iteration` iterations of the mission: exponential from `start` to `end` over
/// `decay_iterations`, then constant, all times R / 2.5 m.
#[must_use]
pub fn means_learning_rate(iteration: u64, start: f64, end: f64, decay_iterations: u32, radius_m: f64) -> f64 {
    let t = (iteration as f64 / f64::from(decay_iterations.max(1))).min(1.0);
    let rate = if start > 0.0 && end > 0.0 { start * (end / start).powf(t) } else { start + (end - start) * t };
    rate * radius_m / 2.5
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_paper_s_rounds_add_up() {
        assert_eq!((paper_iterations(4), paper_iterations(15), paper_iterations(48)), (750, 750, 2400));
        assert_eq!(paper_iterations(60), 2500);
        // I25: 750 for the seed, then eleven rounds of 8, 12, .. 48 views.
        let total: u32 = paper_iterations(4) + (2..=12).map(|k| paper_iterations(4 * k)).sum::<u32>();
        assert_eq!(total, 16_650);
    }

    #[test]
    fn a_loss_is_flat_only_after_two_windows_and_less_than_the_least_gain() {
        let mut history = LossHistory::new(100);
        for _ in 0..199 {
            history.push(1.0);
            assert!(!history.is_flat(0.01));
        }
        history.push(1.0);
        assert!(history.is_flat(0.01));
        for _ in 0..100 {
            history.push(0.98);
        }
        assert!(!history.is_flat(0.01), "2 % gained");
        for _ in 0..100 {
            history.push(0.975);
        }
        assert!(history.is_flat(0.01), "0.5 % gained");
        assert!((history.mean_of_last() - 0.975).abs() < 1e-12);
        let losses: Vec<f64> = history.losses().collect();
        assert_eq!(LossHistory::resume(100, &losses), history);
    }

    #[test]
    fn a_loss_that_is_no_number_never_flattens_a_round() {
        assert!(!LossHistory::resume(10, &[f64::NAN; 20]).is_flat(0.01));
    }

    #[test]
    fn the_window_holds_the_nearest_to_the_newest() {
        let ring: Vec<DVec3> =
            (0..12).map(|k| DVec3::new((k as f64 * 0.5).cos(), (k as f64 * 0.5).sin(), 0.0)).collect();
        assert_eq!(window_views(&ring, 0).len(), 12);
        assert_eq!(window_views(&ring, 20).len(), 12);
        // The ring is nearly closed: view 0 is 0.78 rad from view 11, view 9 one rad.
        assert_eq!(window_views(&ring, 4), [0, 9, 10, 11]);
        assert!(window_views(&[], 3).is_empty());
    }

    #[test]
    fn the_means_slow_down_to_a_tenth_and_scale_with_the_radius() {
        let rate = |n| means_learning_rate(n, 1e-4, 1e-5, 1000, 5.0);
        assert!((rate(0) - 2e-4).abs() < 1e-12 && (rate(1000) - 2e-5).abs() < 1e-12 && rate(9999) == rate(1000));
        assert!((rate(500) - 2e-4 * 0.1f64.sqrt()).abs() < 1e-12);
        assert_eq!(means_learning_rate(5, 0.0, 0.0, 10, 2.5), 0.0);
    }
}
