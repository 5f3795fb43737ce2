//! What the user may choose, and the identity of a run that follows from it: what must be equal for a run to be gone on with.

use std::path::PathBuf;
use std::time::Duration;

use glam::Vec3;
use serde::{Deserialize, Serialize};
use splatting::{BackendKind, SH_DEGREE_MAX};

use crate::dataset::{Dataset, MaskUse};
use crate::error::ReconstructError;
use crate::split::Split;

/// How the number of Gaussians changes in training.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StrategyName {
    /// Cloning, splitting and pruning by gradients on the screen, as 3DGS.
    Default,
    /// Relocation and growth up to `max_gaussians`, as 3DGS-MCMC.
    Mcmc,
    /// What the training began with, less what is pruned.
    None,
}

/// Colour behind the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Background {
    /// Black.
    Black,
    /// White.
    White,
    /// Half grey.
    Grey,
    /// Another colour in each iteration, black in evaluation: nothing transparent can pass for background.
    Random,
}

impl Background {
    /// The colour in evaluation.
    #[must_use]
    pub fn color(self) -> Vec3 {
        match self {
            Self::Black | Self::Random => Vec3::ZERO,
            Self::White => Vec3::ONE,
            Self::Grey => Vec3::splat(0.5),
        }
    }
}

/// Options of a reconstruction.
#[derive(Debug, Clone)]
pub struct Options {
    /// The dataset.
    pub folder: PathBuf,
    /// Where results go.
    pub out: PathBuf,
    /// Iterations in all.
    pub iterations: u32,
    /// Densification; `None`: what is best for the dataset.
    pub strategy: Option<StrategyName>,
    /// Most Gaussians.
    pub max_gaussians: usize,
    /// Highest degree of spherical harmonics.
    pub sh_degree: u8,
    /// Seed of everything random.
    pub seed: u64,
    /// Threads; 0: one per core.
    pub threads: usize,
    /// What trains.
    pub backend: BackendKind,
    /// Name of the GPU, or a part of it; `None`: the best.
    pub adapter: Option<String>,
    /// Whether sums on a GPU have an order, as they always do on the CPU.
    pub deterministic: bool,
    /// Iterations between two evaluations on the held-out images, besides 7,000, 30,000 and the last; 0: those only.
    pub eval_every: u32,
    /// Colour behind the model; `None`: grey for a mission, else black.
    pub background: Option<Background>,
    /// What masks and alpha channels mean.
    pub mask: MaskUse,
    /// Factor by which images are shrunk; `None`: the dataset's default.
    pub downscale: Option<u32>,
    /// Folder of a COLMAP dataset's images; `None`: `images`.
    pub images: Option<String>,
    /// Every how many-th image is held out; 0: none.
    pub hold_out: usize,
    /// Bytes that images and what is made of them may take; `None`: half of what is free.
    pub memory_bytes: Option<u64>,
    /// Whether what lies in `out` is replaced.
    pub overwrite: bool,
    /// Longest wall time between two checkpoints.
    pub checkpoint_period: Duration,
}

impl Options {
    /// The defaults for a dataset.
    #[must_use]
    pub fn new(folder: impl Into<PathBuf>) -> Self {
        let folder = folder.into();
        Self {
            out: folder.join("reconstruct"),
            folder,
            iterations: 7_000,
            strategy: None,
            max_gaussians: 1_000_000,
            sh_degree: SH_DEGREE_MAX,
            seed: 0,
            threads: 0,
            backend: BackendKind::Auto,
            adapter: None,
            deterministic: false,
            eval_every: 1_000,
            background: None,
            mask: MaskUse::Auto,
            downscale: None,
            images: None,
            hold_out: 8,
            memory_bytes: None,
            overwrite: false,
            checkpoint_period: Duration::from_secs(10),
        }
    }

    /// Refuses what makes no sense.
    ///
    /// # Errors
    /// [`ReconstructError::Option`] naming the option.
    pub fn check(&self) -> Result<(), ReconstructError> {
        let no = |option, found: String, expected: &str| {
            Err(ReconstructError::Option { option, found, expected: expected.to_owned() })
        };
        if self.iterations == 0 || self.iterations > 10_000_000 {
            return no("--iterations", self.iterations.to_string(), "1 to 10000000");
        }
        if !(16..=20_000_000).contains(&self.max_gaussians) {
            return no("--max-gaussians", self.max_gaussians.to_string(), "16 to 20000000");
        }
        if self.sh_degree > SH_DEGREE_MAX {
            return no("--sh-degree", self.sh_degree.to_string(), "0 to 3");
        }
        let cores = cores();
        if self.threads > most_threads(cores) {
            let most = most_threads(cores);
            let expected =
                format!("0 (one per core) to {most}: 4 for each of the {cores} cores here, at most {MOST_THREADS}");
            return no("--threads", self.threads.to_string(), &expected);
        }
        if self.downscale.is_some_and(|factor| !(1..=64).contains(&factor)) {
            return no("--downscale", format!("{}", self.downscale.unwrap_or(0)), "1 to 64");
        }
        if self.images.as_ref().is_some_and(|images| images.is_empty()) {
            return no("--images", "empty".to_owned(), "a folder of the dataset, such as images_2");
        }
        Ok(())
    }

