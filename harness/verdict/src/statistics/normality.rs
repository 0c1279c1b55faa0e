//! Tests data for normality.

use super::sample_summary::SampleSummary;
use statrs::distribution::{ContinuousCDF, Normal};

/// Critical value of the modified statistic at the level of 5 % (Stephens 1986, table 4.7, case 3).
const CRITICAL_VALUE: f64 = 0.752;
/// The correction for small samples is valid from this number of values (Stephens 1986).
const MIN_VALUES: usize = 8;

/// The modified statistic A²\* for normal data; `None` below eight values or if all are equal.
/// M. A. Stephens, "Tests based on EDF statistics", in D'Agostino and Stephens, *Goodness-of-Fit
/// Techniques*, 1986, section 4.8.5: `A² = −n − Σ (2i − 1)/n · (ln Φ(z_i) + ln(1 − Φ(z_{n+1−i})))`
/// over the sorted standardised values, times `1 + 0.75/n + 2.25/n²`.
pub fn anderson_darling(values: &[f64]) -> Option<f64> {
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
pub fn is_rejected(values: &[f64]) -> bool {
    anderson_darling(values).is_some_and(|statistic| statistic > CRITICAL_VALUE)
}

#[cfg(test)]
mod tests {
    use super::*;

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
