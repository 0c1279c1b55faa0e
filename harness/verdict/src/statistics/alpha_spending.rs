//! How looking several times is paid for.
//!
//! Who looks at a test after every trial and stops when he likes what he sees is wrong far more often than in one case of twenty. Here the looks are planned,
//! and the error of 1 − c that may be made is spent over them: look k may be wrong with the probability `α(t_k) − α(t_{k−1})`. Their sum, and therefore the
//! probability that any of them is wrong, is at most 1 − c, whatever is tested, however the looks depend on each other, and whatever makes somebody stop
//! (Boole's inequality). That costs some power against boundaries computed for Brownian motion, and in turn needs no large samples.

/// A planned look at the trials.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Look {
    /// Counted from 1.
    pub number: u32,
    /// How many are planned.
    pub planned_looks: u32,
    /// How many trials there are by then.
    pub trials: u32,
    /// Share of the error that this look may make.
    error_share: f64,
}

impl Look {
    /// The one look of a plan without any.
    pub const SINGLE: Self = Self { number: 1, planned_looks: 1, trials: 0, error_share: 1.0 };

    /// The confidence of a bound at this look, where all looks together have `confidence`.
    pub fn confidence(&self, confidence: f64) -> f64 {
        // A share that is lost in rounding must not leave certainty.
        if self.error_share >= 1.0 {
            confidence
        } else {
            (1.0 - (1.0 - confidence) * self.error_share).min(1.0_f64.next_down())
        }
    }
}

/// The looks at `count` trials, at twice as many, at twice as many again, and at `max_count`.
pub fn plan_looks(count: u32, max_count: u32) -> Vec<Look> {
    let last = max_count.max(count);
    let doubled = std::iter::successors(Some(count.max(1)), |trials| trials.checked_mul(2));
    let sizes: Vec<u32> = doubled.take_while(|trials| *trials < last).chain([last]).collect();
    let of = sizes.len() as u32;
    let mut before = 0.0;
    let look = |(number, trials): (u32, u32)| {
        let spent = spent_error_share(f64::from(trials) / f64::from(last.max(1)));
        let share = spent - before;
        before = spent;
        Look { number, planned_looks: of, trials, error_share: share }
    };
    (1..).zip(sizes).map(look).collect()
}

/// The share of the error that is spent when the share `t` of the trials is there: `ln(1 + (e − 1) t)`, the spending function of Pocock's type.
///
/// K. K. G. Lan and D. L. DeMets, "Discrete sequential boundaries for clinical trials", *Biometrika* 70, 1983, pp. 659-663. It spends early, so that a run
/// that is clear after `count` trials may end there; O'Brien and Fleming's would let hardly any end before the last look.
fn spent_error_share(t: f64) -> f64 {
    if t >= 1.0 { 1.0 } else { ((std::f64::consts::E - 1.0) * t).ln_1p() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_look_spends_everything() {
        let planned = plan_looks(30, 30);
        assert_eq!(planned.len(), 1);
        assert_eq!((planned[0].trials, planned[0].confidence(0.95)), (30, 0.95));
    }

    #[test]
    fn the_looks_double_and_end_at_the_last_trial() {
        let sizes = |count, max| plan_looks(count, max).iter().map(|look| look.trials).collect::<Vec<_>>();
        assert_eq!(sizes(30, 200), [30, 60, 120, 200]);
        assert_eq!(sizes(30, 60), [30, 60]);
        assert_eq!(sizes(30, 61), [30, 60, 61]);
        assert_eq!(sizes(1, 3), [1, 2, 3]);
        assert_eq!(sizes(u32::MAX, u32::MAX), [u32::MAX]);
        assert_eq!(sizes(7, 3), [7], "fewer at most than planned is refused when a scenario is read");
    }

    #[test]
    fn all_looks_together_spend_what_there_is() {
        for (count, max) in [(30, 200), (2, 1_000), (5, 5), (10, 11)] {
            let planned = plan_looks(count, max);
            let sum: f64 = planned.iter().map(|look| 1.0 - look.confidence(0.9)).sum();
            assert!((sum - 0.1).abs() < 1e-12, "{sum}");
            assert!(planned.iter().all(|look| look.error_share > 0.0));
        }
        // ln(1 + 1.71828 · 0.15) = 0.2294 of 5 %.
        assert!((plan_looks(30, 200)[0].confidence(0.95) - 0.988_53).abs() < 1e-5);
    }
}
