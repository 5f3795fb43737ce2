//! What a hung process is doing, written down before it is killed.

use std::fmt::Write as _;
use std::fs;
use std::io::Read as _;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal};
use shared_types::ServiceName;

/// Longest time that a debugger gets to print stacks.
const DEBUGGER_PATIENCE: Duration = Duration::from_secs(5);

/// Reports on a process into `path` on a thread of its own, and kills it then where `kill`: also where the report fails.
pub(super) fn begin(service: ServiceName, pid: u32, path: PathBuf, kill: bool) {
    // Taken now, while the number is surely this process's.
    let handle = i32::try_from(pid).ok().and_then(Pid::from_raw).map(|pid| pidfd_open(pid, PidfdFlags::empty()));
    let work = move || {
        let report = format!("{service}, pid {pid}\n\n{}\n{}", threads_of(pid), stacks_of(pid));
        if let Err(error) = fs::write(&path, report) {
            tracing::warn!(%service, path = %path.display(), %error, "the report of a hung service could not be written");
        }
        if let (true, Some(Ok(process))) = (kill, &handle)
            && let Err(error) = pidfd_send_signal(process, Signal::KILL)
        {
            tracing::debug!(%service, %error, "could not kill");
        }
    };
    if let Err(error) = std::thread::Builder::new().name("autopsy".to_owned()).spawn(work) {
        tracing::warn!(%service, %error, "no thread for the report of a hung service; it is not killed either");
    }
}

/// Name, state and place in the kernel of every thread, as far as `/proc` tells.
fn threads_of(pid: u32) -> String {
    let mut text = String::from("thread, name, state, waits in the kernel, system call\n");
    let folder = PathBuf::from(format!("/proc/{pid}/task"));
    for task in fs::read_dir(folder).into_iter().flatten().flatten() {
        let read =
            |name: &str| fs::read_to_string(task.path().join(name)).map_or("?".to_owned(), |t| t.trim().to_owned());
        let status = read("status");
        let state = status.lines().find_map(|line| line.strip_prefix("State:")).unwrap_or("?").trim();
        let id = task.file_name();
        writeln!(text, "{}, {}, {state}, {}, {}", id.display(), read("comm"), read("wchan"), read("syscall")).ok();
        let stack = read("stack");
        if stack.len() > 1 {
            writeln!(text, "{stack}").ok();
        }
    }
    text
}

/// Stacks of all threads by gdb, or why there are none.
fn stacks_of(pid: u32) -> String {
    let mut command = Command::new("gdb");
    command.args(["-nx", "-batch", "-ex", "thread apply all bt 40", "-p", &pid.to_string()]);
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut child = match command.spawn() {
        Ok(child) => child,
        Err(error) => return format!("no stacks: gdb cannot be started ({error}); install gdb to have them\n"),
    };
    let Some(mut output) = child.stdout.take() else { return "no stacks: gdb gave no output\n".to_owned() };
    let reader = std::thread::spawn(move || {
        let mut text = Vec::new();
        output.read_to_end(&mut text).ok();
        text
    });
    let began = Instant::now();
    while matches!(child.try_wait(), Ok(None)) && began.elapsed() < DEBUGGER_PATIENCE {
        std::thread::sleep(Duration::from_millis(20));
    }
    // Too late or not, it must let go of the process.
    child.kill().ok();
    child.wait().ok();
    let text = reader.join().unwrap_or_default();
    if text.is_empty() {
        return "no stacks: gdb said nothing; it may not be permitted to attach\n".to_owned();
    }
    String::from_utf8_lossy(&text).into_owned()
}

#[cfg(test)]
mod tests {
    use std::os::unix::process::ExitStatusExt as _;

    use super::*;

    fn examined(kill: bool) -> (std::process::Child, String) {
        let folder = tempfile::tempdir().expect("folder");
        let child = Command::new("sleep").arg("60").spawn().expect("sleep runs");
        let path = folder.path().join("report.txt");
        begin(ServiceName::Trainer, child.id(), path.clone(), kill);
        let began = Instant::now();
        while fs::metadata(&path).map_or(0, |file| file.len()) == 0 {
            assert!(began.elapsed() < Duration::from_secs(30), "no report");
            std::thread::sleep(Duration::from_millis(10));
        }
        (child, fs::read_to_string(path).expect("report"))
    }

    #[test]
    fn a_hung_process_is_reported_on_and_killed() {
        let (mut child, report) = examined(true);
        // Its state may be any: on a busy disk it is still being loaded.
        assert!(
            report.starts_with("trainer, pid ") && report.contains(&format!("\n{}, sleep, ", child.id())),
            "{report}"
        );
        assert_eq!(child.wait().expect("ended").signal(), Some(9));
    }

    #[test]
    fn one_that_is_held_lives_on() {
        let (mut child, _) = examined(false);
        assert!(matches!(child.try_wait(), Ok(None)));
        child.kill().expect("killed");
        child.wait().expect("ended");
    }
}
