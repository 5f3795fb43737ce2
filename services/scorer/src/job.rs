//! One scoring: a model, a request, and the terms of every candidate.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use glam::{DQuat, DVec3, Quat, Vec3};
use shared_types::messages::{CandidateScore, CandidateView, GaussianRow, ScoreRequest, VarianceMode};
use splatting::uncertainty::{self, BoundingBox, Uncertainty, UncertaintySettings};
use splatting::{Backend, BackendError, Camera, Gaussian, Gaussians, Pose, RenderSettings};

use crate::logic::score::{Candidate, ScoreSettings, score};

/// Largest side of a scoring image, pixels.
const MAX_SIDE_PX: u32 = 4096;

/// A request that makes sense.
#[derive(Debug, Clone)]
pub struct Job {
    settings: ScoreSettings,
    uncertainty: UncertaintySettings,
    /// Camera, index on the grid and direction from the box centre of each view to be scored.
    candidates: Vec<(Camera, u32, DVec3)>,
    /// Directions of the views already taken.
    visited: Vec<DVec3>,
}

/// The terms of every candidate, in the order of the request.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Scores {
    /// One for each candidate.
    pub scores: Vec<CandidateScore>,
    /// 95th percentile that normalised the uncertainties.
    pub uncertainty_p95: f64,
}

impl Job {
    /// Reads a request.
    ///
    /// # Errors
    /// What makes no sense in it, as a sentence.
    pub fn from_request(
        request: &ScoreRequest,
        views: &[CandidateView],
        transparent_alpha: f64,
    ) -> Result<Self, String> {
        let mode = VarianceMode::from_code(request.variance)
            .map(|mode| match mode {
                VarianceMode::Paper => uncertainty::VarianceMode::Paper,
                VarianceMode::Normalised => uncertainty::VarianceMode::Normalised,
            })
            .ok_or_else(|| format!("variance code {} is unknown; expected 0 or 1", request.variance))?;
        for (side, value) in [("width", request.width), ("height", request.height)] {
            if !(8..=MAX_SIDE_PX).contains(&value) {
                return Err(format!("the image's {side} is {value}; expected 8 to {MAX_SIDE_PX} pixels"));
            }
        }
        let finite = |values: &[f64]| values.iter().all(|v| v.is_finite());
        if !finite(&request.principal_px) || !request.focal_px.iter().all(|f| f.is_finite() && *f > 0.0) {
            return Err(format!("focal lengths {:?} px; expected positive numbers", request.focal_px));
        }
        if !finite(&request.box_center_m) || !(0.01..=100.0).contains(&request.box_size_m) {
            return Err(format!(
                "the box's edge is {} m; expected 0.01 to 100 m about a finite centre",
                request.box_size_m
            ));
        }
        if !finite(&[request.weight_uncertainty, request.weight_angle]) {
            return Err("the weights are not finite".to_owned());
        }
        let center_m = DVec3::from_array(request.box_center_m);
        let mut job = Self {
            settings: ScoreSettings {
                weight_uncertainty: request.weight_uncertainty,
                weight_angle: request.weight_angle,
                grid_candidates: request.grid_candidates,
                clip_angle: request.clip_angle != 0,
            },
            uncertainty: UncertaintySettings {
                mode,
                bounding_box: BoundingBox { center_m, size_m: request.box_size_m },
                transparent_alpha,
            },
            candidates: Vec::new(),
            visited: Vec::new(),
        };
        for view in views {
            let position = DVec3::from_array(view.position_m);
            let rotation = DQuat::from_array(view.world_from_camera_xyzw);
            let direction = (position - center_m).try_normalize();
            let (Some(direction), true) = (direction, position.is_finite()) else {
                return Err(format!(
                    "view {} lies at {:?}; expected a point other than the box centre",
                    view.index, view.position_m
                ));
            };
            if view.visited != 0 {
                job.visited.push(direction);
                continue;
            }
            if !rotation.is_finite() || (rotation.length() - 1.0).abs() > 1e-3 {
                return Err(format!(
                    "view {}: its quaternion has length {}; expected 1",
                    view.index,
                    rotation.length()
                ));
            }
            let camera = Camera {
                world_from_camera: Pose { rotation: rotation.as_quat().normalize(), translation: position.as_vec3() },
                fx: request.focal_px[0] as f32,
                fy: request.focal_px[1] as f32,
                cx: request.principal_px[0] as f32,
                cy: request.principal_px[1] as f32,
                width: request.width,
                height: request.height,
            };
            job.candidates.push((camera, view.index, direction));
        }
        if job.candidates.is_empty() {
            return Err("no candidate is to be scored".to_owned());
        }
        Ok(job)
    }

