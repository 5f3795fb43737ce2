use mavlink::dialects::common::{HEARTBEAT_DATA, MavMessage, SYSTEM_TIME_DATA};

use super::*;
use crate::mav::codec::{Outbox, frames};
use crate::vehicle::VehicleConfig;

fn faults(sentences: &[&str]) -> Faults {
    let list: Vec<Fault> = sentences.iter().map(|text| text.parse().expect(text)).collect();
    Faults::new(&list, 7, 1).expect("faults")
}

/// A datagram with a message of each of these numbers.
fn datagram(numbers: core::ops::Range<u64>) -> Vec<u8> {
    let mut outbox = Outbox::new(1, 1);
    for time_unix_usec in numbers {
        outbox.push(&MavMessage::SYSTEM_TIME(SYSTEM_TIME_DATA { time_unix_usec, time_boot_ms: 1 }));
    }
    outbox.take().concat()
}

fn numbers(datagrams: &[Vec<u8>]) -> Vec<u64> {
    let number = |message| match message {
        MavMessage::SYSTEM_TIME(time) => Some(time.time_unix_usec),
        _ => None,
    };
    datagrams.iter().flat_map(|bytes| frames(bytes)).filter_map(|frame| number(frame.message()?)).collect()
}

/// Ten packets a tick for 400 ticks, and what comes of them until the end.
fn carried(disturbance: &Disturbance) -> Vec<(u64, u64)> {
    let mut lane = Lane::new(3);
    let mut came = Vec::new();
    for tick in 0..600 {
        if tick < 400 {
            lane.push(tick, &datagram(tick * 10..tick * 10 + 10), disturbance);
        }
        came.extend(numbers(&lane.take(tick)).into_iter().map(|number| (tick, number)));
    }
    came
}

#[test]
fn nothing_is_done_without_a_fault() {
    let came = carried(&Disturbance::default());
    assert!(came.iter().map(|(_, number)| *number).eq(0..4000));
    assert!(came.iter().all(|(tick, number)| number / 10 == *tick));
    assert!(Faults::new(&[], 1, 1).is_none());
}

#[test]
fn the_share_that_was_asked_for_is_lost_doubled_and_overtaken() {
    let lost = 4000 - carried(&Disturbance { loss: 0.2, ..Default::default() }).len();
    assert!((700..900).contains(&lost), "{lost}");
    let doubled = carried(&Disturbance { duplicate: 0.1, ..Default::default() }).len() - 4000;
    assert!((330..470).contains(&doubled), "{doubled}");
    let overtaken = carried(&Disturbance { reorder: 0.1, ..Default::default() });
    assert_eq!(overtaken.len(), 4000, "nothing is lost");
    let late = overtaken.iter().filter(|(tick, number)| number / 10 < *tick).count();
    assert!((330..470).contains(&late), "{late}");
    assert!(overtaken.iter().all(|(tick, number)| (0..=3).contains(&(tick - number / 10))));
}

#[test]
fn a_delay_keeps_the_order() {
    let came = carried(&Disturbance { delay_ticks: 50, ..Default::default() });
    assert!(came.iter().map(|(_, number)| *number).eq(0..4000));
    assert!(came.iter().all(|(tick, number)| number / 10 + 50 == *tick));
}

#[test]
fn garbage_damages_nothing_else() {
    let mut lane = Lane::new(5);
    let disturbance = Disturbance { garbage: 0.5, ..Default::default() };
    let mut bytes = 0;
    let mut came = Vec::new();
    for tick in 0..100 {
        let sent = datagram(tick..tick + 1);
        lane.push(tick, &sent, &disturbance);
        let taken = lane.take(tick);
        bytes += taken.iter().map(Vec::len).sum::<usize>() - sent.len();
        came.extend(numbers(&taken));
    }
    came.dedup();
    assert!(came.into_iter().eq(0..100));
    assert!(bytes > 500, "{bytes}");
}

#[test]
fn faults_begin_and_end_when_they_should() {
    let faults = faults(&["loss 0.1", "loss 0.5 at 10 for 5", "gone at 20 for 0.5", "delay 0.5 at 30"]);
    assert_eq!(faults.disturbance(9.99), Disturbance { loss: 0.1, ..Default::default() });
    assert_eq!(faults.disturbance(10.0).loss, 0.5, "the worst counts");
    assert_eq!(faults.disturbance(15.0).loss, 0.1);
    assert!(!faults.disturbance(19.99).gone && faults.disturbance(20.49).gone && !faults.disturbance(20.5).gone);
    assert_eq!(faults.disturbance(1e5).delay_ticks, 50);
}

#[test]
fn only_heartbeats_are_lost_where_only_they_should_be() {
    let mut outbox = Outbox::new(1, 1);
    outbox.push(&MavMessage::HEARTBEAT(HEARTBEAT_DATA::default()));
    let mut lane = Lane::new(1);
    let disturbance = Disturbance { heartbeats_lost: true, ..Default::default() };
    lane.push(0, &[outbox.take().concat(), datagram(0..3)].concat(), &disturbance);
    let came = lane.take(0);
    assert_eq!((came.len(), numbers(&came)), (3, vec![0, 1, 2]));
}

#[test]
fn the_vehicle_is_struck_once() {
    let mut faults = faults(&["jump 3 1 0.5 at 1", "battery 0.12 at 2", "fence 8 at 2"]);
    let mut vehicle = Vehicle::new(VehicleConfig::default()).expect("a vehicle");
    let before = *vehicle.estimate();
    for _ in 0..300 {
        faults.strike(&mut vehicle);
        vehicle.step();
    }
    let after = *vehicle.estimate();
    assert_eq!(after.reset_counter, before.reset_counter + 1);
    // East, north and up are y, x and -z of NED.
    assert!((after.position_m - before.position_m).abs_diff_eq(DVec3::new(1.0, 3.0, -0.5), 1e-6));
    assert!((vehicle.battery.remaining() - 0.12).abs() < 1e-6);
    assert_eq!(vehicle.params.real(crate::params::Param::GF_MAX_HOR_DIST), 8.0);
}

#[test]
fn strangers_are_never_the_vehicle_itself_to_its_client() {
    let mut faults = faults(&["second-autopilot", "second-station", "wrong-ids"]);
    let (mut own, mut others, mut to_vehicle) = (0, 0, 0);
    for tick in 0..1000 {
        faults.speak(tick, tick as f64 / 100.0);
        for bytes in faults.outbound.take(tick) {
            for frame in frames(&bytes) {
                let is_vehicle = (frame.system_id, frame.component_id) == (1, 1);
                own += usize::from(is_vehicle);
                others += usize::from(!is_vehicle);
                // The vehicle's own words are answers to somebody else.
                assert!(!is_vehicle || (frame.message_id == 77 && frame.padded::<10>()[8..] == [200, 5]));
            }
        }
        to_vehicle += faults.inbound.take(tick).len();
    }
    assert!(own > 500 && others > 800 && to_vehicle >= 12, "{own} {others} {to_vehicle}");
}
