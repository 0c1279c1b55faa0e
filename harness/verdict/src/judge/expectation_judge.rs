//! Judges one expectation by the trials of a look.

use super::outcome::{Containment, Outcome, containment, exceedance};
use super::over_trials::{OverTrials, all_equal};
use crate::metrics::Measure;
use crate::statistics::alpha_spending::Look;
use crate::statistics::equivalence::widen_bounds;
use crate::statistics::proportion::clopper_pearson;
use crate::trial::TrialMeasures;
use platebench_model::record::{
    Cause, DivergedTrials, Evidence, EvidenceMethod, ExpectationRecord, MetricDefinition, Reason, Statistic,
    TrialFinding, Verdict, percent,
};
use platebench_model::scenario::{Aggregation, Expectation, Limit, Metric, Scenario};

/// Error of the simulation: twice the bound of propagation, percent of the setpoint.
const SIMULATION_ERROR_PERCENT: f64 = 2e-4;

/// Note on results of a real plate, because its true motion is not known.
const OBSERVED_BY_SENSOR: &str = "by the controller's own sensor, at its control instants";

pub(super) struct ExpectationJudge<'a> {
    pub(super) scenario: &'a Scenario,
    pub(super) expectation: &'a Expectation,
    pub(super) expectation_index: usize,
    pub(super) trials: &'a [TrialMeasures],
    pub(super) look: Look,
}

