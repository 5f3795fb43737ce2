use super::*;
use crate::payload::pack_text;

fn state() -> VehicleState {
    VehicleState { world_from_body_xyzw: [0.0, 0.0, 0.0, 1.0], ..VehicleState::default() }
}

fn field<I, H: Check<I>>(header: &H, items: &[I]) -> &'static str {
    header.check(items).expect_err("refused").field
}

#[test]
fn what_steers_the_vehicle_must_be_finite_and_of_this_world() {
    assert_eq!(state().check(&[]), Ok(()));
    for wild in [f64::NAN, f64::INFINITY, -1e9] {
        assert_eq!(field(&VehicleState { position_m: [0.0, wild, 0.0], ..state() }, &[]), "position_m");
        assert_eq!(field(&VehicleState { wind_mps: [wild, 0.0, 0.0], ..state() }, &[]), "wind_mps");
        assert_eq!(field(&CommandRequest { altitude_m: wild, ..CommandRequest::default() }, &[]), "altitude_m");
    }
    assert_eq!(field(&VehicleState { world_from_body_xyzw: [3.0; 4], ..state() }, &[]), "world_from_body_xyzw");
    assert_eq!(field(&VehicleState { battery_fraction: f64::NAN, ..state() }, &[]), "battery_fraction");
    assert_eq!(field(&VehicleState { mode: 99, ..state() }, &[]), "mode");
    assert_eq!(field(&VehicleState { armed: 2, ..state() }, &[]), "armed");
    assert_eq!(field(&VehicleState { position_stamp_ns: u64::MAX, ..state() }, &[]), "position_stamp_ns");
    assert_eq!(field(&state(), &[7]), "items");
}

#[test]
fn a_path_is_as_long_as_it_says() {
    let target = VehicleTarget { id: 1, path_len: 1, return_len: 1, ..VehicleTarget::default() };
    let waypoint = Waypoint { speed_mps: 1.0, ..Waypoint::default() };
    assert_eq!(target.check(&[waypoint; 2]), Ok(()));
    assert_eq!(field(&target, &[waypoint; 3]), "path_len + return_len");
    let both = VehicleTarget { path_len: u32::MAX, return_len: u32::MAX, ..target };
    assert_eq!(field(&both, &[waypoint; 2]), "path_len + return_len");
    assert_eq!(field(&target, &[waypoint, Waypoint { yaw_rad: f64::NAN, ..waypoint }]), "a waypoint");
}

#[test]
fn an_image_has_the_bytes_that_its_sides_ask_for() {
    let frame = FrameHeader {
        world_from_camera_xyzw: [0.0, 0.0, 0.0, 1.0],
        focal_px: [4.0; 2],
        principal_px: [2.0; 2],
        depth_unit_m: 0.001,
        width: 4,
        height: 2,
        has_color: 1,
        ..FrameHeader::default()
    };
    assert_eq!(frame.check(&[0; 40]), Ok(()));
    for (wrong, bytes) in [
        (frame, 39),
        (FrameHeader { width: 0, ..frame }, 0),
        (FrameHeader { width: u32::MAX, height: u32::MAX, ..frame }, 40),
        (FrameHeader { focal_px: [0.0; 2], ..frame }, 40),
        (FrameHeader { has_color: 7, ..frame }, 40),
    ] {
        assert_eq!(field(&wrong, &vec![0; bytes]), "width, height, has_color, bytes");
    }
    let reply = RenderReply { depth_unit_m: 0.001, status: 1, width: 4, height: 2, ..RenderReply::default() };
    assert_eq!(reply.check(&[0; 16]), Ok(()));
    assert_eq!(field(&RenderReply { width: u32::MAX, height: u32::MAX, ..reply }, &[0; 16]), "width, height");
    assert_eq!(field(&RenderReply { depth_unit_m: 0.0, ..reply }, &[0; 16]), "depth_unit_m");
    assert_eq!(field(&RenderReply { status: 2, ..reply }, &[0; 16]), "items");
}

#[test]
fn a_mission_folder_is_a_path() {
    let mission = MissionState { folder: pack_text("/missions/a"), ..MissionState::default() };
    assert_eq!(mission.check(&[]), Ok(()));
    assert_eq!(field(&MissionState { folder: pack_text("../etc"), ..mission }, &[]), "folder");
    assert_eq!(field(&MissionState { folder: [0xff; 256], ..mission }, &[]), "folder");
    assert_eq!(field(&mission, &[CandidateState { status: 9, ..CandidateState::default() }]), "status of a candidate");
}

#[test]
fn scores_are_as_many_as_are_announced_and_finite() {
    let reply = ScoreReply { status: ScoreStatus::Done.code(), candidates: 1, ..ScoreReply::default() };
    assert_eq!(reply.check(&[CandidateScore::default()]), Ok(()));
    assert_eq!(field(&reply, &[]), "candidates");
    assert_eq!(field(&reply, &[CandidateScore { score: f64::NAN, ..CandidateScore::default() }]), "a score");
}

#[test]
fn a_fault_names_field_value_and_what_was_expected() {
    let grant = ClockGrant { service: 5, pid: 0, ..ClockGrant::default() };
    assert_eq!(grant.check(&[]).expect_err("no process").to_string(), "pid is 0; expected a process");
    let health = Health { state: 77, ..Health::default() };
    let error = Check::<Health>::check(&Health::default(), &[health]).expect_err("no state");
    assert_eq!(error.to_string(), "state is 77; expected a code of this version");
}
