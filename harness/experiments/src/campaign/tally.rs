//! Counts trials, and keeps those with the smallest margins.

use crate::campaign::row::Row;
use platebench_model::record::Verdict;
use platebench_verdict::statistics::proportion::clopper_pearson;

/// Number of trials in the table of the report and in the folder of counterexamples.
pub const MAX_WORST: usize = 20;

#[derive(Debug, Clone, PartialEq)]
pub struct Tally {
    pub trials: u64,
    pub failures: u64,
    pub inconclusive: u64,
    pub smallest_margin: f64,
    pub worst_trial: u64,
    /// Sum and number of values, per expectation.
    pub values: Vec<(f64, u64)>,
}

impl Tally {
    pub(crate) fn new(expectations: usize) -> Self {
        let values = vec![(0.0, 0); expectations];
        Self { trials: 0, failures: 0, inconclusive: 0, smallest_margin: f64::INFINITY, worst_trial: 0, values }
    }

    pub(crate) fn add(&mut self, row: &Row) {
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

    pub fn mean(&self, expectation: usize) -> Option<f64> {
        self.values.get(expectation).filter(|(_, count)| *count > 0).map(|(sum, count)| sum / *count as f64)
    }

    /// Share of failing trials, each end one-sided. The upper end also counts inconclusive trials.
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

/// Adds `row` if it is among the worst. Of rows with equal margins, the earlier one is worse.
pub(crate) fn keep_worst(worst: &mut Vec<Row>, row: &Row) {
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

    // Without failures, the bound is 1 − 0.05^(1/n): 0.010 015 for n = 298, 0.009 969 for 299.
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
        let mut worst = Vec::new();
        for trial in 0..100 {
            keep_worst(&mut worst, &Row::example(trial, Verdict::Fail, -((trial % 10) as f64)));
        }
        assert_eq!(worst.len(), MAX_WORST);
        assert_eq!((worst[0].trial, worst[9].trial, worst[10].trial), (9, 99, 8));
    }
}
