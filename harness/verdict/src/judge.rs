//! Expectation to verdict.
//!
//! * `looks`: which trials are judged, and whether more are needed.
//! * `case`: one expectation over those trials.
//! * `finding`: what came of it.

mod case;
mod finding;
mod looks;

pub use looks::{Decision, judge, sequential};

use crate::divergence::{Divergence, divergence};
use crate::feasibility;
use crate::metrics::{self, Measure};
use crate::real_plate;
use crate::record::{Cause, ExpectationRecord, Telemetry, TrialRecord, Verdict};
use platebench_plate::Time;
use platebench_scenario::{Metric, Scenario};
use platebench_trace::{Flags, Row};
use serde_json::{Map, json};
use std::collections::BTreeMap;

/// Everything about a trial that verdicts are made from.
#[derive(Debug, Clone, PartialEq)]
pub struct TrialMeasures {
    /// Counted from 0.
    pub index: u32,
    /// What its plate and noise were drawn from.
    pub seed: u64,
    /// One measure per expectation of the scenario.
    pub measures: Vec<Measure>,
    /// Per expectation, why missing it is not the controller's doing.
    pub excuses: Vec<Option<Excuse>>,
    /// What the rig told beside the trace.
    pub telemetry: Telemetry,
    /// Whether its loop came to no good end, which is why what it missed was missed.
    pub diverged: Option<Divergence>,
    /// Whose doing it is that the trial does not count, and what happened.
    pub cause: Option<(Cause, String)>,
    /// True where the plate was a real one, seen by its own controller's sensor alone.
    pub sensed: bool,
}

/// Why a missed expectation is not the controller's doing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Excuse {
    /// Whose doing it is.
    pub cause: Cause,
    /// In a sentence.
    pub reason: String,
}

/// A scenario's verdict with everything that it rests on.
#[derive(Debug, Clone, PartialEq)]
pub struct Judgement {
    /// Over all expectations.
    pub verdict: Verdict,
    /// One per expectation of the scenario.
    pub expectations: Vec<ExpectationRecord>,
}

/// Measures the trial with number `index`.
pub fn measure(scenario: &Scenario, index: u32, rows: &[Row], telemetry: &Telemetry) -> TrialMeasures {
    let variation = scenario.variation(index);
    let plant = variation.plant(scenario);
    let expectations = &scenario.expectations;
    let sensed = rows.iter().any(|row| row.flags.contains(Flags::SENSED));
    TrialMeasures {
        index,
        seed: variation.seed,
        measures: expectations.iter().map(|expectation| metrics::measure(expectation, rows, telemetry)).collect(),
        excuses: expectations
            .iter()
            .map(|expectation| {
                if sensed {
                    return real_plate::excuse(expectation, rows);
                }
                let reason = feasibility::excuse(scenario, expectation, &plant, rows)?;
                Some(Excuse { cause: Cause::Infeasible, reason: format!("saturated: {reason}") })
            })
            .collect(),
        telemetry: telemetry.clone(),
        diverged: divergence(scenario, rows, telemetry),
        cause: if sensed {
            real_plate::disturbance(scenario, rows, telemetry.real_plate.as_ref())
        } else {
            disturbance(scenario, rows, telemetry)
        },
        sensed,
    }
}

