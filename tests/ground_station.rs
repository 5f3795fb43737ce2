//! A ground station starts a mission, hears of it, and ends it, by MAVLink alone: through the autopilot, which forwards.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

mod common;

use std::net::UdpSocket;
use std::time::{Duration, Instant};

use common::{Flight, journal, keyframes};
use mavlink::dialects::common::{COMMAND_LONG_DATA, HEARTBEAT_DATA, MavCmd, MavMessage, MavResult, MavType};
use mavlink::{MAVLinkV2MessageRaw, MavHeader};
use px4_link::mavlink_io::{OWN_COMPONENT, decode};

/// An instance that no other test takes by chance: its ground link is 18577 to 14550, its system 8.
const INSTANCE: u8 = 7;
const SYSTEM: u8 = INSTANCE + 1;
/// As QGroundControl.
const STATION: (u8, u8) = (255, 190);
const PATIENCE: Duration = Duration::from_secs(60);

struct Station {
    socket: UdpSocket,
    sequence: u8,
    heard: Vec<MavMessage>,
    beaten: Instant,
}

impl Station {
    fn new() -> Self {
        let socket = UdpSocket::bind("127.0.0.1:14550").expect("no other ground station on this machine");
        socket.connect(("127.0.0.1", 18_570 + u16::from(INSTANCE))).expect("connected");
        socket.set_read_timeout(Some(Duration::from_millis(20))).expect("set");
        Self { socket, sequence: 0, heard: Vec::new(), beaten: Instant::now() - Duration::from_secs(1) }
    }

    fn send(&mut self, message: &MavMessage) {
        let mut raw = MAVLinkV2MessageRaw::new();
        let header = MavHeader { system_id: STATION.0.into(), component_id: STATION.1, sequence: self.sequence };
        self.sequence = self.sequence.wrapping_add(1);
        raw.serialize_message(header, message);
        // Nobody may listen yet.
        self.socket.send(raw.raw_bytes()).ok();
    }

    fn order(&mut self, command: MavCmd) {
        let (target_system, target_component) = (SYSTEM, OWN_COMPONENT);
        let order = COMMAND_LONG_DATA { command, target_system, target_component, ..COMMAND_LONG_DATA::default() };
        self.send(&MavMessage::COMMAND_LONG(order));
    }

    fn listen(&mut self) {
        if self.beaten.elapsed() >= Duration::from_millis(500) {
            self.beaten = Instant::now();
            let beat = HEARTBEAT_DATA { mavtype: MavType::MAV_TYPE_GCS, ..HEARTBEAT_DATA::default() };
            self.send(&MavMessage::HEARTBEAT(beat));
        }
        let mut buffer = [0; 2048];
        if let Ok(length) = self.socket.recv(&mut buffer) {
            let ours = decode(&buffer[..length]).into_iter().filter(|heard| heard.component == OWN_COMPONENT);
            self.heard.extend(ours.map(|received| received.message));
        }
    }

    /// Whether its order was accepted: the first answer to it.
    fn ordered(&mut self, command: MavCmd) -> MavResult {
        self.heard.retain(|message| !matches!(message, MavMessage::COMMAND_ACK(ack) if ack.command == command));
        let began = Instant::now();
        let mut sent = began - Duration::from_secs(2);
        loop {
            // A command without an answer is sent again, as ground stations do.
            if sent.elapsed() > Duration::from_secs(1) {
                sent = Instant::now();
                self.order(command);
            }
            self.listen();
            let answer = self.heard.iter().find_map(|message| match message {
                MavMessage::COMMAND_ACK(ack) if ack.command == command => Some(ack.clone()),
                _ => None,
            });
            if let Some(ack) = answer {
                assert_eq!((ack.target_system, ack.target_component), STATION);
                return ack.result;
            }
            assert!(began.elapsed() < PATIENCE, "no answer to {command:?}");
        }
    }

    fn texts(&self) -> String {
        let text = |message: &MavMessage| match message {
            MavMessage::STATUSTEXT(text) => Some(text.text.to_str().ok()?.trim_end_matches('\0').to_owned()),
            _ => None,
        };
        self.heard.iter().filter_map(text).collect::<Vec<_>>().join("\n")
    }

    fn wait_for(&mut self, text: &str) {
        let began = Instant::now();
        while !self.texts().contains(text) {
            self.listen();
            assert!(began.elapsed() < PATIENCE, "{text}: not in\n{}", self.texts());
        }
    }
}

#[test]
fn a_ground_station_starts_a_mission_and_ends_it() {
    let base = tempfile::tempdir().expect("folder");
    let folder = base.path().join("mission");
    let instance = format!("simulator.instance={INSTANCE}");
    let sets = ["--set", &instance, "--set", "planner.autostart=false", "--speed", "6", "--trace"];
    let arguments = [&["--preset", "tiny", "--seed", "21"][..], &sets].concat();
    let mut flight = Flight::start(&folder, &arguments);
    let mut station = Station::new();
    station.wait_for("vantage: waiting for the order to start");
    assert!(journal(&folder).is_empty() && keyframes(&folder).is_empty(), "it waits");

    assert_eq!(station.ordered(MavCmd::MAV_CMD_USER_1), MavResult::MAV_RESULT_ACCEPTED);
    station.wait_for("vantage: taking off");
    assert_eq!(station.ordered(MavCmd::MAV_CMD_USER_1), MavResult::MAV_RESULT_DENIED);
    station.wait_for("vantage: start refused: ");
    flight.wait_until("the first keyframe", |flight| !keyframes(&flight.folder).is_empty());
    assert_eq!(station.ordered(MavCmd::MAV_CMD_USER_2), MavResult::MAV_RESULT_ACCEPTED);
    station.wait_for("vantage: returning");
    station.wait_for("vantage: done (operator)");
    flight.finish_well();
    // On the way, every process has told what it did when.
    let picture = std::fs::read_to_string(folder.join("report/timeline.svg")).expect("a picture");
    let trace = std::fs::read(folder.join("report/trace.json")).expect("a trace");
    let trace: serde_json::Value = serde_json::from_slice(&trace).expect("JSON");
    let events = trace["traceEvents"].as_array().expect("events");
    for (service, stage) in
        [("planner", "takeoff"), ("camera", "image of a keyframe"), ("world", "render"), ("launch", "fly")]
    {
        assert!(picture.contains(&format!(">{service}")) && picture.contains(stage), "{service}: {stage}");
        let told = |event: &serde_json::Value| event["cat"] == service && event["name"] == stage;
        assert!(events.iter().any(told), "{service}: {stage}");
    }
}
