//! `vantage reconstruct`: offline training, shown on the terminal; a mission's model is then measured as the live one was.

use std::io::IsTerminal as _;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use indicatif::{ProgressBar, ProgressStyle};
use reconstruct::report::Report;
use reconstruct::{ErrorKind, Event, Options, Outcome, ReconstructError};
use shared_types::config::load_mission;
use shared_types::folder::{MissionFolder, write_atomic};

use crate::cli;
use crate::evaluate::metrics::Offline;
use crate::evaluate::truth::Truth;
use crate::evaluate::{self, Effort, views};
use crate::exit::{Exit, Refusal};
use crate::{print, say};

/// Time between two lines where there is no terminal.
const LINE_PERIOD: Duration = Duration::from_secs(5);

/// Runs the command.
///
/// # Errors
/// What is wrong with the arguments, the dataset or the output folder, with its exit code.
pub fn run(arguments: &cli::Reconstruct) -> anyhow::Result<Exit> {
    let options = options_of(arguments);
    options.check().map_err(refusal)?;
    // Hours of training are not to end with an object that cannot be read.
    let mission = Simulated::of(&options.folder)?;
    if let Some(mission) = &mission
        && !options.overwrite
        && !is_measured(&options.out)
        && let Some(report) = reconstruct::finished(&options).map_err(refusal)?
    {
        say("trained already, but not measured on the true object: measuring");
        return conclude(arguments, &report, Some(mission), &options.out);
    }
    let interrupted = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&interrupted)).context("cannot listen to signals")?;
    }
    let mut screen = Screen::new(arguments.quiet);
    let outcome = reconstruct::run(&options, &mut |event: &Event| {
        screen.show(event);
        if interrupted.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    screen.clear();
    match outcome.map_err(refusal)? {
        Outcome::Stopped { iteration, iterations, out } => {
            let out = out.display();
            say(&format!("stopped at iteration {iteration} of {iterations}; the same command goes on ({out})"));
            Ok(Exit::Failed)
        }
        Outcome::Finished { report, out } => conclude(arguments, &report, mission.as_ref(), &out),
    }
}

/// A report with what was measured on the true object.
#[derive(serde::Serialize)]
struct Measured<'a> {
    #[serde(flatten)]
    report: &'a Report,
    #[serde(skip_serializing_if = "Option::is_none")]
    offline: Option<&'a Offline>,
}

/// Measures the model where there is a truth, and tells how the run went.
fn conclude(
    arguments: &cli::Reconstruct,
    report: &Report,
    mission: Option<&Simulated>,
    out: &Path,
) -> anyhow::Result<Exit> {
    let offline = mission.map(|mission| mission.measure(report, out)).transpose()?;
    let measured = Measured { report, offline: offline.as_ref() };
    let json = serde_json::to_string_pretty(&measured).context("metrics")? + "\n";
    if offline.is_some() {
        // Last: it is what says that nothing is left to do.
        write_atomic(&out.join("metrics.json"), json.as_bytes())?;
    }
    print(&if arguments.json { json } else { table(report, offline.as_ref(), out) })
}

/// Whether the model of a finished run was measured on the true object too.
fn is_measured(out: &Path) -> bool {
    let json = std::fs::read(out.join("metrics.json")).ok();
    let json = json.and_then(|bytes| serde_json::from_slice::<serde_json::Value>(&bytes).ok());
    json.is_some_and(|json| json.get("offline").is_some())
}

fn options_of(arguments: &cli::Reconstruct) -> Options {
    let defaults = Options::new(&arguments.folder);
    Options {
        out: arguments.out.clone().unwrap_or_else(|| defaults.out.clone()),
        iterations: arguments.iterations,
        strategy: arguments.strategy.map(|strategy| match strategy {
            cli::Strategy::Default => reconstruct::StrategyName::Default,
            cli::Strategy::Mcmc => reconstruct::StrategyName::Mcmc,
            cli::Strategy::None => reconstruct::StrategyName::None,
        }),
        max_gaussians: arguments.max_gaussians,
        sh_degree: arguments.sh_degree,
        seed: arguments.seed,
        threads: arguments.threads,
        backend: match arguments.backend {
            cli::Backend::Auto => splatting::BackendKind::Auto,
            cli::Backend::Cpu => splatting::BackendKind::Cpu,
            cli::Backend::Gpu => splatting::BackendKind::Gpu,
        },
        adapter: arguments.adapter.clone(),
        deterministic: arguments.deterministic,
        eval_every: arguments.eval_every,
        background: arguments.background.map(|background| match background {
            cli::Background::Black => reconstruct::Background::Black,
            cli::Background::White => reconstruct::Background::White,
            cli::Background::Grey => reconstruct::Background::Grey,
            cli::Background::Random => reconstruct::Background::Random,
        }),
        mask: match arguments.mask {
            cli::Mask::Auto => reconstruct::MaskUse::Auto,
            cli::Mask::Ignore => reconstruct::MaskUse::Ignore,
            cli::Mask::Empty => reconstruct::MaskUse::Empty,
            cli::Mask::Off => reconstruct::MaskUse::Off,
        },
        downscale: arguments.downscale,
        images: arguments.images.clone(),
        hold_out: arguments.hold_out,
        memory_bytes: arguments.memory.map(|megabytes| megabytes.saturating_mul(1_000_000)),
        overwrite: arguments.overwrite,
        checkpoint_period: Duration::from_millis(arguments.checkpoint_ms),
        ..defaults
    }
}

