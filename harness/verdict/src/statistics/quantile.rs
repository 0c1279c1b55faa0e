//! Bounds quantiles by order statistics.

use super::proportion::probability_at_most;

/// Quantile at `share` with bounds, each one-sided at `confidence`, for any distribution. A bound
/// is infinite if the sample is too small: a 95 % quantile at 95 % confidence needs 59 values.
///
/// W. J. Conover, *Practical Nonparametric Statistics*, 3rd ed. 1999, section 3.2: upper bound =
/// r-th smallest value with the least r for which `P(B(n, share) ≤ r − 1) ≥ confidence`, lower
/// bound = that with the greatest r for which `P(B(n, share) ≤ r − 1) ≤ 1 − confidence`.
pub fn quantile_bounds(values: &[f64], share: f64, confidence: f64) -> Option<(f64, [f64; 2])> {
    let count = u32::try_from(values.len()).ok().filter(|count| *count > 0)?;
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let ranked = |rank: u32| rank.checked_sub(1).and_then(|index| sorted.get(index as usize)).copied();
    // The probability P(B ≤ r − 1) rises with the rank r, so the ranks are found by bisection.
    let below = |rank: u32| probability_at_most(rank - 1, count, share);
    let upper = bisect_index(1, count, |rank| below(rank) >= confidence).and_then(ranked);
    let beyond = bisect_index(1, count, |rank| below(rank) > 1.0 - confidence).unwrap_or(count + 1);
    let lower = ranked(beyond - 1);
    // The estimate is the smallest value that at least this share of the values does not exceed.
    let estimate = ranked(((f64::from(count) * share).ceil() as u32).clamp(1, count))?;
    Some((estimate, [lower.unwrap_or(f64::NEG_INFINITY), upper.unwrap_or(f64::INFINITY)]))
}

/// Smallest sample size with a finite bound on the side with fewer values.
pub fn min_values_for_bound(share: f64, confidence: f64) -> u32 {
    let rarer = share.max(1.0 - share);
    ((1.0 - confidence).ln() / rarer.ln()).ceil().min(f64::from(u32::MAX)) as u32
}

fn bisect_index(low: u32, high: u32, holds: impl Fn(u32) -> bool) -> Option<u32> {
    let (mut low, mut high) = (low, high.checked_add(1)?);
    let end = high;
    while low < high {
        let middle = low + (high - low) / 2;
        if holds(middle) { high = middle } else { low = middle + 1 }
    }
    (low < end).then_some(low)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp(count: u32) -> Vec<f64> {
        (1..=count).rev().map(f64::from).collect()
    }

    #[test]
    fn the_ranks_are_the_tabulated_ones() {
        // Ranks 11 and 20 bound the median of 30: P(B ≤ 10) = 0.0494, P(B ≤ 19) = 0.9506.
        assert_eq!(quantile_bounds(&ramp(30), 0.5, 0.95), Some((15.0, [11.0, 20.0])));
        // An upper bound of the 95 % quantile needs 59 values and is then the largest one.
        assert_eq!(quantile_bounds(&ramp(58), 0.95, 0.95).unwrap().1[1], f64::INFINITY);
        assert_eq!(quantile_bounds(&ramp(59), 0.95, 0.95).unwrap().1[1], 59.0);
        assert_eq!((min_values_for_bound(0.95, 0.95), min_values_for_bound(0.05, 0.95)), (59, 59));
        assert_eq!(quantile_bounds(&ramp(92), 0.95, 0.95).unwrap().1[1], 92.0);
        assert_eq!(quantile_bounds(&ramp(93), 0.95, 0.95).unwrap().1[1], 92.0);
    }

    #[test]
    fn low_quantiles_mirror_high_ones() {
        let high = quantile_bounds(&ramp(100), 0.9, 0.95).unwrap().1;
        let low = quantile_bounds(&ramp(100), 0.1, 0.95).unwrap().1;
        assert_eq!(low.map(|rank| 101.0 - rank), [high[1], high[0]]);
        assert_eq!(quantile_bounds(&ramp(10), 0.05, 0.95).unwrap().1[0], f64::NEG_INFINITY);
    }

    #[test]
    fn accepts_infinite_values_and_none() {
        assert_eq!(quantile_bounds(&[], 0.5, 0.95), None);
        let mut values = ramp(93);
        values[0] = f64::INFINITY;
        assert_eq!(quantile_bounds(&values, 0.95, 0.95).unwrap().1[1], 92.0);
        assert_eq!(quantile_bounds(&[1.0], 0.5, 0.95), Some((1.0, [f64::NEG_INFINITY, f64::INFINITY])));
    }
}
