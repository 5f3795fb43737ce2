//! Orders of ground stations are given once and answered once; what is told is told when it is new.

use mavlink::dialects::common::{COMMAND_INT_DATA, COMMAND_LONG_DATA};
use proptest::prelude::*;

use super::*;

fn command(from: (u8, u8), command: MavCmd, to: (u8, u8)) -> Received {
    let message = MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
        command,
        target_system: to.0,
        target_component: to.1,
        ..COMMAND_LONG_DATA::default()
    });
    Received { system: from.0, component: from.1, message }
}

fn results(ground: &mut Ground) -> Vec<(MavCmd, MavResult, u8, u8)> {
    let acknowledged = |message: MavMessage| match message {
        MavMessage::COMMAND_ACK(ack) => Some((ack.command, ack.result, ack.target_system, ack.target_component)),
        _ => None,
    };
    ground.take_messages(0).into_iter().filter_map(acknowledged).collect()
}

fn texts(ground: &mut Ground) -> Vec<String> {
    let mut sentences: Vec<(u16, String)> = Vec::new();
    for message in ground.take_messages(0) {
        let MavMessage::STATUSTEXT(text) = message else { continue };
        let part = text.text.to_str().unwrap().trim_end_matches('\0').to_owned();
        match sentences.last_mut().filter(|(id, _)| text.id != 0 && *id == text.id) {
            Some((_, sentence)) => {
                assert!(text.chunk_seq > 0);
                sentence.push_str(&part);
            }
            None => sentences.push((text.id, part)),
        }
    }
    sentences.into_iter().map(|(_, sentence)| sentence).collect()
}

#[test]
fn only_user_commands_to_the_onboard_computer_of_this_system_are_orders() {
    let station = (255, 190);
    for (user, order) in ORDERS {
        assert_eq!(ordered(1, &command(station, user, (1, OWN_COMPONENT))), Some(order));
        for to in [(1, 1), (1, 0), (0, OWN_COMPONENT), (2, OWN_COMPONENT), (0, 0)] {
            assert_eq!(ordered(1, &command(station, user, to)), None, "{to:?}");
        }
        let as_int = MavMessage::COMMAND_INT(COMMAND_INT_DATA {
            command: user,
            target_system: 1,
            target_component: OWN_COMPONENT,
            ..COMMAND_INT_DATA::default()
        });
        assert_eq!(ordered(1, &Received { system: 255, component: 190, message: as_int }), Some(order));
    }
    assert_eq!(ordered(1, &command(station, MavCmd::MAV_CMD_NAV_LAND, (1, OWN_COMPONENT))), None);
}

#[test]
fn an_order_is_answered_to_whom_gave_it_and_repeats_are_not_given_again() {
    let mut ground = Ground::new(1000);
    let start = command((255, 190), MavCmd::MAV_CMD_USER_1, (1, OWN_COMPONENT));
    let Passed { id, order, given_up } = ground.on_order(0, &start, MissionCommand::Start).unwrap();
    assert_eq!((order, given_up), (MissionCommand::Start, None));
    assert!(id > 1000 && ground.on_order(5, &start, MissionCommand::Start).is_none(), "sent again");
    ground.on_answer(id + 1, Ok(()));
    assert!(results(&mut ground).is_empty(), "of another request");
    ground.on_answer(id, Ok(()));
    ground.on_answer(id, Ok(()));
    let accepted = (MavCmd::MAV_CMD_USER_1, MavResult::MAV_RESULT_ACCEPTED, 255, 190);
    assert_eq!(results(&mut ground), [accepted]);
    // Its answer was lost: given again, and the planner not asked again.
    let mut repeat = start.clone();
    if let MavMessage::COMMAND_LONG(m) = &mut repeat.message {
        m.confirmation = 1;
    }
    assert!(ground.on_order(6, &repeat, MissionCommand::Start).is_none());
    assert_eq!(results(&mut ground), [accepted]);
    let id = ground.on_order(7, &start, MissionCommand::Start).unwrap().id;
    ground.on_answer(id, Err("the mission has begun already, and what it says is longer than a text".to_owned()));
    let messages = ground.out.clone();
    assert_eq!(results(&mut ground), [(MavCmd::MAV_CMD_USER_1, MavResult::MAV_RESULT_DENIED, 255, 190)]);
    ground.out = messages;
    let said = texts(&mut ground);
    assert_eq!(said.len(), 1);
    assert!(said[0].starts_with("vantage: start refused: the mission has begun already, and"), "{said:?}");
}

