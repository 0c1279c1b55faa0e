//! Counts the trials of a campaign and judges the share that fails.

use crate::campaign::confirm::Agreement;
use crate::campaign::definition::{Campaign, Method};
use crate::campaign::distribution::Variable;
use crate::campaign::rare::{ChainEstimate, CombinedEstimate, RareMethod};
use crate::campaign::row::{CAUSES, Row, SequentialDecision, ShardEnd, Tally, keep_worst};
use crate::campaign::sample::Sample;
use platebench_model::record::{Cause, Verdict};
use serde_json::{Value, json};

pub const SUMMARY_FILE: &str = "summary.json";

#[derive(Debug)]
pub struct Summary<'a> {
    pub campaign: &'a Campaign,
    pub missing: Vec<u32>,
    pub overall: Tally,
    /// One tally per cell (combination of listed values).
    pub cells: Vec<Tally>,
    pub redraws: u64,
    /// Trials with the smallest margins, smallest first.
    pub worst: Vec<Row>,
    pub failing: Vec<Row>,
    causes: [u64; 4],
    /// Results of the chains of `search` and `rare`. Empty for other methods.
    pub chains: ChainOutcome,
    /// Sample of `grid`, `random` and `sobol`. Empty for other methods.
    pub sample: Sample,
    pub sequential: SequentialDecision,
    pub agreement: Option<Agreement>,
    pub end: ShardEnd,
}

impl<'a> Summary<'a> {
    pub(crate) fn new(campaign: &'a Campaign) -> Self {
        let expectations = campaign.template.scenario.expectations.len();
        let cells = (0..campaign.cells).map(|_| Tally::new(expectations)).collect();
        Self {
            campaign,
            missing: Vec::new(),
            overall: Tally::new(expectations),
            cells,
            redraws: 0,
            worst: Vec::new(),
            failing: Vec::new(),
            causes: [0; 4],
            chains: ChainOutcome::default(),
            sample: Sample::default(),
            sequential: SequentialDecision::new(campaign.trials, campaign.at_most, campaign.confidence),
            agreement: None,
            end: ShardEnd::default(),
        }
    }

