//! Counts the trials of a campaign and judges the share that fails.

use crate::campaign::{Campaign, Method, Variable};
use crate::outcome::ChainOutcome;
use crate::row::Row;
use crate::sample::Sample;
use crate::sequential::SequentialDecision;
use platebench_record::{Cause, Verdict};
use platebench_verdict::statistics::proportion::clopper_pearson;
use serde::Serialize;
use serde_json::{Map, Value, json};
use std::fmt::Write as _;

pub const SUMMARY_FILE: &str = "summary.json";
/// Trials in the report and in the folder of counterexamples.
pub const MAX_WORST: usize = 20;

/// Counts over trials.
#[derive(Debug, Clone, PartialEq)]
pub struct Tally {
    pub trials: u64,
    pub failures: u64,
    pub inconclusive: u64,
    pub smallest_margin: f64,
    /// The trial with it.
    pub worst_trial: u64,
    /// Sum and number of the values, by expectation.
    pub values: Vec<(f64, u64)>,
}

impl Tally {
    fn new(expectations: usize) -> Self {
        let values = vec![(0.0, 0); expectations];
        Self { trials: 0, failures: 0, inconclusive: 0, smallest_margin: f64::INFINITY, worst_trial: 0, values }
    }

    fn add(&mut self, row: &Row) {
        self.trials += 1;
        self.failures += u64::from(row.verdict == Verdict::Fail);
        self.inconclusive += u64::from(row.verdict == Verdict::Inconclusive);
        if row.margin() < self.smallest_margin || self.trials == 1 {
            (self.smallest_margin, self.worst_trial) = (row.margin(), row.trial);
        }
        for ((sum, count), value) in self.values.iter_mut().zip(&row.values).filter(|(_, value)| !value.is_nan()) {
            (*sum, *count) = (*sum + value, *count + 1);
        }
    }

    /// Mean of an expectation's values.
    pub fn mean(&self, expectation: usize) -> Option<f64> {
        self.values.get(expectation).filter(|(_, count)| *count > 0).map(|(sum, count)| sum / *count as f64)
    }

    /// Each end is one-sided at `confidence`. An inconclusive trial may have failed or not.
    pub fn interval(&self, confidence: f64) -> Option<[f64; 2]> {
        let count = |count: u64| u32::try_from(count).unwrap_or(u32::MAX);
        let bounds = |failures: u64| clopper_pearson(count(failures), count(self.trials), confidence);
        let ([low, _], [_, high]) = (bounds(self.failures)?, bounds(self.failures + self.inconclusive)?);
        Some([low, high])
    }

    pub fn verdict(&self, at_most: Option<f64>, confidence: f64) -> Verdict {
        let Some(interval) = self.interval(confidence) else { return Verdict::Inconclusive };
        let (fails, passes) = match at_most {
            Some(share) => (interval[0] > share, interval[1] <= share),
            None => (self.failures > 0, true),
        };
        match (fails, passes && self.inconclusive == 0) {
            (true, _) => Verdict::Fail,
            (false, true) => Verdict::Pass,
            (false, false) => Verdict::Inconclusive,
        }
    }
}

/// The result of a campaign.
#[derive(Debug)]
pub struct Summary<'a> {
    pub campaign: &'a Campaign,
    /// Shards without a part.
    pub missing: Vec<u32>,
    pub overall: Tally,
    /// One per combination of listed values.
    pub cells: Vec<Tally>,
    pub redraws: u64,
    /// Smallest margin first.
    pub worst: Vec<Row>,
    /// Failing trials, smallest margin first.
    pub failing: Vec<Row>,
    causes: [u64; 4],
    /// Of `search` and `rare`.
    pub chains: ChainOutcome,
    /// Of the other methods.
    pub sample: Sample,
    pub sequential: SequentialDecision,
}

