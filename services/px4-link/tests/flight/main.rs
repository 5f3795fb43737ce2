//! Whole flights: the link without sockets against the simulated autopilot, tick by tick.

#![expect(clippy::expect_used, reason = "a test that cannot be set up has failed")]

mod chances;
mod hands;
mod rig;
mod silence;

use glam::DVec3;
use px4_link::commands::set_mode;
use px4_link::logic::command_long;
use px4_link::mavlink_io::{decode, encode};
use px4_link::state::Phase;
use rig::{Rig, at, rig};
use shared_types::bus::ReplyAddress;
use shared_types::config::LinkConfig;
use shared_types::messages::{
    CommandRequest, CommandStatus, Commander, FlightMode, TargetStatus, VehicleCommand, VehicleTarget, Waypoint,
};
use simulator::simulator::LinkId;
use simulator::vehicle::VehicleConfig;

#[test]
fn a_whole_flight_twice() {
    let mut rig = rig();
    for flight in 1..=2u64 {
        rig.take_off();
        rig.target(flight * 10, &[at(3.0, 0.0, 2.5, 1.0, -0.4), at(3.0, 3.0, 3.0, -2.5, -0.4)]);
        rig.until("arrived", 40, |rig| rig.state().target_status == TargetStatus::Arrived.code());
        // PX4's position loop settles with a time constant of a second.
        rig.seconds(5);
        let (state, truth) = (rig.state(), rig.simulator.truth());
        assert_eq!((state.target_id, state.target_progress), (flight * 10, 1.0));
        assert!(truth.position_m.distance(DVec3::new(3.0, 3.0, 3.0)) < 0.15, "{}", truth.position_m);
        assert!(
            DVec3::from_array(state.position_m).distance(truth.position_m) < 0.02,
            "the state is the truth, estimator exact"
        );
        let axis = glam::DQuat::from_array(state.world_from_gimbal_xyzw) * DVec3::X;
        assert!((axis - truth.world_from_gimbal * DVec3::X).length() < 0.02, "{axis}");
        assert!((axis.z.asin() + 0.4).abs() < 0.02 && (axis.y.atan2(axis.x) + 2.5).abs() < 0.05, "{axis}");
        assert_eq!(state.commander, Commander::Vantage.code());
        assert!(rig.now_ns - state.position_stamp_ns <= 20_000_000, "stamps are the mission's time");
        rig.command(VehicleCommand::Return, 90);
        assert!(rig.simulator.truth().position_m.truncate().length() < 0.4, "home by the way back");
        assert_eq!((rig.state().armed, rig.state().commander), (0, Commander::Nobody.code()));
        rig.seconds(3);
    }
}

#[test]
fn the_vehicle_keeps_near_the_path() {
    let mut rig = rig();
    rig.take_off();
    rig.target(1, &[at(3.0, 0.0, 2.5, 0.0, 0.0)]);
    rig.until("arrived", 40, |rig| rig.state().target_status == TargetStatus::Arrived.code());
    let arc: Vec<Waypoint> = (1..=40)
        .map(|i| f64::from(i) * 0.0785)
        .map(|a| at(3.0 * a.cos(), 3.0 * a.sin(), 2.5, a + core::f64::consts::PI, -0.3))
        .collect();
    let begun = rig.path.len();
    rig.target(2, &arc);
    rig.until("flown", 60, |rig| {
        rig.state().target_id == 2 && rig.state().target_status == TargetStatus::Arrived.code()
    });
    let worst = rig.path[begun..].iter().map(|at| (at.truncate().length() - 3.0).abs()).fold(0.0, f64::max);
    eprintln!(
        "half a circle of 3 m: radial error at most {worst:.3} m, {:.1} s",
        (rig.path.len() - begun) as f64 * 0.01
    );
    assert!(worst < 0.3, "{worst} m");
}

