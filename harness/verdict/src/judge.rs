//! Expectation to verdict.

use crate::feasibility;
use crate::metrics::{self, Measure};
use crate::record::{Cause, ExpectationRecord, Telemetry, TrialRecord, Verdict};
use crate::statistics::Summary;
use platebench_plate::Time;
use platebench_scenario::{Expectation, Limit, Metric, Scenario};
use platebench_trace::{Flags, Row};
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;

/// How far, in percent of the setpoint, the bench itself may be off: its bound on the plate's propagation error, doubled.
const BENCH_ERROR_PERCENT: f64 = 2e-4;
/// A deviation agrees with a value where its interval also tells the value from one so many times smaller or larger.
const DISTINCT: f64 = 2.0;

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
    /// Whose doing it is that the trial does not count, and what happened.
    pub cause: Option<(Cause, String)>,
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
    TrialMeasures {
        index,
        seed: variation.seed,
        measures: expectations.iter().map(|expectation| metrics::measure(expectation, rows, telemetry)).collect(),
        excuses: expectations
            .iter()
            .map(|expectation| {
                let reason = feasibility::excuse(scenario, expectation, &plant, rows)?;
                Some(Excuse { cause: Cause::Infeasible, reason: format!("saturated: {reason}") })
            })
            .collect(),
        telemetry: telemetry.clone(),
        cause: disturbance(scenario, rows, telemetry),
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

/// How many overruns a trial may have and still count: what the scenario expects of `overruns` at most, else none.
fn overrun_budget(scenario: &Scenario) -> f64 {
    let expected = scenario.expectations.iter().filter(|expectation| expectation.metric == Metric::Overruns);
    expected.map(|expectation| expectation.limit.range().1).reduce(f64::min).unwrap_or(0.0)
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
    let reason = reason.or_else(|| trial.telemetry.ended.clone());
    TrialRecord {
        index: trial.index,
        seed: trial.seed,
        trace,
        sha256: None,
        metrics: by_name,
        telemetry: trial.telemetry.clone(),
        cause,
        reason,
        wall_ms,
    }
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
            // JSON has no infinity.
            interval: finding.interval.filter(|ends| ends.iter().all(|end| end.is_finite())),
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

    /// A pass with trials that do not count, or that were never played, is not demonstrated; a failure stands.
    fn doubt_disturbed(&self, finding: Finding) -> Finding {
        let (played, planned) = (self.trials.len(), self.scenario.trials.count as usize);
        let finding = if finding.verdict == Verdict::Pass && played < planned {
            let reason = Some(format!("{played} of {planned} trials were played"));
            Finding { verdict: Verdict::Inconclusive, cause: Some(Cause::Evidence), reason, ..finding }
        } else {
            finding
        };
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

    /// What one trial shows by itself.
    fn of_trial(&self, statistic: &'static str, trial: &TrialMeasures, measure: &Measure) -> Finding {
        let limit = self.expectation.limit;
        let (verdict, cause, what) = match measure {
            Measure::Value(value) if limit.holds(*value) => (Verdict::Pass, None, None),
            Measure::Value(value) => (Verdict::Fail, None, Some(format!("{value:.4}, expected {limit}"))),
            Measure::Missing(what) => (Verdict::Fail, None, Some((*what).to_owned())),
            Measure::Undefined(what) => (Verdict::Inconclusive, Some(Cause::Evidence), Some((*what).to_owned())),
        };
        let reason = what.map(|what| match &trial.telemetry.ended {
            Some(ended) => format!("trial {}: {what}: {ended}", trial.index),
            None => format!("trial {}: {what}", trial.index),
        });
        let finding =
            Finding { verdict, cause, reason, value: measure.value(), statistic, interval: None, confidence: None };
        self.excuse_failure(finding, trial)
    }

    /// A trial that could not give the number at all: a failure before a doubt.
    fn without_number(&self, statistic: &'static str) -> Option<Finding> {
        let without = self.counted().filter(|(_, measure)| measure.value().is_none());
        without
            .map(|(trial, measure)| self.of_trial(statistic, trial, measure))
            .reduce(|worst, other| if gravity(other.verdict) > gravity(worst.verdict) { other } else { worst })
    }

    /// A failure for which no controller is to blame.
    fn excuse_failure(&self, finding: Finding, trial: &TrialMeasures) -> Finding {
        match trial.excuses.get(self.number) {
            Some(Some(excuse)) if finding.verdict == Verdict::Fail => Finding {
                verdict: Verdict::Inconclusive,
                cause: Some(excuse.cause),
                reason: Some(excuse.reason.clone()),
                ..finding
            },
            _ => finding,
        }
    }

    /// A failure over trials is excused where those trials that no controller could have played better make it: the others alone do not fail.
    fn excuse_by_rest(&self, finding: Finding, decide: impl Fn(&[f64]) -> Finding) -> Finding {
        let is_excused = |trial: &TrialMeasures| matches!(trial.excuses.get(self.number), Some(Some(_)));
        let Some((excused, _)) = self.counted().find(|(trial, _)| is_excused(trial)) else { return finding };
        let rest = self.counted().filter(|(trial, _)| !is_excused(trial));
        let rest: Vec<f64> = rest.filter_map(|(_, measure)| measure.value()).collect();
        if decide(&rest).verdict == Verdict::Fail { finding } else { self.excuse_failure(finding, excused) }
    }

    fn no_evidence(&self, statistic: &'static str, value: Option<f64>, needed: usize) -> Finding {
        let reason = match self.counted().count() {
            0 => "no trial counts".to_owned(),
            count => format!("{count} of the trials count, expected at least {needed}"),
        };
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

    /// Each trial must meet the limit: the worst one decides.
    fn each(&self) -> Finding {
        const STATISTIC: &str = "worst";
        let values = self.values();
        let interval = values.iter().copied().reduce(f64::min).zip(values.iter().copied().reduce(f64::max));
        let limit = self.expectation.limit;
        let rated = self.counted().map(|(trial, measure)| {
            let finding = self.of_trial(STATISTIC, trial, measure);
            ((gravity(finding.verdict), measure.value().map_or(f64::INFINITY, |value| badness(limit, value))), finding)
        });
        let worst = rated.reduce(|worst, other| if other.0 > worst.0 { other } else { worst });
        let Some((_, finding)) = worst else { return self.no_evidence(STATISTIC, None, 1) };
        Finding { interval: interval.map(|(low, high)| [low, high]), ..finding }
    }

    /// The mean over trials of each trial's size, by two one-sided tests: errors of opposite sign do not make up for each other.
    fn mean(&self) -> Finding {
        self.without_number("mean")
            .unwrap_or_else(|| self.excuse_by_rest(self.mean_of(&self.values()), |rest| self.mean_of(rest)))
    }

    fn mean_of(&self, values: &[f64]) -> Finding {
        const STATISTIC: &str = "mean";
        let confidence = self.expectation.confidence;
        let sizes: Vec<f64> = values.iter().map(|value| value.abs()).collect();
        let Some(summary) = Summary::of(&sizes) else { return self.no_evidence(STATISTIC, None, 1) };
        // Where nothing is left to chance every trial is the same one.
        let bounds = if self.scenario.is_deterministic() && values.iter().all(|value| *value == values[0]) {
            [summary.mean, summary.mean]
        } else {
            match summary.mean_bounds(confidence) {
                Some(bounds) => bounds,
                None => return self.no_evidence(STATISTIC, Some(summary.mean), 2),
            }
        };
        let size = [(bounds[0] - BENCH_ERROR_PERCENT).max(0.0), bounds[1] + BENCH_ERROR_PERCENT];
        self.demonstrated(STATISTIC, summary.mean, size, confidence)
    }

    /// The standard deviation over trials, by chi-square.
    fn deviation(&self) -> Finding {
        self.without_number("deviation")
            .unwrap_or_else(|| self.excuse_by_rest(self.deviation_of(&self.values()), |rest| self.deviation_of(rest)))
    }

    fn deviation_of(&self, values: &[f64]) -> Finding {
        const STATISTIC: &str = "deviation";
        let confidence = self.expectation.confidence;
        let summary = Summary::of(values);
        // Agreement with a value is a two-sided question.
        let per_side = match self.expectation.limit {
            Limit::About { .. } => f64::midpoint(1.0, confidence),
            _ => confidence,
        };
        let bounds = summary.and_then(|summary| Some((summary, summary.deviation_bounds(per_side)?)));
        let Some((summary, bounds)) = bounds else { return self.no_evidence(STATISTIC, None, 2) };
        let finding = |verdict, cause, reason| Finding {
            verdict,
            cause,
            reason,
            value: Some(summary.deviation),
            statistic: STATISTIC,
            interval: Some(bounds),
            confidence: Some(confidence),
        };
        if summary.deviation == 0.0 {
            let reason =
                format!("all {} trials came out the same: nothing varies, so nothing is repeated", summary.count);
            return finding(Verdict::Inconclusive, Some(Cause::Evidence), Some(reason));
        }
        let Limit::About { value, .. } = self.expectation.limit else {
            return self.demonstrated(STATISTIC, summary.deviation, bounds, confidence);
        };
        let [low, high] = bounds;
        let between = format!("{:.4}, between {low:.4} and {high:.4}", summary.deviation);
        if value < low || high < value {
            return finding(Verdict::Fail, None, Some(format!("{between}: does not agree with {value}")));
        }
        // An interval that would agree with anything agrees with nothing.
        if low < value / DISTINCT || value * DISTINCT < high {
            let reason = format!(
                "{} trials leave it {between}, which does not tell {value} from half or double of it",
                summary.count
            );
            return finding(Verdict::Inconclusive, Some(Cause::Evidence), Some(reason));
        }
        finding(Verdict::Pass, None, None)
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
        Finding {
            verdict,
            cause,
            reason,
            value: Some(value),
            statistic,
            interval: Some(interval),
            confidence: Some(confidence),
        }
    }
}

/// A failure weighs more than a doubt, and a doubt more than a pass.
fn gravity(verdict: Verdict) -> u8 {
    match verdict {
        Verdict::Fail => 2,
        Verdict::Inconclusive => 1,
        Verdict::Pass => 0,
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
