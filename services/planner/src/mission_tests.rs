//! Whole missions, with and without faults.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use shared_types::config::PlannerConfig;
use shared_types::config::planner::{MissionMode, SelectorName, Strategy};
use shared_types::messages::{EndReason, MissionCommand, MissionPhase};

use crate::journal::Record;
use crate::simulated::{Faults, World, setup};
use crate::testing::Scene;

fn rock() -> Scene {
    Scene::single(0.2, -0.3, DVec3::new(1.5, 1.1, 1.0))
}

fn fly(planner: PlannerConfig, faults: Faults) -> (World, EndReason) {
    let mut world = World::new(setup(planner, 7), rock(), faults);
    let end = world.fly(2000.0);
    (world, end)
}

fn short() -> PlannerConfig {
    PlannerConfig { keyframes: 14, ..PlannerConfig::default() }
}

#[test]
fn the_default_mission_takes_48_keyframes_and_lands() {
    let (world, end) = fly(PlannerConfig::default(), Faults::default());
    assert_eq!((end, world.keyframes()), (EndReason::Complete, 48));
    assert!(world.captures.values().all(|&count| count == 1));
    assert_eq!(world.state.unwrap().phase, MissionPhase::Done.code());
    let rounds: Vec<u32> = world
        .journal
        .iter()
        .filter_map(|entry| if let Record::Round { views, .. } = entry.record { Some(views) } else { None })
        .collect();
    assert_eq!(rounds, (1..=12).map(|round| 4 * round).collect::<Vec<_>>());
    assert!(world.least_clearance_m >= 0.72, "{}", world.least_clearance_m);
    assert!(world.state.unwrap().paper_coverage > 0.5, "{}", world.state.unwrap().paper_coverage);
    println!("default: {:.1} s, {:.1} m", world.seconds(), world.state.unwrap().path_m);
    assert!(world.seconds() < 300.0, "{}", world.seconds());
}

#[test]
fn the_papers_mission_takes_48_keyframes_in_the_order_of_algorithm_1() {
    let (world, end) = fly(PlannerConfig::paper(), Faults::default());
    assert_eq!((end, world.keyframes()), (EndReason::Complete, 48));
    println!("paper: {:.1} s, {:.1} m", world.seconds(), world.state.unwrap().path_m);
    // Serial: a round is over before the next batch is scored, and nothing flies meanwhile.
    let mut last = "";
    for entry in &world.journal {
        let step = match &entry.record {
            Record::Round { .. } => "train",
            Record::RoundDone { .. } => "trained",
            Record::Score { .. } => "score",
            Record::Selected { .. } => "selected",
            Record::Captured { .. } => "captured",
            _ => continue,
        };
        let allowed = match step {
            "train" => last == "captured",
            "trained" => last == "train",
            "score" => last == "trained",
            "selected" => last == "score" || last == "captured",
            _ => ["selected", "captured", ""].contains(&last),
        };
        assert!(allowed, "{step} after {last}");
        last = step;
    }
    let total: u32 = world
        .journal
        .iter()
        .filter_map(
            |entry| if let Record::Round { max_iterations, .. } = entry.record { Some(max_iterations) } else { None },
        )
        .sum();
    assert_eq!(total, 750 + (2..=12).map(|k| (50 * 4 * k).clamp(750, 2500)).sum::<u32>());
}

#[test]
fn every_strategy_and_selector_completes() {
    for (strategy, selector, wanted) in [
        (Strategy::Orbit24, SelectorName::DepthVariance, 24),
        (Strategy::OrbitLookAt, SelectorName::DepthVariance, 24),
        (Strategy::Nbv, SelectorName::AngleOnly, 14),
        (Strategy::Nbv, SelectorName::FibonacciOrder, 14),
        (Strategy::Nbv, SelectorName::Random, 14),
        (Strategy::Nbv, SelectorName::UncertaintyOnly, 14),
    ] {
        let keyframes = if strategy == Strategy::Nbv { 14 } else { 48 };
        let (world, end) = fly(PlannerConfig { strategy, selector, keyframes, ..short() }, Faults::default());
        assert_eq!((end, world.keyframes()), (EndReason::Complete, wanted), "{strategy:?} {selector:?}");
        assert!(world.least_clearance_m >= 0.72);
    }
}

