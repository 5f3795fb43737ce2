//! Watches members' processes by pidfd, so that a death is seen at once.

use std::collections::BTreeMap;
use std::os::fd::{AsFd as _, BorrowedFd, OwnedFd};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{Pid, PidfdFlags, pidfd_open};

/// The processes of the members' present lives.
#[derive(Debug, Default)]
pub struct Watch {
    /// By service code: incarnation, and the process; `None` where it could not be watched.
    lives: BTreeMap<u32, (u64, Option<OwnedFd>)>,
}

impl Watch {
    /// Watches these (code, incarnation, pid); gives those that are gone already.
    pub fn follow(&mut self, processes: impl Iterator<Item = (u32, u64, u32)>) -> Vec<(u32, u64)> {
        let mut gone = Vec::new();
        for (code, incarnation, pid) in processes {
            if self.lives.get(&code).is_some_and(|(known, _)| *known == incarnation) {
                continue;
            }
            let pid = i32::try_from(pid).ok().and_then(Pid::from_raw);
            let fd = match pid.map(|pid| pidfd_open(pid, PidfdFlags::empty())) {
                Some(Ok(fd)) => Some(fd),
                Some(Err(rustix::io::Errno::SRCH)) => {
                    gone.push((code, incarnation));
                    None
                }
                // Without a pidfd the member is still found out by standing still.
                Some(Err(_)) | None => None,
            };
            self.lives.insert(code, (incarnation, fd));
        }
        gone
    }

    /// Processes that have ended since the last call.
    pub fn ended(&mut self) -> Vec<(u32, u64)> {
        let mut ended = Vec::new();
        for (&code, (incarnation, fd)) in &mut self.lives {
            if fd.as_ref().is_some_and(readable) {
                ended.push((code, *incarnation));
                *fd = None;
            }
        }
        ended
    }

    /// Descriptors to wait on: readable when a process ends.
    pub fn fds(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.lives.values().filter_map(|(_, fd)| fd.as_ref().map(|fd| fd.as_fd()))
    }
}

fn readable(fd: &OwnedFd) -> bool {
    let mut watched = [PollFd::new(fd, PollFlags::IN)];
    let now = Timespec { tv_sec: 0, tv_nsec: 0 };
    poll(&mut watched, Some(&now)).is_ok_and(|n| n > 0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::Command;

    #[test]
    fn a_process_that_ends_is_told_once_and_a_missing_one_at_once() {
        let mut child = Command::new("sleep").arg("60").spawn().expect("sleep runs");
        let pid = child.id();
        let mut watch = Watch::default();
        assert!(watch.follow([(4, 1, pid)].into_iter()).is_empty());
        assert!(watch.ended().is_empty());
        child.kill().expect("killed");
        child.wait().expect("waited for");
        assert_eq!(watch.ended(), [(4, 1)]);
        assert!(watch.ended().is_empty());
        assert_eq!(watch.follow([(4, 2, pid)].into_iter()), [(4, 2)], "its number is free now");
    }
}
