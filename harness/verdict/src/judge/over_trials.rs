//! Judges the mean, a quantile or the standard deviation over trials.

use crate::statistics::{
    SampleSummary, agreement_power, deviation_bounds, mean_bounds, min_values_for_bound, quantile_bounds, widen_bounds,
};
use platebench_model::record::{
    Cause, DivergedTrials, Evidence, EvidenceMethod, Reason, Statistic, StoppedTrial, Verdict, WideBoundsCause, percent,
};
use platebench_model::scenario::{Aggregation, Expectation, Limit};

/// The verdict of one expectation before it is recorded.
#[derive(Debug, Clone)]
pub(super) struct Outcome {
    pub(super) verdict: Verdict,
    pub(super) cause: Option<Cause>,
    pub(super) reason: Option<Reason>,
    pub(super) value: Option<f64>,
    pub(super) statistic: Statistic,
    pub(super) interval: Option<[f64; 2]>,
    pub(super) confidence: Option<f64>,
    pub(super) evidence: Evidence,
    /// Index of the trial that decided.
    pub(super) trial: Option<u32>,
}

impl Outcome {
    pub(super) fn pass(statistic: Statistic) -> Self {
        Self {
            verdict: Verdict::Pass,
            cause: None,
            reason: None,
            value: None,
            statistic,
            interval: None,
            confidence: None,
            evidence: Evidence::default(),
            trial: None,
        }
    }

    pub(super) fn fail(self, reason: Reason) -> Self {
        Self { verdict: Verdict::Fail, cause: None, reason: Some(reason), ..self }
    }

    pub(super) fn inconclusive(self, cause: Cause, reason: Reason) -> Self {
        Self { verdict: Verdict::Inconclusive, cause: Some(cause), reason: Some(reason), ..self }
    }

