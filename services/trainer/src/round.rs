//! A training round as asked for and as run, and its place in checkpoints.

use glam::DVec3;
use shared_types::messages::RoundRequest;

use splatting::bytes::{Reader, Truncated, Writer};

/// Most iterations of a round: hours of training, in which no flight would wait for its end.
const MOST_ITERATIONS: u32 = 1_000_000;

/// What is asked of a round. Two requests are the same round if and only if these are equal.
#[derive(Debug, Clone, PartialEq)]
pub struct RoundSpec {
    /// Number of the round, from 0.
    pub round: u32,
    /// Most iterations.
    pub max_iterations: u32,
    /// Whether to end early once the loss has flattened.
    pub stop_when_flat: bool,
    /// Views to train on, nearest to the newest; 0: all.
    pub window: u32,
    /// Centre of the clip box in the world, metres.
    pub box_center_m: DVec3,
    /// Edge of the clip box, metres.
    pub box_size_m: f64,
    /// Radius of the candidate sphere, metres.
    pub radius_m: f64,
    /// Height of the fitted ground, metres.
    pub ground_z_m: f64,
    /// Seed of the view order.
    pub seed: u64,
    /// Keyframes to train on, oldest first.
    pub keyframes: Vec<u64>,
}

impl RoundSpec {
    /// Reads a request.
    ///
    /// # Errors
    /// What makes no sense in it, as a sentence.
    pub fn from_request(request: &RoundRequest, keyframes: &[u64]) -> Result<Self, String> {
        let spec = Self {
            round: request.round,
            max_iterations: request.max_iterations,
            stop_when_flat: request.stop_when_flat != 0,
            window: request.window,
            box_center_m: DVec3::from_array(request.box_center_m),
            box_size_m: request.box_size_m,
            radius_m: request.radius_m,
            ground_z_m: request.ground_z_m,
            seed: request.seed,
            keyframes: keyframes.to_vec(),
        };
        let mut sorted = spec.keyframes.clone();
        sorted.sort_unstable();
        sorted.dedup();
        if keyframes.is_empty() {
            return Err("a round needs at least one keyframe".to_owned());
        }
        if sorted.len() != keyframes.len() {
            return Err("a keyframe is named twice".to_owned());
        }
        if !spec.box_center_m.is_finite() || !spec.ground_z_m.is_finite() {
            return Err("the box or the ground is not finite".to_owned());
        }
        if !(0.01..=100.0).contains(&spec.box_size_m) {
            return Err(format!("the box's edge is {} m; expected 0.01 to 100 m", spec.box_size_m));
        }
        if spec.max_iterations > MOST_ITERATIONS {
            return Err(format!("{} iterations; expected at most {MOST_ITERATIONS}", spec.max_iterations));
        }
        if !(0.01..=100.0).contains(&spec.radius_m) {
            return Err(format!("the radius is {} m; expected 0.01 to 100 m", spec.radius_m));
        }
        Ok(spec)
    }

    pub(crate) fn write(&self, writer: &mut Writer) {
        writer.u32(self.round);
        writer.u32(self.max_iterations);
        writer.u32(u32::from(self.stop_when_flat));
        writer.u32(self.window);
        for value in self.box_center_m.to_array().into_iter().chain([self.box_size_m, self.radius_m, self.ground_z_m]) {
            writer.f64(value);
        }
        writer.u64(self.seed);
        writer.list(self.keyframes.iter(), |w, &id| w.u64(id));
    }

    pub(crate) fn read(reader: &mut Reader<'_>) -> Result<Self, Truncated> {
        const WHAT: &str = "a round";
        Ok(Self {
            round: reader.u32(WHAT)?,
            max_iterations: reader.u32(WHAT)?,
            stop_when_flat: reader.u32(WHAT)? != 0,
            window: reader.u32(WHAT)?,
            box_center_m: DVec3::new(reader.f64(WHAT)?, reader.f64(WHAT)?, reader.f64(WHAT)?),
            box_size_m: reader.f64(WHAT)?,
            radius_m: reader.f64(WHAT)?,
            ground_z_m: reader.f64(WHAT)?,
            seed: reader.u64(WHAT)?,
            keyframes: reader.list(WHAT, 8, |r| r.u64(WHAT))?,
        })
    }
}

