//! What can go wrong before and during a reconstruction. Every message names the file, the value found, what was expected,
//! and the way out.

use std::path::{Path, PathBuf};

use shared_types::folder::FolderError;

/// Why a dataset cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The folder is none of the datasets that can be read.
    #[error(
        "{root} is no dataset: expected a mission folder (mission.toml), a nerfstudio dataset (transforms.json or \
         transforms_train.json) or a COLMAP dataset (sparse/0/cameras.bin or .txt)"
    )]
    Unknown {
        /// The folder.
        root: PathBuf,
    },
    /// A file that the dataset names, or that must be there, is not.
    #[error("{path} does not exist: {way_out}")]
    Missing {
        /// The file.
        path: PathBuf,
        /// What to do.
        way_out: String,
    },
    /// The system refuses a file.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file says what cannot be.
    #[error("{path}{}: {field} is {found}; expected {expected}", Place(*line))]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Number of the line, from 1, of a text file.
        line: Option<usize>,
        /// Which part of it.
        field: String,
        /// What is there.
        found: String,
        /// What should be, and the way out.
        expected: String,
    },
    /// Nothing, or too little, is left to train on or to judge by.
    #[error(
        "{root} has {images} usable images, of which {training} are left for training{}; expected at least 2: {}",
        HeldOut(*hold_out),
        if *hold_out == 0 { "add images" } else { "add images, or give another --hold-out (0: none)" }
    )]
    TooFew {
        /// The dataset.
        root: PathBuf,
        /// Images that it has.
        images: usize,
        /// Images to train on.
        training: usize,
        /// Every how many-th is held out.
        hold_out: usize,
    },
    /// The masks leave nothing to learn from.
    #[error(
        "{path} is {what} in which no pixel counts, and so are those of all {images} training images; expected white or \
         opaque pixels, or depth in the mission's box, where the object is: correct them, or give --mask off to train \
         on whole images"
    )]
    NothingCounts {
        /// The first of them.
        path: PathBuf,
        /// What the file is.
        what: &'static str,
        /// Images to train on.
        images: usize,
    },
    /// The images do not fit.
    #[error(
        "the {images} images of {root} take {need_mb} MB, more than the {limit_mb} MB that may be used: give \
         --downscale {downscale} or more, or --memory {need_mb} or more"
    )]
    Memory {
        /// The dataset.
        root: PathBuf,
        /// Images that it has.
        images: usize,
        /// Megabytes that they take.
        need_mb: u64,
        /// Megabytes that may be used.
        limit_mb: u64,
        /// A factor at which they would fit.
        downscale: u32,
    },
    /// The mission folder's own reader refuses it.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// The mission's configuration cannot be read.
    #[error(transparent)]
    Config(#[from] shared_types::config::ConfigError),
}

/// How images are held out, as it stands behind those that are left.
struct HeldOut(usize);

impl core::fmt::Display for HeldOut {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self.0 {
            0 => Ok(()),
            1 => write!(f, " once all are held out (--hold-out 1)"),
            every => write!(f, " once one in {every} is held out"),
        }
    }
}

/// Line of a text file, as it stands behind the file's name.
struct Place(Option<usize>);

impl core::fmt::Display for Place {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        self.0.map_or(Ok(()), |line| write!(f, ", line {line}"))
    }
}

