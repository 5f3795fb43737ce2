use super::*;

fn view(now_ms: u64, mode: FlightMode) -> View {
    View {
        now_ns: now_ms * 1_000_000,
        mode,
        armed: true,
        landed: false,
        armable: true,
        speed_mps: 0.0,
        flown_back: false,
        streaming: true,
    }
}

fn hold() -> Procedure {
    Procedure::new(VehicleCommand::Hold, &[Stage::Mode { mode: FlightMode::Hold, always: false }])
}

fn sent(wishes: &[Wish]) -> Option<u8> {
    wishes.iter().find_map(|wish| if let Wish::Command(_, _, confirmation) = wish { Some(*confirmation) } else { None })
}

#[test]
fn an_acknowledgement_alone_confirms_nothing() {
    let mut procedure = hold();
    assert_eq!(sent(&procedure.turn(&view(0, FlightMode::Offboard)).0), Some(0));
    procedure.acknowledged(10_000_000, MavCmd::MAV_CMD_DO_SET_MODE, MavResult::MAV_RESULT_ACCEPTED);
    assert_eq!(procedure.turn(&view(20, FlightMode::Offboard)).1, Outcome::Working);
    assert_eq!(procedure.turn(&view(30, FlightMode::Hold)).1, Outcome::Done);
}

#[test]
fn four_tries_without_an_answer_fail_and_count_up() {
    let mut procedure = hold();
    let mut counts = Vec::new();
    for ms in (0..4_000).step_by(10) {
        let (wishes, outcome) = procedure.turn(&view(ms, FlightMode::Offboard));
        counts.extend(sent(&wishes));
        if let Outcome::Failed(reason) = outcome {
            assert!(ms == 2_000 && reason.contains("not acknowledged"), "{ms} {reason}");
            assert_eq!(counts, [0, 1, 2, 3]);
            return;
        }
    }
    panic!("never failed");
}

#[test]
fn accepted_without_effect_is_said_so_and_denial_ends_at_once() {
    let mut procedure = hold();
    let mut reason = None;
    for ms in (0..20_000).step_by(10) {
        let (wishes, outcome) = procedure.turn(&view(ms, FlightMode::Offboard));
        if sent(&wishes).is_some() {
            procedure.acknowledged(ms, MavCmd::MAV_CMD_DO_SET_MODE, MavResult::MAV_RESULT_ACCEPTED);
        }
        if let Outcome::Failed(text) = outcome {
            reason = Some(text);
            break;
        }
    }
    assert!(reason.is_some_and(|text| text.contains("without effect")));
    let mut denied = hold();
    denied.turn(&view(0, FlightMode::Offboard));
    let answer = denied.acknowledged(1, MavCmd::MAV_CMD_DO_SET_MODE, MavResult::MAV_RESULT_DENIED);
    assert!(answer.is_some_and(|text| text.contains("denied")));
}

#[test]
fn a_failsafes_hold_is_commanded_all_the_same() {
    let mut procedure =
        Procedure::new(VehicleCommand::TakeControl, &[Stage::Mode { mode: FlightMode::Hold, always: true }]);
    assert_eq!(sent(&procedure.turn(&view(0, FlightMode::Hold)).0), Some(0));
    procedure.acknowledged(1, MavCmd::MAV_CMD_DO_SET_MODE, MavResult::MAV_RESULT_ACCEPTED);
    assert_eq!(procedure.turn(&view(10, FlightMode::Hold)).1, Outcome::Done);
}

#[test]
fn unused_parameters_are_not_numbers() {
    for stage in [Stage::Arm, Stage::Takeoff { above_sea_m: 490.0 }] {
        let (_, params) = command_of(stage).expect("a command");
        assert_eq!(params.iter().filter(|p| p.is_nan()).count(), 6);
    }
    assert_eq!(set_mode(FlightMode::Land).1[..3], [1.0, 4.0, 6.0]);
}