/// How far a round is.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Progress {
    /// Iterations run in this round.
    pub iterations: u32,
    /// Iterations run in the mission.
    pub total_iterations: u64,
    /// Gaussians in the model.
    pub gaussians: u64,
    /// Mean loss (Eq. 7) of the last window of iterations.
    pub loss: f64,
    /// Mean PSNR of the last 100 training images over their foreground, dB.
    pub psnr_train_db: f64,
}

/// A round that is over.
#[derive(Debug, Clone, PartialEq)]
pub struct FinishedRound {
    /// What was asked.
    pub spec: RoundSpec,
    /// How it ended.
    pub progress: Progress,
    /// Generation of its final snapshot.
    pub generation: u64,
}

impl FinishedRound {
    pub(crate) fn write(&self, writer: &mut Writer) {
        self.spec.write(writer);
        writer.u32(self.progress.iterations);
        writer.u64(self.progress.total_iterations);
        writer.u64(self.progress.gaussians);
        writer.f64(self.progress.loss);
        writer.f64(self.progress.psnr_train_db);
        writer.u64(self.generation);
    }

    pub(crate) fn read(reader: &mut Reader<'_>) -> Result<Self, Truncated> {
        const WHAT: &str = "a finished round";
        Ok(Self {
            spec: RoundSpec::read(reader)?,
            progress: Progress {
                iterations: reader.u32(WHAT)?,
                total_iterations: reader.u64(WHAT)?,
                gaussians: reader.u64(WHAT)?,
                loss: reader.f64(WHAT)?,
                psnr_train_db: reader.f64(WHAT)?,
            },
            generation: reader.u64(WHAT)?,
        })
    }
}

/// Generation of a snapshot: a function of how far training is, so that it grows over restarts too, and the same number
/// always names the same model. The final snapshot of a round comes after every live one of it.
#[must_use]
pub fn generation(total_iterations: u64, round: u32, is_final: bool) -> u64 {
    2 * (total_iterations + u64::from(round)) + u64::from(is_final)
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(crate) fn request() -> RoundRequest {
        RoundRequest {
            round: 3,
            max_iterations: 800,
            stop_when_flat: 1,
            box_center_m: [1.0, 2.0, 0.5],
            box_size_m: 2.0,
            radius_m: 2.5,
            seed: 9,
            ..RoundRequest::default()
        }
    }

    #[test]
    fn a_finished_round_survives_a_checkpoint() {
        let finished = FinishedRound {
            spec: RoundSpec::from_request(&request(), &[4, 2, 9]).unwrap(),
            progress: Progress { iterations: 240, total_iterations: 991, gaussians: 7, loss: 0.1, psnr_train_db: 30.5 },
            generation: 77,
        };
        let mut writer = Writer::default();
        finished.write(&mut writer);
        let bytes = writer.into_bytes();
        assert_eq!(FinishedRound::read(&mut Reader::new(&bytes)), Ok(finished));
        assert!(FinishedRound::read(&mut Reader::new(&bytes[..bytes.len() - 1])).is_err());
    }

    #[test]
    fn nonsense_is_refused_with_a_sentence() {
        let refused = |request: RoundRequest, ids: &[u64]| RoundSpec::from_request(&request, ids).unwrap_err();
        assert!(refused(request(), &[]).contains("at least one keyframe"));
        assert!(refused(request(), &[1, 2, 1]).contains("twice"));
        assert!(refused(RoundRequest { box_size_m: f64::NAN, ..request() }, &[1]).contains("NaN"));
        assert!(refused(RoundRequest { radius_m: -1.0, ..request() }, &[1]).contains("radius"));
        assert!(refused(RoundRequest { max_iterations: u32::MAX, ..request() }, &[1]).contains("iterations"));
        assert!(refused(RoundRequest { ground_z_m: f64::INFINITY, ..request() }, &[1]).contains("ground"));
    }

    #[test]
    fn generations_grow_with_training() {
        // Live at 20 and 40, final at 40, a round without iterations, live at 60.
        let order = [
            generation(20, 0, false),
            generation(40, 0, false),
            generation(40, 0, true),
            generation(40, 1, true),
            generation(60, 2, false),
            generation(60, 2, true),
        ];
        assert!(order.windows(2).all(|w| w[0] < w[1]) && order[0] > 0, "{order:?}");
        assert_eq!(generation(0, 0, true), 1, "0 means none");
    }
}
