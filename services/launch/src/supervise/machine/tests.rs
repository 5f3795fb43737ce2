use super::*;
use ServiceName::{Camera, Keeper, Planner, Px4Link, Recorder, Scorer, Simulator, Trainer, World};

const POLICY: Policy = Policy {
    restart_delay_ms: 100,
    restart_delay_max_ms: 1000,
    crash_limit: 3,
    crash_window_ms: 10_000,
    stop_timeout_ms: 500,
    landing_timeout_ms: 60_000,
    keeper_timeout_ms: 2_000,
    silence_ms: 10_000,
    start_ms: 60_000,
    stall_ms: 120_000,
    hold_on_fault: false,
};

fn flying() -> Supervisor {
    let mut supervisor = started();
    assert!(supervisor.step(30, &Event::Armed).is_empty());
    supervisor
}

/// All services run; the motors never did.
fn started() -> Supervisor {
    let mut supervisor = Supervisor::new(POLICY, &START_ORDER);
    assert_eq!(supervisor.step(0, &Event::Begin), [Action::Start(Keeper)]);
    let started = supervisor.step(10, &Event::Heard(Keeper));
    assert_eq!(started, START_ORDER[1..].iter().map(|s| Action::Start(*s)).collect::<Vec<_>>());
    for service in START_ORDER {
        assert!(supervisor.step(20, &Event::Heard(service)).is_empty());
    }
    supervisor
}

fn exit(service: ServiceName, code: Option<i32>) -> Event {
    Event::Exited { service, code }
}

/// Answers every `Ask` and `Kill` with the process's end until the run is over.
fn run_out(supervisor: &mut Supervisor, mut now_ms: u64, mut actions: Vec<Action>) -> (Vec<ServiceName>, Outcome) {
    let mut stopped = Vec::new();
    for _ in 0..100 {
        let mut next = Vec::new();
        for action in actions {
            match action {
                Action::Ask(service) | Action::Kill(service) => {
                    stopped.push(service);
                    next.extend(supervisor.step(now_ms, &exit(service, Some(0))));
                }
                Action::Finish(outcome) => return (stopped, outcome),
                _ => {}
            }
        }
        now_ms += 50;
        next.extend(supervisor.step(now_ms, &Event::Tick));
        actions = next;
    }
    panic!("never over; stopped {stopped:?}");
}

#[test]
fn a_planner_whose_journal_finds_no_room_is_started_again_in_the_air_and_not_on_the_ground() {
    let mut supervisor = flying();
    assert!(supervisor.step(1_000, &exit(Planner, Some(69))).is_empty());
    assert_eq!(supervisor.step(1_200, &Event::Tick), [Action::Start(Planner)]);
    supervisor.step(1_300, &Event::Disarmed);
    let actions = supervisor.step(1_400, &exit(Planner, Some(69)));
    let (stopped, outcome) = run_out(&mut supervisor, 1_400, actions);
    assert_eq!(outcome, Outcome::Broken { service: Planner, code: Some(69), worked: false });
    assert!(stopped.contains(&Keeper) && !stopped.contains(&Planner), "{stopped:?}");
}

#[test]
fn the_others_start_without_the_keepers_word_after_a_while() {
    let mut supervisor = Supervisor::new(POLICY, &START_ORDER);
    supervisor.step(0, &Event::Begin);
    assert!(supervisor.step(1_999, &Event::Tick).is_empty());
    assert_eq!(supervisor.step(2_000, &Event::Tick).len(), START_ORDER.len() - 1);
}

#[test]
fn the_dead_are_started_again_after_a_wait_that_doubles() {
    let mut supervisor = flying();
    let mut now = 1_000;
    for wait in [100, 200, 400] {
        assert!(supervisor.step(now, &exit(Trainer, None)).is_empty());
        assert!(supervisor.step(now + wait - 1, &Event::Tick).is_empty(), "too early");
        assert_eq!(supervisor.step(now + wait, &Event::Tick), [Action::Start(Trainer)]);
        now += wait + 10;
    }
    assert_eq!(supervisor.restarts(), BTreeMap::from([(Trainer, 3)]));
    // Long after, the same service's death begins with a short wait again.
    assert!(supervisor.step(100_000, &exit(Trainer, None)).is_empty());
    assert_eq!(supervisor.step(100_100, &Event::Tick), [Action::Start(Trainer)]);
}

