//! Computes bounds of data that are not normal. The seed of the resamples is the number of values,
//! so a stored run has the same bounds.

use super::sample::SampleSummary;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use statrs::distribution::{ContinuousCDF, Normal};

/// At a confidence of 95 %, 100 of 1999 resamples are outside each bound.
const MIN_RESAMPLES: usize = 1_999;
const MIN_TAIL_RESAMPLES: f64 = 10.0;
/// If a bound needs more resamples, it is not computed.
const MAX_RESAMPLES: usize = 20_000;

/// Bias-corrected and accelerated bounds, each one-sided at `confidence`. `None` for fewer than
/// three values or for equal values.
///
/// B. Efron, "Better bootstrap confidence intervals", *J. Am. Stat. Assoc.* 82, 1987, pp. 171-185:
/// the percentile `Φ(z0 + (z0 + z)/(1 − a (z0 + z)))` of the resampled statistic. The bias `z0` is
/// from the share of resamples below the statistic, the acceleration `a` from the jackknife.
pub(super) fn bca_bounds(values: &[f64], statistic: impl Fn(&[f64]) -> f64, confidence: f64) -> Option<[f64; 2]> {
    let estimate = statistic(values);
    let acceleration = acceleration(values, &statistic)?;
    let mut resampled = resample(values, &statistic, confidence)?;
    resampled.sort_by(f64::total_cmp);
    let normal = Normal::standard();
    let below = resampled.partition_point(|value| *value < estimate) as f64;
    let not_above = resampled.partition_point(|value| *value <= estimate) as f64;
    let count = resampled.len() as f64;
    // A resample that equals the estimate counts half.
    let bias = normal.inverse_cdf((f64::midpoint(below, not_above) / count).clamp(0.5 / count, 1.0 - 0.5 / count));
    let bound = |probability: f64| {
        let shifted = bias + normal.inverse_cdf(probability);
        let scale = 1.0 - acceleration * shifted;
        // Beyond the pole of the formula the percentile is 0 or 1.
        let share = if scale > 0.0 { normal.cdf(bias + shifted / scale) } else { f64::from(u8::from(shifted > 0.0)) };
        percentile(&resampled, share)
    };
    Some([bound(1.0 - confidence)?, bound(confidence)?])
}

/// `Σ d³ / 6 (Σ d²)^1.5`; d is the mean of the leave-one-out statistics minus one of them (Efron
/// 1987, equation 7.3).
fn acceleration(values: &[f64], statistic: &impl Fn(&[f64]) -> f64) -> Option<f64> {
    if values.len() < 3 {
        return None;
    }
    let mut left = values.to_vec();
    let last = left.pop()?;
    let mut without = Vec::with_capacity(values.len());
    without.push(statistic(&left));
    for index in 0..left.len() {
        let taken = std::mem::replace(left.get_mut(index)?, last);
        without.push(statistic(&left));
        *left.get_mut(index)? = taken;
    }
    let mean = SampleSummary::of(&without)?.mean;
    let sum = |power: i32| without.iter().map(|value| (mean - value).powi(power)).sum::<f64>();
    let squares = sum(2);
    (squares > 0.0).then(|| sum(3) / (6.0 * squares.powf(1.5)))
}

/// Studentised one-sided bounds. `estimate` returns a value and its standard error. `None` for
/// fewer than three values or a standard error of 0. P. Hall, *Ann. Stat.* 16, 1988, pp. 927-953:
/// the pivot `(θ* − θ)/s*` replaces Student's t. Its upper end covers more than that of BCa for the
/// mean of skewed data and for the logarithm of a deviation.
pub(super) fn studentised_bounds(
    values: &[f64],
    estimate: impl Fn(&[f64]) -> (f64, f64),
    confidence: f64,
) -> Option<[f64; 2]> {
    let (centre, error) = estimate(values);
    if values.len() < 3 || !centre.is_finite() || error <= 0.0 || !error.is_finite() {
        return None;
    }
    let pivot = |sample: &[f64]| {
        let (other, error) = estimate(sample);
        if error > 0.0 { (other - centre) / error } else { f64::INFINITY.copysign(other - centre) }
    };
    let mut pivots = resample(values, pivot, confidence)?;
    pivots.sort_by(f64::total_cmp);
    Some([centre - percentile(&pivots, confidence)? * error, centre - percentile(&pivots, 1.0 - confidence)? * error])
}

