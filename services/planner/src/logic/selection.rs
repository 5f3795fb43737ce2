//! What chooses the views of a round: Eq. 4 and 5, and selectors without feedback behind the same interface.

use core::f64::consts::FRAC_PI_2;

use glam::DVec3;
use shared_types::config::planner::{PlannerConfig, SelectorName};
use shared_types::messages::CandidateScore;

use super::candidates::Candidate;

/// What a selector may look at.
#[derive(Debug)]
pub struct Situation<'a> {
    /// Candidates that can be chosen (not visited, reachable), in the order of their indices.
    pub free: &'a [Candidate],
    /// Directions from the centre of the box of every keyframe, and of the views that will be keyframes by then.
    pub visited: &'a [DVec3],
    /// Scores of at least the free candidates, in any order; empty where the selector needs none.
    pub scores: &'a [CandidateScore],
    /// The grid scale of Eq. 4, radians.
    pub grid_scale_rad: f64,
    /// Seed of the mission.
    pub seed: u64,
    /// Number of the round.
    pub round: u32,
}

/// A candidate that was chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pick {
    /// Index on the Fibonacci sphere.
    pub index: u32,
    /// Its score before the penalty of Eq. 5.
    pub score: f64,
}

/// Chooses the views of a round.
pub trait Selector {
    /// Whether scores of the model are needed.
    fn needs_scores(&self) -> bool;

    /// At most `count` views, in the order of the choice.
    fn select(&self, situation: &Situation<'_>, count: usize) -> Vec<Pick>;
}

/// The selector of a configuration.
#[must_use]
pub fn selector(config: &PlannerConfig) -> Box<dyn Selector> {
    match config.selector {
        SelectorName::DepthVariance => Box::new(Scored { term: |score| score.score }),
        SelectorName::UncertaintyOnly => Box::new(Scored { term: |score| score.uncertainty_normalised }),
        SelectorName::AngleOnly => Box::new(AngleOnly { clip: config.clip_angle }),
        SelectorName::FibonacciOrder => Box::new(FibonacciOrder { sphere_points: config.sphere_points }),
        SelectorName::Random => Box::new(Random),
    }
}

/// The greedy diverse batch of Eq. 5: the first pick has the greatest score; every other score is multiplied by its angle
/// to the nearest pick over 90 degrees, at most 1. Ties go to the lowest index. Candidates of one direction with a pick
/// score zero, and are chosen only when nothing else is left.
#[must_use]
pub fn greedy_diverse(free: &[Candidate], scores: &[f64], count: usize) -> Vec<Pick> {
    let mut nearest = vec![f64::INFINITY; free.len()];
    let mut taken = vec![false; free.len()];
    let mut picks: Vec<Pick> = Vec::new();
    while picks.len() < count.min(free.len()) {
        let mut best: Option<(usize, f64)> = None;
        for (at, &score) in scores.iter().enumerate().take(free.len()) {
            let diversity = (nearest[at] / FRAC_PI_2).clamp(0.0, 1.0);
            let effective = if score.is_finite() { score * diversity } else { 0.0 };
            if !taken[at] && best.is_none_or(|(_, most)| effective > most) {
                best = Some((at, effective));
            }
        }
        let Some((chosen, _)) = best else { break };
        taken[chosen] = true;
        picks.push(Pick { index: free[chosen].index, score: scores[chosen] });
        for (at, candidate) in free.iter().enumerate() {
            nearest[at] = nearest[at].min(candidate.direction.angle_between(free[chosen].direction));
        }
    }
    picks
}

/// Scores of the model (the scorer computes the terms in the mode that the configuration names), then Eq. 5.
struct Scored {
    term: fn(&CandidateScore) -> f64,
}

impl Selector for Scored {
    fn needs_scores(&self) -> bool {
        true
    }

