//! Mean and standard deviation over trials, and which bounds of them to take.

use super::{bootstrap, normality};
use platebench_record::EvidenceMethod;
use statrs::distribution::{ChiSquared, ContinuousCDF, StudentsT};

/// Mean and standard deviation of a sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SampleSummary {
    /// How many values.
    pub count: usize,
    /// Their mean.
    pub mean: f64,
    /// Their standard deviation with n − 1 in the denominator; zero for one value.
    pub deviation: f64,
}

impl SampleSummary {
    /// Summary of `values`; `None` where there are none.
    pub fn of(values: &[f64]) -> Option<Self> {
        let count = values.len();
        if count == 0 {
            return None;
        }
        let mean = values.iter().sum::<f64>() / count as f64;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let deviation = if count > 1 { (squares / (count - 1) as f64).sqrt() } else { 0.0 };
        Some(Self { count, mean, deviation })
    }

    /// One-sided bounds of the mean by Student's t (normal data, unknown deviation). `None` below two values.
    pub fn mean_bounds(&self, confidence: f64) -> Option<[f64; 2]> {
        let freedom = self.degrees_of_freedom()?;
        let quantile = StudentsT::new(0.0, 1.0, freedom).ok()?.inverse_cdf(confidence);
        let half = quantile * self.deviation / (self.count as f64).sqrt();
        Some([self.mean - half, self.mean + half])
    }

    /// One-sided bounds of the standard deviation by chi-square: `s √(f/χ²)` (normal data). `None` below two values.
    pub fn deviation_bounds(&self, confidence: f64) -> Option<[f64; 2]> {
        let freedom = self.degrees_of_freedom()?;
        let chi_squared = ChiSquared::new(freedom).ok()?;
        let bound = |probability: f64| self.deviation * (freedom / chi_squared.inverse_cdf(probability)).sqrt();
        Some([bound(confidence), bound(1.0 - confidence)])
    }

    fn degrees_of_freedom(&self) -> Option<f64> {
        (self.count > 1).then(|| (self.count - 1) as f64)
    }
}

/// Bounds of the mean, each one-sided at `confidence`: by t, or where normality is refused by bootstrap. `None` below two values.
pub fn mean_bounds(values: &[f64], confidence: f64) -> Option<([f64; 2], EvidenceMethod)> {
    let summary = SampleSummary::of(values)?;
    let normal = summary.mean_bounds(confidence)?;
    if !normality::is_rejected(values) {
        return Some((normal, EvidenceMethod::T));
    }
    let mean_of = |values: &[f64]| SampleSummary::of(values).map_or(0.0, |summary| summary.mean);
    Some((bootstrap_bounds(values, mean_of, mean_and_error, confidence), EvidenceMethod::Bootstrap))
}

/// Bounds of the standard deviation, each one-sided at `confidence`: by chi-square, or where normality is refused by bootstrap. `None` below two values.
pub fn deviation_bounds(values: &[f64], confidence: f64) -> Option<([f64; 2], EvidenceMethod)> {
    let summary = SampleSummary::of(values)?;
    let normal = summary.deviation_bounds(confidence)?;
    if !normality::is_rejected(values) {
        return Some((normal, EvidenceMethod::ChiSquare));
    }
    // A deviation is a scale: on its logarithm it is nearer to a shift, and bounds stay above 0.
    let logarithm = |values: &[f64]| SampleSummary::of(values).map_or(0.0, |summary| summary.deviation.ln());
    let bounds = bootstrap_bounds(values, logarithm, logarithm_and_error, confidence).map(f64::exp);
    // One sample of normal data in twenty is refused by mistake: resampling may widen the bounds of its deviation, and never narrows them.
    Some((outer_bounds(normal, bounds), EvidenceMethod::Bootstrap))
}

