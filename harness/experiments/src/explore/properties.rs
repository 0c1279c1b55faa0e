//! Turns the windows of a trial into expectations, the properties that every scene must have.

use crate::explore::generator::MAX_STEADY_DRIVE;
use crate::explore::limits::{BAND, Knowledge, Limits};
use crate::explore::scene::Tuning;
use crate::explore::scene::{Course, Relation, Scene, SceneTrial};
use crate::explore::timeline::EDGE_US;
use platebench_model::scenario::Metric;
use platebench_plate::Plate;
use schemars::JsonSchema;
use serde::Serialize;
use std::f64::consts::TAU;

#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Serialize,
    JsonSchema,
    strum::VariantArray,
    strum::Display,
    strum::IntoStaticStr,
)]
#[serde(rename_all = "kebab-case")]
#[strum(const_into_str, serialize_all = "kebab-case")]
pub enum Property {
    Settling,
    Overshoot,
    StaticError,
    Ripple,
    /// The excitation is at the resonance at the end of a window without changes.
    Frequency,
    /// The drive is near 0 Vpp at setpoint 0.
    RestDrive,
    /// A disturbance moves the amplitude only as far as physics requires.
    Deviation,
    Recovery,
    /// The amplitude follows a ramp of the setpoint.
    Tracking,
    /// Trials that differ only in history and time stamps have the same response.
    SameResponse,
    /// Half the setpoint and half the drive limit give half the response.
    ProportionalResponse,
    /// A resonance on the other side of the start frequency gives the same amplitude.
    MirroredResponse,
    /// A compensated delay in the loop delays the response and changes nothing else.
    DelayedResponse,
    /// The rules of the protocol, checked in every trial.
    Protocol,
    /// The commands equal those of the hosted reference.
    Reference,
    /// The answers to scripts of messages equal those of the hosted reference.
    Answers,
}

impl Property {
    pub const ALL: &[Self] = <Self as strum::VariantArray>::VARIANTS;

    pub const fn name(self) -> &'static str {
        self.into_str()
    }

    pub(crate) const fn metric(self) -> Option<Metric> {
        Some(match self {
            Self::Settling => Metric::SettlingTime,
            Self::Overshoot => Metric::Overshoot,
            Self::StaticError => Metric::StaticError,
            Self::Ripple => Metric::RipplePercent,
            Self::Frequency => Metric::FrequencyError,
            Self::RestDrive => Metric::RestDrive,
            Self::Deviation | Self::Tracking => Metric::PeakDeviation,
            Self::Recovery => Metric::RecoveryTime,
            Self::Reference => Metric::ReferenceDifference,
            Self::Answers => Metric::ProtocolDifferences,
            Self::ProportionalResponse | Self::MirroredResponse | Self::DelayedResponse => Metric::TrialDifference,
            Self::SameResponse | Self::Protocol => return None,
        })
    }

    /// True if the limit follows from the design of the law.
    pub(crate) const fn needs_limits(self) -> bool {
        match self {
            Self::Settling
            | Self::Overshoot
            | Self::StaticError
            | Self::Ripple
            | Self::Frequency
            | Self::RestDrive
            | Self::Deviation
            | Self::Recovery
            | Self::Tracking => true,
            Self::SameResponse
            | Self::ProportionalResponse
            | Self::MirroredResponse
            | Self::DelayedResponse
            | Self::Protocol
            | Self::Reference
            | Self::Answers => false,
        }
    }

    /// `name` is the name of an expectation: a property, possibly followed by a number.
    pub fn of_name(name: &str) -> Option<Self> {
        let name = name.split_once(' ').map_or(name, |(name, _)| name);
        Self::ALL.iter().copied().find(|property| property.name() == name)
    }
}

/// An upper limit of a property in a window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Demand {
    pub property: Property,
    pub from_us: u32,
    pub until_us: u32,
    /// Largest value, in the unit of the metric.
    pub at_most: f64,
    /// Half width of the band, percent, if the metric has one.
    pub band_percent: Option<f64>,
}

