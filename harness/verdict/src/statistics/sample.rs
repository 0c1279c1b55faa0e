//! Summarises a sample by mean and standard deviation, with bounds for normal data, and tests data
//! for normality.

use super::student::student_quantile;
use statrs::distribution::{ChiSquared, ContinuousCDF, Normal};

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SampleSummary {
    pub count: usize,
    pub mean: f64,
    /// Standard deviation with n − 1 in the denominator; 0 for one value.
    pub deviation: f64,
}

impl SampleSummary {
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

    /// One-sided bounds by Student's t for normal data. `None` for fewer than two values.
    pub fn mean_bounds(&self, confidence: f64) -> Option<[f64; 2]> {
        let freedom = self.degrees_of_freedom()?;
        let quantile = student_quantile(freedom, confidence);
        let half = quantile * self.deviation / (self.count as f64).sqrt();
        Some([self.mean - half, self.mean + half])
    }

    /// One-sided bounds of `self.mean − other.mean` for normal data, by Welch's t with
    /// Welch-Satterthwaite degrees of freedom. `None` if a sample has fewer than two values.
    pub fn difference_bounds(&self, other: &Self, confidence: f64) -> Option<[f64; 2]> {
        let difference = self.mean - other.mean;
        let share = |summary: &Self| {
            let freedom = summary.degrees_of_freedom()?;
            let variance = summary.deviation.powi(2) / summary.count as f64;
            Some((variance, variance.powi(2) / freedom))
        };
        let ((own, own_part), (theirs, their_part)) = (share(self)?, share(other)?);
        let variance = own + theirs;
        if variance == 0.0 {
            return Some([difference, difference]);
        }
        let freedom = variance.powi(2) / (own_part + their_part);
        let half = student_quantile(freedom, confidence) * variance.sqrt();
        Some([difference - half, difference + half])
    }

    /// One-sided bounds by chi-square (normal data), f = n − 1: `s √(f/χ²)`. `None` below two
    /// values.
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

/// Critical value of the modified statistic at the level of 5 % (Stephens 1986, table 4.7, case 3).
const CRITICAL_VALUE: f64 = 0.752;
/// The correction for small samples is valid from this number of values (Stephens 1986).
const MIN_VALUES: usize = 8;

/// The modified statistic A²\* for normal data; `None` below eight values or if all are equal.
/// M. A. Stephens, "Tests based on EDF statistics", in D'Agostino and Stephens, *Goodness-of-Fit
/// Techniques*, 1986, section 4.8.5: `A² = −n − Σ (2i − 1)/n · (ln Φ(z_i) + ln(1 − Φ(z_{n+1−i})))`
/// over the sorted standardised values, times `1 + 0.75/n + 2.25/n²`.
fn anderson_darling(values: &[f64]) -> Option<f64> {
    let summary = SampleSummary::of(values)?;
    if values.len() < MIN_VALUES || summary.deviation <= 0.0 || !summary.deviation.is_finite() {
        return None;
    }
    let normal = Normal::standard();
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let standardised = |value: &f64| (value - summary.mean) / summary.deviation;
    // In the far tail the probability rounds to 0, whose logarithm is infinite.
    let logarithm = |probability: f64| probability.max(f64::MIN_POSITIVE).ln();
    let count = values.len() as f64;
    let terms = sorted.iter().zip(sorted.iter().rev()).zip(1_u32..).map(|((low, high), rank)| {
        let weight = f64::from(2 * rank - 1) / count;
        weight * (logarithm(normal.cdf(standardised(low))) + logarithm(normal.sf(standardised(high))))
    });
    let statistic = -count - terms.sum::<f64>();
    Some(statistic * (1.0 + 0.75 / count + 2.25 / (count * count)))
}

/// True if normality is rejected at the level of 5 %. False for fewer than eight values.
pub(super) fn is_rejected(values: &[f64]) -> bool {
    anderson_darling(values).is_some_and(|statistic| statistic > CRITICAL_VALUE)
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
    }

    #[test]
    fn equal_samples_have_the_textbook_interval_of_their_difference() {
        let [first, second] =
            [1.0, 3.0].map(|from| SampleSummary::of(&[from, from + 1.0, from + 2.0, from + 3.0]).unwrap());
        // t(0.975, 6) = 2.44691, standard error √(2 · 5/12).
        let half = 2.446_911_851 * (5.0_f64 / 6.0).sqrt();
        let bounds = second.difference_bounds(&first, 0.975).unwrap();
        assert!((bounds[0] - (2.0 - half)).abs() < 1e-8 && (bounds[1] - (2.0 + half)).abs() < 1e-8, "{bounds:?}");
        let one = SampleSummary::of(&[1.0]).unwrap();
        assert_eq!(one.difference_bounds(&first, 0.975), None);
    }

    #[test]
    fn thirty_trials_demonstrate_1_3_percent_at_1_016() {
        let upper = |deviation| SampleSummary { count: 30, mean: 0.0, deviation }.deviation_bounds(0.95).unwrap()[1];
        assert!(upper(1.015) < 1.3, "{}", upper(1.015));
        assert!(upper(1.017) > 1.3, "{}", upper(1.017));
    }

    #[test]
    fn the_statistic_equals_a_published_example() {
        // Weights of 11 men (Shapiro and Wilk 1965): A² = 0.947, multiplied by 1 + 0.75/11 +
        // 2.25/121. The test of Shapiro and Wilk rejects normality too.
        let weights = [148.0, 154.0, 158.0, 160.0, 161.0, 162.0, 166.0, 170.0, 182.0, 195.0, 236.0];
        let statistic = anderson_darling(&weights).unwrap();
        assert!((statistic - 0.947 * 1.086_78).abs() < 5e-3, "{statistic}");
        assert!(is_rejected(&weights));
    }

    #[test]
    fn too_few_or_equal_values_reject_nothing() {
        assert_eq!(anderson_darling(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 9.0]), None);
        assert!(anderson_darling(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 9.0]).is_some());
        assert_eq!(anderson_darling(&[1.0; 30]), None);
        assert_eq!(anderson_darling(&[f64::MAX; 30]), None);
        assert_eq!(anderson_darling(&[]), None);
    }
}
