//! Measures one trial and decides whether it counts.

use crate::divergence::detect_divergence;
use crate::exclusion::{find_exclusion, find_real_plate_exclusion, saturation_excuse};
use crate::feasibility::{infeasibility_excuse, may_be_limited};
use crate::metrics::{Measure, measure_with_instants};
use crate::symptoms::detect_symptom;
use platebench_model::record::{
    Cause, Divergence, Exclusion, Excuse, LoopSymptom, MetricValues, Telemetry, TrialReason, TrialRecord, Violation,
    WorstInstant,
};
use platebench_model::scenario::{Expectation, Metric, Scenario, Variation};
use platebench_model::trace::{Flags, Row};
use std::borrow::Cow;
use std::collections::BTreeMap;

/// Everything about a trial that verdicts depend on.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TrialMeasures {
    pub index: u32,
    pub seed: u64,
    /// One measure per expectation of the scenario. `worst` and `excuses` have the same order.
    pub measures: Vec<Measure>,
    pub worst: Vec<Option<WorstInstant>>,
    pub excuses: Vec<Option<Excuse>>,
    /// The rig's message about the loss of the controller.
    pub ended: Option<String>,
    /// The controller's first reason for a stop. It explains a failure and never causes one.
    pub stopped: Option<String>,
    pub violations: Vec<Violation>,
    /// Explains a failure and never causes one.
    pub divergence: Option<Divergence>,
    pub symptom: Option<LoopSymptom>,
    pub exclusion: Option<Exclusion>,
    /// True for a real plate, whose motion only the controller's own sensor measures.
    pub is_real_plate: bool,
}

pub fn measure(scenario: &Scenario, index: u32, rows: &[Row], telemetry: &Telemetry) -> TrialMeasures {
    let scenario = scenario.of_trial(index);
    let variation = Variation::of_trial(scenario, index);
    let plant = variation.plant(scenario);
    let expectations = &scenario.expectations;
    let is_real_plate = rows.iter().any(|row| row.flags.contains(Flags::SENSED));
    // Neither the bench nor a limit of the drive ends a controller.
    let failed = telemetry.ended_by_controller;
    let is_limited = !is_real_plate && may_be_limited(rows);
    let excuses = expectations.iter().map(|expectation| {
        if failed {
            None
        } else if is_real_plate {
            saturation_excuse(expectation, rows)
        } else {
            is_limited.then(|| infeasibility_excuse(scenario, expectation, &plant, rows)).flatten()
        }
    });
    let (measures, worst) =
        expectations.iter().map(|expectation| measure_with_instants(expectation, index, rows, telemetry)).unzip();
    TrialMeasures {
        index,
        seed: variation.seed,
        measures,
        worst,
        excuses: excuses.collect(),
        ended: telemetry.ended.clone(),
        stopped: telemetry.stopped.clone(),
        violations: violations(scenario, telemetry),
        divergence: detect_divergence(scenario, rows, telemetry),
        symptom: detect_symptom(scenario, rows, telemetry),
        exclusion: if failed {
            None
        } else if is_real_plate {
            find_real_plate_exclusion(scenario, rows, telemetry.real_plate.as_deref())
        } else {
            find_exclusion(scenario, rows, telemetry)
        },
        is_real_plate,
    }
}

/// A step longer than its period is a violation, unless the scenario states a limit of its own.
fn violations(scenario: &Scenario, telemetry: &Telemetry) -> Vec<Violation> {
    let step_time = telemetry.step_time.filter(|_| !scenario.expects(Metric::StepTime));
    telemetry.violations.iter().copied().chain(step_time.and_then(|steps| steps.violation())).collect()
}

impl TrialMeasures {
    /// True if the controller was lost and the rig caused it.
    pub fn has_lost_controller(&self) -> bool {
        let is_rig = self.exclusion.as_ref().is_some_and(|exclusion| exclusion.cause() == Cause::Rig);
        is_rig && self.violations.is_empty() && self.ended.is_some()
    }

    /// Smallest margin of the expectations that apply to one trial. Negative if the trial misses a
    /// limit; minus infinity if it lacks a value, violates the protocol, diverges, loses the
    /// controller or does not count.
    pub fn margin(&self, expectations: &[Expectation]) -> f64 {
        let is_broken = self.exclusion.is_some()
            || self.divergence.is_some()
            || self.ended.is_some()
            || !self.violations.is_empty();
        if is_broken {
            return f64::NEG_INFINITY;
        }
        let of_trial = expectations.iter().zip(&self.measures).filter(|(expectation, _)| expectation.metric.has_over());
        let margins = of_trial.filter_map(|(expectation, measure)| match measure.value() {
            Some(value) => expectation.margin(expectation.metric.spec().judged(value)),
            None => Some(f64::NEG_INFINITY),
        });
        margins.fold(f64::INFINITY, f64::min)
    }
}

/// `trial` must be measured from `telemetry` and from the rows in `trace`.
pub fn trial_record(
    scenario: &Scenario,
    trial: &TrialMeasures,
    telemetry: Telemetry,
    trace: String,
    wall_ms: Option<f64>,
) -> TrialRecord {
    let mut counts: BTreeMap<Metric, u32> = BTreeMap::new();
    let mut values = MetricValues::with_capacity(scenario.expectations.len());
    for (expectation, measure) in scenario.expectations.iter().zip(&trial.measures) {
        let metric = expectation.metric;
        // These metrics compare trials, so one trial has no value.
        if !metric.has_over() {
            continue;
        }
        let count = counts.entry(metric).or_default();
        *count += 1;
        let name = if *count == 1 { Cow::Borrowed(metric.name()) } else { Cow::Owned(format!("{metric}[{count}]")) };
        values.set(name, measure.value().map(|value| metric.spec().judged(value)));
    }
    let excluded = trial.exclusion.clone().map(TrialReason::Excluded);
    let ended = || trial.ended.clone().map(TrialReason::Ended);
    let diverged = || trial.divergence.map(TrialReason::Diverged);
    let violation = trial.violations.first().copied().map(TrialReason::Violation);
    TrialRecord {
        index: trial.index,
        seed: trial.seed,
        trace,
        sha256: None,
        metrics: values,
        telemetry,
        cause: trial.exclusion.as_ref().filter(|_| violation.is_none()).map(Exclusion::cause),
        reason: violation.or(excluded).or_else(ended).or_else(diverged),
        diverged_at_s: trial.divergence.map(|divergence| divergence.at_s),
        symptom: trial.symptom,
        wall_ms,
    }
}
