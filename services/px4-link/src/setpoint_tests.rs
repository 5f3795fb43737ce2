//! The promises of the generator, over random paths, brakes and restarts.

use proptest::prelude::*;
use shared_types::config::LinkConfig;
use shared_types::messages::Waypoint;

use super::*;
use crate::path::waypoint;

fn limits() -> Limits {
    Limits::new(&LinkConfig::default())
}

fn to(x: f64, y: f64, z: f64, yaw: f64, speed: f64) -> Waypoint {
    waypoint(&Point { position_m: DVec3::new(x, y, z), yaw_rad: yaw, pitch_rad: -0.5 }, speed)
}

/// Watches a sequence of setpoints and fails where a limit is broken.
struct Watch {
    sent: Vec<Point>,
}

impl Watch {
    fn see(&mut self, sent: Setpoint) -> Result<(), TestCaseError> {
        self.sent.push(sent.point);
        let limits = limits();
        let n = self.sent.len();
        let back = |i: usize| self.sent[n - 1 - i];
        let over = 1.0 + 1e-6;
        if n >= 2 {
            let v = (back(0) - back(1)) * (1.0 / PERIOD_S);
            prop_assert!(v.position_m.length() <= limits.speed_mps * over, "speed {}", v.position_m.length());
            prop_assert!(v.yaw_rad.abs() <= limits.yaw_rate_radps * over, "yaw rate {}", v.yaw_rad);
            prop_assert!(v.pitch_rad.abs() <= limits.gimbal_rate_radps * over);
            prop_assert!((v - sent.rate).position_m.length() < 1e-9);
            prop_assert!((back(0) - back(1)).position_m.length() < 0.3);
        }
        if n >= 3 {
            let a = (back(0) - back(1) * 2.0 + back(2)) * PERIOD_S.powi(-2);
            prop_assert!(
                a.position_m.length() <= limits.acceleration_mps2 * over,
                "acceleration {}",
                a.position_m.length()
            );
            prop_assert!(a.yaw_rad.abs() <= limits.yaw_acceleration_radps2 * over, "yaw acceleration {}", a.yaw_rad);
        }
        if n >= 4 {
            let j = (back(0) - back(1) * 3.0 + back(2) * 3.0 - back(3)) * PERIOD_S.powi(-3);
            prop_assert!(j.position_m.length() <= limits.jerk_mps3 * over, "jerk {}", j.position_m.length());
        }
        Ok(())
    }
}