    /// Threads that train.
    #[must_use]
    pub fn thread_count(&self) -> usize {
        match self.threads {
            0 => cores(),
            threads => threads,
        }
    }
}

/// Threads that a run takes at most, whatever the machine: each has buffers of its own.
const MOST_THREADS: usize = 256;

/// More threads than a few a core only wait for each other.
fn most_threads(cores: usize) -> usize {
    cores.saturating_mul(4).min(MOST_THREADS)
}

fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Version of what a run computes: a run of another version is not gone on with.
const FORMAT: u32 = 2;

/// What decides the bits of a run, as `run.json` in its folder keeps it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Identity {
    /// Version of this file and of what a run computes.
    pub format: u32,
    /// Format of the dataset.
    pub dataset: String,
    /// Checksum of names, cameras, pixels and points.
    pub fingerprint: String,
    /// Images trained on.
    pub training: usize,
    /// Images held out.
    pub held_out: usize,
    /// Iterations.
    pub iterations: u32,
    /// Densification.
    pub strategy: StrategyName,
    /// Most Gaussians.
    pub max_gaussians: usize,
    /// Highest degree of spherical harmonics.
    pub sh_degree: u8,
    /// Seed.
    pub seed: u64,
    /// Factor by which images were shrunk.
    pub downscale: u32,
    /// Colour behind the model.
    pub background: Background,
}

impl Identity {
    /// The identity of a run.
    #[must_use]
    pub fn of(options: &Options, dataset: &Dataset, split: &Split, strategy: StrategyName) -> Self {
        Self {
            format: FORMAT,
            dataset: dataset.format.name().to_owned(),
            fingerprint: format!("{:016x}", dataset.fingerprint()),
            training: split.training.len(),
            held_out: split.held_out.len(),
            iterations: options.iterations,
            strategy,
            max_gaussians: options.max_gaussians,
            sh_degree: options.sh_degree,
            seed: options.seed,
            downscale: dataset.downscale,
            background: options.background_for(dataset),
        }
    }

    /// The first field in which another identity differs: its name, the value here and there.
    #[must_use]
    pub fn difference(&self, other: &Self) -> Option<(String, String, String)> {
        let [here, there] = [self, other].map(|identity| serde_json::to_value(identity).unwrap_or_default());
        let fields = here.as_object()?;
        fields
            .iter()
            .find(|(name, value)| there.get(name.as_str()) != Some(value))
            .map(|(name, value)| (named(name), value.to_string(), there[name.as_str()].to_string()))
    }
}

/// What decides a field of an identity, as the user knows it.
fn named(field: &str) -> String {
    match field {
        "fingerprint" => {
            "content of the dataset (its images, masks, cameras or points, or --mask or --images)".to_owned()
        }
        "training" | "held_out" => format!("number of {field} images (of the dataset, or --hold-out)"),
        "iterations" | "strategy" | "max_gaussians" | "sh_degree" | "seed" | "downscale" | "background" => {
            format!("--{}", field.replace('_', "-"))
        }
        other => other.replace('_', " "),
    }
}

impl Options {
    /// The colour behind the model on a dataset.
    #[must_use]
    pub fn background_for(&self, dataset: &Dataset) -> Background {
        let default = if dataset.stage.is_some() { Background::Grey } else { Background::Black };
        self.background.unwrap_or(default)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_make_sense_and_nonsense_is_named() {
        let good = Options::new("scene");
        assert_eq!(good.out, PathBuf::from("scene/reconstruct"));
        good.check().expect("the defaults");
        let refused = |options: Options| options.check().expect_err("nonsense").to_string();
        assert!(refused(Options { iterations: 0, ..good.clone() }).contains("--iterations is 0"));
        assert!(refused(Options { max_gaussians: 1, ..good.clone() }).contains("--max-gaussians is 1"));
        assert!(refused(Options { sh_degree: 4, ..good.clone() }).contains("--sh-degree is 4"));
        assert!(refused(Options { threads: 257, ..good.clone() }).contains("--threads is 257"));
        assert_eq!([1, 2, 64, 65, 1000].map(most_threads), [4, 8, 256, 256, 256]);
        assert!(refused(Options { downscale: Some(0), ..good.clone() }).contains("--downscale is 0"));
    }

    #[test]
    fn a_difference_is_named_with_both_values() {
        let one = Identity {
            format: FORMAT,
            dataset: "COLMAP".to_owned(),
            fingerprint: "00".to_owned(),
            training: 7,
            held_out: 1,
            iterations: 7_000,
            strategy: StrategyName::Mcmc,
            max_gaussians: 1000,
            sh_degree: 3,
            seed: 0,
            downscale: 1,
            background: Background::Black,
        };
        assert_eq!(one.difference(&one.clone()), None);
        let other = Identity { strategy: StrategyName::None, ..one.clone() };
        let difference = one.difference(&other).expect("differs");
        assert_eq!(difference, ("--strategy".to_owned(), "\"mcmc\"".to_owned(), "\"none\"".to_owned()));
    }
}
