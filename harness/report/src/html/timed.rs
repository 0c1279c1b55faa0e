//! Instants that were asked for, in the trial that is drawn as a line: from when the time counts, the last instant that was demanded, and when it came.
//!
//! Neighbours: `bundle` finds the setpoint step that a settling time counts from, `figure` and `interactive` mark what stands here. The numbers are the record's.

use super::bundle::Settling;
use crate::{evidence, shown};
use platebench_verdict::{ExpectationRecord, ScenarioRecord, TrialRecord, Verdict};
use serde_json::Value;

/// Metrics that are a time since the instant which their expectation names, with what is said where it came and where not.
const SINCE: [(&str, &str, &str); 2] =
    [("recovery_time_ms", "recovered after", "does not recover"), (SHUTDOWN, "stopped after", "does not stop")];
const SHUTDOWN: &str = "shutdown_time_ms";

/// A time that was asked for. Instants count from the start of the trial.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Timed {
    /// What came of it: `settled after 1.949 ms`.
    pub(crate) text: String,
    /// From when it counts, where that is known.
    pub(crate) from_ms: Option<f64>,
    /// When it came, if it did.
    pub(crate) instant_ms: Option<f64>,
    /// The last instant that was demanded, and the demand in words.
    pub(crate) deadline: Option<(f64, String)>,
    /// True where the drive shows it, and not the vibration.
    pub(crate) of_drive: bool,
}

/// What was asked for in `trial`: its settling, counted from `step_ms`, with the demand of that expectation; and of every other time those that did not pass,
/// or else the first.
pub(crate) fn timed(
    scenario: &ScenarioRecord,
    trial: &TrialRecord,
    settling: Settling,
    expected: Option<usize>,
    step_ms: Option<f64>,
) -> Vec<Timed> {
    let mut found = Vec::new();
    if settling != Settling::Unknown {
        let (text, instant_ms) = match settling {
            Settling::At { instant_ms, after_ms } => {
                (format!("settled after {} ms", shown::number(after_ms)), Some(instant_ms))
            }
            _ => ("does not settle".to_owned(), None),
        };
        let deadline = expected.zip(step_ms).and_then(|(index, from_ms)| deadline(scenario, index, from_ms));
        found.push(Timed { text, from_ms: step_ms, instant_ms, deadline, of_drive: false });
    }
    for (metric, came, missing) in SINCE {
        let of_metric = || (0..scenario.expectations.len()).filter(move |index| is_of(scenario, *index, metric));
        let open = of_metric()
            .filter(|index| expectation(scenario, *index).is_some_and(|found| found.verdict != Verdict::Pass));
        let mut shown: Vec<usize> = open.collect();
        if shown.is_empty() {
            shown.extend(of_metric().next());
        }
        found.extend(shown.into_iter().filter_map(|index| since(scenario, trial, index, came, missing)));
    }
    found
}

fn expectation(scenario: &ScenarioRecord, index: usize) -> Option<&ExpectationRecord> {
    scenario.expectations.get(index)
}

fn is_of(scenario: &ScenarioRecord, index: usize, metric: &str) -> bool {
    expectation(scenario, index).is_some_and(|found| found.metric == metric)
}

/// The time of expectation `index`; `None` where the trial has no such number or the record does not tell from when it counts.
fn since(scenario: &ScenarioRecord, trial: &TrialRecord, index: usize, came: &str, missing: &str) -> Option<Timed> {
    let expectation = expectation(scenario, index)?;
    let from_ms = expectation.definition.from_ms?;
    let after_ms = trial.metrics.get(&evidence::key(scenario, index)).map(Value::as_f64)?;
    let text = after_ms.map_or_else(|| missing.to_owned(), |after_ms| format!("{came} {} ms", shown::number(after_ms)));
    Some(Timed {
        text,
        from_ms: Some(from_ms),
        instant_ms: after_ms.map(|after_ms| from_ms + after_ms),
        deadline: deadline(scenario, index, from_ms),
        of_drive: expectation.metric == SHUTDOWN,
    })
}

/// The last instant that keeps to an upper limit.
fn deadline(scenario: &ScenarioRecord, index: usize, from_ms: f64) -> Option<(f64, String)> {
    let expectation = expectation(scenario, index)?;
    let limit = &expectation.limit;
    let within = || limit.get("within").and_then(Value::as_array).and_then(|ends| ends.get(1));
    let most_ms = limit.get("at_most").or_else(within).and_then(Value::as_f64)?;
    Some((from_ms + most_ms, format!("{} {} ms", evidence::key(scenario, index), shown::limit(expectation))))
}

/// The key of a deadline.
pub(crate) fn until(deadline_ms: f64, demand: &str) -> String {
    format!("{demand}: until {} ms", shown::number(deadline_ms))
}