const CAUSES: [Cause; 4] = [Cause::Rig, Cause::Bench, Cause::Infeasible, Cause::Evidence];

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
        }
    }

    pub(crate) fn add(&mut self, row: &Row) {
        self.overall.add(row);
        if self.campaign.chain_trials() > 1 {
            self.chains.add(self.campaign, row);
        } else {
            self.sample.add(self.campaign, row);
        }
        // Trials of a grid are no sample in the order of their numbers.
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

    pub fn verdict(&self) -> Verdict {
        if !self.missing.is_empty() {
            return Verdict::Inconclusive;
        }
        let Campaign { method, at_most, confidence, .. } = *self.campaign;
        let is_decided = self.overall.inconclusive == 0;
        match method {
            // A search proves failures; without any it proves no share.
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

    /// Of the share of failing trials. `None` for a search, whose trials are no sample.
    fn interval(&self) -> Option<[f64; 2]> {
        let confidence = self.campaign.confidence;
        match self.campaign.method {
            Method::Search => None,
            Method::Rare => self.chains.combined().map(|combined| combined.interval(confidence)),
            Method::Grid | Method::Random | Method::Sobol => self.overall.interval(confidence),
        }
    }

    pub fn verdict_of(&self, tally: &Tally) -> Verdict {
        tally.verdict(self.campaign.at_most, self.campaign.confidence)
    }

    /// Of an inconclusive verdict: the most frequent cause of inconclusive trials, else too few trials.
    pub fn cause(&self) -> Option<Cause> {
        if self.verdict() != Verdict::Inconclusive {
            return None;
        }
        let most =
            CAUSES.into_iter().zip(self.causes).rev().filter(|(_, count)| *count > 0).max_by_key(|entry| entry.1);
        Some(most.filter(|_| self.missing.is_empty()).map_or(Cause::Evidence, |(cause, _)| cause))
    }

    pub fn json(&self) -> Value {
        let campaign = self.campaign;
        let tally = |tally: &Tally| {
            json!({
                "trials": tally.trials, "failures": tally.failures, "inconclusive": tally.inconclusive,
                "interval": tally.interval(campaign.confidence), "verdict": self.verdict_of(tally),
            })
        };
        let cells = self.cells.iter().enumerate().map(|(number, cell)| {
            let mut entry = Map::new();
            entry.insert("values".to_owned(), self.cell_values(number));
            if let Value::Object(counts) = tally(cell) {
                entry.extend(counts);
            }
            if cell.trials > 0 {
                // JSON has no infinite number.
                let margin = Some(cell.smallest_margin).filter(|margin| margin.is_finite());
                entry.insert("smallest_margin".to_owned(), json!(margin));
                entry.insert("worst_trial".to_owned(), json!(cell.worst_trial));
            }
            Value::Object(entry)
        });
        let cells: Vec<_> = cells.collect();
        let mut overall = tally(&self.overall);
        overall["verdict"] = json!(self.verdict());
        overall["interval"] = json!(self.interval());
        let head = Head { format: 1, title: &campaign.title, method: campaign.method, verdict: self.verdict() };
        let mut summary = serde_json::to_value(head).unwrap_or_default();
        summary["cause"] = json!(self.cause());
        summary["planned_trials"] = json!(campaign.trials);
        summary["missing_shards"] = json!(self.missing);
        summary["at_most"] = json!(campaign.at_most);
        summary["confidence"] = json!(campaign.confidence);
        summary["redrawn"] = json!(self.redraws);
        summary["overall"] = overall;
        summary["cells"] = json!(cells);
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

    /// The variables with listed values, and the number of the value in a cell.
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

    /// By key, as the campaign file lists them.
    fn cell_values(&self, cell: usize) -> Value {
        let values = self.cell_choices(cell).into_iter();
        let values =
            values.map(|(variable, choice)| (variable.key.clone(), json!(variable.distribution.value(choice as f64))));
        Value::Object(values.collect())
    }

    /// A few lines for the console.
    pub fn text(&self) -> String {
        let Tally { trials, failures, inconclusive, .. } = self.overall;
        let mut text = format!("{}: {}", self.campaign.title, self.verdict());
        if let Some(cause) = self.cause() {
            let _ = write!(text, " ({cause})");
        }
        let _ =
            write!(text, "\n{trials} of {} trials: {failures} fail, {inconclusive} inconclusive", self.campaign.trials);
        let is_sample = self.campaign.chain_trials() == 1;
        if let Some([low, high]) = self.interval().filter(|_| is_sample) {
            let [low, high] = [low, high].map(|share| share * 100.0);
            let confidence = self.campaign.confidence * 100.0;
            let _ = write!(text, "; {low:.4} % to {high:.4} % of all fail, each end at {confidence} %");
        }
        if let Some(demanded) = self.campaign.at_most {
            let _ = write!(text, ", at most {} % demanded", demanded * 100.0);
        }
        text += "\n";
        match self.campaign.method {
            Method::Search => text += &self.chains.search_text(self.failing.first()),
            Method::Rare => text += &self.chains.rare_text(self.campaign.confidence),
            Method::Grid | Method::Random | Method::Sobol => {
                text += &self.sample.text(self.campaign);
                if let Some((trials, verdict)) = self.sequential.decision() {
                    let _ = writeln!(text, "the first {trials} trials alone decide: {verdict}");
                }
            }
        }
        if self.redraws > 0 {
            let _ = writeln!(text, "{} draws outside the domain of their quantity were drawn again", self.redraws);
        }
        if !self.missing.is_empty() {
            let shards: Vec<_> = self.missing.iter().map(ToString::to_string).collect();
            let _ = writeln!(text, "missing shards: {}", shards.join(", "));
        }
        text
    }
}

#[derive(Serialize)]
struct Head<'a> {
    format: u32,
    title: &'a str,
    method: Method,
    verdict: Verdict,
}

/// Of equal margins the earlier trial is worse.
fn keep_worst(worst: &mut Vec<Row>, row: &Row) {
    let place = worst.partition_point(|kept| kept.margin() <= row.margin());
    if place < MAX_WORST {
        worst.insert(place, row.clone());
        worst.truncate(MAX_WORST);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    fn tally(trials: u64, failures: u64, inconclusive: u64) -> Tally {
        Tally { trials, failures, inconclusive, ..Tally::new(0) }
    }

    // Without a failure: 1 − 0.05^(1/n) is 0.010 015 for 298 and 0.009 969 for 299 trials.
    #[rstest]
    #[case(298, 0, 0, Some(0.01), Verdict::Inconclusive)]
    #[case(299, 0, 0, Some(0.01), Verdict::Pass)]
    #[case(299, 0, 1, Some(0.01), Verdict::Inconclusive)]
    #[case(10_000, 0, 1, Some(0.01), Verdict::Inconclusive)]
    #[case(100, 50, 0, Some(0.4), Verdict::Fail)]
    #[case(100, 50, 0, Some(0.45), Verdict::Inconclusive)]
    #[case(100, 1, 0, None, Verdict::Fail)]
    #[case(100, 0, 0, None, Verdict::Pass)]
    #[case(100, 0, 1, None, Verdict::Inconclusive)]
    #[case(0, 0, 0, None, Verdict::Inconclusive)]
    fn a_verdict_follows_the_interval(
        #[case] trials: u64,
        #[case] failures: u64,
        #[case] inconclusive: u64,
        #[case] at_most: Option<f64>,
        #[case] expected: Verdict,
    ) {
        assert_eq!(tally(trials, failures, inconclusive).verdict(at_most, 0.95), expected);
    }

    #[test]
    fn the_interval_is_that_of_clopper_and_pearson() {
        let [low, high] = tally(10, 5, 0).interval(0.975).unwrap();
        assert!((low - 0.187_086).abs() < 1e-6 && (high - 0.812_914).abs() < 1e-6, "{low} {high}");
        assert_eq!(tally(10, 5, 2).interval(0.975).unwrap()[0], low);
        assert!(tally(10, 5, 2).interval(0.975).unwrap()[1] > high);
    }

    #[test]
    fn the_worst_rows_are_sorted_by_margin() {
        let row = |trial: u64, margin: f64| Row {
            trial,
            draws: Vec::new(),
            values: Vec::new(),
            margins: vec![margin],
            verdict: Verdict::Fail,
            cause: None,
            redraws: 0,
            score: margin,
        };
        let mut worst = Vec::new();
        for trial in 0..100 {
            keep_worst(&mut worst, &row(trial, -((trial % 10) as f64)));
        }
        assert_eq!(worst.len(), MAX_WORST);
        assert_eq!((worst[0].trial, worst[9].trial, worst[10].trial), (9, 99, 8));
    }
}
