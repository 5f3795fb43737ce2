//! Training rounds, scoring and selection, which go on whatever the vehicle does (Algorithm 1, lines 9 to 24).

use glam::DVec3;
use shared_types::config::PlannerConfig;
use shared_types::config::planner::{MissionMode, Strategy};
use shared_types::messages::{
    CandidateScore, CandidateView, EndReason, KeyframeReason, RoundReply, RoundRequest, RoundStatus, ScoreReply,
    ScoreRequest, ScoreStatus,
};
use shared_types::ns_from_s;
use shared_types::payload::unpack_text;

use super::Mission;
use crate::io::{Effect, Inputs};
use crate::journal::{Record, Score, Shot};
use crate::ledger::Asked;
use crate::logic::candidates::{Candidate, PitchLimits, radius_m, seed_orbit};
use crate::logic::orbit;
use crate::logic::prior::Prior;
use crate::logic::selection::{Pick, Situation, selector, split_mix};
use crate::logic::view::View;
use crate::state::State;

impl Mission {
    pub(super) fn rounds_turn(&mut self, inputs: &Inputs) {
        if self.ledger.started_ns.is_none() || self.ledger.over.is_some() {
            return;
        }
        for (id, reply) in &inputs.round_replies {
            self.round_answered(*id, reply);
        }
        for (id, reply, scores) in &inputs.score_replies {
            self.score_answered(*id, reply, scores);
        }
        self.ask_for_round();
        self.choose_batch();
        if !self.is_placed() {
            self.progress_ns = self.now_ns;
        }
        let waiting =
            self.ledger.asked.is_some() || (self.ledger.training().is_some() && self.state == State::Deciding);
        let late = self.now_ns > self.progress_ns.saturating_add(ns_from_s(self.setup.planner.service_deadline_s));
        if waiting && late && !self.homeward() {
            tracing::warn!("training or scoring made no progress");
            self.end(EndReason::ServiceFailed);
            self.progress_ns = self.now_ns;
        }
    }

    /// Keyframes of the round that is due, if one is.
    pub(super) fn round_due(&self) -> Option<usize> {
        let taken = self.ledger.taken.len();
        let trained = self.ledger.rounds.last().map_or(0, |round| round.views);
        let flown = self.ledger.batches_flown() > self.ledger.rounds.len();
        // After an early end, what was taken of the last batch is trained on as well.
        let rest = self.ledger.ending.is_some() && taken > trained;
        (taken > 0 && self.ledger.training().is_none() && (flown || rest)).then_some(taken)
    }

    fn ask_for_round(&mut self) {
        if self.trainer_failed {
            return;
        }
        if let Some(views) = self.round_due() {
            let config = &self.setup.planner;
            #[expect(clippy::cast_possible_truncation, reason = "at most a few hundred keyframes")]
            let count = views as u32;
            let max_iterations = if config.strategy == Strategy::Nbv {
                (config.round_iterations_per_view.saturating_mul(count))
                    .clamp(config.round_iterations_min, config.round_iterations_max)
            } else {
                config.orbit_iterations
            };
            #[expect(clippy::cast_possible_truncation, reason = "one a batch")]
            let round = self.ledger.rounds.len() as u32;
            self.record(Record::Round { round, views: count, max_iterations });
            self.progress_ns = self.now_ns;
        }
        // Sent once in each life of the planner; the trainer knows the request by its id.
        let Some(round) = self.ledger.training().copied() else { return };
        if self.round_sent == Some(round.request) {
            return;
        }
        let Some((prior, _)) = self.ledger.prior else { return };
        let config = &self.setup.planner;
        let keyframes = self.ledger.taken.iter().take(round.views).map(|taken| taken.shot.keyframe_id).collect();
        let request = round_request(config, self.setup.seed, &prior, round.round, round.max_iterations);
        self.round_sent = Some(round.request);
        self.progress_ns = self.now_ns;
        self.out.effects.push(Effect::Round(round.request, request, keyframes));
    }

