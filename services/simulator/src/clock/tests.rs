//! The clock's rules, one by one (architecture, "Time").

use super::*;

const MS: u64 = 1_000_000;
const LINK: u32 = 4;
const PLANNER: u32 = 8;

fn grant(service: u32, tick: u64) -> Grant {
    Grant {
        clock_incarnation: 7,
        service,
        incarnation: 100,
        pid: 1000 + service,
        tick,
        work: 0,
        datagrams: 0,
        leaving: false,
        held: false,
    }
}

fn clock(speed: f64) -> Lockstep {
    Lockstep::new(7, &[LINK, PLANNER], LINK, speed, 0)
}

/// A clock that has begun tick 1 at wall time 0.
fn begun(speed: f64) -> Lockstep {
    let mut clock = clock(speed);
    for member in [LINK, PLANNER] {
        clock.on_grant(&grant(member, 0), 0, 0);
    }
    assert_eq!(clock.poll(0, 10 * MS), Phase::Ready);
    clock.advance(0);
    clock
}

#[test]
fn tick_0_stands_until_all_have_granted_it_and_names_who_never_came() {
    let mut clock = clock(0.0);
    assert_eq!(clock.poll(0, 0), Phase::Gathering(vec![LINK, PLANNER]));
    clock.on_grant(&grant(LINK, 0), 0, MS);
    assert_eq!(clock.poll(0, 59_000 * MS), Phase::Gathering(vec![PLANNER]));
    assert_eq!(clock.poll(0, 60_000 * MS), Phase::GatheringFailed(vec![PLANNER]));
    assert_eq!(clock.members_in(), 1 << LINK);
}

#[test]
fn the_next_tick_begins_when_all_have_granted_this_one() {
    let mut clock = begun(0.0);
    clock.on_grant(&grant(LINK, 1), 0, MS);
    clock.on_grant(&grant(PLANNER, 0), 0, MS);
    assert_eq!(clock.poll(0, 2 * MS), Phase::Granting(vec![PLANNER]));
    clock.on_grant(&Grant { clock_incarnation: 6, ..grant(PLANNER, 1) }, 0, MS);
    assert_eq!(clock.poll(0, 2 * MS), Phase::Granting(vec![PLANNER]), "another clock's grant does not count");
    clock.on_grant(&grant(PLANNER, 1), 0, MS);
    assert_eq!(clock.poll(0, 2 * MS), Phase::Ready);
    clock.advance(2 * MS);
    assert_eq!(clock.tick(), 2);
    assert_eq!(clock.poll(0, 2 * MS), Phase::Granting(vec![LINK, PLANNER]));
    assert!(clock.deterministic());
}

#[test]
fn a_member_without_progress_is_out_and_comes_back_by_granting_the_present_tick() {
    let mut clock = begun(0.0);
    clock.on_grant(&grant(LINK, 1), 0, MS);
    // Work that goes on is progress.
    for i in 1..10 {
        clock.on_grant(&Grant { work: i, ..grant(PLANNER, 0) }, 0, i * 1000 * MS);
        assert_eq!(clock.poll(0, i * 1000 * MS + 1900 * MS), Phase::Granting(vec![PLANNER]));
    }
    // The same grant again and again is not.
    clock.on_grant(&Grant { work: 9, ..grant(PLANNER, 0) }, 0, 10_500 * MS);
    assert_eq!(clock.poll(0, 11_000 * MS), Phase::Ready, "out after 2 s: the others go on");
    assert_eq!(clock.members_in(), 1 << LINK);
    assert_eq!(clock.outs().collect::<Vec<_>>(), [(LINK, 0), (PLANNER, 1)]);
    clock.advance(11_000 * MS);
    clock.on_grant(&grant(LINK, 2), 0, 11_001 * MS);
    assert_eq!(clock.poll(0, 11_001 * MS), Phase::Until(11_010 * MS), "real time at most while one is out");
    clock.on_grant(&Grant { work: 10, ..grant(PLANNER, 2) }, 0, 11_002 * MS);
    assert_eq!(clock.poll(0, 11_002 * MS), Phase::Ready, "in again");
    assert!(!clock.deterministic());
}

#[test]
fn a_held_member_is_waited_for_without_limit() {
    let mut clock = begun(0.0);
    clock.on_grant(&grant(LINK, 1), 0, MS);
    clock.on_grant(&Grant { held: true, ..grant(PLANNER, 0) }, 0, MS);
    assert_eq!(clock.poll(0, 3_600_000 * MS), Phase::Granting(vec![PLANNER]));
    assert!(clock.deterministic());
}

#[test]
fn a_dead_process_is_out_at_once_and_its_next_life_counts() {
    let mut clock = begun(0.0);
    clock.on_grant(&grant(LINK, 1), 0, MS);
    clock.on_gone(PLANNER, 99);
    assert_eq!(clock.poll(0, MS), Phase::Granting(vec![PLANNER]), "an earlier life's death means nothing");
    clock.on_gone(PLANNER, 100);
    assert_eq!(clock.poll(0, 10 * MS), Phase::Ready);
    clock.on_gone(PLANNER, 100);
    assert_eq!(clock.outs().last(), Some((PLANNER, 1)), "counted once");
    let next = Grant { incarnation: 200, pid: 5, ..grant(PLANNER, 1) };
    clock.on_grant(&next, 0, 11 * MS);
    assert_eq!(clock.members_in(), 1 << LINK | 1 << PLANNER);
    clock.on_grant(&grant(PLANNER, 0), 0, 12 * MS);
    assert_eq!(clock.poll(0, 12 * MS), Phase::Ready, "a late word of the dead is ignored");
    assert_eq!(clock.processes().last(), Some((PLANNER, 200, 5)));
}

