//! Defines estimates with confidence intervals, a test of residuals, and ARX models of order one at
//! the control period (paper, section IV.B and reference \[24\]).
//!
//! The ARX model is `y[k+1] = a y[k] + Σ c_i u_i[k] + e[k]`, so `τ = −Ts / ln a`, and a static gain
//! is `c / (1 − a)`. Least squares assume that `y[k]` is exact, so noise makes `a` and τ too small
//! for any number of samples. Instrumental variables (T. Söderström, P. Stoica, *System
//! Identification*, 1989, chapter 8) use the noise-free response of an auxiliary model in three
//! iterations and are consistent. Their intervals allow for the colour of the error `e[k] = v[k+1]
//! − a v[k]` of white noise v.

use nalgebra::{DMatrix, DVector};
use platebench_verdict::statistics::student_quantile;
use schemars::JsonSchema;
use serde::Serialize;
use statrs::distribution::{ChiSquared, ContinuousCDF};

pub const CONFIDENCE: f64 = 0.95;
pub(crate) const FREEDOM_OF_KNOWN_ERRORS: f64 = 1e4;

/// A value with its two-sided interval of 95 %.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
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
    student_quantile(freedom.max(1.0), f64::midpoint(1.0, CONFIDENCE))
}

/// Ljung-Box test for white residuals.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
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

/// Largest relative standard error of the second mode's gain, or of the shift by self-heating.
/// Noise alone does not reach five standard errors, even as the best of about twenty start points.
const MAX_STRENGTH_ERROR: f64 = 0.2;
const MAX_TIME_CONSTANT_ERROR: f64 = 0.5;

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum EffectFit {
    SecondMode(IdentifiedSecondMode),
    Heating(IdentifiedHeating),
}