    fn round_answered(&mut self, id: u64, reply: &RoundReply) {
        let Some(round) = self.ledger.training().filter(|round| round.request == id).copied() else { return };
        self.progress_ns = self.now_ns;
        match RoundStatus::from_code(reply.status) {
            Some(RoundStatus::Done) => {
                let finite = |value: f64| if value.is_finite() { value } else { 0.0 };
                self.record(Record::RoundDone {
                    round: round.round,
                    generation: reply.generation,
                    iterations: reply.iterations,
                    total_iterations: reply.total_iterations,
                    psnr_train_db: finite(reply.psnr_train_db),
                });
                self.out.effects.push(Effect::RoundOver(id));
            }
            Some(RoundStatus::Failed) => {
                tracing::warn!(why = unpack_text(&reply.reason), "the trainer cannot go on");
                self.trainer_failed = true;
                self.out.effects.push(Effect::RoundOver(id));
                self.end(EndReason::ServiceFailed);
            }
            Some(RoundStatus::Progress) | None => {}
        }
    }

    /// The round whose final snapshot batch `batch` is chosen on.
    fn needed_round(&self, batch: usize) -> usize {
        match self.setup.planner.mode {
            MissionMode::Serial => batch - 1,
            MissionMode::Concurrent => batch.saturating_sub(2),
        }
    }

    /// Views that may still be chosen for the next batch.
    fn quota(&self) -> usize {
        let planned = self.ledger.taken.len() + self.ledger.left().count();
        (self.setup.planner.keyframes_wanted() as usize).saturating_sub(planned).min(self.setup.planner.batch as usize)
    }

    fn choose_batch(&mut self) {
        let Some((prior, limits)) = self.ledger.prior else { return };
        // In a world that is not found again there are no candidates yet.
        if self.homeward() || !self.is_placed() {
            return;
        }
        self.ensure_terrain();
        if self.terrain.is_none() {
            return;
        }
        if let Some(asked) = self.ledger.asked.clone() {
            if self.score_sent != Some(asked.request) {
                let (request, views) = self.score_request(&asked, &prior);
                self.score_sent = Some(asked.request);
                self.progress_ns = self.now_ns;
                self.out.effects.push(Effect::Score(asked.request, request, views));
            }
            return;
        }
        let config = &self.setup.planner;
        let batch = self.ledger.batches.len();
        let limits = PitchLimits { min_rad: limits[0], max_rad: limits[1] };
        if config.strategy != Strategy::Nbv {
            self.choose_orbit_view(&prior, limits);
            return;
        }
        if batch == 0 {
            let seeds = seed_orbit(&prior, limits, config);
            self.select_views(&seeds, KeyframeReason::Seed, 0);
            return;
        }
        if self.ledger.taken.is_empty() && self.ledger.left().next().is_none() {
            // Every seed view was given up: there is nothing to train on, so nothing to choose by.
            self.end(EndReason::NoCandidates);
            return;
        }
        let serial = config.mode == MissionMode::Serial;
        let done = self.ledger.rounds.get(self.needed_round(batch)).and_then(|round| round.generation);
        let Some(generation) = done.filter(|_| !serial || self.ledger.batches_flown() >= batch) else { return };
        let quota = self.quota();
        if quota == 0 {
            return;
        }
        let free: Vec<u32> = self.free().iter().map(|candidate| candidate.index).collect();
        if free.is_empty() {
            if self.ledger.left().next().is_none() {
                self.end(EndReason::NoCandidates);
            }
            return;
        }
        let taken = self.ledger.taken.iter().map(|taken| taken.position_m.to_array());
        let visited_m: Vec<[f64; 3]> = taken.chain(self.ledger.left().map(|shot| shot.position_m)).collect();
        #[expect(clippy::cast_possible_truncation, reason = "a few hundred batches")]
        let number = batch as u32;
        if selector(config).needs_scores() {
            self.progress_ns = self.now_ns;
            self.record(Record::Score { batch: number, generation, free, visited_m });
        } else {
            self.select(&visited_m, &[], quota, generation, 0.0);
        }
    }

