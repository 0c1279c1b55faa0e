//! One expectation over the trials of a look.

use super::TrialMeasures;
use super::finding::{Finding, Held, badness, between, held, limit_record, percent};
use crate::metrics::Measure;
use crate::record::{Cause, Definition, Evidence, ExpectationRecord, Verdict};
use crate::statistics::equivalence::widened;
use crate::statistics::proportion::clopper_pearson;
use crate::statistics::quantile::{fewest_for_bound, quantile_bounds};
use crate::statistics::spending::Look;
use crate::statistics::summary::agreement_power;
use crate::statistics::{Method, Summary, deviation_bounds, mean_bounds};
use platebench_scenario::{Expectation, Limit, Metric, Over, Scenario};

/// How far, in percent of the setpoint, the bench itself may be off: its bound on the plate's propagation error, doubled.
const BENCH_ERROR_PERCENT: f64 = 2e-4;
/// A deviation agrees with a value where its interval also tells the value from one so many times smaller or larger.
const DISTINCT: f64 = 2.0;

/// Of a real plate nobody sees more than this.
const SENSED: &str = "by the controller's own sensor, at its control instants";

/// One expectation over the trials of a look.
pub(super) struct Case<'a> {
    pub(super) scenario: &'a Scenario,
    pub(super) expectation: &'a Expectation,
    pub(super) number: usize,
    pub(super) trials: &'a [TrialMeasures],
    pub(super) look: Look,
}

/// What the trials come to, with bounds.
struct Estimate {
    value: f64,
    bounds: [f64; 2],
    evidence: Evidence,
}

