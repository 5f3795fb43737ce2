//! The score of each candidate (Eq. 4): normalised uncertainty and angle to the views taken.

use glam::DVec3;
use shared_types::messages::CandidateScore;

use splatting::uncertainty::Uncertainty;

/// What Eq. 4 needs to know.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScoreSettings {
    /// Weight of the uncertainty (0.6).
    pub weight_uncertainty: f64,
    /// Weight of the angle (0.4).
    pub weight_angle: f64,
    /// Candidates on the grid, N: the grid scale is sqrt(2 pi / N).
    pub grid_candidates: u32,
    /// Whether the angular term is clipped to [0, 1] as the uncertainty is (I10).
    pub clip_angle: bool,
}

/// A candidate to be scored.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Index on the Fibonacci sphere.
    pub index: u32,
    /// Direction from the box centre.
    pub direction: DVec3,
    /// What it sees.
    pub seen: Uncertainty,
}

/// The 95th percentile of some values (A9), linear between ranks; 0 of none.
#[must_use]
pub fn percentile_95(values: impl IntoIterator<Item = f64>) -> f64 {
    let mut sorted: Vec<f64> = values.into_iter().collect();
    sorted.sort_by(f64::total_cmp);
    let Some(last) = sorted.len().checked_sub(1) else { return 0.0 };
    let rank = 0.95 * last as f64;
    let below = (rank.floor() as usize).min(last);
    let above = (below + 1).min(last);
    sorted[below] + (sorted[above] - sorted[below]) * (rank - below as f64)
}

/// a_c: the least angle between a direction and those visited, over the grid scale; without any, the greatest angle.
#[must_use]
pub fn angle_term(direction: DVec3, visited: &[DVec3], settings: &ScoreSettings) -> f64 {
    let scale = (std::f64::consts::TAU / f64::from(settings.grid_candidates.max(1))).sqrt();
    let least = visited.iter().map(|v| direction.angle_between(*v)).fold(std::f64::consts::PI, f64::min);
    let term = least / scale;
    if settings.clip_angle { term.clamp(0.0, 1.0) } else { term }
}

/// Scores candidates against the directions of visited views; in the order of the candidates. Also gives the percentile
/// that normalised the uncertainties.
#[must_use]
pub fn score(candidates: &[Candidate], visited: &[DVec3], settings: &ScoreSettings) -> (Vec<CandidateScore>, f64) {
    let p95 = percentile_95(candidates.iter().map(|c| c.seen.uncertainty));
    let scores = candidates
        .iter()
        .map(|candidate| {
            let seen = &candidate.seen;
            let uncertainty_normalised = if p95 > 0.0 { (seen.uncertainty / p95).clamp(0.0, 1.0) } else { 0.0 };
            let angle_normalised = angle_term(candidate.direction, visited, settings);
            CandidateScore {
                mean_variance_m2: seen.mean_variance_m2,
                area_fraction: seen.area_fraction,
                uncertainty: seen.uncertainty,
                uncertainty_normalised,
                angle_normalised,
                score: settings.weight_uncertainty * uncertainty_normalised + settings.weight_angle * angle_normalised,
                mean_alpha: seen.mean_alpha,
                transparent_fraction: seen.transparent_fraction,
                index: candidate.index,
                reserved: 0,
            }
        })
        .collect();
    (scores, p95)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SETTINGS: ScoreSettings =
        ScoreSettings { weight_uncertainty: 0.6, weight_angle: 0.4, grid_candidates: 95, clip_angle: false };

    fn candidate(index: u32, direction: DVec3, uncertainty: f64) -> Candidate {
        Candidate { index, direction, seen: Uncertainty { uncertainty, ..Uncertainty::default() } }
    }

    #[test]
    fn percentiles_interpolate_between_ranks() {
        assert_eq!(percentile_95([]), 0.0);
        assert_eq!(percentile_95([3.0]), 3.0);
        assert!((percentile_95((0..=100).rev().map(f64::from)) - 95.0).abs() < 1e-12);
        assert!((percentile_95([0.0, 1.0]) - 0.95).abs() < 1e-12);
    }

    #[test]
    fn the_angle_is_in_units_of_the_grid_and_clipped_only_where_asked() {
        // 90 degrees over sqrt(2 pi / 95) = 14.7 degrees.
        let visited = [DVec3::X, -DVec3::X];
        let raw = angle_term(DVec3::Y, &visited, &SETTINGS);
        assert!((raw - 90.0 / 14.735).abs() < 0.01, "{raw}");
        assert_eq!(angle_term(DVec3::Y, &visited, &ScoreSettings { clip_angle: true, ..SETTINGS }), 1.0);
        assert!(angle_term(DVec3::X, &visited, &SETTINGS) < 1e-6);
        assert!((angle_term(DVec3::Y, &[], &SETTINGS) - 180.0 / 14.735).abs() < 0.02);
    }

    #[test]
    fn the_score_is_the_weighted_sum() {
        let candidates = [candidate(4, DVec3::X, 1.0), candidate(9, DVec3::Y, 0.0)];
        let (scores, p95) = score(&candidates, &[DVec3::X], &ScoreSettings { clip_angle: true, ..SETTINGS });
        assert!((p95 - 0.95).abs() < 1e-12);
        assert_eq!((scores[0].index, scores[1].index), (4, 9));
        assert!((scores[0].score - 0.6).abs() < 1e-6 && (scores[1].score - 0.4).abs() < 1e-6);
        let (certain, p95) = score(&[candidate(0, DVec3::X, 0.0)], &[], &SETTINGS);
        assert_eq!((certain[0].uncertainty_normalised, p95), (0.0, 0.0), "P95 = 0: nothing is uncertain");
    }

    proptest! {
        #[test]
        fn scores_do_not_depend_on_the_order_and_stay_in_range(
            values in proptest::collection::vec((0.0f64..5.0, -3.1f64..3.1), 1..40), rotate in 0usize..40
        ) {
            let all: Vec<Candidate> = values.iter().enumerate()
                .map(|(i, &(u, angle))| candidate(i as u32, DVec3::new(angle.cos(), angle.sin(), 0.1), u)).collect();
            let mut turned = all.clone();
            turned.rotate_left(rotate % all.len());
            turned.reverse();
            let visited = [DVec3::Z, DVec3::X];
            let (a, p95_a) = score(&all, &visited, &SETTINGS);
            let (b, p95_b) = score(&turned, &visited, &SETTINGS);
            prop_assert_eq!(p95_a, p95_b);
            for found in &a {
                prop_assert!((0.0..=1.0).contains(&found.uncertainty_normalised));
                prop_assert_eq!(Some(found), b.iter().find(|s| s.index == found.index));
            }
        }
    }
}
