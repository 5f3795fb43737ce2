//! Processes that kill themselves at the instants that hurt: between write and rename, with a loan in hand, after a reply is
//! computed and before it is sent, between arming and takeoff.
//!
//! Only a build with these points visits them: `cargo test --release --features fault-points --test fault_points`.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

const VARIABLE: &str = "VANTAGE_FAULT_POINT";

/// The points are in a binary that was built for them, and in no other.
#[test]
fn the_plain_binary_has_no_fault_points() {
    let binary = std::fs::read(env!("CARGO_BIN_EXE_vantage")).expect("the binary");
    let has_them = binary.windows(VARIABLE.len()).any(|window| window == VARIABLE.as_bytes());
    assert_eq!(has_them, cfg!(feature = "fault-points"));
}

#[cfg(not(feature = "fault-points"))]
#[test]
#[ignore = "needs --features fault-points"]
fn a_mission_survives_a_death_at_every_fault_point() {
    panic!("this build has no fault points: cargo test --release --features fault-points --test fault_points");
}

#[cfg(feature = "fault-points")]
mod common;

#[cfg(feature = "fault-points")]
mod visits {
    use shared_types::fault_point::VISITED;

    use super::VARIABLE;
    use super::common::watch::Watch;
    use super::common::{Flight, journal, keyframes, metrics, vantage};

    /// Flies a mission for each point of a service, and expects it to complete with every keyframe once.
    fn visits(service: &str) {
        let points: Vec<_> = VISITED.into_iter().filter(|(of, ..)| *of == service).collect();
        assert!(!points.is_empty());
        for (_, point, count) in points {
            let base = tempfile::tempdir().expect("folder");
            let (folder, marker) = (base.path().join("mission"), base.path().join("reached"));
            let mut command = vantage();
            command.env(VARIABLE, format!("{service}/{point}/{count}/{}", marker.display()));
            command.args(["fly", "--preset", "tiny", "--seed", "21", "--output"]).arg(&folder);
            let flight = Flight::spawn(&folder, command);
            let watch = Watch::begin(flight.pid());
            flight.finish_well();
            let what = format!("{service} at {point} ({count})");
            assert!(marker.exists(), "{what}: never reached");
            let metrics = metrics(&folder);
            assert_eq!(metrics["mission"]["end_reason"], "complete", "{what}: {metrics:#}");
            assert_eq!(metrics["mission"]["restarts"][service], 1, "{what}: {metrics:#}");
            assert_eq!(metrics["mission"]["collisions"], 0, "{what}");
            assert_eq!(keyframes(&folder), (0..6).collect::<Vec<u64>>(), "{what}");
            let mut taken: Vec<u64> = journal(&folder)
                .iter()
                .filter(|entry| entry["event"] == "captured")
                .filter_map(|entry| entry["keyframe_id"].as_u64())
                .collect();
            let all = taken.len();
            taken.sort_unstable();
            taken.dedup();
            assert_eq!(taken.len(), all, "{what}: a keyframe twice in the journal");
            let step_m = watch.look(|heard| heard.largest_step_m);
            assert!(step_m <= 0.3, "{what}: a setpoint jumped by {step_m} m");
        }
    }

    #[test]
    fn the_camera() {
        visits("camera");
    }

    #[test]
    fn the_trainer() {
        visits("trainer");
    }

    #[test]
    fn the_scorer() {
        visits("scorer");
    }

    #[test]
    fn the_world() {
        visits("world");
    }

    #[test]
    fn the_planner() {
        visits("planner");
    }

    #[test]
    fn the_keeper() {
        visits("keeper");
    }

    #[test]
    fn px4_link() {
        visits("px4-link");
    }
}
