//! Other hands on the vehicle: pilots, operators, failsafes, and a px4-link that is told to end.

use mavlink::dialects::common::{MANUAL_CONTROL_DATA, MavMessage, MavParamType, PARAM_SET_DATA};
use px4_link::commands::set_mode;
use px4_link::logic::command_long;
use px4_link::mavlink_io::encode;
use px4_link::state::Phase;
use shared_types::config::LinkConfig;
use shared_types::config::link::ArmMode;
use shared_types::messages::{CommandStatus, Commander, FailsafeReason, FlightMode, TargetStatus, VehicleCommand};
use simulator::simulator::LinkId;
use simulator::vehicle::VehicleConfig;

use crate::rig::{Rig, at, rig};

/// A ground station commands a mode.
fn station(rig: &mut Rig, mode: FlightMode) {
    let (command, params) = set_mode(mode);
    rig.simulator.receive(LinkId::Ground, &encode(255, 0, &command_long(1, command, params, 0)), 0);
}

/// A pilot's sticks: `forward` from -1000 to 1000, `up` from 0 to 1000, 500 in the middle.
fn sticks(rig: &mut Rig, forward: i16, up: i16) {
    let message =
        MavMessage::MANUAL_CONTROL(MANUAL_CONTROL_DATA { x: forward, z: up, target: 1, ..Default::default() });
    rig.simulator.receive(LinkId::Ground, &encode(255, 0, &message), 0);
}

/// The pilot's switch to position mode.
fn to_position_mode(rig: &mut Rig) {
    sticks(rig, 0, 500);
    let mut params = [f32::NAN; 7];
    params[..3].copy_from_slice(&[1.0, 3.0, 0.0]);
    let (command, _) = set_mode(FlightMode::Hold);
    rig.simulator.receive(LinkId::Ground, &encode(255, 0, &command_long(1, command, params, 0)), 0);
}

fn pilot_arms(rig: &mut Rig) {
    let mut params = [f32::NAN; 7];
    params[0] = 1.0;
    let arm = command_long(1, mavlink::dialects::common::MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, params, 0);
    rig.simulator.receive(LinkId::Ground, &encode(255, 0, &arm), 0);
}

fn set_param(rig: &mut Rig, name: &str, value: f32, param_type: MavParamType) {
    let message = MavMessage::PARAM_SET(PARAM_SET_DATA {
        target_system: 1,
        target_component: 1,
        param_id: name.into(),
        param_value: value,
        param_type,
    });
    rig.simulator.receive(LinkId::Onboard, &encode(1, 0, &message), 0);
}

fn ticks_with_sticks(rig: &mut Rig, ticks: u32, forward: i16, up: i16) {
    for _ in 0..ticks {
        sticks(rig, forward, up);
        rig.tick(true);
    }
}

fn silent(rig: &mut Rig, seconds: u32) {
    for _ in 0..seconds * 100 {
        rig.tick(true);
        let sent = rig.pending.iter().flat_map(|bytes| px4_link::mavlink_io::decode(bytes));
        assert!(sent.into_iter().all(|sent| matches!(mavlink::Message::message_id(&sent.message), 0 | 111)));
    }
}

#[test]
fn an_operators_hold_survives_a_restart() {
    let mut rig = rig();
    rig.take_off();
    station(&mut rig, FlightMode::Hold);
    rig.restart(100);
    rig.until("looked at", 20, |rig| rig.state().commander != Commander::Nobody.code());
    assert_eq!(rig.state().commander, Commander::Pilot.code());
    silent(&mut rig, 3);
    assert_eq!(rig.state().mode, FlightMode::Hold.code());
}

