//! What flying costs: time, as max(translation, yaw, gimbal) + settling, and the quickest order of a batch.

use shared_types::config::planner::PlannerConfig;

use super::view::wrap_angle;

/// How fast the vehicle and its gimbal are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Speeds {
    /// Highest speed, m/s.
    pub speed_mps: f64,
    /// Acceleration and braking, m/s^2.
    pub acceleration_mps2: f64,
    /// Yaw rate, rad/s.
    pub yaw_rate_radps: f64,
    /// Rate of the gimbal, rad/s.
    pub gimbal_rate_radps: f64,
    /// Settling and capture, seconds.
    pub settle_s: f64,
}

impl Speeds {
    /// From the configuration.
    #[must_use]
    pub fn of(config: &PlannerConfig) -> Self {
        Self {
            speed_mps: config.speed_mps,
            acceleration_mps2: config.acceleration_mps2,
            yaw_rate_radps: config.yaw_rate_degps.to_radians(),
            gimbal_rate_radps: config.gimbal_rate_degps.to_radians(),
            settle_s: config.settle_s,
        }
    }

    /// Time for a length from rest to rest, seconds.
    #[must_use]
    pub fn translation_s(&self, length_m: f64) -> f64 {
        let full = self.speed_mps * self.speed_mps / self.acceleration_mps2;
        if length_m >= full {
            length_m / self.speed_mps + self.speed_mps / self.acceleration_mps2
        } else {
            2.0 * (length_m.max(0.0) / self.acceleration_mps2).sqrt()
        }
    }

    /// Time of a leg, settling included, seconds.
    #[must_use]
    pub fn leg_s(&self, length_m: f64, yaw_change_rad: f64, pitch_change_rad: f64) -> f64 {
        let yaw = wrap_angle(yaw_change_rad).abs() / self.yaw_rate_radps;
        let pitch = pitch_change_rad.abs() / self.gimbal_rate_radps;
        self.translation_s(length_m).max(yaw).max(pitch) + self.settle_s
    }
}

/// The order of visiting that costs least, and its cost: over every order, exactly. `start[i]` is the cost from where the
/// vehicle is to view i, `between[i][j]` from view i to j, `home[i]` from view i to the return point. Ties go to the
/// order that comes first by indices. Infinite costs (no path) are avoided where possible.
#[must_use]
pub fn best_order(start: &[f64], between: &[Vec<f64>], home: &[f64]) -> (Vec<usize>, f64) {
    struct Search<'a> {
        start: &'a [f64],
        between: &'a [Vec<f64>],
        home: &'a [f64],
        best: (Vec<usize>, f64),
        order: Vec<usize>,
    }
    impl Search<'_> {
        fn leg(&self, to: usize) -> f64 {
            match self.order.last() {
                None => self.start[to],
                Some(&from) => self.between[from][to],
            }
        }

        fn go(&mut self, cost: f64) {
            if self.order.len() == self.start.len() {
                let whole = cost + self.order.last().map_or(0.0, |&last| self.home[last]);
                if self.best.0.is_empty() || whole < self.best.1 {
                    self.best = (self.order.clone(), whole);
                }
                return;
            }
            for next in 0..self.start.len() {
                let through = cost + self.leg(next);
                let hopeless = !self.best.0.is_empty() && through >= self.best.1;
                if !self.order.contains(&next) && !hopeless {
                    self.order.push(next);
                    self.go(through);
                    self.order.pop();
                }
            }
        }
    }
    let mut search = Search { start, between, home, best: (Vec::new(), 0.0), order: Vec::new() };
    search.go(0.0);
    search.best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_leg_costs_what_its_slowest_part_costs() {
        let speeds = Speeds {
            speed_mps: 2.0,
            acceleration_mps2: 1.0,
            yaw_rate_radps: 1.0,
            gimbal_rate_radps: 0.5,
            settle_s: 1.0,
        };
        assert!((speeds.leg_s(4.0, 0.0, 0.0) - 5.0).abs() < 1e-12, "2 s up, 2 s down, 1 s settling");
        assert!((speeds.leg_s(8.0, 0.0, 0.0) - 7.0).abs() < 1e-12, "2 s more at 2 m/s");
        assert!((speeds.leg_s(1.0, 3.0, 0.0) - 4.0).abs() < 1e-12, "yaw");
        assert!((speeds.leg_s(1.0, 6.0, -1.5) - 4.0).abs() < 1e-12, "the gimbal; the yaw goes the short way");
    }

    proptest::proptest! {
        #[test]
        fn the_best_order_is_the_best_of_all(values in proptest::collection::vec(0.1..9.0f64, 35)) {
            let n = 5;
            let start = &values[..n];
            let home = &values[n..2 * n];
            let between: Vec<Vec<f64>> = (0..n).map(|i| values[10 + i * n..10 + (i + 1) * n].to_vec()).collect();
            let (order, cost) = best_order(start, &between, home);
            let mut least = f64::INFINITY;
            // Every number of five digits base five that uses each digit once.
            for code in 0..n.pow(5) {
                let digits: Vec<usize> = (0..5).map(|at| code / n.pow(at) % n).collect();
                if (0..n).all(|digit| digits.contains(&digit)) {
                    let legs: f64 = digits.windows(2).map(|leg| between[leg[0]][leg[1]]).sum();
                    least = least.min(start[digits[0]] + legs + home[digits[4]]);
                }
            }
            proptest::prop_assert!((cost - least).abs() < 1e-9);
            proptest::prop_assert_eq!(order.len(), n);
        }
    }
}