#[test]
fn a_dead_process_is_not_taken_for_one_that_still_works() {
    let mut clock = begun(0.0);
    assert_eq!(clock.processes().count(), 2);
    // Out by standing still, then dead: gone all the same.
    clock.on_grant(&grant(PLANNER, 1), 0, MS);
    assert_eq!(clock.poll(0, 2500 * MS), Phase::Ready, "the link is out");
    assert!(!clock.link_died());
    clock.on_gone(LINK, 100);
    assert_eq!(clock.processes().collect::<Vec<_>>(), [(PLANNER, 100, 1000 + PLANNER)]);
    assert!(clock.link_died());
    clock.on_grant(&grant(LINK, 1), 0, 2501 * MS);
    assert_eq!(clock.members_in(), 1 << PLANNER, "a late word does not bring the dead back");
    clock.on_grant(&Grant { incarnation: 200, ..grant(LINK, 1) }, 0, 2502 * MS);
    assert!(!clock.link_died());
    clock.on_grant(&Grant { incarnation: 200, leaving: true, ..grant(LINK, 1) }, 0, 2503 * MS);
    clock.on_gone(LINK, 200);
    assert!(!clock.link_died(), "it left in order");
    assert_eq!(clock.processes().count(), 1);
}

#[test]
fn leaving_is_no_out() {
    let mut clock = begun(0.0);
    clock.on_grant(&grant(LINK, 1), 0, MS);
    clock.on_grant(&Grant { leaving: true, ..grant(PLANNER, 1) }, 0, MS);
    clock.on_gone(PLANNER, 100);
    assert_eq!(clock.poll(0, MS), Phase::Until(10 * MS), "it may be started again at once");
    let later = 2002 * MS;
    assert_eq!(clock.poll(0, later), Phase::Ready, "not limited to real time any more");
    clock.advance(later);
    clock.on_grant(&grant(LINK, 2), 0, later);
    assert_eq!(clock.poll(0, later), Phase::Ready);
    clock.advance(later);
    clock.on_grant(&Grant { leaving: true, ..grant(LINK, 3) }, 0, later + MS);
    assert_eq!(clock.poll(0, later + MS), Phase::Until(later + 10 * MS), "with nobody left there is no hurry");
    assert!(clock.deterministic());
}

#[test]
fn datagrams_are_waited_for_and_given_up_after_200_ms() {
    let mut clock = begun(0.0);
    clock.on_grant(&Grant { datagrams: 3, ..grant(LINK, 1) }, 0, MS);
    clock.on_grant(&grant(PLANNER, 1), 0, MS);
    assert_eq!(clock.poll(2, 2 * MS), Phase::Datagrams);
    assert_eq!(clock.poll(3, 3 * MS), Phase::Ready);
    assert_eq!(clock.poll(2, 10 * MS), Phase::Datagrams);
    assert!(clock.deterministic());
    assert_eq!(clock.poll(2, 203 * MS), Phase::Ready);
    assert_eq!(clock.lost_datagrams(), 1);
    assert!(!clock.deterministic());
    clock.advance(203 * MS);
    clock.on_grant(&Grant { datagrams: 4, ..grant(LINK, 2) }, 3, 204 * MS);
    clock.on_grant(&grant(PLANNER, 2), 3, 204 * MS);
    assert_eq!(clock.poll(3, 205 * MS), Phase::Ready, "what was given up is not waited for again");
}

#[test]
fn a_restarted_link_counts_its_datagrams_anew() {
    let mut clock = begun(0.0);
    clock.on_grant(&Grant { datagrams: 50, ..grant(LINK, 1) }, 50, MS);
    clock.on_grant(&grant(PLANNER, 1), 50, MS);
    clock.on_gone(LINK, 100);
    clock.on_grant(&Grant { incarnation: 200, ..grant(LINK, 1) }, 50, 3 * MS);
    assert_eq!(clock.poll(50, 11 * MS), Phase::Ready);
    clock.advance(11 * MS);
    clock.on_grant(&grant(PLANNER, 2), 50, 12 * MS);
    clock.on_grant(&Grant { incarnation: 200, datagrams: 2, ..grant(LINK, 2) }, 51, 12 * MS);
    assert_eq!(clock.poll(51, 12 * MS), Phase::Datagrams);
    assert_eq!(clock.poll(52, 12 * MS), Phase::Ready);
}

#[test]
fn speed_limits_the_mean_pace() {
    let mut clock = begun(2.0);
    let mut wall = 0;
    while clock.tick() < 201 {
        let tick = clock.tick();
        for member in [LINK, PLANNER] {
            clock.on_grant(&grant(member, tick), 0, wall);
        }
        match clock.poll(0, wall) {
            Phase::Ready => clock.advance(wall),
            // The loop wakes a little late each time.
            Phase::Until(at) => wall = at + MS / 2,
            other => assert_eq!(other, Phase::Ready),
        }
    }
    assert!((990 * MS..1010 * MS).contains(&wall), "200 ticks at 2x took {wall} ns");
}

#[test]
fn a_foreign_client_limits_the_speed_to_real_time() {
    let mut clock = begun(0.0);
    clock.on_foreign();
    for member in [LINK, PLANNER] {
        clock.on_grant(&grant(member, 1), 0, MS);
    }
    assert_eq!(clock.poll(0, MS), Phase::Until(10 * MS));
    assert!(!clock.deterministic());
}

#[test]
fn the_state_is_sent_again_every_100_ms() {
    let mut clock = begun(0.0);
    assert!(clock.send_due(true, 1000 * MS));
    assert!(!clock.send_due(false, 1050 * MS));
    assert!(clock.send_due(false, 1100 * MS));
}