    fn select(&self, situation: &Situation<'_>, count: usize) -> Vec<Pick> {
        let by_index: std::collections::BTreeMap<u32, f64> =
            situation.scores.iter().map(|score| (score.index, (self.term)(score))).collect();
        let scores: Vec<f64> =
            situation.free.iter().map(|candidate| by_index.get(&candidate.index).copied().unwrap_or(0.0)).collect();
        greedy_diverse(situation.free, &scores, count)
    }
}

/// The angular term of Eq. 4: the least angle to a visited direction over the grid scale.
#[must_use]
pub fn angle_term(direction: DVec3, visited: &[DVec3], grid_scale_rad: f64, clip: bool) -> f64 {
    let least = visited.iter().map(|seen| direction.angle_between(*seen)).fold(core::f64::consts::PI, f64::min);
    let term = least / grid_scale_rad.max(1e-9);
    if clip { term.clamp(0.0, 1.0) } else { term }
}

struct AngleOnly {
    clip: bool,
}

impl Selector for AngleOnly {
    fn needs_scores(&self) -> bool {
        false
    }

    fn select(&self, situation: &Situation<'_>, count: usize) -> Vec<Pick> {
        let score = |candidate: &Candidate| {
            angle_term(candidate.direction, situation.visited, situation.grid_scale_rad, self.clip)
        };
        let scores: Vec<f64> = situation.free.iter().map(score).collect();
        greedy_diverse(situation.free, &scores, count)
    }
}

/// The points of the sphere in an order whose every beginning is spread over it: by the golden ratio's multiples of the
/// index. (In the order of the index itself the first rounds would all look from the top.)
struct FibonacciOrder {
    sphere_points: u32,
}

impl Selector for FibonacciOrder {
    fn needs_scores(&self) -> bool {
        false
    }

    fn select(&self, situation: &Situation<'_>, count: usize) -> Vec<Pick> {
        let ratio = (5.0_f64.sqrt() - 1.0) / 2.0;
        let mut order: Vec<(f64, u32)> = situation
            .free
            .iter()
            .map(|candidate| {
                // Which multiple of the golden ratio falls nearest to this index, among the first 4096.
                let target = (f64::from(candidate.index) + 0.5) / f64::from(self.sphere_points.max(1));
                let width = 0.5 / f64::from(self.sphere_points.max(1));
                let hit = |step: &u32| {
                    let at = (f64::from(*step) * ratio + ratio / 2.0).fract();
                    (at - target).abs() <= width
                };
                (f64::from((0..4096).find(hit).unwrap_or(4096)), candidate.index)
            })
            .collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        order.into_iter().take(count).map(|(_, index)| Pick { index, score: 0.0 }).collect()
    }
}

struct Random;

impl Selector for Random {
    fn needs_scores(&self) -> bool {
        false
    }