/// Nothing is carried out that nobody waits for any more, and no order keeps another out.
#[test]
fn an_order_without_an_answer_is_given_up_for_the_next_or_after_a_while() {
    let mut ground = Ground::new(0);
    let start = command((255, 190), MavCmd::MAV_CMD_USER_1, (1, OWN_COMPONENT));
    let land = command((254, 190), MavCmd::MAV_CMD_USER_3, (1, OWN_COMPONENT));
    let lost = ground.on_order(0, &start, MissionCommand::Start).unwrap().id;
    let passed = ground.on_order(1, &land, MissionCommand::Land).unwrap();
    assert_eq!((passed.order, passed.given_up), (MissionCommand::Land, Some(lost)));
    assert_eq!(results(&mut ground), [(MavCmd::MAV_CMD_USER_1, MavResult::MAV_RESULT_TEMPORARILY_REJECTED, 255, 190)]);
    assert_eq!(ground.overdue(PATIENCE_NS), None);
    assert_eq!(ground.overdue(PATIENCE_NS + 1), Some(passed.id));
    assert_eq!(ground.overdue(PATIENCE_NS + 2), None);
    assert_eq!(results(&mut ground), [(MavCmd::MAV_CMD_USER_3, MavResult::MAV_RESULT_FAILED, 254, 190)]);
    ground.on_answer(passed.id, Ok(()));
    ground.refuse(&start, MissionCommand::Start);
    assert_eq!(results(&mut ground), [(MavCmd::MAV_CMD_USER_1, MavResult::MAV_RESULT_DENIED, 255, 190)]);
}

fn state(phase: MissionPhase, round: u32, keyframes: u32) -> MissionState {
    MissionState { phase: phase.code(), round, keyframes, keyframes_wanted: 48, ..MissionState::default() }
}

#[test]
fn what_is_new_is_told_once() {
    let mut ground = Ground::new(0);
    let flight = [
        (MissionPhase::Takeoff, 0, 0),
        (MissionPhase::Takeoff, 0, 0),
        (MissionPhase::Transit, 1, 4),
        (MissionPhase::Capture, 1, 4),
        (MissionPhase::Training, 1, 5),
        (MissionPhase::Transit, 2, 8),
        (MissionPhase::Suspended, 2, 8),
        (MissionPhase::Transit, 2, 8),
        (MissionPhase::Done, 2, 48),
    ];
    for (phase, round, keyframes) in flight {
        ground.on_mission(0, &state(phase, round, keyframes));
    }
    let expected = [
        "vantage: taking off",
        "vantage: round 1, 4 of 48 views",
        "vantage: round 2, 8 of 48 views",
        "vantage: suspended, waiting for the order to go on",
        "vantage: round 2, 8 of 48 views",
        "vantage: done (none), 48 of 48 views",
    ];
    assert_eq!(texts(&mut ground), expected);
    ground.on_mission(0, &MissionState { phase: 999, ..state(MissionPhase::Idle, 0, 0) });
    assert!(texts(&mut ground).is_empty(), "a phase that is none");
    // Who waits for a human says so again; who does not is silent.
    assert!(ground.take_messages(u64::MAX).is_empty());
    ground.on_mission(5, &state(MissionPhase::Suspended, 2, 8));
    let told = [5, 6, REMINDER_NS + 5, REMINDER_NS + 6].map(|now_ns| ground.take_messages(now_ns).len());
    assert_eq!(told, [1, 0, 1, 0]);
}

proptest! {
    #[test]
    fn any_sentence_fits_its_texts(sentence in ".{0,300}") {
        let mut ground = Ground::new(0);
        ground.tell(MavSeverity::MAV_SEVERITY_INFO, &sentence);
        prop_assert!(ground.out.len() <= MOST_TEXTS);
        let whole: String = texts(&mut ground).concat();
        let ascii: String = sentence.chars().map(|c| if c.is_ascii_graphic() || c == ' ' { c } else { '?' }).collect();
        prop_assert!(ascii.starts_with(&whole) && whole.len() == ascii.len().min(MOST_TEXTS * TEXT_BYTES));
    }
}
