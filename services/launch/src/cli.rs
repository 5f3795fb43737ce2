//! The command line.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use shared_types::ServiceName;

/// Flies a quadcopter around an object and reconstructs it with 3D Gaussian Splatting on the way.
#[derive(Debug, Parser)]
#[command(name = "vantage", version, max_term_width = 100)]
#[command(after_help = "Example: vantage fly --preset quick --output rock\n\
    Exit codes: 0 success, 1 mission or job failed, 64 bad arguments or configuration, 69 something needed is missing, \
    70 internal error.")]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// The subcommands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Fly a whole mission on the embedded simulator, or on a vehicle by its configuration.
    #[command(after_help = "Example: vantage fly --object statue.obj --preset quick --output statue --seed 7")]
    Fly(Fly),
    /// Go on with a mission that was cut off.
    #[command(after_help = "Example: vantage resume missions/20260801-120000-0\n         \
        vantage resume missions/20260801-120000-0 --set trainer.backend=cpu")]
    Resume(Resume),
    /// Show what runs, since when, restarts, memory and ages of the last messages.
    #[command(after_help = "Example: vantage status --watch --channels")]
    Status(Status),
    /// Prepare a mission whose services somebody else starts, such as systemd: folder, and the system that they join.
    #[command(after_help = "Example: vantage prepare --config /etc/vantage/vantage.toml --system onboard\n\
        Goes on with the newest mission where that was cut off.")]
    Prepare(Prepare),
    /// Begin a mission that waits for it (planner.autostart = false).
    #[command(after_help = "Example: vantage start")]
    Start(Order),
    /// Tell a flying mission to return, land and save.
    #[command(after_help = "Example: vantage stop --system fly-4711")]
    Stop(Order),
    /// Tell a flying mission to land where it is, and save.
    #[command(after_help = "Example: vantage land")]
    Land(Order),
    /// Tell a flying mission to hold where it is until `vantage go-on`, `stop` or `land`.
    #[command(after_help = "Example: vantage abort")]
    Abort(Order),
    /// Let a mission go on that waits: after a pilot has given the vehicle back, or after `vantage abort`.
    #[command(after_help = "Example: vantage go-on")]
    GoOn(Order),
    /// Print the messages of one channel as they come, or write its images; nobody else notices.
    #[command(after_help = "Example: vantage tap vehicle/state --rate 2\n         \
        vantage tap camera/keyframe --png views\n         \
        vantage tap scorer/score --json --count 2 (a request and its reply)\n\
        `vantage status --channels` lists the channels.")]
    Tap(Tap),
    /// Change the log level of one service of a running system, or of all; nothing is started again.
    #[command(after_help = "Example: vantage log trainer debug")]
    Log(Log),
    /// Draw where a running service spends its time: a flame graph.
    #[command(after_help = "Example: vantage profile trainer --seconds 10")]
    Profile(Profile),
    /// Check this machine and say what to do about what is found.
    #[command(after_help = "Example: vantage doctor --clean")]
    Doctor(Doctor),
    /// Measure a mission's model against held-out views and the true surface.
    #[command(after_help = "Example: vantage evaluate missions/20260801-120000-0 --json")]
    Evaluate(Evaluate),
    /// Write a mission's model or views for other people's tools, or a model file in another format.
    #[command(after_help = "Example: vantage export missions/20260801-120000-0 --format glb --output statue.glb")]
    Export(Export),
    /// Train a model offline on a mission folder, a COLMAP or a nerfstudio dataset.
    #[command(after_help = "Example: vantage reconstruct missions/20260801-120000-0 --iterations 30000\n\
        A run that was cut off goes on when its command is given again.")]
    Reconstruct(Reconstruct),
    /// Run one or more services alone on a recording, as fast as they can: what the others sent is sent again.
    #[command(
        after_help = "Example: vantage replay missions/20260801-120000-0/recording.mcap --services trainer,scorer\n         \
        vantage replay missions/20260801-120000-0 --services trainer --from 60 --set trainer.backend=gpu\n\
        A mission folder without a recording gives its keyframes and training rounds."
    )]
    Replay(Replay),
    /// Print a configuration file with every key, its default and what it means.
    #[command(after_help = "Example: vantage config --preset quick > mission.toml")]
    Config(Configure),
    /// One process of a mission in the foreground.
    #[command(flatten)]
    Process(Process),
}

