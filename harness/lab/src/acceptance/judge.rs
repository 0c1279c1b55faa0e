//! Derives a verdict for each requirement and one for the session from stored runs. Applies the
//! plan's decision rule to the evidence, and checks calibrations before a session.

use crate::acceptance::session_record::{
    AcceptError, BUDGET, DecisionRecord, EvidenceRecord, EvidenceUncertainty, InstrumentRecord, RequirementRecord,
    StepRecord,
};
use jiff::Timestamp;
use jiff::civil::Date;
use jiff::tz::TimeZone;
use platebench_model::record::{ExpectationRecord, InputRecord, RunRecord, ScenarioRecord, Statistic, Verdict, sha256};
use platebench_model::scenario::{Limit, Requirement};
use platebench_report::format;
use platebench_verdict::uncertainty::{
    Budget, CombinedUncertainty, Conformity, DecisionRule, Instrument, TypeA, decide,
};

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

#[derive(Debug, Clone, PartialEq)]
pub struct PlanDecision {
    pub rule: DecisionRule,
    /// Largest allowed expanded uncertainty in percent of the tolerance. Only
    /// [`DecisionRule::SharedRisk`] uses it.
    pub largest_percent: f64,
    pub budget: Budget,
}

pub(crate) fn today() -> Date {
    Timestamp::now().to_zoned(TimeZone::UTC).date()
}

impl PlanDecision {
    /// Fails if a calibration is invalid and not waived, or if a waiver names no instrument.
    pub(crate) fn record(&self, today: Date, waived: &[String]) -> Result<DecisionRecord, AcceptError> {
        let budget = &self.budget;
        let unknown = waived.iter().find(|name| budget.instruments.iter().all(|known| known.name != **name));
        if let Some(name) = unknown {
            return Err(AcceptError::UnknownInstrument(name.clone()));
        }
        let is_waived = |instrument: &Instrument| waived.contains(&instrument.name);
        if let Some(expired) = budget.expired_on(today).find(|instrument| !is_waived(instrument)) {
            return Err(AcceptError::InvalidCalibration {
                instrument: format!("{} ({})", expired.name, expired.serial),
                calibrated: expired.calibrated.to_string(),
                due: expired.due.to_string(),
            });
        }
        let instruments = budget.instruments.iter().map(|instrument| InstrumentRecord {
            name: instrument.name.clone(),
            serial: instrument.serial.clone(),
            certificate: instrument.certificate.clone(),
            calibrated: instrument.calibrated.to_string(),
            due: instrument.due.to_string(),
            waived: !instrument.is_valid_on(today),
        });
        Ok(DecisionRecord {
            rule: self.rule,
            title: budget.title.clone(),
            coverage: budget.coverage,
            instruments: instruments.collect(),
            budget: InputRecord { file: BUDGET.to_owned(), sha256: sha256(&budget.bytes) },
        })
    }

    /// Adds the uncertainty of expectation `number` to `evidence`. If the decision rule does not
    /// allow a pass, the verdict becomes inconclusive.
    pub(crate) fn apply(&self, scenario: &ScenarioRecord, number: usize, evidence: &mut EvidenceRecord) {
        let Some((expectation, value)) = scenario.expectations.get(number).and_then(|each| Some((each, each.value?)))
        else {
            return;
        };
        let Some(budget) = self.budget.quantity(expectation.metric.name()) else { return };
        let combined = match budget.combine(value, observed_scatter(scenario, number, value), self.budget.coverage) {
            Ok(combined) => combined,
            Err(error) => {
                restrict(evidence, error.to_string());
                return;
            }
        };
        // `range(0.0)` is wrong for an `about` limit, which needs a tolerance. This does not
        // matter: the plan accepts `about` only with the rule `simple`, which ignores the range.
        let (range, tolerance) = (expectation.limit.range(0.0), tolerance_of(expectation.limit));
        let conformity = decide(self.rule, value, &combined, range, tolerance, self.largest_percent);
        match conformity {
            Conformity::Accepted => {}
            Conformity::WithinGuardBand { guard_band } => {
                restrict(evidence, format!("the value is within the guard band of {guard_band:.4} at the limit"));
            }
            Conformity::TooUncertain { share_percent, largest_percent } => {
                let message = format!(
                    "the expanded uncertainty is {share_percent:.3} % of the tolerance, more than {largest_percent} %"
                );
                restrict(evidence, message);
            }
        }
        evidence.uncertainty = Some(EvidenceUncertainty {
            value,
            interval: [value - combined.expanded, value + combined.expanded],
            outside_probability: outside_probability(&combined, value, range),
            conformity,
            combined,
        });
    }
}

fn restrict(evidence: &mut EvidenceRecord, reason: String) {
    if evidence.verdict == Verdict::Pass {
        evidence.verdict = Verdict::Inconclusive;
        evidence.reason = Some(reason);
    }
}

/// Probability that the true value is outside the limits, given only the measurement's uncertainty.
fn outside_probability(combined: &CombinedUncertainty, value: f64, (low, high): (f64, f64)) -> f64 {
    let above = if high.is_finite() { combined.probability_above(value, high) } else { 0.0 };
    let below = if low.is_finite() { 1.0 - combined.probability_above(value, low) } else { 0.0 };
    (above + below).min(1.0)
}

/// Returns the scale by which [`Limit::margin`] divides.
fn tolerance_of(limit: Limit) -> f64 {
    let scale = match limit {
        Limit::AtMost(limit) | Limit::AtLeast(limit) | Limit::About(limit) => limit.abs(),
        Limit::Within(low, high) => (high - low) / 2.0,
    };
    if scale == 0.0 { 1.0 } else { scale }
}

fn observed_scatter(scenario: &ScenarioRecord, number: usize, value: f64) -> Option<TypeA> {
    let expectation = scenario.expectations.get(number)?;
    let counted = || scenario.trials.iter().filter(|trial| trial.cause.is_none());
    if expectation.statistic == Statistic::Deviation {
        return TypeA::of_stated_deviation(value, counted().count());
    }
    let name = scenario.metric_key(number);
    let values: Vec<f64> = counted().filter_map(|trial| trial.metrics.number(&name)).collect();
    match expectation.statistic {
        Statistic::Mean => TypeA::of_mean(&values),
        Statistic::Worst | Statistic::Quantile | Statistic::Deviation => TypeA::of_single(&values),
    }
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