impl EffectFit {
    pub(crate) fn is_determined(&self) -> bool {
        let (strength, time_constant) = match self {
            Self::SecondMode(mode) => (&mode.gain_um_per_vpp, &mode.time_constant_s),
            Self::Heating(heating) => (&heating.shift_hz_per_um2, &heating.time_constant_s),
        };
        let is_within = |part: &Estimate, share: f64| part.error < share * part.value.abs();
        is_within(strength, MAX_STRENGTH_ERROR) && is_within(time_constant, MAX_TIME_CONSTANT_ERROR)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub struct IdentifiedSecondMode {
    pub resonance_hz: Estimate,
    pub time_constant_s: Estimate,
    pub gain_um_per_vpp: Estimate,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub struct IdentifiedHeating {
    pub shift_hz_per_um2: Estimate,
    pub time_constant_s: Estimate,
}

pub(crate) fn pool_second_modes(effects: &[EffectFit]) -> Option<IdentifiedSecondMode> {
    let [resonance_hz, time_constant_s, gain_um_per_vpp] = pool(effects, |effect| match effect {
        EffectFit::SecondMode(mode) => Some([mode.resonance_hz, mode.time_constant_s, mode.gain_um_per_vpp]),
        EffectFit::Heating(_) => None,
    })?;
    Some(IdentifiedSecondMode { resonance_hz, time_constant_s, gain_um_per_vpp })
}

pub(crate) fn pool_heating(effects: &[EffectFit]) -> Option<IdentifiedHeating> {
    let [shift_hz_per_um2, time_constant_s] = pool(effects, |effect| match effect {
        EffectFit::Heating(heating) => Some([heating.shift_hz_per_um2, heating.time_constant_s]),
        EffectFit::SecondMode(_) => None,
    })?;
    Some(IdentifiedHeating { shift_hz_per_um2, time_constant_s })
}

fn pool<const N: usize>(
    effects: &[EffectFit],
    parameters: impl Fn(&EffectFit) -> Option<[Estimate; N]>,
) -> Option<[Estimate; N]> {
    let found: Vec<_> = effects.iter().filter_map(parameters).collect();
    let pooled = |index: usize| Estimate::pool(&found.iter().map(|each| each[index]).collect::<Vec<_>>());
    (0..N).map(pooled).collect::<Option<Vec<_>>>()?.try_into().ok()
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ArxMethod {
    LeastSquares,
    InstrumentalVariables,
}

#[derive(Debug, Clone, PartialEq)]
pub struct ArxModel {
    /// Time constant τ, s.
    pub time_constant: Estimate,
    pub gains: Vec<Estimate>,
}

/// Samples are `period` s apart, and inputs are constant between them. `None` if there are too few
/// samples, the inputs are linearly dependent, or `a` is not between 0 and 1.
pub fn arx(y: &[f64], inputs: &[Vec<f64>], period: f64, method: ArxMethod) -> Option<ArxModel> {
    arx_with_gaps(y, inputs, &vec![1; y.len().saturating_sub(1)], period, method)
}

/// `steps` are the numbers of periods from each sample to the next one. Only pairs of samples that
/// are one period apart are used.
pub(crate) fn arx_with_gaps(
    y: &[f64],
    inputs: &[Vec<f64>],
    steps: &[usize],
    period: f64,
    method: ArxMethod,
) -> Option<ArxModel> {
    let pairs: Vec<usize> = (0..y.len().saturating_sub(1)).filter(|sample| steps.get(*sample) == Some(&1)).collect();
    let (rows, width) = (pairs.len(), inputs.len() + 1);
    let freedom = rows.checked_sub(width).filter(|&freedom| freedom > 0)? as f64;
    let with = |states: &[f64]| {
        DMatrix::from_fn(rows, width, |row, column| match column.checked_sub(1) {
            None => states.get(pairs[row]).copied().unwrap_or(0.0),
            Some(input) => inputs.get(input).and_then(|values| values.get(pairs[row])).copied().unwrap_or(0.0),
        })
    };
    let target = pairs.iter().filter_map(|sample| y.get(sample + 1).copied());
    let (regressors, target) = (with(y), DVector::from_iterator(rows, target));
    let mut instruments = regressors.clone();
    let mut theta = solve(&instruments, &regressors, &target)?;
    if method == ArxMethod::InstrumentalVariables {
        for _ in 0..3 {
            instruments = with(&response(&theta, inputs, steps, y.len())?);
            theta = solve(&instruments, &regressors, &target)?;
        }
    }
    let a = theta.get(0).copied().filter(|a| (1e-3..0.9999).contains(a))?;
    let residuals = &target - &regressors * &theta;
    let power = residuals.norm_squared() / freedom;
    let inverse = (instruments.transpose() * &regressors).try_inverse()?;
    let middle = match method {
        ArxMethod::LeastSquares => instruments.transpose() * &instruments * power,
        ArxMethod::InstrumentalVariables => {
            // E[e eᵀ]: (1 + a²)σ² on the diagonal, −aσ² next to it; σ² is the power of v.
            let noise = power / (1.0 + a * a);
            let mut coloured = &instruments * power;
            for row in (1..rows).filter(|row| pairs[*row] == pairs[*row - 1] + 1) {
                for column in 0..width {
                    coloured[(row, column)] -= a * noise * instruments[(row - 1, column)];
                    coloured[(row - 1, column)] -= a * noise * instruments[(row, column)];
                }
            }
            instruments.transpose() * coloured
        }
    };
    let covariance = &inverse * middle * inverse.transpose();
    let error = |gradient: DVector<f64>| (gradient.transpose() * &covariance * &gradient).sum().max(0.0).sqrt();
    let gradient = |entries: &[(usize, f64)]| {
        let mut gradient = DVector::zeros(width);
        for &(index, value) in entries {
            gradient[index] = value;
        }
        gradient
    };
    let slope = period / (a * a.ln().powi(2));
    let gain = |(index, &c): (usize, &f64)| {
        let direction = gradient(&[(0, c / (1.0 - a).powi(2)), (index, 1.0 / (1.0 - a))]);
        Estimate::new(c / (1.0 - a), error(direction), freedom)
    };
    Some(ArxModel {
        time_constant: Estimate::new(-period / a.ln(), error(gradient(&[(0, slope)])), freedom),
        gains: theta.iter().enumerate().skip(1).map(gain).collect(),
    })
}

fn solve(instruments: &DMatrix<f64>, regressors: &DMatrix<f64>, target: &DVector<f64>) -> Option<DVector<f64>> {
    let theta = (instruments.transpose() * regressors).lu().solve(&(instruments.transpose() * target))?;
    theta.iter().all(|value| value.is_finite()).then_some(theta)
}

/// Response of the model, which starts in the steady state of the first inputs. `None` if the model
/// is unstable.
fn response(theta: &DVector<f64>, inputs: &[Vec<f64>], steps: &[usize], length: usize) -> Option<Vec<f64>> {
    let a = theta.get(0).copied().filter(|a| a.abs() < 1.0)?;
    let forced = |k: usize| -> f64 {
        let terms = theta.iter().skip(1).zip(inputs).map(|(c, input)| c * input.get(k).copied().unwrap_or(0.0));
        terms.sum()
    };
    let mut x = forced(0) / (1.0 - a);
    let mut all = Vec::with_capacity(length);
    for k in 0..length {
        all.push(x);
        for _ in 0..steps.get(k).copied().unwrap_or(1) {
            x = a * x + forced(k);
        }
    }
    Some(all)
}
