use mavlink::dialects::common::HEARTBEAT_DATA;
use mavlink::{MAVLinkV2MessageRaw, MavHeader};

use super::*;

fn heartbeat(autopilot: MavAutopilot) -> MavMessage {
    MavMessage::HEARTBEAT(HEARTBEAT_DATA { autopilot, mavlink_version: 3, ..Default::default() })
}

fn framed(system: u8, component: u8, message: &MavMessage) -> Vec<u8> {
    let mut raw = MAVLinkV2MessageRaw::new();
    raw.serialize_message(MavHeader { system_id: u32::from(system), component_id: component, sequence: 0 }, message);
    raw.raw_bytes().to_vec()
}

#[test]
fn only_the_first_autopilot_is_heard() {
    let mut link = Link::open("udpin:127.0.0.1:0", false).expect("a free port");
    let to = link.local_address().expect("udp");
    let socket = |_: u8| UdpSocket::bind("127.0.0.1:0").expect("a free port");
    let (station, autopilot, other) = (socket(0), socket(1), socket(2));
    station.send_to(&framed(255, 190, &heartbeat(MavAutopilot::MAV_AUTOPILOT_INVALID)), to).expect("sent");
    autopilot.send_to(&framed(3, 154, &heartbeat(MavAutopilot::MAV_AUTOPILOT_PX4)), to).expect("sent");
    link.take_all();
    assert!(
        link.sender().peer().is_none()
            && link.foreign == 2
            && !link.sender().send(&heartbeat(MavAutopilot::MAV_AUTOPILOT_INVALID))
    );
    autopilot.send_to(&framed(3, 1, &heartbeat(MavAutopilot::MAV_AUTOPILOT_PX4)), to).expect("sent");
    other.send_to(&framed(3, 1, &heartbeat(MavAutopilot::MAV_AUTOPILOT_PX4)), to).expect("sent");
    link.take_all();
    assert_eq!(link.sender().peer().map(|peer| peer.system), Some(3));
    assert!(link.next_message().is_some() && link.next_message().is_none());
    assert!(link.sender().send(&heartbeat(MavAutopilot::MAV_AUTOPILOT_INVALID)) && link.sender().sent() == 1);
}

#[test]
fn in_lockstep_exactly_the_counted_datagrams_are_taken() {
    let mut link = Link::open("udpin:127.0.0.1:0", true).expect("a free port");
    let to = link.local_address().expect("udp");
    let autopilot = UdpSocket::bind("127.0.0.1:0").expect("a free port");
    let send = |count: usize| {
        for _ in 0..count {
            autopilot.send_to(&framed(1, 1, &heartbeat(MavAutopilot::MAV_AUTOPILOT_PX4)), to).expect("sent");
        }
    };
    let drain = |link: &mut Link, to: u64| {
        link.drain_to(to);
        core::iter::from_fn(|| link.next_message()).count()
    };
    send(2);
    assert_eq!(drain(&mut link, 40), 2, "joining takes the count over");
    send(3);
    assert_eq!(drain(&mut link, 42), 2);
    assert_eq!(drain(&mut link, 43), 1);
    assert_eq!((drain(&mut link, 44), link.missing), (0, 1), "a lost one is given up");
    send(3);
    link.rejoin();
    assert_eq!(drain(&mut link, 47), 0, "what came while it was out is dropped");
    send(1);
    assert_eq!(drain(&mut link, 48), 1);
    assert!(matches!(Link::open("tcpout:127.0.0.1:5760", true), Err(LinkError::NotCountable(_))));
}

/// Turns until something holds.
fn until(link: &mut Link, what: &str, holds: impl Fn(&mut Link) -> bool) {
    let started = Instant::now();
    while !holds(link) {
        assert!(started.elapsed() < Duration::from_secs(10), "{what}");
        link.take_all();
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_tcp_line_that_broke_is_opened_again_and_a_quiet_one_is_not() {
    use std::io::{Read as _, Write as _};
    let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = listener.local_addr().expect("an address");
    let mut link = Link::open(&format!("tcpout:{address}"), false).expect("opened");
    let beat = framed(3, 1, &heartbeat(MavAutopilot::MAV_AUTOPILOT_PX4));
    let (first, _) = listener.accept().expect("connected");
    (&first).write_all(&beat).expect("sent");
    until(&mut link, "heard", |link| link.next_message().is_some());
    // Longer than a read waits: no reason to let go of the line, nor to be deaf for a while.
    std::thread::sleep(Duration::from_millis(300));
    let (head, tail) = beat.split_at(7);
    (&first).write_all(head).expect("sent");
    std::thread::sleep(Duration::from_millis(20));
    (&first).write_all(tail).expect("sent");
    let started = Instant::now();
    until(&mut link, "heard after a pause", |link| link.next_message().is_some());
    assert!(started.elapsed() < Duration::from_millis(700), "{:?}", started.elapsed());
    drop(first);
    let (second, _) = listener.accept().expect("connected again");
    (&second).write_all(&beat).expect("sent");
    until(&mut link, "heard on the second line", |link| link.next_message().is_some());
    assert!(link.sender().send(&heartbeat(MavAutopilot::MAV_AUTOPILOT_INVALID)));
    let mut bytes = [0; 64];
    let length = (&second).read(&mut bytes).expect("read");
    assert_eq!(decode(bytes.get(..length).unwrap_or_default()).len(), 1);
    // Nobody reads: what does not fit is dropped, and the sender is never held up.
    let started = Instant::now();
    while started.elapsed() < Duration::from_secs(10)
        && link.sender().send(&heartbeat(MavAutopilot::MAV_AUTOPILOT_INVALID))
    {}
    let started = Instant::now();
    assert!(!link.sender().send(&heartbeat(MavAutopilot::MAV_AUTOPILOT_INVALID)));
    assert!(started.elapsed() < Duration::from_millis(50), "{:?}", started.elapsed());
}
