//! Expectation to verdict.

use crate::feasibility;
use crate::metrics::{self, Measure};
use crate::record::{Cause, ExpectationRecord, TrialRecord, Verdict};
use crate::statistics::Summary;
use platebench_plate::Time;
use platebench_scenario::{Expectation, Limit, Metric, Scenario};
use platebench_trace::{Flags, Row};
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;

/// How far, in percent of the setpoint, the bench itself may be off: its bound on the plate's propagation error, doubled.
const BENCH_ERROR_PERCENT: f64 = 2e-4;

/// Everything about a trial that verdicts are made from.
#[derive(Debug, Clone, PartialEq)]
pub struct TrialMeasures {
    /// Counted from 0.
    pub index: u32,
    /// What its plate and noise were drawn from.
    pub seed: u64,
    /// One measure per expectation of the scenario.
    pub measures: Vec<Measure>,
    /// Per expectation, why no controller could have met it.
    pub excuses: Vec<Option<String>>,
    /// Whose doing it is that the trial does not count, and what happened.
    pub cause: Option<(Cause, String)>,
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
pub fn measure(scenario: &Scenario, index: u32, rows: &[Row], loop_delay: Time) -> TrialMeasures {
    let variation = scenario.variation(index);
    let plant = variation.plant(scenario);
    let expectations = &scenario.expectations;
    TrialMeasures {
        index,
        seed: variation.seed,
        measures: expectations.iter().map(|expectation| metrics::measure(expectation, rows, loop_delay)).collect(),
        excuses: expectations
            .iter()
            .map(|expectation| feasibility::excuse(scenario, expectation, &plant, rows))
            .collect(),
        cause: disturbance(scenario, rows),
    }
}

/// What happened on the way that is not the controller's doing.
fn disturbance(scenario: &Scenario, rows: &[Row]) -> Option<(Cause, String)> {
    let first = |flag| rows.iter().find(|row| row.flags.contains(flag)).map(|row| row.t_s * 1e3);
    if let Some(t_ms) = first(Flags::LINK_LOST) {
        return Some((Cause::Rig, format!("no answer at {t_ms} ms")));
    }
    if let Some(t_ms) = first(Flags::OVERRUN) {
        return Some((Cause::Bench, format!("the bench was too late at {t_ms} ms")));
    }
    let end = rows.last().map_or(0.0, |row| row.t_s);
    (end < scenario.duration.seconds())
        .then(|| (Cause::Bench, format!("the trace ends at {} ms instead of {}", end * 1e3, scenario.duration)))
}

/// Judges a scenario by its trials.
pub fn judge(scenario: &Scenario, trials: &[TrialMeasures]) -> Judgement {
    let expectations: Vec<_> = (0..)
        .zip(&scenario.expectations)
        .map(|(number, expectation)| Case { scenario, expectation, number, trials }.judge())
        .collect();
    Judgement { verdict: Verdict::over(expectations.iter().map(|expectation| expectation.verdict)), expectations }
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
    TrialRecord { index: trial.index, seed: trial.seed, trace, metrics: by_name, cause, reason, wall_ms }
}

fn shown(metric: Metric, measure: &Measure) -> Option<f64> {
    measure.value().map(|value| if metric == Metric::StaticError { value.abs() } else { value })
}

/// One expectation over all trials.
struct Case<'a> {
    scenario: &'a Scenario,
    expectation: &'a Expectation,
    number: usize,
    trials: &'a [TrialMeasures],
}

/// What decided, before it is written down.
struct Finding {
    verdict: Verdict,
    cause: Option<Cause>,
    reason: Option<String>,
    value: Option<f64>,
    statistic: &'static str,
    interval: Option<[f64; 2]>,
    confidence: Option<f64>,
}