    /// Number of views to be scored.
    #[must_use]
    pub fn candidates(&self) -> usize {
        self.candidates.len()
    }

    /// Scores every candidate on a model; `done` counts them. `None` when cancelled. On the CPU the same bits for any number
    /// of threads: each view is rendered and summed by one.
    ///
    /// # Errors
    /// When the back end fails.
    pub fn run(
        &self,
        backend: &mut Backend,
        model: &Gaussians,
        cancel: &AtomicBool,
        done: &AtomicU64,
    ) -> Result<Option<Scores>, BackendError> {
        let cameras: Vec<Camera> = self.candidates.iter().map(|(camera, ..)| *camera).collect();
        let seen = Mutex::new(vec![Uncertainty::default(); cameras.len()]);
        // Early stop at T = 1e-4 (A8): the last of the transmittance carries the far surface.
        let settings = (&self.uncertainty, &RenderSettings::default());
        let rendered = backend.uncertainties(model, &cameras, settings, cancel, |index, found| {
            if let Some(slot) = seen.lock().unwrap_or_else(PoisonError::into_inner).get_mut(index) {
                *slot = found;
            }
            done.fetch_add(1, Ordering::Relaxed);
        });
        match rendered {
            Ok(()) => {}
            Err(BackendError::Cancelled) => return Ok(None),
            Err(error) => return Err(error),
        }
        let seen = seen.into_inner().unwrap_or_else(PoisonError::into_inner);
        let candidates: Vec<Candidate> = self
            .candidates
            .iter()
            .zip(seen)
            .map(|(&(_, index, direction), seen)| Candidate { index, direction, seen })
            .collect();
        let (scores, uncertainty_p95) = score(&candidates, &self.visited, &self.settings);
        Ok(Some(Scores { scores, uncertainty_p95 }))
    }
}

/// A model that was published, converted for rendering.
#[derive(Debug, Clone)]
pub struct Held {
    /// Generation of its snapshot.
    pub generation: u64,
    /// Whether it is the last of a round.
    pub is_final: bool,
    /// The Gaussians; shared with the thread that renders them.
    pub model: Arc<Gaussians>,
}

impl Held {
    /// Converts a snapshot. Rows that are not finite are left out: the writer is another process and may be wild.
    #[must_use]
    pub fn new(generation: u64, is_final: bool, rows: &[GaussianRow]) -> Self {
        let model = rows.iter().map(gaussian).filter(Gaussian::is_finite).collect();
        Self { generation, is_final, model: Arc::new(model) }
    }
}

fn gaussian(row: &GaussianRow) -> Gaussian {
    Gaussian {
        mean: Vec3::from_array(row.mean_m),
        log_scales: Vec3::from_array(row.log_scales),
        rotation: Quat::from_array(row.rotation_xyzw),
        opacity_logit: row.opacity_logit,
        sh: row.sh0,
        id: u64::from(row.id[0]) | u64::from(row.id[1]) << 32,
        birth_round: row.birth_round,
    }
}

#[cfg(test)]
mod tests {
    use shared_types::frames::{Intrinsics, look_at};
    use splatting::Engine;

    use super::*;

