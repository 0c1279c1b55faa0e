//! Collects the results of the chains of `search` and `rare`.

use crate::campaign::definition::{Campaign, Method};
use crate::campaign::rare::{ChainEstimate, CombinedEstimate, RareMethod};
use crate::campaign::row::Row;
use platebench_model::record::Verdict;
use serde_json::{Value, json};
use std::fmt::Write as _;

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

    pub(crate) fn search_text(&self, worst: Option<&Row>) -> String {
        match worst {
            Some(row) => format!(
                "worst case: trial {}, margin {:.4} (negative: failed); \
                 the search needed {} trials for its first failure\n",
                row.trial,
                row.margin(),
                self.first_failure.unwrap_or_default(),
            ),
            None => format!("no failing trial found in {} trials\n", self.trials),
        }
    }

    pub(crate) fn rare_text(&self, confidence: f64) -> String {
        let Some(combined) = self.combine_chains() else {
            return "the probability of failure has no estimate, because the chains have too few trials\n".to_owned();
        };
        let [low, high] = combined.interval(confidence);
        let precision = match combined.coefficient_of_variation {
            variation if variation.is_finite() => format!("coefficient of variation {variation:.3}"),
            _ => "no trial failed".to_owned(),
        };
        let mut text = format!(
            "probability of failure {:.3e}, {low:.3e} to {high:.3e}, each end at {} % confidence; {precision}\n",
            combined.probability,
            confidence * 100.0,
        );
        for (method, chains, reason) in self.methods() {
            let method = match method {
                RareMethod::ImportanceSampling => "importance sampling around the design point",
                RareMethod::SubsetSimulation => "subset simulation",
            };
            let _ = writeln!(text, "{method} in {chains} of {} chains: {reason}", self.estimates.len());
        }
        text
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
        assert_eq!(outcome.rare_text(0.95), format!("probability of failure {expected}\n{method}\n"));
    }
}