impl ExpectationJudge<'_> {
    pub(super) fn judge(&self) -> ExpectationRecord {
        let mut outcome = self.check_excluded_trials(match self.expectation.aggregation {
            Aggregation::Each => self.judge_each_trial(),
            _ => self.judge_over_trials(),
        });
        let violations = |trial: &TrialMeasures| Some((trial.index, *trial.violations.first()?));
        if let Some((trial, violation)) = self.trials.iter().find_map(violations) {
            outcome = outcome.fail(Reason::Violation { trial, violation });
        }
        if self.trials.iter().any(|trial| trial.is_real_plate) {
            outcome.evidence.observed = Some(OBSERVED_BY_SENSOR.to_owned());
        }
        if self.look.planned_looks > 1 {
            outcome.evidence.look = Some([self.look.number, self.look.planned_looks]);
        }
        let windows = self.expectation.windows.iter();
        let value = outcome.value.filter(|value| value.is_finite());
        ExpectationRecord {
            name: self.expectation.name.clone(),
            windows_ms: windows.map(|window| [window.from.ms(), window.to.ms()]).collect(),
            metric: self.expectation.metric,
            verdict: outcome.verdict,
            value,
            statistic: outcome.statistic,
            limit: self.expectation.limit,
            margin: value.and_then(|value| self.expectation.margin(value)).filter(|margin| margin.is_finite()),
            interval: outcome.interval.filter(|ends| ends.iter().all(|end| end.is_finite())),
            confidence: outcome.confidence,
            cause: outcome.cause,
            reason: outcome.reason,
            paper: self.expectation.paper,
            requirement: self.expectation.requirement.clone(),
            definition: MetricDefinition::of(self.expectation),
            evidence: outcome.evidence,
        }
    }

    fn counted_trials(&self) -> impl Iterator<Item = (&TrialMeasures, &Measure)> {
        let counted = self.trials.iter().filter(|trial| trial.exclusion.is_none());
        counted.filter_map(|trial| Some((trial, trial.measures.get(self.expectation_index)?)))
    }

    /// A static error counts without its sign. For a quantile, a missing value is the worst one.
    fn value_interval(&self, measure: &Measure) -> Option<[f64; 2]> {
        match measure {
            Measure::Value(value) if self.expectation.metric == Metric::StaticError => Some([value.abs(); 2]),
            Measure::Value(value) => Some([*value; 2]),
            Measure::Interval(ends) => Some(*ends),
            Measure::Samples(samples) => Some([self.difference_from_first(samples); 2]),
            Measure::Missing(_) if matches!(self.expectation.aggregation, Aggregation::Quantile(_)) => Some(
                [if matches!(self.expectation.limit, Limit::AtLeast(_)) { f64::NEG_INFINITY } else { f64::INFINITY };
                    2],
            ),
            Measure::Missing(_) | Measure::Undefined(_) => None,
        }
    }

    /// Infinite if the first trial has another number of control instants.
    fn difference_from_first(&self, samples: &[f64]) -> f64 {
        let Some((_, Measure::Samples(first))) = self.counted_trials().next() else { return f64::INFINITY };
        if first.len() != samples.len() {
            return f64::INFINITY;
        }
        first.iter().zip(samples).map(|(one, other)| (one - other).abs()).fold(0.0, f64::max)
    }

    fn simulation_error(&self) -> f64 {
        if self.expectation.metric == Metric::StaticError { SIMULATION_ERROR_PERCENT } else { 0.0 }
    }

    /// A trial that is missing or does not count turns a pass into inconclusive.
    fn check_excluded_trials(&self, outcome: Outcome) -> Outcome {
        let (played, planned) = (self.trials.len(), self.look.trials as usize);
        let outcome = if played < planned && (outcome.verdict == Verdict::Pass || played == 0) {
            outcome.inconclusive(Cause::Evidence, Reason::NotPlayed { played, planned })
        } else {
            outcome
        };
        let excluded = self.trials.iter().find_map(|trial| Some((trial.index, trial.exclusion.clone()?)));
        match excluded {
            Some((trial, exclusion)) if outcome.verdict != Verdict::Fail => {
                outcome.inconclusive(exclusion.cause(), Reason::Excluded { trial, exclusion })
            }
            _ => outcome,
        }
    }

    fn judge_trial(&self, statistic: Statistic, trial: &TrialMeasures, measure: &Measure) -> Outcome {
        let limit = self.expectation.limit;
        let has_value = !matches!(measure, Measure::Missing(_) | Measure::Undefined(_));
        let value = self.value_interval(measure).filter(|_| has_value).map(|[_, high]| high);
        let outcome = Outcome { value, ..Outcome::pass(statistic) };
        let reason =
            |divergence, finding| Reason::Trial { trial: trial.index, divergence, finding, ended: trial.ended.clone() };
        let fail = |outcome: Outcome, finding| outcome.fail(reason(trial.divergence, finding));
        let undecided = |outcome: Outcome, finding| outcome.inconclusive(Cause::Evidence, reason(None, finding));
        let is_interval = matches!(measure, Measure::Interval(_));
        let outcome = match (measure, self.value_interval(measure)) {
            (Measure::Undefined(why), _) => undecided(outcome, TrialFinding::Undefined(*why)),
            (Measure::Missing(why), _) => fail(outcome, TrialFinding::Missing(*why)),
            (_, None) => outcome,
            (_, Some(span)) => {
                let span = widen_bounds(span, self.simulation_error());
                let bounds = span.into();
                match containment(self.expectation.range(), span) {
                    Containment::Inside => outcome,
                    Containment::Outside if is_interval => {
                        fail(outcome, TrialFinding::IntervalOutside { bounds, limit })
                    }
                    Containment::Outside => {
                        let value = value.filter(|value| value.is_finite());
                        fail(outcome, TrialFinding::Outside { value, limit })
                    }
                    Containment::Straddles if is_interval => {
                        undecided(outcome, TrialFinding::CoarseSamples { bounds, limit })
                    }
                    Containment::Straddles => undecided(outcome, TrialFinding::SimulationError { bounds, limit }),
                }
            }
        };
        self.apply_excuse(outcome, trial)
    }

    /// A failure that no controller could have avoided becomes inconclusive.
    fn apply_excuse(&self, outcome: Outcome, trial: &TrialMeasures) -> Outcome {
        match trial.excuses.get(self.expectation_index) {
            Some(Some(excuse)) if outcome.verdict == Verdict::Fail => {
                outcome.inconclusive(excuse.cause(), Reason::Excused(excuse.clone()))
            }
            _ => outcome,
        }
    }

    fn worst_without_value(&self, statistic: Statistic) -> Option<Outcome> {
        let without = self.counted_trials().filter(|(_, measure)| self.value_interval(measure).is_none());
        without
            .map(|(trial, measure)| self.judge_trial(statistic, trial, measure))
            .reduce(|worst, other| if other.severity() > worst.severity() { other } else { worst })
    }

    /// A failure is excused if the trials without an excuse would not fail.
    fn judge_over_trials(&self) -> Outcome {
        let statistic = match self.expectation.aggregation {
            Aggregation::StandardDeviation => Statistic::Deviation,
            Aggregation::Mean => Statistic::Mean,
            Aggregation::Quantile(_) => Statistic::Quantile,
            Aggregation::Each => Statistic::Worst,
        };
        if let Some(outcome) = self.worst_without_value(statistic) {
            return outcome;
        }
        let over_trials = OverTrials {
            expectation: self.expectation,
            statistic,
            counted: self.counted_trials().count(),
            confidence: self.look.confidence(self.expectation.confidence),
            simulation_error: self.simulation_error(),
            is_deterministic: self.can_be_deterministic(),
            diverged: self.diverged_trials(),
        };
        let judge_if = |is_kept: &dyn Fn(&TrialMeasures) -> bool| {
            let kept = self.counted_trials().filter(|(trial, _)| is_kept(trial));
            let spans: Vec<_> = kept.filter_map(|(_, measure)| self.value_interval(measure)).collect();
            over_trials.judge(&spans)
        };
        let outcome = judge_if(&|_| true);
        let is_excused = |trial: &TrialMeasures| matches!(trial.excuses.get(self.expectation_index), Some(Some(_)));
        let Some((excused, _)) = self.counted_trials().find(|(trial, _)| is_excused(trial)) else { return outcome };
        if judge_if(&|trial| !is_excused(trial)).verdict == Verdict::Fail {
            outcome
        } else {
            self.apply_excuse(outcome, excused)
        }
    }

    fn diverged_trials(&self) -> Option<DivergedTrials> {
        let mut diverged = self.counted_trials().filter_map(|(trial, _)| Some((trial.index, trial.divergence?)));
        let (first, divergence) = diverged.next()?;
        Some(DivergedTrials { first, divergence, further: diverged.count() })
    }

    fn can_be_deterministic(&self) -> bool {
        self.scenario.is_deterministic() && !self.trials.iter().any(|trial| trial.is_real_plate)
    }

    fn judge_each_trial(&self) -> Outcome {
        let spans: Vec<[f64; 2]> =
            self.counted_trials().filter_map(|(_, measure)| self.value_interval(measure)).collect();
        let interval = spans.iter().copied().reduce(|[low, high], [lower, higher]| [low.min(lower), high.max(higher)]);
        let rate = |(trial, measure): (&TrialMeasures, &Measure)| {
            let outcome = self.judge_trial(Statistic::Worst, trial, measure);
            let exceedance =
                self.value_interval(measure).map_or(f64::INFINITY, |span| exceedance(self.expectation.range(), span));
            ((outcome.severity(), exceedance), outcome)
        };
        let rated: Vec<_> = self.counted_trials().map(rate).collect();
        let count_from = |least: u8| rated.iter().filter(|((severity, _), _)| *severity >= least).count() as u32;
        let (failed, not_passed, count) = (count_from(2), count_from(1), rated.len() as u32);
        let worst = rated.into_iter().reduce(|worst, other| if other.0 > worst.0 { other } else { worst });
        let too_few = |needed| Reason::TooFewTrials { counted: count as usize, needed };
        let Some((_, outcome)) = worst else {
            return Outcome::pass(Statistic::Worst).inconclusive(Cause::Evidence, too_few(1));
        };
        if self.expectation.metric == Metric::TrialDifference && count == 1 && outcome.verdict == Verdict::Pass {
            return outcome.inconclusive(Cause::Evidence, too_few(2));
        }
        let outcome = Outcome { interval, ..outcome };
        if self.can_be_deterministic() && all_equal(&spans) {
            outcome
        } else {
            self.add_failure_rate(outcome, failed, not_passed, count)
        }
    }

    fn add_failure_rate(&self, outcome: Outcome, failed: u32, not_passed: u32, count: u32) -> Outcome {
        let look_confidence = self.look.confidence(self.expectation.confidence);
        let bounds = |seen: u32| clopper_pearson(seen, count, look_confidence);
        // An inconclusive trial passes in the lower bound and fails in the upper bound.
        let (Some([low, _]), Some([_, high])) = (bounds(failed), bounds(not_passed)) else { return outcome };
        let confidence = percent(self.expectation.confidence);
        let trials = if count == 1 { "1 trial".to_owned() } else { format!("{count} trials") };
        let says = if not_passed == 0 {
            format!(
                "{trials} without a failure: fewer than {} of all trials fail, with {confidence} confidence",
                percent(high)
            )
        } else {
            let (low, high) = (percent(low), percent(high));
            format!("{failed} of {count} trials fail: {low} to {high} of all, each bound with {confidence} confidence")
        };
        let evidence = Evidence {
            method: Some(EvidenceMethod::ClopperPearson),
            failure_rate: Some([low, high]),
            says: Some(says),
            ..outcome.evidence
        };
        Outcome { confidence: Some(self.expectation.confidence), evidence, ..outcome }
    }
}