#[test]
fn a_restart_amid_our_own_hold_or_takeoff_goes_on() {
    for (command, ticks) in [(VehicleCommand::Hold, 1), (VehicleCommand::Takeoff, 150), (VehicleCommand::Takeoff, 1)] {
        let mut rig = rig();
        if command == VehicleCommand::Hold {
            rig.take_off();
        } else {
            rig.until("ready", 60, |rig| rig.state().ready == 1 && rig.state().armable == 1);
            rig.command(VehicleCommand::Arm, 10);
        }
        rig.request(command);
        // One tick sends it; the next brings it to the autopilot.
        (0..ticks).for_each(|_| rig.tick(true));
        let sent = core::mem::take(&mut rig.pending);
        rig.restart(0);
        rig.pending = sent;
        (0..600).for_each(|_| rig.tick(false));
        rig.until("looked at", 20, |rig| rig.state().commander != Commander::Nobody.code());
        assert_eq!(rig.state().commander, Commander::Vantage.code(), "{command} after {ticks}");
        rig.command(VehicleCommand::TakeControl, 10);
    }
}

#[test]
fn a_restart_between_our_arming_and_its_being_seen_is_no_pilots() {
    let mut armed = 0;
    for ticks in [1, 2, 3, 4, 6, 10, 30] {
        let mut rig = rig();
        rig.until("ready", 60, |rig| rig.state().ready == 1 && rig.state().armable == 1);
        rig.request(VehicleCommand::Arm);
        (0..ticks).for_each(|_| rig.tick(true));
        let sent = core::mem::take(&mut rig.pending);
        rig.restart(0);
        rig.pending = sent;
        (0..10).for_each(|_| rig.tick(false));
        for _ in 0..800 {
            rig.tick(true);
            let state = rig.state();
            if state.armed == 1 {
                armed += 1;
                assert_ne!(state.commander, Commander::Pilot.code(), "after {ticks} ticks");
            }
        }
    }
    assert!(armed > 0, "it was armed at least once");
}

#[test]
fn a_hold_just_after_control_was_taken_is_an_operators() {
    let mut rig = rig();
    rig.take_off();
    rig.seconds(1);
    station(&mut rig, FlightMode::Hold);
    rig.seconds(1);
    assert_eq!((rig.state().commander, rig.state().streaming), (Commander::Pilot.code(), 0));
}

#[test]
fn a_pilot_arms_in_any_mode_and_the_mission_takes_off() {
    let mut rig = Rig::new(LinkConfig { arm: Some(ArmMode::Pilot), ..LinkConfig::default() }, VehicleConfig::default());
    rig.until("ready", 60, |rig| rig.state().ready == 1 && rig.state().armable == 1);
    let id = rig.request(VehicleCommand::Arm);
    to_position_mode(&mut rig);
    ticks_with_sticks(&mut rig, 30_000, 0, 500);
    assert_eq!(rig.status(id).0, Some(CommandStatus::Accepted), "it waits for the pilot");
    pilot_arms(&mut rig);
    ticks_with_sticks(&mut rig, 50, 0, 500);
    assert_eq!(rig.status(id).0, Some(CommandStatus::Confirmed));
    assert_eq!((rig.state().commander, rig.core.phase()), (Commander::Vantage.code(), Phase::Armed));
    rig.command(VehicleCommand::Takeoff, 30);
    rig.command(VehicleCommand::TakeControl, 10);
    assert_eq!(rig.core.phase(), Phase::Offboard);
}

#[test]
fn a_pilot_who_arms_and_flies_off_commands() {
    let mut rig = Rig::new(LinkConfig { arm: Some(ArmMode::Pilot), ..LinkConfig::default() }, VehicleConfig::default());
    rig.until("ready", 60, |rig| rig.state().ready == 1 && rig.state().armable == 1);
    rig.request(VehicleCommand::Arm);
    to_position_mode(&mut rig);
    rig.tick(true);
    pilot_arms(&mut rig);
    ticks_with_sticks(&mut rig, 50, 0, 500);
    assert_eq!(rig.state().commander, Commander::Vantage.code(), "armed as the mission asked");
    ticks_with_sticks(&mut rig, 500, 0, 900);
    assert!(rig.simulator.truth().position_m.z > 0.5, "{}", rig.simulator.truth().position_m);
    assert_eq!((rig.state().mode, rig.state().commander), (FlightMode::Pilot.code(), Commander::Pilot.code()));
}