#[test]
fn wrong_targets_are_refused_by_name() {
    let mut rig = rig();
    rig.take_off();
    let refused = |rig: &Rig| (rig.state().target_id, TargetStatus::from_code(rig.state().target_status));
    rig.target(5, &[at(1.0, 0.0, 2.5, 0.0, 0.0)]);
    rig.until("arrived", 20, |rig| rig.state().target_status == TargetStatus::Arrived.code());
    rig.target(4, &[at(0.0, 0.0, 2.5, 0.0, 0.0)]);
    assert_eq!(refused(&rig), (4, Some(TargetStatus::RefusedOld)));
    rig.target(6, &[at(0.0, 0.0, 99.0, 0.0, 0.0)]);
    assert_eq!(refused(&rig), (6, Some(TargetStatus::RefusedPath)));
    rig.target(7, &[at(f64::NAN, 0.0, 2.0, 0.0, 0.0)]);
    assert_eq!(refused(&rig), (7, Some(TargetStatus::RefusedPath)));
    let far = VehicleTarget {
        id: 8,
        mission: 1,
        volume_min_m: [-20.0; 3],
        volume_max_m: [20.0; 3],
        path_len: 1,
        return_len: 0,
    };
    rig.core.on_target(&far, &[at(1.5, 0.0, 2.5, 0.0, 0.0)]);
    assert_eq!(refused(&rig), (8, Some(TargetStatus::RefusedStart)));
    rig.seconds(4);
    let before = rig.simulator.truth().position_m;
    rig.seconds(3);
    assert!(before.distance(rig.simulator.truth().position_m) < 0.05);
    rig.target(9, &[at(0.0, 0.0, 2.5, 0.0, 0.0)]);
    assert_eq!(refused(&rig), (9, Some(TargetStatus::Flying)));
    // The next mission in the same system counts from 1.
    rig.mission = 2;
    rig.target(1, &[at(0.5, 0.0, 2.5, 0.0, 0.0)]);
    assert_eq!(refused(&rig), (1, Some(TargetStatus::Flying)));
}

#[test]
fn a_dead_planner_means_hold_then_home_land_and_disarm() {
    let mut rig = rig();
    rig.take_off();
    rig.target(1, &[at(4.0, 0.0, 3.0, 0.0, 0.0), at(4.0, 6.0, 3.0, 0.0, 0.0)]);
    rig.seconds(4);
    rig.planner = false;
    rig.seconds(5);
    let held = rig.simulator.truth().position_m;
    assert_eq!(rig.state().target_status, TargetStatus::Held.code());
    rig.seconds(10);
    assert!(held.distance(rig.simulator.truth().position_m) < 0.3);
    rig.until("landed", 120, |rig| rig.state().armed == 0);
    assert!(rig.simulator.truth().position_m.truncate().length() < 0.4, "{}", rig.simulator.truth().position_m);
}

#[test]
fn a_restart_in_the_air_has_no_jump_and_never_replays() {
    for away in [30, 250] {
        let mut rig = rig();
        rig.take_off();
        rig.target(3, &[at(9.0, 0.0, 3.0, 0.0, 0.0)]);
        rig.seconds(4);
        let (requested, address) = (rig.now_ns, 77);
        rig.restart(away);
        let lost_at = rig.simulator.truth().position_m;
        rig.tick(true);
        rig.core.on_command(
            rig.now_ns,
            ReplyAddress { client: 8, client_incarnation: 0, request_id: address, sent_ns: requested },
            &CommandRequest { command: VehicleCommand::Arm.code(), ..CommandRequest::default() },
        );
        rig.until("in control again", 20, |rig| rig.core.phase() == Phase::Offboard && rig.state().streaming == 1);
        assert_eq!(rig.status(address).0, Some(CommandStatus::Restarted));
        rig.seconds(5);
        assert!(
            rig.simulator.truth().position_m.distance(lost_at) < 2.5,
            "stayed: {}",
            rig.simulator.truth().position_m
        );
        assert!(rig.fastest(300) < 0.3, "{} m/s", rig.fastest(300));
        rig.target(3, &[at(9.0, 0.0, 3.0, 0.0, 0.0)]);
        assert_eq!(rig.state().target_status, TargetStatus::RefusedOld.code());
        rig.target(4, &[at(9.0, 0.0, 3.0, 0.0, 0.0)]);
        rig.until("arrived", 30, |rig| {
            rig.state().target_id == 4 && rig.state().target_status == TargetStatus::Arrived.code()
        });
    }
}