impl DatasetError {
    /// A file, or a field of a binary or JSON file, that says what cannot be.
    pub(crate) fn damaged(
        path: &Path,
        field: impl Into<String>,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> Self {
        Self::Damaged {
            path: path.to_owned(),
            line: None,
            field: field.into(),
            found: found.into(),
            expected: expected.into(),
        }
    }

    /// Puts the line of a text file into a [`DatasetError::Damaged`].
    pub(crate) fn at_line(mut self, number: usize) -> Self {
        if let Self::Damaged { line, .. } = &mut self {
            *line = Some(number);
        }
        self
    }

    /// A file that cannot be read.
    pub(crate) fn read(path: &Path, source: std::io::Error, way_out: &str) -> Self {
        if source.kind() == std::io::ErrorKind::NotFound {
            Self::Missing { path: path.to_owned(), way_out: way_out.to_owned() }
        } else {
            Self::Read { path: path.to_owned(), source }
        }
    }
}

/// Why a reconstruction did not come about.
#[derive(Debug, thiserror::Error)]
pub enum ReconstructError {
    /// The dataset.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// An option makes no sense.
    #[error("{option} is {found}; expected {expected}")]
    Option {
        /// The option.
        option: &'static str,
        /// Its value.
        found: String,
        /// What should be.
        expected: String,
    },
    /// The output folder holds a run that is over.
    #[error("{out} holds a finished reconstruction: give --overwrite to replace it, or another folder with --out")]
    Finished {
        /// The folder.
        out: PathBuf,
    },
    /// The output folder holds a run with other options, or on other data.
    #[error(
        "{out} holds a reconstruction with another {what} ({found} there, {wanted} now): repeat its command to go on \
         with it, give --overwrite to begin anew, or another folder with --out"
    )]
    OtherRun {
        /// The folder.
        out: PathBuf,
        /// What differs.
        what: String,
        /// In the folder.
        found: String,
        /// In the command that was given.
        wanted: String,
    },
    /// The output folder holds files that a run would replace, and no run.
    #[error(
        "{out} holds {found}, but not as the folder of a reconstruction (with its run.json and lock): nothing there is \
         replaced, with --overwrite neither; give another folder with --out, or move these files away"
    )]
    NotOurs {
        /// The folder.
        out: PathBuf,
        /// What would be replaced.
        found: String,
    },
    /// The output folder is a mission, or one that a mission keeps its own files in.
    #[error(
        "--out is {out}, where the mission {mission} keeps its own files; expected a folder of its own, such as \
         {mission}/reconstruct, which is the default"
    )]
    InMission {
        /// The folder.
        out: PathBuf,
        /// The mission.
        mission: PathBuf,
    },
    /// The output folder's `run.json` cannot be read: nobody knows whose checkpoints lie there.
    #[error(
        "{path} is damaged ({found}); expected the options of the run whose checkpoints lie beside it: give \
         --overwrite to begin anew, or another folder with --out"
    )]
    DamagedRun {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        found: String,
    },
    /// Another process trains into the output folder.
    #[error("another reconstruction runs in {out}: wait for it, end it, or give another folder with --out")]
    Busy {
        /// The folder.
        out: PathBuf,
    },
    /// A file cannot be written.
    #[error(transparent)]
    Write(#[from] FolderError),
    /// The output folder cannot be used.
    #[error("cannot write into {path}: {source}; give another folder with --out")]
    Output {
        /// The folder or file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The model cannot be encoded.
    #[error("{path}: cannot be encoded: {source}")]
    Model {
        /// The file.
        path: PathBuf,
        /// The encoder's reason.
        source: std::io::Error,
    },
    /// A picture cannot be encoded.
    #[error("{path}: cannot be encoded: {source}")]
    Picture {
        /// The file.
        path: PathBuf,
        /// The encoder's reason.
        source: png::EncodingError,
    },
    /// The renderer could not be started.
    #[error(transparent)]
    Engine(#[from] splatting::EngineError),
    /// No back end as it was asked for.
    #[error("{0} (--backend, --adapter)")]
    NoBackend(splatting::BackendError),
    /// The back end failed in training.
    #[error(
        "training failed: {0}; the run stands at its last checkpoint: repeat the command to go on from there, with \
         --backend cpu to go on without the GPU"
    )]
    Backend(#[from] splatting::BackendError),
    /// A setting of the densification is out of range.
    #[error(transparent)]
    Densify(#[from] splatting::DensifyError),
    /// An image and its camera are refused by the renderer.
    #[error("image {name}: {source}")]
    View {
        /// The image.
        name: String,
        /// Why.
        source: splatting::ViewError,
    },
    /// What training begins with is in no image.
    #[error(
        "none of the {gaussians} Gaussians made from {origin} is in any of the {images} training images: poses and points \
         do not belong together; expected both from the same model of the scene, in the same units and axes: export them \
         again together, or take the points away to begin with random ones"
    )]
    Unseen {
        /// Gaussians.
        gaussians: usize,
        /// What they were made from.
        origin: &'static str,
        /// Images to train on.
        images: usize,
    },
    /// The model was lost: every Gaussian was pruned away.
    #[error("no Gaussians are left after iteration {iteration}: the poses or the masks do not fit the images")]
    Empty {
        /// When.
        iteration: u32,
    },
}

/// How a command ends on an error, in the terms of its exit codes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ErrorKind {
    /// Bad arguments.
    Usage,
    /// Something needed is missing or refused by the system.
    Missing,
    /// The data do not allow it.
    Failed,
    /// An error of this program.
    Internal,
}

impl ReconstructError {
    /// What kind of error it is.
    #[must_use]
    pub fn kind(&self) -> ErrorKind {
        match self {
            Self::Dataset(error) => match error {
                DatasetError::Unknown { .. }
                | DatasetError::Config(_)
                | DatasetError::TooFew { .. }
                | DatasetError::NothingCounts { .. } => ErrorKind::Usage,
                DatasetError::Missing { .. } | DatasetError::Read { .. } | DatasetError::Memory { .. } => {
                    ErrorKind::Missing
                }
                DatasetError::Damaged { .. } => ErrorKind::Failed,
                DatasetError::Folder(error) => folder_kind(error),
            },
            Self::Option { .. }
            | Self::Finished { .. }
            | Self::OtherRun { .. }
            | Self::NotOurs { .. }
            | Self::Unseen { .. }
            | Self::InMission { .. }
            | Self::DamagedRun { .. }
            | Self::Busy { .. } => ErrorKind::Usage,
            Self::Write(error) => folder_kind(error),
            Self::Output { .. } | Self::Engine(_) | Self::NoBackend(_) | Self::Backend(_) => ErrorKind::Missing,
            Self::View { .. } | Self::Empty { .. } => ErrorKind::Failed,
            Self::Picture { .. } | Self::Model { .. } | Self::Densify(_) => ErrorKind::Internal,
        }
    }
}

fn folder_kind(error: &FolderError) -> ErrorKind {
    match error {
        FolderError::HoldsMission { .. } | FolderError::NoMission { .. } | FolderError::Exists { .. } => {
            ErrorKind::Usage
        }
        FolderError::Io { .. } | FolderError::Full { .. } => ErrorKind::Missing,
        FolderError::Damaged { .. } => ErrorKind::Failed,
    }
}
