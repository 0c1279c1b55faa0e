//! Bounds the probability of an event by its observed frequency.

use crate::bisection::bisect;
use statrs::function::beta::beta_reg;

/// Sufficient for the resolution of a double.
const BISECTION_STEPS: u32 = 60;

/// One-sided bounds with a coverage of at least `confidence`; `None` without trials. If the
/// probability is the lower (upper) bound, at least (at most) `seen` events occur with probability
/// `1 − confidence`: C. J. Clopper, E. S. Pearson, *Biometrika* 26, 1934, pp. 404-413.
pub fn clopper_pearson(seen: u32, count: u32, confidence: f64) -> Option<[f64; 2]> {
    if count == 0 || seen > count {
        return None;
    }
    let tail = 1.0 - confidence;
    let lower = if seen == 0 {
        0.0
    } else {
        bisect([0.0, 1.0], BISECTION_STEPS, |p| probability_at_least(seen, count, p) < tail)[1]
    };
    let upper = if seen == count {
        1.0
    } else {
        bisect([0.0, 1.0], BISECTION_STEPS, |p| probability_at_most(seen, count, p) >= tail)[1]
    };
    Some([lower, upper])
}

/// `I_{1−p}(n − k, k + 1)`, the regularised incomplete beta function, with k events in n trials.
pub fn probability_at_most(seen: u32, count: u32, p: f64) -> f64 {
    if seen >= count {
        1.0
    } else {
        beta_reg(f64::from(count - seen), f64::from(seen) + 1.0, (1.0 - p).clamp(0.0, 1.0))
    }
}

/// `I_p(k, n − k + 1)`, the regularised incomplete beta function, with k events in n trials.
pub fn probability_at_least(seen: u32, count: u32, p: f64) -> f64 {
    match seen {
        0 => 1.0,
        _ if seen > count => 0.0,
        _ => beta_reg(f64::from(seen), f64::from(count - seen) + 1.0, p.clamp(0.0, 1.0)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    // Without events the bound is 1 − 0.05^(1/n): below 1 % it needs 299 trials, below 0.1 % 2995.
    #[case(0, 30, 0.0, 0.095_034)]
    #[case(0, 299, 0.0, 0.009_969)]
    #[case(0, 2_995, 0.0, 0.000_999_7)]
    // Each end at 97.5 % gives the two-sided 95 % interval of the tables.
    #[case(5, 10, 0.187_086, 0.812_914)]
    #[case(10, 10, 0.691_503, 1.0)]
    fn the_bounds_are_the_tabulated_ones(#[case] seen: u32, #[case] count: u32, #[case] low: f64, #[case] high: f64) {
        let confidence = if seen == 0 { 0.95 } else { 0.975 };
        let [lower, upper] = clopper_pearson(seen, count, confidence).unwrap();
        assert!((lower - low).abs() < 1e-6 && (upper - high).abs() < 1e-6, "{lower} {upper}");
    }

    #[test]
    fn below_one_percent_needs_299_trials() {
        let upper = |count| clopper_pearson(0, count, 0.95).unwrap()[1];
        assert!(upper(298) > 0.01 && upper(299) < 0.01);
        assert!(upper(2_994) > 0.001 && upper(2_995) < 0.001);
    }

    #[test]
    fn the_tails_are_the_binomial_sums() {
        for (seen, least, most) in [(0, 1.0, 0.125), (1, 0.875, 0.5), (2, 0.5, 0.875), (3, 0.125, 1.0)] {
            assert!(
                (probability_at_least(seen, 3, 0.5) - least).abs() < 1e-12
                    && (probability_at_most(seen, 3, 0.5) - most).abs() < 1e-12
            );
        }
        assert_eq!(
            (probability_at_least(4, 3, 0.5), probability_at_most(2, 3, 0.0), probability_at_least(1, 3, 0.0)),
            (0.0, 1.0, 0.0)
        );
    }

    #[test]
    fn no_trials_have_no_bounds() {
        assert_eq!(clopper_pearson(0, 0, 0.95), None);
        assert_eq!(clopper_pearson(2, 1, 0.95), None);
    }
}