    /// The next view of an orbit, once the one before is flown; serial: and trained. Each is a batch of its own, as a round
    /// begins when a keyframe is queued (Section IV-F: the paper's 12K iterations are 24 rounds of 500). Views that were
    /// given up are not replaced: the circles are flown.
    fn choose_orbit_view(&mut self, prior: &Prior, limits: PitchLimits) {
        let Some(terrain) = &self.terrain else { return };
        let config = &self.setup.planner;
        let trains = self.ledger.training().is_some() || self.round_due().is_some();
        if self.ledger.left().next().is_some() || (config.mode == MissionMode::Serial && trains) {
            return;
        }
        // The circle begins where the vehicle comes from.
        let from = terrain.home_m - prior.center();
        let orbit = orbit::views(prior, limits, from.y.atan2(from.x), config);
        let begun = usize::try_from(self.ledger.next_keyframe()).unwrap_or(usize::MAX);
        match orbit.get(begun).copied() {
            Some(next) if self.quota() > 0 => self.select_views(&[next], KeyframeReason::Selected, 0),
            Some(_) => {}
            None if self.ledger.taken.is_empty() => self.end(EndReason::NoCandidates),
            None => self.end(EndReason::Complete),
        }
    }

    /// Candidates that can be chosen.
    fn free(&self) -> Vec<Candidate> {
        let Some(terrain) = &self.terrain else { return Vec::new() };
        let all = terrain.candidates.list.iter();
        all.filter(|candidate| {
            !self.ledger.used.contains(&candidate.index) && !self.ledger.unreachable.contains(&candidate.index)
        })
        .copied()
        .collect()
    }

    fn select(&mut self, visited_m: &[[f64; 3]], scores: &[CandidateScore], quota: usize, generation: u64, p95: f64) {
        let (Some(terrain), Some((prior, _))) = (&self.terrain, &self.ledger.prior) else { return };
        let center = prior.center();
        let direction = |position: &[f64; 3]| (DVec3::from_array(*position) - center).normalize_or(DVec3::Z);
        let visited: Vec<DVec3> = visited_m.iter().map(direction).collect();
        let free = self.free();
        #[expect(clippy::cast_possible_truncation, reason = "a few hundred batches")]
        let batch = self.ledger.batches.len() as u32;
        let situation = Situation {
            free: &free,
            visited: &visited,
            scores,
            grid_scale_rad: terrain.candidates.grid_scale_rad(),
            seed: self.setup.seed,
            round: batch,
        };
        let picks = selector(&self.setup.planner).select(&situation, quota);
        let first = self.ledger.next_keyframe();
        let shots = picks
            .iter()
            .zip(first..)
            .filter_map(|(pick, keyframe_id): (&Pick, u64)| {
                let candidate = terrain.candidates.get(pick.index)?;
                Some(Shot {
                    keyframe_id,
                    reason: KeyframeReason::Selected,
                    candidate: pick.index,
                    position_m: candidate.view.position_m.to_array(),
                    look_at_m: candidate.view.look_at_m.to_array(),
                    score: finite(pick.score),
                })
            })
            .collect();
        let scores = scores
            .iter()
            .map(|score| Score {
                index: score.index,
                uncertainty: finite(score.uncertainty),
                angle: finite(score.angle_normalised),
                score: finite(score.score),
                alpha: finite(score.mean_alpha),
            })
            .collect();
        self.record(Record::Selected { batch, generation, uncertainty_p95: finite(p95), shots, scores });
    }

    /// A batch of views that no score chose: the seed orbit, or a part of the baseline's.
    fn select_views(&mut self, views: &[View], reason: KeyframeReason, generation: u64) {
        let first = self.ledger.next_keyframe();
        let shot = |(view, keyframe_id): (&View, u64)| Shot {
            keyframe_id,
            reason,
            candidate: u32::MAX,
            position_m: view.position_m.to_array(),
            look_at_m: view.look_at_m.to_array(),
            score: 0.0,
        };
        let shots: Vec<Shot> = views.iter().zip(first..).map(shot).collect();
        #[expect(clippy::cast_possible_truncation, reason = "a few hundred batches")]
        let batch = self.ledger.batches.len() as u32;
        self.record(Record::Selected { batch, generation, uncertainty_p95: 0.0, shots, scores: Vec::new() });
    }

