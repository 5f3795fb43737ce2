//! What must outlive px4-link: the checked way back, and whose vehicle it was. Small files in the system folder, whole or
//! absent.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use shared_types::folder::write_atomic;
use shared_types::messages::{FlightMode, Waypoint};

use crate::frames::KeptTransform;
use crate::path::{Limits, Path, Point};
use crate::setpoint::LONGEST_S;

/// The way home from the last target: its path, then the way back from its end.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct WayBack {
    /// Each: x, y, z, yaw, gimbal pitch, speed.
    pub points: Vec<[f64; 6]>,
}

impl WayBack {
    /// Of waypoints.
    #[must_use]
    pub fn of(waypoints: &[Waypoint]) -> Self {
        let points = waypoints
            .iter()
            .map(|w| [w.position_m[0], w.position_m[1], w.position_m[2], w.yaw_rad, w.gimbal_pitch_rad, w.speed_mps])
            .collect();
        Self { points }
    }

    /// Whether its whole path is one that can be planned: a file of this name may hold anything, and a path of years would
    /// take all memory while the vehicle waits for it in the air.
    #[must_use]
    pub fn can_be_flown(&self, limits: &Limits) -> bool {
        let waypoints = self.waypoints();
        let start = waypoints.first().map(Point::of).unwrap_or_default();
        waypoints.len() == self.points.len() && Path::new(start, &waypoints, limits).total_s() <= 2.0 * LONGEST_S
    }

    /// The same places in a world that was moved.
    pub fn shift(&mut self, by_m: glam::DVec3) {
        for point in &mut self.points {
            for (value, by) in point.iter_mut().zip(by_m.to_array()) {
                *value += by;
            }
        }
    }

    /// As waypoints; those with numbers that are not finite are left out.
    #[must_use]
    pub fn waypoints(&self) -> Vec<Waypoint> {
        self.points
            .iter()
            .filter(|p| p.iter().all(|v| v.is_finite()))
            .map(|&[x, y, z, yaw_rad, gimbal_pitch_rad, speed_mps]| Waypoint {
                position_m: [x, y, z],
                yaw_rad,
                gimbal_pitch_rad,
                speed_mps,
            })
            .collect()
    }
}

/// What is remembered of the flight.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Kept {
    /// World from local.
    pub transform: KeptTransform,
    /// Whether the vehicle flew by our command.
    pub ours: bool,
    /// The mode that we last commanded.
    pub expected: FlightMode,
    /// The mode before that, until the commanded one was seen.
    pub before_expected: FlightMode,
    /// Arming was commanded, or is waited for, and not yet seen: who finds the vehicle armed on the ground need not ask by
    /// whom.
    pub arming: bool,
    /// A flight of ours was not yet followed by Hold on the ground.
    pub flown: bool,
    /// The mission of the last target: ids count within a mission.
    pub mission: u64,
    /// Ids up to this one were seen as targets of that mission.
    pub last_target_id: u64,
}

impl Default for Kept {
    fn default() -> Self {
        Self {
            transform: KeptTransform::default(),
            ours: false,
            expected: FlightMode::Unknown,
            before_expected: FlightMode::Unknown,
            arming: false,
            flown: false,
            mission: 0,
            last_target_id: 0,
        }
    }
}

impl Kept {
    /// Whether a vehicle in this mode flies as we last told it to: in the mode that we commanded, in the one before it
    /// while that command was not seen to be obeyed, or holding after our takeoff.
    #[must_use]
    pub fn commanded(&self, mode: FlightMode) -> bool {
        self.ours
            && (mode == self.expected
                || mode == self.before_expected
                || (self.expected == FlightMode::Takeoff && mode == FlightMode::Hold))
    }
}

/// The files.
#[derive(Debug, Clone)]
pub struct Store {
    folder: PathBuf,
}

impl Store {
    /// Files in this folder.
    #[must_use]
    pub fn new(folder: &std::path::Path) -> Self {
        Self { folder: folder.to_owned() }
    }

    fn read<T: Default + serde::de::DeserializeOwned>(&self, name: &str) -> T {
        let path = self.folder.join(name);
        let Ok(text) = std::fs::read_to_string(&path) else { return T::default() };
        serde_json::from_str(&text).unwrap_or_else(|error| {
            tracing::warn!(path = %path.display(), %error, "left out: cannot be read");
            T::default()
        })
    }

    fn write<T: Serialize>(&self, name: &str, value: &T) {
        let path = self.folder.join(name);
        let written = serde_json::to_vec(value)
            .map_err(|error| error.to_string())
            .and_then(|bytes| write_atomic(&path, &bytes).map_err(|error| error.to_string()));
        if let Err(error) = written {
            tracing::warn!(path = %path.display(), error, "cannot be written; a restart would not know it");
        }
    }

