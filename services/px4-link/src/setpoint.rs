//! The generator of setpoints: smooth by construction.
//!
//! A point runs along the [`Path`] and may stop at once. What is sent is that point's mean over a window of `n1` steps, and
//! of those means the mean over `n2` steps. A mean lies in the convex hull of what it is taken of, so:
//! - speed and yaw rate never exceed those of the running point;
//! - acceleration is the change of the running point's velocity over a window, divided by the window: the point never
//!   changes its velocity by more than `a * n1 * dt` within `n1` steps (standing still always obeys that), so it is at most
//!   `a`;
//! - jerk is the change of that over the second window, at most `2 a / (n2 dt)`, and `n2` is chosen so that this is the
//!   limit;
//! - braking is stopping the running point: the setpoint comes to rest on the path behind it.
//!
//! Corners are cut by the means. [`plan`] flies the path beforehand, slows where the flown curve leaves the path by more
//! than the tolerance, and picks the window that arrives first.

use std::collections::VecDeque;

use glam::DVec3;

use crate::path::{Limits, Path, Point};

/// Seconds between setpoints.
pub const PERIOD_S: f64 = 0.05;

/// Phase covered by one entry of a plan's table of slow places, seconds.
const CELL_S: f64 = 0.05;
/// Slow places are never slower than this share of the nominal speed.
const SLOWEST_SHARE: f64 = 0.05;
/// A flight that is not over by then is not simulated further.
const LONGEST_STEPS: usize = 24_000;
/// No path may take longer at the limits, seconds: longer ones are refused before they are planned.
pub const LONGEST_S: f64 = 1_200.0;

/// A path, and how it is flown.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    path: Path,
    /// Length of the first window.
    n1: usize,
    /// Highest share of the nominal speed, by phase.
    shares: Vec<f64>,
    /// How long the flight takes from rest to rest, seconds.
    pub duration_s: f64,
    /// How far the flown curve leaves the path, metres.
    pub deviation_m: f64,
}

impl Plan {
    /// The path that is flown.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "phases are not negative and short")]
    fn cell(sigma_s: f64) -> usize {
        (sigma_s / CELL_S) as usize
    }

    fn share(&self, sigma_s: f64) -> f64 {
        self.shares.get(Self::cell(sigma_s)).copied().unwrap_or(1.0)
    }
}

/// What is sent.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Setpoint {
    /// Position, yaw, gimbal pitch.
    pub point: Point,
    /// Their rates, per second.
    pub rate: Point,
    /// Acceleration, m/s2: fed forward, or the vehicle runs wide in every curve.
    pub acceleration_mps2: DVec3,
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "limits are validated: a few hundred steps"
)]
fn steps(seconds: f64) -> usize {
    ((seconds / PERIOD_S - 1e-9).ceil() as usize).max(1)
}

#[expect(clippy::cast_precision_loss, reason = "windows are short")]
fn span_s(steps: usize) -> f64 {
    steps as f64 * PERIOD_S
}

/// Length of the second window.
fn jerk_steps(limits: &Limits) -> usize {
    steps(2.0 * limits.acceleration_mps2 / limits.jerk_mps3)
}

/// Length of the first window at which full speed, and full yaw rate, can be stopped within the limits.
fn full_steps(limits: &Limits) -> usize {
    steps((limits.speed_mps / limits.acceleration_mps2).max(limits.yaw_rate_radps / limits.yaw_acceleration_radps2))
}

/// Mean as a first value plus a mean of differences: exactly that value when all are equal.
#[expect(clippy::cast_precision_loss, reason = "windows are short")]
fn mean(points: &VecDeque<Point>) -> Point {
    let Some(&first) = points.front() else { return Point::default() };
    let sum = points.iter().fold(Point::default(), |sum, &point| sum + (point - first));
    first + sum * (1.0 / points.len() as f64)
}

fn push(window: &mut VecDeque<Point>, point: Point) {
    window.pop_front();
    window.push_back(point);
}

/// The generator. One step is [`PERIOD_S`].
#[derive(Debug, Clone)]
pub struct Generator {
    limits: Limits,
    /// Windows: running points, their velocities, first means.
    running: VecDeque<Point>,
    velocities: VecDeque<Point>,
    means: VecDeque<Point>,
    phases: VecDeque<f64>,
    sent: Setpoint,
    flight: Option<Plan>,
    sigma_s: f64,
    next: Option<Plan>,
}

