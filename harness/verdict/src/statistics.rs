//! Intervals for what only many trials can tell.
//!
//! Each end of an interval is a one-sided bound at the stated confidence: `at_most` is demonstrated when the upper end keeps to it. That is the two
//! one-sided tests' convention; as a two-sided interval it has the confidence `2c − 1`.

use statrs::distribution::{ChiSquared, ContinuousCDF, StudentsT};

/// Mean and standard deviation of a sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Summary {
    /// How many values.
    pub count: usize,
    /// Their mean.
    pub mean: f64,
    /// Their standard deviation with n − 1 in the denominator; zero for one value.
    pub deviation: f64,
}

impl Summary {
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
        let freedom = self.freedom()?;
        let quantile = StudentsT::new(0.0, 1.0, freedom).ok()?.inverse_cdf(confidence);
        let half = quantile * self.deviation / (self.count as f64).sqrt();
        Some([self.mean - half, self.mean + half])
    }

    /// One-sided bounds of the standard deviation by chi-square: `s √(f/χ²)` (normal data). `None` below two values.
    pub fn deviation_bounds(&self, confidence: f64) -> Option<[f64; 2]> {
        let freedom = self.freedom()?;
        let chi_squared = ChiSquared::new(freedom).ok()?;
        let bound = |probability: f64| self.deviation * (freedom / chi_squared.inverse_cdf(probability)).sqrt();
        Some([bound(confidence), bound(1.0 - confidence)])
    }

    fn freedom(&self) -> Option<f64> {
        (self.count > 1).then(|| (self.count - 1) as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    #[test]
    fn a_summary_is_the_textbook_s() {
        let summary = Summary::of(&[1.0, 2.0, 3.0, 4.0]).unwrap();
        assert_eq!(summary.mean, 2.5);
        assert!((summary.deviation - (5.0_f64 / 3.0).sqrt()).abs() < 1e-15);
        assert_eq!(Summary::of(&[]), None);
        assert_eq!(Summary::of(&[7.0]).unwrap().mean_bounds(0.95), None);
    }

    #[test]
    fn thirty_trials_demonstrate_1_3_percent_at_1_016_and_not_above() {
        let upper = |deviation| Summary { count: 30, mean: 0.0, deviation }.deviation_bounds(0.95).unwrap()[1];
        assert!(upper(1.015) < 1.3, "{}", upper(1.015));
        assert!(upper(1.017) > 1.3, "{}", upper(1.017));
    }

    #[test]
    fn bounds_cover_the_truth_at_their_rate() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let runs = 4_000;
        let mut covered = [0_u32; 4];
        for _ in 0..runs {
            let values: Vec<f64> =
                (0..12).map(|_| 5.0 + 2.0 * Distribution::<f64>::sample(&StandardNormal, &mut random)).collect();
            let summary = Summary::of(&values).unwrap();
            let [mean_low, mean_high] = summary.mean_bounds(0.95).unwrap();
            let [low, high] = summary.deviation_bounds(0.95).unwrap();
            for (count, holds) in covered.iter_mut().zip([mean_low <= 5.0, 5.0 <= mean_high, low <= 2.0, 2.0 <= high]) {
                *count += u32::from(holds);
            }
        }
        for count in covered {
            let rate = f64::from(count) / f64::from(runs);
            // Three standard errors of a proportion of 0.95 over 4 000 runs: 1.0 %.
            assert!((rate - 0.95).abs() < 0.0104, "{covered:?}");
        }
    }
}