/// Largest drive at setpoint 0, Vpp, from the rest of the integral, which decays with the plate.
const REST_DRIVE_VPP: f64 = 0.5;
/// Number of standard deviations by which noise may change a value.
const NOISE_SIGMAS: f64 = 6.0;
/// Shortest steady window, control periods.
const STEADY_PERIODS: u32 = 4;
const STATIC_ERROR_PERCENT: f64 = 0.2;
/// Additional limits of an own law: drive at rest as in the requirement GEN-1, Vpp; overshoot; and
/// static error and half of the ripple, for a law that calculates in steps of a fixed size.
const OWN_REST_DRIVE_VPP: f64 = 1.0;
const OWN_OVERSHOOT_PERCENT: f64 = 60.0;
const OWN_STEADY_PERCENT: f64 = 0.3;
const OWN_STEADY_UM: f64 = 1e-3;
/// Further additional limits of an own law: frequency, Hz, and resolution of its components, µm.
const OWN_FREQUENCY_HZ: f64 = 0.25;
const OWN_RESOLUTION_UM: f64 = 2e-4;
/// Relative error of the damping that a law may have adopted while it was at a limit.
const UNKNOWN_MISMATCH: f64 = 0.3;
const RIPPLE_PERCENT: f64 = 0.25;
/// Static error and ripple per relative error of the damping, until the law has corrected it.
const STATIC_OF_MISMATCH: f64 = 0.5;
const RIPPLE_OF_MISMATCH: f64 = 1.0;
const FREQUENCY_ERROR_HZ: f64 = 0.5;
/// Frequency error per change of the resonance, until the law has corrected it.
const FREQUENCY_OF_MOVE: f64 = 0.5;
const OVERSHOOT_PERCENT: f64 = 10.0;
const UNKNOWN_OVERSHOOT_PERCENT: f64 = 30.0;
/// Part of the overshoot that does not depend on the height of the step, percent of the setpoint.
const OVERSHOOT_OF_SETPOINT_PERCENT: f64 = 1.0;
/// Factor on the effect of a disturbance before the loop reacts, and on the lag behind a ramp.
const DEVIATION_FACTOR: f64 = 2.0;
/// Control periods after a setpoint step. In this time, a law that computes drives in advance
/// mistakes a change of the damping for a late drive.
const STEERING_PERIODS: u32 = 6;
/// Closed-loop time constant of the slowest law that holds the amplitude (`deadbeat`), µs.
const CLOSED_LOOP_US: u32 = 1_000;
/// Relative change of the amplitude per relative change of the damping, if the law adopts it.
const DEVIATION_OF_MISMATCH: f64 = 0.2;
const DEVIATION_PERCENT: f64 = 1.0;

/// Allowed difference of commands, percent of the drive limit or of the frequency range. f32
/// rounding causes about a hundredth of it.
pub(crate) const REFERENCE_DIFFERENCE_PERCENT: f64 = 0.1;

/// Demands that commands and answers in the judged trial of `scene` equal those of the reference.
pub fn reference_demands(scene: &Scene) -> Vec<Demand> {
    let demand = |property, at_most| Demand {
        property,
        from_us: 0,
        until_us: scene.judged.duration_us,
        at_most,
        band_percent: None,
    };
    let answers = scene.script_seed.map(|_| demand(Property::Answers, 0.0));
    [demand(Property::Reference, REFERENCE_DIFFERENCE_PERCENT)].into_iter().chain(answers).collect()
}

/// Largest difference from a response that a relation predicts, share of the largest setpoint.
const RELATION_DIFFERENCE: f64 = 1e-3;
/// The same for an own law, which may calculate in steps of a fixed size.
const OWN_RELATION_DIFFERENCE: f64 = 2e-2;

/// Allowed error of a law's prediction over the delay, share of the amplitude's change in this time.
const PREDICTION_ERROR: f64 = 0.1;
/// Largest drive of a step relative to the drive that holds the setpoint.
const PEAK_DRIVE: f64 = 2.0;

/// Demands that the second play of `scene` has the response that its relation predicts.
pub fn relation_demand(scene: &Scene, base: &Plate) -> Option<Demand> {
    let trial = &scene.judged;
    let relation = scene.relation?;
    let predicted = match relation {
        // b V d with V = PEAK_DRIVE W / K1, relative to W.
        Relation::Delayed => {
            PREDICTION_ERROR * PEAK_DRIVE * trial.plate.apply(base).sigma0 * f64::from(trial.delay_us) * 1e-6
        }
        Relation::Proportional | Relation::Mirrored => 0.0,
    };
    let difference = if trial.law.is_own() { OWN_RELATION_DIFFERENCE } else { RELATION_DIFFERENCE };
    Some(Demand {
        property: relation.property(),
        from_us: 0,
        until_us: trial.played_us(scene.relation),
        at_most: trial.setpoint.range()[1].max(1.0) * 1e-3 * (difference + predicted),
        band_percent: None,
    })
}