    pub(crate) fn add(&mut self, row: &Row) {
        self.overall.add(row);
        if self.campaign.chain_trials() > 1 {
            self.chains.add(self.campaign, row);
        } else {
            self.sample.add(self.campaign, row);
        }
        // With other methods, the first trials are not a random sample.
        if self.campaign.method == Method::Random {
            self.sequential.add(row);
        }
        if let Some(cell) = self.cells.get_mut(self.campaign.cell(&row.draws)) {
            cell.add(row);
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

    /// A drive after confirmed 0 V is a failure. A pass also needs confirmed 0 V.
    pub fn verdict(&self) -> Verdict {
        match self.confirmed_verdict() {
            _ if self.end.driven => Verdict::Fail,
            Verdict::Pass if self.end.unconfirmed => Verdict::Inconclusive,
            verdict => verdict,
        }
    }

    /// True if the rig counts as lost, so that the command ends with exit code 5.
    pub fn is_rig_lost(&self) -> bool {
        self.end.is_lost(self.verdict() == Verdict::Fail)
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
        if !self.missing.is_empty() {
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
            Method::Rare => self.chains.combine_chains().map(|combined| combined.interval(confidence)),
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
        if self.verdict() != Verdict::Inconclusive {
            return None;
        }
        if self.end.unconfirmed {
            return Some(Cause::Rig);
        }
        let most =
            CAUSES.into_iter().zip(self.causes).rev().filter(|(_, count)| *count > 0).max_by_key(|entry| entry.1);
        Some(most.filter(|_| self.missing.is_empty()).map_or(Cause::Evidence, |(cause, _)| cause))
    }

    pub fn json(&self) -> Value {
        let campaign = self.campaign;
        let add_counts = |mut entry: Value, tally: &Tally| {
            entry["trials"] = json!(tally.trials);
            entry["failures"] = json!(tally.failures);
            entry["inconclusive"] = json!(tally.inconclusive);
            entry["interval"] = json!(tally.interval(campaign.confidence));
            entry["verdict"] = json!(self.verdict_of(tally));
            entry
        };
        let cells = self.cells.iter().enumerate().map(|(number, cell)| {
            let mut entry = add_counts(json!({ "values": self.cell_values(number) }), cell);
            if cell.trials > 0 {
                let margin = Some(cell.smallest_margin).filter(|margin| margin.is_finite());
                entry["smallest_margin"] = json!(margin);
                entry["worst_trial"] = json!(cell.worst_trial);
            }
            entry
        });
        let cells: Vec<_> = cells.collect();
        let mut overall = add_counts(json!({}), &self.overall);
        overall["verdict"] = json!(self.verdict());
        overall["interval"] = json!(self.interval());
        let mut summary = json!({
            "format": 1,
            "title": campaign.title,
            "method": campaign.method,
            "verdict": self.verdict(),
            "cause": self.cause(),
            "planned_trials": campaign.trials,
            "missing_shards": self.missing,
            "at_most": campaign.at_most,
            "confidence": campaign.confidence,
            "redrawn": self.redraws,
            "overall": overall,
            "cells": cells,
        });
        if self.end.unconfirmed {
            summary["safe_confirmed"] = json!(false);
        }
        if self.end.lost {
            summary["controller_lost"] = json!(true);
        }
        if let Some(agreement) = &self.agreement {
            summary["confirm"] = agreement.json(campaign.confidence);
        }
        match campaign.method {
            Method::Search => summary["search"] = self.chains.search_json(self.failing.first()),
            Method::Rare => summary["rare"] = self.chains.rare_json(campaign.confidence),
            Method::Grid | Method::Random | Method::Sobol => {
                summary["sample"] = self.sample.json(campaign);
                let decision = self.sequential.decision();
                summary["sequential"] =
                    json!(decision.map(|(trials, verdict)| json!({ "trials": trials, "verdict": verdict })));
            }
        }
        summary
    }

    /// Returns each variable with listed values, and the index of its value in the cell.
    pub fn cell_choices(&self, cell: usize) -> Vec<(&Variable, usize)> {
        let mut place = cell;
        let mut choices = Vec::new();
        for variable in self.campaign.variables.iter().rev() {
            if let Some(list) = variable.distribution.choices() {
                choices.push((variable, place % list.len()));
                place /= list.len();
            }
        }
        choices.reverse();
        choices
    }

    fn cell_values(&self, cell: usize) -> Value {
        let values = self.cell_choices(cell).into_iter();
        let values =
            values.map(|(variable, choice)| (variable.key.clone(), json!(variable.distribution.value(choice as f64))));
        Value::Object(values.collect())
    }

    /// Sentences about the trials, for people.
    pub fn lines(&self) -> Vec<String> {
        let Tally { trials, failures, inconclusive, .. } = self.overall;
        let cause = self.cause().map(|cause| format!(" ({cause})")).unwrap_or_default();
        let mut lines = vec![format!("{}: {}{cause}", self.campaign.title, self.verdict())];
        let mut counts =
            format!("{trials} of {} trials: {failures} fail, {inconclusive} inconclusive", self.campaign.trials);
        let is_sample = self.campaign.chain_trials() == 1;
        let confidence = self.campaign.confidence;
        if let Some([low, high]) = self.interval().filter(|_| is_sample) {
            let [low, high, confidence] = [low, high, confidence].map(|share| share * 100.0);
            counts += &format!("; {low:.4} % to {high:.4} % of all trials fail, each end at {confidence} % confidence");
        }
        if let Some(demanded) = self.campaign.at_most {
            counts += &format!(", at most {} % demanded", demanded * 100.0);
        }
        lines.push(counts);
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
            lines.push(format!("missing shards: {}", shards.join(", ")));
        }
        lines
    }
}

/// The caller adds rows in the order of their trials.
#[derive(Debug, Default)]
pub struct ChainOutcome {
    scores: Vec<f64>,
    pub estimates: Vec<ChainEstimate>,
    pub without_estimate: u64,
    /// Number of trials of a search up to and including the first failing one.
    first_failure: Option<u64>,
    trials: u64,
}

impl ChainOutcome {
    pub(crate) fn add(&mut self, campaign: &Campaign, row: &Row) {
        self.trials += 1;
        match campaign.method {
            Method::Search if self.first_failure.is_none() && row.verdict == Verdict::Fail => {
                self.first_failure = Some(self.trials);
            }
            Method::Rare => {
                self.scores.push(row.score);
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
        let mut scores = std::mem::take(&mut self.scores).into_iter();
        match campaign.run_chain(&trials, &mut |_| scores.next()) {
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
        let [low, high] = combined.interval(confidence);
        match at_most {
            Some(share) if low > share => Verdict::Fail,
            Some(share) if high <= share && self.without_estimate == 0 => Verdict::Pass,
            None if combined.probability > 0.0 => Verdict::Fail,
            _ => Verdict::Inconclusive,
        }
    }

    /// Returns each method, the number of its chains, and why the first of them used it.
    fn methods(&self) -> Vec<(RareMethod, u64, &str)> {
        let mut methods: Vec<(RareMethod, u64, &str)> = Vec::new();
        for estimate in &self.estimates {
            match methods.iter_mut().find(|(method, ..)| *method == estimate.method) {
                Some((_, count, _)) => *count += 1,
                None => methods.push((estimate.method, 1, &estimate.reason)),
            }
        }
        methods
    }

    pub(crate) fn search_json(&self, worst: Option<&Row>) -> Value {
        json!({
            "counterexample": worst.map(|row| format!("counterexamples/{}.toml", row.trial)),
            "margin": worst.map(Row::margin).filter(|margin| margin.is_finite()),
            "trials": self.first_failure.unwrap_or(self.trials),
        })
    }

    pub(crate) fn rare_json(&self, confidence: f64) -> Value {
        let combined = self.combine_chains();
        let methods = self.methods().into_iter();
        let methods =
            methods.map(|(method, chains, reason)| json!({ "method": method, "chains": chains, "reason": reason }));
        let index = self.estimates.first().and_then(|estimate| estimate.reliability_index);
        json!({
            "probability": combined.map(|combined| combined.probability),
            "interval": combined.map(|combined| combined.interval(confidence)),
            "coefficient_of_variation":
                combined.map(|combined| combined.coefficient_of_variation).filter(|value| value.is_finite()),
            "trials": self.trials,
            "reliability_index": index,
            "methods": methods.collect::<Vec<_>>(),
            "chains_without_estimate": self.without_estimate,
        })
    }

    fn search_line(&self, worst: Option<&Row>) -> String {
        match worst {
            Some(row) => format!(
                "worst case: trial {}, margin {:.4} (negative: failed); \
                 the search needed {} trials for its first failure",
                row.trial,
                row.margin(),
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
        let [low, high] = combined.interval(confidence);
        let precision = match combined.coefficient_of_variation {
            variation if variation.is_finite() => format!("coefficient of variation {variation:.3}"),
            _ => "no trial failed".to_owned(),
        };
        let mut lines = vec![format!(
            "probability of failure {:.3e}, {low:.3e} to {high:.3e}, each end at {} % confidence; {precision}",
            combined.probability,
            confidence * 100.0,
        )];
        lines.extend(self.methods().into_iter().map(|(method, chains, reason)| {
            let method = match method {
                RareMethod::ImportanceSampling => "importance sampling around the design point",
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
        "1.000e-4, 8.487e-5 to 1.178e-4, each end at 95 % confidence; coefficient of variation 0.100"
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
