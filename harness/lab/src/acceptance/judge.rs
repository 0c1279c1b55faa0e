//! Derives a verdict for each requirement and one for the session from stored runs.

use crate::acceptance::decision::PlanDecision;
use crate::acceptance::session_record::{EvidenceRecord, RequirementRecord, StepRecord};
use platebench_model::record::{ExpectationRecord, RunRecord, Verdict};
use platebench_model::scenario::Requirement;
use platebench_report::format;

/// `runs` contains the step identifier and the run of each scenario step.
pub(crate) fn judge_requirements(
    requirements: &[Requirement],
    steps: &[StepRecord],
    runs: &[(String, RunRecord)],
    decision: Option<&PlanDecision>,
) -> (Vec<RequirementRecord>, Verdict) {
    let decided: Vec<RequirementRecord> =
        requirements.iter().map(|requirement| requirement_record(requirement, runs, decision)).collect();
    let over_requirements = decided.iter().map(|requirement| requirement.verdict);
    // Runs also contain expectations that belong to no requirement.
    let over_runs = runs.iter().map(|(_, run)| run.verdict);
    let over_steps = steps.iter().map(|step| if step.done { step.verdict } else { Some(Verdict::Inconclusive) });
    let verdict = Verdict::combine(over_requirements.chain(over_runs).chain(over_steps.flatten()));
    (decided, verdict)
}

fn requirement_record(
    requirement: &Requirement,
    runs: &[(String, RunRecord)],
    decision: Option<&PlanDecision>,
) -> RequirementRecord {
    let mut evidence = Vec::new();
    for (step, run) in runs {
        for scenario in &run.scenarios {
            let own = scenario.expectations.iter().enumerate();
            let own = own.filter(|(_, expectation)| expectation.requirement.as_deref() == Some(&requirement.id));
            evidence.extend(own.map(|(number, expectation)| {
                let mut record = evidence_record(step, &scenario.file, expectation);
                if let Some(decision) = decision {
                    decision.apply(scenario, number, &mut record);
                }
                record
            }));
        }
    }
    RequirementRecord {
        id: requirement.id.clone(),
        text: requirement.text.clone(),
        verdict: Verdict::combine(evidence.iter().map(|evidence| evidence.verdict)),
        evidence,
    }
}

fn evidence_record(step: &str, scenario: &str, expectation: &ExpectationRecord) -> EvidenceRecord {
    let with_unit = |text: String| format!("{text} {}", format::unit(expectation.metric)).trim_end().to_owned();
    let cause = expectation.cause.filter(|_| expectation.verdict == Verdict::Inconclusive);
    let reason = match (cause, &expectation.reason) {
        (Some(cause), Some(reason)) => Some(format!("{cause}: {reason}")),
        (Some(cause), None) => Some(cause.to_string()),
        (None, reason) => reason.as_ref().map(ToString::to_string),
    };
    EvidenceRecord {
        step: step.to_owned(),
        scenario: scenario.to_owned(),
        metric: expectation.metric.to_string(),
        demanded: with_unit(format::limit(expectation)) + &demand_scope(expectation),
        found: format::value(expectation).map(with_unit),
        verdict: expectation.verdict,
        reason,
        uncertainty: None,
    }
}

/// Text of a limit's scope: its share of the trials and part of the trace. Empty if it covers all.
fn demand_scope(expectation: &ExpectationRecord) -> String {
    let share =
        expectation.evidence.quantile.map(|share| format!(" in {} % of the trials", (share * 1e6).round() / 1e4));
    let from = expectation.definition.from_ms.map(|from| format!(", from {from} ms on"));
    [share, from].into_iter().flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

    fn demanded_text(more: &[(&str, Value)]) -> String {
        let mut record = json!({
            "name": "settling_time_ms", "metric": "settling_time_ms", "verdict": "pass", "value": 2.5,
            "statistic": "worst", "limit": {"at_most": 3.0},
            "interval": null, "confidence": null, "cause": null, "reason": null, "paper": null, "requirement": "R-1",
        });
        for (key, value) in more {
            record[*key] = value.clone();
        }
        evidence_record("05-s", "s.toml", &serde_json::from_value(record).unwrap()).demanded
    }

    #[test]
    fn demand_names_share_of_trials_and_start() {
        assert_eq!(demanded_text(&[]), "≤ 3 ms");
        let share = ("evidence", json!({"quantile": 0.9}));
        assert_eq!(demanded_text(std::slice::from_ref(&share)), "≤ 3 ms in 90 % of the trials");
        assert_eq!(demanded_text(&[("from_ms", json!(100.0))]), "≤ 3 ms, from 100 ms on");
        assert_eq!(demanded_text(&[share, ("from_ms", json!(0.5))]), "≤ 3 ms in 90 % of the trials, from 0.5 ms on");
        assert_eq!(demanded_text(&[("evidence", json!({"quantile": 0.29}))]), "≤ 3 ms in 29 % of the trials");
    }
}