    /// The last way back; empty when there is none, or none that can be flown.
    #[must_use]
    pub fn way_back(&self, limits: &Limits) -> WayBack {
        let way: WayBack = self.read("px4-link-return.json");
        if !way.can_be_flown(limits) {
            let path = self.folder.join("px4-link-return.json");
            tracing::warn!(path = %path.display(), points = way.points.len(), "left out: no path that can be flown");
            return WayBack::default();
        }
        way
    }

    /// Keeps a way back.
    pub fn keep_way_back(&self, way: &WayBack) {
        self.write("px4-link-return.json", way);
    }

    /// What is remembered of the flight.
    #[must_use]
    pub fn kept(&self) -> Kept {
        self.read("px4-link.json")
    }

    /// Remembers.
    pub fn keep(&self, kept: &Kept) {
        self.write("px4-link.json", kept);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_kept_is_read_again_and_torn_files_are_left_out() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = Store::new(folder.path());
        assert_eq!(store.kept(), Kept::default());
        let kept = Kept { ours: true, last_target_id: 9, ..Kept::default() };
        store.keep(&kept);
        store.keep_way_back(&WayBack { points: vec![[1.0, 2.0, 3.0, 0.0, -0.5, 1.0]] });
        let limits = Limits::new(&shared_types::config::LinkConfig::default());
        assert_eq!((store.kept(), store.way_back(&limits).waypoints().len()), (kept, 1));
        // A flight of centuries, and numbers that JSON has and f64 has not.
        store.keep_way_back(&WayBack { points: vec![[0.0; 6], [1e12, 0.0, 0.0, 0.0, 0.0, 1.0]] });
        assert_eq!(store.way_back(&limits), WayBack::default());
        std::fs::write(folder.path().join("px4-link-return.json"), b"{\"points\":[[1e999,0,0,0,0,1]]}")
            .expect("written");
        assert_eq!(store.way_back(&limits), WayBack::default());
        std::fs::write(folder.path().join("px4-link.json"), b"{\"ours\":tr").expect("written");
        assert_eq!(store.kept(), Kept::default());
        std::fs::write(folder.path().join("px4-link.json"), b"{\"last_target_id\":3}").expect("written");
        assert_eq!(store.kept().last_target_id, 3, "a file of an older version");
    }

    #[test]
    fn a_loss_of_power_leaves_the_old_or_the_new() {
        use shared_types::storage::record::Recorder;
        use shared_types::storage::{mount, replay::every_outcome};

        let folder = tempfile::tempdir_in("/dev/shm").expect("tmpfs");
        let store = Store::new(folder.path());
        let kept = |id| Kept { ours: true, last_target_id: id, ..Kept::default() };
        let way = |x| WayBack { points: vec![[x, 2.0, 3.0, 0.0, -0.5, 1.0]; 4] };
        store.keep(&kept(1));
        store.keep_way_back(&way(1.0));
        let recorder = Recorder::new(folder.path()).expect("read");
        let mounted = mount(folder.path(), std::sync::Arc::new(recorder.clone()));
        store.keep(&kept(2));
        store.keep_way_back(&way(2.0));
        drop(mounted);
        let after = folder.path().join("after");
        let findings = every_outcome(&recorder.trace(), &after, |root| {
            let store = Store::new(root);
            match (store.kept(), store.way_back(&Limits::new(&shared_types::config::LinkConfig::default()))) {
                (a, b) if a == kept(1) && b == way(1.0) => Ok("old"),
                (a, b) if a == kept(2) && b == way(1.0) => Ok("between"),
                (a, b) if a == kept(2) && b == way(2.0) => Ok("new"),
                other => Err(format!("{other:?}")),
            }
        })
        .expect("one after the other");
        println!("px4-link's files: {} cuts, {} outcomes: {:?}", findings.places, findings.distinct, findings.by_name);
        assert_eq!(findings.by_name.len(), 3, "{findings:?}");
    }

    #[test]
    fn only_the_mode_that_we_commanded_is_ours() {
        use FlightMode::{Hold, Offboard, Takeoff};
        let of = |expected, before_expected| Kept { ours: true, expected, before_expected, ..Kept::default() };
        assert!(of(Hold, Hold).commanded(Hold) && of(Takeoff, Takeoff).commanded(Hold));
        assert!(!of(Offboard, Offboard).commanded(Hold), "an operator's Hold");
        assert!(of(Offboard, Hold).commanded(Hold), "OFFBOARD was commanded and not yet seen");
        assert!(!Kept { ours: false, ..of(Hold, Hold) }.commanded(Hold));
    }
}