/// How likely a deviation is refused that is `ratio` times what it should agree with, where agreement means to lie in the two-sided chi-square interval with
/// each end at `per_side` (normal data). `None` below two values.
///
/// `P = 1 − F(χ²_hi/ρ²) + F(χ²_lo/ρ²)`: s² (n − 1)/σ² is chi-square distributed with n − 1 degrees of freedom, σ = ρ σ0.
pub fn agreement_power(count: usize, per_side: f64, ratio: f64) -> Option<f64> {
    let chi_squared = ChiSquared::new(count.checked_sub(1)? as f64).ok()?;
    let scaled = |probability: f64| chi_squared.cdf(chi_squared.inverse_cdf(probability) / (ratio * ratio));
    Some(1.0 - scaled(per_side) + scaled(1.0 - per_side))
}

/// The outer ends of two intervals.
fn outer_bounds(one: [f64; 2], other: [f64; 2]) -> [f64; 2] {
    [one[0].min(other[0]), one[1].max(other[1])]
}

/// The outer ends of both bootstraps: BCa is short above where data are skewed, the other one where they have corners. Where neither has an answer there is
/// no bound.
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

/// ln s with its standard error `√((m4/m2² − 1)/4n)` (M. Kendall and A. Stuart, *The Advanced Theory of Statistics* 1, section 10.5, for s², by the delta
/// method).
fn logarithm_and_error(values: &[f64]) -> (f64, f64) {
    let Some(summary) = SampleSummary::of(values).filter(|summary| summary.deviation > 0.0) else {
        return (f64::NEG_INFINITY, 0.0);
    };
    let count = summary.count as f64;
    let moment = |power: i32| values.iter().map(|value| (value - summary.mean).powi(power)).sum::<f64>() / count;
    // Two values in equal parts have a fourth moment of the least size there is: no error at first order.
    let excess = (moment(4) / moment(2).powi(2) - 1.0).max(f64::EPSILON);
    (summary.deviation.ln(), (excess / (4.0 * count)).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_summary_is_the_textbook_s() {
        let summary = SampleSummary::of(&[1.0, 2.0, 3.0, 4.0]).unwrap();
        assert_eq!(summary.mean, 2.5);
        assert!((summary.deviation - (5.0_f64 / 3.0).sqrt()).abs() < 1e-15);
        assert_eq!(SampleSummary::of(&[]), None);
        assert_eq!(SampleSummary::of(&[7.0]).unwrap().mean_bounds(0.95), None);
        assert_eq!((mean_bounds(&[7.0], 0.95), deviation_bounds(&[7.0], 0.95)), (None, None));
    }

    #[test]
    fn thirty_trials_demonstrate_1_3_percent_at_1_016_and_not_above() {
        let upper = |deviation| SampleSummary { count: 30, mean: 0.0, deviation }.deviation_bounds(0.95).unwrap()[1];
        assert!(upper(1.015) < 1.3, "{}", upper(1.015));
        assert!(upper(1.017) > 1.3, "{}", upper(1.017));
    }

    #[test]
    fn the_power_is_the_level_at_the_value_itself_and_grows_with_the_distance() {
        let power = |count, ratio| agreement_power(count, 0.975, ratio).unwrap();
        for count in [2, 30, 300] {
            assert!((power(count, 1.0) - 0.05).abs() < 1e-9);
        }
        assert!(power(5, 2.0) < power(10, 2.0) && power(10, 1.5) < power(10, 2.0) && power(10, 0.5) > 0.05);
        assert_eq!(agreement_power(1, 0.975, 2.0), None);
    }

    #[test]
    fn what_is_plainly_not_normal_is_resampled() {
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
        // Never narrower than for normal data.
        let flat: Vec<f64> = [0.0, 1.0].repeat(15);
        let (bounds, method) = deviation_bounds(&flat, 0.95).unwrap();
        let normal = SampleSummary::of(&flat).unwrap().deviation_bounds(0.95).unwrap();
        assert_eq!((method, bounds), (EvidenceMethod::Bootstrap, normal));
        // Too high a confidence for resampling leaves everything open, and in order.
        assert_eq!(deviation_bounds(&skewed, 0.999_999_9).unwrap().0, [0.0, f64::INFINITY]);
        assert_eq!(mean_bounds(&skewed, 0.999_999_9).unwrap().0, [f64::NEG_INFINITY, f64::INFINITY]);
    }
}
