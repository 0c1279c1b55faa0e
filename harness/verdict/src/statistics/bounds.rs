//! Chooses the bounds of mean and standard deviation over trials.

use super::sample_summary::SampleSummary;
use super::{bootstrap, normality};
use platebench_model::record::EvidenceMethod;
use statrs::distribution::{ChiSquared, ContinuousCDF};

/// One-sided bounds by t, or by bootstrap if normality is rejected. `None` below two values.
pub fn mean_bounds(values: &[f64], confidence: f64) -> Option<([f64; 2], EvidenceMethod)> {
    let summary = SampleSummary::of(values)?;
    let normal = summary.mean_bounds(confidence)?;
    if !normality::is_rejected(values) {
        return Some((normal, EvidenceMethod::T));
    }
    let mean_of = |values: &[f64]| SampleSummary::of(values).map_or(0.0, |summary| summary.mean);
    Some((bootstrap_bounds(values, mean_of, mean_and_error, confidence), EvidenceMethod::Bootstrap))
}

/// One-sided bounds by chi-square, or by bootstrap if normality is rejected. `None` for fewer than
/// two values.
pub fn deviation_bounds(values: &[f64], confidence: f64) -> Option<([f64; 2], EvidenceMethod)> {
    let summary = SampleSummary::of(values)?;
    let normal = summary.deviation_bounds(confidence)?;
    if !normality::is_rejected(values) {
        return Some((normal, EvidenceMethod::ChiSquare));
    }
    // The logarithm turns a factor on the deviation into a shift, and its bounds stay above 0.
    let logarithm = |values: &[f64]| SampleSummary::of(values).map_or(0.0, |summary| summary.deviation.ln());
    let bounds = bootstrap_bounds(values, logarithm, logarithm_and_error, confidence).map(f64::exp);
    // One of twenty normal samples is rejected by chance, which must not narrow its bounds.
    Some((outer_bounds(normal, bounds), EvidenceMethod::Bootstrap))
}

/// Probability that a deviation of `ratio` times the expected value is rejected, if the two-sided
/// chi-square interval with each end at `per_side` must contain the expected value (normal data):
/// `P = 1 − F(χ²_hi/ρ²) + F(χ²_lo/ρ²)`, because s² (n − 1)/σ² has n − 1 degrees of freedom; ρ =
/// σ/σ0 is `ratio`.
pub fn agreement_power(count: usize, per_side: f64, ratio: f64) -> Option<f64> {
    let chi_squared = ChiSquared::new(count.checked_sub(1)? as f64).ok()?;
    let scaled = |probability: f64| chi_squared.cdf(chi_squared.inverse_cdf(probability) / (ratio * ratio));
    Some(1.0 - scaled(per_side) + scaled(1.0 - per_side))
}

fn outer_bounds(one: [f64; 2], other: [f64; 2]) -> [f64; 2] {
    [one[0].min(other[0]), one[1].max(other[1])]
}

/// The upper end of BCa is too low for skewed data, that of the studentised bounds for data with
/// corners. Infinite if one of them has no bounds.
fn bootstrap_bounds(
    values: &[f64],
    statistic: impl Fn(&[f64]) -> f64,
    estimate: impl Fn(&[f64]) -> (f64, f64),
    confidence: f64,
) -> [f64; 2] {
    let both = bootstrap::bca_bounds(values, statistic, confidence)
        .zip(bootstrap::studentised_bounds(values, estimate, confidence));
    both.map_or([f64::NEG_INFINITY, f64::INFINITY], |(one, other)| outer_bounds(one, other))
}

fn mean_and_error(values: &[f64]) -> (f64, f64) {
    SampleSummary::of(values)
        .map_or((0.0, 0.0), |summary| (summary.mean, summary.deviation / (summary.count as f64).sqrt()))
}

/// ln s with its standard error `√((m4/m2² − 1)/4n)` (M. Kendall and A. Stuart, *The Advanced
/// Theory of Statistics* 1, section 10.5, for s², by the delta method).
fn logarithm_and_error(values: &[f64]) -> (f64, f64) {
    let Some(summary) = SampleSummary::of(values).filter(|summary| summary.deviation > 0.0) else {
        return (f64::NEG_INFINITY, 0.0);
    };
    let count = summary.count as f64;
    let moment = |power: i32| values.iter().map(|value| (value - summary.mean).powi(power)).sum::<f64>() / count;
    // Two values in equal parts have the smallest possible fourth moment, which gives no error at
    // first order.
    let excess = (moment(4) / moment(2).powi(2) - 1.0).max(f64::EPSILON);
    (summary.deviation.ln(), (excess / (4.0 * count)).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_value_has_no_bounds() {
        assert_eq!((mean_bounds(&[7.0], 0.95), deviation_bounds(&[7.0], 0.95)), (None, None));
    }

    #[test]
    fn the_power_grows_from_the_level_with_the_distance() {
        let power = |count, ratio| agreement_power(count, 0.975, ratio).unwrap();
        for count in [2, 30, 300] {
            assert!((power(count, 1.0) - 0.05).abs() < 1e-9);
        }
        assert!(power(5, 2.0) < power(10, 2.0) && power(10, 1.5) < power(10, 2.0) && power(10, 0.5) > 0.05);
        assert_eq!(agreement_power(1, 0.975, 2.0), None);
    }

    #[test]
    fn resamples_data_that_are_not_normal() {
        let even: Vec<f64> = (1..=20).map(f64::from).collect();
        assert_eq!(mean_bounds(&even, 0.95).map(|(_, method)| method), Some(EvidenceMethod::T));
        assert_eq!(deviation_bounds(&even, 0.95).map(|(_, method)| method), Some(EvidenceMethod::ChiSquare));
        let skewed: Vec<f64> = even.iter().map(|value| (value / 3.0).exp()).collect();
        let (mean, deviation) = (mean_bounds(&skewed, 0.95).unwrap(), deviation_bounds(&skewed, 0.95).unwrap());
        assert_eq!((mean.1, deviation.1), (EvidenceMethod::Bootstrap, EvidenceMethod::Bootstrap));
        let summary = SampleSummary::of(&skewed).unwrap();
        for ([low, high], value) in [(mean.0, summary.mean), (deviation.0, summary.deviation)] {
            assert!(0.0 < low && low < value && value < high, "{low} {value} {high}");
        }
        let flat: Vec<f64> = [0.0, 1.0].repeat(15);
        let (bounds, method) = deviation_bounds(&flat, 0.95).unwrap();
        let normal = SampleSummary::of(&flat).unwrap().deviation_bounds(0.95).unwrap();
        assert_eq!((method, bounds), (EvidenceMethod::Bootstrap, normal));
        assert_eq!(deviation_bounds(&skewed, 0.999_999_9).unwrap().0, [0.0, f64::INFINITY]);
        assert_eq!(mean_bounds(&skewed, 0.999_999_9).unwrap().0, [f64::NEG_INFINITY, f64::INFINITY]);
    }
}