impl Generator {
    /// A generator at rest.
    #[must_use]
    pub fn new(limits: Limits, at: Point) -> Self {
        let mut generator = Self {
            limits,
            running: VecDeque::new(),
            velocities: VecDeque::new(),
            means: VecDeque::new(),
            phases: VecDeque::new(),
            sent: Setpoint::default(),
            flight: None,
            sigma_s: 0.0,
            next: None,
        };
        generator.anchor(at);
        generator
    }

    /// Forgets all paths and rests at a point, at once.
    pub fn anchor(&mut self, at: Point) {
        self.flight = None;
        self.next = None;
        self.sigma_s = 0.0;
        self.means = VecDeque::from(vec![at; jerk_steps(&self.limits)]);
        self.sent = Setpoint { point: at, ..Setpoint::default() };
        self.resize(full_steps(&self.limits), at);
    }

    /// Sets the first window's length; only at rest.
    fn resize(&mut self, n1: usize, at: Point) {
        self.running = VecDeque::from(vec![at; n1]);
        self.velocities = VecDeque::from(vec![Point::default(); n1]);
        self.phases = VecDeque::from(vec![self.sigma_s; n1 + self.means.len()]);
    }

    /// The running point: where the setpoint comes to rest when it brakes now.
    #[must_use]
    pub fn input(&self) -> Point {
        self.running.back().copied().unwrap_or(self.sent.point)
    }

    /// What was sent last.
    #[must_use]
    pub fn sent(&self) -> Setpoint {
        self.sent
    }

    /// Whether the setpoint stands and will stand until a path is flown.
    #[must_use]
    pub fn at_rest(&self) -> bool {
        let at = self.input();
        self.sent.rate == Point::default() && self.running.iter().chain(&self.means).all(|&point| point == at)
    }

    /// Whether the flight is over: at rest at the path's end.
    #[must_use]
    pub fn arrived(&self) -> bool {
        self.next.is_none()
            && self.flight.as_ref().is_some_and(|plan| self.sigma_s >= plan.path.total_s())
            && self.at_rest()
    }

    /// Share of the path's duration behind the setpoint, 0 to 1.
    #[must_use]
    pub fn progress(&self) -> f64 {
        match &self.flight {
            None => 0.0,
            Some(_) if self.arrived() => 1.0,
            #[expect(clippy::cast_precision_loss, reason = "windows are short")]
            Some(plan) => {
                let mean = self.phases.iter().sum::<f64>() / self.phases.len().max(1) as f64;
                (mean / plan.path.total_s().max(1e-9)).clamp(0.0, 1.0)
            }
        }
    }

    /// Flies a plan: at once from rest, else after braking. Its start is moved to where the setpoint rests.
    pub fn fly(&mut self, plan: Plan) {
        self.next = Some(plan);
    }

    fn begin(&mut self, mut plan: Plan) {
        let at = self.input();
        if plan.path.start() != at {
            plan.path = plan.path.restarted(at, &self.limits);
        }
        self.sigma_s = 0.0;
        self.resize(plan.n1, at);
        self.flight = Some(plan);
    }

    /// Whether the running point may move by `delta` in one step.
    fn allowed(&self, delta: Point) -> bool {
        let velocity = delta * (1.0 / PERIOD_S);
        let change = velocity - self.velocities.front().copied().unwrap_or_default();
        let window_s = span_s(self.running.len());
        let most_mps = self.limits.acceleration_mps2 * window_s;
        let most_radps = self.limits.yaw_acceleration_radps2 * window_s;
        velocity.position_m.length() <= most_mps
            && change.position_m.length() <= most_mps
            && velocity.yaw_rad.abs() <= most_radps
            && change.yaw_rad.abs() <= most_radps
    }

    /// How far the running point may go this step, as a phase of its path.
    fn advance(&self, plan: &Plan, share: f64) -> f64 {
        let total_s = plan.path.total_s();
        let at = self.input();
        let wished = (self.sigma_s + PERIOD_S * share.clamp(0.0, 1.0) * plan.share(self.sigma_s)).min(total_s);
        if self.allowed(plan.path.at(wished) - at) {
            return wished;
        }
        let (mut low, mut high) = (self.sigma_s, wished);
        for _ in 0..20 {
            let middle = 0.5 * (low + high);
            if self.allowed(plan.path.at(middle) - at) {
                low = middle;
            } else {
                high = middle;
            }
        }
        low
    }

