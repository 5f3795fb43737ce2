//! The mission folder and the system folder: journal, keyframes, configuration, and what px4-link keeps.

use std::hint::black_box;
use std::path::Path;

use planner::io::{Inputs, Views};
use planner::journal::{Entry, Record, Shot, parse};
use planner::ledger::Ledger;
use planner::logic::depth::DepthView;
use planner::mission::{Mission, Setup};
use px4_link::path::{Limits, Path as FlightPath, Point, rest_from};
use px4_link::store::{Store, WayBack};
use shared_types::config::{Config, Layer, load};
use shared_types::folder::keyframe::read_view_folder;
use shared_types::folder::{Exposure, Frame, Gate, Keyframe, MissionFolder};
use shared_types::frames::{Intrinsics, look_at};
use shared_types::messages::{EndReason, FrameView, KeyframeReason, VehicleCommand};
use tempfile::TempDir;

use crate::seal::{join, png, split};

struct NoViews;

impl Views for NoViews {
    fn read(&mut self, _reason: KeyframeReason, _keyframe_id: u64) -> Option<(DepthView, bool)> {
        None
    }
}

/// A mission that goes on after a journal: a few turns without anybody else.
pub fn journal(data: &[u8]) {
    let Ok((entries, good)) = parse(data, Path::new("journal.jsonl")) else { return };
    assert!(good <= data.len());
    let ledger = Ledger::replay(&entries);
    let config = Config::default();
    let setup = Setup {
        planner: config.planner,
        camera: config.camera,
        mission_id: "m".to_owned(),
        folder: "/m".to_owned(),
        seed: 1,
        epoch_ns: 0,
    };
    let mut mission = Mission::new(setup, &entries);
    for turn in 0..3 {
        let now_ns = ledger.last_ns.saturating_add(1_000_000_000 + turn * 10_000_000);
        let inputs = Inputs { vehicle: Some(vehicle(now_ns)), ..Inputs::default() };
        mission.step(now_ns, inputs, &mut NoViews);
    }
}

/// In the air at the start of the survey.
fn vehicle(now_ns: u64) -> shared_types::messages::VehicleState {
    use shared_types::messages::{Commander, FlightMode, VehicleState};
    VehicleState {
        incarnation: 1,
        position_stamp_ns: now_ns,
        attitude_stamp_ns: now_ns,
        gimbal_stamp_ns: now_ns,
        position_m: [3.0, 0.0, 2.0],
        setpoint_position_m: [3.0, 0.0, 2.0],
        world_from_body_xyzw: [0.0, 0.0, 0.0, 1.0],
        world_from_gimbal_xyzw: [0.0, 0.0, 0.0, 1.0],
        gimbal_pitch_min_rad: -2.3,
        gimbal_pitch_max_rad: 0.8,
        battery_fraction: 0.9,
        mode: FlightMode::Offboard.code(),
        commander: Commander::Vantage.code(),
        armed: 1,
        ready: 1,
        armable: 1,
        gimbal_present: 1,
        streaming: 1,
        ..VehicleState::default()
    }
}