#[test]
fn a_service_that_keeps_dying_sends_the_vehicle_home_and_breaks_the_run() {
    let mut supervisor = flying();
    let mut now = 1_000;
    let mut last = Vec::new();
    for _ in 0..=POLICY.crash_limit {
        last = supervisor.step(now, &exit(Scorer, Some(70)));
        now += 1_000;
        supervisor.step(now, &Event::Tick);
    }
    assert!(last.contains(&Action::CommandRecall), "the mission stays open: {last:?}");
    assert!(!last.contains(&Action::CommandStop), "{last:?}");
    assert!(supervisor.is_ending());
    // A planner that dies on the way home is told again.
    supervisor.step(now, &exit(Planner, None));
    now += 200;
    assert_eq!(supervisor.step(now, &Event::Tick), [Action::Start(Planner), Action::CommandRecall]);
    let actions = supervisor.step(now + 100, &Event::MissionOver { usable: true });
    let (stopped, outcome) = run_out(&mut supervisor, now + 200, actions);
    assert_eq!(outcome, Outcome::Broken { service: Scorer, code: Some(70), worked: true });
    assert!(!stopped.contains(&Scorer));
}

#[test]
fn when_the_planner_keeps_dying_the_landed_vehicle_ends_the_run() {
    let mut supervisor = flying();
    assert!(supervisor.step(500, &Event::Disarmed).is_empty(), "on the ground before takeoff is not the end");
    for death in 0..=POLICY.crash_limit as u64 {
        supervisor.step(1_000 * death, &exit(Planner, None));
        supervisor.step(1_000 * death + 999, &Event::Tick);
    }
    let actions = supervisor.step(30_000, &Event::Disarmed);
    let (_, outcome) = run_out(&mut supervisor, 30_000, actions);
    assert!(matches!(outcome, Outcome::Broken { service: Planner, .. }));
}

#[test]
fn before_the_motors_ever_ran_a_service_that_keeps_dying_ends_the_run_at_once() {
    let mut supervisor = started();
    let mut actions = Vec::new();
    for death in 0..=POLICY.crash_limit as u64 {
        assert!(!actions.contains(&Action::Ask(Planner)), "too early");
        actions = supervisor.step(1_000 * death, &exit(Trainer, Some(70)));
        supervisor.step(1_000 * death + 999, &Event::Tick);
    }
    assert!(actions.contains(&Action::Ask(Planner)) && !actions.contains(&Action::CommandRecall), "{actions:?}");
    let (_, outcome) = run_out(&mut supervisor, 5_000, actions);
    assert_eq!(outcome, Outcome::Broken { service: Trainer, code: Some(70), worked: true });
}

#[test]
fn an_interrupt_before_the_motors_ever_ran_stops_in_order_and_is_not_forgotten() {
    let mut supervisor = started();
    let actions = supervisor.step(1_000, &Event::Interrupt);
    assert!(actions.contains(&Action::Ask(Planner)) && !actions.contains(&Action::CommandStop), "{actions:?}");
    let (stopped, outcome) = run_out(&mut supervisor, 1_000, actions);
    assert_eq!((stopped.len(), outcome), (START_ORDER.len(), Outcome::Failed));
}

#[test]
fn the_users_first_interrupt_on_the_way_home_only_says_what_is_going_on() {
    let mut supervisor = flying();
    for death in 0..=POLICY.crash_limit as u64 {
        supervisor.step(1_000 * death, &exit(Scorer, Some(70)));
        supervisor.step(1_000 * death + 999, &Event::Tick);
    }
    let first = supervisor.step(6_000, &Event::Interrupt);
    assert!(matches!(first[..], [Action::Say(_)]), "{first:?}");
    let second = supervisor.step(7_000, &Event::Interrupt);
    assert!(second.contains(&Action::VehicleHold) && second.contains(&Action::Kill(Px4Link)), "{second:?}");
    assert_eq!(run_out(&mut supervisor, 7_000, second).1, Outcome::Aborted);
}