    fn select(&self, situation: &Situation<'_>, count: usize) -> Vec<Pick> {
        // Keys drawn for each candidate, whatever the others are: a dropped candidate changes no other choice.
        let mut order: Vec<(u64, u32)> = situation
            .free
            .iter()
            .map(|candidate| (split_mix(situation.seed ^ (u64::from(candidate.index) << 32)), candidate.index))
            .collect();
        order.sort_unstable();
        order.into_iter().take(count).map(|(_, index)| Pick { index, score: 0.0 }).collect()
    }
}

/// SplitMix64: a well-mixed number of a number.
#[must_use]
pub fn split_mix(seed: u64) -> u64 {
    let mut z = seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::logic::candidates::fibonacci_direction;
    use crate::logic::view::View;
    use shared_types::config::planner::SelectorName;

    fn upper() -> Vec<Candidate> {
        (0..100)
            .map(|index| {
                let direction = fibonacci_direction(index, 200);
                Candidate { index, direction, view: View { position_m: direction * 2.5, look_at_m: DVec3::ZERO } }
            })
            .collect()
    }

    fn score(index: u32, score: f64) -> CandidateScore {
        CandidateScore { index, score, ..CandidateScore::default() }
    }

    fn run(name: SelectorName, scores: &[CandidateScore], visited: &[DVec3], seed: u64, count: usize) -> Vec<u32> {
        let config = PlannerConfig { selector: name, ..PlannerConfig::default() };
        let free = upper();
        let situation = Situation { free: &free, visited, scores, grid_scale_rad: 0.25, seed, round: 1 };
        selector(&config).select(&situation, count).iter().map(|pick| pick.index).collect()
    }

    #[test]
    fn the_first_pick_has_the_best_score_and_ties_go_to_the_lowest_index() {
        let scores: Vec<CandidateScore> =
            (0..100).map(|i| score(i, if i == 40 || i == 70 { 2.0 } else { 1.0 })).collect();
        let picks = run(SelectorName::DepthVariance, &scores, &[], 0, 4);
        assert_eq!(picks[0], 40);
        let all_equal: Vec<CandidateScore> = (0..100).map(|i| score(i, 1.0)).collect();
        assert_eq!(run(SelectorName::DepthVariance, &all_equal, &[], 0, 1), [0]);
    }

    #[test]
    fn a_neighbour_of_a_pick_loses_to_a_worse_view_far_away() {
        let free = upper();
        let mut scores = vec![0.1; 100];
        scores[10] = 1.0;
        let neighbour = (0..100)
            .filter(|&i| i != 10)
            .min_by(|&a, &b| {
                let angle = |i: usize| free[i].direction.angle_between(free[10].direction);
                angle(a).total_cmp(&angle(b))
            })
            .unwrap();
        scores[neighbour] = 0.4;
        let picks = greedy_diverse(&free, &scores, 2);
        assert_eq!(picks[0].index, 10);
        assert_ne!(picks[1].index as usize, neighbour, "0.4 x 15/90 is less than 0.1");
    }

    #[test]
    fn four_picks_agree_with_equation_5_by_hand() {
        let free = upper();
        let scores: Vec<f64> = (0..100).map(|i| 0.5 + 0.5 * f64::sin(i as f64)).collect();
        let picks = greedy_diverse(&free, &scores, 4);
        let mut chosen: Vec<usize> = Vec::new();
        for _ in 0..4 {
            let effective = |i: usize| {
                let factor = chosen
                    .iter()
                    .map(|&j| free[i].direction.dot(free[j].direction).clamp(-1.0, 1.0).acos() / FRAC_PI_2)
                    .fold(1.0, f64::min);
                scores[i] * factor
            };
            let next = (0..100).filter(|i| !chosen.contains(i)).max_by(|&a, &b| effective(a).total_cmp(&effective(b)));
            chosen.push(next.unwrap());
        }
        assert_eq!(picks.iter().map(|pick| pick.index as usize).collect::<Vec<_>>(), chosen);
    }

    #[test]
    fn angle_only_goes_where_nobody_was() {
        let visited = [DVec3::X, DVec3::Y, DVec3::NEG_Y, DVec3::Z];
        let config = PlannerConfig { selector: SelectorName::AngleOnly, clip_angle: false, ..PlannerConfig::default() };
        let free = upper();
        let situation =
            Situation { free: &free, visited: &visited, scores: &[], grid_scale_rad: 0.25, seed: 0, round: 1 };
        let first = selector(&config).select(&situation, 1)[0].index;
        assert!(free[first as usize].direction.x < -0.6, "opposite of what was seen");
    }

    #[test]
    fn every_beginning_of_the_fibonacci_order_is_spread() {
        let free = upper();
        let picks = run(SelectorName::FibonacciOrder, &[], &[], 0, 100);
        let mut sorted = picks.clone();
        sorted.sort_unstable();
        assert_eq!(sorted, (0..100).collect::<Vec<_>>(), "a permutation");
        let first: Vec<DVec3> = picks[..8].iter().map(|&i| free[i as usize].direction).collect();
        for (i, a) in first.iter().enumerate() {
            for b in &first[..i] {
                assert!(a.angle_between(*b) > 0.3, "{i}");
            }
        }
        let heights: Vec<f64> = first.iter().map(|direction| direction.z).collect();
        assert!(heights.iter().any(|&z| z > 0.7) && heights.iter().any(|&z| z < 0.3), "{heights:?}");
    }

    #[test]
    fn random_depends_on_the_seed_alone() {
        let a = run(SelectorName::Random, &[], &[], 7, 10);
        assert_eq!(a, run(SelectorName::Random, &[], &[DVec3::X], 7, 10));
        assert_ne!(a, run(SelectorName::Random, &[], &[], 8, 10));
    }

    proptest::proptest! {
        #[test]
        fn picks_are_distinct_and_free(values in proptest::collection::vec(0.0..1.0f64, 100), count in 1usize..8) {
            let picks = greedy_diverse(&upper(), &values, count);
            let mut indices: Vec<u32> = picks.iter().map(|pick| pick.index).collect();
            indices.sort_unstable();
            indices.dedup();
            proptest::prop_assert_eq!(indices.len(), count);
        }
    }
}