/// The error with the exit code of its kind.
fn refusal(error: ReconstructError) -> anyhow::Error {
    let exit = match error.kind() {
        ErrorKind::Usage => Exit::Usage,
        ErrorKind::Missing => Exit::Missing,
        ErrorKind::Failed => Exit::Failed,
        ErrorKind::Internal => Exit::Internal,
    };
    Refusal { exit, message: error.to_string() }.into()
}

/// A simulated mission, with the true object that its models are measured on.
struct Simulated {
    folder: MissionFolder,
    effort: Effort,
    truth: Truth,
}

impl Simulated {
    /// The mission in a folder; `None` for other datasets, and for missions without a truth to compare with.
    fn of(folder: &Path) -> anyhow::Result<Option<Self>> {
        let Ok(folder) = MissionFolder::open(folder) else { return Ok(None) };
        let config = load_mission(&folder.config_path())?;
        if !config.link.is_local() {
            return Ok(None);
        }
        Ok(Some(Self { folder, effort: Effort::of(&config), truth: Truth::build(&config)? }))
    }

    /// Measures a model on the views that the live model is measured on, and notes it beside that one.
    fn measure(&self, report: &Report, out: &Path) -> anyhow::Result<Offline> {
        let (truth, effort) = (&self.truth, self.effort);
        let model = evaluate::read_model(&out.join("model.ply"))?;
        let quality = views::appearance(truth, &model, &views::held_out(truth, effort)?, effort)?;
        let mut offline = Offline {
            iterations: Some(report.run.iterations),
            keyframes: Some(report.run.training),
            gaussians: Some(report.gaussians),
            seconds: report.last().map(|row| row.wall_s),
            ..Offline::default()
        };
        offline.take(&quality);
        if let Some(mut metrics) = evaluate::read_metrics(&self.folder)? {
            metrics.offline = offline.clone();
            evaluate::write_metrics(&self.folder, &metrics)?;
        }
        Ok(offline)
    }
}

/// What a run ends with.
fn table(report: &Report, offline: Option<&Offline>, out: &Path) -> String {
    let mut rows: Vec<(String, String)> = vec![
        ("iterations".to_owned(), report.run.iterations.to_string()),
        ("Gaussians".to_owned(), report.gaussians.to_string()),
        ("trained by".to_owned(), report.backends.join(", then ")),
        ("iterations a second".to_owned(), format!("{:.1}", report.iterations_per_s)),
        ("processor time an iteration".to_owned(), format!("{:.1} ms", report.cpu_ms_per_iteration)),
    ];
    let mut row = |name: &str, value: Option<f64>, unit: &str, digits: usize| {
        rows.extend(value.map(|value| (name.to_owned(), format!("{value:.digits$}{unit}"))));
    };
    if let Some(last) = report.last() {
        row("PSNR training images", last.train_psnr_db, " dB", 2);
        row("PSNR held-out images", last.held_out_psnr_db, " dB", 2);
        row("SSIM held-out images", last.held_out_ssim, "", 4);
    }
    if let Some(offline) = offline {
        row("PSNR object, true views at R", offline.psnr_object_db, " dB", 2);
        row("PSNR object, true views at 0.8 R", offline.psnr_object_near_db, " dB", 2);
        row("SSIM object, true views at R", offline.ssim_object, "", 4);
    }
    row("memory", report.memory.peak_rss_mb, " MB", 0);
    let mut text = String::new();
    for (name, value) in rows {
        text += &format!("{name:<34}{value}\n");
    }
    let out = out.display();
    text + &format!(
        "\nmodel     {out}/model.ply\nfigures   {out}/metrics.{{csv,json}}\npictures  {out}/{{curve,held-out}}.png\n"
    )
}

/// What the user sees of a run: a line that changes on a terminal, else a line every few seconds.
struct Screen {
    quiet: bool,
    bar: Option<ProgressBar>,
    last: Option<Instant>,
}

impl Screen {
    fn new(quiet: bool) -> Self {
        let bar = (!quiet && std::io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::new_spinner();
            if let Ok(style) = ProgressStyle::with_template("{spinner} {wide_msg}") {
                bar.set_style(style);
            }
            bar
        });
        Self { quiet, bar, last: None }
    }

    fn show(&mut self, event: &Event) {
        if self.quiet {
            return;
        }
        match (event, &self.bar) {
            (Event::Trained(_), Some(bar)) => {
                bar.set_message(event.line());
                bar.tick();
            }
            (Event::Trained(_), None) => {
                if self.last.is_none_or(|last| last.elapsed() >= LINE_PERIOD) {
                    self.last = Some(Instant::now());
                    say(&event.line());
                }
            }
            (_, Some(bar)) => bar.suspend(|| say(&event.line())),
            (_, None) => say(&event.line()),
        }
    }

    fn clear(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

#[cfg(test)]
mod tests;
