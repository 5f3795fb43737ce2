//! Writes the man pages and the shell completions of every command, made from the commands themselves.
//!
//! ```text
//! cargo run --release -p launch --example manuals -- target/manuals
//! ```

use std::fs;
use std::path::PathBuf;

use clap::CommandFactory as _;
use clap_complete::Shell;
use launch::cli::Cli;

fn main() -> anyhow::Result<()> {
    let folder = std::env::args_os().nth(1).map_or_else(|| PathBuf::from("target/manuals"), PathBuf::from);
    let (pages, completions) = (folder.join("man"), folder.join("completions"));
    for made in [&pages, &completions] {
        if made.exists() {
            fs::remove_dir_all(made)?;
        }
        fs::create_dir_all(made)?;
    }
    clap_mangen::generate_to(Cli::command(), &pages)?;
    for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
        clap_complete::generate_to(shell, &mut Cli::command(), "vantage", &completions)?;
    }
    let counted = fs::read_dir(&pages)?.count() + fs::read_dir(&completions)?.count();
    println!("{counted} files in {}", folder.display());
    Ok(())
}