/// The services, one process each.
#[derive(Debug, Subcommand)]
pub enum Process {
    /// MAVLink: vehicle state and setpoints.
    #[command(after_help = "Example: vantage px4-link --system lab")]
    Px4Link(Service),
    /// RGB-D images and keyframes.
    #[command(after_help = "Example: vantage camera --system lab")]
    Camera(Service),
    /// The Gaussian model.
    #[command(after_help = "Example: vantage trainer --system lab")]
    Trainer(Service),
    /// Scores of candidate views.
    #[command(after_help = "Example: vantage scorer --system lab")]
    Scorer(Service),
    /// The mission.
    #[command(after_help = "Example: vantage planner --system lab")]
    Planner(Service),
    /// Every channel to a recording.
    #[command(after_help = "Example: vantage recorder --system lab")]
    Recorder(Service),
    /// Holds the channels open and cleans up after the dead.
    #[command(after_help = "Example: vantage keeper --system lab")]
    Keeper(Service),
    /// A PX4-compatible vehicle and the mission clock.
    #[command(after_help = "Example: vantage simulator --system lab")]
    Simulator(Service),
    /// The simulator's rendered world.
    #[command(after_help = "Example: vantage world --system lab")]
    World(Service),
}

impl Process {
    /// The service and its arguments.
    #[must_use]
    pub fn service(&self) -> (ServiceName, &Service) {
        match self {
            Self::Px4Link(service) => (ServiceName::Px4Link, service),
            Self::Camera(service) => (ServiceName::Camera, service),
            Self::Trainer(service) => (ServiceName::Trainer, service),
            Self::Scorer(service) => (ServiceName::Scorer, service),
            Self::Planner(service) => (ServiceName::Planner, service),
            Self::Recorder(service) => (ServiceName::Recorder, service),
            Self::Keeper(service) => (ServiceName::Keeper, service),
            Self::Simulator(service) => (ServiceName::Simulator, service),
            Self::World(service) => (ServiceName::World, service),
        }
    }
}

/// Where a configuration comes from: defaults < preset < file < `--set`.
#[derive(Debug, Clone, Default, Args)]
pub struct Settings {
    /// Configuration file (TOML), laid over the preset; `vantage config` prints one.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Preset that the configuration starts from: default, paper, quick or tiny.
    #[arg(long, default_value = "default", value_name = "NAME")]
    pub preset: String,
    /// One key, laid over everything else; may be given many times.
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    pub sets: Vec<String>,
}

