//! The battery: drains while the motors are armed, and says how low it is.

use crate::params::{Param, Params};

/// Cells in series.
const CELLS: f64 = 4.0;
/// Voltage of a full cell and of an empty one under load.
const CELL_FULL_V: f64 = 4.2;
const CELL_EMPTY_V: f64 = 3.4;
/// Share of the drain that electronics take while the motors stand still with the vehicle armed on the ground.
const IDLE_SHARE: f64 = 0.1;

/// How low it is (MAV_BATTERY_CHARGE_STATE 1 to 4).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Charge {
    /// Above every threshold.
    Ok,
    /// Below BAT_LOW_THR: a warning.
    Low,
    /// Below BAT_CRIT_THR: COM_LOW_BAT_ACT decides.
    Critical,
    /// Below BAT_EMERGEN_THR: land at once, where COM_LOW_BAT_ACT allows it.
    Emergency,
}

/// State of charge.
#[derive(Debug, Clone)]
pub struct Battery {
    remaining: f64,
}

impl Battery {
    /// A battery with a charge, 0 to 1.
    #[must_use]
    pub fn new(remaining: f64) -> Self {
        Self { remaining: if remaining.is_finite() { remaining.clamp(0.0, 1.0) } else { 1.0 } }
    }

    /// Charge left, 0 to 1.
    #[must_use]
    pub fn remaining(&self) -> f64 {
        self.remaining
    }

    /// Its charge is another from one moment to the next, as when a cell fails.
    pub fn set(&mut self, remaining: f64) {
        *self = Self::new(remaining);
    }

    /// Drains for `dt_s`: SIM_BAT_DRAIN is the time of flight from full to empty, SIM_BAT_MIN_PCT where it stops.
    pub fn step(&mut self, dt_s: f64, armed: bool, flying: bool, params: &Params) {
        let drain_s = params.real(Param::SIM_BAT_DRAIN);
        let floor = params.real(Param::SIM_BAT_MIN_PCT) / 100.0;
        if !armed || drain_s <= 0.0 || self.remaining <= floor {
            return;
        }
        let share = if flying { 1.0 } else { IDLE_SHARE };
        self.remaining = (self.remaining - share * dt_s / drain_s).max(floor).clamp(0.0, 1.0);
    }

    /// How low it is against the thresholds.
    #[must_use]
    pub fn charge(&self, params: &Params) -> Charge {
        if self.remaining < params.real(Param::BAT_EMERGEN_THR) {
            Charge::Emergency
        } else if self.remaining < params.real(Param::BAT_CRIT_THR) {
            Charge::Critical
        } else if self.remaining < params.real(Param::BAT_LOW_THR) {
            Charge::Low
        } else {
            Charge::Ok
        }
    }

    /// Voltage of the pack, V.
    #[must_use]
    pub fn voltage_v(&self) -> f64 {
        CELLS * self.cell_voltage_v()
    }

    /// Voltage of one cell, V.
    #[must_use]
    pub fn cell_voltage_v(&self) -> f64 {
        CELL_EMPTY_V + (CELL_FULL_V - CELL_EMPTY_V) * self.remaining
    }

    /// Cells in series.
    #[must_use]
    pub fn cells(&self) -> usize {
        CELLS as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::params::Value;

    #[test]
    fn thresholds_are_crossed_in_order_and_the_floor_stops_the_drain() {
        let mut params = Params::default();
        assert!(params.set("SIM_BAT_DRAIN", Value::Real(100.0)).is_ok());
        let mut battery = Battery::new(1.0);
        let mut at = Vec::new();
        let mut last = Charge::Ok;
        for tick in 0..12_000 {
            battery.step(0.01, true, true, &params);
            let charge = battery.charge(&params);
            if charge != last {
                at.push((charge, f64::from(tick) / 100.0));
                last = charge;
            }
        }
        let order: Vec<Charge> = at.iter().map(|&(c, _)| c).collect();
        assert_eq!(order, [Charge::Low, Charge::Critical, Charge::Emergency]);
        assert!((at[0].1 - 85.0).abs() < 0.1 && (at[1].1 - 93.0).abs() < 0.1 && (at[2].1 - 95.0).abs() < 0.1, "{at:?}");
        assert!(battery.remaining() == 0.0);

        assert!(params.set("SIM_BAT_MIN_PCT", Value::Real(50.0)).is_ok());
        let mut held = Battery::new(1.0);
        for _ in 0..12_000 {
            held.step(0.01, true, true, &params);
        }
        assert!((held.remaining() - 0.5).abs() < 1e-3);
        let before = held.remaining();
        held.step(10.0, false, false, &params);
        assert!(held.remaining() == before, "nothing drains while disarmed");
    }
}
