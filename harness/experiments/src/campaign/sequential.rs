//! Decides from the first n trials by number, before all trials are played.
//!
//! The trials that end first are a biased sample, because a trial that settles late may take
//! longer. Therefore a decision waits for all trials 0 to n − 1, for planned values of n. Each look
//! at the results spends a part of the error probability (alpha spending).

use crate::campaign::row::Row;
use crate::campaign::tally::Tally;
use platebench_model::record::Verdict;
use platebench_verdict::statistics::alpha_spending::{Look, plan_looks};

const FIRST_LOOK: u32 = 32;

/// Looks at the first 32, 64, 128 … trials.
#[derive(Debug)]
pub struct SequentialDecision {
    at_most: Option<f64>,
    confidence: f64,
    looks: std::vec::IntoIter<Look>,
    next: Option<Look>,
    tally: Tally,
    decision: Option<(u32, Verdict)>,
}

impl SequentialDecision {
    pub(crate) fn new(trials: u64, at_most: Option<f64>, confidence: f64) -> Self {
        let trials = u32::try_from(trials).unwrap_or(u32::MAX);
        let mut looks = plan_looks(FIRST_LOOK.min(trials), trials).into_iter();
        let next = looks.next();
        Self { at_most, confidence, looks, next, tally: Tally::new(0), decision: None }
    }

    /// Ignores all trials after a missing trial.
    pub(crate) fn add(&mut self, row: &Row) {
        let (Some(_), Some(look)) = (self.at_most, self.next) else { return };
        if row.trial != self.tally.trials || self.decision.is_some() {
            return;
        }
        self.tally.add(row);
        if self.tally.trials == u64::from(look.trials) {
            let verdict = self.tally.verdict(self.at_most, look.confidence(self.confidence));
            self.decision = (verdict != Verdict::Inconclusive).then_some((look.trials, verdict));
            self.next = self.looks.next();
        }
    }

    pub const fn decision(&self) -> Option<(u32, Verdict)> {
        self.decision
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(trial: u64, verdict: Verdict) -> Row {
        Row::example(trial, verdict, 1.0)
    }

    fn decide(rows: impl IntoIterator<Item = Row>) -> Option<(u32, Verdict)> {
        let mut decision = SequentialDecision::new(1_000, Some(0.1), 0.95);
        rows.into_iter().for_each(|row| decision.add(&row));
        decision.decision()
    }

    #[test]
    fn decides_at_a_planned_number_of_trials() {
        assert_eq!(decide((0..1_000).map(|trial| row(trial, Verdict::Fail))), Some((32, Verdict::Fail)));
        // If 10 % of all trials fail, 64 trials pass with the probability 0.9⁶⁴ = 0.0012.
        assert_eq!(decide((0..1_000).map(|trial| row(trial, Verdict::Pass))), Some((64, Verdict::Pass)));
        assert_eq!(decide((0..40).map(|trial| row(trial, Verdict::Pass))), None);
    }

    // Every fifth trial fails and ends late. The trials that end first all pass.
    #[test]
    fn trials_that_ended_first_decide_nothing() {
        let fails = |trial: u64| trial.is_multiple_of(5);
        let ended: Vec<u64> = (0..1_000).filter(|trial| !fails(*trial)).collect();
        let passing = |(number, _): (u64, &u64)| row(number, Verdict::Pass);
        assert_eq!(decide((0..).zip(&ended).map(passing)), Some((64, Verdict::Pass)), "the biased decision");
        assert_eq!(decide(ended.iter().map(|trial| row(*trial, Verdict::Pass))), None);
        let verdict = |trial| if fails(trial) { Verdict::Fail } else { Verdict::Pass };
        assert_eq!(
            decide((0..1_000).map(|trial| row(trial, verdict(trial)))).map(|found| found.1),
            Some(Verdict::Fail)
        );
    }

    #[test]
    fn decides_wrongly_no_more_often_than_stated() {
        use rand_chacha::ChaCha8Rng;
        use rand_chacha::rand_core::{Rng, SeedableRng};
        // The true share equals the allowed share, so every decision `pass` is wrong.
        let wrong = (0..400).filter(|seed| {
            let mut random = ChaCha8Rng::seed_from_u64(*seed);
            let mut draw = |trial| {
                let fails = f64::from(random.next_u32()) < 0.1 * f64::from(u32::MAX);
                row(trial, if fails { Verdict::Fail } else { Verdict::Pass })
            };
            decide((0..1_000).map(&mut draw)).is_some_and(|(_, verdict)| verdict == Verdict::Pass)
        });
        let wrong = wrong.count();
        assert!(wrong <= 30, "{wrong} of 400, expected 20 or fewer, with a standard deviation of 4.4");
    }
}
