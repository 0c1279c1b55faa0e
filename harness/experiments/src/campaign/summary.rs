//! Counts the trials of a campaign and judges the share that fails.

use crate::campaign::confirm::Agreement;
use crate::campaign::definition::{Campaign, Method};
use crate::campaign::passing_region::PassingRegion;
use crate::campaign::plan::part_name;
use crate::campaign::rare::{ChainEstimate, CombinedEstimate, RareMethod};
use crate::campaign::row::{CAUSES, EarlyDecision, ShardEnd, Tally, TrialRow, keep_worst, margin_text};
use crate::campaign::sample::{SampleResult, TrialSample};
use crate::campaign::truncation::Truncation;
use platebench_model::quoted;
use platebench_model::record::{Cause, Verdict};
use schemars::JsonSchema;
use serde::Serialize;
use serde_json::Value;
use std::fmt::Write as _;

pub const SUMMARY_FILE: &str = "summary.json";
/// Folder of failing trials, in the campaign folder.
pub(crate) const COUNTEREXAMPLES: &str = "counterexamples";

/// Content of `summary.json`.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct CampaignResult<'a> {
    pub format: u32,
    pub title: &'a str,
    pub method: Method,
    /// `None` without a plan.
    #[serde(flatten)]
    pub tested: Option<TestedController<'a>>,
    /// `None` for a complete map, which is not judged.
    pub verdict: Option<Verdict>,
    pub cause: Option<Cause>,
    /// False for a map.
    pub judged: bool,
    pub planned_trials: u64,
    pub missing_shards: &'a [u32],
    pub at_most: Option<f64>,
    pub confidence: f64,
    pub redrawn: u64,
    #[serde(skip_serializing_if = "<[_]>::is_empty")]
    pub truncated: &'a [Truncation],
    pub overall: TallyResult,
    pub cells: Vec<TallyResult>,
    /// Only with a listed number of two or more values.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub passing_region: Option<PassingRegion>,
    /// Only if 0 V was not confirmed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub safe_confirmed: Option<bool>,
    /// Only if a controller was lost.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub controller_lost: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub confirm: Option<&'a Agreement>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub search: Option<SearchResult>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rare: Option<RareResult<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sample: Option<SampleResult>,
    /// The inner value is `None` if no look at the first trials gives a verdict.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sequential: Option<Option<SequentialResult>>,
}

/// The controller of all shards.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, JsonSchema)]
pub struct TestedController<'a> {
    pub rig: &'a str,
    /// SHA-256 of the firmware image, or of the controller's identity and program.
    pub firmware_sha256: &'a str,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct TallyResult {
    /// Listed values of a cell.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub values: Option<Value>,
    pub trials: u64,
    pub failures: u64,
    pub inconclusive: u64,
    /// Trials that were not played, because the controller does not announce their law or a loop
    /// delay. They are not in `trials`. Only if there are some.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub not_applicable: Option<u64>,
    pub interval: Option<[f64; 2]>,
    /// `None` for a cell that is not applicable, and for a complete map.
    pub verdict: Option<Verdict>,
    #[serde(flatten)]
    pub worst: Option<WorstTrial>,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub struct WorstTrial {
    /// `None` if a trial has no finite margin.
    pub smallest_margin: Option<f64>,
    pub worst_trial: u64,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct SearchResult {
    pub counterexample: Option<String>,
    pub margin: Option<f64>,
    pub trials: u64,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct RareResult<'a> {
    pub probability: Option<f64>,
    pub interval: Option<[f64; 2]>,
    pub coefficient_of_variation: Option<f64>,
    pub effective_sample_size: Option<f64>,
    pub trials: u64,
    pub reliability_index: Option<f64>,
    pub methods: Vec<MethodUse<'a>>,
    pub chains_without_estimate: u64,
}

/// A method, the number of its chains, and why the first of them used it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, JsonSchema)]
pub struct MethodUse<'a> {
    pub method: RareMethod,
    pub chains: u64,
    pub reason: &'a str,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, JsonSchema)]
pub struct SequentialResult {
    pub trials: u32,
    pub verdict: Verdict,
}

#[derive(Debug)]
pub struct Summary<'a> {
    pub campaign: &'a Campaign,
    pub tested: Option<TestedController<'a>>,
    pub missing: Vec<u32>,
    pub overall: Tally,
    /// One tally per cell (combination of listed values).
    pub cells: Vec<Tally>,
    pub redraws: u64,
    /// Trials with the smallest margins, smallest first.
    pub worst: Vec<TrialRow>,
    pub failing: Vec<TrialRow>,
    causes: [u64; 4],
    /// Results of the chains of `search` and `rare`. Empty for other methods.
    pub chains: ChainOutcome,
    /// Sample of `grid`, `random` and `sobol`. Empty for other methods.
    pub sample: TrialSample,
    pub sequential: EarlyDecision,
    pub agreement: Option<Agreement>,
    pub end: ShardEnd,
}

