//! `mission/state`: what others see of the mission.

use shared_types::messages::{CandidateState, CandidateStatus, EndReason, MissionPhase, MissionState};
use shared_types::payload::pack_text;
use shared_types::{NS_PER_S, s_from_ns};

use super::Mission;
use crate::io::{Effect, Views};
use crate::logic::candidates::radius_m;
use crate::state::State;

impl Mission {
    /// Publishes the state where it changed, and once a second while numbers that always change do.
    pub(super) fn report(&mut self, views: &mut dyn Views) {
        self.count_coverage(views);
        let state = self.mission_state();
        let due = match &self.published {
            None => true,
            Some((before, at_ns)) => {
                let steady = MissionState {
                    sequence: before.sequence,
                    remaining_s: before.remaining_s,
                    path_m: before.path_m,
                    ..state
                };
                steady != *before || (self.now_ns >= at_ns + NS_PER_S && self.state != State::Over)
            }
        };
        if due {
            self.sequence += 1;
            let state = MissionState { sequence: self.sequence, ..state };
            self.published = Some((state, self.now_ns));
            let candidates = self.candidate_states();
            self.out.effects.push(Effect::State(Box::new(state), candidates));
        }
    }

    /// What the mission waits for while nothing is flown.
    fn waiting(&self) -> MissionPhase {
        if self.ledger.asked.is_some() {
            MissionPhase::Scoring
        } else if self.ledger.training().is_some() {
            MissionPhase::Training
        } else if self.ledger.prior.is_none() {
            MissionPhase::Prior
        } else {
            MissionPhase::Transit
        }
    }

    /// The phase that others see.
    #[must_use]
    pub fn phase(&self) -> MissionPhase {
        if self.stepping_down && self.is_over() && self.ledger.over.is_none() {
            // The mission goes on with the next process.
            return MissionPhase::Landing;
        }
        self.state.phase(self.waiting(), self.ledger.over.is_some_and(|(_, usable)| usable))
    }

    fn mission_state(&self) -> MissionState {
        let ledger = &self.ledger;
        let config = &self.setup.planner;
        let unrecorded = match (self.cancelled, self.misaligned) {
            (true, _) => EndReason::Operator,
            (false, true) => EndReason::Misaligned,
            (false, false) => EndReason::None,
        };
        let reason = ledger.over.or(ledger.ending).map_or(unrecorded, |(reason, _)| reason);
        let prior = ledger.prior.map(|(prior, _)| prior);
        let count = |length: usize| u32::try_from(length).unwrap_or(u32::MAX);
        MissionState {
            sequence: self.sequence,
            started_ns: ledger.started_ns.unwrap_or(0),
            mission_id: pack_text(&self.setup.mission_id),
            folder: pack_text(&self.setup.folder),
            phase: self.phase().code(),
            end_reason: reason.code(),
            round: count(ledger.rounds.len()),
            keyframes: count(ledger.taken.len()),
            keyframes_wanted: config.keyframes_wanted(),
            exposure_locked: u32::from(!ledger.taken.is_empty()),
            prior_known: u32::from(prior.is_some()),
            iterations: ledger.iterations,
            box_center_m: prior.map_or([0.0; 3], |prior| prior.center_m),
            box_size_m: prior.map_or(0.0, |prior| prior.size_m),
            radius_m: prior.map_or(0.0, |prior| radius_m(prior.size_m, config)),
            ground_z_m: prior.map_or(0.0, |prior| prior.ground_z_m()),
            paper_coverage: self.coverage.fraction(),
            psnr_train_db: ledger.psnr_train_db,
            remaining_s: self.remaining_s(),
            path_m: self.path_m,
        }
    }

    fn remaining_s(&self) -> f64 {
        const SURVEY_S: f64 = 30.0;
        const VIEW_S: f64 = 4.0;
        const HOME_S: f64 = 20.0;
        if self.ledger.over.is_some() || self.ledger.started_ns.is_none() {
            return 0.0;
        }
        if self.homeward() {
            return HOME_S;
        }
        let wanted = self.setup.planner.keyframes_wanted() as usize;
        #[expect(clippy::cast_precision_loss, reason = "a few hundred keyframes")]
        let (taken, left) = (self.ledger.taken.len() as f64, wanted.saturating_sub(self.ledger.taken.len()) as f64);
        let Some((airborne_ns, _)) = self.ledger.airborne else { return SURVEY_S + left * VIEW_S + HOME_S + 10.0 };
        let flown_s = s_from_ns(self.now_ns.saturating_sub(airborne_ns));
        // What a view took so far, the survey apart; a few expected ones steady the first figures.
        let each = ((flown_s - SURVEY_S).max(0.0) + 6.0 * VIEW_S) / (taken + 6.0);
        let survey = if self.ledger.prior.is_some() { 0.0 } else { SURVEY_S };
        survey + left * each + HOME_S
    }

    fn candidate_states(&self) -> Vec<CandidateState> {
        let Some(terrain) = &self.terrain else { return Vec::new() };
        let ledger = &self.ledger;
        let score =
            |index: u32| ledger.scores.iter().find(|score| score.index == index).map_or(0.0, |score| score.score);
        let status = |index: u32| {
            if ledger.unreachable.contains(&index) {
                CandidateStatus::Unreachable
            } else if ledger.taken.iter().any(|taken| taken.shot.candidate == index) {
                CandidateStatus::Visited
            } else if ledger.left().any(|shot| shot.candidate == index) {
                CandidateStatus::Selected
            } else {
                CandidateStatus::Free
            }
        };
        let list = &terrain.candidates.list;
        list.iter()
            .map(|candidate| CandidateState {
                position_m: candidate.view.position_m.to_array(),
                score: score(candidate.index),
                status: status(candidate.index).code(),
                index: candidate.index,
            })
            .collect()
    }
}