fn waypoints() -> impl Strategy<Value = Vec<Waypoint>> {
    proptest::collection::vec((-4.0..4.0f64, -4.0..4.0f64, 0.5..4.0f64, -3.2..3.2f64, 0.2..4.0f64), 1..6)
        .prop_map(|list| list.into_iter().map(|(x, y, z, yaw, speed)| to(x, y, z, yaw, speed)).collect())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn limits_hold_and_the_end_is_reached_exactly_whatever_happens(
        paths in proptest::collection::vec(waypoints(), 1..4),
        brakes in proptest::collection::vec((0usize..120, 0usize..80, 0.0..1.0f64), 3),
    ) {
        let mut generator = Generator::new(limits(), Point { position_m: DVec3::new(0.3, -0.2, 2.0), yaw_rad: 1.0, pitch_rad: 0.0 });
        let mut watch = Watch { sent: Vec::new() };
        for (index, path) in paths.iter().enumerate() {
            let (fly, hold, share) = brakes[index % brakes.len()];
            generator.fly(plan(&Path::new(generator.input(), path, &limits()), &limits()));
            for _ in 0..fly {
                watch.see(generator.step(1.0))?;
            }
            for _ in 0..hold {
                watch.see(generator.step(share.powi(4)))?;
            }
            if index + 1 == paths.len() {
                let mut left = 20_000;
                while !generator.arrived() && left > 0 {
                    watch.see(generator.step(1.0))?;
                    left -= 1;
                }
                let end = Point::of(path.last().expect("at least one"));
                prop_assert!(generator.arrived());
                prop_assert_eq!(generator.sent().point.position_m, end.position_m);
                prop_assert!(crate::frames::wrap_pi(generator.sent().point.yaw_rad - end.yaw_rad).abs() < 1e-9);
                prop_assert_eq!(generator.sent().rate, Point::default());
                prop_assert_eq!(generator.progress(), 1.0);
            }
        }
    }

    #[test]
    fn braking_rests_where_it_said_and_the_same_again(path in waypoints(), fly in 1usize..200) {
        let run = || {
            let mut generator = Generator::new(limits(), Point::default());
            generator.fly(plan(&Path::new(Point::default(), &path, &limits()), &limits()));
            let flown: Vec<Setpoint> = (0..fly).map(|_| generator.step(1.0)).collect();
            let rest = generator.input();
            let stops_in = full_steps(&limits()) + jerk_steps(&limits()) + 1;
            (0..stops_in).for_each(|_| { generator.step(0.0); });
            (flown, rest, generator)
        };
        let (flown, rest, generator) = run();
        prop_assert!(generator.at_rest());
        prop_assert_eq!(generator.sent().point, rest);
        prop_assert_eq!(flown, run().0);
    }

    #[test]
    fn the_flown_curve_keeps_to_the_path(path in waypoints()) {
        let path = Path::new(Point::default(), &path, &limits());
        let plan = plan(&path, &limits());
        prop_assert!(plan.deviation_m <= limits().tolerance_m, "{} m", plan.deviation_m);
        let mut generator = Generator::new(limits(), Point::default());
        generator.fly(plan);
        for _ in 0..20_000 {
            let distance = path.distance_m(generator.step(1.0).point.position_m, 0.0, path.total_s());
            prop_assert!(distance <= limits().tolerance_m + 1e-9, "{distance} m");
            if generator.arrived() {
                break;
            }
        }
    }
}

#[test]
fn a_straight_leg_takes_about_as_long_as_it_must() {
    let config = LinkConfig { speed_mps: 2.0, acceleration_mps2: 1.5, jerk_mps3: 4.0, ..LinkConfig::default() };
    let limits = Limits::new(&config);
    let time = |metres: f64| {
        plan(&Path::new(Point::default(), &[to(metres, 0.0, 0.0, 0.0, 9.0)], &limits), &limits).duration_s
    };
    // 10 m at 2 m/s, 1.5 m/s2, 4 m/s3 cannot be flown below 5 + 1.33 + 0.375 s.
    assert!((6.7..7.3).contains(&time(10.0)), "{}", time(10.0));
    assert!(time(0.5) < 2.3, "{}", time(0.5));
}

#[test]
fn an_arc_of_many_short_legs_is_flown_without_stopping() {
    let arc: Vec<Waypoint> = (0..=60)
        .map(|i| f64::from(i) * 3.0f64.to_radians())
        .map(|angle| to(1.8 * angle.cos(), 1.8 * angle.sin(), 1.5, angle + core::f64::consts::PI, 1.5))
        .collect();
    let path = Path::new(Point::of(&arc[0]), &arc, &limits());
    let started = std::time::Instant::now();
    let plan = plan(&path, &limits());
    let took = started.elapsed();
    // 5.65 m: yaw at 45 deg/s takes 4 s; with rounding and stopping it stays below 10 s.
    assert!(plan.deviation_m <= 0.1 && plan.duration_s < 10.0, "{} m in {} s", plan.deviation_m, plan.duration_s);
    assert!(took.as_millis() < 200, "planning took {took:?}");
    eprintln!("arc: {} s for a nominal {} s, planned in {took:?}", plan.duration_s, path.total_s());
}

#[test]
fn a_vehicle_that_lags_slows_the_setpoint_and_keeps_the_leash() {
    assert!((share_of_speed(1.0, 3.0) - 1.0).abs() < 1e-12 && share_of_speed(2.3, 3.0) == 0.0);
    let drawn = leashed(DVec3::new(9.0, 0.0, 0.0), DVec3::new(1.0, 0.0, 0.0), 3.0);
    assert!((drawn - DVec3::new(4.0, 0.0, 0.0)).length() < 1e-12);
}
