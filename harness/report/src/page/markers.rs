//! Finds start, end and deadline of the times that expectations measure in a trial.

use crate::format;
use platebench_model::metrics::ElapsedLabels;
use platebench_model::record::{
    ExpectationRecord, Limit, Metric, MetricDefinition, ScenarioRecord, TrialRecord, Verdict,
};

/// All instants are in ms since the start of the trial.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TimeMarker {
    pub(crate) text: String,
    pub(crate) from_ms: Option<f64>,
    pub(crate) instant_ms: Option<f64>,
    /// Latest allowed end in ms, and text of the expectation.
    pub(crate) deadline: Option<(f64, String)>,
    pub(crate) is_on_drive: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Settling {
    Unknown,
    Never,
    At {
        /// Time since the start of the trial.
        instant_ms: f64,
        /// Time since the setpoint step.
        after_ms: f64,
    },
}

/// Index of the first settling time that did not pass. If there is none, of the first settling
/// time, then of the first metric with a band.
pub(crate) fn settling_expectation(scenario: &ScenarioRecord) -> Option<usize> {
    let all = || scenario.expectations.iter().enumerate();
    let settling = || all().filter(|(_, found)| found.metric == Metric::SettlingTime);
    let not_passed = settling().find(|(_, found)| found.verdict != Verdict::Pass);
    let banded = all().find(|(_, found)| found.definition.band_percent.is_some());
    not_passed.or_else(|| settling().next()).or(banded).map(|(index, _)| index)
}

pub(crate) fn settling(scenario: &ScenarioRecord, trial: &TrialRecord, index: usize, steps_ms: &[f64]) -> Settling {
    let Some(expectation) = scenario.expectations.get(index).filter(|found| found.metric == Metric::SettlingTime)
    else {
        return Settling::Unknown;
    };
    match trial.metrics.get(&scenario.metric_key(index)) {
        None => Settling::Unknown,
        Some(None) => Settling::Never,
        Some(Some(after_ms)) => settling_start_ms(&expectation.definition, steps_ms)
            .map_or(Settling::Unknown, |step_ms| Settling::At { instant_ms: step_ms + after_ms, after_ms }),
    }
}

/// Instant of the last setpoint step up to `from_ms`, or of the first step.
fn settling_start_ms(definition: &MetricDefinition, steps_ms: &[f64]) -> Option<f64> {
    let passed = definition.from_ms.map_or(1, |from_ms| steps_ms.partition_point(|step_ms| *step_ms <= from_ms));
    steps_ms.get(passed.saturating_sub(1)).copied()
}

/// Marker of settling, and for recovery and shutdown markers of the expectations that did not pass
/// or, if all passed, of the first one.
pub(crate) fn time_markers(
    scenario: &ScenarioRecord,
    trial: &TrialRecord,
    settling: Settling,
    expected: Option<usize>,
    steps_ms: &[f64],
) -> Vec<TimeMarker> {
    let mut found = Vec::new();
    let settling_text = match settling {
        Settling::Unknown => None,
        Settling::Never => Some(("does not settle".to_owned(), None)),
        Settling::At { instant_ms, after_ms } => {
            Some((format!("settled after {} ms", format::number(after_ms)), Some(instant_ms)))
        }
    };
    if let (Some((text, instant_ms)), Some(index)) = (settling_text, expected) {
        let definition = scenario.expectations.get(index).map(|expectation| &expectation.definition);
        let from_ms = definition.and_then(|definition| settling_start_ms(definition, steps_ms));
        let deadline = from_ms.and_then(|from_ms| deadline(scenario, index, from_ms));
        found.push(TimeMarker { text, from_ms, instant_ms, deadline, is_on_drive: false });
    }
    let elapsed_metrics = Metric::ALL.iter().filter_map(|&metric| Some((metric, metric.spec().elapsed?)));
    for (metric, labels) in elapsed_metrics {
        let of_metric = || scenario.expectations.iter().enumerate().filter(|(_, found)| found.metric == metric);
        let mut shown: Vec<usize> =
            of_metric().filter(|(_, found)| found.verdict != Verdict::Pass).map(|(index, _)| index).collect();
        if shown.is_empty() {
            shown.extend(of_metric().next().map(|(index, _)| index));
        }
        let marker = |index| elapsed_marker(scenario, trial, index, labels);
        found.extend(shown.into_iter().filter_map(marker));
    }
    found
}

/// `None` if the trial has no result or the expectation has no `from_ms`.
fn elapsed_marker(
    scenario: &ScenarioRecord,
    trial: &TrialRecord,
    index: usize,
    labels: ElapsedLabels,
) -> Option<TimeMarker> {
    let expectation = scenario.expectations.get(index)?;
    let from_ms = expectation.definition.from_ms?;
    let after_ms = trial.metrics.get(&scenario.metric_key(index))?;
    let text = after_ms.map_or_else(
        || labels.not_reached.to_owned(),
        |after_ms| format!("{} {} ms", labels.reached, format::number(after_ms)),
    );
    Some(TimeMarker {
        text,
        from_ms: Some(from_ms),
        instant_ms: after_ms.map(|after_ms| from_ms + after_ms),
        deadline: deadline(scenario, index, from_ms),
        is_on_drive: labels.is_on_drive,
    })
}

fn deadline(scenario: &ScenarioRecord, index: usize, from_ms: f64) -> Option<(f64, String)> {
    let expectation = scenario.expectations.get(index)?;
    let at_ms = from_ms + upper_limit(expectation)?;
    Some((at_ms, format!("{} {} ms", expectation.name, format::limit(expectation))))
}

fn upper_limit(expectation: &ExpectationRecord) -> Option<f64> {
    match expectation.limit {
        Limit::AtMost(limit) | Limit::Within(_, limit) => Some(limit),
        Limit::AtLeast(_) | Limit::About(_) => None,
    }
}