/// Arguments of `fly`.
#[derive(Debug, Clone, Args)]
pub struct Fly {
    /// Configuration.
    #[command(flatten)]
    pub settings: Settings,
    /// Mesh of the object (OBJ, PLY, STL or glTF); none: a procedural rock.
    #[arg(long, value_name = "MESH")]
    pub object: Option<PathBuf>,
    /// Mission folder to make; must not hold a mission. Default: missions/<date>-<seed>.
    #[arg(long, value_name = "DIR")]
    pub output: Option<PathBuf>,
    /// Seed of everything random.
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Simulated seconds per wall second at most; 0: no limit.
    #[arg(long, value_name = "X", allow_negative_numbers = true)]
    pub speed: Option<f64>,
    /// Name of the system; default: a fresh one.
    #[arg(long, value_name = "NAME")]
    pub system: Option<String>,
    /// Measure what every process did when: report/timeline.svg, and report/trace.json for Perfetto (launch.trace).
    #[arg(long)]
    pub trace: bool,
    /// Print the result as JSON (report/metrics.json) instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `resume`.
#[derive(Debug, Clone, Args)]
pub struct Resume {
    /// The mission folder.
    pub folder: PathBuf,
    /// Simulated seconds per wall second at most; 0: no limit.
    #[arg(long, value_name = "X", allow_negative_numbers = true)]
    pub speed: Option<f64>,
    /// One key of this flight, laid over mission.toml; not of [mission], [planner], [camera] and [world], which the journal
    /// and the keyframes were made with. May be given many times.
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    pub sets: Vec<String>,
    /// Print the result as JSON (report/metrics.json) instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `prepare`.
#[derive(Debug, Clone, Args)]
pub struct Prepare {
    /// Configuration.
    #[command(flatten)]
    pub settings: Settings,
    /// Name of the system to make; none of that name may run.
    #[arg(long, value_name = "NAME", default_value = "onboard")]
    pub system: String,
}

/// Arguments of `status`.
#[derive(Debug, Clone, Args)]
pub struct Status {
    /// Name or folder of the system; default: the only one there is.
    #[arg(long, value_name = "NAME")]
    pub system: Option<String>,
    /// Show the channels too: who is on them, their memory, rates and ages. JSON has them always.
    #[arg(long)]
    pub channels: bool,
    /// Again and again, until Ctrl-C; as JSON, a line each time.
    #[arg(long)]
    pub watch: bool,
    /// As JSON.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of the operator's orders.
#[derive(Debug, Clone, Args)]
pub struct Order {
    /// Name or folder of the system; default: the only one there is.
    #[arg(long, value_name = "NAME")]
    pub system: Option<String>,
}

/// Arguments of `tap`.
#[derive(Debug, Clone, Args)]
pub struct Tap {
    /// The channel, such as vehicle/state; of a pair of channels, such as scorer/score, request and reply.
    pub channel: String,
    /// As JSON, a line for each message, with its items.
    #[arg(long)]
    pub json: bool,
    /// Write the images of messages into this folder.
    #[arg(long, value_name = "DIR")]
    pub png: Option<PathBuf>,
    /// Messages a second at most; those between are passed over.
    #[arg(long, value_name = "HZ", value_parser = positive)]
    pub rate: Option<f64>,
    /// End after so many messages; default: with the system, or Ctrl-C.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
    /// Name or folder of the system; default: the only one there is.
    #[arg(long, value_name = "NAME")]
    pub system: Option<String>,
}

fn not_negative(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|error: core::num::ParseFloatError| error.to_string())?;
    if value.is_finite() && value >= 0.0 { Ok(value) } else { Err("expected a number of 0 or more".to_owned()) }
}

fn positive(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|error: core::num::ParseFloatError| error.to_string())?;
    if value.is_finite() && value > 0.0 { Ok(value) } else { Err("expected a number above 0".to_owned()) }
}

/// Arguments of `log`.
#[derive(Debug, Clone, Args)]
pub struct Log {
    /// The service, or `all`.
    pub service: String,
    /// What it logs from now on.
    #[arg(value_parser = clap::builder::PossibleValuesParser::new(shared_types::logging::LEVELS))]
    pub level: String,
    /// Name or folder of the system; default: the only one there is.
    #[arg(long, value_name = "NAME")]
    pub system: Option<String>,
}

/// Arguments of `profile`.
#[derive(Debug, Clone, Args)]
pub struct Profile {
    /// The service.
    pub service: String,
    /// How long it is looked at.
    #[arg(long, default_value_t = 10, value_name = "S", value_parser = clap::value_parser!(u32).range(1..=3600))]
    pub seconds: u32,
    /// Where the picture goes; default: SERVICE.svg here.
    #[arg(long, value_name = "FILE")]
    pub output: Option<PathBuf>,
    /// Name or folder of the system; default: the only one there is.
    #[arg(long, value_name = "NAME")]
    pub system: Option<String>,
}

/// Arguments of `doctor`.
#[derive(Debug, Clone, Args)]
pub struct Doctor {
    /// Configuration whose ports and sizes are checked.
    #[command(flatten)]
    pub settings: Settings,
    /// Remove what dead systems left behind.
    #[arg(long)]
    pub clean: bool,
    /// As JSON.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `evaluate`.
#[derive(Debug, Clone, Args)]
pub struct Evaluate {
    /// The mission folder.
    pub folder: PathBuf,
    /// Held-out views, both radii together, 2 to 1000; default: launch.evaluate_views. Other numbers are only printed.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=1000))]
    pub views: Option<u32>,
    /// Width of the held-out views, 32 to 4096 pixels; default: model.width. Another than the default is only printed.
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(32..=4096))]
    pub width: Option<u32>,
    /// Model to measure instead of the mission's own (.ply, .splat, .spz or .glb).
    #[arg(long, value_name = "FILE")]
    pub model: Option<PathBuf>,
    /// Print metrics.json instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `export`.
#[derive(Debug, Clone, Args)]
pub struct Export {
    /// The mission folder; or a model file (.ply, .splat, .spz or .glb) to write in another format.
    #[arg(value_name = "DIR|FILE")]
    pub source: PathBuf,
    /// What to write.
    #[arg(long, value_enum)]
    pub format: Format,
    /// Where to; default: in DIR/export, or beside FILE.
    #[arg(long, value_name = "PATH")]
    pub output: Option<PathBuf>,
}

/// Formats of other people's tools.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// The model as an INRIA PLY, which every splat viewer reads and which keeps everything.
    Ply,
    /// The model as antimatter15's .splat, for web viewers; no view-dependent colours.
    Splat,
    /// The model as SPZ version 3, about six times smaller than PLY.
    Spz,
    /// The model as binary glTF with KHR_gaussian_splatting.
    Glb,
    /// The views as a COLMAP model, text and binary.
    Colmap,
    /// The views as a nerfstudio transforms.json.
    Nerfstudio,
}