#[test]
fn a_stall_is_treated_as_a_restart() {
    for stalled in [70, 300] {
        let mut rig = rig();
        rig.take_off();
        rig.target(1, &[at(9.0, 0.0, 3.0, 0.0, 0.0)]);
        rig.seconds(3);
        (0..stalled).for_each(|_| rig.tick(false));
        rig.seconds(1);
        rig.until("in control again", 20, |rig| rig.core.phase() == Phase::Offboard && rig.state().target_status == 0);
        rig.seconds(3);
        assert!(rig.fastest(200) < 0.3, "{} m/s after {stalled} ticks", rig.fastest(200));
        assert_eq!(rig.state().commander, Commander::Vantage.code());
    }
}

#[test]
fn a_pilot_who_takes_over_is_left_alone_until_the_word_to_go_on() {
    let mut rig = rig();
    rig.take_off();
    rig.target(1, &[at(9.0, 0.0, 3.0, 0.0, 0.0)]);
    rig.seconds(2);
    // AUTO.LAND from a ground station: not our command.
    let (command, params) = set_mode(FlightMode::Land);
    rig.simulator.receive(LinkId::Ground, &encode(255, 0, &command_long(1, command, params, 0)), 0);
    rig.seconds(1);
    assert_eq!((rig.state().commander, rig.state().streaming), (Commander::Pilot.code(), 0));
    let refused = rig.request(VehicleCommand::TakeControl);
    rig.tick(true);
    assert_eq!(rig.status(refused).0, Some(CommandStatus::Refused));
    rig.pending.clear();
    for _ in 0..100 {
        rig.tick(true);
        let commands = rig.pending.iter().flat_map(|bytes| decode(bytes));
        assert!(
            commands.into_iter().all(|sent| matches!(mavlink::Message::message_id(&sent.message), 0 | 111)),
            "heartbeats only"
        );
    }
    rig.command(VehicleCommand::GoOn, 10);
    assert_eq!((rig.state().mode, rig.state().commander), (FlightMode::Hold.code(), Commander::Vantage.code()));
    rig.command(VehicleCommand::TakeControl, 10);
}

#[test]
fn the_world_and_the_vehicle_stay_when_the_estimator_jumps() {
    let mut rig = rig();
    rig.take_off();
    rig.seconds(2);
    let (before, seen) = (rig.simulator.truth().position_m, DVec3::from_array(rig.state().position_m));
    rig.simulator.vehicle_mut().reset_estimate(DVec3::new(4.0, -3.0, 1.0));
    for _ in 0..500 {
        rig.tick(true);
        assert!(DVec3::from_array(rig.state().position_m).distance(seen) < 0.3, "the state jumped");
    }
    assert_eq!(rig.state().reset_count, 1);
    assert!(
        rig.simulator.truth().position_m.distance(before) < 0.3,
        "the vehicle moved to {}",
        rig.simulator.truth().position_m
    );
}

#[test]
fn a_world_that_is_moved_takes_its_places_along_and_moves_no_vehicle() {
    let mut rig = rig();
    rig.take_off();
    rig.target(1, &[at(1.0, 0.0, 3.0, 0.5, 0.0)]);
    rig.until("arrived", 30, |rig| rig.state().target_status == TargetStatus::Arrived.code());
    let (before, path) = (rig.state(), rig.path.len());
    let shift = |rig: &mut Rig, shift_m: [f64; 3], reset_count: u32| {
        let command = VehicleCommand::ShiftWorld.code();
        rig.request_with(CommandRequest { command, reset_count, shift_m, ..CommandRequest::default() })
    };
    let id = shift(&mut rig, [1.5, -2.0, 0.5], before.reset_count);
    rig.until("moved", 10, |rig| rig.status(id).0 == Some(CommandStatus::Confirmed));
    rig.seconds(1);
    let after = rig.state();
    assert_eq!((after.reset_count, after.streaming), (before.reset_count + 1, 0));
    let moved = DVec3::from_array(after.position_m) - DVec3::from_array(before.position_m);
    assert!((moved - DVec3::new(1.5, -2.0, 0.5)).length() < 0.1, "{moved}");
    let home = DVec3::from_array(after.home_m) - DVec3::from_array(before.home_m);
    assert!((home - DVec3::new(1.5, -2.0, 0.5)).length() < 0.01, "{home}");
    // What was measured before it moved does not hold any more, and what is far off is no shift.
    for (by_m, reset_count, reason) in
        [([1.0, 0.0, 0.0], before.reset_count, "moved since"), ([30.0, 0.0, 0.0], after.reset_count, "at most 20")]
    {
        let id = shift(&mut rig, by_m, reset_count);
        rig.seconds(1);
        let (status, why) = rig.status(id);
        assert!(status == Some(CommandStatus::Refused) && why.contains(reason), "{status:?} {why}");
    }
    // The next life knows, and the vehicle goes on from where it stands.
    rig.restart(20);
    rig.until("known again", 20, |rig| rig.state().ready == 1);
    assert_eq!(rig.state().reset_count, after.reset_count);
    rig.command(VehicleCommand::TakeControl, 20);
    let truly = rig.path[path..].windows(2).map(|pair| pair[0].distance(pair[1])).sum::<f64>();
    assert!(truly < 0.5, "the vehicle went {truly} m");
    rig.command(VehicleCommand::Return, 120);
    assert_eq!(rig.state().landed, 1);
}

