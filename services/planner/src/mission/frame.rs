//! Finding the world again after `vantage resume`: the estimator may have been started anew, and its origin then lies metres
//! from where it lay. The prior's views are taken again, from above first, and laid onto the stored ones; px4-link moves its
//! transform by what that gives, until object and prior agree.

use glam::DVec3;
use shared_types::messages::{CommandRequest, KeyframeReason, VehicleCommand, VehicleState};

use super::Mission;
use super::vehicle::MOST_REFUSALS;
use crate::io::Views;
use crate::journal::Record;
use crate::ledger::Shift;
use crate::logic::align::{Fit, align};
use crate::logic::depth::DepthView;
use crate::state::State;

/// A shift below this is as good as none, metres: from above alone, and from both views.
const ROUGH_M: f64 = 0.15;
const FINE_M: f64 = 0.02;
/// Most that may be left between the object's surfaces, metres: beyond, new views would not fit those that there are.
const MOST_RESIDUAL_M: f64 = 0.05;
/// A start whose height differs by more than this from that of the mission's first takeoff is taken for the same ground.
const LEVEL_M: f64 = 0.3;
/// A height that differs by more is no estimator's error, metres.
const MOST_RISE_M: f64 = 15.0;
/// More shifts than this do not settle.
const MOST_SHIFTS: usize = 5;

impl Mission {
    /// Whether positions in the world mean what they meant when the prior was made: it was in this flight, or the world was
    /// found again in it. True as long as there is no prior.
    pub(super) fn is_placed(&self) -> bool {
        self.ledger.prior.is_none() || self.ledger.placed_ns.is_some_and(|at_ns| at_ns >= self.setup.epoch_ns)
    }

    /// On the ground, before the takeoff: the first height to fly to counts from it. False while the world is being moved.
    pub(super) fn level_home(&mut self, vehicle: &VehicleState) -> bool {
        let Some((_, first_m)) = self.ledger.airborne.filter(|_| !self.is_placed()) else { return true };
        if self.shifting(vehicle) {
            return false;
        }
        let rise_m = first_m[2] - vehicle.home_m[2];
        if rise_m.abs() <= LEVEL_M {
            return true;
        }
        if self.shifts() >= MOST_SHIFTS || rise_m.abs() > MOST_RISE_M {
            let why = format!("home is {:.1} m off the height of the first takeoff, and that is not mended", -rise_m);
            self.misaligned(None, &why);
            return false;
        }
        self.record(Record::Shift { shift_m: [0.0, 0.0, rise_m], reset_count: vehicle.reset_count });
        false
    }

    /// How often the world was moved in this flight.
    pub(super) fn shifts(&self) -> usize {
        self.ledger.shifts.iter().filter(|shift| shift.at_ns >= self.setup.epoch_ns).count()
    }

    /// Sees that a shift is carried out; false where none is under way. That the vehicle's counter is another one says that
    /// it was: px4-link does it once, and a planner that was started anew cannot do it twice.
    pub(super) fn shifting(&mut self, vehicle: &VehicleState) -> bool {
        // What an earlier flight wanted moved was measured in that flight's world.
        let last = self.ledger.shifts.last().filter(|shift| shift.at_ns >= self.setup.epoch_ns);
        let Some(Shift { shift_m, reset_count, .. }) = last.copied() else { return false };
        if vehicle.reset_count != reset_count {
            return false;
        }
        let command = VehicleCommand::ShiftWorld.code();
        let answer = self.ensure_request(CommandRequest { command, reset_count, altitude_m: 0.0, shift_m });
        // Done or not, the counter tells; a refusal rests for a while.
        if let Some(Err(why)) = answer
            && self.refusals >= MOST_REFUSALS
        {
            self.refusals = 0;
            self.misaligned(None, &format!("the world cannot be moved: {why}"));
        }
        true
    }

    /// In the air: takes the prior's views again, and moves the world until they lie on the stored ones.
    pub(super) fn find_world(&mut self, vehicle: &VehicleState, views: &mut dyn Views) -> State {
        if self.survey_view(KeyframeReason::CheckOverhead).is_none() {
            let shot = self.prior_shot(vehicle, KeyframeReason::CheckOverhead);
            return self.fly_next(vehicle, &[shot]);
        }
        let has_side = self.survey_view(KeyframeReason::CheckSide).is_some();
        let fit = match self.fit(views, has_side) {
            Ok(fit) => fit,
            Err(why) => return self.misaligned(None, &why),
        };
        let shift_m = fit.shift_m.length();
        tracing::info!(
            shift_m,
            residual_m = fit.residual_m,
            both = has_side,
            "the prior's views were laid onto the stored ones"
        );
        if shift_m > if has_side { FINE_M } else { ROUGH_M } {
            if self.shifts() >= MOST_SHIFTS {
                return self.misaligned(Some(fit.residual_m), "the world does not settle; is the estimator drifting?");
            }
            self.record(Record::Shift { shift_m: fit.shift_m.to_array(), reset_count: vehicle.reset_count });
            return State::Deciding;
        }
        if !has_side {
            let shot = self.prior_shot(vehicle, KeyframeReason::CheckSide);
            return self.fly_next(vehicle, &[shot]);
        }
        if fit.residual_m > MOST_RESIDUAL_M {
            return self.misaligned(Some(fit.residual_m), "the object is not as the prior's views show it");
        }
        self.record(Record::Aligned { shift_m: fit.shift_m.to_array(), residual_m: fit.residual_m });
        self.terrain = None;
        self.ensure_terrain();
        State::Deciding
    }

    /// Lays the views of now onto those of the prior, or says why not.
    fn fit(&self, views: &mut dyn Views, has_side: bool) -> Result<Fit, String> {
        let (prior, _) = self.ledger.prior.ok_or("the journal has no prior")?;
        let mut read = |reason: KeyframeReason| {
            let view = self.read_survey(reason, views);
            view.ok_or_else(|| format!("the mission folder's view {} cannot be read; expected it whole", reason.name()))
        };
        let stored = [read(KeyframeReason::PriorOverhead)?, read(KeyframeReason::PriorSide)?];
        let mut seen = vec![read(KeyframeReason::CheckOverhead)?];
        if has_side {
            seen.push(read(KeyframeReason::CheckSide)?);
        }
        let (stored, seen): (Vec<&DepthView>, Vec<&DepthView>) = (stored.iter().collect(), seen.iter().collect());
        let around_m = DVec3::from_array(prior.center_m);
        align(&stored, &seen, &prior.ground, around_m, self.setup.planner.survey_radius_m)
            .ok_or_else(|| "the object is not seen where the prior has it".to_owned())
    }

    pub(super) fn misaligned(&mut self, residual_m: Option<f64>, why: &str) -> State {
        let limit = MOST_RESIDUAL_M;
        let why = match residual_m {
            Some(left) => {
                format!("{why}: {left:.3} m are left between its surfaces then and now, expected at most {limit}")
            }
            None => why.to_owned(),
        };
        tracing::warn!(why, "returning and landing; the mission stays open");
        self.record(Record::Misaligned { residual_m, why });
        self.misaligned = true;
        self.recall();
        State::Deciding
    }
}
