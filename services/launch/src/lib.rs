//! The `vantage` command: starts, watches and restarts the services of a mission; offline tools.
//!
//! - [`cli`], [`settings`]: arguments, and the configuration they resolve to;
//! - [`service`]: one process of a mission in the foreground;
//! - [`fly`], [`supervise`], [`progress`], [`summary`]: a whole mission; [`prepare`]: one that another supervisor runs;
//! - [`evaluate`], [`export`]: what a mission folder is worth, and how it leaves Vantage;
//! - [`replay`]: services alone on what was recorded;
//! - [`reconstruct`]: offline training on a mission folder or another dataset;
//! - [`status`], [`tap`]: what runs, and what it says;
//! - [`order`], [`control`], [`doctor`]: the operator's word to it, its logs, and whether this machine is fit for it.

#![forbid(unsafe_code)]

pub mod cli;
pub mod clock;
pub mod control;
pub mod doctor;
pub mod evaluate;
pub mod exit;
pub mod export;
pub mod fly;
pub mod instance;
pub mod machine_check;
pub mod order;
pub mod prepare;
pub mod proc;
pub mod profile;
pub mod progress;
pub mod reach;
pub mod reconstruct;
pub mod replay;
pub mod service;
pub mod settings;
pub mod status;
pub mod summary;
pub mod supervise;
pub mod tap;
pub mod timeline;

use std::process::ExitCode;

use clap::Parser as _;
use clap::error::ErrorKind;
use tracing_subscriber::filter::LevelFilter;

use cli::{Cli, Command};
use exit::{Exit, exit_of};
use shared_types::folder::MissionFolder;
use shared_types::messages::MissionCommand;

/// The whole command: parses the arguments, does what they say, and tells how it went.
#[must_use]
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => {
            let asked_for = matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion);
            // Nothing can be said about a closed terminal.
            error.print().ok();
            return if asked_for { Exit::Ok.into() } else { Exit::Usage.into() };
        }
    };
    let is_service = matches!(cli.command, Command::Process(_));
    shared_types::logging::init(if is_service { LevelFilter::INFO } else { LevelFilter::WARN });
    match run(&cli.command) {
        Ok(exit) => exit.into(),
        Err(error) => {
            say(&format!("vantage: {}", told(&error)));
            exit_of(&error).into()
        }
    }
}

/// An error with its causes, less those that the message before them ends with already.
fn told(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if text.is_empty() {
            text = cause;
        } else if !text.contains(&cause) {
            text = format!("{text}: {cause}");
        }
    }
    text
}

fn run(command: &Command) -> anyhow::Result<Exit> {
    match command {
        Command::Process(process) => {
            let (name, arguments) = process.service();
            service::run(name, arguments).map(|()| Exit::Ok)
        }
        Command::Fly(arguments) => fly::fly(arguments),
        Command::Resume(arguments) => fly::resume(arguments),
        Command::Status(arguments) => status::run(arguments),
        Command::Prepare(arguments) => prepare::run(arguments),
        Command::Start(arguments) => order::run(MissionCommand::Start, arguments),
        Command::Stop(arguments) => order::run(MissionCommand::Stop, arguments),
        Command::Land(arguments) => order::run(MissionCommand::Land, arguments),
        Command::Abort(arguments) => order::run(MissionCommand::Abort, arguments),
        Command::GoOn(arguments) => order::run(MissionCommand::GoOn, arguments),
        Command::Tap(arguments) => tap::run(arguments),
        Command::Log(arguments) => control::log(arguments),
        Command::Profile(arguments) => profile::run(arguments),
        Command::Doctor(arguments) => doctor::run(arguments),
        Command::Evaluate(arguments) => evaluate::run(arguments),
        Command::Export(arguments) => export_any(arguments),
        Command::Reconstruct(arguments) => reconstruct::run(arguments),
        Command::Replay(arguments) => replay::run(arguments),
        Command::Config(arguments) => {
            print(&shared_types::config::commented(&settings::resolve(&arguments.settings)?)?)
        }
    }
}

fn export_any(arguments: &cli::Export) -> anyhow::Result<Exit> {
    use splatting::formats::Format as Model;
    let (format, name) = match arguments.format {
        cli::Format::Ply => (export::Format::Model(Model::Ply), "model.ply"),
        cli::Format::Splat => (export::Format::Model(Model::Splat), "model.splat"),
        cli::Format::Spz => (export::Format::Model(Model::Spz), "model.spz"),
        cli::Format::Glb => (export::Format::Model(Model::Glb), "model.glb"),
        cli::Format::Colmap => (export::Format::Colmap, "colmap"),
        cli::Format::Nerfstudio => (export::Format::Nerfstudio, "nerfstudio"),
    };
    let source = &arguments.source;
    let (exported, out) = if source.is_file() {
        let export::Format::Model(model) = format else {
            let message = format!("{}: {name} has views, expected a mission folder and not a file", source.display());
            return Err(exit::Refusal::usage(message));
        };
        let out = arguments.output.clone().unwrap_or_else(|| source.with_extension(model.extension()));
        (export::export_model(source, model, &out), out)
    } else {
        let folder = MissionFolder::open(source)?;
        let out = arguments.output.clone().unwrap_or_else(|| folder.root().join("export").join(name));
        if let Some(parent) = out.parent() {
            std::fs::create_dir_all(parent).map_err(|error| {
                let way_out = "give another place with --output";
                exit::Refusal::missing(format!("cannot make the folder {}: {error}; {way_out}", parent.display()))
            })?;
        }
        (export::export(&folder, format, &out), out)
    };
    let summary = exported.map_err(|error| match error {
        export::ExportError::Folder(error) => error.into(),
        usage @ (export::ExportError::NotAModel { .. } | export::ExportError::Itself { .. }) => {
            exit::Refusal::usage(usage.to_string())
        }
        other => exit::Refusal::failed(other.to_string()),
    })?;
    if let Some(degree) = summary.lost_sh_degree {
        say(&format!("vantage: {name} has no view-dependent colours: those of SH degree {degree} were left out"));
    }
    match summary.views {
        0 => print(&format!("{}: {} Gaussians\n", out.display(), summary.gaussians)),
        views => {
            let masks = if summary.masks > 0 { " with masks of the object" } else { "" };
            print(&format!("{}: {views} views{masks}, {} points\n", out.display(), summary.points))
        }
    }
}

/// Writes a line to standard error. Never fails: a terminal that has hung up is no reason to end a flight.
pub(crate) fn say(text: &str) {
    use std::io::Write as _;
    writeln!(std::io::stderr(), "{text}").ok();
}

/// Writes to standard output; a reader that has seen enough (`| head`) is no error.
pub(crate) fn print(text: &str) -> anyhow::Result<Exit> {
    print_on(text).map(|_| Exit::Ok)
}

/// As [`print`]; false where the reader has seen enough, so that whoever has more to say may stop.
pub(crate) fn print_on(text: &str) -> anyhow::Result<bool> {
    use std::io::Write as _;
    let mut output = std::io::stdout();
    match output.write_all(text.as_bytes()).and_then(|()| output.flush()) {
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(error.into()),
        Ok(()) => Ok(true),
    }
}

#[cfg(test)]
mod tests {
    use anyhow::Context as _;
    use shared_types::folder::FolderError;

    #[test]
    fn a_reason_is_told_once() {
        let source = std::io::Error::other("the disk is on fire");
        let error = FolderError::Io { action: "write", path: "a.ply".into(), source };
        let error = Err::<(), _>(error).context("exporting").expect_err("an error");
        assert_eq!(super::told(&error), "exporting: cannot write a.ply: the disk is on fire");
    }
}