fn percentile(sorted: &[f64], share: f64) -> Option<f64> {
    let count = sorted.len() as f64;
    let position = (share * (count + 1.0)).clamp(1.0, count) - 1.0;
    let (left, right) = (*sorted.get(position.floor() as usize)?, *sorted.get(position.ceil() as usize)?);
    Some(if left == right { left } else { left + (right - left) * position.fract() })
}

/// Draws enough resamples for `confidence`; `None` if that takes too many.
fn resample(values: &[f64], statistic: impl Fn(&[f64]) -> f64, confidence: f64) -> Option<Vec<f64>> {
    let outside = 1.0 - confidence;
    let resamples = ((MIN_TAIL_RESAMPLES / outside).ceil() as usize).saturating_sub(1).max(MIN_RESAMPLES);
    if resamples > MAX_RESAMPLES {
        return None;
    }
    let count = values.len() as u64;
    let mut random = ChaCha8Rng::seed_from_u64(count);
    let mut sample = vec![0.0; values.len()];
    let mut one = || {
        for place in &mut sample {
            let index = (u64::from(random.next_u32()) * count) >> 32;
            *place = values.get(index as usize).copied().unwrap_or_default();
        }
        statistic(&sample)
    };
    Some((0..resamples).map(|_| one()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mean(values: &[f64]) -> f64 {
        values.iter().sum::<f64>() / values.len() as f64
    }

    fn mean_and_error(values: &[f64]) -> (f64, f64) {
        let summary = SampleSummary::of(values).unwrap();
        (summary.mean, summary.deviation / (summary.count as f64).sqrt())
    }

    const SKEWED: [f64; 10] = [0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 0.9, 1.3, 2.0, 4.6];

    #[test]
    fn the_acceleration_follows_the_skewness() {
        // a = skewness/(6 √n) with moments over n, because leave-one-out means mirror the values.
        let centre = mean(&SKEWED);
        let moment = |power: i32| SKEWED.iter().map(|value| (value - centre).powi(power)).sum::<f64>();
        let expected = moment(3) / (6.0 * moment(2).powf(1.5));
        assert!((acceleration(&SKEWED, &mean).unwrap() - expected).abs() < 1e-9);
        assert!(expected > 0.0);
    }

    #[test]
    fn the_bound_is_the_resample_at_the_published_percentile() {
        let normal = Normal::standard();
        let mut resampled = resample(&SKEWED, mean, 0.95).unwrap();
        resampled.sort_by(f64::total_cmp);
        let share = |value: f64| resampled.partition_point(|other| *other <= value) as f64 / resampled.len() as f64;
        let (bias, acceleration) = (normal.inverse_cdf(share(mean(&SKEWED))), acceleration(&SKEWED, &mean).unwrap());
        for (bound, z) in bca_bounds(&SKEWED, mean, 0.95).unwrap().into_iter().zip([-1.644_854, 1.644_854]) {
            let percentile = normal.cdf(bias + (bias + z) / (1.0 - acceleration * (bias + z)));
            assert!((share(bound) - percentile).abs() < 1e-3, "{} {percentile}", share(bound));
        }
        assert!(bias > 0.0 && share(bca_bounds(&SKEWED, mean, 0.95).unwrap()[1]) > 0.98);
    }

    #[test]
    fn bounds_of_skewed_data_are_longer_above() {
        for bounds in
            [bca_bounds(&SKEWED, mean, 0.95).unwrap(), studentised_bounds(&SKEWED, mean_and_error, 0.95).unwrap()]
        {
            let below = mean(&SKEWED) - bounds[0];
            let above = bounds[1] - mean(&SKEWED);
            assert!(0.0 < below && below < above, "{bounds:?}");
        }
    }

    #[test]
    fn bounds_repeat_and_widen_with_the_confidence() {
        let at = |confidence| bca_bounds(&SKEWED, mean, confidence).unwrap();
        assert_eq!(at(0.95), at(0.95));
        assert!(at(0.999)[0] < at(0.95)[0] && at(0.95)[1] < at(0.999)[1]);
        assert_eq!(bca_bounds(&SKEWED, mean, 0.999_999_9), None, "too many resamples");
        assert_eq!(studentised_bounds(&SKEWED, mean_and_error, 0.999_999_9), None);
    }

    #[test]
    fn constant_data_have_no_bounds() {
        assert_eq!(bca_bounds(&[1.0; 10], mean, 0.95), None);
        assert_eq!(bca_bounds(&[1.0, 2.0], mean, 0.95), None);
        assert_eq!(studentised_bounds(&[1.0; 10], mean_and_error, 0.95), None);
        assert_eq!(studentised_bounds(&[1.0, 2.0], mean_and_error, 0.95), None);
    }
}
