//! From stored runs to a verdict for each requirement, and one for all.

use crate::plan::Requirement;
use crate::session::{EvidenceRecord, RequirementRecord, StepRecord};
use platebench_report::shown;
use platebench_verdict::{ExpectationRecord, RunRecord, Verdict};

/// What a session shows: each requirement's verdict, and the verdict over all of it. `runs` are those of the scenario steps, by their identifier.
pub(crate) fn decide(
    requirements: &[Requirement],
    steps: &[StepRecord],
    runs: &[(String, RunRecord)],
) -> (Vec<RequirementRecord>, Verdict) {
    let decided: Vec<RequirementRecord> =
        requirements.iter().map(|requirement| requirement_record(requirement, runs)).collect();
    let over_requirements = decided.iter().map(|requirement| requirement.verdict);
    // An expectation that holds no requirement may fail too.
    let over_runs = runs.iter().map(|(_, run)| run.verdict);
    // Scenario steps say what their runs say.
    let over_steps = steps.iter().map(|step| if step.done { step.verdict } else { Some(Verdict::Inconclusive) });
    let verdict = Verdict::over(over_requirements.chain(over_runs).chain(over_steps.flatten()));
    (decided, verdict)
}

fn requirement_record(requirement: &Requirement, runs: &[(String, RunRecord)]) -> RequirementRecord {
    let mut evidence = Vec::new();
    for (step, run) in runs {
        for scenario in &run.scenarios {
            let own = scenario.expectations.iter();
            let own = own.filter(|expectation| expectation.requirement.as_deref() == Some(&requirement.id));
            evidence.extend(own.map(|expectation| evidence_record(step, &scenario.file, expectation)));
        }
    }
    RequirementRecord {
        id: requirement.id.clone(),
        text: requirement.text.clone(),
        // Over nothing it is a doubt.
        verdict: Verdict::over(evidence.iter().map(|evidence| evidence.verdict)),
        evidence,
    }
}

fn evidence_record(step: &str, scenario: &str, expectation: &ExpectationRecord) -> EvidenceRecord {
    let with_unit = |text: String| format!("{text} {}", shown::unit(&expectation.metric)).trim_end().to_owned();
    let cause = expectation.cause.filter(|_| expectation.verdict == Verdict::Inconclusive);
    let reason = match (cause, &expectation.reason) {
        (Some(cause), Some(reason)) => Some(format!("{cause}: {reason}")),
        (Some(cause), None) => Some(cause.to_string()),
        (None, reason) => reason.clone(),
    };
    EvidenceRecord {
        step: step.to_owned(),
        scenario: scenario.to_owned(),
        metric: expectation.metric.clone(),
        demanded: with_unit(shown::limit(expectation)),
        found: shown::value(expectation).map(with_unit),
        verdict: expectation.verdict,
        reason,
    }
}