#[test]
fn an_autopilot_that_would_climb_away_is_refused_with_the_way_out() {
    let mut rig = Rig::new(
        LinkConfig { set_params: Some(false), ..LinkConfig::default() },
        VehicleConfig { params: vec![("COM_OBL_RC_ACT".to_owned(), 0.0)], ..VehicleConfig::default() },
    );
    rig.until("ready", 60, |rig| rig.state().ready == 1 && rig.state().armable == 1);
    let id = rig.request(VehicleCommand::Arm);
    rig.tick(true);
    let (status, reason) = rig.status(id);
    assert!(status == Some(CommandStatus::Refused) && reason.contains("COM_OBL_RC_ACT"), "{reason}");
}

#[test]
fn a_battery_failsafe_is_not_fought() {
    let mut rig = Rig::new(LinkConfig::default(), VehicleConfig { battery: 0.2, ..VehicleConfig::default() });
    rig.take_off();
    for (name, value) in [("SIM_BAT_DRAIN", 60.0), ("SIM_BAT_MIN_PCT", 0.0)] {
        let message = mavlink::dialects::common::MavMessage::PARAM_SET(mavlink::dialects::common::PARAM_SET_DATA {
            target_system: 1,
            target_component: 1,
            param_id: name.into(),
            param_value: value,
            param_type: mavlink::dialects::common::MavParamType::MAV_PARAM_TYPE_REAL32,
        });
        rig.simulator.receive(LinkId::Onboard, &encode(1, 0, &message), 0);
    }
    rig.until("failsafe", 120, |rig| rig.state().commander == Commander::Failsafe.code());
    rig.seconds(2);
    assert_eq!(rig.state().failsafe, shared_types::messages::FailsafeReason::Battery.code());
    assert_eq!(rig.state().streaming, 0);
    rig.until("down", 200, |rig| rig.state().armed == 0);
}

#[test]
fn leaving_in_the_air_waits_for_the_ground() {
    let mut rig = rig();
    rig.take_off();
    rig.target(1, &[at(3.0, 0.0, 3.0, 0.0, 0.0)]);
    rig.seconds(6);
    rig.planner = false;
    assert!(rig.core.stop(rig.now_ns) && !rig.core.may_leave());
    rig.until("may leave", 120, |rig| rig.core.may_leave());
    assert_eq!((rig.state().armed, rig.state().commander), (0, Commander::Nobody.code()));
    assert!(rig.simulator.truth().position_m.truncate().length() < 0.4);
}

#[test]
fn leaving_between_arming_and_the_climb_waits_for_the_disarming() {
    for ticks in [0, 5, 60, 150] {
        let mut rig = rig();
        rig.until("ready", 60, |rig| rig.state().ready == 1 && rig.state().armable == 1);
        rig.request(VehicleCommand::Arm);
        rig.until("armed", 10, |rig| rig.state().armed == 1 && rig.state().commander == Commander::Vantage.code());
        if ticks > 0 {
            rig.request(VehicleCommand::Takeoff);
            (0..ticks).for_each(|_| rig.tick(true));
        }
        assert!(rig.core.stop(rig.now_ns), "armed: leaving waits ({ticks} ticks after the takeoff's request)");
        rig.until("may leave", 60, |rig| rig.core.may_leave());
        assert_eq!(rig.state().armed, 0);
    }
}