/// Demands on the judged trial of `scene` that follow from the physics of the plate.
pub fn demands(scene: &Scene, base: &Plate) -> Vec<Demand> {
    let trial = &scene.judged;
    let Some(properties) = trial.law.properties() else { return Vec::new() };
    let limits = Limits::new(trial, base, properties);
    let is_own = properties.own.is_some();
    // The limits are derived for gains of the law's own design.
    let Tuning { range_tenths, slew_tenths, .. } = trial.tuning;
    let frequency_limits =
        if is_own { Tuning { range_tenths, slew_tenths, ..Tuning::default() } } else { Tuning::default() };
    if trial.tuning != frequency_limits {
        return Vec::new();
    }
    // The gain of an own law for noise is unknown.
    if is_own && trial.plate.noise_pm > 0 {
        return Vec::new();
    }
    let has_sine = [&trial.force, &trial.temperature].iter().any(|course| matches!(course, Course::Sine { .. }));
    if has_sine {
        return Vec::new();
    }
    // The limits of a trial with a delay do not apply to its play without one.
    if scene.relation == Some(Relation::Delayed) {
        return Vec::new();
    }
    let highest = trial.largest_setpoint_nm(base, MAX_STEADY_DRIVE);
    if !is_own && trial.setpoint.range()[1] > f64::from(highest) {
        return Vec::new();
    }
    let mut demands = Vec::new();
    // True while damping and resonance are those of the last steady state, which the law knows.
    let mut is_known = false;
    let mut was_steady = false;
    let mut mismatch = limits.initial_mismatch();
    let mut moved_hz = limits.initial_detuning_hz();
    let mut last_from_us = 0;
    let mut is_touched_at_rest = false;
    // True if the amplitude was steady at the drive limit.
    let mut was_limited = false;
    for window in windows(trial) {
        let change = window.change;
        let since_last = last_from_us..=change.from_us;
        if trial.faults.iter().any(|fault| fault.may_stop() && since_last.contains(&fault.until_us)) {
            // The controller is configured again and forgets damping and resonance.
            is_known = false;
            mismatch = f64::max(mismatch, limits.initial_mismatch());
            moved_hz = f64::max(moved_hz, limits.initial_detuning_hz());
        }
        last_from_us = change.from_us;
        mismatch += limits.mismatch_of(change.from_us, change.to_us);
        moved_hz += limits.change_of_resonance_hz(change.from_us, change.to_us);
        if limits.properties.steers && resembles_late_drive(trial, change) {
            break;
        }
        let is_in_range = limits.is_in_range(change.to_us);
        if is_own && !(is_in_range && limits.has_drive(change.to_us)) {
            // The law knows neither damping nor resonance after a time at a limit.
            (is_known, was_steady, mismatch) = (false, false, f64::max(mismatch, UNKNOWN_MISMATCH));
            was_limited = is_in_range && window.quiet_us() >= to_us(limits.decay_at_rest(change.to_us));
            continue;
        }
        let judge = WindowJudge {
            limits: &limits,
            trial,
            window,
            is_known,
            was_steady,
            is_touched_at_rest,
            was_limited,
            mismatch,
            moved_hz,
        };
        judge.add_demands(&mut demands);
        was_limited = false;
        if change.force || change.temperature {
            is_known = false;
        }
        let is_driven = trial.setpoint_at(change.to_us) > 0.0;
        was_steady = window.quiet_us() >= judge.steady_us();
        // At the slew limit the remaining detuning is unknown.
        if is_driven && (was_steady || trial.tuning == Tuning::default()) {
            mismatch *= limits.tracking_remainder(window.quiet_us());
            moved_hz *= limits.tracking_remainder(window.quiet_us());
        }
        is_touched_at_rest = !is_driven && (is_touched_at_rest || change.force);
        // At rest the law measures neither damping nor resonance.
        is_known |= was_steady && is_driven;
    }
    let recovered_us = trial.faults.iter().map(|fault| fault.recovered_us(trial.period_us)).max().unwrap_or(0);
    demands.retain(|demand| demand.from_us >= recovered_us);
    demands
}

