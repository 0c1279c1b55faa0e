//! Judges the expectations of a scenario by its trials.
//!
//! A look is an evaluation of the trials so far. A scenario with `max_count` has looks after
//! `count` trials, after twice as many and so on. The looks depend on the scenario alone, and a
//! decision depends on the trials up to its look. Therefore a stored run gets the same verdict as
//! the live run, for any order of play.

mod over_trials;

use crate::metrics::Measure;
use crate::statistics::{Look, clopper_pearson, plan_looks, widen_bounds};
use crate::trial::TrialMeasures;
use crate::uncertainty::QuantityBudget;
use over_trials::{Containment, Outcome, OverTrials, all_equal, containment, exceedance};
use platebench_model::metrics::{TrialRule, UndefinedValue};
use platebench_model::record::{
    Cause, DivergedTrials, Evidence, EvidenceMethod, ExpectationRecord, MetricDefinition, Reason, Statistic,
    StoppedTrial, TrialFinding, Verdict, WorstInstant, percent,
};
use platebench_model::scenario::{Aggregation, Expectation, Limit, Scenario};
use std::borrow::Cow;

#[derive(Debug, Clone, PartialEq)]
pub struct Judgement {
    pub verdict: Verdict,
    pub expectations: Vec<ExpectationRecord>,
}

#[derive(Debug, Clone, PartialEq)]
pub enum SequentialDecision {
    /// More trials cannot change the judgement.
    Stop(Judgement),
    Continue {
        /// Number of trials at the next look, including those already played.
        trials: u32,
    },
}

/// A look decides if every expectation passes, one fails, or one is inconclusive and more trials
/// cannot change that. The last look always decides.
pub fn judge_sequentially(scenario: &Scenario, trials: &[TrialMeasures]) -> SequentialDecision {
    match judge_at_deciding_look(scenario, &sorted_by_index(trials)) {
        Ok(judgement) => SequentialDecision::Stop(judgement),
        Err(next) => SequentialDecision::Continue { trials: next.trials },
    }
}

pub fn judge(scenario: &Scenario, trials: &[TrialMeasures]) -> Judgement {
    judge_at_time_limit(scenario, trials, None)
}

/// `time_limit_s` is the time limit that ended the trials before the next look, if one did.
pub fn judge_at_time_limit(scenario: &Scenario, trials: &[TrialMeasures], time_limit_s: Option<f64>) -> Judgement {
    let trials = sorted_by_index(trials);
    let judged = judge_at_deciding_look(scenario, &trials);
    judged.unwrap_or_else(|next| judge_at_look(scenario, &trials, next, time_limit_s))
}

fn judge_at_deciding_look(scenario: &Scenario, trials: &[TrialMeasures]) -> Result<Judgement, Look> {
    let mut planned = plan_looks(scenario.trials.count, scenario.trials.max_count).into_iter().peekable();
    loop {
        let Some(look) = planned.next() else { return Ok(judge_at_look(scenario, trials, Look::SINGLE, None)) };
        let played = trials.partition_point(|trial| trial.index < look.trials);
        if played < look.trials as usize {
            return Err(look);
        }
        let judgement = judge_at_look(scenario, trials.get(..played).unwrap_or(trials), look, None);
        if planned.peek().is_none() || is_final(&judgement) {
            return Ok(judgement);
        }
    }
}

fn is_final(judgement: &Judgement) -> bool {
    let is_decided = |expectation: &ExpectationRecord| match expectation.verdict {
        Verdict::Pass => false,
        Verdict::Fail => true,
        Verdict::Inconclusive => expectation.cause != Some(Cause::Evidence),
    };
    judgement.verdict == Verdict::Pass || judgement.expectations.iter().any(is_decided)
}

fn judge_at_look(scenario: &Scenario, trials: &[TrialMeasures], look: Look, time_limit_s: Option<f64>) -> Judgement {
    let judge = |(expectation_index, expectation)| {
        ExpectationJudge { scenario, expectation, expectation_index, trials, look, time_limit_s }.judge()
    };
    let expectations: Vec<_> = scenario.expectations.iter().enumerate().map(judge).collect();
    Judgement { verdict: Verdict::combine(expectations.iter().map(|expectation| expectation.verdict)), expectations }
}

impl Judgement {
    /// States the bench's own error of each value. It changes no verdict, so a search judges without it.
    #[must_use]
    pub fn with_bench_errors(mut self, scenario: &Scenario) -> Self {
        for (record, expectation) in self.expectations.iter_mut().zip(&scenario.expectations) {
            let value = record.value.filter(|_| record.evidence.observed.is_none());
            record.bench_error =
                value.and_then(|value| QuantityBudget::of_bench(scenario, expectation).own_standard(value));
        }
        self
    }
}

fn sorted_by_index(trials: &[TrialMeasures]) -> Cow<'_, [TrialMeasures]> {
    if trials.is_sorted_by_key(|trial| trial.index) {
        return Cow::Borrowed(trials);
    }
    let mut sorted = trials.to_vec();
    sorted.sort_by_key(|trial| trial.index);
    Cow::Owned(sorted)
}

/// Note on results of a real plate, because its true motion is not known.
const OBSERVED_BY_SENSOR: &str = "by the controller's own sensor, at its control instants";

struct ExpectationJudge<'a> {
    scenario: &'a Scenario,
    expectation: &'a Expectation,
    expectation_index: usize,
    trials: &'a [TrialMeasures],
    look: Look,
    time_limit_s: Option<f64>,
}

