//! Which tier of the plate a scenario is played on: the one it names, or the cheapest that is good enough.
//!
//! The budget is a tenth of the tightest expectation's tolerance as a relative amplitude error |ΔW|/setpoint; the bound of a tier is what
//! [`platebench_plate::bound`] says for one and the same drives, times what the law's loop makes of it. Both are known before anything is played and
//! stand in the record. `docs/mathematics.md`, "The cheapest plate that is good enough", derives them.

use crate::expect::{Expectation, Limit, Metric};
use crate::scenario::Scenario;
use platebench_plate::{Plate, Profile, Tier};
use std::f64::consts::TAU;

mod loops;

/// What [`Model::asked`] is called in scenarios and on the command line where the bench chooses.
pub const AUTO: &str = "auto";
/// Share of a tolerance that the plate's own error may take.
const SHARE: f64 = 0.1;
/// Tolerance of a limit on one side only, as a share of the limit; the same as the default of `about`.
const ONE_SIDED: f64 = 0.05;
/// Tolerance where no expectation looks at W: the curves are looked at all the same.
const UNWATCHED: f64 = 0.05;

/// How a tier was chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Model {
    /// The tier that was asked for by name; the bench chooses where none was.
    pub asked: Option<Tier>,
    /// Bound on |ΔW|/setpoint between the chosen tier and the exact plate, at any time; infinite where none is known.
    pub bound: f64,
    /// What it may be.
    pub budget: f64,
}

impl Model {
    /// Nothing is known of any tier yet.
    pub const fn of(asked: Option<Tier>) -> Self {
        Self { asked, bound: f64::INFINITY, budget: 0.0 }
    }

    /// What was asked for, by name.
    pub fn asked_name(&self) -> &'static str {
        self.asked.map_or(AUTO, Tier::name)
    }
}

impl Scenario {
    /// Chooses the tier anew, after something changed. `transparent`: nothing but the scenario's own loop delay acts; where line and clock add to it, no
    /// bound on a loop is known beforehand.
    pub fn choose_model(&mut self, transparent: bool) {
        let bounds = Tier::ALL.map(|tier| (tier, self.bound(tier, transparent)));
        let budget = self.model_budget();
        let fits = bounds.iter().filter(|(tier, _)| *tier <= exact(&self.plate)).find(|(_, bound)| *bound <= budget);
        self.tier = self.model.asked.or(fits.map(|(tier, _)| *tier)).unwrap_or_else(|| exact(&self.plate));
        self.model.budget = budget;
        self.model.bound = self.bound(self.tier, transparent);
    }

    /// A tenth of the tightest tolerance, as |ΔW|/setpoint. A scenario that expects nothing gets the exact plate.
    pub fn model_budget(&self) -> f64 {
        if self.expectations.is_empty() {
            return 0.0;
        }
        let tolerances = self.expectations.iter().filter_map(|expectation| self.tolerance(expectation));
        SHARE * tolerances.reduce(f64::min).unwrap_or(UNWATCHED).max(0.0)
    }

    /// Bound on |ΔW|, relative to the smallest setpoint above 0, between `tier` and the exact plate.
    pub fn bound(&self, tier: Tier, transparent: bool) -> f64 {
        let scale = smallest_setpoint(&self.setpoint);
        if tier >= exact(&self.plate) {
            let varies = self.scene.temperature_offset_k.varies() || self.scene.finger_force_n.varies();
            let within_reach = self.plate.gain * self.plate.drive_limit_vpp;
            return platebench_plate::bound::numerical(varies) * within_reach / scale;
        }
        if scale <= 0.0 || !transparent || !self.faults.is_empty() {
            return f64::INFINITY;
        }
        let Some(known) = loops::known(self) else { return f64::INFINITY };
        known.amplification * known.beforehand.error(tier) / scale
    }