#[test]
fn an_orbit_trains_after_every_view() {
    for mode in [MissionMode::Serial, MissionMode::Concurrent] {
        let planner =
            PlannerConfig { strategy: Strategy::Orbit24, mode, stop_when_flat: false, ..PlannerConfig::default() };
        let (world, end) = fly(planner, Faults::default());
        assert_eq!((end, world.keyframes()), (EndReason::Complete, 24));
        let rounds: Vec<u32> = world
            .journal
            .iter()
            .filter_map(|entry| {
                if let Record::Round { max_iterations, .. } = entry.record { Some(max_iterations) } else { None }
            })
            .collect();
        assert_eq!(rounds, [500; 24], "the paper's 12K iterations");
    }
}

#[test]
fn a_mission_whose_every_seed_view_fails_comes_home_at_once() {
    let (world, end) = fly(short(), Faults { failing_capture: 1, failing_after: 2, ..Faults::default() });
    assert_eq!((end, world.keyframes()), (EndReason::NoCandidates, 0));
    assert!(world.seconds() < 200.0, "{}", world.seconds());
}

#[test]
fn a_pilot_takes_his_time_to_arm() {
    let (world, end) = fly(short(), Faults { arming_ticks: 30_000, ..Faults::default() });
    assert_eq!((end, world.keyframes()), (EndReason::Complete, 14));
}

#[test]
fn the_same_seed_writes_the_same_journal() {
    let (a, _) = fly(short(), Faults::default());
    let (b, _) = fly(short(), Faults::default());
    assert_eq!(a.journal, b.journal);
}

#[test]
fn a_px4_link_that_dies_often_ends_no_mission() {
    let link_restarts = (2000..9000).step_by(700).collect();
    let (world, end) = fly(short(), Faults { link_restarts, ..Faults::default() });
    assert_eq!((end, world.keyframes()), (EndReason::Complete, 14));
    assert!(world.captures.values().all(|&count| count == 1));
}

#[test]
fn failed_captures_are_tried_again() {
    let (world, end) = fly(short(), Faults { failing_capture: 5, ..Faults::default() });
    assert_eq!((end, world.keyframes()), (EndReason::Complete, 14));
    assert!(world.journal.iter().any(|entry| matches!(entry.record, Record::CaptureFailed { .. })));
}

#[test]
fn a_low_battery_brings_the_vehicle_home_and_trains_what_there_is() {
    let (world, end) = fly(short(), Faults { drain_per_s: 0.012, ..Faults::default() });
    assert_eq!(end, EndReason::Battery);
    let taken = world.keyframes();
    assert!(taken > 4 && taken < 14, "{taken}");
    let views = world.journal.iter().rev().find_map(|entry| match entry.record {
        Record::Round { views, .. } => Some(views as usize),
        _ => None,
    });
    assert_eq!(views, Some(taken), "the last round trains on everything");
    assert_eq!(world.state.unwrap().phase, MissionPhase::Done.code());
}

#[test]
fn bare_ground_is_scanned_and_then_said_to_be_bare() {
    let mut world = World::new(setup(short(), 1), Scene::default(), Faults::default());
    assert_eq!(world.fly(600.0), EndReason::NoObject);
    assert_eq!(world.state.unwrap().phase, MissionPhase::Failed.code());
    let scans = world
        .journal
        .iter()
        .filter(|entry| matches!(&entry.record, Record::Target { purpose, .. } if purpose == "scan"));
    assert_eq!(scans.count(), 8);
}

#[test]
fn an_object_beside_the_survey_point_is_found_by_the_scan() {
    let scene = Scene::single(4.0, 2.5, DVec3::new(1.2, 1.2, 1.0));
    let mut world = World::new(setup(short(), 1), scene, Faults::default());
    assert_eq!(world.fly(900.0), EndReason::Complete);
    let state = world.state.unwrap();
    assert!(
        (DVec3::from_array(state.box_center_m) - DVec3::new(4.0, 2.5, 0.5)).length() < 0.2,
        "{:?}",
        state.box_center_m
    );
    assert_eq!(world.keyframes(), 14);
}

#[test]
fn the_operator_can_stop_land_hold_and_go_on() {
    for (command, at) in [(MissionCommand::Stop, 6000), (MissionCommand::Land, 6000), (MissionCommand::Stop, 100)] {
        let faults = Faults { commands: BTreeMap::from([(at, command)]), ..Faults::default() };
        assert_eq!(fly(short(), faults).1, EndReason::Operator, "{command}");
    }
    let commands = BTreeMap::from([(6000, MissionCommand::Abort), (7000, MissionCommand::GoOn)]);
    let (world, end) = fly(short(), Faults { commands, ..Faults::default() });
    assert_eq!((end, world.keyframes()), (EndReason::Complete, 14));
}