impl Case<'_> {
    fn judge(&self) -> ExpectationRecord {
        let finding = self.doubt_disturbed(match self.expectation.metric {
            Metric::Repeatability => self.deviation(),
            Metric::StaticError => self.mean(),
            _ => self.each(),
        });
        ExpectationRecord {
            metric: self.expectation.metric.to_string(),
            verdict: finding.verdict,
            value: finding.value,
            statistic: finding.statistic.to_owned(),
            limit: limit_record(self.expectation.limit),
            interval: finding.interval,
            confidence: finding.confidence,
            cause: finding.cause,
            reason: finding.reason,
            paper: self.expectation.paper,
            requirement: self.expectation.requirement.clone(),
        }
    }

    /// The trials that count, with this expectation's measure.
    fn counted(&self) -> impl Iterator<Item = (&TrialMeasures, &Measure)> {
        let counted = self.trials.iter().filter(|trial| trial.cause.is_none());
        counted.filter_map(|trial| Some((trial, trial.measures.get(self.number)?)))
    }

    fn values(&self) -> Vec<f64> {
        self.counted().filter_map(|(_, measure)| measure.value()).collect()
    }

    /// A pass with trials that do not count is not demonstrated; a failure stands.
    fn doubt_disturbed(&self, finding: Finding) -> Finding {
        let Some((trial, (cause, what))) =
            self.trials.iter().find_map(|trial| trial.cause.as_ref().map(|cause| (trial, cause)))
        else {
            return finding;
        };
        if finding.verdict == Verdict::Fail {
            return finding;
        }
        let reason = Some(format!("trial {}: {what}", trial.index));
        Finding { verdict: Verdict::Inconclusive, cause: Some(*cause), reason, ..finding }
    }

    /// A trial that could not give the number at all.
    fn without_number(&self, statistic: &'static str) -> Option<Finding> {
        let (trial, measure) = self.counted().find(|(_, measure)| measure.value().is_none())?;
        let (verdict, cause, what) = match measure {
            Measure::Undefined(what) => (Verdict::Inconclusive, Some(Cause::Evidence), what),
            Measure::Missing(what) => (Verdict::Fail, None, what),
            Measure::Value(_) => return None,
        };
        let reason = format!("trial {}: {what}", trial.index);
        let finding =
            Finding { verdict, cause, reason: Some(reason), value: None, statistic, interval: None, confidence: None };
        Some(self.excuse_failure(finding, trial))
    }

    /// A failure for which no controller is to blame.
    fn excuse_failure(&self, finding: Finding, trial: &TrialMeasures) -> Finding {
        match trial.excuses.get(self.number) {
            Some(Some(excuse)) if finding.verdict == Verdict::Fail => Finding {
                verdict: Verdict::Inconclusive,
                cause: Some(Cause::Infeasible),
                reason: Some(format!("saturated: {excuse}")),
                ..finding
            },
            _ => finding,
        }
    }

    fn no_evidence(&self, statistic: &'static str, value: Option<f64>) -> Finding {
        let reason = format!("{} trials that count, expected at least 2", self.counted().count());
        Finding {
            verdict: Verdict::Inconclusive,
            cause: Some(Cause::Evidence),
            reason: Some(reason),
            value,
            statistic,
            interval: None,
            confidence: None,
        }
    }

    /// Each trial must meet the limit.
    fn each(&self) -> Finding {
        const STATISTIC: &str = "worst";
        let values = self.values();
        let interval = values.iter().copied().reduce(f64::min).zip(values.iter().copied().reduce(f64::max));
        let interval = interval.map(|(low, high)| [low, high]);
        if let Some(finding) = self.without_number(STATISTIC) {
            return Finding { interval, ..finding };
        }
        let limit = self.expectation.limit;
        let worst = self
            .counted()
            .filter_map(|(trial, measure)| Some((trial, measure.value()?)))
            .max_by(|a, b| badness(limit, a.1).total_cmp(&badness(limit, b.1)));
        let Some((trial, value)) = worst else { return self.no_evidence(STATISTIC, None) };
        let holds = limit.holds(value);
        let finding = Finding {
            verdict: if holds { Verdict::Pass } else { Verdict::Fail },
            cause: None,
            reason: (!holds).then(|| format!("trial {}: {value:.4}, expected {limit}", trial.index)),
            value: Some(value),
            statistic: STATISTIC,
            interval,
            confidence: None,
        };
        self.excuse_failure(finding, trial)
    }

    /// The size of the mean over trials, by two one-sided tests.
    fn mean(&self) -> Finding {
        const STATISTIC: &str = "mean";
        if let Some(finding) = self.without_number(STATISTIC) {
            return finding;
        }
        let values = self.values();
        let confidence = self.expectation.confidence;
        let Some(summary) = Summary::of(&values) else { return self.no_evidence(STATISTIC, None) };
        let bounds = if self.scenario.is_deterministic() {
            // Every trial is the same one: nothing is left to chance.
            [summary.mean, summary.mean]
        } else {
            match summary.mean_bounds(confidence) {
                Some(bounds) => bounds,
                None => return self.no_evidence(STATISTIC, Some(summary.mean.abs())),
            }
        };
        let [low, high] = [bounds[0] - BENCH_ERROR_PERCENT, bounds[1] + BENCH_ERROR_PERCENT];
        let size = if low > 0.0 {
            [low, high]
        } else if high < 0.0 {
            [-high, -low]
        } else {
            [0.0, high.max(-low)]
        };
        self.demonstrated(STATISTIC, summary.mean.abs(), size, confidence)
    }

    /// The standard deviation over trials, by chi-square.
    fn deviation(&self) -> Finding {
        const STATISTIC: &str = "deviation";
        if let Some(finding) = self.without_number(STATISTIC) {
            return finding;
        }
        let confidence = self.expectation.confidence;
        let summary = Summary::of(&self.values());
        // Agreement with a value is a two-sided question.
        let per_side = match self.expectation.limit {
            Limit::About { .. } => f64::midpoint(1.0, confidence),
            _ => confidence,
        };
        let bounds = summary.and_then(|summary| Some((summary, summary.deviation_bounds(per_side)?)));
        let Some((summary, bounds)) = bounds else { return self.no_evidence(STATISTIC, None) };
        let Limit::About { value, .. } = self.expectation.limit else {
            return self.demonstrated(STATISTIC, summary.deviation, bounds, confidence);
        };
        let agrees = (bounds[0]..=bounds[1]).contains(&value);
        Finding {
            verdict: if agrees { Verdict::Pass } else { Verdict::Fail },
            cause: None,
            reason: (!agrees).then(|| {
                format!(
                    "{:.4}, between {:.4} and {:.4}: does not agree with {value}",
                    summary.deviation, bounds[0], bounds[1]
                )
            }),
            value: Some(summary.deviation),
            statistic: STATISTIC,
            interval: Some(bounds),
            confidence: Some(confidence),
        }
    }

    /// Pass where the whole interval keeps to the limit, fail where none of it does.
    fn demonstrated(&self, statistic: &'static str, value: f64, interval: [f64; 2], confidence: f64) -> Finding {
        let limit = self.expectation.limit;
        let (lowest, highest) = limit.range();
        let [low, high] = interval;
        let between = format!("between {low:.4} and {high:.4}");
        let (verdict, cause, reason) = if lowest <= low && high <= highest {
            (Verdict::Pass, None, None)
        } else if high < lowest || highest < low {
            (Verdict::Fail, None, Some(format!("{value:.4}, {between}, expected {limit}")))
        } else {
            let count = self.counted().count();
            let reason = format!("{count} trials leave it {between}, which does not decide {limit}");
            (Verdict::Inconclusive, Some(Cause::Evidence), Some(reason))
        };
        let finding = Finding {
            verdict,
            cause,
            reason,
            value: Some(value),
            statistic,
            interval: Some(interval),
            confidence: Some(confidence),
        };
        // A mean that fails is excused where some trial could not have been better.
        match self.trials.iter().find(|trial| matches!(trial.excuses.get(self.number), Some(Some(_)))) {
            Some(trial) => self.excuse_failure(finding, trial),
            None => finding,
        }
    }
}

/// How far beyond the limit a value lies; negative where it is good.
fn badness(limit: Limit, value: f64) -> f64 {
    let (low, high) = limit.range();
    (low - value).max(value - high)
}

fn limit_record(limit: Limit) -> Map<String, Value> {
    let (name, value) = match limit {
        Limit::AtMost(value) => ("at_most", json!(value)),
        Limit::AtLeast(value) => ("at_least", json!(value)),
        Limit::Within(low, high) => ("within", json!([low, high])),
        Limit::About { value, .. } => ("about", json!(value)),
    };
    Map::from_iter([(name.to_owned(), value)])
}

#[cfg(test)]
mod tests;
