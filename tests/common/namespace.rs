//! A mount namespace with small file systems of its own: a full disk and a small /dev/shm for the real binary, seen by
//! nobody else. Needs no root where the kernel lets users make namespaces.

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

/// A namespace, as long as this lives.
#[derive(Debug)]
pub struct Namespace {
    holder: Child,
}

impl Namespace {
    /// Makes one with a tmpfs of so many bytes on each of these folders; `None`, with the reason printed, where this machine
    /// does not permit it.
    pub fn with(mounts: &[(&Path, u64)]) -> Option<Self> {
        let mounting: String = mounts
            .iter()
            .map(|(folder, bytes)| format!("mount -t tmpfs -o size={bytes},mode=1777 tmpfs '{}' && ", folder.display()))
            .collect();
        let started = Command::new("unshare")
            .args(["--user", "--map-root-user", "--mount", "sh", "-c"])
            .arg(format!("{mounting}echo ready && exec sleep 3600"))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn();
        let mut holder = match started {
            Ok(holder) => holder,
            Err(error) => {
                println!("skipped: unshare: {error}");
                return None;
            }
        };
        let mut line = String::new();
        let read = BufReader::new(holder.stdout.take().expect("piped")).read_line(&mut line);
        if read.is_ok() && line.trim() == "ready" {
            return Some(Self { holder });
        }
        let output = holder.wait_with_output().expect("waited");
        println!("skipped: no namespace with a small tmpfs here: {}", String::from_utf8_lossy(&output.stderr).trim());
        None
    }

    /// A command that runs inside.
    pub fn command(&self, program: impl AsRef<Path>) -> Command {
        let mut command = Command::new("nsenter");
        command.args(["--preserve-credentials", "--user", "--mount", "--target", &self.holder.id().to_string(), "--"]);
        command.arg(program.as_ref());
        command
    }

    /// Where a path inside is found from outside.
    pub fn seen(&self, path: &Path) -> PathBuf {
        Path::new("/proc")
            .join(self.holder.id().to_string())
            .join("root")
            .join(path.strip_prefix("/").expect("absolute"))
    }

    /// Fills the file system of a folder inside until so many bytes are left.
    pub fn fill(&self, folder: &Path, left_bytes: u64) {
        let mut filler = File::options().create(true).append(true).open(self.filler(folder)).expect("filler");
        while filler.write(&[0_u8; 1 << 12]).is_ok_and(|written| written > 0) {}
        let full = filler.metadata().expect("filler").len();
        filler.set_len(full.saturating_sub(left_bytes)).expect("cut");
    }

    /// Makes that room again.
    pub fn free(&self, folder: &Path) {
        fs::remove_file(self.filler(folder)).expect("freed");
    }

    fn filler(&self, folder: &Path) -> PathBuf {
        self.seen(folder).join("filler")
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        drop(self.holder.kill());
        drop(self.holder.wait());
    }
}
