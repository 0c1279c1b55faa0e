//! Defines estimates with confidence intervals, and a test of residuals.

use serde::Serialize;
use statrs::distribution::{ChiSquared, ContinuousCDF, StudentsT};

pub const CONFIDENCE: f64 = 0.95;
pub(crate) const FREEDOM_OF_KNOWN_ERRORS: f64 = 1e4;

/// A value with its two-sided interval of 95 %.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    pub value: f64,
    /// Standard error.
    pub error: f64,
    pub low: f64,
    pub high: f64,
    /// Degrees of freedom of the error.
    #[serde(skip)]
    pub freedom: f64,
}

impl Estimate {
    pub fn new(value: f64, error: f64, freedom: f64) -> Self {
        let reach = quantile(freedom) * error;
        Self { value, error, low: value - reach, high: value + reach, freedom }
    }

    /// Estimate of a positive value whose logarithm has a normal error.
    pub fn from_logarithm(logarithm: f64, error: f64, freedom: f64) -> Self {
        let reach = quantile(freedom) * error;
        let value = logarithm.exp();
        Self { value, error: value * error, low: (logarithm - reach).exp(), high: (logarithm + reach).exp(), freedom }
    }

    #[must_use]
    pub fn scaled(self, factor: f64) -> Self {
        let (a, b) = (self.low * factor, self.high * factor);
        Self { value: self.value * factor, error: (self.error * factor).abs(), low: a.min(b), high: a.max(b), ..self }
    }

    #[must_use]
    pub(crate) fn shifted(self, by: f64) -> Self {
        Self { value: self.value + by, low: self.low + by, high: self.high + by, ..self }
    }

    pub fn contains(&self, truth: f64) -> bool {
        (self.low..=self.high).contains(&truth)
    }

    /// Mean of independent estimates of one quantity, weighted with their inverse variances.
    pub(crate) fn combine_independent(estimates: &[Self]) -> Option<Self> {
        if let [] | [_] = estimates {
            return estimates.first().copied();
        }
        let precision = |each: &Self| each.error.max(f64::MIN_POSITIVE).powi(-2);
        let sum: f64 = estimates.iter().map(precision).sum();
        let value = estimates.iter().map(|each| each.value * precision(each)).sum::<f64>() / sum;
        Some(Self::new(value, sum.sqrt().recip(), FREEDOM_OF_KNOWN_ERRORS))
    }

    /// Pools estimates with the names of their recordings. Estimates of one recording count as one.
    pub fn pool_by_recording(estimates: &[(String, Self)]) -> Option<Self> {
        let mut sorted = estimates.to_vec();
        sorted.sort_by(|a, b| a.0.cmp(&b.0));
        let groups = sorted.chunk_by(|a, b| a.0 == b.0);
        let own = |group: &[(String, Self)]| Self::pool(&group.iter().map(|(_, each)| *each).collect::<Vec<_>>());
        Self::pool(&groups.filter_map(own).collect::<Vec<_>>())
    }

    /// Mean of the estimates. Its error is the error from their scatter or from their stated
    /// errors, whichever is larger.
    pub fn pool(estimates: &[Self]) -> Option<Self> {
        let (first, count) = (*estimates.first()?, estimates.len() as f64);
        if estimates.len() == 1 {
            return Some(first);
        }
        let mean = estimates.iter().map(|each| each.value).sum::<f64>() / count;
        let scatter = (estimates.iter().map(|each| (each.value - mean).powi(2)).sum::<f64>() / (count - 1.0)).sqrt();
        let stated = estimates.iter().map(|each| each.error * each.error).sum::<f64>().sqrt() / count;
        Some(Self::new(mean, (scatter / count.sqrt()).max(stated), count - 1.0))
    }
}

fn quantile(freedom: f64) -> f64 {
    StudentsT::new(0.0, 1.0, freedom.max(1.0)).map_or(f64::INFINITY, |t| t.inverse_cdf(f64::midpoint(1.0, CONFIDENCE)))
}

/// Ljung-Box test for white residuals.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct WhitenessTest {
    /// Statistic `Q = n(n+2) Σ ρ²/(n−k)` over all lags k and both components.
    pub statistic: f64,
    /// Degrees of freedom: lags times components.
    pub freedom: usize,
    /// Probability of a statistic at least this large if the residuals are white.
    pub p_value: f64,
}

impl WhitenessTest {
    /// Tests lags up to 10 or a fifth of the length. `None` for fewer than ten residuals or
    /// constant residuals. The model uses no past outputs, so the degrees of freedom are not
    /// reduced (G. M. Ljung, G. E. P. Box, Biometrika 65, 1978).
    pub fn ljung_box(components: &[Vec<f64>]) -> Option<Self> {
        let mut whole = Self { statistic: 0.0, freedom: 0, p_value: 1.0 };
        for residuals in components {
            let n = residuals.len() as f64;
            let mean = residuals.iter().sum::<f64>() / n;
            let power: f64 = residuals.iter().map(|r| (r - mean).powi(2)).sum();
            if residuals.len() < 10 || power <= 0.0 {
                return None;
            }
            for lag in 1..=(residuals.len() / 5).min(10) {
                let late = residuals.iter().skip(lag);
                let product: f64 = residuals.iter().zip(late).map(|(a, b)| (a - mean) * (b - mean)).sum();
                whole.statistic += n * (n + 2.0) * (product / power).powi(2) / (n - lag as f64);
                whole.freedom += 1;
            }
        }
        whole.p_value = ChiSquared::new(whole.freedom as f64).ok()?.sf(whole.statistic);
        Some(whole)
    }

    pub fn is_rejected(&self) -> bool {
        self.p_value < 0.01
    }
}