/// The parts of a mission: before it flies, with a prior, and to its end.
pub fn journal_seeds() -> Vec<Vec<u8>> {
    let shot = |keyframe_id, candidate| Shot {
        keyframe_id,
        reason: KeyframeReason::Seed,
        candidate,
        position_m: [2.0, 0.0, 1.5],
        look_at_m: [0.0, 0.0, 0.6],
        score: 0.7,
    };
    let prior = serde_json::json!({
        "event": "prior",
        "prior": {"center_m": [0.0, 0.0, 0.7], "size_m": 1.6, "ground": {"slope": [0.0, 0.0], "offset_m": 0.0},
            "extents_m": [1.2, 1.1, 1.3], "clamped": false},
        "pitch_limits_rad": [-2.3, 0.8], "candidates": 64, "left_out": [3, 0, 1]
    });
    let records = [
        Record::Started { mission_id: "m".to_owned(), seed: 1 },
        Record::Command { command: VehicleCommand::Takeoff, altitude_m: 2.5 },
        Record::Airborne { home_m: [3.0, 0.0, 0.0] },
        Record::Target { purpose: "survey".to_owned(), keyframe_id: None, path: vec![[0.0; 6]], back: vec![[0.0; 6]] },
        Record::Scan,
        Record::Survey { point_m: [0.1, 0.0, 0.0] },
        Record::Selected {
            batch: 0,
            generation: 0,
            uncertainty_p95: 0.0,
            shots: vec![shot(0, 4), shot(1, 9)],
            scores: Vec::new(),
        },
        Record::Capture { shot: shot(0, 4), target: 4, deadline_ns: 90_000_000_000 },
        Record::Captured { keyframe_id: 0, stamp_ns: 9, gate_missed: false, position_m: [2.0, 0.0, 1.5] },
        Record::CaptureFailed { keyframe_id: 1, why: "world gone".to_owned() },
        Record::Dropped { keyframe_id: 1, candidate: 9, why: "unreachable".to_owned() },
        Record::Round { round: 0, views: 1, max_iterations: 750 },
        Record::RoundDone { round: 0, generation: 9, iterations: 700, total_iterations: 700, psnr_train_db: 25.0 },
        Record::Score { batch: 1, generation: 9, free: vec![1, 2, 3], visited_m: vec![[2.0, 0.0, 1.5]] },
        Record::Suspended,
        Record::GoOn,
        Record::Ending { reason: EndReason::Complete, land_here: false },
        Record::Landed,
        Record::Over { reason: EndReason::Complete, usable: true },
    ];
    let text = |lines: &[serde_json::Value]| {
        let numbered = lines.iter().zip(1..).map(|(line, id): (_, u64)| {
            let mut line = line.clone();
            line["id"] = id.into();
            line["now_ns"] = (id * 1_000_000_000).into();
            format!("{line}\n")
        });
        numbered.collect::<String>().into_bytes()
    };
    let value = |record: &Record| {
        serde_json::to_value(Entry { id: 0, now_ns: 0, record: record.clone() })
            .unwrap_or_else(|error| panic!("{error}"))
    };
    let whole: Vec<_> = records.iter().map(value).collect();
    let with_prior: Vec<_> = whole[..3].iter().chain([&prior]).chain(&whole[6..13]).cloned().collect();
    vec![text(&whole), text(&whole[..3]), text(&with_prior[..4]), text(&with_prior)]
}

thread_local! {
    static FOLDER: TempDir =
        TempDir::new_in("/dev/shm").or_else(|_full| TempDir::new()).unwrap_or_else(|error| panic!("{error}"));
}

/// The three files of a keyframe.
pub fn keyframe(data: &[u8]) {
    let [json, rgb, depth] = split(data);
    FOLDER.with(|folder| {
        for (name, bytes) in [("frame.json", json), ("rgb.png", &png(rgb)), ("depth.png", &png(depth))] {
            std::fs::write(folder.path().join(name), bytes).unwrap_or_else(|error| panic!("{name}: {error}"));
        }
        let Ok(view) = read_view_folder(folder.path()) else { return };
        let header = view.frame.header();
        let mut items = vec![0; header.items_len()];
        view.fill_items(&mut items);
        assert!(FrameView::new(&header, &items).is_some(), "a keyframe that no reader takes: {header:?}");
        assert!(view.depth_m().iter().all(|depth| depth.is_finite()), "depths that are not finite");
    });
}

/// A keyframe as the camera writes it.
pub fn keyframe_seeds() -> Vec<Vec<u8>> {
    let (width, height) = (8, 6);
    let pose = look_at(glam::DVec3::new(2.0, 0.5, 1.5), glam::DVec3::new(0.0, 0.0, 0.5));
    let keyframe = Keyframe {
        frame: Frame {
            id: 1,
            stamp_ns: 12_000_000_000,
            reason: KeyframeReason::Selected,
            candidate: Some(3),
            target_id: 7,
            look_at_m: [0.0, 0.0, 0.5],
            world_from_camera_position_m: pose.position_m.to_array(),
            world_from_camera_xyzw: pose.rotation.to_array(),
            intrinsics: Intrinsics::from_hfov(width, height, 1.2),
            depth_unit_m: 0.0002,
            gate: Gate::default(),
            exposure: Exposure::default(),
        },
        rgb: (0..width * height * 3).map(|i| i.to_le_bytes()[0]).collect(),
        depth_units: (0..width * height).map(|i| u16::try_from(100 * i).unwrap_or(0)).collect(),
    };
    let written = || -> Result<Vec<u8>, Box<dyn std::error::Error>> {
        let folder = TempDir::new()?;
        let path = MissionFolder::create(folder.path().join("m"))?.write_keyframe(&keyframe)?;
        let file = |name: &str| std::fs::read(path.join(name));
        Ok(join([&file("frame.json")?, &file("rgb.png")?, &file("depth.png")?]))
    };
    vec![written().unwrap_or_else(|error| panic!("{error}"))]
}