impl<'a> Summary<'a> {
    pub(crate) fn new(campaign: &'a Campaign) -> Self {
        let expectations = campaign.template.scenario.expectations.len();
        let cells = (0..campaign.cells).map(|_| Tally::new(expectations)).collect();
        Self {
            campaign,
            tested: None,
            missing: Vec::new(),
            overall: Tally::new(expectations),
            cells,
            redraws: 0,
            worst: Vec::new(),
            failing: Vec::new(),
            causes: [0; 4],
            chains: ChainOutcome::default(),
            sample: TrialSample::default(),
            sequential: EarlyDecision::new(campaign.trials, campaign.at_most, campaign.confidence),
            agreement: None,
            end: ShardEnd::default(),
        }
    }

    pub(crate) fn add(&mut self, row: &TrialRow) {
        self.overall.add(row);
        if self.campaign.chain_trials() > 1 {
            self.chains.add(self.campaign, row);
        }
        if let Some(cell) = self.cells.get_mut(self.campaign.cell(&row.draws)) {
            cell.add(row);
        }
        if !row.is_applicable {
            return;
        }
        if self.campaign.chain_trials() == 1 {
            self.sample.add(self.campaign, row);
        }
        // With other methods, the first trials are not a random sample.
        if self.campaign.method == Method::Random {
            self.sequential.add(row);
        }
        self.redraws += u64::from(row.redraws);
        if let Some(position) = CAUSES.iter().position(|cause| Some(*cause) == row.cause)
            && let Some(count) = self.causes.get_mut(position)
        {
            *count += 1;
        }
        keep_worst(&mut self.worst, row);
        if row.verdict == Verdict::Fail {
            keep_worst(&mut self.failing, row);
        }
    }

    /// A drive after confirmed 0 V is a failure. A pass also needs confirmed 0 V. `None` for a map
    /// that is complete: all shards are there, and the rig or the bench spoiled no trial.
    pub fn verdict(&self) -> Option<Verdict> {
        let verdict = if self.campaign.is_map { self.map_verdict() } else { Some(self.confirmed_verdict()) };
        match verdict {
            _ if self.end.driven => Some(Verdict::Fail),
            Some(Verdict::Pass) if self.end.unconfirmed => Some(Verdict::Inconclusive),
            None if self.end.is_lost(self.overall.failures > 0) => Some(Verdict::Inconclusive),
            verdict => verdict,
        }
    }

    /// True if the rig counts as lost, so that the command ends with exit code 5.
    pub fn is_rig_lost(&self) -> bool {
        let has_failure = self.verdict() == Some(Verdict::Fail);
        self.end.is_lost(has_failure || (self.campaign.is_map && self.overall.failures > 0))
    }

    fn map_verdict(&self) -> Option<Verdict> {
        let count = |wanted: Cause| {
            CAUSES.iter().zip(self.causes).find(|(cause, _)| **cause == wanted).map_or(0, |(_, count)| count)
        };
        let is_spoiled = count(Cause::Rig) + count(Cause::Bench) > 0;
        // If the hosted rig missed a failure, its cells are not those of the emulated firmware.
        let is_wrong = self.agreement.as_ref().is_some_and(|agreement| agreement.missed_failures > 0);
        let is_empty = self.overall.is_not_applicable();
        (!self.missing.is_empty() || is_spoiled || is_wrong || is_empty).then_some(Verdict::Inconclusive)
    }