#[test]
fn while_services_stop_the_second_interrupt_kills_and_holds_what_still_flies() {
    for flies in [false, true] {
        let mut supervisor = flying();
        if !flies {
            supervisor.step(900, &Event::Disarmed);
        }
        supervisor.step(1_000, &Event::MissionOver { usable: true });
        let first = supervisor.step(1_100, &Event::Interrupt);
        assert!(matches!(first[..], [Action::Say(_)]), "{first:?}");
        let second = supervisor.step(1_200, &Event::Interrupt);
        assert_eq!(second.contains(&Action::VehicleHold), flies, "{second:?}");
        assert!(second.contains(&Action::Kill(Keeper)));
        let outcome = run_out(&mut supervisor, 1_200, second).1;
        assert_eq!(outcome, if flies { Outcome::Aborted } else { Outcome::Done }, "a landed mission is what it was");
    }
}

#[test]
fn a_service_that_refuses_its_configuration_ends_the_run_at_once() {
    for code in [64, 69] {
        let mut supervisor = Supervisor::new(POLICY, &START_ORDER);
        supervisor.step(0, &Event::Begin);
        supervisor.step(10, &Event::Heard(Keeper));
        let actions = supervisor.step(100, &exit(World, Some(code)));
        let (stopped, outcome) = run_out(&mut supervisor, 100, actions);
        assert_eq!(outcome, Outcome::Broken { service: World, code: Some(code), worked: false });
        assert_eq!(stopped.len(), START_ORDER.len() - 1);
    }
}

#[test]
fn what_is_missing_before_the_takeoff_is_named_by_its_own_exit_code() {
    // Members that never came: the simulator had been heard for a minute.
    let mut supervisor = started();
    let actions = supervisor.step(60_000, &exit(Simulator, Some(69)));
    assert!(!actions.iter().any(|action| matches!(action, Action::Kill(_))), "stopped in order: {actions:?}");
    let (_, outcome) = run_out(&mut supervisor, 60_000, actions);
    assert_eq!(outcome, Outcome::Broken { service: Simulator, code: Some(69), worked: false });
    // In flight, a service that lost its bus for an instant is started again.
    let mut supervisor = flying();
    assert!(supervisor.step(1_000, &exit(Camera, Some(69))).is_empty());
    assert_eq!(supervisor.step(1_100, &Event::Tick), [Action::Start(Camera)]);
}

#[test]
fn the_simulator_is_not_started_again_once_it_has_flown() {
    let mut supervisor = flying();
    let actions = supervisor.step(5_000, &exit(Simulator, None));
    assert!(!actions.contains(&Action::Start(Simulator)));
    let (_, outcome) = run_out(&mut supervisor, 5_000, actions);
    assert_eq!(outcome, Outcome::Broken { service: Simulator, code: None, worked: true });
}

#[test]
fn a_finished_mission_stops_in_order() {
    let mut supervisor = flying();
    let actions = supervisor.step(9_000, &Event::MissionOver { usable: true });
    let (stopped, outcome) = run_out(&mut supervisor, 9_000, actions);
    assert_eq!(outcome, Outcome::Done);
    assert_eq!(stopped.len(), START_ORDER.len());
    assert_eq!(stopped[5..], [Px4Link, Recorder, Simulator, Keeper]);
}

#[test]
fn the_first_interrupt_lands_and_the_second_holds_and_kills() {
    let mut supervisor = flying();
    let first = supervisor.step(1_000, &Event::Interrupt);
    assert!(
        first.contains(&Action::CommandStop) && !first.iter().any(|a| matches!(a, Action::Ask(_) | Action::Kill(_)))
    );
    assert!(supervisor.step(2_000, &exit(Camera, None)).is_empty());
    assert_eq!(supervisor.step(2_100, &Event::Tick), [Action::Start(Camera)], "still kept alive on the way home");
    let second = supervisor.step(3_000, &Event::Interrupt);
    assert!(second.contains(&Action::VehicleHold));
    assert_eq!(second.iter().filter(|a| matches!(a, Action::Kill(_))).count(), START_ORDER.len());
    let (_, outcome) = run_out(&mut supervisor, 3_000, second);
    assert_eq!(outcome, Outcome::Aborted);
}

#[test]
fn an_interrupted_mission_that_lands_with_a_model_is_done() {
    let mut supervisor = flying();
    supervisor.step(1_000, &Event::Interrupt);
    let actions = supervisor.step(20_000, &Event::MissionOver { usable: true });
    assert_eq!(run_out(&mut supervisor, 20_000, actions).1, Outcome::Done);
}