    /// The tolerance of an expectation as |ΔW|/setpoint; `None` where it does not look at W.
    fn tolerance(&self, expectation: &Expectation) -> Option<f64> {
        let (value, width) = width(expectation);
        let percent = width / 100.0;
        let fixed_frequency = matches!(self.controller.law.as_str(), "open-loop" | "voltage-only" | "frequency-only");
        let smallest = smallest_setpoint(&self.setpoint);
        let damped = loops::sigma(self).1;
        match expectation.metric {
            Metric::StaticError | Metric::Repeatability | Metric::PeakDeviation => Some(percent),
            // Of the step, which may be smaller than the setpoint.
            Metric::Overshoot => Some(percent * (smallest_step(&self.setpoint) / smallest).min(1.0)),
            // A first-order response that takes T to a band β crosses its edge at the slope β ln(1/β)/T.
            Metric::SettlingTime | Metric::RecoveryTime => {
                let band = expectation.band_percent / 100.0;
                let share = if value > 0.0 { width / value } else { 0.0 };
                Some(share * band * (-band.ln()).max(0.0))
            }
            Metric::FinalAmplitude => Some(width / smallest),
            Metric::FrequencyError if self.controller.law == "frequency-only" => Some(0.0),
            Metric::FrequencyError if fixed_frequency => None,
            // Wq/Wd off by ε moves a frequency that follows it by σε.
            Metric::FrequencyError => Some(TAU * width / damped),
            // At the ratio r, Wd is at least 1/(1 + r²) of what the drive would reach at resonance.
            Metric::QuadratureRatio => {
                let least = self.plate.sigma0.min(damped) / damped / (1.0 + value * value);
                Some(width * least / (1.0 + value))
            }
            Metric::DrivePeak if self.controller.law == "open-loop" => None,
            Metric::DrivePeak => Some(width / (loops::proportional_gain(self) * smallest)),
            // The drive is at its limit or it is not: no error of W is small enough to be sure.
            Metric::Saturated => Some(0.0),
            Metric::LoopDelay
            | Metric::InstructionsPerStep
            | Metric::Overruns
            | Metric::ShutdownTime
            | Metric::MissedReplies => None,
        }
    }
}

/// The exact plate, as far as the sensor can see it.
fn exact(plate: &Plate) -> Tier {
    if plate.lockin.is_some() { Tier::Carrier } else { Tier::Modal }
}

/// The value that an expectation is about, and how far a result may be from it.
fn width(expectation: &Expectation) -> (f64, f64) {
    let (low, high) = expectation.limit.range();
    let one_sided = |limit: f64| (limit.abs(), ONE_SIDED * limit.abs());
    let lowest = expectation.metric.possible().0;
    match expectation.limit {
        Limit::AtMost(limit) | Limit::AtLeast(limit) => one_sided(limit),
        // No result lies below: it is a limit on one side.
        Limit::Within(..) if low <= lowest => one_sided(high),
        Limit::Within(..) | Limit::About { .. } => (high, (high - low) / 2.0),
    }
}

/// The smallest setpoint above 0 that is ever asked for, µm; 0 where it goes through 0 or there is none.
fn smallest_setpoint(profile: &Profile) -> f64 {
    let (low, high) = profile.range();
    match profile {
        Profile::Hold(points) => {
            let smallest =
                points.iter().map(|point| point.1).filter(|value| *value > 0.0).fold(f64::INFINITY, f64::min);
            if smallest.is_finite() { smallest } else { 0.0 }
        }
        _ if high > 0.0 => low.max(0.0),
        _ => 0.0,
    }
}

/// The smallest change between two setpoints in a row, from rest on, µm.
fn smallest_step(profile: &Profile) -> f64 {
    let (Profile::Hold(points) | Profile::Linear(points)) = profile else { return 0.0 };
    let values = std::iter::once(0.0).chain(points.iter().map(|point| point.1));
    let steps = values.clone().zip(values.skip(1)).map(|(before, after)| (after - before).abs());
    let smallest = steps.filter(|step| *step > 0.0).fold(f64::INFINITY, f64::min);
    if smallest.is_finite() { smallest } else { 0.0 }
}

#[cfg(test)]
mod tests;