    fn request() -> ScoreRequest {
        let camera = Intrinsics::from_hfov(96, 72, 1.204);
        ScoreRequest {
            variance: VarianceMode::Normalised.code(),
            clip_angle: 1,
            width: 96,
            height: 72,
            grid_candidates: 12,
            focal_px: [camera.fx, camera.fy],
            principal_px: [camera.cx, camera.cy],
            box_size_m: 1.0,
            weight_uncertainty: 0.6,
            weight_angle: 0.4,
            ..ScoreRequest::default()
        }
    }

    fn view(index: u32, eye: DVec3, visited: u32) -> CandidateView {
        let pose = look_at(eye, DVec3::ZERO);
        CandidateView {
            position_m: pose.position_m.to_array(),
            world_from_camera_xyzw: pose.rotation.to_array(),
            index,
            visited,
        }
    }

    fn ring() -> Vec<CandidateView> {
        (0..12u32)
            .map(|k| {
                let angle = f64::from(k) * std::f64::consts::TAU / 12.0;
                view(k, 2.0 * DVec3::new(angle.cos(), angle.sin(), 0.25), 0)
            })
            .collect()
    }

    /// A wall of opaque discs that faces south (-y), 0.8 m wide and high, at this y.
    fn wall(y: f32, opacity_logit: f32) -> Vec<GaussianRow> {
        (0..41 * 41)
            .map(|k| GaussianRow {
                mean_m: [(k % 41) as f32 * 0.02 - 0.4, y, (k / 41) as f32 * 0.02 - 0.4],
                log_scales: [0.014f32.ln(), 0.001f32.ln(), 0.014f32.ln()],
                rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
                opacity_logit,
                ..GaussianRow::default()
            })
            .collect()
    }

    fn run(request: &ScoreRequest, views: &[CandidateView], rows: &[GaussianRow], threads: usize) -> Scores {
        let held = Held::new(5, true, rows);
        let job = Job::from_request(request, views, 0.1).unwrap();
        let mut backend = Backend::from(Engine::new(threads).unwrap());
        let done = AtomicU64::new(0);
        let scores = job.run(&mut backend, &held.model, &AtomicBool::new(false), &done).unwrap().unwrap();
        assert_eq!(done.into_inner(), job.candidates() as u64);
        scores
    }

    #[test]
    fn two_layers_are_less_certain_than_one() {
        let south = [view(0, DVec3::new(0.0, -2.0, 0.0), 0)];
        let one = run(&request(), &south, &wall(0.0, 8.0), 1).scores[0];
        // A third of the light stops at the first layer: weights of 1/3 and 2/3, 0.3 m apart, are a variance of 0.02 m^2.
        let mut rows = wall(-0.15, -2.2);
        rows.extend(wall(0.15, 8.0));
        let two = run(&request(), &south, &rows, 1).scores[0];
        assert!(one.mean_alpha > 0.4 && one.mean_alpha < 1.0, "{one:?}");
        assert!(two.mean_variance_m2 > one.mean_variance_m2 + 0.003, "{one:?} {two:?}");
    }

    #[test]
    fn an_empty_model_is_everywhere_as_uncertain_as_the_chord() {
        let scores = run(&request(), &ring(), &[], 2);
        for score in &scores.scores {
            assert_eq!((score.mean_alpha, score.transparent_fraction), (0.0, 1.0));
            assert!(score.mean_variance_m2 > 0.03 && score.mean_variance_m2 < 3.0 / 12.0, "{score:?}");
        }
        let paper = ScoreRequest { variance: VarianceMode::Paper.code(), ..request() };
        assert!(run(&paper, &ring(), &[], 1).scores.iter().all(|s| (s.mean_variance_m2 - 0.25).abs() < 1e-12));
    }