    fn confirmed_verdict(&self) -> Verdict {
        let missed = self.agreement.as_ref().map_or(0, |agreement| agreement.missed_failures);
        match (self.screened_verdict(), self.campaign.at_most) {
            (verdict, _) if missed == 0 => verdict,
            (_, None) => Verdict::Fail,
            // The hosted rig missed a failure, so its pass is not reliable.
            (Verdict::Pass, Some(_)) => Verdict::Inconclusive,
            (verdict, Some(_)) => verdict,
        }
    }

    fn screened_verdict(&self) -> Verdict {
        if !self.missing.is_empty() || self.overall.is_not_applicable() {
            return Verdict::Inconclusive;
        }
        let Campaign { method, at_most, confidence, .. } = *self.campaign;
        let is_decided = self.overall.inconclusive == 0;
        match method {
            // A search without a failure does not bound the share of failing trials.
            Method::Search if self.overall.failures > 0 => Verdict::Fail,
            Method::Search if at_most.is_some() || !is_decided => Verdict::Inconclusive,
            Method::Search => Verdict::Pass,
            Method::Rare => match self.chains.rare_verdict(at_most, confidence) {
                Verdict::Pass if !is_decided => Verdict::Inconclusive,
                verdict => verdict,
            },
            Method::Grid | Method::Random | Method::Sobol => self.verdict_of(&self.overall),
        }
    }

    /// Interval of the share of failing trials. `None` for a search: it is not a random sample.
    fn interval(&self) -> Option<[f64; 2]> {
        let confidence = self.campaign.confidence;
        match self.campaign.method {
            Method::Search => None,
            Method::Rare => self.chains.combine_chains().and_then(|combined| combined.interval(confidence)),
            Method::Grid | Method::Random | Method::Sobol => self.overall.interval(confidence),
        }
    }

    pub fn verdict_of(&self, tally: &Tally) -> Verdict {
        tally.verdict(self.campaign.at_most, self.campaign.confidence)
    }

    /// Cause of an inconclusive verdict: the most frequent cause of inconclusive trials. It is
    /// [`Cause::Evidence`] if there is none or a shard is missing, and [`Cause::Rig`] if 0 V was
    /// not confirmed.
    pub fn cause(&self) -> Option<Cause> {
        if self.verdict() != Some(Verdict::Inconclusive) {
            return None;
        }
        if self.end.unconfirmed {
            return Some(Cause::Rig);
        }
        let most =
            CAUSES.into_iter().zip(self.causes).rev().filter(|(_, count)| *count > 0).max_by_key(|entry| entry.1);
        Some(most.filter(|_| self.missing.is_empty()).map_or(Cause::Evidence, |(cause, _)| cause))
    }