impl ExpectationJudge<'_> {
    fn judge(&self) -> ExpectationRecord {
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
        let worst = outcome.trial.and_then(|trial| self.worst_instant(trial));
        let value = outcome.value.filter(|value| value.is_finite());
        ExpectationRecord {
            name: self.expectation.name.clone(),
            windows_ms: windows.map(|window| [window.from.ms(), window.to.ms()]).collect(),
            worst,
            metric: self.expectation.metric,
            verdict: outcome.verdict,
            value,
            statistic: outcome.statistic,
            limit: self.expectation.limit,
            margin: value.and_then(|value| self.expectation.margin(value)).filter(|margin| margin.is_finite()),
            bench_error: None,
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

    fn worst_instant(&self, trial: u32) -> Option<WorstInstant> {
        let measures = self.trials.iter().find(|measures| measures.index == trial)?;
        measures.worst.get(self.expectation_index)?.clone()
    }

    fn counted_trials(&self) -> impl Iterator<Item = (&TrialMeasures, &Measure)> {
        let counted = self.trials.iter().filter(|trial| trial.exclusion.is_none());
        counted.filter_map(|trial| Some((trial, trial.measures.get(self.expectation_index)?)))
    }

    /// For a quantile, a missing value is the worst one.
    fn value_interval(&self, measure: &Measure) -> Option<[f64; 2]> {
        match measure {
            Measure::Value(value) => Some([self.expectation.metric.spec().judged(*value); 2]),
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
        self.expectation.metric.spec().simulation_error
    }

    /// A trial that is missing or does not count turns a pass into inconclusive.
    fn check_excluded_trials(&self, outcome: Outcome) -> Outcome {
        let (played, planned) = (self.trials.len(), self.look.trials as usize);
        let lacks_trials = outcome.verdict == Verdict::Pass || played == 0;
        let needs_trials = lacks_trials || outcome.cause == Some(Cause::Evidence);
        let outcome = match self.time_limit_s {
            Some(limit_s) if needs_trials => {
                outcome.inconclusive(Cause::Evidence, Reason::TimeLimit { limit_s, played, planned })
            }
            None if played < planned && lacks_trials => {
                outcome.inconclusive(Cause::Evidence, Reason::NotPlayed { played, planned })
            }
            _ => outcome,
        };
        let excluded = self.trials.iter().find_map(|trial| Some((trial.index, trial.exclusion.clone()?)));
        match excluded {
            Some((trial, exclusion)) if outcome.verdict != Verdict::Fail => {
                let outcome = Outcome { trial: Some(trial), ..outcome };
                outcome.inconclusive(exclusion.cause(), Reason::Excluded { trial, exclusion })
            }
            _ => outcome,
        }
    }

    fn judge_trial(&self, statistic: Statistic, trial: &TrialMeasures, measure: &Measure) -> Outcome {
        let limit = self.expectation.limit;
        let has_value = !matches!(measure, Measure::Missing(_) | Measure::Undefined(_));
        let value = self.value_interval(measure).filter(|_| has_value).map(|[_, high]| high);
        let outcome = Outcome { value, trial: Some(trial.index), ..Outcome::pass(statistic) };
        let (ended, stopped) = (&trial.ended, &trial.stopped);
        let reason = |divergence, finding| Reason::Trial {
            trial: trial.index,
            divergence,
            finding,
            ended: ended.clone(),
            stopped: stopped.clone(),
        };
        let fail = |outcome: Outcome, finding| outcome.fail(reason(trial.divergence, finding));
        let undecided = |outcome: Outcome, finding| {
            let is_stalled = matches!(finding, TrialFinding::Undefined(UndefinedValue::StalledScripts));
            let cause = if is_stalled { Cause::Bench } else { Cause::Evidence };
            outcome.inconclusive(cause, reason(None, finding))
        };
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
            stopped: self.stopped_trial(),
        };
        let judge_if = |is_kept: &dyn Fn(&TrialMeasures) -> bool| {
            let kept = self.counted_trials().filter(|(trial, _)| is_kept(trial));
            let spans: Vec<_> = kept.filter_map(|(_, measure)| self.value_interval(measure)).collect();
            over_trials.judge(&spans)
        };
        let outcome = Outcome { trial: self.farthest_trial(), ..judge_if(&|_| true) };
        let is_excused = |trial: &TrialMeasures| matches!(trial.excuses.get(self.expectation_index), Some(Some(_)));
        let Some((excused, _)) = self.counted_trials().find(|(trial, _)| is_excused(trial)) else { return outcome };
        if judge_if(&|trial| !is_excused(trial)).verdict == Verdict::Fail {
            outcome
        } else {
            self.apply_excuse(outcome, excused)
        }
    }

    /// The first trial with the largest value.
    fn farthest_trial(&self) -> Option<u32> {
        let sizes = self.counted_trials().filter_map(|(trial, measure)| {
            let [_, high] = self.value_interval(measure)?;
            Some((trial.index, high.abs()))
        });
        sizes.reduce(|farthest, other| if other.1 > farthest.1 { other } else { farthest }).map(|(index, _)| index)
    }

    fn diverged_trials(&self) -> Option<DivergedTrials> {
        let mut diverged = self.counted_trials().filter_map(|(trial, _)| Some((trial.index, trial.divergence?)));
        let (first, divergence) = diverged.next()?;
        Some(DivergedTrials { first, divergence, further: diverged.count() })
    }

    fn stopped_trial(&self) -> Option<StoppedTrial> {
        self.counted_trials()
            .find_map(|(trial, _)| Some(StoppedTrial { trial: trial.index, why: trial.stopped.clone()? }))
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
        if self.expectation.metric.spec().trials == TrialRule::FromFirst
            && count == 1
            && outcome.verdict == Verdict::Pass
        {
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

#[cfg(test)]
mod tests;
