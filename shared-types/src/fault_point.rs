//! Named instants at which a test makes a process die: between write and rename, with a loan in hand, after a reply is
//! computed and before it is sent.
//!
//! Only a build with the feature `fault-points` has them; in any other, [`reach`] is nothing, and the binary does not even
//! hold the variable's name. `VANTAGE_FAULT_POINT=SERVICE/POINT/COUNT/MARKER` kills the process of that service with SIGKILL
//! when it reaches the point for the COUNT-th time, unless the file MARKER exists: it is made just before, so that the
//! service, started again, lives, and so that the test sees that the point was reached.

/// Points and the services that a mission takes through them: (service, point, how often it is reached before it counts).
#[cfg(feature = "fault-points")]
pub const VISITED: [(&str, &str, u64); 20] = [
    ("camera", "file/unrenamed", 4),
    ("camera", "file/renamed", 4),
    ("camera", "loan/camera/keyframe", 2),
    ("camera", "reply/camera/capture/reply", 3),
    ("trainer", "loan/model/snapshot", 3),
    ("trainer", "file/unrenamed", 2),
    ("trainer", "file/renamed", 2),
    ("trainer", "reply/trainer/round/reply", 4),
    ("scorer", "reply/scorer/score/reply", 1),
    ("world", "reply/simulator/render/reply", 5),
    ("planner", "journal/appended", 2),
    ("planner", "journal/appended", 9),
    ("planner", "journal/unwritten", 12),
    ("planner", "loan/vehicle/target", 4),
    ("keeper", "channels/half-open", 1),
    ("px4-link", "vehicle/armed", 1),
    ("px4-link", "vehicle/offboard", 1),
    ("px4-link", "reply/vehicle/command/reply", 3),
    ("px4-link", "loan/vehicle/state", 500),
    ("px4-link", "file/unrenamed", 3),
];

/// This process is at a point, `kind/name`.
#[cfg(not(feature = "fault-points"))]
#[inline(always)]
pub fn reach(_kind: &'static str, _name: &'static str) {}

/// This process is at a point, `kind/name`.
#[cfg(feature = "fault-points")]
pub fn reach(kind: &'static str, name: &'static str) {
    use std::sync::OnceLock;
    use std::sync::atomic::{AtomicU64, Ordering};

    static WANTED: OnceLock<Option<Wanted>> = OnceLock::new();
    static REACHED: AtomicU64 = AtomicU64::new(0);
    let Some(wanted) = WANTED.get_or_init(Wanted::of_this_process) else { return };
    let is_it = wanted.point.strip_prefix(kind).and_then(|rest| rest.strip_prefix('/')) == Some(name);
    if is_it && REACHED.fetch_add(1, Ordering::Relaxed) + 1 >= wanted.count {
        let made = std::fs::File::options().write(true).create_new(true).open(&wanted.marker);
        if made.is_ok() {
            eprintln!("fault point {kind}/{name}: this process kills itself");
            let own = rustix::process::getpid();
            if let Err(error) = rustix::process::kill_process(own, rustix::process::Signal::KILL) {
                eprintln!("it cannot: {error}");
            }
        }
    }
}

#[cfg(feature = "fault-points")]
struct Wanted {
    point: String,
    count: u64,
    marker: std::path::PathBuf,
}

#[cfg(feature = "fault-points")]
impl Wanted {
    /// What the variable asks of the service that this process is.
    fn of_this_process() -> Option<Self> {
        let wanted = std::env::var("VANTAGE_FAULT_POINT").ok()?;
        let (service, rest) = wanted.split_once('/')?;
        if std::env::args().nth(1).as_deref() != Some(service) {
            return None;
        }
        // The marker is a path, and points have slashes too: COUNT is the first part that is a number.
        let parts: Vec<&str> = rest.split('/').collect();
        let at = parts.iter().position(|part| part.parse::<u64>().is_ok())?;
        let (point, rest) = parts.split_at_checked(at)?;
        let (count, marker) = rest.split_first()?;
        Some(Self { point: point.join("/"), count: count.parse().ok()?, marker: marker.join("/").into() })
    }
}
