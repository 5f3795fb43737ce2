//! What the journal says: the state of the mission that outlives the planner. It changes only by records.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use shared_types::messages::{EndReason, KeyframeReason};

use crate::journal::{Entry, Record, Score, Shot};
use crate::logic::prior::Prior;

/// A keyframe on disk.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Taken {
    /// The view that was wanted.
    pub shot: Shot,
    /// Measured position of the camera, metres.
    pub position_m: DVec3,
}

/// A training round.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Round {
    /// Number of the request.
    pub request: u64,
    /// Number of the round.
    pub round: u32,
    /// Keyframes it trains on: the first so many.
    pub views: usize,
    /// Most iterations.
    pub max_iterations: u32,
    /// Generation of its final snapshot, once over.
    pub generation: Option<u64>,
}

/// Scores that are asked for.
#[derive(Debug, Clone, PartialEq)]
pub struct Asked {
    /// Number of the request.
    pub request: u64,
    /// The batch they are for.
    pub batch: u32,
    /// Snapshot.
    pub generation: u64,
    /// Candidates.
    pub free: Vec<u32>,
    /// Positions of the views taken and planned.
    pub visited_m: Vec<[f64; 3]>,
}

/// The world, moved.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shift {
    /// Mission time of the decision.
    pub at_ns: u64,
    /// What positions in the world change by, metres.
    pub shift_m: [f64; 3],
    /// The vehicle's reset counter before it.
    pub reset_count: u32,
}

/// A chosen batch.
#[derive(Debug, Clone, PartialEq)]
pub struct Batch {
    /// Views not taken yet, in the order of the choice.
    pub left: Vec<Shot>,
}

/// The state that the records add up to.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Ledger {
    /// Entries so far: the number of the last line.
    pub entries: u64,
    /// Mission time of the last line.
    pub last_ns: u64,
    /// When the mission began.
    pub started_ns: Option<u64>,
    /// When it was first in the air, and home.
    pub airborne: Option<(u64, [f64; 3])>,
    /// The survey point, where a scan moved it.
    pub survey_m: Option<[f64; 3]>,
    /// How often a scan was begun.
    pub scans: u32,
    /// Whether a scan is going on.
    pub scanning: bool,
    /// The prior views taken since the last survey, by reason code: id, and mission time of the record.
    pub prior_views: BTreeMap<u32, (u64, u64)>,
    /// When the world was last known to lie where the prior says.
    pub placed_ns: Option<u64>,
    /// When the object was last found not to be as it was.
    pub misaligned_ns: Option<u64>,
    /// How the world was moved since it was last in place, in order.
    pub shifts: Vec<Shift>,
    /// The prior, and the gimbal's limits that go with it.
    pub prior: Option<(Prior, [f64; 2])>,
    /// Keyframes, in the order of capture.
    pub taken: Vec<Taken>,
    /// Batches chosen, in order.
    pub batches: Vec<Batch>,
    /// Candidates that were ever chosen or given up.
    pub used: BTreeSet<u32>,
    /// Candidates given up.
    pub unreachable: BTreeSet<u32>,
    /// Failed tries of each keyframe.
    pub failures: BTreeMap<u64, u32>,
    /// Training rounds asked for.
    pub rounds: Vec<Round>,
    /// Scores being waited for.
    pub asked: Option<Asked>,
    /// Last scores.
    pub scores: Vec<Score>,
    /// 95th percentile of the first scored batch.
    pub first_p95: Option<f64>,
    /// Iterations run.
    pub iterations: u32,
    /// PSNR of training views at the end of the last round, dB.
    pub psnr_train_db: f64,
    /// Captures ever asked for, the last of each keyframe.
    pub captures: BTreeMap<u64, Shot>,
    /// Waiting for the operator.
    pub suspended: bool,
    /// Why no more views are taken, and whether to land at once.
    pub ending: Option<(EndReason, bool)>,
    /// How it ended, and whether there is a model.
    pub over: Option<(EndReason, bool)>,
    /// Whether the vehicle is back on the ground for good.
    pub landed: bool,
    next_keyframe: u64,
}

impl Ledger {
    /// The state after a journal.
    #[must_use]
    pub fn replay(entries: &[Entry]) -> Self {
        Self::replay_for(entries, 0)
    }

    /// The same for a flight that began at `epoch_ns`: what earlier ones measured before there was a prior is nowhere now.
    #[must_use]
    pub fn replay_for(entries: &[Entry], epoch_ns: u64) -> Self {
        let (before, here) = entries.split_at(entries.partition_point(|entry| entry.now_ns < epoch_ns));
        let mut ledger = Self::default();
        before.iter().for_each(|entry| ledger.apply(entry));
        if !before.is_empty() && ledger.prior.is_none() {
            ledger.airborne = None;
            ledger.survey_m = None;
            ledger.scans = 0;
            ledger.scanning = false;
            ledger.prior_views.clear();
        }
        here.iter().for_each(|entry| ledger.apply(entry));
        ledger
    }