#[test]
fn a_recalled_mission_lands_and_goes_on_when_it_is_resumed() {
    for at in [40, 700, 3000, 6000] {
        let faults = Faults { commands: BTreeMap::from([(at, MissionCommand::Recall)]), ..Faults::default() };
        let (mut world, end) = fly(short(), faults);
        assert_eq!((end, world.state.unwrap().phase), (EndReason::None, MissionPhase::Failed.code()), "at {at}");
        let ends = |record: &Record| matches!(record, Record::Ending { .. } | Record::Over { .. });
        assert!(!world.journal.iter().any(|entry| ends(&entry.record)), "nothing recorded ends it");
        world.resume();
        assert_eq!((world.fly(2000.0), world.keyframes()), (EndReason::Complete, 14), "at {at}");
        assert!(world.captures.values().all(|&count| count == 1));
    }
}

#[test]
fn a_planner_whose_process_is_to_end_lands_and_the_next_one_goes_on() {
    for at in [700, 3000, 6000] {
        let mut world = World::new(setup(short(), 7), rock(), Faults::default());
        world.step_down_at(at);
        assert_eq!(world.fly(2000.0), EndReason::None, "at {at}");
        // Whoever supervises it is not told that the mission is over: it would end everything.
        assert_eq!(world.state.unwrap().phase, MissionPhase::Landing.code(), "at {at}");
        world.resume();
        assert_eq!((world.fly(2000.0), world.keyframes()), (EndReason::Complete, 14), "at {at}");
        assert!(world.captures.values().all(|&count| count == 1));
    }
}

#[test]
fn after_a_reboot_the_world_is_found_again() {
    for (at, moved_m) in [(4000, DVec3::new(1.9, -1.4, 0.8)), (6000, DVec3::new(-0.7, 0.2, -0.6)), (6000, DVec3::ZERO)]
    {
        let commands = BTreeMap::from([(at, MissionCommand::Recall)]);
        let (mut world, _) = fly(short(), Faults { commands, ..Faults::default() });
        let before = world.keyframes();
        world.reboot(moved_m, rock());
        let end = world.fly(2000.0);
        assert_eq!((end, world.keyframes()), (EndReason::Complete, 14), "{moved_m}: {before} before");
        assert!(world.off_m.length() < 0.03, "still off by {} after {moved_m}", world.off_m);
        let clearance_m = PlannerConfig::default().clearance_m;
        assert!(world.least_clearance_m > clearance_m - 0.1, "{}", world.least_clearance_m);
        assert!(world.journal.iter().any(|entry| matches!(entry.record, Record::Aligned { .. })));
        // Once for this flight.
        world.resume();
        assert!(world.captures.values().all(|&count| count == 1));
    }
}

#[test]
fn a_flight_that_is_cut_off_while_the_world_is_looked_for_leaves_nothing_to_the_next() {
    for after in [300, 900, 1200, 1500, 1800, 2400] {
        let commands = BTreeMap::from([(6000, MissionCommand::Recall)]);
        let (mut world, _) = fly(short(), Faults { commands, ..Faults::default() });
        world.reboot(DVec3::new(1.5, 1.0, 0.7), rock());
        let at = world.tick() + after;
        // Brought down by px4-link, and started anew with yet another origin.
        world.step_down_at(at);
        world.fly(2000.0);
        world.reboot(DVec3::new(-1.0, 0.8, -0.6), rock());
        assert_eq!((world.fly(3000.0), world.keyframes()), (EndReason::Complete, 14), "{after}");
        assert!(world.off_m.length() < 0.05, "still off by {} after {after}", world.off_m);
    }
}

#[test]
fn whatever_was_under_way_when_the_first_flight_ended_the_next_completes() {
    // Between batches, with scores asked for, before and after the prior.
    for at in (500..9000).step_by(500) {
        let commands = BTreeMap::from([(at, MissionCommand::Recall)]);
        let (mut world, end) = fly(short(), Faults { commands, ..Faults::default() });
        if end != EndReason::None {
            break;
        }
        world.reboot(DVec3::new(0.9, -0.6, 0.4), rock());
        assert_eq!((world.fly(3000.0), world.keyframes()), (EndReason::Complete, 14), "{at}");
    }
}