    pub fn result(&self) -> CampaignResult<'_> {
        let campaign = self.campaign;
        let tally = |tally: &Tally| TallyResult {
            values: None,
            trials: tally.trials,
            failures: tally.failures,
            inconclusive: tally.inconclusive,
            interval: tally.interval(campaign.confidence),
            not_applicable: (tally.not_applicable > 0).then_some(tally.not_applicable),
            verdict: (!tally.is_not_applicable()).then(|| self.verdict_of(tally)),
            worst: None,
        };
        let cells = self.cells.iter().enumerate().map(|(number, cell)| {
            let smallest_margin = Some(cell.smallest_margin).filter(|margin| margin.is_finite());
            let worst = WorstTrial { smallest_margin, worst_trial: cell.worst_trial };
            let values = Some(campaign.cell_values(number));
            TallyResult { values, worst: (cell.trials > 0).then_some(worst), ..tally(cell) }
        });
        let is_sample = campaign.chain_trials() == 1;
        let decision = || self.sequential.decision().map(|(trials, verdict)| SequentialResult { trials, verdict });
        CampaignResult {
            format: 1,
            title: &campaign.title,
            method: campaign.method,
            tested: self.tested,
            verdict: self.verdict(),
            cause: self.cause(),
            judged: !campaign.is_map,
            planned_trials: campaign.trials,
            missing_shards: &self.missing,
            at_most: campaign.at_most,
            confidence: campaign.confidence,
            redrawn: self.redraws,
            truncated: &campaign.truncated,
            overall: TallyResult { verdict: self.verdict(), interval: self.interval(), ..tally(&self.overall) },
            cells: cells.collect(),
            passing_region: PassingRegion::new(self),
            safe_confirmed: self.end.unconfirmed.then_some(false),
            controller_lost: self.end.lost.then_some(true),
            confirm: self.agreement.as_ref(),
            search: (campaign.method == Method::Search).then(|| self.chains.search_result(self.failing.first())),
            rare: (campaign.method == Method::Rare).then(|| self.chains.rare_result(campaign.confidence)),
            sample: is_sample.then(|| self.sample.result(campaign)),
            sequential: is_sample.then(decision),
        }
    }

    /// Sentences about the trials, for people.
    pub fn lines(&self) -> Vec<String> {
        let Tally { trials, failures, inconclusive, .. } = self.overall;
        let cause = self.cause().map(|cause| format!(" ({cause})")).unwrap_or_default();
        let title = &self.campaign.title;
        let mut lines = vec![match self.verdict() {
            Some(verdict) => format!("{title}: {verdict}{cause}"),
            None => format!("{title}: map, not judged: no [judge], and no expectation with a requirement"),
        }];
        let mut counts =
            format!("{trials} of {} trials: {failures} fail, {inconclusive} inconclusive", self.campaign.trials);
        // The cells of a map are chosen, not drawn.
        let is_sample = self.campaign.chain_trials() == 1 && !self.campaign.is_map;
        let confidence = self.campaign.confidence;
        if let Some([low, high]) = self.interval().filter(|_| is_sample) {
            let [low, high, confidence] = [low, high, confidence].map(|share| share * 100.0);
            let _ =
                write!(counts, "; {low:.4} % to {high:.4} % of all trials fail, each end at {confidence} % confidence");
        }
        if let Some(demanded) = self.campaign.at_most {
            let _ = write!(counts, ", at most {} % demanded", demanded * 100.0);
        }
        lines.push(counts);
        lines.extend(self.tested.map(|TestedController { rig, firmware_sha256 }| {
            format!("tested: rig {}, firmware SHA-256 {firmware_sha256:.12}", quoted(rig))
        }));
        match self.campaign.method {
            Method::Search => lines.push(self.chains.search_line(self.failing.first())),
            Method::Rare => lines.extend(self.chains.rare_lines(confidence)),
            Method::Grid | Method::Random | Method::Sobol => {
                let decision = self.sequential.decision();
                lines
                    .extend(decision.map(|(trials, verdict)| {
                        format!("the first {trials} trials alone give the verdict {verdict}")
                    }));
            }
        }
        lines.extend(self.agreement.iter().flat_map(|agreement| agreement.lines(confidence)));
        if let Some(row) = self.failing.first() {
            lines.push(format!(
                "counterexample with the smallest margin, of {failures} failing in {trials} trials: {}",
                counterexample_name(row.trial)
            ));
        }
        lines.extend(self.campaign.truncated.iter().map(Truncation::line));
        if self.overall.not_applicable > 0 {
            let (count, cells) = (self.overall.not_applicable, &self.cells);
            let cells = match cells.iter().filter(|cell| cell.is_not_applicable()).count() {
                0 => String::new(),
                skipped => format!(", with {skipped} of {} combinations of listed values", cells.len()),
            };
            lines.push(format!(
                "{count} trials not applicable{cells}: the controller does not announce their law \
                 (controller.law), or no loop delay (controller.design_delay_ms); expected a law that it announces, \
                 or \"own\""
            ));
        }
        if self.redraws > 0 {
            lines.push(format!("the scenario refused {} draws, which were repeated", self.redraws));
        }
        if self.end.driven {
            lines.push("the controller commanded a drive after it had confirmed 0 V".to_owned());
        } else if self.end.unconfirmed {
            lines.push("the controller did not confirm 0 V at the end".to_owned());
        }
        if self.end.lost {
            lines.push("the controller was lost during a trial".to_owned());
        }
        if !self.missing.is_empty() {
            let shards: Vec<_> = self.missing.iter().map(ToString::to_string).collect();
            let parts: Vec<_> = self.missing.iter().map(|shard| part_name(*shard)).collect();
            lines.push(format!("missing shards: {} ({})", shards.join(", "), parts.join(", ")));
        }
        lines
    }
}