/// Arguments of `reconstruct`.
#[derive(Debug, Clone, Args)]
pub struct Reconstruct {
    /// The dataset: a mission folder, a folder with COLMAP's sparse/0 and images, or one with transforms.json.
    pub folder: PathBuf,
    /// Training iterations, 1 to 10000000.
    #[arg(long, default_value_t = 7_000, value_name = "N")]
    pub iterations: u32,
    /// Where results go; default: <folder>/reconstruct.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Replace what lies in the output folder.
    #[arg(long)]
    pub overwrite: bool,
    /// How Gaussians are added and removed; default: none for a mission, whose depth seeds them, else default (3DGS).
    #[arg(long, value_enum)]
    pub strategy: Option<Strategy>,
    /// Most Gaussians, 16 to 20000000.
    #[arg(long, default_value_t = 1_000_000, value_name = "N")]
    pub max_gaussians: usize,
    /// Highest degree of spherical harmonics, 0 to 3.
    #[arg(long, default_value_t = 3, value_name = "N")]
    pub sh_degree: u8,
    /// Seed of everything random.
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub seed: u64,
    /// Threads of the CPU, at most four per core and 256; 0: one per core. The result is the same for any number.
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub threads: usize,
    /// What trains: auto (a GPU where there is a real one, else the CPU), cpu or gpu. A run may go on on another.
    #[arg(long, value_enum, default_value_t = Backend::Auto)]
    pub backend: Backend,
    /// Name of the GPU, or a part of it; `vantage doctor` lists them. Default: the best that is not software.
    #[arg(long, value_name = "NAME")]
    pub adapter: Option<String>,
    /// Give sums on a GPU an order, so that a run repeats bit for bit, as on the CPU it always does; costs memory and time.
    #[arg(long)]
    pub deterministic: bool,
    /// Iterations between two evaluations on the held-out images, besides 7000, 30000 and the last; 0: those only.
    #[arg(long, default_value_t = 1_000, value_name = "N")]
    pub eval_every: u32,
    /// Every how many-th image is held out, by name, 2 or more; 0: none.
    #[arg(long, default_value_t = 8, value_name = "N")]
    pub hold_out: usize,
    /// Colour behind the model; default: grey for a mission, else black.
    #[arg(long, value_enum)]
    pub background: Option<Background>,
    /// What pixels outside of masks and alpha channels are.
    #[arg(long, value_enum, default_value_t = Mask::Auto)]
    pub mask: Mask,
    /// Whole number by which images are shrunk, 1 to 64; default: a mission's training size, else until none is wider than 1600.
    #[arg(long, value_name = "N")]
    pub downscale: Option<u32>,
    /// Folder of a COLMAP dataset's images, such as images_2; cameras are scaled to it. Default: images.
    #[arg(long, value_name = "NAME")]
    pub images: Option<String>,
    /// Megabytes that images may take; default: half of what is free.
    #[arg(long, value_name = "MB")]
    pub memory: Option<u64>,
    /// Longest time between two checkpoints, milliseconds.
    #[arg(long, default_value_t = 10_000, value_name = "MS", hide = true)]
    pub checkpoint_ms: u64,
    /// Show no progress.
    #[arg(long, short)]
    pub quiet: bool,
    /// Print metrics.json instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// What trains.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Backend {
    /// A GPU where there is a real one, else the CPU.
    Auto,
    /// The CPU.
    Cpu,
    /// A GPU, or an error.
    Gpu,
}

