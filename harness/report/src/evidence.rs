//! Where to look: the trial behind an expectation that did not pass, and the scenario that another is shown against.
//!
//! Neighbours: the reports. Verdicts are read here, never made.

use platebench_verdict::{Cause, RunRecord, ScenarioRecord, TrialRecord, Verdict};
use serde_json::Value;

/// The name under which a trial holds its number for expectation `index` of the scenario: the metric's, with `[n]`
/// behind it for the n-th expectation of that metric.
pub(crate) fn key(scenario: &ScenarioRecord, index: usize) -> String {
    let Some(expectation) = scenario.expectations.get(index) else { return String::new() };
    let before = scenario.expectations.iter().take(index);
    match before.filter(|earlier| earlier.metric == expectation.metric).count() {
        0 => expectation.metric.clone(),
        earlier => format!("{}[{}]", expectation.metric, earlier + 1),
    }
}

/// The trial to look at for expectation `index`: the one that decided it where one did, otherwise the first. `None`
/// where it passed or there is no trial.
pub(crate) fn trial(scenario: &ScenarioRecord, index: usize) -> Option<&TrialRecord> {
    let expectation = scenario.expectations.get(index).filter(|found| found.verdict != Verdict::Pass)?;
    let key = key(scenario, index);
    let number = |trial: &TrialRecord| trial.metrics.get(&key).and_then(Value::as_f64);
    let decided = match (expectation.cause, expectation.value) {
        (Some(cause @ (Cause::Rig | Cause::Bench)), _) => {
            scenario.trials.iter().find(|trial| trial.cause == Some(cause))
        }
        (_, None) => scenario.trials.iter().find(|trial| trial.metrics.get(&key).is_some_and(Value::is_null)),
        (_, value) if expectation.statistic == "worst" => {
            scenario.trials.iter().find(|trial| trial.cause.is_none() && number(trial) == value)
        }
        (_, Some(_)) => {
            let sized = scenario.trials.iter().filter_map(|trial| Some((trial, number(trial)?.abs())));
            sized.max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.index.cmp(&a.0.index))).map(|(trial, _)| trial)
        }
    };
    decided.or_else(|| scenario.trials.first())
}

/// Everything that did not pass, failures first: scenario, number of the expectation.
pub(crate) fn open_points(record: &RunRecord) -> Vec<(&ScenarioRecord, usize)> {
    let of = |verdict: Verdict| {
        record.scenarios.iter().flat_map(move |scenario| {
            let numbered = scenario.expectations.iter().enumerate();
            numbered.filter(move |(_, found)| found.verdict == verdict).map(move |(index, _)| (scenario, index))
        })
    };
    of(Verdict::Fail).chain(of(Verdict::Inconclusive)).collect()
}

/// Why the run as a whole did not pass, where none of its scenarios says so.
pub(crate) fn doubt(record: &RunRecord) -> Option<&'static str> {
    if !record.complete {
        Some("the run was not finished")
    } else if record.scenarios.is_empty() {
        Some("there was nothing to run")
    } else if record.verdict != Verdict::Pass && record.scenarios.iter().all(|found| found.verdict == Verdict::Pass) {
        Some("the run did not pass")
    } else {
        None
    }
}

/// Why a scenario did not pass, where none of its expectations says so.
pub(crate) fn doubt_of(scenario: &ScenarioRecord) -> Option<&'static str> {
    let carried = scenario.expectations.iter().any(|expectation| expectation.verdict != Verdict::Pass);
    if scenario.verdict == Verdict::Pass || carried {
        None
    } else if scenario.expectations.is_empty() {
        Some("nothing was judged")
    } else {
        Some("the scenario did not pass")
    }
}

/// The scenario `X-open-loop` that belongs to the scenario `X-closed-loop`.
pub(crate) fn open_loop_of(record: &RunRecord, scenario: &ScenarioRecord) -> Option<usize> {
    let bare = |file: &str| file.strip_suffix(".toml").unwrap_or(file).to_owned();
    let wanted = format!("{}-open-loop", bare(&scenario.file).strip_suffix("-closed-loop")?);
    record.scenarios.iter().position(|other| bare(&other.file) == wanted)
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_verdict::{Definition, Evidence, ExpectationRecord, Telemetry};
    use serde_json::{Map, json};

    #[test]
    fn behind_a_mean_stands_the_trial_that_is_farthest_off() {
        let expectation = ExpectationRecord {
            metric: "static_error_percent".to_owned(),
            verdict: Verdict::Fail,
            value: Some(2.0),
            statistic: "mean".to_owned(),
            limit: Map::from_iter([("at_most".to_owned(), json!(1.0))]),
            interval: None,
            confidence: None,
            cause: None,
            reason: None,
            paper: None,
            requirement: None,
            definition: Definition::default(),
            evidence: Evidence::default(),
        };
        let metrics = |value: f64| Map::from_iter([("static_error_percent".to_owned(), json!(value))]);
        let trial_of = |index, value| TrialRecord {
            index,
            seed: 1,
            trace: String::new(),
            metrics: metrics(value),
            cause: None,
            reason: None,
            sha256: None,
            telemetry: Telemetry::default(),
            diverged_at_s: None,
            wall_ms: None,
        };
        let mut scenario = ScenarioRecord {
            file: "a.toml".to_owned(),
            title: String::new(),
            source: None,
            verdict: Verdict::Fail,
            law: String::new(),
            model: String::new(),
            model_choice: None,
            inputs: Vec::new(),
            expectations: vec![expectation],
            trials: vec![trial_of(0, 1.0), trial_of(1, 3.0), trial_of(2, 3.0), trial_of(3, 2.0)],
        };
        assert_eq!(trial(&scenario, 0).unwrap().index, 1);
        scenario.expectations[0].verdict = Verdict::Pass;
        assert!(trial(&scenario, 0).is_none(), "a pass needs no look");
    }
}