    /// Takes one record in.
    pub fn apply(&mut self, entry: &Entry) {
        self.entries = entry.id;
        self.last_ns = entry.now_ns;
        match &entry.record {
            Record::Started { .. } => self.started_ns = self.started_ns.or(Some(entry.now_ns)),
            Record::Command { .. } | Record::Target { .. } => {}
            Record::Airborne { home_m } => self.airborne = self.airborne.or(Some((entry.now_ns, *home_m))),
            Record::Capture { shot, .. } => {
                self.captures.insert(shot.keyframe_id, *shot);
            }
            Record::Captured { keyframe_id, position_m, .. } => {
                self.captured(*keyframe_id, *position_m, entry.now_ns);
            }
            Record::CaptureFailed { keyframe_id, .. } => *self.failures.entry(*keyframe_id).or_insert(0) += 1,
            Record::Dropped { keyframe_id, candidate, .. } => {
                for batch in &mut self.batches {
                    batch.left.retain(|shot| shot.keyframe_id != *keyframe_id);
                }
                if *candidate != u32::MAX {
                    self.unreachable.insert(*candidate);
                }
            }
            Record::Scan => {
                self.scans += 1;
                self.scanning = true;
            }
            Record::Survey { point_m } => {
                self.survey_m = Some(*point_m);
                self.scanning = false;
                self.prior_views.clear();
            }
            Record::Prior { prior, pitch_limits_rad, .. } => {
                self.prior = Some((*prior, *pitch_limits_rad));
                self.placed_ns = Some(entry.now_ns);
            }
            Record::Shift { shift_m, reset_count } => {
                self.shifts.push(Shift { at_ns: entry.now_ns, shift_m: *shift_m, reset_count: *reset_count });
                self.forget_checks();
            }
            Record::Aligned { .. } => {
                self.placed_ns = Some(entry.now_ns);
                self.shifts.clear();
            }
            Record::Misaligned { .. } => {
                self.misaligned_ns = Some(entry.now_ns);
                self.forget_checks();
            }
            Record::Round { round, views, max_iterations } => self.rounds.push(Round {
                request: entry.id,
                round: *round,
                views: *views as usize,
                max_iterations: *max_iterations,
                generation: None,
            }),
            Record::RoundDone { round, generation, total_iterations, psnr_train_db, .. } => {
                if let Some(over) = self.rounds.iter_mut().find(|known| known.round == *round) {
                    over.generation = Some(*generation);
                }
                self.iterations = *total_iterations;
                self.psnr_train_db = *psnr_train_db;
            }
            Record::Score { batch, generation, free, visited_m } => {
                self.asked = Some(Asked {
                    request: entry.id,
                    batch: *batch,
                    generation: *generation,
                    free: free.clone(),
                    visited_m: visited_m.clone(),
                });
            }
            Record::Selected { uncertainty_p95, shots, scores, .. } => {
                self.asked = None;
                if !scores.is_empty() {
                    self.first_p95 = self.first_p95.or(Some(*uncertainty_p95));
                    self.scores.clone_from(scores);
                }
                self.used.extend(shots.iter().map(|shot| shot.candidate).filter(|index| *index != u32::MAX));
                self.next_keyframe += shots.len() as u64;
                self.batches.push(Batch { left: shots.clone() });
            }
            Record::Landed => self.landed = true,
            Record::Suspended => self.suspended = true,
            Record::GoOn => self.suspended = false,
            Record::Ending { reason, land_here } => {
                let reason = self.ending.map_or(*reason, |(first, _)| first);
                self.ending = Some((reason, *land_here));
                self.suspended = false;
                self.asked = None;
            }
            Record::Over { reason, usable } => self.over = Some((*reason, *usable)),
        }
    }

    fn forget_checks(&mut self) {
        self.prior_views.remove(&KeyframeReason::CheckOverhead.code());
        self.prior_views.remove(&KeyframeReason::CheckSide.code());
    }

    fn captured(&mut self, keyframe_id: u64, position_m: [f64; 3], now_ns: u64) {
        let Some(shot) = self.captures.get(&keyframe_id).copied() else { return };
        match shot.reason {
            reason if reason.is_survey() => {
                self.prior_views.insert(reason.code(), (keyframe_id, now_ns));
            }
            _ if self.taken.iter().any(|taken| taken.shot.keyframe_id == keyframe_id) => {}
            _ => {
                for batch in &mut self.batches {
                    batch.left.retain(|left| left.keyframe_id != keyframe_id);
                }
                self.taken.push(Taken { shot, position_m: DVec3::from_array(position_m) });
            }
        }
    }

    /// Id of the next keyframe to be chosen.
    #[must_use]
    pub fn next_keyframe(&self) -> u64 {
        self.next_keyframe
    }

    /// Views chosen and not taken.
    pub fn left(&self) -> impl Iterator<Item = &Shot> {
        self.batches.iter().flat_map(|batch| &batch.left)
    }

    /// The batch being flown: the first with views left.
    #[must_use]
    pub fn current(&self) -> Option<(usize, &Batch)> {
        self.batches.iter().enumerate().find(|(_, batch)| !batch.left.is_empty())
    }

    /// Batches all of whose views are taken or given up, counted from the first.
    #[must_use]
    pub fn batches_flown(&self) -> usize {
        self.batches.iter().take_while(|batch| batch.left.is_empty()).count()
    }

    /// The round that is training.
    #[must_use]
    pub fn training(&self) -> Option<&Round> {
        self.rounds.iter().find(|round| round.generation.is_none())
    }
}