    pub(super) fn severity(&self) -> u8 {
        match self.verdict {
            Verdict::Fail => 2,
            Verdict::Inconclusive => 1,
            Verdict::Pass => 0,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Containment {
    Inside,
    Outside,
    Straddles,
}

pub(super) fn containment((lowest, highest): (f64, f64), [low, high]: [f64; 2]) -> Containment {
    if lowest <= low && high <= highest {
        Containment::Inside
    } else if high < lowest || highest < low {
        Containment::Outside
    } else {
        Containment::Straddles
    }
}

/// Distance of the worst value from the permitted range; negative if all values are inside.
pub(super) fn exceedance((lowest, highest): (f64, f64), [low, high]: [f64; 2]) -> f64 {
    (lowest - low).max(high - highest)
}

/// The interval of a deviation must exclude this multiple and this fraction of the expected value.
const DISTINGUISHABLE_RATIO: f64 = 2.0;

pub(super) struct OverTrials<'a> {
    pub(super) expectation: &'a Expectation,
    pub(super) statistic: Statistic,
    pub(super) counted: usize,
    pub(super) confidence: f64,
    /// Error of the simulation, in units of the metric.
    pub(super) simulation_error: f64,
    pub(super) is_deterministic: bool,
    pub(super) diverged: Option<DivergedTrials>,
    pub(super) stopped: Option<StoppedTrial>,
}

struct Estimate {
    value: f64,
    bounds: [f64; 2],
    evidence: Evidence,
    wide: Option<WideBoundsCause>,
}

pub(super) fn all_equal(spans: &[[f64; 2]]) -> bool {
    spans.windows(2).all(|pair| matches!(pair, [one, other] if one == other))
}

fn column(spans: &[[f64; 2]], end: usize) -> Vec<f64> {
    spans.iter().filter_map(|span| span.get(end)).copied().collect()
}

impl OverTrials<'_> {
    pub(super) fn judge(&self, spans: &[[f64; 2]]) -> Outcome {
        match self.expectation.aggregation {
            Aggregation::StandardDeviation => self.judge_deviation(spans),
            Aggregation::Quantile(share) => self.judge_quantile(spans, share),
            Aggregation::Mean | Aggregation::Each => self.judge_mean(spans),
        }
    }

    fn too_few_trials(&self, value: Option<f64>, needed: usize) -> Outcome {
        let reason = Reason::TooFewTrials { counted: self.counted, needed };
        Outcome { value, ..Outcome::pass(self.statistic) }.inconclusive(Cause::Evidence, reason)
    }

    /// The interval of all trials, if the scenario is deterministic and all trials agree.
    fn certain_interval(&self, spans: &[[f64; 2]]) -> Option<[f64; 2]> {
        spans.first().copied().filter(|_| self.is_deterministic && all_equal(spans))
    }

    /// Judges the mean of absolute values, so that errors of opposite sign do not cancel.
    fn judge_mean(&self, spans: &[[f64; 2]]) -> Outcome {
        let (lows, highs) = (column(spans, 0), column(spans, 1));
        let Some(summary) = SampleSummary::of(&highs) else { return self.too_few_trials(None, 1) };
        let (bounds, method) = if let Some(certain) = self.certain_interval(spans) {
            (certain, None)
        } else {
            let bounds = mean_bounds(&lows, self.confidence).zip(mean_bounds(&highs, self.confidence));
            let Some((([low, _], _), ([_, high], method))) = bounds else {
                return self.too_few_trials(Some(summary.mean), 2);
            };
            ([low, high], Some(method))
        };
        let bounds = widen_bounds(bounds, self.simulation_error);
        let (evidence, wide) = evidence_of_method(method);
        self.judge_interval(&Estimate { value: summary.mean, bounds, evidence, wide })
    }

    fn judge_quantile(&self, spans: &[[f64; 2]], share: f64) -> Outcome {
        let [lows, highs] = [0, 1].map(|end| quantile_bounds(&column(spans, end), share, self.confidence));
        let Some(((_, [low, _]), (value, [_, high]))) = lows.zip(highs) else { return self.too_few_trials(None, 1) };
        let certain = self.certain_interval(spans);
        let bounds = widen_bounds(certain.unwrap_or([low, high]), self.simulation_error);
        let (needed, trials) = (min_values_for_bound(share, self.confidence), spans.len());
        let wide = (trials < needed as usize && certain.is_none()).then_some(WideBoundsCause::TooFewForQuantile {
            share,
            needed,
            trials,
        });
        let evidence = Evidence {
            method: certain.is_none().then_some(EvidenceMethod::OrderStatistics),
            quantile: Some(share),
            says: wide.map(|wide| wide.to_string()),
            ..Evidence::default()
        };
        self.judge_interval(&Estimate { value, bounds, evidence, wide })
    }

    fn judge_deviation(&self, spans: &[[f64; 2]]) -> Outcome {
        let values = column(spans, 1);
        // Agreement has a limit on both sides, so each side gets half of the error probability.
        let per_side = match self.expectation.limit {
            Limit::About(_) => f64::midpoint(1.0, self.confidence),
            _ => self.confidence,
        };
        let Some((summary, (bounds, method))) = SampleSummary::of(&values).zip(deviation_bounds(&values, per_side))
        else {
            return self.too_few_trials(None, 2);
        };
        let (value, trials) = (summary.deviation, summary.count);
        let (evidence, wide) = evidence_of_method(Some(method));
        let estimate = Estimate { value, bounds, evidence, wide };
        if value == 0.0 {
            return self.outcome_of(&estimate).inconclusive(Cause::Evidence, Reason::NoVariation { trials });
        }
        match self.expectation.limit {
            Limit::About(expected) => self.judge_agreement(&estimate, trials, expected, method, per_side),
            _ => self.judge_interval(&estimate),
        }
    }

    fn outcome_of(&self, estimate: &Estimate) -> Outcome {
        Outcome {
            value: Some(estimate.value),
            interval: Some(estimate.bounds),
            confidence: Some(self.expectation.confidence),
            evidence: estimate.evidence.clone(),
            ..Outcome::pass(self.statistic)
        }
    }

    fn judge_interval(&self, estimate: &Estimate) -> Outcome {
        let (limit, outcome) = (self.expectation.limit, self.outcome_of(estimate));
        let (value, bounds) = (estimate.value, estimate.bounds.into());
        match containment(self.expectation.range(), estimate.bounds) {
            Containment::Inside => outcome,
            Containment::Outside => {
                let value = value.is_finite().then_some(value);
                outcome.fail(Reason::Outside {
                    value,
                    bounds,
                    limit,
                    diverged: self.diverged,
                    stopped: self.stopped.clone(),
                })
            }
            Containment::Straddles => {
                let reason = Reason::Undecided { trials: self.counted, bounds, limit, cause: estimate.wide };
                outcome.inconclusive(Cause::Evidence, reason)
            }
        }
    }

    fn judge_agreement(
        &self,
        estimate: &Estimate,
        trials: usize,
        expected: f64,
        method: EvidenceMethod,
        per_side: f64,
    ) -> Outcome {
        let power_at = |ratio| agreement_power(trials, per_side, ratio);
        let power = power_at(DISTINGUISHABLE_RATIO)
            .zip(power_at(1.0 / DISTINGUISHABLE_RATIO))
            .map(|(double, half)| double.min(half));
        let says = power.map(|power| {
            let condition = if method == EvidenceMethod::Bootstrap { ", if the trials were normal" } else { "" };
            format!("half or double of {expected} would be detected in {} of runs{condition}", percent(power))
        });
        let outcome = self.outcome_of(estimate);
        let outcome = Outcome { evidence: Evidence { power, says, ..outcome.evidence }, ..outcome };
        let [low, high] = estimate.bounds;
        let (value, bounds) = (estimate.value, estimate.bounds.into());
        if expected < low || high < expected {
            return outcome.fail(Reason::Disagrees { value, bounds, expected, diverged: self.diverged });
        }
        if low < expected / DISTINGUISHABLE_RATIO || expected * DISTINGUISHABLE_RATIO < high {
            return outcome.inconclusive(Cause::Evidence, Reason::Indistinct { trials, value, bounds, expected });
        }
        outcome
    }
}

fn evidence_of_method(method: Option<EvidenceMethod>) -> (Evidence, Option<WideBoundsCause>) {
    let wide = (method == Some(EvidenceMethod::Bootstrap)).then_some(WideBoundsCause::NotNormal);
    (Evidence { method, says: wide.map(|wide| wide.to_string()), ..Evidence::default() }, wide)
}