#[test]
fn a_vehicle_that_does_not_land_is_not_waited_for_for_ever() {
    let mut supervisor = flying();
    supervisor.step(1_000, &Event::Interrupt);
    assert!(supervisor.step(60_999, &Event::Tick).is_empty());
    let actions = supervisor.step(61_000, &Event::Tick);
    assert!(actions.contains(&Action::Ask(Planner)));
    assert_eq!(run_out(&mut supervisor, 61_000, actions).1, Outcome::NotLanded);
}

#[test]
fn who_does_not_stop_is_killed_but_px4_link_gets_the_time_to_fly_home() {
    let mut supervisor = flying();
    supervisor.step(1_000, &Event::MissionOver { usable: true });
    for service in [Planner, Scorer, Trainer, Camera] {
        supervisor.step(1_100, &exit(service, Some(0)));
    }
    let actions = supervisor.step(1_500, &Event::Tick);
    assert!(actions.contains(&Action::Kill(World)) && !actions.contains(&Action::Kill(Planner)), "{actions:?}");
    let actions = supervisor.step(1_550, &exit(World, None));
    assert_eq!(actions, [Action::Ask(Px4Link)]);
    assert!(supervisor.step(1_550 + 59_000, &Event::Tick).is_empty());
    assert!(supervisor.step(1_550 + 60_000, &Event::Tick).contains(&Action::Kill(Px4Link)));
}

fn examined(actions: &[Action]) -> Vec<(ServiceName, bool)> {
    let examine = |action: &Action| match action {
        Action::Examine { service, kill } => Some((*service, *kill)),
        _ => None,
    };
    actions.iter().filter_map(examine).collect()
}

/// Everybody but `silent` speaks each second from `from_ms` until `to_ms`; gives what is done about it.
fn speak(supervisor: &mut Supervisor, silent: ServiceName, from_ms: u64, to_ms: u64) -> Vec<Action> {
    let mut actions = Vec::new();
    for now_ms in (from_ms..to_ms).step_by(500) {
        for service in START_ORDER.into_iter().filter(|service| *service != silent) {
            actions.extend(supervisor.step(now_ms, &Event::Heard(service)));
        }
    }
    actions
}

#[test]
fn who_is_silent_is_killed_once_and_mended_like_the_dead() {
    let mut supervisor = flying();
    assert_eq!(examined(&speak(&mut supervisor, Camera, 500, 10_000)), []);
    let actions = speak(&mut supervisor, Camera, 10_000, 14_000);
    assert_eq!(examined(&actions), [(Camera, true)]);
    assert!(
        actions.contains(&Action::Say("camera has said nothing for 10 s: it is killed and started again".to_owned()))
    );
    assert!(supervisor.step(14_000, &exit(Camera, None)).is_empty());
    assert_eq!(supervisor.step(14_100, &Event::Tick), [Action::Start(Camera)]);
    // A new process has the time of a start.
    assert_eq!(examined(&speak(&mut supervisor, Camera, 14_500, 74_000)), []);
    assert_eq!(examined(&speak(&mut supervisor, Camera, 74_000, 75_000)), [(Camera, true)]);
}

#[test]
fn a_job_without_progress_is_a_hang() {
    let mut supervisor = flying();
    assert_eq!(examined(&supervisor.step(500, &Event::Stalled(Trainer, 119_999))), []);
    assert_eq!(examined(&supervisor.step(600, &Event::Stalled(Trainer, 120_000))), [(Trainer, true)]);
    assert_eq!(examined(&supervisor.step(700, &Event::Stalled(Trainer, 121_000))), [], "once");
}

#[test]
fn a_supervisor_that_was_stopped_blames_nobody_for_it() {
    let mut supervisor = flying();
    speak(&mut supervisor, Planner, 500, 6_000);
    assert_eq!(examined(&supervisor.step(60_000, &Event::Tick)), []);
    // The silence of before still counts.
    assert_eq!(examined(&speak(&mut supervisor, Planner, 60_000, 64_000)), []);
    assert_eq!(examined(&speak(&mut supervisor, Planner, 64_000, 65_500)), [(Planner, true)]);
}

