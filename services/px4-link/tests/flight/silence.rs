//! A link that is silent for a while, a px4-link that was stopped, an estimator that moved meanwhile.

use glam::DVec3;
use px4_link::commands::set_mode;
use px4_link::logic::command_long;
use px4_link::mavlink_io::{decode, encode};
use px4_link::state::Phase;
use shared_types::messages::{Commander, FlightMode, TargetStatus};
use simulator::simulator::LinkId;

use crate::rig::{Rig, at, rig};

fn station(rig: &mut Rig, mode: FlightMode) {
    let (command, params) = set_mode(mode);
    rig.simulator.receive(LinkId::Ground, &encode(255, 0, &command_long(1, command, params, 0)), 0);
}

/// Ticks, and asserts that nothing is sent that moves the vehicle: heartbeats, time, questions.
fn harmless(rig: &mut Rig, ticks: u32) {
    for _ in 0..ticks {
        rig.tick(true);
        for sent in rig.pending.iter().flat_map(|bytes| decode(bytes)) {
            use mavlink::dialects::common::{MavCmd, MavMessage};
            let asks = matches!(&sent.message, MavMessage::COMMAND_LONG(command)
                if matches!(command.command, MavCmd::MAV_CMD_REQUEST_MESSAGE));
            assert!(asks || matches!(mavlink::Message::message_id(&sent.message), 0 | 111), "{:?}", sent.message);
        }
    }
}

#[test]
fn a_silent_link_stops_the_stream_and_control_is_taken_anew_where_it_then_is() {
    for (ticks, stops) in [(70, false), (95, true), (300, true)] {
        let mut rig = rig();
        rig.take_off();
        rig.target(1, &[at(9.0, 0.0, 3.0, 0.0, 0.0)]);
        rig.seconds(3);
        rig.deaf = true;
        (0..ticks).for_each(|_| rig.tick(true));
        assert_eq!(rig.state().streaming == 0, stops, "after {ticks} ticks");
        rig.deaf = false;
        rig.seconds(1);
        rig.until("in control", 20, |rig| rig.core.phase() == Phase::Offboard && rig.state().streaming == 1);
        assert_eq!(rig.state().commander, Commander::Vantage.code());
        if stops {
            rig.seconds(3);
            assert!(rig.fastest(200) < 0.3, "{} m/s after {ticks} ticks", rig.fastest(200));
            assert_eq!(rig.state().target_status, TargetStatus::None.code());
        } else {
            rig.until("arrived", 30, |rig| rig.state().target_status == TargetStatus::Arrived.code());
        }
    }
}

#[test]
fn a_pilot_who_took_over_in_the_silence_is_left_alone() {
    for mode in [FlightMode::Hold, FlightMode::Return] {
        let mut rig = rig();
        rig.take_off();
        rig.seconds(5);
        rig.deaf = true;
        rig.seconds(1);
        station(&mut rig, mode);
        rig.seconds(1);
        rig.deaf = false;
        harmless(&mut rig, 300);
        assert_eq!((rig.state().mode, rig.state().commander), (mode.code(), Commander::Pilot.code()));
    }
}

#[test]
fn after_a_stop_of_the_process_nothing_is_commanded_by_what_was_heard_before() {
    let mut rig = rig();
    rig.take_off();
    rig.seconds(5);
    (0..100).for_each(|_| rig.tick(false));
    station(&mut rig, FlightMode::Land);
    (0..20).for_each(|_| rig.tick(false));
    rig.core.rejoin(rig.now_ns);
    harmless(&mut rig, 200);
    assert_eq!((rig.state().mode, rig.state().commander), (FlightMode::Land.code(), Commander::Pilot.code()));
}

#[test]
fn an_estimator_that_was_reset_while_away_is_not_flown_by() {
    let mut rig = rig();
    rig.take_off();
    rig.seconds(1);
    rig.pending.clear();
    rig.simulator.vehicle_mut().reset_estimate(DVec3::new(4.0, 0.0, 0.0));
    rig.restart(100);
    rig.until("looked at", 20, |rig| rig.state().commander != Commander::Nobody.code());
    assert_eq!((rig.state().commander, rig.state().streaming), (Commander::Failsafe.code(), 0));
}