    fn score_request(&self, asked: &Asked, prior: &Prior) -> (ScoreRequest, Vec<CandidateView>) {
        let config = &self.setup.planner;
        let full = self.setup.camera.intrinsics();
        let x = f64::from(config.score_width_px) / f64::from(full.width.max(1));
        let y = f64::from(config.score_height_px) / f64::from(full.height.max(1));
        let candidates = self.terrain.as_ref().map(|terrain| &terrain.candidates);
        let count = candidates.map_or(0, |candidates| candidates.list.len());
        #[expect(clippy::cast_possible_truncation, reason = "a few hundred candidates and rounds")]
        let request = ScoreRequest {
            generation: asked.generation,
            round: asked.batch,
            variance: config.variance.code(),
            clip_angle: u32::from(config.clip_angle),
            width: config.score_width_px,
            height: config.score_height_px,
            grid_candidates: count as u32,
            focal_px: [full.fx * x, full.fy * y],
            principal_px: [full.cx * x, full.cy * y],
            box_center_m: prior.center_m,
            box_size_m: prior.size_m,
            weight_uncertainty: config.weight_uncertainty,
            weight_angle: config.weight_angle,
        };
        let view = |view: View, index: u32, visited: u32| {
            let pose = view.pose();
            CandidateView {
                position_m: pose.position_m.to_array(),
                world_from_camera_xyzw: pose.rotation.to_array(),
                index,
                visited,
            }
        };
        let center = prior.center();
        let to_score = asked
            .free
            .iter()
            .filter_map(|index| candidates.and_then(|all| all.get(*index)).map(|found| view(found.view, *index, 0)));
        let visited = asked
            .visited_m
            .iter()
            .map(|position| view(View { position_m: DVec3::from_array(*position), look_at_m: center }, u32::MAX, 1));
        (request, to_score.chain(visited).collect())
    }

    fn score_answered(&mut self, id: u64, reply: &ScoreReply, scores: &[CandidateScore]) {
        let Some(asked) = self.ledger.asked.clone().filter(|asked| asked.request == id) else { return };
        let status = ScoreStatus::from_code(reply.status);
        if status != Some(ScoreStatus::Waiting) {
            self.progress_ns = self.now_ns;
        }
        match status {
            Some(ScoreStatus::Done) => {
                self.out.effects.push(Effect::ScoreOver(id));
                self.ensure_terrain();
                let config = &self.setup.planner;
                let enough = config.stop_gain * self.ledger.first_p95.unwrap_or(0.0);
                if config.stop_gain > 0.0 && reply.uncertainty_p95 < enough {
                    self.end(EndReason::NothingToGain);
                    return;
                }
                self.select(&asked.visited_m, scores, self.quota(), reply.generation, reply.uncertainty_p95);
            }
            Some(ScoreStatus::GenerationGone) => {
                self.out.effects.push(Effect::ScoreOver(id));
                let Asked { batch, free, visited_m, .. } = asked;
                self.record(Record::Score { batch, generation: reply.newest_generation, free, visited_m });
            }
            Some(ScoreStatus::Refused) => {
                tracing::warn!(why = unpack_text(&reply.reason), "the scorer refused");
                self.out.effects.push(Effect::ScoreOver(id));
                self.end(EndReason::ServiceFailed);
            }
            Some(ScoreStatus::Waiting) | None => {}
        }
    }
}

fn finite(value: f64) -> f64 {
    if value.is_finite() { value } else { 0.0 }
}

/// What the trainer is asked for in a round. Also for a replay of a mission folder, whose journal names the rounds.
#[must_use]
pub fn round_request(
    config: &PlannerConfig,
    seed: u64,
    prior: &Prior,
    round: u32,
    max_iterations: u32,
) -> RoundRequest {
    RoundRequest {
        round,
        max_iterations,
        stop_when_flat: u32::from(config.stop_when_flat),
        window: if config.strategy == Strategy::Nbv { 0 } else { config.orbit_window },
        box_center_m: prior.center_m,
        box_size_m: prior.size_m,
        radius_m: radius_m(prior.size_m, config),
        ground_z_m: prior.ground_z_m(),
        seed: split_mix(seed ^ (u64::from(round) << 40)),
    }
}