impl Case<'_> {
    pub(super) fn judge(&self) -> ExpectationRecord {
        let mut finding = self.doubt_disturbed(match self.expectation.over {
            Over::Deviation => self.over_trials("deviation", |spans| self.deviation(spans)),
            Over::Mean => self.over_trials("mean", |spans| self.mean(spans)),
            Over::Quantile(share) => self.over_trials("quantile", |spans| self.quantile(spans, share)),
            Over::Each => self.each(),
        });
        if self.trials.iter().any(|trial| trial.sensed) {
            finding.evidence.observed = Some(SENSED.to_owned());
        }
        if self.look.of > 1 {
            finding.evidence.look = Some([self.look.number, self.look.of]);
        }
        ExpectationRecord {
            metric: self.expectation.metric.to_string(),
            verdict: finding.verdict,
            value: finding.value.filter(|value| value.is_finite()),
            statistic: finding.statistic.to_owned(),
            limit: limit_record(self.expectation.limit),
            // JSON has no infinity.
            interval: finding.interval.filter(|ends| ends.iter().all(|end| end.is_finite())),
            confidence: finding.confidence,
            cause: finding.cause,
            reason: finding.reason,
            paper: self.expectation.paper,
            requirement: self.expectation.requirement.clone(),
            definition: Definition::of(self.expectation),
            evidence: finding.evidence,
        }
    }

    /// Confidence of each bound at this look.
    fn confidence(&self) -> f64 {
        self.look.confidence(self.expectation.confidence)
    }

    /// The trials that count, with this expectation's measure.
    fn counted(&self) -> impl Iterator<Item = (&TrialMeasures, &Measure)> {
        let counted = self.trials.iter().filter(|trial| trial.cause.is_none());
        counted.filter_map(|trial| Some((trial, trial.measures.get(self.number)?)))
    }

    /// Between what the number lies that a trial gave: the size of an error, which the bench itself may be off by a little, or what samples leave.
    ///
    /// For a quantile a trial without the number is the worst of all.
    fn span(&self, measure: &Measure) -> Option<[f64; 2]> {
        match measure {
            Measure::Value(value) if self.expectation.metric == Metric::StaticError => Some([value.abs(); 2]),
            Measure::Value(value) => Some([*value; 2]),
            Measure::Between(ends) => Some(*ends),
            Measure::Missing(_) if matches!(self.expectation.over, Over::Quantile(_)) => Some(
                [if matches!(self.expectation.limit, Limit::AtLeast(_)) { f64::NEG_INFINITY } else { f64::INFINITY };
                    2],
            ),
            Measure::Missing(_) | Measure::Undefined(_) => None,
        }
    }

    /// The bench's own error in units of the metric, where it could decide.
    fn margin(&self) -> f64 {
        if self.expectation.metric == Metric::StaticError { BENCH_ERROR_PERCENT } else { 0.0 }
    }

    /// A pass with trials that do not count, or that were never played, is not demonstrated; a failure stands.
    fn doubt_disturbed(&self, finding: Finding) -> Finding {
        let (played, planned) = (self.trials.len(), self.look.trials as usize);
        let finding = if finding.verdict == Verdict::Pass && played < planned {
            finding.doubt(Cause::Evidence, format!("{played} of {planned} trials were played"))
        } else {
            finding
        };
        let disturbed = self.trials.iter().find_map(|trial| trial.cause.as_ref().map(|cause| (trial, cause)));
        match disturbed {
            Some((trial, (cause, what))) if finding.verdict != Verdict::Fail => {
                finding.doubt(*cause, format!("trial {}: {what}", trial.index))
            }
            _ => finding,
        }
    }

    /// What one trial shows by itself.
    fn of_trial(&self, statistic: &'static str, trial: &TrialMeasures, measure: &Measure) -> Finding {
        let limit = self.expectation.limit;
        let finding = Finding { value: self.value(measure), ..Finding::pass(statistic) };
        let span = self.span(measure).map(|span| if self.margin() > 0.0 { widened(span, self.margin()) } else { span });
        let says = |what: String| match &trial.telemetry.ended {
            Some(ended) => format!("trial {}: {what}: {ended}", trial.index),
            None => format!("trial {}: {what}", trial.index),
        };
        let failed = |what: String| match &trial.diverged {
            Some(diverged) => says(format!("{diverged}: {what}")),
            None => says(what),
        };
        let finding = match (measure, span) {
            (Measure::Undefined(what), _) => finding.doubt(Cause::Evidence, says((*what).to_owned())),
            (Measure::Missing(what), _) => finding.fail(failed((*what).to_owned())),
            (Measure::Value(_) | Measure::Between(_), None) => finding,
            (Measure::Value(_) | Measure::Between(_), Some(span)) => match held(limit, span) {
                Held::Whole => finding,
                Held::None if matches!(measure, Measure::Between(_)) => {
                    finding.fail(failed(format!("{}, expected {limit}", between(span))))
                }
                Held::None => {
                    let value = finding.value.unwrap_or_default();
                    finding.fail(failed(format!("{value:.4}, expected {limit}")))
                }
                Held::Part => {
                    let why = if matches!(measure, Measure::Between(_)) {
                        "the samples leave it"
                    } else {
                        "the bench's own error leaves it"
                    };
                    finding
                        .doubt(Cause::Evidence, says(format!("{why} {}, which does not decide {limit}", between(span))))
                }
            },
        };
        self.excuse_failure(finding, trial)
    }

    fn value(&self, measure: &Measure) -> Option<f64> {
        measure.value().and_then(|_| self.span(measure)).map(|[_, high]| high)
    }

    /// A trial that could not give the number at all: a failure before a doubt.
    fn without_number(&self, statistic: &'static str) -> Option<Finding> {
        let without = self.counted().filter(|(_, measure)| self.span(measure).is_none());
        without
            .map(|(trial, measure)| self.of_trial(statistic, trial, measure))
            .reduce(|worst, other| if other.gravity() > worst.gravity() { other } else { worst })
    }

    /// A failure for which no controller is to blame.
    fn excuse_failure(&self, finding: Finding, trial: &TrialMeasures) -> Finding {
        match trial.excuses.get(self.number) {
            Some(Some(excuse)) if finding.verdict == Verdict::Fail => {
                finding.doubt(excuse.cause, excuse.reason.clone())
            }
            _ => finding,
        }
    }

    /// A failure over trials is excused where those trials that no controller could have played better make it: the others alone do not fail.
    fn over_trials(&self, statistic: &'static str, decide: impl Fn(&[[f64; 2]]) -> Finding) -> Finding {
        if let Some(finding) = self.without_number(statistic) {
            return finding;
        }
        let spans = |kept: &dyn Fn(&TrialMeasures) -> bool| -> Vec<[f64; 2]> {
            self.counted().filter(|(trial, _)| kept(trial)).filter_map(|(_, measure)| self.span(measure)).collect()
        };
        let finding = self.name_divergence(decide(&spans(&|_| true)));
        let is_excused = |trial: &TrialMeasures| matches!(trial.excuses.get(self.number), Some(Some(_)));
        let Some((excused, _)) = self.counted().find(|(trial, _)| is_excused(trial)) else { return finding };
        if decide(&spans(&|trial| !is_excused(trial))).verdict == Verdict::Fail {
            finding
        } else {
            self.excuse_failure(finding, excused)
        }
    }

    /// Says of a failure over trials that there were some that diverged.
    fn name_divergence(&self, finding: Finding) -> Finding {
        let mut diverged = self.counted().filter_map(|(trial, _)| Some((trial.index, trial.diverged.as_ref()?)));
        match (finding.verdict, diverged.next(), &finding.reason) {
            (Verdict::Fail, Some((index, first)), Some(reason)) => {
                let reason = match diverged.count() {
                    0 => format!("{reason}: trial {index} {first}"),
                    more => format!("{reason}: trial {index} {first}, and {more} more trials diverged"),
                };
                finding.fail(reason)
            }
            _ => finding,
        }
    }

    fn no_evidence(&self, statistic: &'static str, value: Option<f64>, needed: usize) -> Finding {
        let reason = match self.counted().count() {
            0 => "no trial counts".to_owned(),
            count => format!("{count} of the trials count, expected at least {needed}"),
        };
        Finding { value, ..Finding::pass(statistic) }.doubt(Cause::Evidence, reason)
    }

    /// True where nothing was left to chance, and nothing came of it.
    fn is_certain(&self, spans: &[[f64; 2]]) -> bool {
        let is_real = self.trials.iter().any(|trial| trial.sensed);
        !is_real
            && self.scenario.is_deterministic()
            && spans.windows(2).all(|pair| matches!(pair, [one, other] if one == other))
    }

    /// Each trial must meet the limit: the worst one decides.
    fn each(&self) -> Finding {
        const STATISTIC: &str = "worst";
        let limit = self.expectation.limit;
        let spans: Vec<[f64; 2]> = self.counted().filter_map(|(_, measure)| self.span(measure)).collect();
        let interval = spans.iter().copied().reduce(|[low, high], [lower, higher]| [low.min(lower), high.max(higher)]);
        let mut rated = Vec::new();
        for (trial, measure) in self.counted() {
            let finding = self.of_trial(STATISTIC, trial, measure);
            let badness = self.span(measure).map_or(f64::INFINITY, |span| badness(limit, span));
            rated.push(((finding.gravity(), badness), finding));
        }
        let (count, certain) = (rated.len() as u32, self.is_certain(&spans));
        let broken = rated.iter().filter(|((gravity, _), _)| *gravity == 2).count() as u32;
        let open = rated.iter().filter(|((gravity, _), _)| *gravity > 0).count() as u32;
        let worst = rated.into_iter().reduce(|worst, other| if other.0 > worst.0 { other } else { worst });
        let Some((_, finding)) = worst else { return self.no_evidence(STATISTIC, None, 1) };
        let finding = Finding { interval, ..finding };
        if certain { finding } else { self.with_failure_rate(finding, broken, open, count) }
    }

    /// What so many trials show of those that were not played.
    fn with_failure_rate(&self, finding: Finding, broken: u32, open: u32, count: u32) -> Finding {
        let bounds = |seen: u32| clopper_pearson(seen, count, self.confidence());
        // A trial that is open may have been broken or not.
        let (Some([low, _]), Some([_, high])) = (bounds(broken), bounds(open)) else { return finding };
        let confidence = percent(self.expectation.confidence);
        let says = match (open, count) {
            (0, 1) => format!("1 trial without a failure: fewer than {} of all fail, at {confidence}", percent(high)),
            (0, _) => {
                format!("{count} trials without a failure: fewer than {} of all fail, at {confidence}", percent(high))
            }
            _ => format!(
                "{broken} of {count} trials fail: {} to {} of all, each end at {confidence}",
                percent(low),
                percent(high)
            ),
        };
        let evidence = Evidence {
            method: Some("clopper-pearson".to_owned()),
            failure_rate: Some([low, high]),
            says: Some(says),
            ..finding.evidence
        };
        Finding { confidence: Some(self.expectation.confidence), evidence, ..finding }
    }

    /// The mean over trials of each trial's size: errors of opposite sign do not make up for each other.
    fn mean(&self, spans: &[[f64; 2]]) -> Finding {
        const STATISTIC: &str = "mean";
        let ends = |end: usize| -> Vec<f64> { spans.iter().filter_map(|span| span.get(end)).copied().collect() };
        let (lows, highs) = (ends(0), ends(1));
        let Some(summary) = Summary::of(&highs) else { return self.no_evidence(STATISTIC, None, 1) };
        let (bounds, method) = if let Some(only) = spans.first().filter(|_| self.is_certain(spans)) {
            // Every trial is the same one.
            (*only, None)
        } else {
            let bounds = mean_bounds(&lows, self.confidence()).zip(mean_bounds(&highs, self.confidence()));
            let Some((([low, _], _), ([_, high], method))) = bounds else {
                return self.no_evidence(STATISTIC, Some(summary.mean), 2);
            };
            ([low, high], Some(method))
        };
        let bounds = if self.margin() > 0.0 { widened(bounds, self.margin()) } else { bounds };
        self.demonstrated(STATISTIC, Estimate { value: summary.mean, bounds, evidence: found_by(method) })
    }

    /// A quantile of the trials, by order statistics.
    fn quantile(&self, spans: &[[f64; 2]], share: f64) -> Finding {
        const STATISTIC: &str = "quantile";
        let ends = |end: usize| -> Vec<f64> { spans.iter().filter_map(|span| span.get(end)).copied().collect() };
        let confidence = self.confidence();
        let found = quantile_bounds(&ends(0), share, confidence).zip(quantile_bounds(&ends(1), share, confidence));
        let Some(((_, [low, _]), (value, [_, high]))) = found else { return self.no_evidence(STATISTIC, None, 1) };
        let certain = spans.first().filter(|_| self.is_certain(spans));
        let bounds = certain.copied().unwrap_or([low, high]);
        let bounds = if self.margin() > 0.0 { widened(bounds, self.margin()) } else { bounds };
        let (fewest, count) = (fewest_for_bound(share, confidence), spans.len());
        let needs = (count < fewest as usize && certain.is_none())
            .then(|| format!("a bound of the {} quantile takes {fewest} trials, there are {count}", percent(share)));
        let evidence = Evidence {
            method: certain.is_none().then(|| "order statistics".to_owned()),
            quantile: Some(share),
            says: needs,
            ..Evidence::default()
        };
        self.demonstrated(STATISTIC, Estimate { value, bounds, evidence })
    }

    /// The standard deviation over trials.
    fn deviation(&self, spans: &[[f64; 2]]) -> Finding {
        const STATISTIC: &str = "deviation";
        let values: Vec<f64> = spans.iter().map(|[_, value]| *value).collect();
        // Agreement with a value is a two-sided question.
        let per_side = match self.expectation.limit {
            Limit::About { .. } => f64::midpoint(1.0, self.confidence()),
            _ => self.confidence(),
        };
        let Some((summary, (bounds, method))) = Summary::of(&values).zip(deviation_bounds(&values, per_side)) else {
            return self.no_evidence(STATISTIC, None, 2);
        };
        let value = summary.deviation;
        let finding = Finding {
            value: Some(value),
            interval: Some(bounds),
            confidence: Some(self.expectation.confidence),
            evidence: found_by(Some(method)),
            ..Finding::pass(STATISTIC)
        };
        if value == 0.0 {
            let count = summary.count;
            let reason = format!("all {count} trials came out the same: nothing varies, so nothing is repeated");
            return finding.doubt(Cause::Evidence, reason);
        }
        match self.expectation.limit {
            Limit::About { value, .. } => agreement(finding, &summary, value, method, per_side),
            _ => self.demonstrated(STATISTIC, Estimate { value, bounds, evidence: finding.evidence }),
        }
    }

    /// Pass where the whole interval keeps to the limit, fail where none of it does.
    fn demonstrated(&self, statistic: &'static str, estimate: Estimate) -> Finding {
        let (limit, Estimate { value, bounds, evidence }) = (self.expectation.limit, estimate);
        let needs = evidence.says.as_ref().map(|says| format!(": {says}")).unwrap_or_default();
        let finding = Finding {
            value: Some(value),
            interval: Some(bounds),
            confidence: Some(self.expectation.confidence),
            evidence,
            ..Finding::pass(statistic)
        };
        match held(limit, bounds) {
            Held::Whole => finding,
            Held::None => finding.fail(format!("{value:.4}, {}, expected {limit}", between(bounds))),
            Held::Part => {
                let count = self.counted().count();
                let reason =
                    format!("{count} trials leave it {}, which does not decide {limit}{needs}", between(bounds));
                finding.doubt(Cause::Evidence, reason)
            }
        }
    }
}