/// Path of a counterexample, relative to the campaign folder.
fn counterexample_name(trial: u64) -> String {
    format!("{COUNTEREXAMPLES}/{trial}.toml")
}

/// The caller adds rows in the order of their trials.
#[derive(Debug, Default)]
pub struct ChainOutcome {
    /// Values and scores of the trials of the present chain.
    chain: Vec<(Vec<f64>, Vec<f64>)>,
    /// First trial of a chain with other points than those of this version's method.
    pub(crate) foreign_chain: Option<u64>,
    pub estimates: Vec<ChainEstimate>,
    pub without_estimate: u64,
    /// Number of trials of a search up to and including the first failing one.
    first_failure: Option<u64>,
    trials: u64,
}

impl ChainOutcome {
    pub(crate) fn add(&mut self, campaign: &Campaign, row: &TrialRow) {
        self.trials += 1;
        match campaign.method {
            Method::Search if self.first_failure.is_none() && row.verdict == Verdict::Fail => {
                self.first_failure = Some(self.trials);
            }
            Method::Rare => {
                self.chain.push((row.draws.clone(), row.scores()));
                let chain = campaign.chain_trials();
                if (row.trial + 1).is_multiple_of(chain) || row.trial + 1 == campaign.trials {
                    self.end_chain(campaign, row.trial / chain * chain..row.trial + 1);
                }
            }
            _ => {}
        }
    }

    /// Computes the estimate of the chain again from its scores, without playing trials.
    fn end_chain(&mut self, campaign: &Campaign, trials: std::ops::Range<u64>) {
        let mut stored = std::mem::take(&mut self.chain).into_iter();
        let mut is_foreign = false;
        let estimate = campaign.run_chain(&trials, &mut |point| {
            let (draws, scores) = stored.next()?;
            is_foreign |= draws != campaign.rare_values(point);
            (!is_foreign).then_some(scores)
        });
        if is_foreign {
            self.foreign_chain.get_or_insert(trials.start);
        }
        match estimate {
            Some(estimate) => self.estimates.push(estimate),
            None => self.without_estimate += 1,
        }
    }

    pub fn combine_chains(&self) -> Option<CombinedEstimate> {
        (!self.estimates.is_empty()).then(|| CombinedEstimate::new(&self.estimates))
    }

    /// The verdict is not `pass` if a chain has no estimate.
    pub(crate) fn rare_verdict(&self, at_most: Option<f64>, confidence: f64) -> Verdict {
        let Some(combined) = self.combine_chains() else { return Verdict::Inconclusive };
        match (at_most, combined.interval(confidence)) {
            (Some(share), Some([low, _])) if low > share => Verdict::Fail,
            (Some(share), Some([_, high])) if high <= share && self.without_estimate == 0 => Verdict::Pass,
            (None, _) if combined.probability > 0.0 => Verdict::Fail,
            _ => Verdict::Inconclusive,
        }
    }