    #[test]
    fn the_unseen_back_scores_higher_than_the_front_and_threads_do_not_matter() {
        let mut views = ring();
        views.push(view(99, DVec3::new(0.0, -2.0, 0.5), 1));
        let rows = wall(0.0, 8.0);
        let scores = run(&request(), &views, &rows, 1);
        assert_eq!(scores.scores.len(), 12, "the visited view is not scored");
        // View 9 looks from the south, where a view was taken; view 3 from the north.
        assert!(scores.scores[3].angle_normalised > scores.scores[9].angle_normalised);
        assert!(scores.scores[3].score > scores.scores[9].score);
        assert_eq!(run(&request(), &views, &rows, 2), scores);
        let mut turned = views.clone();
        turned.reverse();
        let mut reversed = run(&request(), &turned, &rows, 2);
        reversed.scores.reverse();
        assert_eq!(reversed, scores);
    }

    /// Views from four distances, from each place aimed at five points.
    fn thousand() -> Vec<CandidateView> {
        (0..1000u32)
            .map(|k| {
                let (place, aim) = (k / 5, f64::from(k % 5));
                let (angle, radius) = (f64::from(place) * 0.7, 1.4 + 0.4 * f64::from(place % 4));
                let eye = radius * DVec3::new(angle.cos(), angle.sin(), 0.3);
                let pose = look_at(eye, 0.1 * DVec3::new(aim.cos(), aim.sin(), 0.0));
                CandidateView { world_from_camera_xyzw: pose.rotation.to_array(), ..view(k, eye, 0) }
            })
            .collect()
    }

    #[test]
    fn a_thousand_candidates_score_as_they_do_one_by_one() {
        let (views, rows) = (thousand(), wall(0.0, 8.0));
        let all = run(&request(), &views, &rows, 2);
        assert_eq!(all.scores.len(), 1000);
        for index in [0, 1, 499, 998, 999] {
            let alone = run(&request(), &views[index..=index], &rows, 1).scores[0];
            let among = all.scores[index];
            assert_eq!(
                (alone.index, alone.mean_variance_m2, alone.area_fraction, alone.mean_alpha),
                (among.index, among.mean_variance_m2, among.area_fraction, among.mean_alpha)
            );
        }
    }

    #[test]
    fn a_thousand_candidates_are_given_up_on_demand() {
        let held = Held::new(5, true, &wall(0.0, 8.0));
        let job = Job::from_request(&request(), &thousand(), 0.1).unwrap();
        let mut backend = Backend::from(Engine::new(2).unwrap());
        let (cancel, done) = (AtomicBool::new(false), AtomicU64::new(0));
        std::thread::scope(|scope| {
            scope.spawn(|| {
                while done.load(Ordering::Relaxed) == 0 {
                    std::thread::yield_now();
                }
                cancel.store(true, Ordering::Relaxed);
            });
            assert_eq!(job.run(&mut backend, &held.model, &cancel, &done).unwrap(), None);
        });
        assert!(done.into_inner() < 1000);
    }

    #[test]
    fn broken_rows_are_left_out() {
        let mut rows = wall(0.0, 8.0);
        rows[7].opacity_logit = f32::NAN;
        rows[8].rotation_xyzw = [0.0; 4];
        assert_eq!(Held::new(1, true, &rows).model.len(), rows.len() - 2);
    }

    #[test]
    fn nonsense_is_refused_with_a_sentence() {
        let refused =
            |request: ScoreRequest, views: &[CandidateView]| Job::from_request(&request, views, 0.1).unwrap_err();
        assert!(refused(ScoreRequest { variance: 9, ..request() }, &ring()).contains("variance code 9"));
        assert!(refused(ScoreRequest { width: 0, ..request() }, &ring()).contains("width is 0"));
        assert!(refused(ScoreRequest { focal_px: [0.0; 2], ..request() }, &ring()).contains("focal"));
        assert!(refused(ScoreRequest { box_size_m: f64::NAN, ..request() }, &ring()).contains("edge"));
        assert!(refused(request(), &[]).contains("no candidate"));
        assert!(refused(request(), &[CandidateView { position_m: [0.0; 3], ..ring()[0] }]).contains("box centre"));
        let bent = CandidateView { world_from_camera_xyzw: [1.0; 4], ..ring()[0] };
        assert!(refused(request(), &[bent]).contains("quaternion"));
    }
}