fn found_by(method: Option<Method>) -> Evidence {
    let says = (method == Some(Method::Bootstrap)).then(|| "the trials do not look normally distributed".to_owned());
    Evidence { method: method.map(|method| method.name().to_owned()), says, ..Evidence::default() }
}

/// Whether a deviation agrees with `expected`, and what that is worth.
fn agreement(finding: Finding, summary: &Summary, expected: f64, method: Method, per_side: f64) -> Finding {
    let [low, high] = finding.interval.unwrap_or([0.0, f64::INFINITY]);
    let noticed = |ratio| agreement_power(summary.count, per_side, ratio);
    let power = noticed(DISTINCT).zip(noticed(1.0 / DISTINCT)).map(|(double, half)| double.min(half));
    let says = power.map(|power| {
        let (if_normal, share) =
            (if method == Method::Bootstrap { ", were the trials normal" } else { "" }, percent(power));
        format!("half or double of {expected} would have been noticed in {share} of runs{if_normal}")
    });
    let evidence = Evidence { power, says, ..finding.evidence };
    let finding = Finding { evidence, ..finding };
    let found = format!("{:.4}, {}", summary.deviation, between([low, high]));
    if expected < low || high < expected {
        return finding.fail(format!("{found}: does not agree with {expected}"));
    }
    // An interval that would agree with anything agrees with nothing.
    if low < expected / DISTINCT || expected * DISTINCT < high {
        let count = summary.count;
        let reason =
            format!("{count} trials leave it {found}, which does not tell {expected} from half or double of it");
        return finding.doubt(Cause::Evidence, reason);
    }
    finding
}