    fn methods(&self) -> Vec<MethodUse<'_>> {
        let mut methods: Vec<MethodUse<'_>> = Vec::new();
        for ChainEstimate { method, reason, .. } in &self.estimates {
            match methods.iter_mut().find(|known| known.method == *method) {
                Some(known) => known.chains += 1,
                None => methods.push(MethodUse { method: *method, chains: 1, reason }),
            }
        }
        methods
    }

    fn search_result(&self, worst: Option<&TrialRow>) -> SearchResult {
        SearchResult {
            counterexample: worst.map(|row| counterexample_name(row.trial)),
            margin: worst.map(TrialRow::margin).filter(|margin| margin.is_finite()),
            trials: self.first_failure.unwrap_or(self.trials),
        }
    }

    fn rare_result(&self, confidence: f64) -> RareResult<'_> {
        let combined = self.combine_chains();
        let variation = combined.map(|combined| combined.coefficient_of_variation);
        RareResult {
            probability: combined.map(|combined| combined.probability),
            interval: combined.and_then(|combined| combined.interval(confidence)),
            coefficient_of_variation: variation.filter(|value| value.is_finite()),
            effective_sample_size: combined.map(|combined| combined.effective_samples),
            trials: self.trials,
            reliability_index: self.estimates.first().and_then(|estimate| estimate.reliability_index),
            methods: self.methods(),
            chains_without_estimate: self.without_estimate,
        }
    }

    fn search_line(&self, worst: Option<&TrialRow>) -> String {
        match worst {
            Some(row) => format!(
                "worst case: trial {}, margin {} (negative: failed; –: no value); \
                 the search needed {} trials for its first failure",
                row.trial,
                margin_text(row.margin()),
                self.first_failure.unwrap_or_default(),
            ),
            None => format!("no failing trial found in {} trials", self.trials),
        }
    }

    fn rare_lines(&self, confidence: f64) -> Vec<String> {
        let Some(combined) = self.combine_chains() else {
            let message = "the probability of failure has no estimate, because the chains have too few trials";
            return vec![message.to_owned()];
        };
        let size = combined.effective_samples;
        let precision = match combined.coefficient_of_variation {
            variation if variation.is_finite() => {
                format!("coefficient of variation {variation:.3}, effective sample size {size:.0}")
            }
            _ => "no trial failed".to_owned(),
        };
        let interval = match combined.interval(confidence) {
            Some([low, high]) => format!("{low:.3e} to {high:.3e}, each end at {} % confidence", confidence * 100.0),
            None => format!(
                "without an interval, because the effective sample size is below {}; play more trials",
                combined.min_effective_samples
            ),
        };
        let mut lines = vec![format!("probability of failure {:.3e}, {interval}; {precision}", combined.probability)];
        lines.extend(self.methods().into_iter().map(|MethodUse { method, chains, reason }| {
            let method = match method {
                RareMethod::ImportanceSampling => "importance sampling around the failing regions",
                RareMethod::SubsetSimulation => "subset simulation",
            };
            format!("{method} in {chains} of {} chains: {reason}", self.estimates.len())
        }));
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case::failures(
        1e-4,
        0.1,
        "1.000e-4, 7.948e-5 to 1.258e-4, each end at 95 % confidence; coefficient of variation 0.100, \
         effective sample size 100"
    )]
    #[case::few_failures(
        1e-4,
        0.6,
        "1.000e-4, without an interval, because the effective sample size is below 4; play more trials; coefficient \
         of variation 0.600, effective sample size 3"
    )]
    #[case::no_failure(
        0.0,
        f64::INFINITY,
        "0.000e0, 0.000e0 to 2.000e-3, each end at 95 % confidence; no trial failed"
    )]
    fn states_the_precision_of_the_probability(
        #[case] probability: f64,
        #[case] coefficient_of_variation: f64,
        #[case] expected: &str,
    ) {
        let estimate = ChainEstimate {
            probability,
            coefficient_of_variation,
            effective_samples: coefficient_of_variation.powi(-2),
            bias: 0.0,
            ceiling: 2e-3,
            method: RareMethod::SubsetSimulation,
            reason: "FORM did not converge".to_owned(),
            reliability_index: None,
            trials: 1000,
        };
        let outcome = ChainOutcome { estimates: vec![estimate], ..ChainOutcome::default() };
        let method = "subset simulation in 1 of 1 chains: FORM did not converge";
        assert_eq!(outcome.rare_lines(0.95), [format!("probability of failure {expected}"), method.to_owned()]);
    }
}