struct WindowJudge<'a> {
    limits: &'a Limits<'a>,
    trial: &'a SceneTrial,
    window: PropertyWindow,
    is_known: bool,
    /// True if the previous window was long enough to settle.
    was_steady: bool,
    /// True if the force changed during the rest before. The law drives for another damping until it
    /// has measured it, so that the amplitude may overshoot in proportion.
    is_touched_at_rest: bool,
    /// True if the amplitude was steady below the setpoint, at the drive limit.
    was_limited: bool,
    /// Relative error of the damping that the law assumes at the end of the change.
    mismatch: f64,
    /// Sum of the changes of the resonance that the law has not tracked yet.
    moved_hz: f64,
}

/// True if the damping changes so soon after a step that the law mistakes it for a late drive.
fn resembles_late_drive(trial: &SceneTrial, change: Change) -> bool {
    let moves = trial.setpoint.moves();
    let last = moves.iter().rfind(|[from, _]| *from <= change.to_us).map_or(0, |[_, to]| (*to).min(change.to_us));
    change.force && change.from_us <= last + STEERING_PERIODS * trial.period_us
}

impl WindowJudge<'_> {
    /// Setpoints before and after the change, µm.
    fn levels(&self) -> (f64, f64) {
        let change = self.window.change;
        let before = if change.from_us == 0 { 0.0 } else { self.trial.setpoint_at(change.from_us - 1) };
        (before, self.trial.setpoint_at(change.to_us))
    }

    /// Time from the end of the change until the state is steady, µs.
    fn steady_us(&self) -> u32 {
        let (before, after) = self.levels();
        if after == 0.0 {
            return to_us(self.limits.decay_at_rest(self.window.change.to_us));
        }
        to_us(self.limits.steady(self.window.change.to_us, before, after) + self.limits.slew(self.moved_hz))
    }

    fn add_demands(&self, demands: &mut Vec<Demand>) {
        let PropertyWindow { change, until_us } = self.window;
        let (before, after) = self.levels();
        if after == 0.0 {
            // At setpoint 0 the drive loop is active, so the drive may rise again during the decay.
            let from_us = change.to_us + self.steady_us();
            if from_us + STEADY_PERIODS * self.trial.period_us <= until_us {
                let noise_vpp = NOISE_SIGMAS * self.limits.noise_um() * self.limits.strongest_gain();
                let rest_vpp = if self.is_own() { OWN_REST_DRIVE_VPP } else { REST_DRIVE_VPP };
                demands.push(self.demand(Property::RestDrive, from_us, until_us, rest_vpp + noise_vpp));
            }
            return;
        }
        if self.noise_percent(after) > 3.0 {
            return;
        }
        if change.is_setpoint_ramp() {
            self.add_tracking(demands);
        } else if change.setpoint && !change.force && !change.temperature {
            self.add_step(demands, before, after);
        } else if !change.setpoint {
            self.add_disturbance(demands, after);
        }
        self.add_steady_state(demands, after);
    }

    fn is_own(&self) -> bool {
        self.limits.properties.own.is_some()
    }

    /// Allowance for an own law that calculates in steps of a fixed size.
    fn own_percent(&self, setpoint: f64) -> f64 {
        if self.is_own() { OWN_STEADY_PERCENT + OWN_STEADY_UM / setpoint * 100.0 } else { 0.0 }
    }

    fn noise_percent(&self, setpoint: f64) -> f64 {
        NOISE_SIGMAS * self.limits.noise_um() / setpoint * 100.0
    }

    fn demand(&self, property: Property, from_us: u32, until_us: u32, at_most: f64) -> Demand {
        let band = matches!(property, Property::Settling | Property::Recovery | Property::Deviation);
        let level = self.trial.setpoint_at(from_us);
        let band_percent = band.then(|| BAND * 100.0 + self.noise_percent(level));
        Demand { property, from_us, until_us, at_most, band_percent }
    }

    fn add_step(&self, demands: &mut Vec<Demand>, before: f64, after: f64) {
        let PropertyWindow { change, until_us } = self.window;
        let is_first = change.from_us == 0;
        if !(is_first || self.was_steady || self.was_limited) {
            return;
        }
        let is_forgotten = before == 0.0 && self.limits.properties.steers;
        let knowledge = if self.is_known && !is_forgotten { Knowledge::Settled } else { Knowledge::Unknown };
        let slew = if knowledge == Knowledge::Settled { 0.0 } else { self.limits.slew(self.moved_hz) };
        let allowed = self.limits.settling(change.to_us, before, after, knowledge) + slew;
        if self.window.quiet_us() > to_us(allowed) + self.trial.period_us {
            demands.push(self.demand(Property::Settling, change.to_us, until_us, allowed * 1e3));
        }
        let is_known = self.is_known && before > 0.0;
        // An own law may hold Wd, so |W| overshoots until the frequency is at the resonance.
        if self.is_touched_at_rest {
            return;
        }
        if self.window.quiet_us() > 2 * self.trial.period_us && (is_known || !self.is_own()) {
            let of_step = match is_known {
                true if self.is_own() => OWN_OVERSHOOT_PERCENT,
                true => OVERSHOOT_PERCENT,
                false => UNKNOWN_OVERSHOOT_PERCENT,
            };
            let of_mismatch = STATIC_OF_MISMATCH * self.mismatch * 100.0;
            let of_setpoint = OVERSHOOT_OF_SETPOINT_PERCENT + of_mismatch + self.noise_percent(after.max(before));
            let at_most = of_step + of_setpoint * after.max(before) / (after - before).abs();
            demands.push(self.demand(Property::Overshoot, change.to_us, until_us, at_most));
        }
    }

    /// During a ramp the amplitude lags behind the setpoint by rate · lag.
    fn add_tracking(&self, demands: &mut Vec<Demand>) {
        let Change { from_us, to_us, .. } = self.window.change;
        let judged_us = if self.was_steady { from_us } else { from_us + self.steady_us() };
        let points = self.trial.setpoint.points().array_windows();
        let parts = points.filter(|[(start, _), _]| (from_us..to_us).contains(start));
        let rate = |[(start, low), (end, high)]: &[(u32, i32); 2]| f64::from(high - low).abs() / f64::from(end - start);
        let fastest = parts.clone().map(rate).fold(0.0, f64::max) * 1e3;
        let lowest = parts.flatten().map(|(_, level)| f64::from(*level) * 1e-3).fold(f64::INFINITY, f64::min);
        if judged_us + STEADY_PERIODS * self.trial.period_us > to_us || lowest == 0.0 {
            return;
        }
        let lag = DEVIATION_FACTOR * fastest * self.limits.lag(to_us) / lowest * 100.0;
        let steady = DEVIATION_PERCENT + STATIC_OF_MISMATCH * self.mismatch * 100.0 + self.own_percent(lowest);
        let at_most = lag + steady + self.noise_percent(lowest);
        demands.push(self.demand(Property::Tracking, judged_us, to_us, at_most));
    }

    fn add_disturbance(&self, demands: &mut Vec<Demand>, level: f64) {
        let PropertyWindow { change, until_us } = self.window;
        if !self.was_steady {
            return;
        }
        let allowed = if change.temperature {
            self.limits.settling(change.to_us, level, level, Knowledge::Unknown) + self.limits.slew(self.moved_hz)
        } else {
            self.limits.recovery_of_force(change.from_us, change.to_us, level)
        };
        if self.window.quiet_us() > to_us(allowed) + self.trial.period_us {
            demands.push(self.demand(Property::Recovery, change.to_us, until_us, allowed * 1e3));
        }
        // How far a disturbance moves the amplitude is part of the design.
        if self.is_own() {
            return;
        }
        let reaction_us = self.trial.period_us + self.trial.delay_us + self.trial.period_us.max(CLOSED_LOOP_US);
        let moved_us = change.to_us.min(change.from_us + reaction_us).max(change.from_us);
        let [mode_before, mode_after] = [change.from_us.saturating_sub(1), moved_us].map(|at| self.limits.mode(at));
        let effect = Limits::effect(&mode_before, &mode_after, f64::from(reaction_us) * 1e-6) * 100.0;
        let change_of_damping = self.limits.change_of_damping(change.from_us, change.to_us).max(self.mismatch);
        let adoption = DEVIATION_OF_MISMATCH * change_of_damping * 100.0;
        let at_most = DEVIATION_FACTOR * effect + adoption + DEVIATION_PERCENT + self.noise_percent(level);
        demands.push(self.demand(Property::Deviation, change.from_us, until_us, at_most));
    }

    fn add_steady_state(&self, demands: &mut Vec<Demand>, level: f64) {
        let PropertyWindow { change, until_us } = self.window;
        let from_us = change.to_us + self.steady_us();
        if from_us + STEADY_PERIODS * self.trial.period_us > until_us {
            return;
        }
        let noise = self.noise_percent(level);
        let mismatch = self.mismatch * self.limits.tracking_remainder(from_us - change.to_us) * 100.0;
        let moved_hz = self.moved_hz * self.limits.tracking_remainder(until_us - change.to_us);
        // tan φ = Δω/σ: an error of the phase looks like a detuning.
        let noise_hz = self.limits.frequency_of_phase(change.to_us, noise / 100.0);
        let own_percent = self.own_percent(level);
        // tan φ = Δω/σ: an error of a component looks like a detuning too.
        let resolution_hz = self.limits.mode(change.to_us).sigma / TAU * OWN_RESOLUTION_UM / level;
        let own_hz = if self.is_own() { OWN_FREQUENCY_HZ + resolution_hz } else { 0.0 };
        let pairs = [
            (Property::StaticError, STATIC_ERROR_PERCENT + STATIC_OF_MISMATCH * mismatch + noise + own_percent),
            (Property::Ripple, RIPPLE_PERCENT + RIPPLE_OF_MISMATCH * mismatch + 2.0 * noise + 2.0 * own_percent),
            (Property::Frequency, FREQUENCY_ERROR_HZ + FREQUENCY_OF_MOVE * moved_hz + noise_hz + own_hz),
        ];
        demands.extend(pairs.map(|(property, at_most)| self.demand(property, from_us, until_us, at_most)));
    }
}