#[test]
fn a_service_in_a_debugger_may_be_silent() {
    let mut supervisor = flying();
    assert_eq!(examined(&speak(&mut supervisor, Scorer, 500, 11_000)), [(Scorer, true)]);
    assert!(supervisor.step(11_000, &Event::Debugged(Scorer)).is_empty());
    assert_eq!(examined(&speak(&mut supervisor, Scorer, 11_100, 21_000)), []);
    assert_eq!(examined(&speak(&mut supervisor, Scorer, 21_000, 22_500)), [(Scorer, true)]);
}

#[test]
fn faults_are_held_for_a_debugger_where_that_was_asked_for() {
    let mut supervisor = Supervisor::new(Policy { hold_on_fault: true, ..POLICY }, &START_ORDER);
    supervisor.step(0, &Event::Begin);
    for service in START_ORDER {
        supervisor.step(20, &Event::Heard(service));
    }
    supervisor.step(30, &Event::Armed);
    let said = supervisor.step(100, &exit(Trainer, None));
    assert!(matches!(&said[..], [Action::Say(text)] if text.contains("vantage trainer")), "{said:?}");
    let actions = speak(&mut supervisor, Camera, 500, 12_000);
    assert_eq!(examined(&actions), [(Camera, false)]);
    assert!(!actions.contains(&Action::Start(Trainer)) && !supervisor.is_ending(), "{actions:?}");
    // The user's interrupt ends it as ever.
    assert!(supervisor.step(12_000, &Event::Interrupt).contains(&Action::CommandStop));
    let actions = supervisor.step(13_000, &Event::MissionOver { usable: true });
    assert_eq!(run_out(&mut supervisor, 13_000, actions).1, Outcome::Done);
}

proptest::proptest! {
    /// Whatever happens in whatever order, no service runs twice, and a run that is interrupted often enough ends.
    #[test]
    fn nothing_runs_twice_and_every_run_can_be_ended(script in proptest::collection::vec((0_u8..9, 0_usize..8, 0_u64..800), 0..120)) {
        let mut supervisor = Supervisor::new(POLICY, &START_ORDER);
        let mut alive: std::collections::BTreeSet<ServiceName> = std::collections::BTreeSet::new();
        let mut over = false;
        let mut events = vec![Event::Begin];
        for (kind, service, wait) in script {
            let service = START_ORDER[service];
            events.push(match kind {
                0 => Event::Interrupt,
                1 => Event::MissionOver { usable: wait % 2 == 0 },
                2 => Event::Heard(service),
                3 => Event::Disarmed,
                4 => Event::Tick,
                5 => Event::Armed,
                6 => Event::Stalled(service, wait * 1_000),
                7 => Event::Debugged(service),
                _ => exit(service, None),
            });
        }
        events.extend([Event::Interrupt, Event::Interrupt, Event::Interrupt]);
        events.extend(std::iter::repeat_n(Event::Tick, 40));
        let mut now = 0;
        for event in events {
            now += 250;
            if let Event::Exited { service, .. } = event && !alive.remove(&service) {
                continue;
            }
            let mut queue = supervisor.step(now, &event);
            while !queue.is_empty() {
                let mut next = Vec::new();
                for action in queue {
                    match action {
                        Action::Start(service) => {
                            proptest::prop_assert!(!over && alive.insert(service), "{service} runs twice or after the end");
                        }
                        Action::Kill(service) | Action::Examine { service, kill: true } if alive.remove(&service) => {
                            next.extend(supervisor.step(now, &exit(service, None)));
                        }
                        Action::Finish(_) => over = true,
                        _ => {}
                    }
                }
                queue = next;
            }
        }
        proptest::prop_assert!(over && alive.is_empty(), "alive: {alive:?}");
    }
}

#[test]
fn a_mission_goes_on_without_a_recorder_that_keeps_dying() {
    let mut supervisor = flying();
    let mut now_ms = 100;
    let mut said = Vec::new();
    for _ in 0..=POLICY.crash_limit {
        let exited = Event::Exited { service: Recorder, code: Some(70) };
        said.extend(supervisor.step(now_ms, &exited));
        now_ms += POLICY.restart_delay_max_ms;
        said.extend(supervisor.step(now_ms, &Event::Tick));
    }
    let words: Vec<_> = said.iter().filter(|action| matches!(action, Action::Say(_))).collect();
    let [Action::Say(text)] = words[..] else { panic!("{words:?}") };
    assert!(text.contains("the mission goes on without it"), "{text}");
    assert!(!supervisor.is_ending());
    assert!(!said.contains(&Action::CommandRecall));
}