#[test]
fn a_failsafes_hold_is_no_finished_takeoff_and_not_our_own_hold() {
    // A ground station's loss: Hold for five seconds, then return.
    for commanded in [None, Some(VehicleCommand::Hold)] {
        let config = LinkConfig { gcs_heartbeat: Some(false), ..LinkConfig::default() };
        let mut rig = Rig::new(config, VehicleConfig::default());
        rig.take_off();
        if let Some(command) = commanded {
            rig.command(command, 10);
            rig.seconds(5);
        }
        set_param(&mut rig, "NAV_DLL_ACT", f32::from_bits(2), MavParamType::MAV_PARAM_TYPE_INT32);
        rig.seconds(1);
        assert_eq!(rig.state().mode, FlightMode::Hold.code());
        assert_eq!(rig.state().commander, Commander::Failsafe.code(), "{commanded:?}");
        assert_ne!(rig.state().failsafe, FailsafeReason::None.code());
    }
}

#[test]
fn told_to_end_on_the_way_home_it_goes_on_and_takes_no_new_work() {
    let mut rig = rig();
    rig.take_off();
    rig.target(1, &[at(3.0, 0.0, 3.0, 0.0, 0.0)]);
    rig.until("arrived", 20, |rig| rig.state().target_status == TargetStatus::Arrived.code());
    let home = rig.request(VehicleCommand::Return);
    rig.seconds(2);
    let cut = rig.request(VehicleCommand::TakeControl);
    rig.tick(true);
    assert_eq!(rig.status(cut).0, Some(CommandStatus::Refused), "control is not taken from a landing");
    assert!(rig.core.stop(rig.now_ns) && !rig.core.may_leave());
    rig.tick(true);
    assert_eq!(rig.status(home).0, Some(CommandStatus::Accepted), "the return goes on");
    for command in [VehicleCommand::TakeControl, VehicleCommand::Takeoff, VehicleCommand::Arm, VehicleCommand::GoOn] {
        let refused = rig.request(command);
        rig.tick(true);
        assert_eq!(rig.status(refused).0, Some(CommandStatus::Refused), "{command}");
    }
    rig.until("may leave", 120, |rig| rig.core.may_leave());
    assert!(rig.simulator.truth().position_m.truncate().length() < 0.4);
}

#[test]
fn told_to_end_between_arming_and_lift_off_it_disarms_or_goes_home() {
    for climbing in [false, true] {
        let mut rig = rig();
        rig.until("ready", 60, |rig| rig.state().ready == 1 && rig.state().armable == 1);
        rig.command(VehicleCommand::Arm, 10);
        if climbing {
            rig.request(VehicleCommand::Takeoff);
            rig.until("takeoff", 10, |rig| rig.state().mode == FlightMode::Takeoff.code());
            // Off the ground before the autopilot hears of the disarming.
            rig.until("nearly up", 10, |rig| rig.simulator.truth().position_m.z > 0.02);
        }
        assert!(rig.core.stop(rig.now_ns), "later");
        rig.until("may leave", 60, |rig| rig.core.may_leave());
        assert_eq!(rig.state().armed, 0);
    }
}

#[test]
fn a_pilots_mode_on_the_ground_is_left_alone() {
    let mut rig = rig();
    rig.until("ready", 60, |rig| rig.state().ready == 1 && rig.state().armable == 1);
    station(&mut rig, FlightMode::Offboard);
    rig.seconds(5);
    assert_eq!(rig.state().mode, FlightMode::Offboard.code());
    station(&mut rig, FlightMode::Hold);
    rig.seconds(1);
    rig.take_off();
    rig.command(VehicleCommand::Land, 60);
    rig.until("Hold after a flight of ours", 10, |rig| rig.state().mode == FlightMode::Hold.code());
}

#[test]
fn a_refused_target_is_refused_by_the_next_life_too() {
    let mut rig = rig();
    rig.take_off();
    rig.target(7, &[at(0.0, 0.0, 99.0, 0.0, 0.0)]);
    assert_eq!(rig.state().target_status, TargetStatus::RefusedPath.code());
    rig.restart(30);
    rig.until("in control again", 20, |rig| rig.core.phase() == Phase::Offboard && rig.state().streaming == 1);
    rig.target(7, &[at(1.0, 0.0, 3.0, 0.0, 0.0)]);
    assert_eq!(rig.state().target_status, TargetStatus::RefusedOld.code());
}