fn to_us(seconds: f64) -> u32 {
    (seconds * 1e6).ceil() as u32
}

/// Interval in which inputs change. Start and end of a step are equal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Change {
    pub(crate) from_us: u32,
    pub(crate) to_us: u32,
    pub(crate) setpoint: bool,
    pub(crate) force: bool,
    pub(crate) temperature: bool,
}

impl Change {
    /// A step in a course with ramps takes [`EDGE_US`].
    pub(crate) const fn is_setpoint_ramp(&self) -> bool {
        self.setpoint && !self.force && !self.temperature && self.to_us - self.from_us > EDGE_US
    }
}

/// A change, and the time without changes after it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PropertyWindow {
    pub(crate) change: Change,
    pub(crate) until_us: u32,
}

impl PropertyWindow {
    pub(crate) const fn quiet_us(&self) -> u32 {
        self.until_us.saturating_sub(self.change.to_us)
    }
}

fn changes(trial: &SceneTrial) -> Vec<Change> {
    let change = |[from_us, to_us]: [u32; 2], setpoint, force, temperature| Change {
        from_us,
        to_us: to_us.min(trial.duration_us),
        setpoint,
        force,
        temperature,
    };
    // The plate starts at rest, so the setpoint at the start is a step.
    let start = (trial.setpoint.at(0) > 0.0).then_some([0; 2]);
    let setpoints = start.into_iter().chain(trial.setpoint.moves()).map(|ends| change(ends, true, false, false));
    let forces = trial.force.moves().into_iter().map(|ends| change(ends, false, true, false));
    let temperatures = trial.temperature.moves().into_iter().map(|ends| change(ends, false, false, true));
    let mut all: Vec<Change> = setpoints.chain(forces).chain(temperatures).collect();
    all.sort_by_key(|change| (change.from_us, change.to_us));
    let mut merged: Vec<Change> = Vec::with_capacity(all.len());
    for next in all {
        match merged.last_mut() {
            Some(last) if next.from_us <= last.to_us => {
                last.to_us = last.to_us.max(next.to_us);
                last.setpoint |= next.setpoint;
                last.force |= next.force;
                last.temperature |= next.temperature;
            }
            _ => merged.push(next),
        }
    }
    merged
}

pub(crate) fn windows(trial: &SceneTrial) -> Vec<PropertyWindow> {
    let changes = changes(trial);
    let ends = changes.iter().skip(1).map(|next| next.from_us).chain([trial.duration_us]);
    changes.iter().zip(ends).map(|(change, until_us)| PropertyWindow { change: *change, until_us }).collect()
}