    /// One step. `share` of the planned speed: 0 brakes, 1 flies as planned.
    pub fn step(&mut self, share: f64) -> Setpoint {
        if self.next.is_some()
            && self.at_rest()
            && let Some(plan) = self.next.take()
        {
            self.begin(plan);
        }
        let before = self.input();
        let share = if self.next.is_some() { 0.0 } else { share };
        let running = match &self.flight {
            Some(plan) if share > 0.0 && self.sigma_s < plan.path.total_s() => {
                let sigma_s = self.advance(plan, share);
                let point = plan.path.at(sigma_s);
                self.sigma_s = sigma_s;
                point
            }
            _ => before,
        };
        push(&mut self.running, running);
        push(&mut self.velocities, (running - before) * (1.0 / PERIOD_S));
        self.phases.pop_front();
        self.phases.push_back(self.sigma_s);
        let first = mean(&self.running);
        push(&mut self.means, first);
        let point = mean(&self.means);
        let rate = (point - self.sent.point) * (1.0 / PERIOD_S);
        let acceleration_mps2 = (rate.position_m - self.sent.rate.position_m) / PERIOD_S;
        self.sent = Setpoint { point, rate, acceleration_mps2 };
        self.sent
    }
}

/// Plans the flight along a path from rest to rest.
#[must_use]
pub fn plan(path: &Path, limits: &Limits) -> Plan {
    let full = full_steps(limits);
    let mut best: Option<Plan> = None;
    for quarters in 1..=4 {
        let n1 = (full * quarters).div_ceil(4).max(2);
        let flown = slowed_at_corners(path, n1, limits);
        let better = best.as_ref().is_none_or(|best| {
            let (fits, best_fits) = (flown.deviation_m <= limits.tolerance_m, best.deviation_m <= limits.tolerance_m);
            (fits && !best_fits) || (fits == best_fits && flown.duration_s < best.duration_s)
        });
        if better {
            best = Some(flown);
        }
    }
    best.unwrap_or_else(|| Plan {
        path: path.clone(),
        n1: full,
        shares: Vec::new(),
        duration_s: path.total_s(),
        deviation_m: 0.0,
    })
}

/// Flies a path with one window, again and again, slower where it left the path by too much.
fn slowed_at_corners(path: &Path, n1: usize, limits: &Limits) -> Plan {
    let cells = Plan::cell(path.total_s().min(LONGEST_S)) + 1;
    let mut plan = Plan { path: path.clone(), n1, shares: vec![1.0; cells], duration_s: 0.0, deviation_m: 0.0 };
    for _ in 0..14 {
        let slower = fly_beforehand(&mut plan, limits);
        if slower.is_empty() {
            break;
        }
        for cell in slower {
            if let Some(share) = plan.shares.get_mut(cell) {
                *share = (*share * 0.75).max(SLOWEST_SHARE);
            }
        }
    }
    plan
}

/// Flies a plan from rest, notes its duration and deviation, and returns the cells in which it went astray.
fn fly_beforehand(plan: &mut Plan, limits: &Limits) -> Vec<usize> {
    let mut generator = Generator::new(*limits, plan.path.start());
    generator.fly(plan.clone());
    let mut slower = vec![false; plan.shares.len()];
    let (mut worst_m, mut count) = (0.0f64, 0usize);
    while count < LONGEST_STEPS {
        let sent = generator.step(1.0);
        count += 1;
        let (from_s, to_s) = (
            generator.phases.front().copied().unwrap_or_default(),
            generator.phases.back().copied().unwrap_or_default(),
        );
        let deviation_m = plan.path.distance_m(sent.point.position_m, from_s, to_s);
        worst_m = worst_m.max(deviation_m);
        if deviation_m > limits.tolerance_m {
            for cell in slower.iter_mut().take(Plan::cell(to_s) + 1).skip(Plan::cell(from_s)) {
                *cell = true;
            }
        }
        if generator.arrived() {
            break;
        }
    }
    plan.duration_s = span_s(count);
    plan.deviation_m = worst_m;
    slower.iter().enumerate().filter_map(|(cell, slow)| slow.then_some(cell)).collect()
}

/// Draws a setpoint towards the measured position, so that it is never farther away than the leash.
#[must_use]
pub fn leashed(position_m: DVec3, measured_m: DVec3, leash_m: f64) -> DVec3 {
    measured_m + (position_m - measured_m).clamp_length_max(leash_m)
}

/// How fast to go on when the vehicle is `lag_m` behind its setpoint: full speed up to half the leash, none from three
/// quarters of it.
#[must_use]
pub fn share_of_speed(lag_m: f64, leash_m: f64) -> f64 {
    ((0.75 * leash_m - lag_m) / (0.25 * leash_m)).clamp(0.0, 1.0)
}

#[cfg(test)]
#[path = "setpoint_tests.rs"]
mod tests;