/// How the number of Gaussians changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Strategy {
    /// Clone, split and prune by gradients on the screen, as 3DGS.
    Default,
    /// Relocate, and grow to the most, as 3DGS-MCMC.
    Mcmc,
    /// Keep what training began with, less what is pruned.
    None,
}

/// Colours behind a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Background {
    /// Black.
    Black,
    /// White.
    White,
    /// Half grey.
    Grey,
    /// Another colour in each iteration; black in evaluation.
    Random,
}

/// Uses of masks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Mask {
    /// Unknown outside of a mask file, empty where an alpha channel is transparent.
    Auto,
    /// Unknown: no part of the loss.
    Ignore,
    /// Empty: the model must be transparent there.
    Empty,
    /// Unused: every pixel counts, also of a mission.
    Off,
}

/// Arguments of `replay`.
#[derive(Debug, Clone, Args)]
pub struct Replay {
    /// A recording (recording.mcap), or a mission folder.
    #[arg(value_name = "FILE|DIR")]
    pub input: PathBuf,
    /// Services that run: camera, trainer, scorer, planner, world. What they sent then is left out.
    #[arg(long, value_name = "NAMES", value_delimiter = ',', required = true)]
    pub services: Vec<String>,
    /// Simulated seconds per wall second at most; 0: as fast as the services are.
    #[arg(long, default_value_t = 0.0, value_name = "X", value_parser = not_negative)]
    pub speed: f64,
    /// Seconds of the recording to pass over; keyframes of them are there all the same.
    #[arg(long, default_value_t = 0.0, value_name = "S", value_parser = not_negative)]
    pub from: f64,
    /// Folder for what the services write; default: replay-1 and so on, beside the recording.
    #[arg(long, value_name = "DIR")]
    pub output: Option<PathBuf>,
    /// Record the replay too.
    #[arg(long)]
    pub record: bool,
    /// One key of the services' configuration, laid over the recording's; may be given many times.
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    pub sets: Vec<String>,
    /// Name of the system; default: a fresh one.
    #[arg(long, value_name = "NAME")]
    pub system: Option<String>,
    /// The services are started by somebody else.
    #[arg(long, hide = true)]
    pub joined: bool,
}

/// Arguments of `config`.
#[derive(Debug, Clone, Args)]
pub struct Configure {
    /// Configuration to print.
    #[command(flatten)]
    pub settings: Settings,
}

/// Arguments of a service's command.
#[derive(Debug, Clone, Args)]
pub struct Service {
    /// Configuration of a system that does not exist yet; one that runs has its own.
    #[command(flatten)]
    pub settings: Settings,
    /// Name or folder of the system to join; made if there is none of that name. Default: the only one there is.
    #[arg(long, value_name = "NAME")]
    pub system: Option<String>,
    /// Alone, on a recording or a mission folder, in the foreground: for a debugger or a profiler.
    #[arg(long, requires = "input")]
    pub standalone: bool,
    /// The recording or mission folder of --standalone.
    #[arg(long, value_name = "FILE|DIR", requires = "standalone")]
    pub input: Option<PathBuf>,
    /// Started by a supervisor: stop when it is gone.
    #[arg(long, hide = true)]
    pub supervised: bool,
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn every_subcommand_explains_itself_with_an_example() {
        Cli::command().debug_assert();
        for command in Cli::command().get_subcommands() {
            let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            let begin = format!("Example: vantage {}", command.get_name());
            assert!(help.starts_with(&begin), "{}: {help}", command.get_name());
            assert!(command.get_about().is_some());
        }
    }

    #[test]
    fn every_started_service_has_a_command_of_its_name() {
        for service in crate::supervise::plan::START_ORDER {
            let cli = Cli::try_parse_from(["vantage", service.name(), "--system", "x"]).expect("parses");
            let Command::Process(process) = cli.command else { panic!("{service} is no process") };
            assert_eq!(process.service().0, service);
        }
    }

    #[test]
    fn the_examples_parse() {
        for command in Cli::command().get_subcommands() {
            let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            let first = help.lines().next().unwrap_or_default();
            let line = first.trim_start_matches("Example: ").split(" > ").next().unwrap_or_default().to_owned();
            assert!(Cli::try_parse_from(line.split_whitespace()).is_ok(), "{line}");
        }
    }
}
