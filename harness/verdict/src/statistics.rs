//! Computes intervals over trials.
//!
//! Each end of an interval is a one-sided bound at the stated confidence c (two one-sided tests):
//! `at_most` is demonstrated if the upper end meets it. As a two-sided interval it has the
//! confidence `2c − 1`. The tests simulate the coverage.

mod bootstrap;
mod incomplete_beta;
mod ranks;
mod sample;
mod student;

use incomplete_beta::incomplete_beta;
use platebench_model::record::EvidenceMethod;
use statrs::distribution::{ChiSquared, ContinuousCDF};
use std::convert::Infallible;

pub use ranks::{rank_correlation, rank_correlation_bounds, rank_index, ranks};
pub use sample::SampleSummary;
use sample::is_rejected;
pub use student::student_quantile;

/// One-sided bounds by t, or by bootstrap if normality is rejected. `None` below two values.
pub fn mean_bounds(values: &[f64], confidence: f64) -> Option<([f64; 2], EvidenceMethod)> {
    let summary = SampleSummary::of(values)?;
    let normal = summary.mean_bounds(confidence)?;
    if !is_rejected(values) {
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
    if !is_rejected(values) {
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

/// Widens bounds of an absolute value by the bench's error `margin`, so that this error neither
/// passes nor fails a controller. Two one-sided tests: D. J. Schuirmann, *J. Pharmacokin.
/// Biopharm.* 15, 1987, pp. 657-680.
pub fn widen_bounds(bounds: [f64; 2], margin: f64) -> [f64; 2] {
    if margin > 0.0 { [(bounds[0] - margin).max(0.0), bounds[1] + margin] } else { bounds }
}

/// As [`try_bisect`], for a condition that cannot fail.
pub fn bisect(ends: [f64; 2], times: u32, holds: impl Fn(f64) -> bool) -> [f64; 2] {
    let Ok(ends) = try_bisect(ends, times, |at| Ok::<_, Infallible>(holds(at)));
    ends
}

/// Halves an interval `times` times. `holds` is true at its first end and false at the second.
pub fn try_bisect<E>(
    [mut low, mut high]: [f64; 2],
    times: u32,
    holds: impl Fn(f64) -> Result<bool, E>,
) -> Result<[f64; 2], E> {
    for _ in 0..times {
        let middle = f64::midpoint(low, high);
        *(if holds(middle)? { &mut low } else { &mut high }) = middle;
    }
    Ok([low, high])
}

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
    if seen >= count { 1.0 } else { incomplete_beta(f64::from(count - seen), f64::from(seen) + 1.0, 1.0 - p, p) }
}

/// `I_p(k, n − k + 1)`, the regularised incomplete beta function, with k events in n trials.
pub fn probability_at_least(seen: u32, count: u32, p: f64) -> f64 {
    match seen {
        0 => 1.0,
        _ if seen > count => 0.0,
        _ => incomplete_beta(f64::from(seen), f64::from(count - seen) + 1.0, p, 1.0 - p),
    }
}

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

// Corrects the error rate of a test that is evaluated several times (alpha spending).
//
// A test that stops at the first favourable look exceeds its error rate. Therefore look k, at the
// share `t_k` of the trials, may be wrong with probability `α(t_k) − α(t_{k−1})`. By Boole's
// inequality the sum is at most 1 − c (confidence c), for every test and every dependence between
// looks. Boundaries for Brownian motion are not used, because they need large samples.

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Look {
    /// Number of the look, counted from 1.
    pub number: u32,
    pub planned_looks: u32,
    pub trials: u32,
    error_share: f64,
}

impl Look {
    pub const SINGLE: Self = Self { number: 1, planned_looks: 1, trials: 0, error_share: 1.0 };

    /// Confidence of a bound at this look, if all looks together have `confidence`.
    pub fn confidence(&self, confidence: f64) -> f64 {
        if self.error_share >= 1.0 {
            confidence
        } else {
            (1.0 - (1.0 - confidence) * self.error_share).min(1.0_f64.next_down())
        }
    }
}

/// Looks after `count` trials, after 2, 4, 8 … times as many, and after `max_count`.
pub fn plan_looks(count: u32, max_count: u32) -> Vec<Look> {
    let last = max_count.max(count);
    let doubled = std::iter::successors(Some(count.max(1)), |trials| trials.checked_mul(2));
    let sizes: Vec<u32> = doubled.take_while(|trials| *trials < last).chain([last]).collect();
    let planned_looks = sizes.len() as u32;
    let mut before = 0.0;
    let look = |(number, trials): (u32, u32)| {
        let spent = spent_error_share(f64::from(trials) / f64::from(last.max(1)));
        let share = spent - before;
        before = spent;
        Look { number, planned_looks, trials, error_share: share }
    };
    (1..).zip(sizes).map(look).collect()
}

/// Share of the error probability that is spent after the share `t` of the trials: `ln(1 + (e − 1)
/// t)`, of Pocock's type. It spends early, so a clear run ends at its first look. With O'Brien and
/// Fleming's function hardly any run would end there. K. K. G. Lan and D. L. DeMets, *Biometrika*
/// 70, 1983, pp. 659-663.
fn spent_error_share(t: f64) -> f64 {
    if t >= 1.0 { 1.0 } else { ((std::f64::consts::E - 1.0) * t).ln_1p() }
}

#[cfg(test)]
mod tests;