#[test]
fn a_planner_that_dies_on_the_way_home_of_a_refusal_does_not_search_again() {
    let commands = BTreeMap::from([(6000, MissionCommand::Recall)]);
    let (mut world, _) = fly(short(), Faults { commands, ..Faults::default() });
    world.reboot(DVec3::new(0.5, 0.3, 0.0), Scene::default());
    world.fly_until(|entry| matches!(entry.record, Record::Misaligned { .. }));
    world.resume();
    assert_eq!(world.fly(2000.0), EndReason::Misaligned);
    let refusals = world.journal.iter().filter(|entry| matches!(entry.record, Record::Misaligned { .. })).count();
    assert_eq!(refusals, 1);
}

#[test]
fn an_object_that_is_gone_or_another_is_refused_with_the_figure() {
    for scene in [Scene::default(), Scene::single(0.0, 0.0, DVec3::new(0.6, 2.4, 1.9))] {
        let commands = BTreeMap::from([(6000, MissionCommand::Recall)]);
        let (mut world, _) = fly(short(), Faults { commands, ..Faults::default() });
        let before = world.keyframes();
        world.reboot(DVec3::new(0.5, 0.3, 0.0), scene);
        assert_eq!((world.fly(2000.0), world.keyframes()), (EndReason::Misaligned, before));
        let why = world.journal.iter().rev().find_map(|entry| match &entry.record {
            Record::Misaligned { why, .. } => Some(why.clone()),
            _ => None,
        });
        assert!(why.is_some_and(|why| why.contains("object")));
        // Put back, it goes on.
        world.reboot(DVec3::new(-0.5, 0.3, 0.0), rock());
        assert_eq!((world.fly(3000.0), world.keyframes()), (EndReason::Complete, 14));
    }
}

#[test]
fn a_held_mission_can_be_recalled_and_a_recalled_one_stopped() {
    let commands = BTreeMap::from([(6000, MissionCommand::Abort), (7000, MissionCommand::Recall)]);
    let (mut world, end) = fly(short(), Faults { commands, ..Faults::default() });
    assert_eq!(end, EndReason::None);
    world.resume();
    assert_eq!((world.fly(2000.0), world.keyframes()), (EndReason::Complete, 14));
    let commands = BTreeMap::from([(6000, MissionCommand::Recall), (6050, MissionCommand::Stop)]);
    assert_eq!(fly(short(), Faults { commands, ..Faults::default() }).1, EndReason::Operator);
}

#[test]
fn a_mission_told_to_end_before_it_began_is_over_and_may_be_begun_later() {
    for command in [MissionCommand::Stop, MissionCommand::Land, MissionCommand::Abort] {
        let (mut world, end) = fly(short(), Faults { commands: BTreeMap::from([(1, command)]), ..Faults::default() });
        assert_eq!((end, world.state.unwrap().phase), (EndReason::Operator, MissionPhase::Failed.code()));
        assert!(world.journal.is_empty(), "nothing was begun");
        world.resume();
        assert_eq!((world.fly(2000.0), world.keyframes()), (EndReason::Complete, 14));
    }
}

#[test]
fn a_pilot_is_waited_for() {
    let (pilots, commands) = (BTreeMap::from([(5000, 500)]), BTreeMap::from([(5500, MissionCommand::GoOn)]));
    let (world, end) = fly(short(), Faults { pilots, commands, ..Faults::default() });
    assert_eq!((end, world.keyframes()), (EndReason::Complete, 14));
    assert!(world.journal.iter().any(|entry| entry.record == Record::Suspended));
}

#[test]
fn the_time_limit_nothing_to_gain_and_a_lost_snapshot() {
    let (_, end) = fly(PlannerConfig { max_mission_s: 60.0, ..short() }, Faults::default());
    assert_eq!(end, EndReason::Time);
    let (world, end) = fly(PlannerConfig { stop_gain: 0.4, ..PlannerConfig::default() }, Faults::default());
    assert_eq!(end, EndReason::NothingToGain);
    assert!(world.keyframes() < 48);
    let (world, end) = fly(short(), Faults { generation_gone: true, ..Faults::default() });
    assert_eq!((end, world.keyframes()), (EndReason::Complete, 14));
}

#[test]
fn an_obstacle_beside_the_object_is_flown_around() {
    let (world, end) = fly(short(), Faults { wall: true, ..Faults::default() });
    assert_eq!((end, world.keyframes()), (EndReason::Complete, 14));
}