/// What happened on the way that is not the controller's doing.
fn disturbance(scenario: &Scenario, rows: &[Row], telemetry: &Telemetry) -> Option<(Cause, String)> {
    // An answer that a planned fault swallowed is the experiment itself.
    let is_planned = |row: &&Row| Time::from_seconds(row.t_s).is_some_and(|time| scenario.explains(time));
    let mut flagged = rows.iter().filter(|row| row.flags.contains(Flags::LINK_LOST));
    if let Some(row) = flagged.find(|row| !is_planned(row)) {
        return Some((Cause::Rig, format!("no answer at {} ms", row.t_s * 1e3)));
    }
    let late = || rows.iter().filter(|row| row.flags.contains(Flags::OVERRUN));
    if late().count() as f64 > overrun_budget(scenario)
        && let Some(first) = late().next()
    {
        let what = format!("the bench was too late {} times, first at {} ms", late().count(), first.t_s * 1e3);
        return Some((Cause::Bench, what));
    }
    let paced = telemetry.timing.as_ref().filter(|timing| timing.pacing == "target");
    let clock = paced.and_then(|timing| timing.target_clock_ppm.zip(timing.target_clock_error_ppm));
    if let Some(what) = clock.and_then(|(ppm, error)| other_clock(scenario, ppm, error)) {
        return Some((Cause::Rig, what));
    }
    if let Some(lost) = telemetry.timing.as_ref().map(|timing| timing.lost_rows).filter(|lost| *lost > 0) {
        return Some((Cause::Bench, format!("{lost} rows were lost on their way out of the loop")));
    }
    if let Some(first) = rows.first().filter(|row| row.t_s > 0.0) {
        return Some((Cause::Bench, format!("the trace starts at {} ms", first.t_s * 1e3)));
    }
    // Instants are whole nanoseconds.
    let widest = scenario.trace_step.seconds() + 0.5e-9;
    let gap = rows.windows(2).find(|pair| matches!(pair, [left, right] if right.t_s - left.t_s > widest));
    if let Some([left, right]) = gap {
        let what = format!("no rows between {} and {} ms", left.t_s * 1e3, right.t_s * 1e3);
        return Some((Cause::Bench, format!("{what}, expected one every {}", scenario.trace_step)));
    }
    let end = rows.last().map_or(0.0, |row| row.t_s);
    (end < scenario.duration.seconds())
        .then(|| (Cause::Bench, format!("the trace ends at {} ms instead of {}", end * 1e3, scenario.duration)))
}

/// Says where a controller that makes the control instants by a timer of its own made others than those that the scenario asks for. Crystals are off by some 100 ppm and
/// oscillators on the chip by 1 %; a clock that was set up wrongly is off by a factor.
pub(crate) fn other_clock(scenario: &Scenario, ppm: f64, error_ppm: f64) -> Option<String> {
    const CLOCK_PPM: f64 = 20_000.0;
    // One stall of the computer at either end of the trial.
    const STALL_S: f64 = 0.05;
    let allowed = CLOCK_PPM + 4.0 * error_ppm + STALL_S / scenario.duration.seconds() * 1e6;
    let how = if ppm > 0.0 { "fast" } else { "slow" };
    let percent = ppm.abs() / 1e4;
    (ppm.abs() > allowed).then(|| {
        format!(
            "the controller's clock runs {percent:.0} % {how} by the bench's: its periods are not those of the scenario"
        )
    })
}

/// How many overruns a trial may have and still count: what the scenario expects of `overruns` at most, else none.
fn overrun_budget(scenario: &Scenario) -> f64 {
    let expected = scenario.expectations.iter().filter(|expectation| expectation.metric == Metric::Overruns);
    expected.map(|expectation| expectation.limit.range().1).reduce(f64::min).unwrap_or(0.0)
}

/// The record of a trial, with its metrics by name.
pub fn trial_record(scenario: &Scenario, trial: &TrialMeasures, trace: String, wall_ms: Option<f64>) -> TrialRecord {
    let mut counts: BTreeMap<Metric, u32> = BTreeMap::new();
    let mut by_name = Map::new();
    for (expectation, measure) in scenario.expectations.iter().zip(&trial.measures) {
        let metric = expectation.metric;
        // A single trial has no repeatability.
        if metric == Metric::Repeatability {
            continue;
        }
        let count = counts.entry(metric).or_default();
        *count += 1;
        let name = if *count == 1 { metric.to_string() } else { format!("{metric}[{count}]") };
        by_name.insert(name, json!(shown(metric, measure)));
    }
    let (cause, reason) = trial.cause.clone().unzip();
    let diverged = || trial.diverged.as_ref().map(ToString::to_string);
    let reason = reason.or_else(|| trial.telemetry.ended.clone()).or_else(diverged);
    TrialRecord {
        index: trial.index,
        seed: trial.seed,
        trace,
        sha256: None,
        metrics: by_name,
        telemetry: trial.telemetry.clone(),
        cause,
        reason,
        diverged_at_s: trial.diverged.as_ref().map(|divergence| divergence.at_s),
        wall_ms,
    }
}

fn shown(metric: Metric, measure: &Measure) -> Option<f64> {
    measure.value().map(|value| if metric == Metric::StaticError { value.abs() } else { value })
}

#[cfg(test)]
mod tests;