/// A configuration file, or where it is one line a `--set`; what is accepted is written and read again.
pub fn config(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else { return };
    let layer = match text.strip_prefix("--set ") {
        Some(argument) => match Layer::of_set(argument) {
            Ok(layer) => layer,
            Err(_) => return,
        },
        None => Layer { name: "mission.toml".to_owned(), text: text.to_owned(), has_lines: true },
    };
    let Ok(config) = load(&[layer]) else { return };
    // Numbers of more than 63 bits have no place in TOML.
    let Ok(text) = shared_types::config::load::to_toml(&config) else { return };
    let again = load(&[Layer { name: "again".to_owned(), text, has_lines: true }]);
    let again = again.unwrap_or_else(|error| panic!("what was accepted is refused when it is read again: {error}"));
    assert_eq!(again, config);
}

/// Every preset as it is written into a mission folder, and settings of the command line.
pub fn config_seeds() -> Vec<Vec<u8>> {
    let mut seeds: Vec<Vec<u8>> = ["tiny", "paper"]
        .iter()
        .filter_map(|name| shared_types::config::preset(name).ok())
        .filter_map(|config| shared_types::config::load::to_toml(&config).ok())
        .map(String::into_bytes)
        .collect();
    for text in [
        "[clock]\nspeed = 2.0\nmode = \"wall\"\n",
        "--set planner.strategy=orbit24",
        "--set world.size_m=1.5",
        "--set simulator.params=[[\"MPC_XY_VEL_MAX\", 3.0]]",
    ] {
        seeds.push(text.as_bytes().to_vec());
    }
    seeds
}

/// What px4-link keeps in the system folder, and the path that it would fly home by it.
pub fn way_back(data: &[u8]) {
    let [kept, way] = split(data);
    FOLDER.with(|folder| {
        for (name, bytes) in [("px4-link.json", kept), ("px4-link-return.json", way)] {
            std::fs::write(folder.path().join(name), bytes).unwrap_or_else(|error| panic!("{name}: {error}"));
        }
        let store = Store::new(folder.path());
        black_box(store.kept());
        let limits = Limits::new(&shared_types::config::LinkConfig::default());
        let waypoints = store.way_back(&limits).waypoints();
        let here = glam::DVec3::new(1.0, 2.0, 3.0);
        if let Some((rest, distance_m)) = rest_from(&waypoints, here)
            && distance_m <= 1.5
        {
            let start = Point { position_m: here, ..Point::default() };
            let path = FlightPath::new(start, &rest, &limits);
            let plan = px4_link::setpoint::plan(&path, &limits);
            assert!(plan.duration_s.is_finite() && path.end().is_finite(), "a way back of {} s", plan.duration_s);
        }
    });
}

/// As px4-link writes them.
pub fn way_back_seeds() -> Vec<Vec<u8>> {
    let way = WayBack {
        points: vec![[1.0, 2.0, 3.0, 0.0, -0.5, 1.0], [2.0, 2.0, 3.0, 1.0, -0.2, 0.5], [0.0, 0.0, 2.5, 3.0, 0.0, 1.0]],
    };
    let written = || -> Result<Vec<u8>, Box<dyn std::error::Error>> {
        let folder = TempDir::new()?;
        let store = Store::new(folder.path());
        store.keep(&px4_link::store::Kept { ours: true, last_target_id: 9, ..Default::default() });
        store.keep_way_back(&way);
        let file = |name: &str| std::fs::read(folder.path().join(name));
        Ok(join([&file("px4-link.json")?, &file("px4-link-return.json")?]))
    };
    vec![written().unwrap_or_else(|error| panic!("{error}"))]
}