#[test]
fn a_mission_that_is_over_stays_over() {
    let (world, _) = fly(short(), Faults::default());
    let mission = crate::mission::Mission::new(world.setup.clone(), &world.journal);
    assert!(mission.is_over());
}

#[test]
fn a_planner_that_dies_between_touchdown_and_disarming_waits_for_the_disarming() {
    let (calm, _) = fly(short(), Faults::default());
    let last = calm.tick();
    for before in [20, 100, 150, 190] {
        let faults = Faults { restarts: BTreeMap::from([(last - before, 10)]), ..Faults::default() };
        assert_eq!(fly(short(), faults).1, EndReason::Complete);
    }
}

fn an_order() -> impl proptest::strategy::Strategy<Value = MissionCommand> {
    proptest::sample::select(vec![
        MissionCommand::Stop,
        MissionCommand::Abort,
        MissionCommand::Land,
        MissionCommand::GoOn,
        MissionCommand::Recall,
    ])
}

proptest::proptest! {
    #![proptest_config(proptest::test_runner::Config::with_cases(24))]
    #[test]
    fn after_deaths_every_keyframe_exists_once_and_the_choice_is_the_same(
        deaths in proptest::collection::btree_map(50u64..13_000, 1u64..400, 1..5),
        link in proptest::collection::btree_set(1500u64..13_000, 0..3),
        serial in proptest::bool::ANY,
    ) {
        let mode = if serial { MissionMode::Serial } else { MissionMode::Concurrent };
        let planner = PlannerConfig { mode, ..short() };
        let (calm, _) = fly(planner.clone(), Faults::default());
        let faults = Faults { restarts: deaths, link_restarts: link, ..Faults::default() };
        let (world, end) = fly(planner, faults);
        proptest::prop_assert_eq!(end, EndReason::Complete);
        proptest::prop_assert_eq!(world.keyframes(), 14);
        proptest::prop_assert!(world.captures.values().all(|&count| count == 1));
        proptest::prop_assert_eq!(world.selections(), calm.selections());
        proptest::prop_assert!(world.least_clearance_m >= 0.72);
        let ids: BTreeSet<u64> = world.journal.iter().filter_map(|entry| match &entry.record {
            Record::Captured { keyframe_id, .. } => Some(*keyframe_id),
            _ => None,
        }).collect();
        proptest::prop_assert_eq!(ids.len(), 14 + 2);
    }
    /// Always a way to the ground: an operator says anything at any time, a pilot comes and goes, processes die; when the
    /// pilot has let go and the operator says go on, and stop, it lands. A mission that is still open then is resumed.
    #[test]
    fn whatever_operator_and_pilot_do_it_lands_with_every_keyframe_once(
        said in proptest::collection::btree_map(100u64..12_000, an_order(), 0..6),
        pilots in proptest::collection::btree_map(1500u64..12_000, 20u64..900, 0..3),
        deaths in proptest::collection::btree_map(50u64..13_000, 1u64..400, 0..3),
        link in proptest::collection::btree_set(1500u64..13_000, 0..3),
    ) {
        let mut commands = said;
        for at in (13_000..400_000).step_by(800) {
            commands.insert(at, MissionCommand::GoOn);
            commands.insert(at + 400, MissionCommand::Stop);
        }
        let faults = Faults { restarts: deaths, link_restarts: link, pilots, commands, ..Faults::default() };
        let mut world = World::new(setup(short(), 7), rock(), faults);
        let is_over = |world: &World| world.journal.iter().any(|entry| matches!(entry.record, Record::Over { .. }));
        for _ in 0..8 {
            world.fly(3000.0);
            if is_over(&world) {
                break;
            }
            world.resume();
        }
        proptest::prop_assert!(is_over(&world), "open after all: {:?}", world.journal.last());
        proptest::prop_assert!(world.captures.values().all(|&count| count == 1));
        proptest::prop_assert!(world.least_clearance_m >= 0.72, "{}", world.least_clearance_m);
        let mut ended = false;
        for entry in &world.journal {
            ended |= matches!(entry.record, Record::Ending { .. });
            proptest::prop_assert!(!ended || !matches!(entry.record, Record::Selected { .. }), "chosen after the end");
        }
        let ids: Vec<u64> = world.journal.iter().filter_map(|entry| match &entry.record {
            Record::Captured { keyframe_id, .. } => Some(*keyframe_id),
            _ => None,
        }).collect();
        proptest::prop_assert_eq!(ids.iter().collect::<BTreeSet<_>>().len(), ids.len(), "twice in the journal");
    }
}
