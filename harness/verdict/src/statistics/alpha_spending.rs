//! Corrects the error rate of a test that is evaluated several times.
//!
//! A test that stops at the first favourable look exceeds its error rate. Therefore look k, at the
//! share `t_k` of the trials, may be wrong with probability `α(t_k) − α(t_{k−1})`. By Boole's
//! inequality the sum is at most 1 − c (confidence c), for every test and every dependence between
//! looks. Boundaries for Brownian motion are not used, because they need large samples.

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Look {
    /// Number of the look, counted from 1.
    pub number: u32,
    pub planned_looks: u32,
    pub trials: u32,
    error_share: f64,
}

impl Look {
    pub const SINGLE: Self = Self { number: 1, planned_looks: 1, trials: 0, error_share: 1.0 };

    /// Confidence of a bound at this look, if all looks together have `confidence`.
    pub fn confidence(&self, confidence: f64) -> f64 {
        if self.error_share >= 1.0 {
            confidence
        } else {
            (1.0 - (1.0 - confidence) * self.error_share).min(1.0_f64.next_down())
        }
    }
}

/// Looks after `count` trials, after 2, 4, 8 … times as many, and after `max_count`.
pub fn plan_looks(count: u32, max_count: u32) -> Vec<Look> {
    let last = max_count.max(count);
    let doubled = std::iter::successors(Some(count.max(1)), |trials| trials.checked_mul(2));
    let sizes: Vec<u32> = doubled.take_while(|trials| *trials < last).chain([last]).collect();
    let planned_looks = sizes.len() as u32;
    let mut before = 0.0;
    let look = |(number, trials): (u32, u32)| {
        let spent = spent_error_share(f64::from(trials) / f64::from(last.max(1)));
        let share = spent - before;
        before = spent;
        Look { number, planned_looks, trials, error_share: share }
    };
    (1..).zip(sizes).map(look).collect()
}

/// Share of the error probability that is spent after the share `t` of the trials: `ln(1 + (e − 1)
/// t)`, of Pocock's type. It spends early, so a clear run ends at its first look. With O'Brien and
/// Fleming's function hardly any run would end there. K. K. G. Lan and D. L. DeMets, *Biometrika*
/// 70, 1983, pp. 659-663.
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
        assert_eq!(sizes(7, 3), [7], "`load` rejects a smaller maximum");
    }

    #[test]
    fn all_looks_together_spend_the_whole_error() {
        for (count, max) in [(30, 200), (2, 1_000), (5, 5), (10, 11)] {
            let planned = plan_looks(count, max);
            let sum: f64 = planned.iter().map(|look| 1.0 - look.confidence(0.9)).sum();
            assert!((sum - 0.1).abs() < 1e-12, "{sum}");
            assert!(planned.iter().all(|look| look.error_share > 0.0));
        }
        // The first look spends ln(1 + 1.71828 · 0.15) = 0.2294 of 5 %.
        assert!((plan_looks(30, 200)[0].confidence(0.95) - 0.988_53).abs() < 1e-5);
    }
}
